"""Rows of a campaign by what they have in common, and medians and bands over their samples."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from simulator.runner import Cell, Row


@dataclass(frozen=True)
class Quartiles:
    """Median and quartiles over samples. A failure counts as infinitely bad, so it can be the median itself."""

    median: float
    low: float
    high: float
    count: int
    failed: int

    @classmethod
    def of(cls, values: Sequence[Cell]) -> Quartiles:
        """Of numbers; None is a failure."""
        numbers = np.array([np.inf if value is None else float(value) for value in values])
        # "nearest" orders by rank: infinities are never subtracted from each other.
        low, high = np.quantile(numbers, [0.25, 0.75], method="nearest")
        ordered = np.sort(numbers)
        below, above = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
        median = above if np.isinf(above) else (below + above) / 2
        return cls(float(median), float(low), float(high), len(numbers), int(np.isinf(numbers).sum()))


Item = TypeVar("Item")
Key = TypeVar("Key", bound=Hashable)


def group(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """The items by key, both in order of appearance."""
    groups: dict[Key, list[Item]] = defaultdict(list)
    for item in items:
        groups[key(item)].append(item)
    return dict(groups)


def text(row: Row, column: str) -> str:
    """A value as text, "" where it does not apply."""
    value = row[column]
    return "" if value is None else str(value)


def number(row: Row, column: str) -> float:
    """A value as a number, NaN where it does not apply."""
    value = row[column]
    return math.nan if value is None else float(value)
