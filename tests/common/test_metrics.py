"""Metrics: exact on small cases, invariant where they should be, strict on what they cannot judge."""

from __future__ import annotations

import doctest

import numpy as np
import pytest

from common import metrics
from common.errors import PointsError


def test_the_formulas_in_the_docstrings_hold() -> None:
    results = doctest.testmod(metrics)
    assert results.attempted >= 4
    assert not results.failed


def test_nrmse_and_psnr_ignore_scale_and_datum() -> None:
    rng = np.random.default_rng(1)
    truth, estimate = rng.normal(size=(2, 30, 20))
    for metric in (metrics.nrmse, metrics.psnr):
        assert metric(1e4 + 7 * truth, 1e4 + 7 * estimate) == pytest.approx(metric(truth, estimate), rel=1e-9)


def test_psnr_of_the_truth_itself_is_infinite() -> None:
    assert metrics.psnr([0.0, 1.0], [0.0, 1.0]) == float("inf")


@pytest.mark.parametrize("metric", [metrics.rmse, metrics.nrmse, metrics.max_error, metrics.psnr])
def test_a_nan_in_the_estimate_is_an_error_not_a_gap(metric: object) -> None:
    with pytest.raises(PointsError, match="estimate"):
        metric([0.0, 1.0], [0.0, np.nan])  # type: ignore[operator]


def test_shapes_that_differ_and_flat_truth_are_refused() -> None:
    with pytest.raises(PointsError, match="one shape"):
        metrics.rmse([0.0, 1.0], [0.0])
    with pytest.raises(PointsError, match="flat"):
        metrics.nrmse([1.0, 1.0], [0.0, 1.0])
