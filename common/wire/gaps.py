"""The bytes of a body that are no packet: how many they were, and what the inner code can still make of them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable

import numpy as np

from common.surface import BoolArray
from common.wire import inner
from common.wire.inner import Shape
from common.wire.limits import DEFAULT_DATAGRAM, MAX_CORRECTION_WORK

MAX_SHAPES = 3
"""Shapes of coded datagrams tried on a body: the true one has most votes by far; the others allow for look-alikes."""

MAX_GUESSED_PARTS = 8
MAX_WRONG_BITS = 6
"""Wrong bits in the first bytes of what is still taken for a coded datagram: a packet that is not coded has seven."""


class Gaps:
    """The runs of bytes between the intact packets of a body, in order."""

    def __init__(self) -> None:
        self._runs = [bytearray()]
        self._votes: Counter[Shape] = Counter()
        self._leftovers: list[int] = []
        self._work = 0

    def extend(self, data: memoryview) -> None:
        """Bytes that are no packet follow."""
        self._runs[-1] += data

    def end(self) -> None:
        """An intact packet follows."""
        if self._runs[-1]:
            self._runs.append(bytearray())

    def vote(self, datagram: memoryview) -> None:
        """What follows has the framing of a coded datagram, intact or not."""
        shape = inner.shape_of(datagram)
        if shape:
            self._votes[shape] += 1

    def count(self, longest: int) -> int:
        """Packets the bytes were: a run is one, or as many as `longest`, the longest intact packet, goes into it."""
        unit = longest or DEFAULT_DATAGRAM
        return sum(max(1, round(size / unit)) for size in (*self._leftovers, *map(len, self._runs)) if size)

    def correct(self, accept: Callable[[bytes], bool], *, guess: bool) -> None:
        """Find coded datagrams in the runs and correct them, in order; those that `accept` takes are no gap any more.

        The starts are those that are legible, and those that must be there because all coded datagrams are of one
        length and stand end to end: from the beginning of a run on, and back from its end.

        Parameters
        ----------
        accept : callable
            Takes a corrected datagram if it passes its checksum, and says whether it did.
        guess : bool
            Where no start is legible, try whether a run is up to `MAX_GUESSED_PARTS` datagrams of one length whose
            start is only nearly legible. Sensible where the body held no intact packet, as one short message may.
        """
        shapes = [shape for shape, _ in self._votes.most_common(MAX_SHAPES)]
        for run in self._runs:
            taken = np.zeros(len(run), dtype=bool)
            for shape in shapes:
                self._correct_run(run, shape, taken, accept)
            if guess and not taken.any():
                for shape in _guesses(run):
                    self._correct_run(run, shape, taken, accept)
            edges = np.flatnonzero(np.diff(taken, prepend=True, append=True))
            self._leftovers += np.diff(edges)[::2].tolist()
        self._runs = [bytearray()]

    def _correct_run(self, run: bytearray, shape: Shape, taken: BoolArray, accept: Callable[[bytes], bool]) -> None:
        size = shape.size
        cost = inner.correction_work(shape)
        starts = [s for s in _starts(run, shape) if not taken[s : s + size].any()]
        starts = starts[: (MAX_CORRECTION_WORK - self._work) // cost]
        if not starts:
            return
        self._work += cost * len(starts)
        # A datagram that is cut off lost bytes that the code can fill in again.
        padded = np.frombuffer(bytes(run) + bytes(size), dtype=np.uint8)
        datagrams = inner.recover(np.stack([padded[s : s + size] for s in starts]), shape.strength)
        for start, datagram in zip(starts, datagrams, strict=True):
            stop = min(start + size, len(run))
            if not taken[start:stop].any() and accept(datagram.tobytes()):
                taken[start:stop] = True


def _starts(run: bytearray, shape: Shape) -> list[int]:
    length, size = len(run), shape.size
    shortest = size - shape.strength // 2
    starts = set(range(0, length - shortest + 1, size))
    starts.update(range(length % size, length - size + 1, size))
    starts.update(
        match.start()
        for match in re.finditer(re.escape(inner.prefix(shape)), run)
        if match.start() + shortest <= length
    )
    return sorted(starts)


def _guesses(run: bytearray) -> Iterable[Shape]:
    for parts in range(1, MAX_GUESSED_PARTS + 1):
        for shape in inner.shapes_of_size(len(run) // parts) if len(run) % parts == 0 else []:
            prefix = inner.prefix(shape)
            wrong = int.from_bytes(prefix, "big") ^ int.from_bytes(run[: len(prefix)], "big")
            if wrong.bit_count() <= MAX_WRONG_BITS:
                yield shape
