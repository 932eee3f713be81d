"""The page that shows a service's API, in a real browser, served by a real service."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(180)]

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("service", "path", "told"),
    [("receiver", "/v1/transmissions/{id}", "spread"), ("sender", "/v1/transmissions", "gap")],
)
def test_the_page_shows_every_call(browser: Browser, tmp_path: Path, service: str, path: str, told: str) -> None:
    data = ["--data", str(tmp_path)] if service == "receiver" else []
    command = [sys.executable, "-m", service, "serve", "--port", "0", *data]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            found = re.search(r"http://[\d.:]+", process.stdout.readline())
            assert found is not None
            page = browser.new_page()
            asked: list[str] = []
            complaints: list[str] = []
            page.on("request", lambda request: asked.append(request.url))
            page.on("pageerror", lambda error: complaints.append(str(error)))
            page.goto(f"{found[0]}/docs")
            call = page.locator("details", has=page.get_by_text(path, exact=True)).first
            call.locator("summary").click()
            assert call.get_by_text(told, exact=True).first.is_visible()
            assert page.title() == f"surfacelink {service}: API"
            assert not complaints
            assert all(url.startswith((found[0], "data:")) for url in asked)
            page.close()
        finally:
            process.terminate()
            process.wait(timeout=30)
