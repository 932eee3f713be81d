"""A client that goes away while it sends."""

from __future__ import annotations

from typing import Any

from starlette.types import Message


async def break_off(app: Any, method: str, path: str, content_type: str, body: bytes) -> None:
    """Send a part of a body to an ASGI application, and hang up."""
    arriving: list[Message] = [
        {"type": "http.request", "body": body, "more_body": True},
        {"type": "http.disconnect"},
    ]

    async def receive() -> Message:
        return arriving.pop(0) if len(arriving) > 1 else arriving[0]

    async def send(message: Message) -> None:
        """No one is there to read it."""

    headers = [(b"content-type", content_type.encode()), (b"content-length", b"1000"), (b"host", b"service")]
    scope = {"type": "http", "method": method, "path": path, "raw_path": path.encode(), "query_string": b"",
             "headers": headers, "scheme": "http", "server": ("service", 80), "http_version": "1.1"}  # fmt: skip
    await app(scope, receive, send)
