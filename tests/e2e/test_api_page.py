"""The page that shows a service's API, in a real browser, served by a real service."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(180)]


@pytest.mark.parametrize(
    ("service", "path", "told"),
    [("receiver", "/v1/transmissions/{id}", "spread"), ("sender", "/v1/transmissions", "gap")],
)
def test_the_page_shows_every_call(
    browser: Browser, start: Callable[..., str], tmp_path: Path, service: str, path: str, told: str
) -> None:
    url = start(service, *(["--data", str(tmp_path)] if service == "receiver" else []))
    page = browser.new_page()
    asked: list[str] = []
    complaints: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(f"{url}/docs")
    call = page.locator("details", has=page.get_by_text(path, exact=True)).first
    call.locator("summary").click()
    assert call.get_by_text(told, exact=True).first.is_visible()
    assert page.title() == f"surfacelink {service}: API"
    assert not complaints
    assert all(each.startswith((url, "data:")) for each in asked)
    page.close()
