"""Messages through a channel, seed by seed: what is lost, and how good is the rest.

The message is cut into datagrams that are numbered by the transport, free of charge: the receiver knows which of them
are missing and puts zeros there. Impairments of time and order therefore change nothing; impairments of points have
no meaning for a raster and are refused.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np

from common.channel import Channel, PointImpairment
from common.channel.impairments.erasure import Erasure
from common.errors import ChannelError
from common.metrics import nrmse
from common.surface import BoolArray, FloatArray
from common.wire.limits import DEFAULT_DATAGRAM
from simulator.codecs import Failure, Message, Sandbox, decode
from simulator.codecs.protection import Protection, find_protection

TRANSPORT = frozenset({"duplication", "reordering", "delay", "jitter", "rate"})
"""Impairments that numbering the datagrams undoes."""


@dataclass(frozen=True, slots=True)
class Survival:
    """What came out of a channel.

    Attributes
    ----------
    message : Message
    protection : str
    channel : str
        In the short form, without a seed.
    sent : int
        Bytes sent, protection included.
    errors : tuple of (float or None)
        For each seed the NRMSE, or None where nothing could be decoded.
    failures : mapping
        How many decodes ended by a crash, a timeout, for want of memory, or by an error.
    """

    message: Message
    protection: str
    channel: str
    sent: int
    errors: tuple[float | None, ...]
    failures: Mapping[str, int]

    @property
    def decoded(self) -> tuple[float, ...]:
        """NRMSE of the seeds that gave a surface."""
        return tuple(error for error in self.errors if error is not None)

    @property
    def failed(self) -> float:
        """Share of seeds that gave no surface, 0 to 1."""
        return 1 - len(self.decoded) / len(self.errors)

    @property
    def median(self) -> float | None:
        """Median NRMSE of the seeds that gave a surface; None where none did."""
        return float(np.median(self.decoded)) if self.decoded else None


def received(
    data: bytes, channel: Channel, *, transmission: str, datagram: int = DEFAULT_DATAGRAM
) -> tuple[bytes, BoolArray]:
    """(bytes as long as `data`, which of them are lost) at the other end of a channel; lost bytes are zeros."""
    packets = [data[start : start + datagram] for start in range(0, len(data), datagram)]
    delivery = channel.transmit(packets, transmission=transmission, numbered=True)
    gone = {fault.packet for fault in delivery.faults if fault.kind in ("erasure", "gilbert_elliott")}
    arrived = iter(delivery.packets)
    out, lost = bytearray(), np.ones(len(data), dtype=np.bool_)
    for number, packet in enumerate(packets):
        body = b"" if number in gone else next(arrived)
        lost[len(out) : len(out) + len(body)] = False
        out += body.ljust(len(packet), b"\0")
    return bytes(out), lost


def expose(
    field: FloatArray,
    message: Message,
    channel: Channel,
    seeds: Sequence[int],
    *,
    transmission: str = "",
    protection: str = "none",
    datagram: int = DEFAULT_DATAGRAM,
    sandbox: Sandbox | None = None,
) -> Survival:
    """Send one message through a channel, once a seed.

    Parameters
    ----------
    field : ndarray, shape (rows, columns)
        The true heights.
    message : Message
    channel : Channel
        Its own seed is not used.
    seeds : sequence of int
        Seeds of the channel; at least one.
    transmission : str
        What draws follow from beside the seed; one for all that is to meet the same luck.
    protection : str
        Key of `PROTECTIONS`.
    datagram : int
        Bytes of a datagram.
    sandbox : Sandbox, optional
        Where the damaged messages are decoded; one child process unless given.

    Raises
    ------
    ChannelError
        If the channel moves points.
    NotFoundError, MissingExtraError
    """
    code = find_protection(protection)
    link = _for_streams(channel)
    stream = code.encode(message.data)
    calls = [_arrival(stream, code, Channel(link.impairments, seed), message, transmission, datagram) for seed in seeds]
    errors: list[float | None] = []
    failures: Counter[str] = Counter()
    with Sandbox() if sandbox is None else nullcontext(sandbox) as box:
        for heights in box.map(decode, calls):
            if isinstance(heights, Failure):
                failures[heights.kind] += 1
                errors.append(None)
            elif heights.shape != field.shape:
                failures["error"] += 1
                errors.append(None)
            else:
                errors.append(nrmse(field, heights))
    return Survival(
        message,
        protection,
        str(Channel(channel.impairments)),
        len(stream),
        tuple(errors),
        dict(sorted(failures.items())),
    )


def _arrival(
    stream: bytes, code: Protection, channel: Channel, message: Message, transmission: str, datagram: int
) -> tuple[str, bytes, BoolArray]:
    """Arguments of `decode` for one seed."""
    data, lost = received(stream, channel, transmission=transmission, datagram=datagram)
    body, gone = code.decode(data, lost, stream)
    return message.codec, body, gone


def _for_streams(channel: Channel) -> Channel:
    """The channel, unseeded, as a numbered stream of datagrams meets it; raises ChannelError where it moves points.

    What is undone leaves a place that does nothing: draws follow from an impairment's position, too.
    """
    for impairment in channel.impairments:
        if isinstance(impairment, PointImpairment):
            raise ChannelError(f"{impairment.kind} moves points; a raster codec sends none")
    return Channel([Erasure(p=0) if part.kind in TRANSPORT else part for part in channel.impairments])
