from __future__ import annotations

import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import pytest

from receiver.__main__ import main
from receiver.app import create_app
from receiver.settings import Settings

Run: TypeAlias = Callable[..., tuple[int, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs ``receiver serve`` with some arguments; its exit status, and what it said."""

    def serve(*arguments: str, **env: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["receiver", "serve", *arguments])
        for name, value in env.items():
            monkeypatch.setenv(name, value)
        with pytest.raises(SystemExit) as stop:
            main()
        return int(stop.value.code or 0), "".join(capsys.readouterr())

    return serve


def assert_one_line(outcome: tuple[int, str], *words: str) -> None:
    status, output = outcome
    assert status == 1
    lines = output.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    for word in words:
        assert word in lines[0]


def test_a_port_in_use(run: Run, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert_one_line(run("--port", str(port), "--data", str(tmp_path)), f"127.0.0.1 port {port}", "--port")


def test_an_unusable_folder(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    assert_one_line(run("--data", str(tmp_path / "file" / "below")), "file/below", "cannot be made")


def test_a_bad_channel(run: Run, tmp_path: Path) -> None:
    assert_one_line(run("--channel", "thunder:p=1", "--data", str(tmp_path)), "thunder", "gaussian")


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--port", "70000"), "--port: "),
        (("--seed", "-1"), "--seed: "),
        (("--host", ""), "--host: "),
        (("--max-body-bytes", "1"), "--max-body-bytes: "),
    ],
)
def test_settings_out_of_bounds(run: Run, tmp_path: Path, arguments: tuple[str, str], word: str) -> None:
    assert_one_line(run(*arguments, "--data", str(tmp_path)), word)


def test_settings_come_from_the_environment_too(run: Run, tmp_path: Path) -> None:
    assert_one_line(run(RECEIVER_CHANNEL="thunder", RECEIVER_DATA=str(tmp_path)), "thunder")
    assert_one_line(run(RECEIVER_TRAININGS="0", RECEIVER_DATA=str(tmp_path)), "error: RECEIVER_TRAININGS: ")


def test_a_seed_beside_another_one(run: Run, tmp_path: Path) -> None:
    assert create_app(Settings(channel="erasure:p=0.1;seed=5")).state.channel.seed == 5
    assert create_app(Settings(channel="erasure:p=0.1", seed=5)).state.channel.seed == 5
    outcome = run("--channel", "erasure:p=0.1;seed=5", "--data", str(tmp_path), RECEIVER_SEED="0")
    assert_one_line(outcome, "two seeds, 0 and 5; give one")


def test_what_is_wrong_is_named_as_it_was_given(run: Run, tmp_path: Path) -> None:
    outcome = run("--port", "70000", "--data", str(tmp_path), RECEIVER_MAX_WAIT_SECONDS="abc", RECEIVER_PORT="8001")
    assert_one_line(outcome, "--port: ", "RECEIVER_MAX_WAIT_SECONDS: ")
    assert "RECEIVER_PORT" not in outcome[1]


def test_an_address_of_another_machine(run: Run, tmp_path: Path) -> None:
    assert_one_line(run("--host", "192.0.2.1", "--data", str(tmp_path)), "192.0.2.1")
