"""The socket that a service listens on: that it is there, and where."""

from __future__ import annotations

import socket

import pytest

from common.errors import ParameterError
from common.listening import listen, url_of


def test_who_connects_before_anything_is_served_waits() -> None:
    with listen("127.0.0.1", 0) as listener, socket.create_connection(listener.getsockname(), timeout=5):
        pass


def test_a_port_has_one_listener() -> None:
    with listen("127.0.0.1", 0) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(ParameterError, match=f"127.0.0.1 port {port}: Address already in use"):
            listen("127.0.0.1", port)


def test_an_address_of_version_6_stands_in_brackets() -> None:
    with listen("127.0.0.1", 0) as listener:
        assert url_of(listener) == f"http://127.0.0.1:{listener.getsockname()[1]}"
    try:
        listener = listen("::1", 0)
    except ParameterError:
        pytest.skip("this machine has no IPv6")
    with listener:
        assert url_of(listener) == f"http://[::1]:{listener.getsockname()[1]}"


@pytest.mark.parametrize(("host", "port"), [("127.0.0.1", 65_536), ("127.0.0.1", -1), ("192.0.2.1", 0)])
def test_where_nobody_can_listen_is_our_error(host: str, port: int) -> None:
    with pytest.raises(ParameterError):
        listen(host, port)


def test_the_option_that_would_help_is_named() -> None:
    with listen("127.0.0.1", 0) as listener, pytest.raises(ParameterError, match="choose another --port"):
        listen("127.0.0.1", listener.getsockname()[1])
    for host in ("192.0.2.1", "no host"):
        with pytest.raises(ParameterError, match="choose another --host"):
            listen(host, 0)
