"""The benchmarks say what they do before they do it."""

from __future__ import annotations

import importlib
import sys

import pytest

pytest.importorskip("reedsolo")


@pytest.mark.parametrize("name", ["channel", "wire"])
def test_help_is_help(name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(f"benchmarks.{name}").main()
    assert ended.value.code == 0
    assert f"usage: python -m benchmarks.{name}" in capsys.readouterr().out
