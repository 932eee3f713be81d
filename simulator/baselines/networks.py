"""The networks that the paper and its references compare; same arguments as in `interpolation`.

The RBF networks here have the paper's rule for the spread, twice the distance between neighbouring centres, and no
smoothing: least squares decides the coefficients.
"""

from __future__ import annotations

import warnings

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.linalg import lstsq

from common.network.evaluation import evaluate_grid
from common.network.kernel import chunks, nearest_distance, squared_distances
from common.surface import FloatArray
from simulator.baselines.interpolation import nodes

POINTS_A_CENTER = 2
"""Points behind each centre of the networks that have fewer centres than points."""

EXACT_LIMIT = 2500
"""Centres of the network that has them all; of more points, a random sample this large are centres."""

GRNN_SPREADS = np.logspace(-1, 1.5, 26)
"""Candidates for the spread of the generalised regression network, over the distance between neighbours."""

GRNN_LIMIT = 1500
"""Points that judge the spread by leaving one out; of more, a random sample this large."""

HIDDEN = (20, 20)
"""Neurons of the back-propagation network's hidden layers."""


def _fitted(points: FloatArray, centers: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    spread = 2 * nearest_distance(centers) or 1.0
    mean = points[:, 2].mean()
    kernel = np.exp(-0.5 * squared_distances(points[:, :2], centers) / spread**2)
    coefficients = lstsq(kernel, points[:, 2] - mean)[0]
    return np.asarray(evaluate_grid(x, y, centers, np.array([spread]), coefficients[None, :, None])[:, :, 0] + mean)


def _count(points: FloatArray) -> int:
    return min(EXACT_LIMIT, max(1, len(points) // POINTS_A_CENTER))


def kmeans_centers(points: FloatArray, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Half as many centres as points, at the means of clusters; draws the first means."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="One of the clusters is empty")  # one centre less
        means, labels = kmeans2(points[:, :2], _count(points), minit="++", rng=rng)
    return _fitted(points, np.asarray(means)[np.unique(labels)], x, y)


def random_centers(points: FloatArray, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Half as many centres as points, drawn from them."""
    return _fitted(points, rng.permutation(points[:, :2])[: _count(points)], x, y)


def every_center(points: FloatArray, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Every point a centre, as far as `EXACT_LIMIT` goes; draws only beyond it."""
    centers = points[:, :2] if len(points) <= EXACT_LIMIT else rng.permutation(points[:, :2])[:EXACT_LIMIT]
    return _fitted(points, centers, x, y)


def _regression(r2: FloatArray, heights: FloatArray, spread: float) -> FloatArray:
    # The nearest point has weight 1, so far from all points the sum of weights does not vanish.
    weights = np.exp(-0.5 * (r2 - r2.min(axis=1, keepdims=True)) / spread**2)
    return np.asarray(weights @ heights / weights.sum(axis=1))


def grnn(points: FloatArray, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Mean of the heights weighted by a Gaussian of the distance, spread by leaving one out; draws a sample of many."""
    sample = points if len(points) <= GRNN_LIMIT else rng.permutation(points)[:GRNN_LIMIT]
    r2 = squared_distances(sample[:, :2])
    np.fill_diagonal(r2, np.inf)
    # A sample is sparser than the points; its best spread is too wide by the ratio of the distances.
    ratio = nearest_distance(points[:, :2]) / nearest_distance(sample[:, :2])
    candidates = GRNN_SPREADS * nearest_distance(sample[:, :2])
    errors = [np.mean((_regression(r2, sample[:, 2], spread) - sample[:, 2]) ** 2) for spread in candidates]
    spread = float(candidates[int(np.argmin(errors))]) * ratio
    at = nodes(x, y)
    grid = np.empty(len(at))
    for part in chunks(len(at), len(points)):
        grid[part] = _regression(squared_distances(at[part], points[:, :2]), points[:, 2], spread)
    return grid.reshape(len(y), len(x))


def back_propagation(points: FloatArray, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Two hidden layers of tanh neurons, trained by L-BFGS; draws the first weights."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.neural_network import MLPRegressor

    center, unit = points.mean(axis=0), points.std(axis=0)
    scaled = (points - center) / np.where(unit > 0, unit, 1.0)
    network = MLPRegressor(
        hidden_layer_sizes=HIDDEN,
        activation="tanh",
        solver="lbfgs",
        max_iter=1000,
        max_fun=3000,
        random_state=int(rng.integers(2**31)),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # the cap on iterations is part of the method
        network.fit(scaled[:, :2], scaled[:, 2])
    at = (nodes(x, y) - center[:2]) / unit[:2]
    return np.asarray((network.predict(at) * unit[2] + center[2]).reshape(len(y), len(x)))
