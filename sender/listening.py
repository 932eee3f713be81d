"""A socket to serve on."""

from __future__ import annotations

import socket

from common.errors import ParameterError


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens at `host` and `port`; 0 takes a free one. Raises ParameterError where that cannot be."""
    if not 0 <= port <= 65535:
        raise ParameterError(f"port must be 0 to 65535, got {port}")
    try:
        return socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except OSError as error:
        reason = str(error.strerror or error).partition(" (while")[0]  # the address stands in the message already
        raise ParameterError(f"cannot listen on {host} port {port}: {reason}; choose another --port") from error
