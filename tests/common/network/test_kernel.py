"""Sums of Gaussians against each of them alone."""

from __future__ import annotations

import numpy as np
import pytest

from common.network.kernel import ladder_spreads, squared_distances, sum_of_levels, upper_sum_of_levels


@pytest.mark.parametrize("n", [0, 1, 40, 300])
@pytest.mark.parametrize("levels", [1, 12])
def test_levels_add_up_whatever_the_pieces_they_are_taken_in(n: int, levels: int) -> None:
    rng = np.random.default_rng(n)
    r2 = squared_distances(rng.uniform(-1, 1, (n, 2)))
    spreads = ladder_spreads(0.05, 4.0)[:levels]
    amplitudes = rng.random(levels)
    expected = sum(a * np.exp(-0.5 * r2 / s**2) for a, s in zip(amplitudes, spreads, strict=True))
    np.testing.assert_allclose(sum_of_levels(r2, spreads, amplitudes), expected, rtol=1e-12)
    upper = np.full((n, n), np.nan)
    upper_sum_of_levels(r2, spreads, amplitudes, upper)
    np.testing.assert_array_equal(np.triu(upper), np.triu(sum_of_levels(r2, spreads, amplitudes)))


def test_what_is_too_far_away_to_matter_does_not_underflow() -> None:
    with np.errstate(all="raise"):
        values = sum_of_levels(np.array([0.0, 1.0, 1e6]), np.array([0.1]), np.ones(1))
    assert values[0] == 1.0
    assert 0 <= values[2] < 1e-300
