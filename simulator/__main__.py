"""``simulate demo``, ``simulate channel``, ..."""

from __future__ import annotations

import signal
import tempfile
from pathlib import Path
from typing import Annotated

import anyio
import typer
import uvicorn
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from common.channel import Channel
from common.command import command_line, run
from common.listening import listen, url_of
from sender.surfaces import find_surface
from simulator.demo import DEMO_SURFACES, Exhibit, run_demo, steps
from simulator.folder import make_folder
from simulator.paper import paper_command
from simulator.pictures import write_pictures
from simulator.proxy import create_proxy
from simulator.rivals import rivals_command
from simulator.services import Services, running
from simulator.sweep import HELP as SWEEP_HELP
from simulator.sweep import sweep_command

app = command_line("simulate", "Experiments over the link: sender, noisy channel, receiver.")
console = Console()
CHANNELS = ("clean", "noisy")


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("surfacelink-demo"),
    surface: Annotated[
        list[str] | None,
        typer.Option(help=f"Send only this one (by default {', '.join(DEMO_SURFACES)}); may be repeated."),
    ] = None,
    serve: Annotated[bool, typer.Option("--serve", help="Leave both services running and print curl lines.")] = False,
) -> None:
    """Send four surfaces over real HTTP, clean and noisy; print a table, draw a picture of each."""
    # Either signal ends the demo with both services stopped, even where a shell has it ignored.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    names = tuple(surface or DEMO_SURFACES)
    for name in names:
        find_surface(name)
    make_folder(out)
    with tempfile.TemporaryDirectory(prefix="data-", dir=out) as data, running(Path(data)) as services:
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
        )
        with Progress(*columns, console=console, transient=True) as bar:
            task = bar.add_task("starting", total=steps(names) + 1)

            def progress(stage: str) -> None:
                bar.update(task, description=stage)
                bar.advance(task)

            exhibits = anyio.run(lambda: run_demo(services, names, progress=progress))
            bar.update(task, description="drawing")
            pictures = write_pictures(exhibits, out)
            bar.advance(task)
        console.print(demo_table(exhibits))
        console.print("NRMSE: root mean square error over the range of z. Noisy: the paper's noise, on x, y and z.")
        console.print("Linear and cubic interpolate the same feature points.")
        for picture in pictures:
            console.print(f"picture: {picture}", highlight=False, soft_wrap=True)
        if serve:
            _leave_running(services, exhibits)


def demo_table(exhibits: list[Exhibit]) -> Table:
    """The figures of the demo, a column a surface; the least error of each channel in bold."""
    rows = [exhibit.row() for exhibit in exhibits]
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for name in rows[0]:
        if name == "surface":
            table.add_column(name, no_wrap=True)
            for row in rows:
                table.add_column(str(row[name]), justify="right", no_wrap=True)
            continue
        channel, _, method = name.partition(" ")
        label = f"NRMSE, {channel} channel: {method}" if channel in CHANNELS else name
        cells = []
        for row in rows:
            rivals = [row[other] for other in row if other.startswith(f"{channel} ")]
            won = channel in CHANNELS and row[name] == min(rivals)
            cells.append(Text(_cell(name, row[name]), "bold green" if won else ""))
        table.add_row(label, *cells, end_section=name in ("dense bytes", "clean cubic", "noisy cubic"))
    return table


def _cell(name: str, value: str | float) -> str:
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.1f}" if name == "seconds" else f"{value:.4f}"
    return value


def _leave_running(services: Services, exhibits: list[Exhibit]) -> None:
    receiver, sender, surface = services.receiver, services.sender, exhibits[0].noisy.id
    as_json = "-H 'Content-Type: application/json'"
    lines = (
        f"receiver {receiver}  (open it in a browser)",
        f"sender   {sender}",
        f"curl {receiver}/v1/surfaces",
        f"curl '{receiver}/v1/surfaces/{surface}/grid?shape=5,5&f=csv'",
        f"curl -o {surface}.png '{receiver}/v1/surfaces/{surface}/grid?f=png'",
        f'curl -X PUT {receiver}/v1/channel {as_json} -d \'{{"spec": "erasure:p=0.3"}}\'',
        f'curl {sender}/v1/transmissions {as_json} -d \'{{"surface": "peaks", "rounds": 3}}\'',
        f"curl {receiver}/v1/surfaces/peaks",
        "Ctrl-C stops both.",
    )
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True)
    try:
        anyio.run(anyio.sleep_forever)
    except KeyboardInterrupt:
        console.print("stopped")


app.command("paper")(paper_command)
app.command("sweep", help=SWEEP_HELP)(sweep_command)
app.command("rivals")(rivals_command)


@app.command()
def channel(
    spec: Annotated[
        str, typer.Argument(metavar="SPEC", help='The channel, for example "gaussian:std=0.1,axes=xyz;erasure:p=0.05".')
    ],
    upstream: Annotated[str, typer.Option(help="URL of the server behind the channel.")] = "http://127.0.0.1:8001",
    port: Annotated[int, typer.Option(help="Port to listen on; 0 takes a free one.")] = 8002,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the channel's random draws. (that of the channel, else 0)")
    ] = None,
) -> None:
    """Put a channel between any client and any receiver; GET and PUT /v1/channel steer it."""
    proxy = create_proxy(upstream, Channel.given(spec, seed))
    with listen("127.0.0.1", port) as listener:
        console.print(f"channel   {url_of(listener)}", highlight=False, soft_wrap=True)
        console.print(f"upstream  {upstream}", highlight=False, soft_wrap=True)
        uvicorn.Server(uvicorn.Config(proxy, log_level="info")).run(sockets=[listener])


def main() -> None:
    """The command line."""
    run(app)


if __name__ == "__main__":
    main()
