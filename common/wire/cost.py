"""What a transmission costs, and what for."""

from __future__ import annotations

from dataclasses import dataclass

from common.surface import FeatureSet
from common.wire.encoder import protect_blocks, write_blocks
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
    options = options or WireOptions()
    header, blocks = write_blocks(features, transmission, options)
    once = options.model_copy(update={"copies": 1, "inner": 0})
    sizes = [len(datagram) for datagram in protect_blocks(header, blocks, once)]
    repeated = sum(map(len, protect_blocks(header, blocks, options.model_copy(update={"inner": 0}))))
    sent = sum(map(len, protect_blocks(header, blocks, options)))
    points, plain = sum(map(len, blocks)), sum(sizes[: header.total])
    return Cost(points, plain - points, sum(sizes) - plain, repeated - sum(sizes), sent - repeated, len(features))
