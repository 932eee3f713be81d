"""The services' web pages: files of the package, each whole, so that no other network is needed."""

from __future__ import annotations

from base64 import b64encode
from hashlib import sha256
from importlib.resources import files
from typing import NamedTuple


class Page(NamedTuple):
    """The text of a page, and the headers that it is answered with."""

    text: str
    headers: dict[str, str]


def read_page(package: str, name: str) -> Page:
    """The page of that name; its policy lets it run its own script and speak to its service, and nothing else."""
    text = files(package).joinpath(name).read_text(encoding="utf-8")
    script = text.partition("<script>")[2].partition("</script>")[0]
    digest = b64encode(sha256(script.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src 'self' data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return Page(text, {"Content-Security-Policy": policy, "Cache-Control": "no-cache"})


def api_page(home: str | None = None) -> Page:
    """What a service's ``/openapi.json`` says, for people; `home` names the page at ``/``, if there is another one."""
    page = read_page("common", "docs.html")
    return page._replace(text=page.text.replace("<!-- home -->", f'<a href="/">{home}</a> · ' if home else ""))
