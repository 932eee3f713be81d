"""The paper's figures at a reduced size: every panel, every reading, every claim with its numbers."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from common.errors import ParameterError
from common.surface import FloatArray
from sender.surfaces import AnalyticSurface, find_surface
from simulator import paper
from simulator.statistics import Quartiles
from tests.simulator.test_report import outside

SHOWN = ("surface-1", "surface-1-printed")
LETTERS = ["a", "b", "c", "d", "e", "f", "f*", "g", "h", "i", "i*", "j"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> paper.Regenerated:
    return paper.regenerate(tmp_path_factory.mktemp("paper"), seeds=2, workers=1, grid=(16, 16), dpi=30, readings=SHOWN)


def test_every_panel_is_a_picture_and_on_the_page(made: paper.Regenerated) -> None:
    names = {path.name for path in made.pictures}
    for stem in ("figure-2", "figure-2-surface-1-printed"):
        assert {f"{stem}.png", *(f"{stem}-{letter.replace('*', '-printed')}.png" for letter in LETTERS)} <= names
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in made.pictures)
    html = made.page.read_text()
    assert html.count("<canvas") == 2 * len(LETTERS)


def test_the_page_loads_nothing_and_its_data_is_json(made: paper.Regenerated) -> None:
    html = made.page.read_text()
    assert outside(html) == []
    scripts = re.findall(r'<script type="application/json" id="[^"]*">(.*?)</script>', html)
    assert len(scripts) == 2 * len(LETTERS)
    for script in scripts:
        data = json.loads(script)
        assert len(data["range"]) == 6
        assert bool(data["surface"]) != bool(data.get("points"))


def test_every_claim_has_a_verdict_with_each_setting(made: paper.Regenerated) -> None:
    html = made.page.read_text()
    for claim in paper.CLAIMS:
        assert claim.test in html
        for method in claim.settings:
            findings = claim.findings(made.errors, method)
            assert [f.surface for f in findings] == list(SHOWN)
            assert paper.verdict(findings)[0] in html


def test_the_feature_counts_are_the_papers() -> None:
    for name, count in (("surface-1", 25), ("surface-2", 16), ("surface-3", 16)):
        by_letter = {panel.letter: panel for panel in paper.panels(find_surface(name), shape=(8, 8))}
        assert len(by_letter["d"].data) == len(by_letter["e"].data) == count
        assert len(by_letter["g"].data) == 2 * count
        assert np.all(by_letter["d"].data[:, 2] <= by_letter["e"].data[:, 2])


class OnNodes(AnalyticSurface):
    """Sampled at the nodes of a grid, those on the edges of the region among them."""

    def sample(self, rng: np.random.Generator, n: int | None = None) -> FloatArray:
        return self.grid((17, 17)).points()


def test_points_on_the_far_edges_belong_to_the_last_pieces() -> None:
    surface = find_surface("surface-2")
    assert isinstance(surface, AnalyticSurface)
    drawn = paper.panels(OnNodes(**vars(surface)), shape=(8, 8))
    assert [len(panel.data) for panel in drawn if panel.letter in "de"] == [16, 16]


def test_a_folder_that_cannot_be_made_is_our_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ParameterError, match="cannot write to"):
        paper.regenerate(tmp_path / "file" / "out", seeds=1, workers=1)


def finding(surface: str, holds: bool) -> paper.Finding:
    return paper.Finding(surface, "", holds)


@pytest.mark.parametrize(
    ("held", "words", "holds"),
    [
        ((True, True, True), "confirmed", True),
        ((False, False, False), "contradicted", False),
        ((True, False, False), "confirmed on surface-1 only", None),
    ],
)
def test_a_verdict_is_over_the_three_surfaces(held: tuple[bool, ...], words: str, holds: bool | None) -> None:
    findings = [finding(f"surface-{k + 1}", ok) for k, ok in enumerate(held)]
    assert paper.verdict([*findings, finding("surface-1-printed", not held[0])]) == (words, holds)


def test_claims_can_fail() -> None:
    def errors(network: float, cubic: float) -> dict[paper.Key, paper.Errors]:
        def cell(value: float) -> paper.Errors:
            return paper.Errors(Quartiles.of([value]), Quartiles.of([value]))

        return {
            ("surface-1", noise, method): cell(cubic if method.startswith("cubic") else network)
            for noise in paper.NOISES
            for method in paper.METHODS
        }

    good, bad = errors(0.01, 0.04), errors(0.5, 0.04)
    for claim in paper.CLAIMS[:5]:
        assert claim.findings(good, paper.OURS)[0].holds
        assert not claim.findings(bad, paper.OURS)[0].holds
    assert not paper.CLAIMS[5].findings(errors(0.1, 0.5), paper.TRADITIONAL)[0].holds
    assert not paper.CLAIMS[6].findings(good, paper.TRADITIONAL)[0].holds
