"""Cholesky's four steps without holding the interpreter.

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

from common.surface import FloatArray


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
            passed.append(ctypes.create_string_buffer(argument))
        elif isinstance(argument, int):
            passed.append(integer(argument))
        elif isinstance(argument, float):
            passed.append(ctypes.c_double(argument))
        else:
            passed.append(argument)
    routine(*(p.ctypes.data if isinstance(p, np.ndarray) else ctypes.addressof(p) for p in passed))
    last = [p for p in passed if isinstance(p, integer)][-1]
    return int(last.value)


def _columns_first(values: FloatArray) -> FloatArray:
    """A Fortran-ordered float64 copy of (n,) or (n, k) values."""
    return np.array(values, dtype=np.float64, order="F")


def _side(matrix: FloatArray) -> int:
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise ValueError(f"a square matrix is needed, got the shape {matrix.shape}")
    return max(1, len(matrix))


def _right(matrix: FloatArray, right: FloatArray) -> tuple[FloatArray, int]:
    solved = _columns_first(right)
    if solved.ndim not in (1, 2) or len(solved) != len(matrix):
        raise ValueError(f"the right side has the shape {solved.shape}; ({len(matrix)}, k) is needed")
    return solved, 1 if solved.ndim == 1 else solved.shape[1]


def cholesky(matrix: FloatArray) -> FloatArray | None:
    """The factor L of a symmetric matrix (n, n) = L L^T in the lower triangle, the upper one left as it was.

    None where the matrix is not positive definite.
    """
    side, factor = _side(matrix), _columns_first(matrix)
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


def inverse_diagonal(factor: FloatArray) -> FloatArray:
    """The diagonal (n,) of (L L^T)^-1 for a factor of `cholesky`.

    It is the squared length of each column of L^-1, a third of the work of the whole inverse.
    """
    side, inverted = _side(factor), _columns_first(factor)
    _call(cython_lapack, "dtrtri", b"L", b"N", len(factor), inverted, side, 0)
    diagonal = np.empty(len(factor))
    for start in range(0, len(factor), _STRIP):
        stop = min(len(factor), start + _STRIP)
        corner, below = np.tril(inverted[start:stop, start:stop]), inverted[stop:, start:stop]
        diagonal[start:stop] = np.einsum("ij,ij->j", corner, corner) + np.einsum("ij,ij->j", below, below)
    return diagonal


_STRIP = 128
"""Columns of a triangle whose lengths are taken together."""
