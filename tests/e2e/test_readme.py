"""The README tells the truth: its tour is run line by line, its example and its settings are checked."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import receiver.settings
import sender.settings
from simulator import services

pytestmark = pytest.mark.e2e

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
TOUR = re.findall(r"<!-- tour -->\n```console\n(.*?)```", README, re.DOTALL)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[services.Services]:
    with services.running(tmp_path / "services") as both:
        yield both


@pytest.mark.skipif(shutil.which("curl") is None, reason="curl is not installed")
def test_the_tour_prints_what_the_readme_says(running: services.Services, tmp_path: Path) -> None:
    assert len(TOUR) == 2
    for step in re.split(r"^\$ ", "".join(TOUR), flags=re.MULTILINE)[1:]:
        line, _, expected = step.partition("\n")
        command = shlex.split(line.replace("http://127.0.0.1:8001", running.receiver))
        if command[0] == "sender":
            command = [sys.executable, "-m", *command, "--receiver", running.receiver]
        done = subprocess.run(
            command,
            cwd=tmp_path,
            env={"COLUMNS": "200", "PYTHONPATH": str(ROOT), "PATH": "/usr/local/bin:/usr/bin:/bin"},
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        said = expected.replace("http://127.0.0.1:8001", running.receiver).strip()
        pattern = re.escape(said).replace(r"\.\.\.", ".*")
        assert re.fullmatch(pattern, done.stdout.replace("\r", "").strip(), re.DOTALL), f"{line}\n{done.stdout}"
    assert (tmp_path / "surface-1.png").read_bytes().startswith(b"\x89PNG")


def test_the_python_example_runs() -> None:
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    scope: dict[str, object] = {}
    exec(compile(example, "README.md", "exec"), scope)
    assert getattr(scope["z"], "shape", None) == (101, 101)


@pytest.mark.parametrize(
    ("prefix", "settings"), [("RECEIVER_", receiver.settings.Settings), ("SENDER_", sender.settings.Settings)]
)
def test_every_setting_is_in_the_table_with_its_default(
    prefix: str, settings: type[receiver.settings.Settings]
) -> None:
    for name, field in settings.model_fields.items():
        default = str(field.default).lower() if isinstance(field.default, bool) else str(field.default)
        assert f"| `{prefix}{name.upper()}` | `{default}` | {field.description} |" in README
