"""Uniform noise on coordinates: the paper's."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from common.channel.impairment import STRENGTH_MAX, PointImpairment
from common.surface import FloatArray


class Uniform(PointImpairment):
    """c' = c + amplitude * U(-1, 1), independently for each point and axis; its deviation is amplitude / sqrt(3)."""

    kind: Literal["uniform"] = "uniform"
    amplitude: float | None = Field(None, ge=0, le=STRENGTH_MAX, description="half the width, data units")

    in_data_units: ClassVar[str] = "amplitude"

    @property
    def power(self) -> float:
        """Variance of U(-1, 1)."""
        return 1 / 3

    def draw(self, shape: tuple[int, int], rng: np.random.Generator) -> FloatArray:
        """U(-1, 1)."""
        return rng.uniform(-1.0, 1.0, shape)
