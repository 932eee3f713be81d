"""The paper's page in a real browser: where its labels stand."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from simulator.page import data_script, page

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(180)]

WATCH = """() => {
    const draw = CanvasRenderingContext2D.prototype.fillText;
    window.written = {};
    CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
        const half = this.measureText(text).width / 2;
        window.written[text] = [x - half, x + half, y, this.canvas.width];
        draw.call(this, text, x, y);
    };
}"""


def test_labels_stand_within_the_canvas_and_apart(browser: Browser, tmp_path: Path) -> None:
    data = {"range": [-2, 2.5, -3, 3.5, -4.98, -0.556], "surface": None, "points": [], "flat": False}
    canvas = '<canvas style="width: 194px; height: 194px" data-group="a" data-source="a-a"></canvas>'
    (tmp_path / "page.html").write_text(page("Labels", canvas + data_script("a-a", data), script="surface3d.js"))
    tab = browser.new_page()
    tab.add_init_script(f"({WATCH})()")
    tab.goto((tmp_path / "page.html").as_uri())
    tab.wait_for_function("Object.keys(window.written).length == 9")
    written = tab.evaluate("window.written")
    tab.close()
    for left, right, _, side in written.values():
        assert 0 <= left < right <= side
    for (one, (left, right, y, _)), (other, (start, end, height, _)) in combinations(written.items(), 2):
        assert right <= start or end <= left or abs(y - height) >= 11, (one, other)
