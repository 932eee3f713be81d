"""What the services tell each other in JSON: the receipt of a transmission, the state of a surface."""

from __future__ import annotations

import re
from typing import Annotated, Literal, TypeAlias

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, WithJsonSchema, computed_field

_ID = r"(?!\.{1,2}$)[A-Za-z0-9._-]{1,64}"  # clients take . and .. out of a path (RFC 3986, section 5.2.4)


def _check_id(name: str) -> str:
    if re.fullmatch(_ID, name) is None:
        raise ValueError(
            "expected 1 to 64 characters: letters from A to Z and a to z, digits, dots, underlines, hyphens; "
            "not . or .. alone"
        )
    return name


SurfaceId: TypeAlias = Annotated[
    str, AfterValidator(_check_id), WithJsonSchema({"type": "string", "pattern": f"^{_ID}$"})
]
"""Of a surface at the receiver, and of the transmissions that bring it."""

State: TypeAlias = Literal["receiving", "training", "ready", "failed"]


class PacketCounts(BaseModel):
    """Packets of one transmission."""

    model_config = ConfigDict(frozen=True)

    received: int = Field(description="Different packets that arrived intact.")
    damaged: int = Field(description="Packets that were found damaged and dropped.")
    duplicate: int = Field(description="Packets that had arrived before.")
    foreign: int = Field(default=0, description="Packets of another transmission.")
    rebuilt: int = Field(default=0, description="Packets that did not arrive and were rebuilt from parity.")
    total: int | None = Field(description="Packets the transmission consists of; null before the first arrives.")

    @computed_field(  # type: ignore[prop-decorator]
        description="Packets that are not here, neither arrived nor rebuilt; null before the first arrives."
    )
    @property
    def absent(self) -> int | None:
        """Packets that are not here."""
        return None if self.total is None else self.total - self.received - self.rebuilt


class PacketsNamed(PacketCounts):
    """Packets of one transmission, the missing ones by their number."""

    missing: list[int] = Field(
        description="Sequence numbers of packets that are not here, ascending: at most 1,000 or, if that is more, as "
        "many as have arrived. `absent` counts them all; the next receipt names others."
    )


class Delivery(BaseModel):
    """What one POST brought."""

    model_config = ConfigDict(frozen=True)

    new: int = Field(description="Packets that were not here before.")
    duplicate: int = Field(description="Packets that were here already.")
    damaged: int = Field(description="Packets that arrived damaged and were dropped.")
    foreign: int = Field(description="Packets of another transmission.")


class Receipt(BaseModel):
    """What the receiver holds of a transmission after a POST."""

    model_config = ConfigDict(frozen=True)

    id: str
    packets: PacketsNamed
    points: int = Field(description="Feature points held.")
    complete: bool = Field(description="Whether every packet has arrived.")
    state: State
    delivery: Delivery | None = Field(default=None, description="What the POST brought.")
