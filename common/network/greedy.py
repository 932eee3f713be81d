"""Greedy choice of centres by a Newton basis.

The paper's rule: start from a subset of the points, evaluate the error at all of them, add a centre where it is
largest, stop when it is below the tolerance. The Newton basis (Mueller and Schaback 2009, "A Newton basis for kernel
spaces") makes a new centre cost one kernel column and one product with the functions so far, with no refit: with
P^2(x) = K(x, x) - sum_j v_j(x)^2 the squared power function, the next function is

    v_k(x) = (K(x, x_k) - sum_{j<k} v_j(x_k) v_j(x)) / P(x_k)

The error is that of the regularised fit of *all* points to the centres so far, min |y - K c|^2 + lambda c' K_cc c. In
the Newton basis the penalty is the squared norm of the coefficients, so an orthonormal basis of the columns
(v_k; sqrt(lambda) e_k) updates the residual by one projection. Among the points of largest error the one is taken whose
column lowers the sum of squares most, as in orthogonal least squares (Chen, Cowan and Grant 1991), which needs fewer
centres than the largest error alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from common.errors import ParameterError
from common.network import lapack
from common.network.threads import single_threaded_blas
from common.surface import FloatArray, IntArray

Gram: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]
"""K(A, B) of shape (len(A), len(B)), symmetric and positive definite, with a constant diagonal."""

StopReason: TypeAlias = Literal["tolerance", "max_centers", "rounding", "every point is a centre", "memory"]

SHORTLIST = 16
"""Points of largest error among which the gain decides. One is the plain rule; 64 saved no more centres than 16."""

SHORTLIST_POINTS = 4096
"""Up to as many points the shortlist is affordable in every round; above, centres come in blocks."""

BLOCK = 16
"""Centres a round above `SHORTLIST_POINTS`: the basis is read from memory once a round."""

POOL = 8
"""Points of largest error that a block looks at, for each centre it adds."""

MEMORY = 2 << 30
"""Bytes that the two bases may take together."""


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """The chosen centres and the fit of all points to them.

    Attributes
    ----------
    indices : ndarray of int, shape (m,)
        Rows of X, in the order in which they were chosen; none twice.
    coefficients : ndarray, shape (m, k)
        Of K(x, x_i), in the order of `indices`.
    history : ndarray, shape (rounds + 1,)
        Greatest absolute error at the points: before the first centre and after each round.
    stop_reason : str
        "tolerance", "max_centers", "rounding" (no further column can be told from rounding), "every point is a centre"
        or "memory" (`max_centers` was left open and the memory budget ended the choice).
    """

    indices: IntArray
    coefficients: FloatArray
    history: FloatArray
    stop_reason: StopReason


def select(
    X: FloatArray,
    y: FloatArray,
    kernel: Gram,
    *,
    smoothing: float = 0.0,
    weights: FloatArray | None = None,
    tolerance: float = 0.0,
    max_centers: int | None = None,
    initial: IntArray | None = None,
    block: int | None = None,
    memory: int = MEMORY,
    tick: Callable[[float], None] | None = None,
) -> Selection:
    """Choose centres among the rows of X until the error at all of them is within the tolerance.

    Parameters
    ----------
    X : ndarray, shape (n, d)
        Distinct positions.
    y : ndarray, shape (n, k)
        Values, without their mean.
    kernel : callable
        ``kernel(A, B)`` is the kernel matrix, shape (len(A), len(B)).
    smoothing : float
        lambda >= 0 of the fit; 0 is least squares, and interpolation once every point is a centre.
    weights : ndarray, shape (n,), optional
        Samples behind each value.
    tolerance : float
        Greatest absolute error at the points, in the units of y.
    max_centers : int, optional
        Most centres; n where it is left out.
    initial : ndarray of int, optional
        Rows of X taken before the error is asked.
    block : int, optional
        Centres a round; 1 up to `SHORTLIST_POINTS` points and `BLOCK` above where it is left out.
    memory : int
        Bytes that the bases may take.
    tick : callable, optional
        ``tick(fraction)`` after every round.

    Raises
    ------
    ParameterError
        If `block`, `initial` or `max_centers` cannot be met, by the number of points or by the memory.
    """
    n = len(X)
    if block is not None and block < 1:
        raise ParameterError(f"block must be at least 1, got {block}")
    limit = n if max_centers is None else min(n, max_centers)
    if limit < 1:
        raise ParameterError(f"max_centers must be at least 1, got {max_centers}")
    affordable = max(1, memory // (2 * 8 * n))
    if max_centers is not None and limit > affordable:
        raise ParameterError(
            f"{limit} centres of {n} points need {16 * n * limit / 2**20:.0f} MiB; the limit is {memory / 2**20:.0f} "
            f"MiB, accepted are at most {affordable} centres"
        )
    first = np.zeros(0, dtype=np.int64) if initial is None else np.asarray(initial, dtype=np.int64).ravel()
    if (
        len(np.unique(first)) != len(first)
        or len(first) > limit
        or (len(first) and not 0 <= first.min() <= first.max() < n)
    ):
        raise ParameterError(f"initial must be at most {limit} different rows of X, of {n}")

    # The products of a round are too small for the threads of BLAS, which cost more time than they save.
    with single_threaded_blas():
        return _select(X, y, kernel, smoothing, weights, tolerance, limit, affordable, first, block, tick)


def _select(
    X: FloatArray,
    y: FloatArray,
    kernel: Gram,
    smoothing: float,
    weights: FloatArray | None,
    tolerance: float,
    limit: int,
    affordable: int,
    first: IntArray,
    block: int | None,
    tick: Callable[[float], None] | None,
) -> Selection:
    n = len(X)
    step = block or (1 if n <= SHORTLIST_POINTS else BLOCK)
    room = min(limit, affordable)
    basis = _Basis(X, y, kernel, smoothing, weights, room)
    history = [basis.error()]
    if len(first):
        for start in range(0, len(first), BLOCK):
            basis.extend(first[start : start + BLOCK])
        history.append(basis.error())
    floor = np.finfo(np.float64).eps * max(history[0], 1e-300)
    while True:
        reason: StopReason
        if history[-1] <= tolerance:
            reason = "tolerance"
        elif basis.count == n:
            reason = "every point is a centre"
        elif basis.count == limit:
            reason = "max_centers"
        elif basis.count == affordable:
            reason = "memory"
        elif history[-1] <= floor or not len(
            rows := basis.propose(min(step, limit - basis.count, affordable - basis.count))
        ):
            reason = "rounding"
        else:
            basis.extend(rows)
            history.append(basis.error())
            if tick is not None:
                tick(basis.count / limit)
            continue
        break
    return Selection(basis.indices(), basis.coefficients(), np.array(history), reason)


class _Basis:
    """The Newton functions at all points, an orthonormal basis of their span, and the residual."""

    def __init__(
        self,
        X: FloatArray,
        y: FloatArray,
        kernel: Gram,
        smoothing: float,
        weights: FloatArray | None,
        limit: int,
    ) -> None:
        n = len(X)
        self.X, self.kernel, self.limit = X, kernel, limit
        self.root = None if weights is None else np.sqrt(weights)
        self.penalty = float(np.sqrt(smoothing))
        self.count = 0
        self.chosen = np.zeros(limit, dtype=np.int64)
        self.free = np.ones(n, dtype=bool)
        self.peak = float(kernel(X[:1], X[:1])[0, 0])
        self.power = np.full(n, self.peak)
        """Squared power function."""
        self.floor = 8 * n**0.5 * float(np.finfo(np.float64).eps) * self.peak
        """Below it the squared power function is rounding."""
        self.newton = np.empty((min(limit, 64), n))
        self.ortho = np.empty((min(limit, 64), n + (limit if self.penalty else 0)))
        self.upper = np.zeros((len(self.newton), len(self.newton)))
        """R of V' = Q' R, V the Newton functions and Q the orthonormal basis."""
        self.residual = np.zeros((self.ortho.shape[1], y.shape[1]))
        self.residual[:n] = y if self.root is None else y * self.root[:, None]
        self.target = self.residual[:n].copy()

    def error(self) -> float:
        """Greatest absolute error at the points."""
        return float(self._errors().max())

    def _errors(self) -> FloatArray:
        errors = np.abs(self.residual[: len(self.X)]).max(axis=1)
        return np.asarray(errors if self.root is None else errors / self.root)

    def indices(self) -> IntArray:
        return self.chosen[: self.count].copy()

    def _columns(self, rows: IntArray) -> FloatArray:
        """K(., x_i) less its part in the Newton functions so far, shape (len(rows), n)."""
        columns = np.ascontiguousarray(self.kernel(self.X[rows], self.X))
        if self.count:
            columns -= self.newton[: self.count, rows].T @ self.newton[: self.count]
        return columns

    def propose(self, step: int) -> IntArray:
        """The next rows, at most `step`; none where no column can be told from rounding."""
        errors = np.where(self.free & (self.power > self.floor), self._errors(), -1.0)
        pool = min(len(errors), SHORTLIST if step == 1 and len(errors) <= SHORTLIST_POINTS else POOL * step)
        rows = np.argpartition(errors, len(errors) - pool)[-pool:]
        rows = rows[np.argsort(-errors[rows], kind="stable")]
        rows = rows[errors[rows] >= 0]
        if len(rows) < 2:
            return rows
        if step == 1 and len(errors) <= SHORTLIST_POINTS:
            return rows[[int(np.argmax(self._gains(rows)))]]
        return rows[self._spaced(rows, step)]

    def _gains(self, rows: IntArray) -> FloatArray:
        """By how much each column would lower the sum of squares."""
        n = len(self.X)
        columns = self.kernel(self.X[rows], self.X)
        if self.root is not None:
            columns = columns * self.root
        explained = columns @ self.ortho[: self.count, :n].T
        whole = np.einsum("ij,ij->i", columns, columns)
        left = whole - np.einsum("ij,ij->i", explained, explained)
        gains = np.square(columns @ self.residual[:n]).sum(axis=1) / np.maximum(left, 1e-13 * whole)
        return np.asarray(np.where(left > 1e-12 * whole, gains, 0.0))

    def _spaced(self, rows: IntArray, step: int) -> IntArray:
        """Positions in `rows` of the largest errors, each taken after interpolating the ones before it in the pool."""
        pool = self.kernel(self.X[rows], self.X[rows])
        if self.count:
            pool = pool - self.newton[: self.count, rows].T @ self.newton[: self.count, rows]
        errors = self.residual[rows] if self.root is None else self.residual[rows] / self.root[rows, None]
        errors = errors.copy()
        taken: list[int] = []
        for _ in range(step):
            power = np.diag(pool)
            score = np.where(power > self.floor, np.abs(errors).max(axis=1), -1.0)
            score[taken] = -1.0
            best = int(np.argmax(score))
            if score[best] < 0:
                break
            taken.append(best)
            share = pool[:, best] / power[best]
            errors = errors - np.outer(share, errors[best])
            pool = pool - np.outer(share, pool[best])
        return np.array(taken, dtype=np.int64)

    def extend(self, rows: IntArray) -> None:
        """Make the rows centres, as far as rounding lets them be told from the others."""
        columns = self._columns(rows)
        start = self.count
        self._reserve(start + len(rows))
        for column, row in zip(columns, rows, strict=True):
            power = self.power[row]
            self.free[row] = False
            if power <= self.floor:
                continue
            new = self.newton[start : self.count]
            function = (column - new[:, row] @ new if len(new) else column) / np.sqrt(power)
            self.newton[self.count] = function
            self.power -= function**2
            np.maximum(self.power, 0.0, out=self.power)
            self.power[row] = 0.0
            self.chosen[self.count] = row
            self.count += 1
        self._project(start)

    def _project(self, start: int) -> None:
        """Orthonormalise the functions from `start` on and take their part off the residual.

        Twice where the first time cancels more than a digit (Giraud, Langou and Rozloznik 2005).
        """
        n = len(self.X)
        fresh = self.ortho[start : self.count]
        fresh[:] = 0.0
        fresh[:, :n] = (
            self.newton[start : self.count] if self.root is None else self.newton[start : self.count] * self.root
        )
        if self.penalty:
            fresh[np.arange(len(fresh)), n + np.arange(start, self.count)] = self.penalty
        old, own = self.ortho[:start], np.eye(len(fresh))
        for _ in range(2):
            before = np.linalg.norm(fresh, axis=1)
            if start:
                shares = fresh @ old.T
                fresh -= shares @ old
                self.upper[:start, start : self.count] += shares.T @ own
            after = np.linalg.norm(fresh, axis=1)
            if len(fresh) == 1:
                length = float(after[0]) or 1.0
                fresh /= length
                own = length * own
            elif len(fresh):
                basis, triangle = np.linalg.qr(fresh.T)
                fresh[:], own = basis.T, triangle @ own
            if np.all(after > 0.1 * before):
                break
        self.upper[start : self.count, start : self.count] = own
        self.residual -= fresh.T @ (fresh @ self.residual)

    def _reserve(self, rows: int) -> None:
        """Room for as many functions; grows by doubling."""
        for name in ("newton", "ortho"):
            held = getattr(self, name)
            if rows > len(held):
                size = min(self.limit, max(rows, 2 * len(held)))
                grown = np.empty((size, held.shape[1]))
                grown[: self.count] = held[: self.count]
                setattr(self, name, grown)
                self.upper = np.pad(self.upper, (0, size - len(self.upper)))

    def coefficients(self) -> FloatArray:
        """Of the kernel at the centres, shape (count, k)."""
        m, n = self.count, len(self.X)
        newton = self.newton[:m]
        triangle = newton[:, self.chosen[:m]].T
        if m == n and not self.penalty:
            right = self.target if self.root is None else self.target / self.root[:, None]
            inner = lapack.solve_lower(triangle, right[self.chosen])
        else:
            inner = lapack.solve_lower(self.upper[:m, :m].T, self.ortho[:m, :n] @ self.target, transposed=True)
        return lapack.solve_lower(triangle, inner, transposed=True)
