"""Surfaces over [-2, 2]^2 that the networks are tried on: positions (n, 2) to values (n,)."""

from __future__ import annotations

import numpy as np

from common.surface import FloatArray


def sine(X: FloatArray) -> FloatArray:
    return np.asarray(np.sin(2 * X[:, 0]) + np.sin(2 * X[:, 1]))


def bowl(X: FloatArray) -> FloatArray:
    return np.asarray(-5 / (1 + np.square(X).sum(axis=1)))


def rough(X: FloatArray, finest: float = 0.25, count: int = 40) -> FloatArray:
    """Waves of so many lengths from 4 down to the finest, each as steep as the others."""
    rng = np.random.default_rng(7)
    waves = rng.normal(size=(count, 2))
    waves *= (2 * np.pi / np.geomspace(4, finest, count) / np.linalg.norm(waves, axis=1))[:, None]
    phases = rng.uniform(0, 6, count)
    return np.asarray((np.sin(X @ waves.T + phases) / np.linalg.norm(waves, axis=1)).sum(axis=1))


def scattered(n: int, seed: int = 0) -> FloatArray:
    """Positions that are drawn evenly."""
    return np.random.default_rng(seed).uniform(-2, 2, (n, 2))
