"""Cholesky's steps without holding the interpreter.

`scipy.linalg.lapack` and `scipy.linalg.solve_triangular` keep the global interpreter lock while they work (a second for
a matrix of 4,000), and with it every other thread: a service that trains in a thread would stand still. These call the
same routines, through the pointers that `scipy.linalg.cython_lapack` is there to hand out; ctypes gives the lock away.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from scipy.linalg import cython_blas, cython_lapack

from common.surface import FloatArray, IntArray


@cache
def _routine(module: Any, name: str) -> tuple[Callable[..., None], Any]:
    """A Fortran routine, whose arguments are all pointers, and the type of its integers."""
    capsule = module.__pyx_capi__[name]
    name_of = ctypes.pythonapi.PyCapsule_GetName
    name_of.restype, name_of.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer_of = ctypes.pythonapi.PyCapsule_GetPointer
    pointer_of.restype, pointer_of.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    signature = name_of(capsule)
    arguments = signature.partition(b"(")[2].split(b",")
    routine = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * len(arguments))(pointer_of(capsule, signature))
    return routine, ctypes.c_int if b"int *" in signature else ctypes.c_int64


def _call(module: Any, name: str, *arguments: bytes | int | float | FloatArray) -> int:
    """Call a routine; the last of its integers as it left it (LAPACK's info)."""
    routine, integer = _routine(module, name)
    passed: list[Any] = []
    for argument in arguments:
        if isinstance(argument, bytes):
            passed.append(_flag(argument))
        elif isinstance(argument, int):
            passed.append(integer(argument))
        elif isinstance(argument, float):
            passed.append(ctypes.c_double(argument))
        else:
            passed.append(argument)
    routine(*(p.ctypes.data if isinstance(p, np.ndarray) else ctypes.addressof(p) for p in passed))
    last = [p for p in passed if isinstance(p, integer)][-1]
    return int(last.value)


@cache
def _flag(letter: bytes) -> Any:
    return ctypes.create_string_buffer(letter)


def _columns_first(values: FloatArray, out: FloatArray | None = None) -> FloatArray:
    """A Fortran-ordered float64 copy of (n,) or (n, k) values, in `out` where that is given."""
    if out is None:
        return np.array(values, dtype=np.float64, order="F")
    if out.shape != values.shape or out.dtype != np.float64 or not out.flags.f_contiguous:
        raise ValueError(f"room for Fortran-ordered float64 values {values.shape} is needed, got the shape {out.shape}")
    if out is not values:
        np.copyto(out, values)
    return out


def _side(matrix: FloatArray) -> int:
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise ValueError(f"a square matrix is needed, got the shape {matrix.shape}")
    return max(1, len(matrix))


def _right(matrix: FloatArray, right: FloatArray) -> tuple[FloatArray, int]:
    solved = _columns_first(right)
    if solved.ndim not in (1, 2) or len(solved) != len(matrix):
        raise ValueError(f"the right side has the shape {solved.shape}; ({len(matrix)}, k) is needed")
    return solved, 1 if solved.ndim == 1 else solved.shape[1]


def cholesky(matrix: FloatArray, out: FloatArray | None = None) -> FloatArray | None:
    """The factor L of a symmetric matrix (n, n) = L L^T in the lower triangle, the upper one left as it was.

    It stands in `out` (n, n), Fortran-ordered, where that is given. None where the matrix is not positive definite.
    """
    side, factor = _side(matrix), _columns_first(matrix, out)
    failed = _call(cython_lapack, "dpotrf", b"L", len(matrix), factor, side, 0)
    return None if failed else factor


def solve(factor: FloatArray, right: FloatArray) -> FloatArray:
    """(L L^T)^-1 B for a factor of `cholesky` and B (n,) or (n, k)."""
    side, lower = _side(factor), np.asfortranarray(factor)
    solved, columns = _right(factor, right)
    _call(cython_lapack, "dpotrs", b"L", len(factor), columns, lower, side, solved, side, 0)
    return solved


def solve_lower(factor: FloatArray, right: FloatArray, *, transposed: bool = False) -> FloatArray:
    """L^-1 B, or L^-T B, for L in the lower triangle of a matrix (n, n) and B (n,) or (n, k)."""
    side, lower = _side(factor), np.asfortranarray(factor)
    solved, columns = _right(factor, right)
    turn = b"T" if transposed else b"N"
    _call(cython_blas, "dtrsm", b"L", b"L", turn, b"N", len(factor), columns, 1.0, lower, side, solved, side)
    return solved


def inverse_elements(
    factor: FloatArray, rows: IntArray, columns: IntArray, *, in_place: bool = False
) -> tuple[FloatArray, FloatArray]:
    """The diagonal (n,) of (L L^T)^-1 for a factor of `cholesky`, and its elements (p,) at rows and columns (p,).

    They are products of columns of L^-1, which is a third of the work of the whole inverse. Where it is `in_place` it
    stands where the factor did.
    """
    inverted = _columns_first(factor, factor if in_place else None)
    _invert_lower(inverted, _side(factor))
    diagonal = np.empty(len(factor))
    for start in range(0, len(factor), _STRIP):
        stop = min(len(factor), start + _STRIP)
        corner, below = np.tril(inverted[start:stop, start:stop]), inverted[stop:, start:stop]
        diagonal[start:stop] = np.einsum("ij,ij->j", corner, corner) + np.einsum("ij,ij->j", below, below)
    first = np.maximum(rows, columns)
    elements = [inverted[k:, i] @ inverted[k:, j] for k, i, j in zip(first, rows, columns, strict=True)]
    return diagonal, np.array(elements, dtype=np.float64)


def _invert_lower(triangle: FloatArray, side: int) -> None:
    """L^-1 in place of a Fortran-ordered L, a part of a matrix with columns `side` apart; above it all stays.

    The halves are inverted first; what is below them follows by products of matrices, which are faster than LAPACK's
    own inversion.
    """
    n = len(triangle)
    if n <= INVERTED:
        _call(cython_lapack, "dtrtri", b"L", b"N", n, triangle, side, 0)
        return
    half = n // 2
    upper, lower, below = triangle[:half, :half], triangle[half:, half:], triangle[half:, :half]
    _invert_lower(upper, side)
    _invert_lower(lower, side)
    _call(cython_blas, "dtrmm", b"L", b"L", b"N", b"N", n - half, half, -1.0, lower, side, below, side)
    _call(cython_blas, "dtrmm", b"R", b"L", b"N", b"N", n - half, half, 1.0, upper, side, below, side)


def cholesky_each(matrices: FloatArray) -> bool:
    """Factorise symmetric matrices (p, n, n) in place, each from its lower triangle to its factor's.

    For many small matrices: what numpy spends on copies is as much as their factorisation. Rows are what LAPACK takes
    for columns, so a lower triangle is an upper one there. False where a matrix is not positive definite; it and those
    behind it are spoilt then.
    """
    p, n, _ = _rows_first(matrices).shape
    if matrices.shape[2] != n:
        raise ValueError(f"square matrices are needed, got the shape {matrices.shape}")
    routine, integer = _routine(cython_lapack, "dpotf2" if n <= UNBLOCKED else "dpotrf")
    side, order, info = integer(max(1, n)), integer(n), integer(0)
    at = [ctypes.addressof(value) for value in (_flag(b"U"), order, side, info)]
    first = matrices.ctypes.data
    for i in range(p):
        routine(at[0], at[1], first + 8 * i * n * n, at[2], at[3])
        if info.value:
            return False
    return True


def solve_transposed_each(factors: FloatArray, right: FloatArray) -> None:
    """L^-T b in place of every row b of `right` (p, m, n), for L in the first n rows of what `cholesky_each` left."""
    p, m, n = _rows_first(right).shape
    side = _rows_first(factors).shape[2]
    if factors.shape != (p, side, side) or side < n:
        raise ValueError(f"{p} factors of {n} rows or more are needed, got the shape {factors.shape}")
    routine, integer = _routine(cython_blas, "dtrsv")
    flags = [_flag(letter) for letter in (b"U", b"N", b"N")]
    sizes = integer(n), integer(max(1, side)), integer(1)
    at = [ctypes.addressof(value) for value in (*flags, *sizes)]
    first, then = factors.ctypes.data, right.ctypes.data
    for i in range(p * m):
        routine(*at[:4], first + 8 * (i // m) * side * side, at[4], then + 8 * i * n, at[5])


def _rows_first(arrays: FloatArray) -> FloatArray:
    if arrays.ndim != 3 or arrays.dtype != np.float64 or not arrays.flags.c_contiguous:
        raise ValueError(f"a C-ordered stack of float64 matrices is needed, got the shape {arrays.shape}")
    return arrays


UNBLOCKED = 112
"""Sides of a matrix up to which the plain factorisation is faster than the one by blocks."""

INVERTED = 64
"""Sides of a triangle up to which LAPACK inverts it."""

_STRIP = 128
"""Columns of a triangle whose lengths are taken together."""
