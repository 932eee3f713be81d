"""How long the body of a request may be."""

from __future__ import annotations

from starlette.types import Message, Receive, Scope

from common.errors import LimitError


def limited(scope: Scope, receive: Receive, most: int) -> Receive:
    """`receive`, for bodies of at most `most` bytes.

    Raises LimitError at once where the request declares more, and from what is returned where more come.
    """

    def check(length: int) -> None:
        if length > most:
            raise LimitError(f"the body is longer than {most} bytes")

    declared = dict(scope["headers"]).get(b"content-length", b"")
    check(int(declared) if declared.isdigit() else 0)
    received = 0

    async def counted() -> Message:
        nonlocal received
        message = await receive()
        received += len(message.get("body", b""))
        check(received)
        return message

    return counted
