"""What the adapters to HTTP share: a body in, a body out, and the names of the headers. No HTTP is done here."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from itertools import pairwise
from threading import Lock

from common.channel.channel import Channel, Delivery
from common.channel.passage import Reference
from common.errors import ParameterError, WireError
from common.wire import split
from common.wire.framing import START, length_after

ATTEMPT_HEADER = "Surfacelink-Attempt"
"""Request header: 0 for the first sending of a transmission, 1, 2, ... for the next (absent: 0)."""
FAULTS_HEADER = "Surfacelink-Faults"
"""Header of a harmed request and of its answer: how many datagrams each impairment touched,
such as ``erasure=2, gaussian=10``, or ``none``."""
MAX_ATTEMPT = 2**31 - 1

MAX_REFERENCES = 256
"""Transmissions remembered; their attempts follow each other closely, and few are under way at once."""

_TRANSMISSION = re.compile(r"/v1/transmissions/(?P<transmission>[^/]+)/?")


def transmission_of(path: str) -> str | None:
    """The id in the (percent-decoded) path of a transmission, or None for another path.

    >>> transmission_of("/v1/transmissions/hills"), transmission_of("/v1/surfaces/hills")
    ('hills', None)
    """
    match = _TRANSMISSION.fullmatch(path)
    return match and match["transmission"]


def attempt_of(header: str | None) -> int:
    """The attempt a request header names; raises ParameterError where it is no integer of 0 to `MAX_ATTEMPT`."""
    if header is None:
        return 0
    if not re.fullmatch(r"[0-9]{1,10}", header.strip()) or int(header) > MAX_ATTEMPT:
        raise ParameterError(f"{ATTEMPT_HEADER} must be an integer of 0 to {MAX_ATTEMPT}")
    return int(header)


def datagrams_of(body: bytes) -> list[bytes]:
    """The datagrams of a body; end to end they are the body, whatever it is.

    A body that is no run of packets, because a channel before this one damaged it, is cut wherever a packet seems to
    start.
    """
    try:
        return split(body)
    except WireError:
        return _cut(body)


def _cut(body: bytes) -> list[bytes]:
    cuts, position = [0], 0
    while (start := START.search(body, position)) is not None:
        position = min(start.end() + length_after(start), len(body))
        cuts += [start.start(), position]
    return [body[a:b] for a, b in pairwise([*cuts, len(body)]) if a < b]


class References:
    """What relative strengths refer to in each of the last transmissions: what was in the body sent first.

    May be used by several threads.
    """

    def __init__(self) -> None:
        self._kept: dict[str, Reference] = {}
        self._lock = Lock()

    def find(self, transmission: str, attempt: int) -> Reference | None:
        """That of a transmission that is sent again; None for one sent first, or not known any more."""
        with self._lock:
            return self._kept.get(transmission) if attempt else None

    def keep(self, transmission: str, delivery: Delivery) -> None:
        """Remember what `delivery` referred to, if it did."""
        with self._lock:
            self._kept.pop(transmission, None)
            if delivery.reference is not None:
                self._kept[transmission] = delivery.reference
            if len(self._kept) > MAX_REFERENCES:
                del self._kept[next(iter(self._kept))]


def carry(
    channel: Channel,
    body: bytes,
    *,
    transmission: str,
    attempt: int = 0,
    passed: int = 0,
    references: References | None = None,
) -> Delivery:
    """Send the datagrams of a body through the channel; relative strengths refer to what `references` knows, if given.

    A later attempt then meets noise as strong as the first did, though it carries fewer points. `passed` channels were
    on the way before this one: as many as the request has headers `FAULTS_HEADER`.
    """
    known = references.find(transmission, attempt) if references else None
    delivery = channel.transmit(
        datagrams_of(body), transmission=transmission, attempt=attempt, passed=passed, reference=known
    )
    if references:
        references.keep(transmission, delivery)
    return delivery


def faults_header(delivery: Delivery) -> str:
    """The value of the response header."""
    return _listed(delivery.counts)


def with_faults(own: str, inner: str | None) -> str:
    """The value of the header where an inner channel answered with one already: its counts are added."""
    counts: Counter[str] = Counter()
    for kind, _, count in (pair.partition("=") for value in (own, inner or "") for pair in value.split(", ")):
        if count.isdecimal():
            counts[kind] += int(count)
    return _listed(counts)


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{kind}={count}" for kind, count in counts.items()) or "none"
