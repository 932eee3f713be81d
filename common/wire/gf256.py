"""Arithmetic in the field of 256 elements, on arrays of bytes; what both codes of the wire stand on.

The field is GF(2)[x] / (x^8 + x^4 + x^3 + x^2 + 1), 0x11D, in which x is primitive: the one of RAID 6, QR codes and
most Reed-Solomon libraries. Addition is exclusive or.
"""

from __future__ import annotations

from functools import cache
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from common.surface import IntArray

ByteArray: TypeAlias = npt.NDArray[np.uint8]

POLYNOMIAL = 0x11D
ORDER = 255
"""Non-zero elements; the powers of x repeat after so many."""


@cache
def powers() -> ByteArray:
    """``powers()[i]`` is x**i for i in 0 .. 509, so that a sum of two logarithms needs no reduction."""
    table = np.zeros(2 * ORDER, dtype=np.uint8)
    value = 1
    for i in range(2 * ORDER):
        table[i] = value
        value <<= 1
        if value > 0xFF:
            value ^= POLYNOMIAL
    table.setflags(write=False)
    return table


@cache
def logarithms() -> IntArray:
    """The inverse of `powers`; the entry of 0 is meaningless."""
    table = np.zeros(256, dtype=np.int64)
    table[powers()[:ORDER]] = np.arange(ORDER)
    table.setflags(write=False)
    return table


@cache
def products() -> ByteArray:
    """The multiplication table: the product of a and b stands at 256 a + b."""
    log = logarithms()
    table = powers()[log[:, None] + log[None, :]].copy()
    table[0, :] = table[:, 0] = 0
    flat: ByteArray = table.ravel()
    flat.setflags(write=False)
    return flat


def multiply(a: ByteArray, b: ByteArray) -> ByteArray:
    """Element by element, with NumPy's broadcasting."""
    # One flat index is a third of the time of two.
    found: ByteArray = products().take(a.astype(np.uint16) << np.uint16(8) | b)
    return found


def inverse(a: npt.NDArray[np.integer]) -> ByteArray:
    """1 / a, element by element; of 0 it is meaningless."""
    found: ByteArray = powers()[(ORDER - logarithms()[a]) % ORDER]
    return found


def combine(matrix: ByteArray, rows: ByteArray) -> ByteArray:
    """The matrix product of (m, k) and (k, length)."""
    out = np.zeros((len(matrix), rows.shape[1]), dtype=np.uint8)
    for coefficients, row in zip(matrix.T, rows, strict=True):
        out ^= multiply(coefficients[:, None], row[None, :])
    return out


def solve(matrix: ByteArray, rows: ByteArray) -> ByteArray:
    """The (k, length) array whose product with the regular (k, k) `matrix` is `rows`."""
    work = np.concatenate([matrix, rows], axis=1)
    size = len(matrix)
    for i in range(size):
        pivot = i + int(np.argmax(work[i:, i] != 0))
        work[[i, pivot]] = work[[pivot, i]]
        work[i] = multiply(inverse(work[i, i : i + 1]), work[i])
        factors = work[:, i].copy()
        factors[i] = 0
        work ^= multiply(factors[:, None], work[i][None, :])
    return work[:, size:]
