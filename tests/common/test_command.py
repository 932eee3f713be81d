"""What the command lines have in common."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer import Typer
from typer.testing import CliRunner

import receiver.__main__
import sender.__main__
import simulator.__main__
from common.version import product_version


@pytest.mark.parametrize("app", [sender.__main__.app, receiver.__main__.app, simulator.__main__.app])
def test_every_command_line_tells_its_version(app: Typer) -> None:
    said = CliRunner().invoke(app, ["--version"])
    assert (said.exit_code, said.output) == (0, f"{product_version()}\n")


COMMANDS = [("sender", "surfaces"), ("simulator", "--version"), ("receiver", "serve", "--port", "0")]


def outcome(command: tuple[str, ...], stdout: int, folder: Path) -> tuple[int, str]:
    """Exit status and stderr of a command that writes to a file descriptor."""
    module, *arguments = command
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments],
        env={**os.environ, "RECEIVER_DATA": str(folder)},
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        timeout=60,
    )
    return done.returncode, done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the device is Linux's")
@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_output_on_a_full_disk_is_one_line(command: tuple[str, ...], tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:  # noqa: PTH123 - a device
        assert outcome(command, full.fileno(), tmp_path) == (
            1,
            "error: the output cannot be written: No space left on device\n",
        )


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_closed_pipe_ends_a_command_without_a_word(command: tuple[str, ...], tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    try:
        assert outcome(command, writer, tmp_path) == (1, "")
    finally:
        os.close(writer)
