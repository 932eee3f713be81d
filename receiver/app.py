"""The receiver as an HTTP service. Make it with `create_app`; nothing is opened before its lifespan starts."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import asdict
from functools import partial
from hashlib import sha256
from http import HTTPStatus
from itertools import chain
from typing import Annotated, Any, TypeVar

import anyio
import numpy as np
from anyio.to_thread import run_sync as run_in_thread
from fastapi import APIRouter, Body, Depends, FastAPI, Header, Path, Query, Request, Response
from fastapi.responses import HTMLResponse, StreamingResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent

from common.asgi import Head
from common.channel import Channel
from common.channel.carrying import FAULTS_HEADER
from common.errors import ForbiddenError, MediaTypeError, NotFoundError, NotReadyError, ParameterError
from common.messages import SurfaceId
from common.network.model import NetworkSettings, SurfaceModel
from common.page import Page, api_page, read_page
from common.problems import described
from common.surface import FloatArray
from common.version import product_version
from common.wire import MEDIA_TYPES
from receiver import grids, schemas
from receiver.formats import GRID_FORMATS, TABLE_FORMATS, Format, Table, choose
from receiver.metrics import CONTENT_TYPE, CountRequests, Metrics
from receiver.middleware import SENT, ChannelMiddleware
from receiver.picture import Palette, Style
from receiver.problems import Guard, install, known_query
from receiver.settings import Settings
from receiver.store import Row, Store
from receiver.surfaces import Surfaces, Train

Content = TypeVar("Content")

DESCRIPTION = """
Takes the packets of a surface's feature points in, whatever a poor link left of them, trains a Gaussian radial basis
function network on them, and answers with heights.

Every error is a problem of RFC 9457, `application/problem+json`.
"""


class NotStarted(NotReadyError):  # noqa: N818 - a state that passes, not a fault
    """The receiver is not up yet, or is stopping."""

    status = 503
    title = "Not started"
    retry_after = 1


def _surfaces(request: Request) -> Surfaces:
    surfaces: Surfaces | None = request.app.state.surfaces
    if surfaces is None:
        raise NotStarted("the receiver is not up")
    return surfaces


async def _known(request: Request, name: Id) -> Row:
    return await run_in_thread(_surfaces(request).store.get, name)


def _settings(request: Request) -> Settings:
    settings: Settings = request.app.state.settings
    return settings


Here = Annotated[Surfaces, Depends(_surfaces)]
Configured = Annotated[Settings, Depends(_settings)]
Id = Annotated[
    SurfaceId,
    Path(
        alias="id",
        description="Of the surface: 1 to 64 letters, digits, dots, underlines, hyphens; not . or .. alone.",
        examples=["hills"],
    ),
]
Wait = Annotated[
    float, Query(ge=0, allow_inf_nan=False, description="Seconds to wait until the surface is ready or failed.")
]


def _forms(formats: Sequence[Format[Content]]) -> Any:
    """What ?f= may be, as OpenAPI tells it: of `formats`, those that what is installed here can write."""
    names = [form.name for form in formats if form.available]
    return Query(alias="f", description="Form of the answer; before Accept.", json_schema_extra={"enum": names})


GridForm = Annotated[str | None, _forms(GRID_FORMATS)]
TableForm = Annotated[str | None, _forms(TABLE_FORMATS)]
Accept = Annotated[str | None, Header(description="Media types, with q where some are preferred.")]


def _problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """OpenAPI's description of the errors of a call."""
    return {status: described(HTTPStatus(status).phrase) for status in statuses}


def _offers(formats: Iterable[Format[Content]], description: str) -> dict[int | str, dict[str, Any]]:
    """OpenAPI's description of an answer in several forms."""
    binary = {"schema": {"type": "string", "format": "binary"}}
    texts = {"application/json": {"schema": {"type": "object"}}, "text/csv": {"schema": {"type": "string"}}}
    return {
        200: {
            "description": description,
            "content": {form.media_type: texts.get(form.media_type, binary) for form in formats if form.available},
        }
    }


api = APIRouter()


@api.post(
    "/v1/transmissions/{id}",
    tags=["transmissions"],
    status_code=202,
    summary="Take packets in",
    responses=_problems(400, 409, 413, 415, 422),
    openapi_extra={
        "requestBody": {
            "required": True,
            "description": "Packets end to end, as docs/wire.md specifies them.",
            "content": {kind: {"schema": {"type": "string", "format": "binary"}} for kind in sorted(MEDIA_TYPES)},
        }
    },
)
async def transmit(
    request: Request, response: Response, here: Here, name: Id, network: Annotated[NetworkSettings, Query()]
) -> schemas.Receipt:
    """Packets of a surface, all or some of them, in any order, as often as you like: those that are here already
    change nothing. What is acknowledged survives a restart. The network is trained on all that is here whenever a body
    changed it; its settings are query parameters, and hold on for later bodies until they are given anew. Each is taken
    back by its default: `spread=auto`, `smoothing=auto`, `tolerance=0`, `max_centers=all`, `mapping=height`."""
    content_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if content_type not in MEDIA_TYPES:
        raise MediaTypeError(f"a body of packets is accepted as {', '.join(sorted(MEDIA_TYPES))}")
    if request.headers.get("content-encoding", "identity").lower() != "identity":
        raise MediaTypeError("a body in a content coding is not accepted")
    body = await request.body()
    # A channel in front of this service says so; what it left need not be a packet.
    sent: bytes | None = None if FAULTS_HEADER in request.headers else request.scope.get(SENT, body)
    receipt = await here.receive(name, body, network.model_dump(exclude_unset=True), sent=sent)
    response.headers["Location"] = receipt.links.surface
    return receipt


@api.get("/v1/surfaces", tags=["surfaces"], summary="List the surfaces", responses=_problems(422))
async def list_surfaces(
    here: Here,
    limit: Annotated[int, Query(ge=1, le=1_000, description="Most surfaces to list.")] = 100,
    before: Annotated[int | None, Query(ge=0, lt=2**63, description="Where an earlier list's `next` goes on.")] = None,
) -> schemas.SurfaceList:
    """The surfaces that are kept, the latest first."""
    return await here.list(before=before, limit=limit)


@api.get("/v1/surfaces/{id}", tags=["surfaces"], summary="Describe a surface", responses=_problems(404, 422))
async def get_surface(here: Here, settings: Configured, name: Id, wait: Wait = 0.0) -> schemas.SurfaceInfo:
    """State, region, units, packets, and the network once it is ready; with `wait`, after it is ready or failed."""
    if wait:
        await here.settle(name, _bounded(wait, settings))
    return await here.info(name)


@api.delete(
    "/v1/surfaces/{id}", tags=["surfaces"], status_code=204, summary="Remove a surface", responses=_problems(404, 422)
)
async def delete_surface(here: Here, name: Id) -> None:
    """Call its training off, and remove all that was received and trained."""
    await here.delete(name)


@api.get(
    "/v1/surfaces/{id}/grid",
    tags=["surfaces"],
    summary="Compute heights",
    response_class=Response,
    responses=_offers(GRID_FORMATS, "Heights on a rectangular grid, rows along ascending y.")
    | {304: {"description": "The bytes that If-None-Match names are still right."}}
    | _problems(404, 406, 409, 422),
)
async def get_grid(
    request: Request,
    here: Here,
    settings: Configured,
    name: Id,
    shape: Annotated[
        str | None,
        Query(
            description="rows,columns; 200,200 unless given, for a picture in the proportions of the region.",
            examples=["200,200"],
        ),
    ] = None,
    bbox: Annotated[
        str | None, Query(description="x_min,y_min,x_max,y_max within the region; all of it unless given.")
    ] = None,
    std: Annotated[
        bool, Query(description="Also the standard deviation of the heights; in a picture, instead of them.")
    ] = False,
    form: GridForm = None,
    wait: Wait = 0.0,
    palette: Annotated[Palette, Query(description="Colours of a picture.")] = "viridis",
    shading: Annotated[bool, Query(description="Whether a picture shades slopes.")] = True,
    colorbar: Annotated[
        bool, Query(description="Whether a picture has axes and a colour bar; without, one pixel is one node.")
    ] = True,
    accept: Accept = None,
) -> Response:
    """Heights of the trained network, in the form that `f` or else the header Accept asks for."""
    chosen = choose(GRID_FORMATS, form, accept)
    most = settings.max_std_cells if std else settings.max_grid_cells
    given = None if shape is None else grids.parse_shape(shape, most)
    row, model = await here.model(name, _bounded(wait, settings))
    region = model.region if bbox is None else grids.parse_bbox(bbox, model.region)
    if given is None:
        given = grids.default_shape(region, chosen.name == "png", most)
    wanted = grids.GridRequest(region, given, std, Style(palette, shading, colorbar))
    return await _deliver(
        request, row, chosen, wanted.tag(row.digest or "", chosen), partial(wanted.answer, name, model)
    )


@api.get(
    "/v1/surfaces/{id}/features",
    tags=["surfaces"],
    summary="Give the feature points",
    response_class=Response,
    responses=_offers(TABLE_FORMATS, "What has arrived: x, y, z of each point.") | _problems(404, 406, 409, 422),
)
async def get_features(
    request: Request, here: Here, name: Id, form: TableForm = None, accept: Accept = None
) -> Response:
    """The points that have arrived, as the network is trained on them."""
    chosen = choose(TABLE_FORMATS, form, accept)
    row, features = await here.features(name)
    # Not the row's number: in a new data folder it would come again with other points.
    told = (row.features, features.region, features.units, features.gap, features.kind, chosen.name)
    tag = f'"{sha256(repr(told).encode()).hexdigest()[:32]}"'

    def table() -> Table:
        about = {
            "id": name,
            "region": asdict(features.region),
            "units": asdict(features.units),
            "gap": features.gap,
            "kind": features.kind,
        }
        x, y, z = features.points.T
        return Table({"x": x, "y": y, "z": z}, about)

    return await _deliver(request, row, chosen, tag, table)


@api.get(
    "/v1/surfaces/{id}/network",
    tags=["surfaces"],
    summary="Give the network",
    response_class=Response,
    responses=_offers(TABLE_FORMATS, "Centres, and their coefficients for each spread.")
    | _problems(404, 406, 409, 422),
)
async def get_network(
    request: Request,
    here: Here,
    settings: Configured,
    name: Id,
    form: TableForm = None,
    wait: Wait = 0.0,
    accept: Accept = None,
) -> Response:
    """The centres of the trained network and their coefficients."""
    chosen = choose(TABLE_FORMATS, form, accept)
    row, model = await here.model(name, _bounded(wait, settings))
    tag = f'"{(row.digest or "")[:32]}-{chosen.name}-network"'

    def table() -> Table:
        return Table(_neurons(model), {"id": name} | model.summary())

    return await _deliver(request, row, chosen, tag, table)


@api.get(
    "/v1/surfaces/{id}/events",
    tags=["events"],
    summary="Follow a surface",
    response_class=EventSourceResponse,
    responses=_problems(404, 422),
)
async def follow_surface(here: Here, row: Annotated[Row, Depends(_known)]) -> AsyncIterator[ServerSentEvent]:
    """Server-sent events until the surface is ready, failed or removed: `surface` with its description whenever its
    state changes, `progress` with stage and fraction, `deleted`."""
    async for event in _events(here, row.id):
        yield event


@api.get("/v1/events", tags=["events"], summary="Follow all surfaces", response_class=EventSourceResponse)
async def follow_all(here: Here) -> AsyncIterator[ServerSentEvent]:
    """The same of all surfaces, without an end."""
    async for event in _events(here, None):
        yield event


@api.get("/v1/channel", tags=["channel"], summary="Show the channel in force")
async def get_channel(request: Request, settings: Configured) -> schemas.ChannelInfo:
    """What harms each transmission before the receiver sees it."""
    return _channel_info(request.app.state.channel, settings)


@api.put("/v1/channel", tags=["channel"], summary="Put a channel in force", responses=_problems(400, 403, 415, 422))
async def put_channel(
    request: Request,
    settings: Configured,
    document: Annotated[
        Any,
        Body(
            description='Impairments and seed, or {"spec": the short string}.',
            openapi_examples={
                "short": {"value": {"spec": "gaussian:std=0.1;erasure:p=0.05", "seed": 7}},
                "long": {"value": {"impairments": [{"kind": "gaussian", "std": 0.1}], "seed": 7}},
            },
        ),
    ],
) -> schemas.ChannelInfo:
    """For requests that start later; forgotten at a restart. Only where RECEIVER_CHANNEL_CONTROL allows it."""
    if not settings.channel_control:
        raise ForbiddenError("the channel is fixed here; start the receiver with --channel-control to change it")
    if isinstance(document, bytes):  # what FastAPI hands on where the body is not said to be JSON
        raise MediaTypeError("a channel is accepted as application/json; say so in the header Content-Type")
    request.app.state.channel = Channel.from_json(document)
    return _channel_info(request.app.state.channel, settings)


@api.get("/health/live", tags=["health"], summary="Is the process alive?")
async def live() -> schemas.Health:
    """Yes, as long as its event loop turns."""
    return schemas.Health()


@api.get("/health/ready", tags=["health"], summary="Can it take packets in?", responses=_problems(503))
async def ready(here: Here) -> schemas.Health:
    """Yes, if its store can be written: a little is, and synced."""
    await run_in_thread(here.store.ping)
    return schemas.Health()


@api.get("/metrics", tags=["health"], summary="Counters", response_class=Response)
async def metrics(here: Here) -> Response:
    """In the text format of Prometheus."""
    surfaces = await run_in_thread(here.store.count)
    return Response(here.metrics.text(surfaces=surfaces, running=len(here.trainings)), media_type=CONTENT_TYPE)


@api.get("/", include_in_schema=False, response_class=HTMLResponse)
async def viewer(request: Request) -> HTMLResponse:
    """The viewer: one page that asks this service for everything else."""
    return _page(request.app.state.viewer)


@api.get("/docs", include_in_schema=False, response_class=HTMLResponse)
async def docs(request: Request) -> HTMLResponse:
    """The OpenAPI document for people, without the network that FastAPI's own page needs."""
    return _page(request.app.state.docs)


def _page(page: Page) -> HTMLResponse:
    return HTMLResponse(page.text, headers=page.headers)


def _neurons(model: SurfaceModel) -> dict[str, FloatArray]:
    """Centres x, y (and z, where points are mapped to points), then their coefficients.

    There is a column of coefficients for each spread, the greatest first, and for each output. The patches of a large
    network share the amplitudes of their spreads: they have one column, the centres of each patch in turn.
    """
    network = model.network
    single = np.ndim(network.spread_) == 0 or network.patches_ > 1
    levels = network.coefficients_[None] if single else network.coefficients_
    outputs = levels[:, :, None] if levels.ndim == 2 else levels
    columns = dict(zip("xyz", network.centers_[network.members_].T, strict=False))
    for level, coefficients in enumerate(outputs):
        for axis, values in zip("xyz", coefficients.T, strict=False):
            number = "" if single else f"_{level}"
            columns[f"coefficient{number}" + (f"_{axis}" if outputs.shape[2] > 1 else "")] = values
    return columns


def _bounded(wait: float, settings: Settings) -> float:
    if wait > settings.max_wait_seconds:
        raise ParameterError(f"wait is at most {settings.max_wait_seconds:g} seconds here")
    return wait


def _channel_info(channel: Channel, settings: Settings) -> schemas.ChannelInfo:
    return schemas.ChannelInfo(**channel.to_json(), spec=str(channel), control=settings.channel_control)


async def _events(here: Surfaces, name: str | None) -> AsyncIterator[ServerSentEvent]:
    """Events of one surface until it is settled, or of all."""
    with here.changes.subscribe(name) as subscription:
        states: dict[str, tuple[str, str]] = {}
        changed = name
        while True:
            if changed is not None:
                try:
                    info = await here.info(changed)
                except NotFoundError:
                    yield ServerSentEvent(event="deleted", data={"id": changed})
                    info = None
                if info is None:
                    states.pop(changed, None)
                elif states.get(changed) != (state := (info.state, info.updated)):
                    states[changed] = state
                    yield ServerSentEvent(event="surface", data=info.model_dump(mode="json"))
                elif info.progress is not None:
                    yield ServerSentEvent(event="progress", data={"id": changed} | info.progress.model_dump())
                if name is not None and (info is None or info.state in ("ready", "failed")):
                    return
            changed = await subscription.next()
            if changed is None:
                return


def _matches(lines: Iterable[str], tag: str) -> bool:
    """Whether If-None-Match, in one line or several, names `tag` (RFC 9110, section 13.1.2: weakly compared)."""
    given = [part.strip().removeprefix("W/") for line in lines for part in line.split(",")]
    return tag in given or given == ["*"]


async def _deliver(
    request: Request, row: Row, form: Format[Content], tag: str, make: Callable[[], Content]
) -> Response:
    """`make`'s content in `form`, or 304 where the client has it already."""
    headers = {"ETag": tag, "Cache-Control": "no-cache", "Vary": "Accept"}
    if _matches(request.headers.getlist("if-none-match"), tag):
        return Response(status_code=304, headers=headers)

    def begin() -> tuple[bytes, Iterator[bytes]]:
        parts = form.render(make())
        return next(parts), parts

    first, others = await run_in_thread(begin, limiter=request.app.state.rendering)
    headers["Content-Disposition"] = f'inline; filename="{row.id}.{form.name}"'
    return StreamingResponse(chain([first], others), media_type=form.media_type, headers=headers)


def create_app(settings: Settings | None = None, *, train: Train = SurfaceModel.train) -> FastAPI:
    """A receiver.

    Parameters
    ----------
    settings : Settings, optional
        From the environment unless given.
    train : callable
        Stands in for `SurfaceModel.train`.

    Raises
    ------
    ChannelError
        If the channel of the settings cannot be built. The lifespan raises StoreError where the data folder cannot be
        used.
    """
    known = settings or Settings()
    counters = Metrics()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        app.state.rendering = anyio.CapacityLimiter(known.renderings)
        store = await run_in_thread(Store, known.data)
        try:
            async with Surfaces.open(
                store, trainings=known.trainings, cached=known.cached_models, metrics=counters, train=train
            ) as app.state.surfaces:
                yield
        finally:
            app.state.surfaces = None
            store.close()

    app = FastAPI(
        title="surfacelink receiver",
        version=product_version(),
        description=DESCRIPTION,
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        dependencies=[Depends(known_query)],
        responses=_problems(422, 500),
    )
    app.state.settings = known
    app.state.surfaces = None
    app.state.viewer, app.state.docs = read_page("receiver", "viewer/index.html"), api_page(home="Viewer")
    app.state.channel = Channel.given(known.channel, known.seed if "seed" in known.model_fields_set else None)
    app.include_router(api)
    install(app)
    # The last one added stands outermost.
    app.add_middleware(Head)
    app.add_middleware(CountRequests, metrics=counters)
    app.add_middleware(ChannelMiddleware, max_body_bytes=known.max_body_bytes)
    app.add_middleware(Guard, max_body_bytes=known.max_body_bytes)
    return app
