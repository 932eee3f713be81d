"""The sender as a service: name a surface or upload a file, and it goes to the receiver."""

from __future__ import annotations

import logging
import uuid
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import asdict
from functools import partial
from http import HTTPStatus
from typing import Annotated, Any, Literal, TypeAlias

import anyio
import anyio.abc
from fastapi import APIRouter, Depends, FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, RedirectResponse
from pydantic import BaseModel, Field, ValidationError
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from common.asgi import Head, limited
from common.errors import LimitError, MediaTypeError, NotFoundError, ParameterError, SurfacelinkError, hint
from common.messages import Receipt
from common.network.model import NetworkSettings
from common.page import api_page
from common.problems import (
    MEDIA_TYPE,
    SCHEMAS,
    Problem,
    described,
    problem_of,
    problem_of_fields,
    problem_of_status,
    refused_parameters,
)
from common.version import product_version
from common.wire import WireOptions
from sender.client import ReceiverClient
from sender.readers import parse_points
from sender.settings import Settings
from sender.surfaces import SURFACES, find_surface
from sender.transmission import Order, Prepared, deliver, prepare

logger = logging.getLogger(__name__)

MAX_ORDER_BYTES = 64 << 10
"""Of an order that comes alone, and of what a form may hold beside its file: boundaries, headers, the order."""

FIELDS = ("file", "order")
"""Of a form."""

PARTS: Mapping[int | str, type[BaseModel]] = {"wire": WireOptions, "network": NetworkSettings}
"""Members of an order that have members of their own."""


class SurfaceOut(BaseModel):
    """A surface that can be sent by name."""

    name: str
    title: str
    points: int = Field(description="Points of the cloud, unless another number is asked for.")
    gap: float = Field(description="Segment gap, in the units of x and y.")
    region: dict[str, float]
    units: dict[str, str]


class TransmissionOut(BaseModel):
    """A transmission and what has become of it."""

    id: str
    state: Literal["sending", "sent", "failed"]
    surface: str = Field(description="Id of the surface at the receiver.")
    cloud_points: int
    feature_points: int
    packets: int = Field(description="Packets put on the air, retransmissions included.")
    bytes: int = Field(description="Bytes put on the air, retransmissions included.")
    protection_bytes: int = Field(description="Bytes of one sending that are there for the channel's sake.")
    notes: tuple[str, ...] = Field((), description="What is worth a word of how the file was read.")
    retransmissions: int = Field(0, description="Packets sent again.")
    receipt: Receipt | None = Field(None, description="The receiver's last receipt.")
    links: dict[str, str] = Field(default_factory=dict)
    error: Problem | None = None


class Desk:
    """The transmissions of one service; they live as long as it runs."""

    def __init__(self, settings: Settings, client: ReceiverClient, tasks: anyio.abc.TaskGroup) -> None:
        self._settings = settings
        self._client = client
        self._tasks = tasks
        self._transmissions: dict[str, TransmissionOut] = {}

    async def reaches_receiver(self) -> bool:
        """Whether the receiver answers."""
        return await self._client.alive()

    def get(self, transmission: str) -> TransmissionOut:
        """The transmission of that id; raises NotFoundError."""
        try:
            return self._transmissions[transmission]
        except KeyError:
            raise NotFoundError("no such transmission; this service forgets them when it stops") from None

    def accept(self, prepared: Prepared, order: Order) -> TransmissionOut:
        """Start to send what was prepared."""
        record = TransmissionOut(
            id=uuid.uuid4().hex,
            state="sending",
            surface=prepared.id,
            cloud_points=prepared.cloud,
            feature_points=len(prepared.features),
            packets=len(prepared.packets),
            bytes=prepared.cost.total,
            protection_bytes=prepared.cost.protection,
            notes=prepared.notes,
            links={"surface": f"{self._settings.receiver.rstrip('/')}/v1/surfaces/{prepared.id}"},
        )
        self._forget()
        self._transmissions[record.id] = record
        self._tasks.start_soon(self._deliver, record.id, prepared, order)
        return record

    def _forget(self) -> None:
        done = [key for key, record in self._transmissions.items() if record.state in ("sent", "failed")]
        for key in done[: max(0, len(self._transmissions) - self._settings.kept + 1)]:
            del self._transmissions[key]

    async def _deliver(self, key: str, prepared: Prepared, order: Order) -> None:
        try:
            sent = await deliver(prepared, order, self._client)
        except SurfacelinkError as error:
            logger.warning("%s: %s", prepared.id, error)
            self._update(key, state="failed", error=problem_of(error))
        except Exception:
            logger.exception("%s: sending failed", prepared.id)
            self._update(key, state="failed", error=problem_of_status(500, "the fault is the sender's"))
        else:
            self._update(
                key,
                state="sent",
                packets=sent.packets,
                bytes=sent.bytes,
                retransmissions=sent.retransmitted,
                receipt=sent.receipt,
            )

    def _update(self, key: str, **changes: Any) -> None:
        self._transmissions[key] = self._transmissions[key].model_copy(update=changes)


def _desk(request: Request) -> Desk:
    desk: Desk = request.app.state.desk
    return desk


def _settings(request: Request) -> Settings:
    settings: Settings = request.app.state.settings
    return settings


router = APIRouter(prefix="/v1")
PROBLEMS: dict[int | str, dict[str, Any]] = {
    status: described(text)
    for status, text in ((404, "No such name"), (413, "Too large"), (415, "Not JSON, not a form"), (422, "Unusable"))
}


@router.get("/surfaces", tags=["surfaces"], summary="What can be sent by name")
def surfaces() -> list[SurfaceOut]:
    return [
        SurfaceOut(
            name=surface.name,
            title=surface.title,
            points=surface.points,
            gap=surface.gap,
            region=asdict(surface.region),
            units=asdict(surface.units),
        )
        for surface in SURFACES.values()
    ]


@router.post(
    "/transmissions",
    tags=["transmissions"],
    status_code=HTTPStatus.ACCEPTED,
    summary="Send a surface, or an uploaded file, to the receiver",
    responses=PROBLEMS,
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                "application/json": {
                    "schema": {"$ref": "#/components/schemas/Order"},
                    "example": {"surface": "surface-1", "rounds": 3},
                },
                "multipart/form-data": {
                    "schema": {
                        "type": "object",
                        "required": ["file"],
                        "properties": {
                            "file": {
                                "type": "string",
                                "format": "binary",
                                "description": "csv, txt, xyz, asc, npy, npz, tif or hgt",
                            },
                            "order": {"type": "string", "description": "The same JSON as the other kind of body."},
                        },
                    }
                },
            },
        }
    },
)
async def send(
    request: Request,
    response: Response,
    desk: Annotated[Desk, Depends(_desk)],
    settings: Annotated[Settings, Depends(_settings)],
) -> TransmissionOut:
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if request.headers.get("content-encoding", "identity").lower() != "identity":
        raise MediaTypeError("a body in a content coding is not accepted")
    upload = None
    if kind == "application/json":
        order = _parse(await _bounded(request, MAX_ORDER_BYTES).body())
    elif kind == "multipart/form-data":
        # Beyond it a form is not read on, declared or not; the file alone is measured below.
        body = _bounded(request, settings.max_upload_bytes + MAX_ORDER_BYTES)
        async with body.form(max_files=1, max_fields=1) as form:
            file, text = form.get("file"), form.get("order")
            if not isinstance(file, UploadFile):
                raise ParameterError("the form has no file in its field 'file'")
            unknown = [name[:40] for name in form if name not in FIELDS]
            if unknown:
                told = (
                    f"no such field; accepted are {' and '.join(FIELDS)}, which holds the members of an order as JSON"
                )
                raise RequestValidationError([{"loc": ("body", name), "msg": told} for name in unknown])
            if (file.size or 0) > settings.max_upload_bytes:
                raise LimitError(f"the file is longer than {settings.max_upload_bytes} bytes")
            order = _parse(text.encode()) if isinstance(text, str) else Order()
            name = file.filename or "upload"
            data = await file.read()
            upload = (name, partial(parse_points, data, name, order.columns, order.no_data, settings.max_points))
    else:
        raise HTTPException(HTTPStatus.UNSUPPORTED_MEDIA_TYPE)
    if order.surface is not None and upload is None:
        count = order.points if order.points is not None else find_surface(order.surface).points
        if count > settings.max_points:
            raise LimitError(f"{count} points were asked for; at most {settings.max_points} are accepted")
    record = desk.accept(await anyio.to_thread.run_sync(prepare, order, upload), order)
    response.headers["Location"] = f"/v1/transmissions/{record.id}"
    return record


@router.get(
    "/transmissions/{transmission}",
    tags=["transmissions"],
    summary="What has become of it",
    responses={404: PROBLEMS[404]},
)
def transmission(transmission: str, desk: Annotated[Desk, Depends(_desk)]) -> TransmissionOut:
    return desk.get(transmission)


def _bounded(request: Request, most: int) -> Request:
    """The request, whose body is a LimitError beyond `most` bytes."""
    return Request(request.scope, limited(request.scope, request.receive, most))


def _parse(text: bytes) -> Order:
    try:
        return Order.model_validate_json(text)
    except ValidationError as error:
        raise RequestValidationError([_in_body(found) for found in error.errors()]) from error


def _in_body(found: Mapping[str, Any]) -> dict[str, Any]:
    """pydantic's complaint with the place in front; of a member that there is not it says which there are."""
    complaint = {**found, "loc": ("body", *found["loc"])}
    if found["type"] == "extra_forbidden":
        *within, name = found["loc"]
        model = PARTS[within[0]] if within else Order
        complaint["msg"] = f"no such member{hint(str(name)[:40], model.model_fields)}"
    return complaint


def _answer(problem: Problem, headers: dict[str, str] | None = None) -> JSONResponse:
    return JSONResponse(
        problem.model_dump(exclude_none=True), status_code=problem.status, media_type=MEDIA_TYPE, headers=headers
    )


async def _on_error(_request: Request, error: Exception) -> Response:
    match error:
        case RequestValidationError():
            return _answer(problem_of_fields(error.errors()))
        case SurfacelinkError():
            return _answer(problem_of(error))
        case HTTPException():
            details = {
                400: f"the form cannot be read: {error.detail}; accepted are one 'file' and one 'order'",
                404: "there is nothing at this path; /docs lists what there is",
                405: "this method is not possible here; see the header Allow",
                415: "send application/json, or multipart/form-data with a file",
            }
            return _answer(
                problem_of_status(error.status_code, details.get(error.status_code)), dict(error.headers or {})
            )
        case ClientDisconnect():  # an upload that is broken off is no fault; no one is there to read an answer
            return Response(status_code=HTTPStatus.BAD_REQUEST)
        case _:
            return _answer(problem_of_status(500, "the fault is the sender's; its log says more"))


async def _known_query(request: Request) -> None:
    """For every route: raises RequestValidationError where a query parameter is none of the route's, or given twice."""
    if request.query_params:
        path = request.scope["route"].path_format
        given = [name for name, _ in request.query_params.multi_items()]
        refused = refused_parameters(request.app.openapi(), path, request.method, given)
        if refused:
            raise RequestValidationError(refused)


class SenderAPI(FastAPI):
    """Describes what FastAPI does not see: the order, since the body is of one of two kinds, and the problems."""

    def openapi(self) -> dict[str, Any]:
        """The description with the schemas of both in it."""
        document = super().openapi()
        for model in (Order, Problem):
            schema = model.model_json_schema(ref_template=SCHEMAS)
            document["components"]["schemas"] |= schema.pop("$defs", {}) | {model.__name__: schema}
        return document


Connect: TypeAlias = Callable[[str], ReceiverClient]


def create_app(settings: Settings | None = None, connect: Connect = ReceiverClient.connect) -> FastAPI:
    """The service.

    Parameters
    ----------
    settings : Settings, optional
        By default from the environment.
    connect : callable
        Makes the client for the receiver's URL; a test gives one that needs no socket.
    """
    settings = settings or Settings()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        async with connect(settings.receiver) as client, anyio.create_task_group() as tasks:
            app.state.desk = Desk(settings, client, tasks)
            yield
            tasks.cancel_scope.cancel()

    app = SenderAPI(
        title="surfacelink sender",
        description="Keeps the feature points of a surface and sends them to the receiver.",
        version=product_version(),
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        dependencies=[Depends(_known_query)],
        responses={422: PROBLEMS[422]},
    )
    app.state.settings = settings
    for kind in (SurfacelinkError, RequestValidationError, HTTPException, ClientDisconnect, Exception):
        app.add_exception_handler(kind, _on_error)
    app.include_router(router)
    app.add_middleware(Head)

    @app.get("/health/live", tags=["health"], summary="The process runs")
    def live() -> dict[str, str]:
        return {"status": "live"}

    @app.get("/health/ready", tags=["health"], summary="The receiver answers", response_model=None)
    async def ready(desk: Annotated[Desk, Depends(_desk)]) -> Response:
        reached = await desk.reaches_receiver()
        status = HTTPStatus.OK if reached else HTTPStatus.SERVICE_UNAVAILABLE
        return JSONResponse({"status": "ready" if reached else "the receiver does not answer"}, status)

    page = api_page()

    @app.get("/docs", include_in_schema=False)
    def docs() -> HTMLResponse:
        return HTMLResponse(page.text, headers=page.headers)

    @app.get("/", include_in_schema=False)
    def root() -> RedirectResponse:
        return RedirectResponse("/docs")

    return app
