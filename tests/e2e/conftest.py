"""A real browser, where one is installed."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser

ROOT = Path(__file__).resolve().parents[2]

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")

ARGUMENTS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    # While it is open, an event loop runs in this thread: the tests of other modules want one of their own.
    executable = next(filter(None, map(shutil.which, BROWSERS)), None)
    if executable is None:
        pytest.skip(f"no browser is installed: none of {', '.join(BROWSERS)} is in the PATH")
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, headless=True, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture
def start() -> Iterator[Callable[..., str]]:
    """Starts a service, by its name and options, as a process of its own, and gives its address."""

    @contextmanager
    def running(service: str, *options: str) -> Iterator[str]:
        command = [sys.executable, "-m", service, "serve", "--port", "0", *options]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            try:
                found = re.search(r"http://[\d.:]+", process.stdout.readline())
                assert found is not None
                yield found[0]
            finally:
                process.terminate()
                status = process.wait(timeout=30)
        assert status in (0, -15)

    with ExitStack() as stack:
        yield lambda service, *options: stack.enter_context(running(service, *options))
