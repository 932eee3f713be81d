"""The command `receiver`."""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
import uvicorn
from fastapi import FastAPI
from rich.console import Console
from rich.markup import escape

from common.command import about, command_line, run, settings_from
from common.listening import listen, url_of
from receiver.app import create_app
from receiver.settings import Settings
from receiver.store import Store
from receiver.surfaces import Surfaces

app = command_line("receiver", "Take a surface's packets in and grow the surface back.")

GRACE_SECONDS = 5
"""How long a stop waits for answers that are under way."""


class Server(uvicorn.Server):
    """A server that says when it is up, and ends event streams when it is told to stop instead of waiting for
    their readers to leave."""

    def __init__(self, config: uvicorn.Config, application: FastAPI, announce: Callable[[], None]) -> None:
        super().__init__(config)
        self._application = application
        self._announce = announce

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started:
            try:
                self._announce()
            except BaseException:  # no one is there to read it: the application is to stop in order all the same
                await self.shutdown(sockets)
                raise

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        surfaces: Surfaces | None = self._application.state.surfaces
        if surfaces is not None:
            surfaces.changes.close()
        await super().shutdown(sockets)


@app.command()
def serve(
    host: Annotated[str | None, typer.Option(help=about(Settings, "host"))] = None,
    port: Annotated[int | None, typer.Option(help=about(Settings, "port"))] = None,
    data: Annotated[Path | None, typer.Option(help=about(Settings, "data"), metavar="DIR")] = None,
    channel: Annotated[str | None, typer.Option(help=about(Settings, "channel"), metavar="SPEC")] = None,
    seed: Annotated[int | None, typer.Option(help=about(Settings, "seed"))] = None,
    channel_control: Annotated[
        bool | None, typer.Option("--channel-control/--no-channel-control", help=about(Settings, "channel_control"))
    ] = None,
    trainings: Annotated[int | None, typer.Option(help=about(Settings, "trainings"))] = None,
    max_body_bytes: Annotated[int | None, typer.Option(help=about(Settings, "max_body_bytes"))] = None,
    access_log: Annotated[bool, typer.Option(help="Whether each request is logged.")] = False,
) -> None:
    """Run the service until it is stopped. What is not given here is read from RECEIVER_... in the environment."""
    given: dict[str, Any] = {
        "host": host,
        "port": port,
        "data": data,
        "channel": channel,
        "seed": seed,
        "channel_control": channel_control,
        "trainings": trainings,
        "max_body_bytes": max_body_bytes,
    }
    settings = settings_from(Settings, given)
    application = create_app(settings)
    Store(settings.data).close()  # says what is wrong with the folder before anything listens
    listener = listen(settings.host, settings.port)
    logging.captureWarnings(True)

    def announce() -> None:
        out = Console(soft_wrap=True, highlight=False)
        out.print(f"receiver  {url_of(listener)}")
        out.print(f"data      {escape(str(settings.data.resolve()))}")
        out.print(f"channel   {escape(str(application.state.channel))}")

    config = uvicorn.Config(
        application,
        log_level="info" if access_log else "warning",
        access_log=access_log,
        timeout_graceful_shutdown=GRACE_SECONDS,
        lifespan="on",
    )
    with listener:
        Server(config, application, announce).run(sockets=[listener])


def main() -> None:
    """The command line."""
    run(app)


if __name__ == "__main__":
    main()
