"""The extrema of the pieces of a raster, and the network that is trained on them."""

from __future__ import annotations

import numpy as np
import pytest

from common.metrics import nrmse
from common.network import RBFNetwork
from sender.features import extract_features
from sender.surfaces import SURFACES


@pytest.mark.parametrize(("pieces", "most"), [(4, 0.04), (8, 0.0012)])
def test_pairs_on_either_side_of_a_border_do_not_pass_a_smooth_surface_for_a_rough_one(
    pieces: int, most: float
) -> None:
    surface = SURFACES["surface-2"]
    raster = surface.grid((256, 256))
    gap = (surface.region.x_max - surface.region.x_min) / pieces
    points = np.array(extract_features(raster.points(), gap=gap, region=surface.region).points)
    step = np.ptp(raster.z) / 1023
    network = RBFNetwork().fit(points[:, :2], step * np.round(points[:, 2] / step))
    assert nrmse(raster.z, network.predict_grid(raster.x, raster.y)) < most
