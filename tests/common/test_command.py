"""What the command lines have in common."""

from __future__ import annotations

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
