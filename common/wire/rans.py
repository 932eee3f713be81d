"""Entropy coding of many short messages at once: range asymmetric numeral systems (Duda 2013), a lane a message.

A coder takes one symbol of every lane at a time. `Writer` and `Reader` have the same methods, so that a model is
written once and serves both ways: the writer returns the values it is given, the reader those it finds.

A message is its final state, of four bytes or of three if they do, and then words of 16 bits. The state starts at 0
instead of at the usual lower bound, so a message has no overhead but rounding up to bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from common.surface import BoolArray, FloatArray, IntArray

PRECISION = 12
"""Bits of a probability."""

TOTAL = 1 << PRECISION
WORD = 16
_LOWER = 1 << WORD


class Tables(NamedTuple):
    """Probability tables over one alphabet; a table is a row.

    Parameters
    ----------
    frequencies : IntArray, shape (tables, symbols)
        Each row sums up to `TOTAL`; none is 0.
    starts : IntArray, shape (tables, symbols)
        Sums of the frequencies before each symbol.
    symbols : IntArray, shape (tables, TOTAL)
        The symbol of each slot.
    """

    frequencies: IntArray
    starts: IntArray
    symbols: IntArray

    def bits(self) -> FloatArray:
        """Bits that each symbol costs, shape (tables, symbols)."""
        cost: FloatArray = PRECISION - np.log2(self.frequencies)
        return cost


def tables(weights: Sequence[Sequence[int]]) -> Tables:
    """Tables of the given integer weights.

    A frequency is the weight's share of `TOTAL` rounded down, at least 1; the first of the greatest takes what is left.
    """
    rows = []
    for row in weights:
        shares = [max(1, weight * TOTAL // sum(row)) for weight in row]
        shares[shares.index(max(shares))] += TOTAL - sum(shares)
        rows.append(shares)
    frequencies = np.array(rows, dtype=np.int64)
    symbols = np.array([np.repeat(np.arange(len(row)), row) for row in rows])
    return Tables(frequencies, np.cumsum(frequencies, axis=1) - frequencies, symbols)


class Coder(Protocol):
    """What `Writer` and `Reader` have in common; every array is one value a lane."""

    def symbol(self, model: Tables, table: IntArray, value: IntArray, active: BoolArray) -> IntArray:
        """Code `value` by row `table` of `model` in the lanes that are `active`; 0 in the others."""

    def raw(self, bits: IntArray, value: IntArray, active: BoolArray) -> IntArray:
        """Code the `bits` <= 32 bits of `value`, all equally likely, in the `active` lanes; 0 in the others."""


class Writer:
    """Takes the symbols in the order in which they are read, and writes them last to first."""

    def __init__(self, lanes: int) -> None:
        self._lanes = lanes
        self._steps: list[tuple[IntArray, IntArray, IntArray | int, IntArray]] = []

    def symbol(self, model: Tables, table: IntArray, value: IntArray, active: BoolArray) -> IntArray:
        """See `Coder`."""
        lanes = np.flatnonzero(active)
        row, column = table[lanes], value[lanes]
        self._steps.append((model.frequencies[row, column], model.starts[row, column], PRECISION, lanes))
        return np.where(active, value, 0)

    def raw(self, bits: IntArray, value: IntArray, active: BoolArray) -> IntArray:
        """See `Coder`."""
        lanes = np.flatnonzero(active)
        for low, count in _pieces(bits[lanes]):
            piece = value[lanes] >> low & (np.int64(1) << count) - 1
            self._steps.append((np.ones_like(lanes), piece, count, lanes))
        return np.where(active, value, 0)

    def finish(self) -> list[bytes]:
        """The message of each lane."""
        state = np.zeros(self._lanes, dtype=np.int64)
        emitted: list[tuple[IntArray, IntArray]] = []
        for frequency, start, precision, lanes in reversed(self._steps):
            current = state[lanes]
            full = current >= frequency << (2 * WORD - precision)
            if full.any():
                emitted.append((lanes[full], current[full] & _LOWER - 1))
                current = np.where(full, current >> WORD, current)
            state[lanes] = (current // frequency << precision) + current % frequency + start
        if emitted:
            owner = np.concatenate([lanes for lanes, _ in reversed(emitted)])
            words = np.concatenate([word for _, word in reversed(emitted)])
            order = np.argsort(owner, kind="stable")
            data, ends = words[order].astype(">u2").tobytes(), np.searchsorted(owner[order], np.arange(self._lanes + 1))
        else:
            data, ends = b"", np.zeros(self._lanes + 1, dtype=np.int64)
        return [
            int(state[lane]).to_bytes(3 if state[lane] < 1 << 24 else 4, "big")
            + data[2 * ends[lane] : 2 * ends[lane + 1]]
            for lane in range(self._lanes)
        ]


class Reader:
    """Takes the symbols off messages of at least three bytes."""

    def __init__(self, messages: Sequence[bytes]) -> None:
        heads = [3 + (len(message) + 1) % 2 for message in messages]
        self._state = np.array(
            [int.from_bytes(message[:head], "big") for message, head in zip(messages, heads, strict=True)],
            dtype=np.int64,
        )
        words = [np.frombuffer(message[head:], dtype=">u2") for message, head in zip(messages, heads, strict=True)]
        self._left = np.array([len(row) for row in words], dtype=np.int64)
        self._next = np.cumsum(self._left) - self._left
        self._words = np.concatenate([*words, np.zeros(1, dtype=">u2")]).astype(np.int64)

    def symbol(self, model: Tables, table: IntArray, value: IntArray, active: BoolArray) -> IntArray:  # noqa: ARG002
        """See `Coder`; `value` is not looked at."""
        lanes = np.flatnonzero(active)
        slot, row = self._state[lanes] & TOTAL - 1, table[lanes]
        found = model.symbols[row, slot]
        self._advance(lanes, model.frequencies[row, found], slot - model.starts[row, found], PRECISION)
        out = np.zeros(len(active), dtype=np.int64)
        out[lanes] = found
        return out

    def raw(self, bits: IntArray, value: IntArray, active: BoolArray) -> IntArray:  # noqa: ARG002
        """See `Coder`; `value` is not looked at."""
        lanes = np.flatnonzero(active)
        out = np.zeros(len(active), dtype=np.int64)
        for low, count in _pieces(bits[lanes]):
            out[lanes] |= (self._state[lanes] & (np.int64(1) << count) - 1) << low
            self._advance(lanes, np.int64(1), np.int64(0), count)
        return out

    def finished(self) -> BoolArray:
        """Whether each message was read to its end, as a message is that `Writer` wrote."""
        finished: BoolArray = (self._state == 0) & (self._left == 0)
        return finished

    def _advance(
        self, lanes: IntArray, frequency: IntArray | np.int64, rest: IntArray | np.int64, precision: IntArray | int
    ) -> None:
        state = frequency * (self._state[lanes] >> precision) + rest
        low = (state < _LOWER) & (self._left[lanes] > 0)
        hungry = lanes[low]
        state[low] = state[low] << WORD | self._words[self._next[hungry]]
        self._next[hungry] += 1
        self._left[hungry] -= 1
        self._state[lanes] = state


def _pieces(bits: IntArray) -> list[tuple[int, IntArray]]:
    """How raw bits are cut so that each piece fits a word: the position of its lowest bit, and its bits."""
    whole = [(0, np.minimum(bits, WORD))]
    return [(WORD, np.maximum(bits - WORD, 0)), *whole] if np.any(bits > WORD) else whole
