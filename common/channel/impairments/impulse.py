"""Impulse noise: a share of wild values."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from common.channel.impairment import STRENGTH_MAX, PointImpairment
from common.surface import FloatArray


class Impulse(PointImpairment):
    """c' = c + b * std * N(0, 1), b = 1 with probability `p`, else 0, independently for each point and axis.

    Bernoulli-Gaussian noise: Ghosh, "Analysis of the effect of impulse noise on multicarrier and single carrier QAM
    systems", IEEE Trans. Communications 44 (2), 1996. Its mean square, which `snr_db` sets, is p * std^2.
    """

    kind: Literal["impulse"] = "impulse"
    p: Annotated[float, Field(gt=0, le=1, description="share of the values that are wild, above 0 to 1")] = 0.05
    std: float | None = Field(None, ge=0, le=STRENGTH_MAX, description="standard deviation of a wild value, data units")

    in_data_units: ClassVar[str] = "std"

    @property
    def power(self) -> float:
        """Mean square: the share of wild values."""
        return self.p

    def draw(self, shape: tuple[int, int], rng: np.random.Generator) -> FloatArray:
        """N(0, 1) with probability p, else 0."""
        return np.where(rng.random(shape) < self.p, rng.standard_normal(shape), 0.0)
