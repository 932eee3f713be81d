from __future__ import annotations

import ctypes

import numpy as np
import pytest
import scipy.linalg
from scipy.linalg import cython_blas, cython_lapack

from common.network import lapack


def positive(n: int) -> np.ndarray:
    half = np.random.default_rng(n).normal(size=(n, n))
    return np.asarray(half @ half.T + n * np.eye(n))


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("n", [0, 1, 2, 7, 90, 300])
def test_the_four_steps_are_scipy_s(n: int, order: str) -> None:
    matrix = np.array(positive(n), order=order)  # type: ignore[call-overload]
    before = matrix.copy()
    factor = lapack.cholesky(matrix)
    assert factor is not None
    np.testing.assert_array_equal(matrix, before)
    np.testing.assert_allclose(np.tril(factor), np.linalg.cholesky(matrix), rtol=1e-12, atol=1e-12)
    kept = factor.copy()
    for shape in ((n,), (n, 3), (n, 0)):
        right = np.random.default_rng(1).normal(size=shape)
        np.testing.assert_allclose(matrix @ lapack.solve(factor, right), right, atol=1e-10)
        np.testing.assert_allclose(np.tril(factor) @ lapack.solve_lower(factor, right), right, atol=1e-10)
        turned = lapack.solve_lower(factor, right, transposed=True)
        np.testing.assert_allclose(np.tril(factor).T @ turned, right, atol=1e-10)
    inverse, rows, columns = np.linalg.inv(matrix), np.arange(min(n, 2)), np.arange(n)[::-1][:2]
    diagonal, elements = lapack.inverse_elements(factor, rows, columns)
    np.testing.assert_allclose(diagonal, np.diag(inverse), rtol=1e-10)
    np.testing.assert_allclose(elements, inverse[rows, columns], rtol=1e-8, atol=1e-12)
    np.testing.assert_array_equal(factor, kept)
    room = np.empty((n, n)).T
    assert lapack.cholesky(matrix, room) is room
    np.testing.assert_array_equal(room, factor)
    np.testing.assert_array_equal(lapack.inverse_elements(room, rows, columns, in_place=True)[0], diagonal)
    np.testing.assert_allclose(np.tril(room) @ np.tril(factor), np.eye(n), atol=1e-10)
    with pytest.raises(ValueError, match="room"):
        lapack.cholesky(matrix, np.empty((n + 1, n)))


def test_the_same_bits_as_scipy() -> None:
    matrix = positive(40)
    expected, _ = scipy.linalg.lapack.dpotrf(matrix, lower=1, clean=0)
    factor = lapack.cholesky(matrix)
    assert factor is not None
    np.testing.assert_array_equal(factor, expected)


@pytest.mark.parametrize("n", [0, 1, 5, 60, lapack.UNBLOCKED + 1])
def test_many_small_matrices_in_place(n: int) -> None:
    matrices = np.stack([(i + 1) * positive(n) for i in range(3)])
    right = np.random.default_rng(0).normal(size=(3, 2, n))
    factors, solved = matrices.copy(), right.copy()
    assert lapack.cholesky_each(factors)
    lapack.solve_transposed_each(factors, solved)
    for i in range(3):
        np.testing.assert_allclose(np.tril(factors[i]), np.linalg.cholesky(matrices[i]), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(solved[i] @ np.tril(factors[i]), right[i], atol=1e-10)
    with pytest.raises(ValueError, match="stack"):
        lapack.cholesky_each(np.zeros((2, 4, 4)).transpose(0, 2, 1))
    with pytest.raises(ValueError, match="factors"):
        lapack.solve_transposed_each(factors, np.zeros((3, 2, n + 1)))


def test_the_first_rows_of_a_factor_are_a_factor() -> None:
    matrices = np.stack([positive(8), positive(8)])
    right = np.random.default_rng(0).normal(size=(2, 1, 6))
    factors, solved = matrices.copy(), right.copy()
    assert lapack.cholesky_each(factors)
    lapack.solve_transposed_each(factors, solved)
    expected = np.linalg.solve(np.linalg.cholesky(matrices[0, :6, :6]).T, right[0, 0])
    np.testing.assert_allclose(solved[0, 0], expected, atol=1e-12)


def test_a_stack_with_one_indefinite_matrix_has_no_factors() -> None:
    assert not lapack.cholesky_each(np.stack([np.eye(2), np.diag([1.0, -1.0])]))


def test_what_is_not_positive_definite_has_no_factor() -> None:
    assert lapack.cholesky(np.diag([1.0, -1.0])) is None
    assert lapack.cholesky(np.zeros((3, 3))) is None


@pytest.mark.parametrize("right", [np.zeros(3), np.zeros((3, 1)), np.zeros((4, 1, 1)), np.float64(0)])
def test_shapes_are_checked_before_memory_is_touched(right: np.ndarray) -> None:
    for step in (lapack.solve, lapack.solve_lower):
        with pytest.raises(ValueError, match="right side"):
            step(np.eye(4), right)
    nowhere = np.zeros(0, dtype=np.int64)
    for only in (lapack.cholesky, lambda matrix: lapack.inverse_elements(matrix, nowhere, nowhere)):
        with pytest.raises(ValueError, match="square"):
            only(np.zeros((4, 3)))


def test_the_interpreter_is_given_away_during_the_call() -> None:
    for module, name in ((cython_lapack, "dpotrf"), (cython_lapack, "dtrtri"), (cython_blas, "dtrsm")):
        routine, _ = lapack._routine(module, name)
        # What keeps the lock is made by PYFUNCTYPE, whose functions bear this flag.
        assert not type(routine)._flags_ & ctypes.PYFUNCTYPE(None)._flags_ & ~ctypes.CFUNCTYPE(None)._flags_  # type: ignore[attr-defined]
