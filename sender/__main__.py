"""``sender serve``, ``sender send``, ``sender surfaces``."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import anyio
import httpx
import typer
import uvicorn
from pydantic import ValidationError
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from common.channel import Channel
from common.command import about, command_line, run, settings_from
from common.errors import ParameterError
from common.listening import listen, url_of
from common.problems import problem_of_fields
from common.surface import Unit
from common.wire import WireOptions
from sender.app import create_app
from sender.client import ReceiverClient, Sent
from sender.features import Extracted, Repeated
from sender.options import Columns, NoDataHeight, labels_of
from sender.readers import read_points
from sender.settings import Settings
from sender.surfaces import SURFACES, names_file
from sender.transmission import Order, Prepared, deliver, prepare
from sender.transport import ChannelTransport

app = command_line("sender", "Keep the feature points of a surface and send them to a receiver.")
console = Console()
DEFAULTS = Settings.model_construct()

WORTH_TELLING = 2.0
"""Seconds from which on it is said how long there is to wait for the channel."""

STEPS = 200
"""Parts that the wait for a channel is drawn in."""


@app.command()
def serve(
    host: Annotated[str | None, typer.Option(help=about(Settings, "host"))] = None,
    port: Annotated[int | None, typer.Option(help=about(Settings, "port"))] = None,
    receiver: Annotated[str | None, typer.Option(help=about(Settings, "receiver"))] = None,
) -> None:
    """Run the service until it is stopped. What is not given here is read from SENDER_... in the environment."""
    settings = settings_from(Settings, {"host": host, "port": port, "receiver": receiver})
    ReceiverClient.connect(settings.receiver)
    with listen(settings.host, settings.port) as listener:
        console.print(f"sender    {url_of(listener)}", highlight=False, soft_wrap=True)
        console.print(f"receiver  {settings.receiver}", highlight=False, soft_wrap=True)
        uvicorn.Server(uvicorn.Config(create_app(settings), log_level="warning")).run(sockets=[listener])


@app.command()
def surfaces() -> None:
    """List the surfaces that can be sent by name."""
    table = Table("name", "surface", "points", "segment gap", box=None, pad_edge=False)
    for surface in SURFACES.values():
        table.add_row(surface.name, surface.title, str(surface.points), f"{surface.gap:g} {surface.units.xy}".strip())
    console.print(table)


@app.command()
def send(
    what: Annotated[
        str,
        typer.Argument(
            metavar="NAME|FILE", help="A surface by name (`sender surfaces` lists them), or a file: points or a grid."
        ),
    ],
    receiver: Annotated[str, typer.Option(help="URL of the receiver.")] = DEFAULTS.receiver,
    name: Annotated[str | None, typer.Option("--id", help="Id at the receiver; by default the name.")] = None,
    gap: Annotated[
        float | None, typer.Option(help="Segment gap, in the units of x and y; by default the surface's own.")
    ] = None,
    points: Annotated[int | None, typer.Option(help="Points of the cloud; by default the surface's own.")] = None,
    kind: Annotated[
        Extracted,
        typer.Option(
            help="Points to send: least and greatest z of each piece, a lattice of one point a piece, or all."
        ),
    ] = "extrema",
    seed: Annotated[int, typer.Option(help="Seed the cloud is drawn from.")] = 0,
    columns: Columns = None,
    no_data: NoDataHeight = None,
    repeated: Annotated[
        Repeated,
        typer.Option(help="What a position with several heights is: refused (error), or their mean, min or max."),
    ] = "error",
    xy_unit: Annotated[Unit, typer.Option(help="Unit of x and y in a file; none by default.")] = "",
    z_unit: Annotated[Unit, typer.Option(help="Unit of z in a file; none by default.")] = "",
    rounds: Annotated[
        int, typer.Option(help="How often to send, the first time included; later only what the receiver misses.")
    ] = 1,
    datagram: Annotated[int, typer.Option(help="Longest packet, in bytes.")] = WireOptions().datagram,
    precision: Annotated[str, typer.Option(help="float64, float32, or how many bits a coordinate has.")] = str(
        WireOptions().precision
    ),
    coding: Annotated[
        Literal["plain", "compact"], typer.Option(help="How points are packed; compact takes fewer bytes.")
    ] = WireOptions().coding,
    parity: Annotated[
        float, typer.Option(help="Packets that rebuild lost ones, as a share of those with points, for example 0.3.")
    ] = 0.0,
    copies: Annotated[int, typer.Option(help="How often each packet is sent.")] = 1,
    inner: Annotated[int, typer.Option(help="Bytes of Reed-Solomon parity in each 255 of a packet; 0 for none.")] = 0,
    channel: Annotated[
        str,
        typer.Option(
            metavar="SPEC",
            help='Channel that harms the packets on their way, such as "gaussian:std=0.1,axes=xyz;erasure:p=0.05". One '
            "of a rate or a delay takes its time in earnest: how long is said before it starts.",
        ),
    ] = "",
    channel_seed: Annotated[int | None, typer.Option(help="Seed of the channel. (that of the channel, else 0)")] = None,
    virtual_time: Annotated[
        bool, typer.Option("--virtual-time", help="Say how long the channel takes, and do not wait for it.")
    ] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Wait until the receiver has trained its network.")] = False,
) -> None:
    """Send a surface, or a file of points, to a receiver."""
    harm = Channel.given(channel, channel_seed)
    wire = {
        "datagram": datagram,
        "precision": int(precision) if precision.isdecimal() else precision,
        "coding": coding,
        "parity": parity,
        "copies": copies,
        "inner": inner,
    }
    path = Path(what)
    is_file = names_file(what)
    order = _order(
        surface=None if is_file else what,
        id=name,
        points=points,
        seed=seed,
        gap=gap,
        kind=kind,
        repeated=repeated,
        columns=labels_of(columns),
        no_data=no_data,
        xy_unit=xy_unit,
        z_unit=z_unit,
        rounds=rounds,
        wire=wire,
    )
    upload = (path.name, partial(read_points, path, order.columns, order.no_data)) if is_file else None
    prepared = prepare(order, upload)
    for note in prepared.notes:
        Console(stderr=True).print(f"note: {note}", highlight=False, markup=False, soft_wrap=True)
    console.print(
        f"{prepared.id}: {prepared.cloud} points -> {len(prepared.features)} feature points -> "
        f"{len(prepared.packets)} packets, {prepared.cost.total} bytes"
        + (f", {prepared.cost.protection} of them for protection" if prepared.cost.protection else "")
    )
    sleep = _say_seconds if virtual_time else _wait_for_channel
    transport = ChannelTransport(httpx.AsyncHTTPTransport(), harm, sleep=sleep) if harm else None
    sent, trained = anyio.run(_send, prepared, order, receiver, transport, wait)
    counts = sent.receipt.packets
    # A receiver that nothing reached does not know how much there was.
    total = len(prepared.packets) if counts.total is None else counts.total
    missing = total - counts.received if counts.absent is None else counts.absent
    console.print(
        f"receiver: {counts.received} of {total} packets, {counts.damaged} damaged, {counts.duplicate} duplicate, "
        f"{counts.rebuilt} rebuilt, {missing} missing, {sent.retransmitted} sent again; "
        f"holds {sent.receipt.points} points",
        soft_wrap=True,
    )
    address = f"{receiver.rstrip('/')}/v1/surfaces/{prepared.id}"
    delivery = sent.receipt.delivery
    if delivery is not None and delivery.duplicate and not delivery.new:
        console.print(
            "nothing new: every packet had arrived before; of its copies an unaltered one is kept, else the first. "
            f"To send anew take another --id, or remove what is there: curl -X DELETE {address}",
            highlight=False,
            soft_wrap=True,
        )
    for line in _told(trained):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    console.print(f"curl {address}", highlight=False, soft_wrap=True)


def _told(surface: Mapping[str, Any]) -> list[str]:
    """What is worth a word of a surface that was trained: points set aside, notes of the network."""
    network = surface.get("network") or {}
    aside = len(network.get("outliers", ()))
    lines = [f"network: {aside} of {surface.get('points')} points set aside as outliers"] if aside else []
    return lines + [f"network: {note}" for note in network.get("notes", ())]


async def _say_seconds(seconds: float) -> None:
    """Say how long the channel takes, where it takes time."""
    if seconds > 0:
        console.print(f"the channel takes about {duration(seconds)}", highlight=False, soft_wrap=True)


async def _wait_for_channel(seconds: float) -> None:
    """Wait for the channel; where that is long, with a word before and a bar meanwhile."""
    if seconds < WORTH_TELLING:
        await anyio.sleep(seconds)
        return
    await _say_seconds(seconds)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        for _ in bar.track(range(STEPS), description="on the air"):
            await anyio.sleep(seconds / STEPS)


def duration(seconds: float) -> str:
    """Seconds as people say them, to the second; fewer than two to two digits.

    >>> duration(0.2791), duration(4.6), duration(1326.4), duration(7380)
    ('0.28 s', '5 s', '22 min 6 s', '2 h 3 min 0 s')
    """
    if seconds < WORTH_TELLING:
        return f"{seconds:.2g} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return (f"{hours} h " if hours else "") + (f"{minutes} min " if hours or minutes else "") + f"{rest} s"


async def _send(
    prepared: Prepared, order: Order, receiver: str, transport: ChannelTransport | None, wait: bool
) -> tuple[Sent, Mapping[str, Any]]:
    async with ReceiverClient.connect(receiver, transport) as client:
        sent = await deliver(prepared, order, client)
        return sent, await client.wait_ready(prepared.id) if wait else {}


def _order(**fields: Any) -> Order:
    try:
        return Order(**fields)
    except ValidationError as error:
        found = [
            {**each, "loc": ("command", *map(_option, (part for part in each["loc"] if part != "wire")))}
            for each in error.errors()
        ]
        raise ParameterError(problem_of_fields(found).detail) from error


def _option(part: int | str) -> int | str:
    """A part of a field's place, an option's name as it is typed."""
    typed = part in Order.model_fields or part in WireOptions.model_fields
    return f"--{str(part).replace('_', '-')}" if typed else part


def main() -> None:
    """The command line."""
    run(app)


if __name__ == "__main__":
    main()
