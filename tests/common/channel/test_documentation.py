"""docs/channel.md says what the code does."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

from common.channel import IMPAIRMENTS, PROFILES, Channel, Impairment

PAGE = Path(__file__).parents[3] / "docs" / "channel.md"


@pytest.fixture(scope="module")
def page() -> str:
    return PAGE.read_text(encoding="utf-8")


@pytest.mark.parametrize("model", IMPAIRMENTS)
def test_every_impairment_has_its_line_with_every_parameter(model: type[Impairment], page: str) -> None:
    (line,) = [line for line in page.splitlines() if line.startswith(f"| `{model.model_fields['kind'].default}` |")]
    shared = {"kind", "probability", "axes", "relative", "snr_db"}
    for name in set(model.model_fields) - shared:
        assert f"`{name}`" in line, name
        default = model.model_fields[name].default
        if isinstance(default, (int, float)):
            assert f"`{name}` ({default:g})" in line


def test_every_profile_has_its_line(page: str) -> None:
    for name, profile in PROFILES.items():
        assert f"| `{name}` | `{profile.channel}` | {profile.summary} | {profile.source} |" in page


def test_the_code_on_the_page_runs(
    page: str, few_packets: list[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = ModuleType("page")
    monkeypatch.setitem(sys.modules, "page", module)
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(block, module.__dict__)
    module.__dict__["test_a_surface_survives_a_poor_link"](tmp_path)
    stuck = module.__dict__["StuckByte"](p=1, value=255)
    delivery = Channel([stuck], seed=1).transmit(few_packets, transmission="hills")
    changed = [
        sum(a != b for a, b in zip(sent, came, strict=True))
        for sent, came in zip(few_packets, delivery.packets, strict=True)
    ]
    assert set(changed) <= {0, 1}
    assert sum(changed) > 0.9 * len(few_packets)


def test_the_json_on_the_page_is_the_short_string_on_the_page(page: str) -> None:
    (document,) = re.findall(r"```json\n(.*?)```", page, re.DOTALL)
    (text,) = re.findall(r"^    (gaussian\S+)$", page, re.MULTILINE)
    assert Channel.from_json(json.loads(document)) == Channel.parse(text)
