"""Gaussian noise on coordinates."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from common.channel.impairment import STRENGTH_MAX, PointImpairment
from common.surface import FloatArray


class Gaussian(PointImpairment):
    """c' = c + std * N(0, 1), independently for each point and axis."""

    kind: Literal["gaussian"] = "gaussian"
    std: float | None = Field(None, ge=0, le=STRENGTH_MAX, description="standard deviation, data units")

    in_data_units: ClassVar[str] = "std"

    def draw(self, shape: tuple[int, int], rng: np.random.Generator) -> FloatArray:
        """N(0, 1)."""
        return rng.standard_normal(shape)
