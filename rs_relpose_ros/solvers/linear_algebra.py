"""Small dense factorisations without allocation, for compiled code."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.vectors import cross, dot, Vector

Array = NDArray[np.float64]


@kernel
def lu_factor(A: Array, pivots: NDArray[np.int64]) -> float:
    """LU factorisation of `A` (n, n) in place, with row pivoting; the determinant.

    The diagonal receives the reciprocals of the pivots. A pivot that is exactly zero is replaced
    by a tiny one, as inverse iteration wants it; the determinant is then zero.
    """
    n = A.shape[0]
    determinant = 1.0
    tiny = 0.0
    for i in range(n):
        for j in range(n):
            tiny = max(tiny, abs(A[i, j]))
    tiny = max(1e-18 * tiny, 1e-280)
    for k in range(n):
        pivot = k
        largest = abs(A[k, k])
        for i in range(k + 1, n):
            size = abs(A[i, k])
            if size > largest:
                largest = size
                pivot = i
        pivots[k] = pivot
        if pivot != k:
            for j in range(n):
                swap = A[k, j]
                A[k, j] = A[pivot, j]
                A[pivot, j] = swap
            determinant = -determinant
        determinant *= A[k, k]
        if A[k, k] == 0.0:
            A[k, k] = tiny
        inverse = 1.0 / A[k, k]
        A[k, k] = inverse
        for i in range(k + 1, n):
            factor = A[i, k] * inverse
            A[i, k] = factor
            for j in range(k + 1, n):
                A[i, j] -= factor * A[k, j]
    return determinant


@kernel
def lu_solve(LU: Array, pivots: NDArray[np.int64], b: Array) -> None:
    """Solve ``A x = b`` in place of `b` (n,), with the result of `lu_factor`."""
    n = LU.shape[0]
    for k in range(n):
        swap = b[k]
        b[k] = b[pivots[k]]
        b[pivots[k]] = swap
    for k in range(n):
        total = b[k]
        for j in range(k):
            total -= LU[k, j] * b[j]
        b[k] = total
    for k in range(n - 1, -1, -1):
        total = b[k]
        for j in range(k + 1, n):
            total -= LU[k, j] * b[j]
        b[k] = total * LU[k, k]


@kernel
def lu_solve_transposed(LU: Array, pivots: NDArray[np.int64], b: Array) -> None:
    """Solve ``A^T x = b`` in place of `b` (n,), with the result of `lu_factor`."""
    n = LU.shape[0]
    for k in range(n):
        solved = b[k] * LU[k, k]
        b[k] = solved
        for j in range(k + 1, n):
            b[j] -= LU[k, j] * solved
    for k in range(n - 1, -1, -1):
        solved = b[k]
        for j in range(k):
            b[j] -= LU[k, j] * solved
    for k in range(n - 1, -1, -1):
        swap = b[k]
        b[k] = b[pivots[k]]
        b[pivots[k]] = swap


@kernel
def triangularise(columns: Array, count: int, diagonal: Array, scales: Array) -> None:
    """Householder reflections that make the first `count` columns of a matrix upper triangular.

    Parameters
    ----------
    columns : (n, m) ndarray
        The n columns, m numbers each, one per row of the array. All are reflected in place: entry
        ``[j, i]`` is then R's ``[i, j]`` for ``i < j``; the rest of the first `count` holds the
        reflectors.
    diagonal, scales : (count,) ndarray
        Receive R's diagonal and the scales of the reflectors.
    """
    n, m = columns.shape
    for k in range(count):
        norm2 = 0.0
        for i in range(k, m):
            norm2 += columns[k, i] * columns[k, i]
        if not norm2 > 0.0:
            diagonal[k], scales[k] = 0.0, 0.0
            continue
        alpha = math.sqrt(norm2) if columns[k, k] > 0.0 else -math.sqrt(norm2)
        columns[k, k] += alpha
        diagonal[k] = -alpha
        scales[k] = 1.0 / (alpha * columns[k, k])
        for j in range(k + 1, n):
            reflect(columns[k], scales[k], k, columns[j])


@kernel
def reflect(reflector: Array, scale: float, first: int, vector: Array) -> None:
    """Reflect `vector` (m,) in place; the reflector is zero before element `first`."""
    dot = 0.0
    for i in range(first, vector.shape[0]):
        dot += reflector[i] * vector[i]
    dot *= scale
    for i in range(first, vector.shape[0]):
        vector[i] -= dot * reflector[i]


@kernel
def normalise(v: Array) -> float:
    """Scale `v` (n,) to unit length in place; its former length."""
    largest = 0.0
    for k in range(v.shape[0]):
        largest = max(largest, abs(v[k]))
    if not 0.0 < largest < math.inf:
        return largest
    total = 0.0
    for k in range(v.shape[0]):
        v[k] /= largest
        total += v[k] * v[k]
    total = math.sqrt(total)
    for k in range(v.shape[0]):
        v[k] /= total
    return largest * total


@kernel
def null_direction(rows: Array) -> tuple[Vector, float]:
    """Vector perpendicular to the rows of a matrix (3, 3) of rank 2, and its squared length.

    The longest of the cross products of two rows; zero where all are parallel.
    """
    best, longest = (0.0, 0.0, 0.0), 0.0
    for i in range(3):
        direction = cross(rows[i], rows[(i + 1) % 3])
        length2 = dot(direction, direction)
        if length2 > longest:
            best, longest = direction, length2
    return best, longest


@kernel
def cholesky(matrix: Array, factor: Array) -> bool:
    """Lower Cholesky factor of a symmetric matrix; False unless it is positive definite."""
    n = matrix.shape[0]
    for i in range(n):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            if i == j:
                if not value > 0.0:
                    return False
                factor[i, i] = math.sqrt(value)
            else:
                factor[i, j] = value / factor[j, j]
    return True


@kernel
def newton_step(factor: Array, gradient: Array) -> Array:
    """Solution of ``L L^T x = -gradient`` with the Cholesky factor L."""
    n = gradient.shape[0]
    x = np.empty(n)
    for i in range(n):
        x[i] = -gradient[i]
    for i in range(n):
        for k in range(i):
            x[i] -= factor[i, k] * x[k]
        x[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= factor[k, i] * x[k]
        x[i] /= factor[i, i]
    return x
