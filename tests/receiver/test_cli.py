from __future__ import annotations

import socket
from pathlib import Path

import pytest
from typer.testing import CliRunner

from receiver.__main__ import app


def run(*arguments: str, env: dict[str, str] | None = None) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["serve", *arguments], env=env)
    assert result.exception is None or isinstance(result.exception, SystemExit)
    return result.exit_code, result.output


def assert_one_line(outcome: tuple[int, str], *words: str) -> None:
    status, output = outcome
    assert status == 1
    lines = output.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    for word in words:
        assert word in lines[0]


def test_a_port_in_use(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert_one_line(run("--port", str(port), "--data", str(tmp_path)), f"127.0.0.1 port {port}", "--port")


def test_an_unusable_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    assert_one_line(run("--data", str(tmp_path / "file" / "below")), "file/below", "cannot be made")


def test_a_bad_channel(tmp_path: Path) -> None:
    assert_one_line(run("--channel", "thunder:p=1", "--data", str(tmp_path)), "thunder", "gaussian")


@pytest.mark.parametrize(
    ("arguments", "word"), [(("--port", "70000"), "port"), (("--seed", "-1"), "seed"), (("--host", ""), "host")]
)
def test_settings_out_of_bounds(tmp_path: Path, arguments: tuple[str, str], word: str) -> None:
    assert_one_line(run(*arguments, "--data", str(tmp_path)), word)


def test_settings_come_from_the_environment_too(tmp_path: Path) -> None:
    env = {"RECEIVER_CHANNEL": "thunder", "RECEIVER_DATA": str(tmp_path)}
    assert_one_line(run(env=env), "thunder")
    assert_one_line(run(env={"RECEIVER_TRAININGS": "0", "RECEIVER_DATA": str(tmp_path)}), "trainings")


def test_an_address_of_another_machine(tmp_path: Path) -> None:
    assert_one_line(run("--host", "192.0.2.1", "--data", str(tmp_path)), "192.0.2.1")
