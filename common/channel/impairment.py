"""What every impairment is: a frozen, validated model with a `kind`, and one pure function of datagrams.

Two ways to write one: override `harm` where each datagram stands for itself (most), or `apply` where they depend on
each other (order, a queue, bursts). Impairments on coordinates derive from `PointImpairment`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Annotated, ClassVar, Literal, Self, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from common.channel.datagram import Datagram, intact
from common.channel.passage import Passage
from common.surface import FloatArray

Probability: TypeAlias = Annotated[float, Field(ge=0, le=1)]
Axes: TypeAlias = Literal["x", "y", "z", "xy", "xz", "yz", "xyz"]

FLOAT_MAX = float(np.finfo(float).max)
STRENGTH_MAX = 1e100
"""Largest strength in data units: far beyond any surface, far below overflow."""


class Impairment(BaseModel):
    """Something that befalls datagrams on their way.

    Subclasses declare ``kind: Literal["name"] = "name"`` and their parameters with units and bounds, say which of them
    at 0 does nothing (`idle_at_0`, or else `acts`), and override `harm` or `apply`. They hold no state: whatever they
    draw comes from the `Passage`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    kind: str
    probability: Probability = Field(1.0, description="probability that a packet is touched at all, 0 to 1")

    idle_at_0: ClassVar[str | None] = None
    """The parameter that at 0 leaves everything as it is; None where there is none."""

    @property
    def acts(self) -> bool:
        """Whether it ever does anything."""
        return self.probability > 0 and (self.idle_at_0 is None or getattr(self, self.idle_at_0) != 0)

    def apply(self, flight: list[Datagram], passage: Passage) -> list[Datagram]:
        """The datagrams that go on, in order; `flight` is not changed."""
        onward: list[Datagram] = []
        for datagram in flight:
            if passage.spares(datagram, self.probability):
                onward.append(datagram)
            else:
                onward.extend(self.harm(datagram, passage))
        return onward

    def harm(self, datagram: Datagram, passage: Passage) -> Iterable[Datagram]:
        """What becomes of one datagram: none, one or several."""
        raise NotImplementedError(f"{type(self).__name__} overrides neither harm nor apply")


class PointImpairment(Impairment):
    """Adds ``strength * draw`` to the chosen coordinates of a packet's points.

    The strength of an axis is given in one of three ways:

    - in data units, by the subclass's own parameter;
    - ``relative``: times that axis's range (max - min);
    - ``snr_db``: such that the mean square of what is added is var / 10^(snr_db / 10), where var is the variance of
      that axis with the mean removed (heights have a datum; it is not signal).

    Range and variance are those of the points in the call, as they were sent, or of a `Reference` that is given.
    """

    axes: Axes = Field("z", description="the coordinates it acts on, each by itself")
    relative: float | None = Field(None, ge=0, le=1e6, description="strength over the range of the axis")
    snr_db: float | None = Field(
        None, ge=-200, le=400, description="signal-to-noise ratio in dB over the axis with its mean removed"
    )

    in_data_units: ClassVar[str]
    """The subclass's own parameter for the strength."""

    @property
    def acts(self) -> bool:
        """Whether it ever does anything."""
        return super().acts and 0 not in (self.absolute, self.relative)

    @property
    def absolute(self) -> float | None:
        """The strength in data units, or None where it is given relative to the points."""
        value: float | None = getattr(self, self.in_data_units)
        return value

    @property
    def power(self) -> float:
        """Mean square of `draw`, dimensionless."""
        return 1.0

    def draw(self, shape: tuple[int, int], rng: np.random.Generator) -> FloatArray:
        """Values of `shape` (points, axes) in units of the strength."""
        raise NotImplementedError

    @model_validator(mode="after")
    def _one_strength(self) -> Self:
        given = [value for value in (self.absolute, self.relative, self.snr_db) if value is not None]
        if len(given) != 1:
            raise ValueError(f"give exactly one of {self.in_data_units}, relative, snr_db")
        return self

    def apply(self, flight: list[Datagram], passage: Passage) -> list[Datagram]:
        """The datagrams, with their points moved; one that is damaged or carries no points is left alone."""
        columns = ["xyz".index(axis) for axis in self.axes]
        strength = self._strength(passage, columns)
        return [
            datagram
            if packet is None or not len(packet.points) or passage.spares(datagram, self.probability)
            else self._moved(datagram, packet.points, columns, strength, passage)
            for datagram, packet in zip(flight, intact(flight), strict=True)
        ]

    def _strength(self, passage: Passage, columns: list[int]) -> FloatArray:
        """Strength in data units of each of the `columns` (0, 1, 2 for x, y, z)."""
        if self.absolute is not None:
            return np.full(len(columns), self.absolute)
        reference = passage.reference()
        with np.errstate(over="ignore"):
            if self.relative is not None:
                strength = self.relative * reference.ranges[columns]
            else:
                deviation = reference.deviations[columns] / np.sqrt(self.power)
                strength = deviation * 10 ** (-(self.snr_db or 0.0) / 20)
        return np.clip(strength, -FLOAT_MAX, FLOAT_MAX)

    def _moved(
        self, datagram: Datagram, sent: FloatArray, columns: list[int], strength: FloatArray, passage: Passage
    ) -> Datagram:
        points = np.array(sent if datagram.points is None else datagram.points)
        with np.errstate(over="ignore"):
            added = self.draw((len(points), len(columns)), passage.rng(datagram)) * strength
            points[:, columns] = np.clip(points[:, columns] + added, -FLOAT_MAX, FLOAT_MAX)
        touched = int(np.count_nonzero(added.any(axis=1)))
        if not touched:
            return datagram
        passage.note(datagram, touched, "points")
        return replace(datagram, points=points)
