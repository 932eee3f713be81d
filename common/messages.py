"""What the services tell each other in JSON: the receipt of a transmission, the state of a surface."""

from __future__ import annotations

from typing import Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field

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
    missing: list[int] = Field(description="Sequence numbers that have not arrived.")


class Receipt(BaseModel):
    """What the receiver holds of a transmission after a POST."""

    model_config = ConfigDict(frozen=True)

    id: str
    packets: PacketCounts
    points: int = Field(description="Feature points held.")
    complete: bool = Field(description="Whether every packet has arrived.")
    state: State
