"""Packets to send through channels."""

from __future__ import annotations

import numpy as np
import pytest

from common.surface import FeatureSet, FloatArray, Region
from common.wire import WireOptions, encode


@pytest.fixture(scope="session")
def points() -> FloatArray:
    """6,000 points whose heights stand on a datum of 10^4."""
    rng = np.random.default_rng(20)
    xy = rng.uniform(-1, 1, (6000, 2))
    return np.column_stack([xy, 1e4 + np.sin(3 * xy[:, 0]) + 0.5 * xy[:, 1]])


@pytest.fixture(scope="session")
def packets(points: FloatArray) -> list[bytes]:
    """The points in packets of float64."""
    return _encode(points, datagram=1400)


@pytest.fixture(scope="session")
def few_packets(points: FloatArray) -> list[bytes]:
    """300 of the points in short packets."""
    return _encode(points[:300], datagram=256)


def _encode(points: FloatArray, datagram: int) -> list[bytes]:
    features = FeatureSet(points, Region(-1, 1, -1, 1))
    return encode(features, transmission="hills", options=WireOptions(datagram=datagram, precision="float64"))
