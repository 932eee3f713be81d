"""Reed-Solomon codes over bytes, many code words at once.

The code is the common one (field 0x11D, generator 2, first consecutive root 0), so code words are those of other
libraries. Those work on one word at a time, some milliseconds each; a body is hundreds of words, and here each step
is done for all of them. With r bytes of parity, up to r / 2 wrong bytes of a word are corrected.
"""

from __future__ import annotations

from functools import cache, lru_cache

import numpy as np

from common.surface import IntArray
from common.wire.gf256 import ORDER, ByteArray, inverse, multiply, powers

MAX_WORD = 255
"""Bytes of a code word, parity included."""

BATCH = 256
"""Words worked on at once."""

PRODUCTS = 2**18
"""Products made at once: they stay within a core's cache."""


@cache
def _generator(parity: int) -> ByteArray:
    """Coefficients of prod_j (x - 2^j), j < parity, highest power first, without the leading 1."""
    poly = np.ones(1, dtype=np.uint8)
    for j in range(parity):
        poly = np.append(poly, np.uint8(0)) ^ np.append(np.uint8(0), multiply(poly, powers()[j : j + 1]))
    return poly[1:]


def encode(data: ByteArray, parity: int) -> ByteArray:
    """The (words, parity) parity of (words, k) data, k + parity <= 255."""
    generator = _generator(parity)
    remainder = np.zeros((len(data), parity), dtype=np.uint8)
    for column in data.T:
        factor = column ^ remainder[:, 0]
        remainder[:, :-1] = remainder[:, 1:]
        remainder[:, -1] = 0
        remainder ^= multiply(factor[:, None], generator[None, :])
    return remainder


def correct(words: ByteArray, parity: int) -> ByteArray:
    """Corrected copies of (words, n) code words.

    A word with more than parity / 2 wrong bytes is left as it is, or (rarely) becomes another code word: only a
    checksum can tell.
    """
    out = np.empty_like(words)
    for start in range(0, len(words), BATCH):
        batch = slice(start, start + BATCH)
        out[batch] = _correct(words[batch], parity)
    return out


def _correct(words: ByteArray, parity: int) -> ByteArray:
    syndromes = _syndromes(words, parity)
    locator, degree = _berlekamp_massey(syndromes)
    n = words.shape[1]
    # Byte i of a word belongs to x^(n - 1 - i); it is wrong where the locator has the root x^-(n - 1 - i).
    places = range(1 - n, 1)
    roots = powers()[np.asarray(places) % ORDER]
    wrong = _evaluate(locator, places) == 0
    solvable = (degree <= parity // 2) & (np.count_nonzero(wrong, axis=1) == degree)
    # Forney: the error is x * omega(1/x) / locator'(1/x), with omega = syndromes * locator mod x^parity.
    omega = np.zeros_like(syndromes)
    for j in range(locator.shape[1]):
        omega[:, j:] ^= multiply(locator[:, j : j + 1], syndromes[:, : parity - j])
    derivative = locator[:, 1:].copy()
    derivative[:, 1::2] = 0
    numerator = multiply(_evaluate(omega, places), inverse(roots)[None, :])
    errors = multiply(numerator, inverse(_evaluate(derivative, places)))
    return np.where(wrong & solvable[:, None], words ^ errors, words)


def _syndromes(words: ByteArray, parity: int) -> ByteArray:
    """The words as polynomials, at 2^0 .. 2^(parity - 1)."""
    return _evaluate(words[:, ::-1], range(parity))


def _evaluate(polynomials: ByteArray, exponents: range) -> ByteArray:
    """(words, coefficients), lowest power first, at 2 to each of `exponents`."""
    words, terms = polynomials.shape
    table = _powers_of_points(terms, exponents)
    out = np.empty((words, len(exponents)), dtype=np.uint8)
    rows = max(1, PRODUCTS // table.size)
    for start in range(0, words, rows):
        part = slice(start, start + rows)
        out[part] = np.bitwise_xor.reduce(multiply(polynomials[part, :, None], table[None]), axis=1)
    return out


@lru_cache(maxsize=64)
def _powers_of_points(terms: int, exponents: range) -> ByteArray:
    table: ByteArray = powers()[np.outer(np.arange(terms), exponents) % ORDER]
    return table


def _berlekamp_massey(syndromes: ByteArray) -> tuple[ByteArray, IntArray]:
    """The shortest error locator of each word, lowest power first, and its degree (Massey 1969)."""
    words, parity = syndromes.shape
    locator = np.zeros((words, parity + 1), dtype=np.uint8)
    locator[:, 0] = 1
    previous = locator.copy()
    degree = np.zeros(words, dtype=np.int64)
    last = np.ones(words, dtype=np.uint8)
    for step in range(parity):
        previous[:, 1:] = previous[:, :-1].copy()
        previous[:, 0] = 0
        window = syndromes[:, step::-1]
        discrepancy = np.bitwise_xor.reduce(multiply(locator[:, : step + 1], window), axis=1)
        update = locator ^ multiply(multiply(discrepancy, inverse(last))[:, None], previous)
        longer = (discrepancy != 0) & (2 * degree <= step)
        previous = np.where(longer[:, None], locator, previous)
        last = np.where(longer, discrepancy, last)
        degree = np.where(longer, step + 1 - degree, degree)
        locator = update
    return locator, degree
