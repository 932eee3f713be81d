"""A constant error of coordinates."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from common.channel.impairment import STRENGTH_MAX, PointImpairment
from common.surface import FloatArray


class Bias(PointImpairment):
    """c' = c + offset: a datum that is off, the same for every point. Nothing is drawn."""

    kind: Literal["bias"] = "bias"
    offset: float | None = Field(None, ge=-STRENGTH_MAX, le=STRENGTH_MAX, description="what is added, data units")
    relative: float | None = Field(None, ge=-1e6, le=1e6, description="what is added over the range of the axis")

    in_data_units: ClassVar[str] = "offset"

    def draw(self, shape: tuple[int, int], rng: np.random.Generator) -> FloatArray:  # noqa: ARG002 - nothing is drawn
        """Ones."""
        return np.ones(shape)
