"""Bits to symbols, symbols through a channel, symbols to bits: at complex baseband, with Eb = 1.

BPSK carries a bit a symbol, QPSK two (Gray coded), so at equal Eb / N0 both have the same bit-error rate. The receiver
knows the gain of the channel (coherent detection) and decides each bit by the sign of its component.

Source: Proakis and Salehi, "Digital Communications", 5th edition, sections 4.3 and 13.3.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

ComplexArray: TypeAlias = npt.NDArray[np.complex64]
Bits: TypeAlias = npt.NDArray[np.uint8]

Modulation: TypeAlias = Literal["bpsk", "qpsk"]
BLOCK = 2**16
"""Bytes worked on at once, about the longest packet: bounds the memory, as each bit of them takes a few numbers."""

BITS_PER_SYMBOL: dict[Modulation, int] = {"bpsk": 1, "qpsk": 2}


def symbols_of(modulation: Modulation, data: bytes) -> ComplexArray:
    """The symbols that carry `data`, shape (8 * len(data) / bits a symbol,), most significant bit first."""
    antipodal = np.float32(1) - np.float32(2) * np.unpackbits(np.frombuffer(data, dtype=np.uint8))
    symbols: ComplexArray = antipodal.astype(np.complex64) if modulation == "bpsk" else antipodal.view(np.complex64)
    return symbols


def detect(modulation: Modulation, received: ComplexArray, gains: ComplexArray) -> Bits:
    """The bits, 0 or 1, that the receiver decides for, given the gain of each symbol, or one of all."""
    aligned = received * gains.conj()
    components = aligned.real if modulation == "bpsk" else aligned.view(np.float32)
    return (components < 0).astype(np.uint8)


def complex_normal(rng: np.random.Generator, count: int, variance: float) -> ComplexArray:
    """`count` circular complex normal values whose squared magnitude has the mean `variance`."""
    values: ComplexArray = rng.standard_normal(2 * count, dtype=np.float32).view(np.complex64)
    return values * np.float32(math.sqrt(variance / 2))


def blocks_of(data: bytes) -> list[bytes]:
    """`data` in pieces of `BLOCK` bytes."""
    return [data[start : start + BLOCK] for start in range(0, len(data), BLOCK)]


def block_fading(
    modulation: Modulation, data: bytes, coherence: int, rng: np.random.Generator
) -> Iterator[ComplexArray]:
    """The gain of each symbol, afresh after every `coherence` symbols, for each of the blocks of `data`."""
    drawn, start = np.empty(0, dtype=np.complex64), 0
    for block in blocks_of(data):
        symbols = np.arange(start, start + symbol_count(modulation, block))
        # The last gain may reach into the next block.
        first, known = start // coherence, -(-start // coherence)
        fresh = complex_normal(rng, int(symbols[-1]) // coherence + 1 - known, variance=1.0)
        drawn = np.concatenate([drawn[len(drawn) - (known - first) :], fresh])
        yield drawn[symbols // coherence - first]
        start += len(symbols)


def transmit(
    modulation: Modulation, data: bytes, gains: Iterable[ComplexArray], ebn0_db: float, rng: np.random.Generator
) -> tuple[bytes, int]:
    """`data` as it is received over r = gain * s + n, and the number of wrong bits.

    `gains` has, for each of the blocks of `data`, one value a symbol, or one for all, with a mean squared magnitude of
    1, so that `ebn0_db` is the mean ratio of the energy of a bit to the noise density N0; the noise has the variance
    N0 / 2 in each of its components.
    """
    received = []
    for block, gain in zip(blocks_of(data), gains, strict=False):
        symbols = symbols_of(modulation, block)
        noise = complex_normal(rng, len(symbols), variance=10 ** (-ebn0_db / 10))
        received.append(np.packbits(detect(modulation, gain * symbols + noise, gain)).tobytes())
    harmed = b"".join(received)
    return (data, 0) if harmed == data else (harmed, count_differing_bits(data, harmed))


def symbol_count(modulation: Modulation, data: bytes) -> int:
    """Symbols that carry `data`."""
    return 8 * len(data) // BITS_PER_SYMBOL[modulation]


def count_differing_bits(a: bytes, b: bytes) -> int:
    """Bits in which two strings of one length differ."""
    different = np.frombuffer(a, dtype=np.uint8) ^ np.frombuffer(b, dtype=np.uint8)
    return int(np.bitwise_count(different).sum())
