"""A channel: impairments in a row, and a seed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Self, Union

from pydantic import Field, TypeAdapter

from common.channel.datagram import deliver, launch
from common.channel.impairment import Impairment
from common.channel.impairments import IMPAIRMENTS
from common.channel.notation import (
    MAX_IMPAIRMENTS,
    MAX_SEED,
    check_impairments,
    check_seed,
    parameters_of,
    parse_json,
    parse_text,
    to_text,
)
from common.channel.passage import Draws, Fault, Passage, Reference


@dataclass(frozen=True, slots=True)
class Delivery:
    """What came out of the channel."""

    packets: tuple[bytes, ...]
    """The datagrams in the order of their arrival."""
    faults: tuple[Fault, ...]
    """What was done to which packet, by packet and then in the order it happened."""
    times: tuple[float, ...]
    """Seconds of virtual time at which each datagram arrived, ascending; the first is sent at 0."""
    reference: Reference | None = field(default=None, compare=False)
    """What relative strengths referred to; None where no impairment has one. Hand it on to later calls."""

    @property
    def body(self) -> bytes:
        """The datagrams end to end."""
        return b"".join(self.packets)

    @property
    def seconds(self) -> float:
        """Virtual time until the last datagram arrived."""
        return self.times[-1] if self.times else 0.0

    @property
    def counts(self) -> Mapping[str, int]:
        """How many datagrams each kind of impairment touched."""
        return dict(sorted(Counter(fault.kind for fault in self.faults).items()))


@dataclass(frozen=True)
class Channel:
    """A link that harms what is sent through it, in exactly the way and measure that is written down.

    Impairments act in the order given. A channel holds no state: the same packets, transmission and attempt meet the
    same harm, whatever the order they are sent in. The company they are sent in matters to the queue of `rate`, the
    places of `reordering`, and to relative strengths and signal-to-noise ratios unless a `Reference` is given.

    Parameters
    ----------
    impairments : sequence of Impairment
        Empty is the channel that does nothing.
    seed : int
        0 to 2^64 - 1.

    Raises
    ------
    ChannelError
        If there are too many impairments or the seed is out of bounds.

    Examples
    --------
    >>> channel = Channel.parse("gaussian:std=0.1,axes=xyz;erasure:p=0.05", seed=7)
    >>> str(channel)
    'gaussian:std=0.1,axes=xyz;erasure:p=0.05;seed=7'
    >>> Channel.parse(str(channel)) == channel
    True
    """

    impairments: tuple[Impairment, ...] = field(default=())
    seed: int = 0

    def __init__(self, impairments: Sequence[Impairment] = (), seed: int = 0) -> None:
        object.__setattr__(self, "impairments", check_impairments(impairments))
        object.__setattr__(self, "seed", check_seed(seed))

    @classmethod
    def parse(cls, text: str, seed: int = 0) -> Self:
        """A channel from the short form; a seed in the text goes before `seed`; raises ChannelError."""
        impairments, own = parse_text(text)
        return cls(impairments, seed if own is None else own)

    @classmethod
    def given(cls, text: str, seed: int | None) -> Self:
        """A channel from the short form and a seed; raises ChannelError where the text has another seed."""
        return cls.from_json({"spec": text} if seed is None else {"spec": text, "seed": seed})

    @classmethod
    def from_json(cls, document: object) -> Self:
        """A channel from a decoded JSON document (see `to_json`) or a short string; raises ChannelError."""
        impairments, seed = parse_json(document)
        return cls(impairments, seed or 0)

    def to_json(self) -> dict[str, Any]:
        """``{"impairments": [{"kind": ..., parameters that are not at their default}], "seed": ...}``."""
        return {
            "impairments": [{"kind": part.kind, **parameters_of(part)} for part in self.impairments],
            "seed": self.seed,
        }

    @staticmethod
    def json_schema() -> dict[str, Any]:
        """JSON schema of what `from_json` accepts, with the units and bounds of every impairment."""
        kinds: Any = Annotated[Union[IMPAIRMENTS], Field(discriminator="kind")]  # noqa: UP007 - built from the registry
        items = TypeAdapter(kinds).json_schema()
        definitions = items.pop("$defs")
        return {
            "type": "object",
            "additionalProperties": False,
            "properties": {
                "impairments": {"type": "array", "maxItems": MAX_IMPAIRMENTS, "items": items},
                "seed": {"type": "integer", "minimum": 0, "maximum": MAX_SEED},
            },
            "$defs": definitions,
        }

    def __str__(self) -> str:
        return to_text(self.impairments, self.seed)

    def __bool__(self) -> bool:
        """False for the channel that does nothing."""
        return bool(self.impairments)

    def transmit(
        self,
        packets: Sequence[bytes],
        *,
        transmission: str,
        attempt: int = 0,
        passed: int = 0,
        numbered: bool = False,
        reference: Reference | None = None,
    ) -> Delivery:
        """Send datagrams through the channel; never raises, whatever bytes they are.

        Parameters
        ----------
        packets : sequence of bytes
            Datagrams in the order they are sent. One that is no packet is harmed by its position.
        transmission : str
            Id of the transmission.
        attempt : int
            0 for the first sending, another number for each later one: packets sent again meet fresh luck.
        passed : int
            Channels that were on the way before this one: one with the same seed draws apart from them.
        numbered : bool
            Whether what is no packet meets the luck of the packet of its number, instead of one of its own.
        reference : Reference, optional
            What relative strengths refer to. Without it, the points in `packets`; give it where a transmission is
            sent in several parts, or sent again in part: the `Delivery` of the first call has it.
        """
        flight = launch(packets, numbered=numbered)
        launched = tuple(flight)

        def scale() -> Reference:
            nonlocal reference
            if reference is None:
                reference = Reference.of(launched)
            return reference

        log: list[Fault] = []
        for position, impairment in enumerate(self.impairments, start=passed * MAX_IMPAIRMENTS):
            draws = Draws.of(self.seed, transmission, attempt, position)
            flight = impairment.apply(flight, Passage(impairment.kind, draws, scale, log))
        flight.sort(key=lambda datagram: datagram.at)
        return Delivery(
            packets=tuple(deliver(flight)),
            faults=tuple(sorted(log, key=lambda fault: (fault.packet, fault.copy))),
            times=tuple(datagram.at for datagram in flight),
            reference=reference,
        )
