"""Which points of a cloud a campaign sends: the paper's features or others, of a given size or in given bytes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from common.errors import ParameterError
from common.surface import FeatureSet, FloatArray, Region
from common.wire import WireOptions, encode
from sender.features import Extracted, extract_features, lattice, linear_heights, merge_repeated, suitable_gap
from simulator.campaign import FeatureSettings

AHEAD = 4
"""Pieces a side beyond the finest that a bisection finds to fit, which are tried, too.

A gap of few digits takes up to 8 bytes less in every packet, so in short datagrams finer pieces may take fewer bytes.
"""


def choose_features(
    cloud: FloatArray, region: Region, settings: FeatureSettings, wire: WireOptions, usual_gap: float | None
) -> FeatureSet:
    """The features of a cloud as a campaign asks for them.

    Parameters
    ----------
    cloud : ndarray, shape (n, 3)
    region : Region
    settings : FeatureSettings
    wire : WireOptions
        What a budget is counted with.
    usual_gap : float or None
        The gap where the settings give no size; None for `suitable_gap`.

    Raises
    ------
    ParameterError
        If nothing fits into the budget.
    """
    longer = max(region.width, region.height)
    extract = _extraction(cloud, region, settings.kind)
    if settings.budget is not None:
        return _finest(lambda pieces: extract(longer / pieces), len(cloud), settings.budget, wire)
    return extract(longer / settings.pieces if settings.pieces is not None else settings.gap or usual_gap)


def _extraction(cloud: FloatArray, region: Region, kind: Extracted) -> Callable[[float | None], FeatureSet]:
    """What gives the features of a cloud for a gap, or for a `suitable_gap`."""
    if kind != "lattice":
        return lambda gap: extract_features(cloud, gap=gap, kind=kind, region=region)
    # Triangulated once; a budget tries several lattices.
    points = merge_repeated(cloud)
    heights = linear_heights(points, region)
    return lambda gap: lattice(heights, gap or suitable_gap(points, region), region)


def _finest(extract: Callable[[int], FeatureSet], points: int, budget: int, wire: WireOptions) -> FeatureSet:
    """The features of the most pieces along the longer side whose packets fit into `budget` bytes."""

    def fits(pieces: int) -> bool:
        packets = encode(extract(pieces), transmission="budget", options=wire)
        return sum(map(len, packets)) <= budget

    # Beyond two pieces a point along each side every point is a feature, and more pieces change nothing.
    most = 2 * int(np.ceil(np.sqrt(points)))
    low, high = 0, most + 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    if not low:
        raise ParameterError(f"not even the features of a single piece fit into {budget} bytes")
    ahead = range(min(low + AHEAD, most), low, -1)
    return extract(next(filter(fits, ahead), low))
