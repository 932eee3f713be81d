"""What the sender chooses about the bytes."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidatorFunctionWrapHandler, field_validator

from common.wire.inner import Strength
from common.wire.limits import (
    DEFAULT_DATAGRAM,
    MAX_BITS,
    MAX_COPIES,
    MAX_DATAGRAM,
    MAX_PACKETS,
    MAX_PARITY,
    MIN_BITS,
    MIN_DATAGRAM,
)

Bits: TypeAlias = Annotated[int, Field(ge=MIN_BITS, le=MAX_BITS)]
Precision: TypeAlias = Literal["float64", "float32"] | Bits


class WireOptions(BaseModel):
    """How a FeatureSet becomes packets."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    datagram: int = Field(
        default=DEFAULT_DATAGRAM, ge=MIN_DATAGRAM, le=MAX_DATAGRAM, description="Bytes; no packet is longer."
    )
    precision: Precision = Field(
        default=16,
        description="float64, float32, or the bits of a height quantised over the range of the heights.",
    )
    position_bits: Bits | None = Field(
        default=None,
        description="Bits of x and of y, quantised over the region; by default what the points' density asks for. "
        "Where compact coding cannot say so many, it is not used; at least 3 where a height has fewer than 4.",
    )
    min_packets: int = Field(
        default=1,
        ge=1,
        le=MAX_PACKETS,
        description="Spread the points over this many packets at least (where there are as many points).",
    )
    parity: float = Field(
        default=0.0,
        ge=0.0,
        le=MAX_PARITY,
        description="Packets of parity as a share of those with points: so many may be lost without loss of points.",
    )
    copies: int = Field(default=1, ge=1, le=MAX_COPIES, description="How often each packet is sent.")
    inner: Literal[0] | Strength = Field(
        default=0,
        description="Bytes of Reed-Solomon parity in each 255 of a datagram; half as many wrong bytes are corrected.",
    )
    coding: Literal["plain", "compact"] = Field(
        default="plain",
        description="Plain: fixed width, fast. Compact: sorted, predicted and entropy-coded; of quantised points only.",
    )

    @field_validator("precision", mode="wrap")
    @classmethod
    def _said_at_once(cls, value: object, handler: ValidatorFunctionWrapHandler) -> object:
        try:
            return handler(value)
        except ValidationError as error:
            raise ValueError(f"expected float64, float32, or {MIN_BITS} to {MAX_BITS} bits") from error
