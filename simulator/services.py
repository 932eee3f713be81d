"""Receiver and sender as real processes on this machine, for as long as they are needed."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx

from common.errors import LinkError

START_TIMEOUT = 60.0
"""Seconds a service may take until it answers: importing scipy from a cold disk takes several."""

STOP_TIMEOUT = 10.0
"""Seconds a service may take to finish its requests before it is killed."""


@dataclass(frozen=True)
class Services:
    """Where the two services listen."""

    receiver: str
    sender: str


def free_port() -> int:
    """A TCP port of the loopback interface that nothing listens on at the moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def running(folder: Path) -> Iterator[Services]:
    """Start a receiver and a sender on free ports; stop both at the end, whatever happens.

    Parameters
    ----------
    folder : Path
        The receiver keeps its data and both keep their logs there.

    Raises
    ------
    LinkError
        If one does not start; the message carries the end of its log.
    """
    folder.mkdir(parents=True, exist_ok=True)
    receiver, sender = free_port(), free_port()
    services = Services(f"http://127.0.0.1:{receiver}", f"http://127.0.0.1:{sender}")
    with contextlib.ExitStack() as stack:
        for name, url, arguments in (
            ("receiver", services.receiver, ["--port", str(receiver), "--data", str(folder / "receiver")]),
            ("sender", services.sender, ["--port", str(sender), "--receiver", services.receiver]),
        ):
            log = folder / f"{name}.log"
            process = stack.enter_context(_process(name, arguments, log))
            _wait_until_ready(name, process, url, log)
        yield services


@contextlib.contextmanager
def _process(name: str, arguments: list[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    environment = os.environ | {"RECEIVER_CHANNEL_CONTROL": "true"}
    with log.open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", name, "serve", *arguments], stdout=output, stderr=output, env=environment
        )
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(STOP_TIMEOUT)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _wait_until_ready(name: str, process: subprocess.Popen[bytes], url: str, log: Path) -> None:
    end = time.monotonic() + START_TIMEOUT
    while time.monotonic() < end and process.poll() is None:
        with contextlib.suppress(httpx.TransportError):
            if httpx.get(f"{url}/health/ready", timeout=5.0, trust_env=False).is_success:
                return
        time.sleep(0.1)
    last = log.read_text(errors="replace").strip().splitlines()[-3:]
    raise LinkError(f"the {name} did not start at {url}: {' / '.join(last) or 'it said nothing'}")
