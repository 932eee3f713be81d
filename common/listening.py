"""The socket that a service listens on."""

from __future__ import annotations

import errno
import socket

from common.errors import ParameterError

OF_THE_PORT = (errno.EADDRINUSE, errno.EACCES)
"""Errors that another port may cure; the others are of the address."""


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens on `host` and `port`; 0 takes a free one. Raises ParameterError where that cannot be.

    Who connects before the service is up waits for it.
    """
    if not 0 <= port <= 65535:
        raise ParameterError(f"port must be 0 to 65535, got {port}")
    listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen()
    except OSError as error:
        listener.close()
        option = "--port" if error.errno in OF_THE_PORT else "--host"
        raise ParameterError(
            f"cannot listen on {host} port {port}: {error.strerror or error}; choose another {option}"
        ) from error
    return listener


def url_of(listener: socket.socket) -> str:
    """Where a client finds what is served on `listener`."""
    host, port, *_ = listener.getsockname()
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
