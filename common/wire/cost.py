"""What a transmission costs, and what for."""

from __future__ import annotations

from dataclasses import dataclass

from common.surface import FeatureSet
from common.wire.encoder import draft, protect
from common.wire.options import WireOptions


@dataclass(frozen=True, slots=True)
class Cost:
    """Bytes of a transmission; the parts add up to `total`.

    Parameters
    ----------
    points : int
        The feature points themselves.
    headers : int
        Framing, headers and checksums of the packets with points.
    parity : int
        Packets of parity.
    copies : int
        Copies of all of these after the first.
    inner : int
        What the inner code adds.
    count : int
        Feature points.
    """

    points: int
    headers: int
    parity: int
    copies: int
    inner: int
    count: int

    @property
    def total(self) -> int:
        """Bytes sent."""
        return self.points + self.headers + self.parity + self.copies + self.inner

    @property
    def protection(self) -> int:
        """Bytes that are there for the channel's sake."""
        return self.parity + self.copies + self.inner

    @property
    def bytes_per_point(self) -> float:
        """Bytes sent for each feature point, all overhead included."""
        return self.total / self.count


def cost(features: FeatureSet, *, transmission: str, options: WireOptions | None = None) -> Cost:
    """The bytes that `encode` makes of the same arguments, and what each is for; raises what `encode` raises."""
    return encode_with_cost(features, transmission=transmission, options=options)[1]


def encode_with_cost(
    features: FeatureSet, *, transmission: str, options: WireOptions | None = None
) -> tuple[list[bytes], Cost]:
    """What `encode` and `cost` give, with the points written once; raises what `encode` raises."""
    options = options or WireOptions()
    unprotected = draft(features, transmission, options)
    datagrams = protect(unprotected, options)
    repeated = once = datagrams
    if options.inner:
        repeated = once = protect(unprotected, options.model_copy(update={"inner": 0}))
    if options.copies > 1:
        once = protect(unprotected, options.model_copy(update={"copies": 1, "inner": 0}))
    points, plain = sum(map(len, unprotected.blocks)), sum(map(len, once[: unprotected.header.total]))
    single, several, sent = (sum(map(len, each)) for each in (once, repeated, datagrams))
    return datagrams, Cost(points, plain - points, single - plain, several - single, sent - several, len(features))
