"""The demo's pictures: they explain what is in them, and only that."""

from __future__ import annotations

import numpy as np
import pytest

from sender.surfaces import SURFACES
from simulator.demo import Arrived, Exhibit
from simulator.pictures import exhibit_picture


@pytest.mark.parametrize(("points", "marked"), [(50, True), (900, False)])
def test_centres_are_explained_where_they_are_drawn(points: int, marked: bool) -> None:
    surface = SURFACES["surface-1"]
    truth = surface.grid((8, 9))
    features = surface.sample(np.random.default_rng(0), points)
    arrived = Arrived(
        channel="clean",
        features=features,
        centers=features[:, :2],
        grid=truth,
        linear=truth.z,
        cubic=truth.z,
        sent_bytes=300,
        seconds=1.0,
        id="a",
    )
    figure = exhibit_picture(Exhibit(surface, truth, arrived, arrived))
    assert ("rings" in figure.get_supxlabel()) is marked
    title = figure.axes[1].get_title(loc="center")
    assert ("centres" in title) is marked
    assert len(figure.axes[1].collections) == (2 if marked else 1) + len(figure.axes[0].collections)
