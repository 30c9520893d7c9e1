"""Small dense factorisations, and real roots of polynomials, for compiled code."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import cross, dot, Vector
from rs_relpose_ros.jit import kernel, small_kernel


@kernel
def lu_factor(A: Array, pivots: NDArray[np.int64]) -> float:
    """LU factorisation of `A` (n, n) in place, with row pivoting; the determinant.

    The diagonal receives the reciprocals of the pivots. For inverse iteration, a pivot of exactly
    zero is replaced by a tiny one; the determinant is then zero.
    """
    n = A.shape[0]
    determinant, largest = 1.0, 0.0
    for i in range(n):
        for j in range(n):
            largest = max(largest, abs(A[i, j]))
    tiny = max(1e-18 * largest, 1e-280)
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(A[i, k]) > abs(A[pivot, k]):
                pivot = i
        pivots[k] = pivot
        if pivot != k:
            for j in range(n):
                A[k, j], A[pivot, j] = A[pivot, j], A[k, j]
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
        b[k], b[pivots[k]] = b[pivots[k]], b[k]
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


@small_kernel
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
        b[k], b[pivots[k]] = b[pivots[k]], b[k]


@kernel
def triangularise(columns: Array, count: int, diagonal: Array, scales: Array) -> None:
    """Householder reflections that make the first `count` columns of a matrix upper triangular.

    `columns` (n, m): the n columns of the matrix, one per row of the array, reflected in place.
    Entry ``[j, i]`` is then R's ``[i, j]`` for ``i < j``; the rest of the first `count` rows are
    the reflectors. `diagonal`, `scales` (count,): receive R's diagonal and the reflectors' scales.
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
    """Reflect `vector` (m,) in place; elements of the reflector before `first` are zero."""
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
    """Null vector of a matrix (3, 3) of rank 2, and its squared length.

    The longest of the cross products of two rows; zero if all are parallel.
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


# Real roots of polynomials. The roots of the derivative divide the line into intervals on which
# the polynomial is monotonic, each with at most one root; applied from the linear derivative
# upwards this isolates **all** real roots without a start value and without division by a leading
# coefficient (Yuksel, *High-Performance Polynomial Root Finding for Graphics*, HPG 2022). The line
# is covered as [-1, 1] and, with the coefficients reversed, its outside: values do not overflow.

class PairRule(NamedTuple):
    """Conjugate pairs ``c +- ih`` that count as the real root c.

    Their angle ``2 atan(zoom x)`` has an imaginary part ``2 zoom h / (1 + zoom^2 c^2)`` below
    `tolerance` [rad].
    """

    tolerance: float
    zoom: float


@kernel
def value(p: Array, degree: int, x: float) -> float:
    """Value at `x` of the polynomial with ascending coefficients ``p[:degree + 1]``."""
    y = p[degree]
    for k in range(degree - 1, -1, -1):
        y = y * x + p[k]
    return y


@small_kernel
def _root_between(p: Array, degree: int, low: float, high: float, at_low: float,
                  last_step: float) -> float:
    """Root in a bracket with a monotonic polynomial: Newton's method, bisection outside of it."""
    x = 0.5 * (low + high)
    for _ in range(80):  # bisection alone would need 52
        y = p[degree]
        slope = 0.0
        for k in range(degree - 1, -1, -1):
            slope = slope * x + y
            y = y * x + p[k]
        if y == 0.0:
            return x
        if (y > 0.0) == (at_low > 0.0):
            low = x
        else:
            high = x
        moved = x - y / slope
        if not low <= moved <= high:
            moved = 0.5 * (low + high)
        step = abs(moved - x)
        x = moved
        if step < last_step:
            break
    return x


@small_kernel
def _half_gap2(derivatives: Array, extremum: float, at_extremum: float, rule: PairRule) -> float:
    """``h^2`` of the pair ``extremum +- ih`` of the polynomial in the last row; -1 if not counted.

    Near its extremum c, ``p(x) = p(c) + p''(c) (x - c)^2 / 2``; the row of the second derivative
    is ``p'' / 2``.
    """
    n = derivatives.shape[0] - 1
    h2 = at_extremum / value(derivatives[n - 2], n - 2, extremum)
    limit = 0.5 * rule.tolerance * (1.0 / rule.zoom + rule.zoom * extremum * extremum)
    return h2 if 0.0 <= h2 < limit * limit else -1.0


@small_kernel
def _roots_between_cuts(derivatives: Array, m: int, cuts: Array, rule: PairRule, roots: Array,
                        half_gaps: Array) -> int:
    """Roots in [-1, 1] of row m of the derivatives, ascending; -1 if a value is not finite.

    `cuts` are the roots of the previous row: row m is monotonic between them. Pairs count only in
    the last row, the polynomial itself.
    """
    p = derivatives[m]
    is_last = m == derivatives.shape[0] - 1
    # A shorter step is the last one: Newton's iteration squares the error.
    last_step = 1e-8 if is_last else 1e-5
    count, left = 0, -1.0
    at_left = value(p, m, left)
    for k in range(cuts.shape[0] + 1):
        right = cuts[k] if k < cuts.shape[0] else 1.0
        at_right = value(p, m, right)
        if not (math.isfinite(at_left) and math.isfinite(at_right)):
            return -1
        if (at_left > 0.0) != (at_right > 0.0):
            # Exactly 0 counts as negative: a root at a cut is found once.
            roots[count] = _root_between(p, m, left, right, at_left, last_step)
            half_gaps[count] = 0.0
            count += 1
        elif is_last and k < cuts.shape[0]:
            # An extremum, if no root follows, which may nearly touch zero.
            following = value(p, m, cuts[k + 1] if k + 1 < cuts.shape[0] else 1.0)
            h2 = _half_gap2(derivatives, right, at_right, rule)
            if (following > 0.0) == (at_right > 0.0) and h2 >= 0.0:
                roots[count], half_gaps[count] = right, math.sqrt(h2)
                count += 1
        left, at_left = right, at_right
    return count


@kernel
def roots_in_unit_interval(p: Array, rule: PairRule, roots: Array, half_gaps: Array) -> int:
    """All real roots in [-1, 1], ascending; their number, 0 when a coefficient is not finite.

    `p` (n + 1,): ascending coefficients, n >= 1. `roots`, `half_gaps` (n,): receive the roots, and
    h of those that are a conjugate pair (otherwise 0).
    """
    n = p.shape[0] - 1
    # Row m: the derivative of degree m, ascending, divided by (n - m)!; row n is p itself.
    derivatives, cuts = np.zeros((n + 1, n + 1)), np.empty(n)
    for k in range(n + 1):
        derivatives[n, k] = p[k]
    for m in range(n - 1, 0, -1):
        scale = 1.0 / (n - m)
        for k in range(m + 1):
            derivatives[m, k] = derivatives[m + 1, k + 1] * ((k + 1) * scale)
    count = 0
    for m in range(1, n + 1):
        for k in range(count):
            cuts[k] = roots[k]
        count = _roots_between_cuts(derivatives, m, cuts[:count], rule, roots, half_gaps)
        if count < 0:
            return 0
    return count


@small_kernel
def real_roots(p: Array, pair_tolerance: float, roots: Array) -> int:
    """All real roots of a polynomial with ascending coefficients `p` (n + 1,) into `roots` (n,).

    Conjugate pairs within `pair_tolerance` (see `PairRule`, zoom 1) count as one root.
    """
    degree = p.shape[0] - 1
    rule = PairRule(pair_tolerance, 1.0)
    found, half_gaps = np.empty(degree), np.empty(degree)
    count = roots_in_unit_interval(p, rule, roots, half_gaps)
    outside = roots_in_unit_interval(p[::-1].copy(), rule, found, half_gaps)
    for k in range(outside):
        # +-1 is part of the inner interval; 0 is a root at infinity.
        if 0.0 < abs(found[k]) < 1.0 and count < degree:
            roots[count] = 1.0 / found[k]
            count += 1
    return count


# All zeros of a real trigonometric polynomial D(psi) of degree n. With ``x = tan(psi / 2) /
# zoom``, ``exp(i psi) = (1 + i zoom x)^2 / (1 + zoom^2 x^2)``, hence ``(1 + zoom^2 x^2)^n D`` is a
# polynomial of degree 2n in x, which 2n + 1 samples determine. A zoom below 1 concentrates the
# samples around angle 0, so that zeros which cluster there within about `zoom`, where D is smaller
# by orders of magnitude than on the rest of the circle, are resolved.

# Largest distance from the unit circle of a pair of roots in exp(i psi) that counts as one angle.
PAIR_TOLERANCE = 1e-3


def half_angle_matrix(degree: int) -> Array:
    """Matrix (2n + 1, 2n + 1) from samples to ascending coefficients in x, at zoom 1.

    The samples are those of D at ``psi_k = 2 pi k / (2n + 1)``.
    """
    n, size = degree, 2 * degree + 1
    angles = 2.0 * np.pi * np.arange(size) / size
    matrix = np.zeros((size, size))
    one_plus_x2 = np.polynomial.Polynomial([1.0, 0.0, 1.0])
    turn = np.polynomial.Polynomial([1.0, 1.0j])
    for k in range(n + 1):
        basis = np.zeros(size, dtype=complex)
        product = (one_plus_x2 ** (n - k) * turn ** (2 * k)).coef
        basis[:len(product)] = product
        weight = (1.0 if k == 0 else 2.0) / size
        matrix += weight * (np.outer(basis.real, np.cos(k * angles))
                            + np.outer(basis.imag, np.sin(k * angles)))
    return matrix


def half_angle_nodes(degree: int) -> Array:
    """Cosine and sine (2n + 1, 2) of the half angles of the samples of `angles_of_zeros`."""
    half = np.pi * np.arange(2 * degree + 1) / (2 * degree + 1)
    return np.stack([np.cos(half), np.sin(half)], axis=1)


@kernel
def sample_angle(node: Array, zoom: float) -> tuple[float, float, float]:
    """Cosine and sine of the angle of a sample, and its weight.

    With ``x = tan(angle / 2) / zoom = sin / cos`` of `node` (2,), a row of `half_angle_nodes`, the
    weight ``((1 + zoom^2 x^2) / (1 + x^2))^n`` transforms a trigonometric polynomial of degree n
    in the angle to one of the same degree in ``2 atan(x)``; it is returned for n = 1.
    """
    c, s = node[0], zoom * node[1]
    weight = c * c + s * s
    return (c * c - s * s) / weight, 2.0 * c * s / weight, weight


@small_kernel
def is_known_angle(angle: float, angles: Array, tolerance: float) -> bool:
    """Whether an angle equals one of `angles` (K,), up to whole turns."""
    for known in angles:
        gap = abs(angle - known)
        if gap < tolerance or abs(gap - 2.0 * math.pi) < tolerance:
            return True
    return False


@kernel
def _append_angles(p: Array, scale: float, offset: float, angles: Array, gaps: Array,
                   count: int) -> int:
    """Add the angles ``2 atan(scale x) + offset`` of the roots of `p` in [-1, 1]; new count."""
    degree = p.shape[0] - 1
    roots, half_gaps = np.empty(degree), np.empty(degree)
    found = roots_in_unit_interval(p, PairRule(PAIR_TOLERANCE, scale), roots, half_gaps)
    for k in range(found):
        angle = 2.0 * math.atan(scale * roots[k]) + offset
        # A root at the border of both parts of the line is found twice.
        if not is_known_angle(angle, angles[:count], 1e-12) and count < degree:
            angles[count] = angle
            gaps[count] = 2.0 * half_gaps[k] / (1.0 / scale + scale * roots[k] * roots[k])
            count += 1
    return count


@kernel
def angles_of_zeros(samples: Array, matrix: Array, zoom: float, angles: Array,
                    half_gaps: Array) -> int:
    """All zeros of D; their number.

    `samples` (2n + 1,): D at the angles of `sample_angle`, times its weight to the power n.
    `matrix`: of `half_angle_matrix`. `angles`, `half_gaps` (2n,): receive the zeros [rad], and the
    distance of those that are a pair of roots in ``exp(i psi)`` within PAIR_TOLERANCE of the unit
    circle (otherwise 0).
    """
    size = samples.shape[0]
    largest = 0.0
    for k in range(size):
        largest = max(largest, abs(samples[k]))
    if not 0.0 < largest < math.inf:
        return 0
    p, reversed_p = np.empty(size), np.empty(size)
    for i in range(size):
        total = 0.0
        for k in range(size):
            total += matrix[i, k] * samples[k]
        p[i] = total / largest
    # |x| > 1: x = -1 / y, of which p(-1 / y) y^2n = 0. 2 atan(zoom x) = 2 atan(y / zoom) + pi, up
    # to whole turns.
    for i in range(size):
        reversed_p[i] = p[size - 1 - i] if i % 2 == 0 else -p[size - 1 - i]
    count = _append_angles(p, zoom, 0.0, angles, half_gaps, 0)
    return _append_angles(reversed_p, 1.0 / zoom, math.pi, angles, half_gaps, count)
