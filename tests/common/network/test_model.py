"""The model of a feature set: the surface's own terms in and out."""

from __future__ import annotations

import json

import numpy as np
import pytest

from common.network.model import NetworkSettings, SurfaceModel
from common.surface import FeatureSet, Region, Units


@pytest.fixture(scope="module")
def features() -> FeatureSet:
    rng = np.random.default_rng(5)
    xy = rng.uniform(-1, 1, (60, 2))
    z = 3 / (1 + np.sum(xy**2, axis=1))
    return FeatureSet(np.column_stack([xy, z]), Region(-1, 1, -1, 1), units=Units("m", "m"))


def test_a_trained_model_gives_heights_in_the_units_of_the_features(features: FeatureSet) -> None:
    model = SurfaceModel.train(features)
    x, y = features.region.axes((21, 31))
    grid = model.grid(x, y)
    truth = 3 / (1 + x[None, :] ** 2 + y[:, None] ** 2)
    assert grid.units == Units("m", "m")
    assert np.sqrt(np.mean((grid.z - truth) ** 2)) < 0.02
    assert model.std(x, y).shape == (21, 31)


def test_the_summary_is_json(features: FeatureSet) -> None:
    summary = SurfaceModel.train(features).summary()
    assert json.loads(json.dumps(summary))["centers"] == len(features)


def test_a_model_outlives_its_state(features: FeatureSet) -> None:
    model = SurfaceModel.train(features)
    again = SurfaceModel.from_state(model.to_state())
    x, y = features.region.axes((5, 6))
    np.testing.assert_array_equal(again.grid(x, y).z, model.grid(x, y).z)
    assert (again.region, again.units, again.summary()) == (model.region, model.units, model.summary())


def test_settings_out_of_bounds_are_refused() -> None:
    with pytest.raises(ValueError, match="greater than or equal to 0"):
        NetworkSettings(tolerance=-1)
