"""The viewer in a real browser, served by a real receiver."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
import numpy as np
import pytest

from common.surface import FeatureSet, Region, Units
from common.wire import MEDIA_TYPE, encode

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(180)]

ROOT = Path(__file__).resolve().parents[2]

USUAL = Region(-2, 2, -1, 1)


@pytest.fixture
def receiver(start: Callable[..., str], tmp_path: Path) -> str:
    """The address of a receiver that runs as a process of its own."""
    return start("receiver", "--data", str(tmp_path / "data"))


def send(receiver: str, name: str, points: np.ndarray, region: Region = USUAL) -> None:
    features = FeatureSet(points, region, gap=0.5, kind="cloud", units=Units("m", "m"))
    answer = httpx.post(
        f"{receiver}/v1/transmissions/{name}",
        content=b"".join(encode(features, transmission=name)),
        headers={"Content-Type": MEDIA_TYPE},
        timeout=30,
    )
    assert answer.status_code == 202


@pytest.fixture
def points() -> np.ndarray:
    xy = np.random.default_rng(2).uniform((-2, -1), (2, 1), (80, 2))
    return np.column_stack([xy, 100 + np.sin(2 * xy).sum(axis=1)])


@pytest.fixture
def page(browser: Browser, receiver: str) -> Iterator[Page]:
    """The viewer; fails where it logs an error or asks anyone but the receiver."""
    context = browser.new_context(viewport={"width": 1200, "height": 900}, color_scheme="light")
    page = context.new_page()
    complaints: list[str] = []
    page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on(
        "request",
        lambda request: None if request.url.startswith((receiver, "data:")) else complaints.append(request.url),
    )
    page.goto(receiver)
    yield page
    context.close()
    assert complaints == []


def shown(page: Page) -> np.ndarray:
    """Red, green, blue of every seventh pixel in the middle of what is drawn."""
    script = """() => {
        const c = document.querySelector("canvas"), found = [];
        const pixels = c.getContext("2d").getImageData(c.width / 4, c.height / 4, c.width / 2, c.height / 2).data;
        for (let k = 0; k < pixels.length; k += 28) found.push(pixels[k] << 16 | pixels[k + 1] << 8 | pixels[k + 2]);
        return found.join();
    }"""
    return np.array(page.evaluate(script).split(","), dtype=int)


def test_a_surface_appears_by_itself_and_can_be_read(page: Page, receiver: str, points: np.ndarray) -> None:
    page.get_by_text("Nothing has arrived yet").wait_for()
    send(receiver, "hills", points)
    page.locator('canvas[data-drawn="hills map z"]').wait_for()
    assert page.locator("#state").inner_text() == "ready"
    assert len(np.unique(shown(page))) > 100

    canvas = page.locator("canvas")
    canvas.focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowUp")
    read = page.locator("#read").inner_text()
    found = re.search(r"x\s+(\S+) m\s+y\s+(\S+) m\s+height\s+(\S+) m", read)
    assert found is not None, read
    x, y, height = map(float, found.groups())
    assert (x, y) == (0.04, 0.02)
    assert height == pytest.approx(100 + np.sin(2 * x) + np.sin(2 * y), abs=0.1)

    box = canvas.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert "height" in page.locator("#read").inner_text()


def test_an_address_with_a_name_shows_that_surface(page: Page, receiver: str, points: np.ndarray) -> None:
    for name in ("hills", "dunes"):
        send(receiver, name, points)
    page.locator('[data-id="dunes"]').wait_for()
    for name in ("dunes", "hills"):
        page.goto(f"{receiver}/#{name}")
        page.locator(f'canvas[data-drawn="{name} map z"]').wait_for()


def test_what_is_shown_can_be_chosen(page: Page, receiver: str, points: np.ndarray) -> None:
    send(receiver, "hills", points)
    page.locator('canvas[data-drawn="hills map z"]').wait_for()
    pictures = [shown(page)]

    def changed() -> None:
        for _ in range(100):
            page.wait_for_timeout(20)  # about a frame
            pictures.append(shown(page))
            if not np.array_equal(pictures[-2], pictures[-1]):
                return
        pytest.fail("the picture did not change")

    page.locator("#palette").select_option("magma")
    changed()
    for box in ("#shade", "#lines", "#points"):
        page.locator(box).uncheck()
        changed()
    with page.expect_response(re.compile("/network")):
        page.locator("#centers").check()
    changed()
    page.locator("#layer").select_option("std")
    page.locator('canvas[data-drawn="hills map std"]').wait_for()
    changed()
    page.locator("#as-3d").click()
    page.locator('canvas[data-drawn="hills 3d std"]').wait_for()
    changed()
    page.locator("canvas").focus()
    page.keyboard.press("ArrowLeft")
    changed()
    page.locator("#theme").click()
    assert page.locator("html").get_attribute("data-theme") == "dark"


def test_labels_tell_apart_what_is_far_from_the_origin(page: Page, receiver: str, points: np.ndarray) -> None:
    """A survey of 4 x 2 m in UTM coordinates, with heights within 1 m."""
    page.evaluate("""() => {
        const draw = CanvasRenderingContext2D.prototype.fillText;
        window.written = new Set();
        CanvasRenderingContext2D.prototype.fillText = function (text, ...at) {
            window.written.add(text);
            draw.call(this, text, ...at);
        };
    }""")
    origin, extent = (500_000, 4_100_000, 1_200), (1, 1, 0.1)
    region = Region(499_998, 500_002, 4_099_999, 4_100_001)
    send(receiver, "plot", (points - (0, 0, 100)) * extent + origin, region)
    page.locator('canvas[data-drawn="plot map z"]').wait_for()
    numbers = {float(text) for text in page.evaluate("[...window.written]") if re.fullmatch(r"[\d.]+", text)}
    for low, high in ((1_199, 1_201), (499_998, 500_002), (4_099_999, 4_100_001)):
        ticks = sorted(number for number in numbers if low <= number <= high)
        assert len(ticks) >= 3
        np.testing.assert_allclose(np.diff(ticks), np.diff(ticks)[0], rtol=1e-6)
    assert "499998 … 500002 m" in page.get_by_text("499998").inner_text()
    page.locator("#as-3d").click()
    page.locator('canvas[data-drawn="plot 3d z"]').wait_for()
    assert "y 4099999 … 4100001 m" in page.evaluate("[...window.written]")


def test_downloads_and_curl_lines_work(page: Page, receiver: str, points: np.ndarray) -> None:
    send(receiver, "hills", points)
    page.locator('canvas[data-drawn="hills map z"]').wait_for()
    page.locator(".links a", has_text="png").wait_for()
    links = [link.get_attribute("href") or "" for link in page.locator(".links a").all()]
    assert len(links) >= 10
    for link in links:
        assert httpx.get(receiver + link, timeout=30).status_code == 200, link
    lines = page.locator(".curl pre").all_inner_texts()
    assert any(f'curl "{receiver}/v1/surfaces/hills/grid?f=csv' in line for line in lines)


def test_only_what_the_receiver_can_write_is_offered(page: Page, receiver: str, points: np.ndarray) -> None:
    def without_tif(route: Route) -> None:
        answer = route.fetch()
        route.fulfill(response=answer, body=answer.text().replace(',"tif"', ""))

    page.route("**/openapi.json", without_tif)
    page.reload()
    send(receiver, "hills", points)
    page.locator("#grids a", has_text="png").wait_for()
    assert page.locator("#grids a", has_text="tif").count() == 0


def test_a_telephone_shows_more_map_than_margins(page: Page, receiver: str) -> None:
    page.evaluate("""() => {
        const draw = CanvasRenderingContext2D.prototype.drawImage;
        CanvasRenderingContext2D.prototype.drawImage = function (...at) {
            if (at.length === 9) window.map = at.slice(5);
            draw.apply(this, at);
        };
    }""")
    page.set_viewport_size({"width": 390, "height": 844})
    xy = np.random.default_rng(2).uniform(-1, 1, (4000, 2))
    send(receiver, "dense", np.column_stack([xy, 100 * xy.sum(axis=1)]), Region(-1, 1, -1, 1))
    canvas = page.locator('canvas[data-drawn="dense map z"]')
    canvas.wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    box = canvas.bounding_box()
    assert box is not None
    x, y, width, height = page.evaluate("window.map")
    assert width * height > 0.5 * box["width"] * box["height"]
    assert y >= 0
    assert y + height <= box["height"]
    assert box["y"] + y + height <= 844  # seen without scrolling
    script = """([x, y, width, height]) => {
        const pixels = document.querySelector("canvas").getContext("2d").getImageData(x, y, width, height).data;
        return Array.from(pixels);
    }"""
    pixels = np.reshape(page.evaluate(script, [x, y, width, height]), (-1, 4))[:, :3]
    page.locator("#points").uncheck()
    page.wait_for_timeout(200)
    bare = np.reshape(page.evaluate(script, [x, y, width, height]), (-1, 4))[:, :3]
    assert 0 < np.mean(np.abs(pixels - bare).max(axis=1) > 60) < 0.25


def test_all_of_the_3d_view_is_within_the_canvas(page: Page, receiver: str, points: np.ndarray) -> None:
    page.evaluate("""() => {
        const line = CanvasRenderingContext2D.prototype.lineTo;
        window.lines = [];
        CanvasRenderingContext2D.prototype.lineTo = function (x, y) {
            window.lines.push([x, y]);
            line.call(this, x, y);
        };
    }""")
    send(receiver, "hills", points * (1, 2, 1), Region(-2, 2, -2, 2))
    page.locator('canvas[data-drawn="hills map z"]').wait_for()
    page.locator("#as-3d").click()
    canvas = page.locator('canvas[data-drawn="hills 3d z"]')
    canvas.wait_for()
    box = canvas.bounding_box()
    assert box is not None
    for around in (-0.6, 0.8, 3.0):
        for above in (0.08, 0.62, 1.5):
            drawn = page.evaluate(f"lines = []; turn = {{around: {around}, above: {above}, zoom: 1}}; draw3D(); lines")
            assert np.min(drawn) >= 0
            assert (np.max(drawn, axis=0) <= (box["width"], box["height"])).all(), (around, above)


def test_a_removed_surface_goes(page: Page, receiver: str, points: np.ndarray) -> None:
    send(receiver, "hills", points)
    send(receiver, "dales.-_", points)
    page.locator("nav li", has_text="dales.-_").wait_for()
    page.locator("nav li button", has_text="hills").click()
    page.locator('canvas[data-drawn="hills map z"]').wait_for()
    page.once("dialog", lambda dialog: dialog.accept())
    page.locator("#remove").click()
    page.locator("nav li", has_text="hills").wait_for(state="detached")
    assert page.locator("#name").inner_text() == "dales.-_"
    assert httpx.get(f"{receiver}/v1/surfaces/hills").status_code == 404


def test_what_comes_while_the_list_is_fetched_is_not_lost(page: Page, receiver: str, points: np.ndarray) -> None:
    def late(route: Route) -> None:
        empty = route.fetch()
        send(receiver, "hills", points)
        while httpx.get(f"{receiver}/v1/surfaces/hills").json()["state"] != "ready":
            time.sleep(0.05)
        time.sleep(1)  # for the events to reach the page before the list does
        route.fulfill(response=empty)

    page.route("**/v1/surfaces?limit=500", late, times=1)
    page.reload()
    page.wait_for_event("requestfinished", lambda request: request.url.endswith("/v1/channel"))
    page.locator("nav li", has_text="hills").wait_for(timeout=5000)


def test_a_failed_training_is_explained(page: Page, receiver: str) -> None:
    send(receiver, "point", np.zeros((1, 3)))
    page.get_by_text("The network could not be trained").wait_for()
    assert "point" in page.locator("#veil-text").inner_text()


def test_an_event_that_comes_late_changes_nothing(page: Page, receiver: str) -> None:
    send(receiver, "point", np.zeros((1, 3)))
    title = page.get_by_text("The network could not be trained")
    title.wait_for()
    page.evaluate("() => changed({...surfaces.get('point'), state: 'training', updated: '2000'})")
    assert title.is_visible()
    page.evaluate("() => changed({...surfaces.get('point'), state: 'training', updated: '9999'})")
    assert not title.is_visible()


def test_no_slope_is_so_dark_that_it_reads_as_a_hole(page: Page) -> None:
    """All shades from none to full light, of white; `lit` draws both the map and the relief."""
    page.get_by_text("Nothing has arrived yet").wait_for()
    shades = page.evaluate("[...Array(11).keys()].map(k => lit(255, k / 10))")
    assert min(shades) >= 0.55 * 255
    assert shades == sorted(shades)
    assert shades[-1] == 255
    assert shades[5] < 0.75 * 255


def test_an_address_that_names_no_surface_shows_the_latest(page: Page, receiver: str, points: np.ndarray) -> None:
    send(receiver, "hills", points)
    page.locator("nav li", has_text="hills").wait_for()
    page.goto(f"{receiver}/#100%")
    page.reload()
    page.locator('canvas[data-drawn="hills map z"]').wait_for()
    assert page.locator("#live").inner_text() == "live"
