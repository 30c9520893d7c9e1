"""Small dense factorisations, and real roots of polynomials, for compiled code."""

import math

import numpy as np

from rs_relpose_ros.geometry import Array, Indices
from rs_relpose_ros.geometry.so3 import copy_vector, cross, dot, Vector
from rs_relpose_ros.jit import kernel, small_kernel


@kernel
def lu_factor(A: Array, pivots: Indices) -> float:
    """Factor `A` (n, n) into L U in place, with row pivoting; returns the determinant.

    The diagonal receives the reciprocals of the pivots. A pivot of exactly zero is replaced by a
    tiny one, so that inverse iteration works; the determinant is then zero.
    """
    n = A.shape[0]
    determinant = 1.0
    largest = 0.0
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
        upper = A[k]
        if pivot != k:
            other = A[pivot]
            for j in range(n):
                upper[j], other[j] = other[j], upper[j]
            determinant = -determinant
        diagonal = upper[k]
        determinant *= diagonal
        if diagonal == 0.0:
            diagonal = tiny
        inverse = 1.0 / diagonal
        upper[k] = inverse
        for i in range(k + 1, n):
            row = A[i]
            factor = row[k] * inverse
            row[k] = factor
            for j in range(k + 1, n):
                row[j] -= factor * upper[j]
    return determinant


@kernel
def lu_solve(LU: Array, pivots: Indices, b: Array) -> None:
    """Solve ``A x = b`` with the result of `lu_factor`; x replaces `b` (n,)."""
    n = LU.shape[0]
    for k in range(n):
        pivot = pivots[k]
        b[k], b[pivot] = b[pivot], b[k]
    for k in range(n):
        row = LU[k]
        total = b[k]
        for j in range(k):
            total -= row[j] * b[j]
        b[k] = total
    for k in range(n - 1, -1, -1):
        row = LU[k]
        total = b[k]
        for j in range(k + 1, n):
            total -= row[j] * b[j]
        b[k] = total * row[k]


@kernel
def normalise(v: Array) -> None:
    """Scale `v` (n,) to unit length in place; a vector of length zero becomes NaN."""
    largest = 0.0
    total = 0.0
    for k in range(len(v)):
        largest = max(largest, abs(v[k]))
    for k in range(len(v)):
        v[k] /= largest  # first, so that squares neither overflow nor vanish
        total += v[k] * v[k]
    total = math.sqrt(total)
    for k in range(len(v)):
        v[k] /= total


@kernel
def null_direction(rows: Array) -> tuple[Vector, float]:
    """Null vector of a matrix (3, 3) of rank 2, and its squared length.

    It is the longest of the cross products of two rows, and zero if all rows are parallel.
    """
    best = (0.0, 0.0, 0.0)
    longest = 0.0
    for i in range(3):
        direction = cross(rows[i], rows[(i + 1) % 3])
        length2 = dot(direction, direction)
        if length2 > longest:
            best = direction
            longest = length2
    return best, longest


# Real roots of polynomials. The roots of the derivative divide the line into intervals on which
# the polynomial is monotonic, and each interval has at most one root. Applied from the linear
# derivative upwards, this isolates **all** real roots without a start value and without division
# by a leading coefficient (Yuksel, *High-Performance Polynomial Root Finding for Graphics*, HPG
# 2022). The line is covered as [-1, 1] and, with the coefficients reversed, as its outside, so
# that values do not overflow.

# Largest distance from the unit circle of a pair of roots in exp(i psi) that counts as one angle.
# A smaller value loses double roots that rounding has moved off the circle; a larger value costs
# Newton's method on pairs that are no solution. [chosen: Newton's method decides, so any value
# in 1e-4..1e-2 would do]
PAIR_TOLERANCE = 1e-3


@kernel
def value(p: Array, x: float) -> float:
    """Evaluate the polynomial with ascending coefficients `p` at `x`."""
    y = 0.0
    for k in range(len(p) - 1, -1, -1):
        y = y * x + p[k]
    return y


@small_kernel
def _root_between(p: Array, low: float, high: float, at_low: float, last_step: float) -> float:
    """Find the root of a polynomial that is monotonic between `low` and `high`.

    Newton's method finds it; a step that would leave the bracket is replaced by a bisection.
    """
    x = 0.5 * (low + high)
    for _ in range(80):  # bisection alone would need 52
        y = 0.0
        slope = 0.0
        for k in range(len(p) - 1, -1, -1):
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


@kernel
def roots_in_unit_interval(p: Array, zoom: float, roots: Array, half_gaps: Array) -> int:
    """Find all real roots in [-1, 1], ascending; returns their number.

    `p` (n + 1,): ascending coefficients, n >= 2; if one is not finite there are no roots.
    `roots` (n,) receives the roots. `half_gaps` (n,) receives 0, or h if a root c stands for a
    conjugate pair ``c +- ih``. Such a pair counts if its angle ``2 atan(zoom x)`` has an imaginary
    part ``2 zoom h / (1 + zoom^2 c^2)`` below PAIR_TOLERANCE.
    """
    n = len(p) - 1
    count = 0
    # Row m: the derivative of degree m, ascending, divided by (n - m)!; row n is p itself.
    derivatives = np.zeros((n + 1, n + 1))
    copy_vector(p, derivatives[n])
    for m in range(n - 1, 0, -1):
        higher = derivatives[m + 1]
        for k in range(m + 1):
            derivatives[m, k] = higher[k + 1] * ((k + 1) / (n - m))
    for m in range(1, n + 1):
        # Row m is monotonic between the roots of the previous one.
        q = derivatives[m, : m + 1]
        cuts = roots[:count].copy()
        count = 0
        left = -1.0
        at_left = value(q, -1.0)
        for k in range(len(cuts) + 1):
            right = cuts[k] if k < len(cuts) else 1.0
            at_right = value(q, right)
            if not (math.isfinite(at_left) and math.isfinite(at_right)):
                return 0
            if (at_left > 0.0) != (at_right > 0.0):
                # Exactly 0 counts as negative, so that a root at a cut is found once. As Newton's
                # iteration squares the error, a step below this is the last one.
                last_step = 1e-8 if m == n else 1e-5
                roots[count] = _root_between(q, left, right, at_left, last_step)
                half_gaps[count] = 0.0
                count += 1
            elif m == n and k < len(cuts):
                # The cut is an extremum c. If no root follows, it may nearly touch zero: near it,
                # p(x) = p(c) + p''(c) (x - c)^2 / 2, and row n - 2 is p'' / 2.
                following = value(q, cuts[k + 1] if k + 1 < len(cuts) else 1.0)
                h2 = at_right / value(derivatives[n - 2, : n - 1], right)
                limit = 0.5 * PAIR_TOLERANCE * (1.0 / zoom + zoom * right * right)
                if (following > 0.0) == (at_right > 0.0) and 0.0 <= h2 < limit * limit:
                    roots[count] = right
                    half_gaps[count] = math.sqrt(h2)
                    count += 1
            left = right
            at_left = at_right
    return count


# The functions below find all zeros of a real trigonometric polynomial D(psi) of degree n. With
# ``x = tan(psi / 2) / zoom``, ``exp(i psi) = (1 + i zoom x)^2 / (1 + zoom^2 x^2)``, hence
# ``(1 + zoom^2 x^2)^n D`` is a polynomial of degree 2n in x, which 2n + 1 samples determine. A
# zoom below 1 concentrates the samples around angle 0. So it resolves zeros that cluster there
# within about `zoom`, where D is smaller by orders of magnitude than on the rest of the circle.


def half_angle_nodes(degree: int) -> Array:
    """Cosine and sine (2n + 1, 2) of the half angles of the samples of D."""
    count = 2 * degree + 1
    half = np.pi * np.arange(count) / count
    return np.stack([np.cos(half), np.sin(half)], axis=1)


def half_angle_matrix(degree: int) -> Array:
    """Matrix (2n + 1, 2n + 1) from samples to ascending coefficients in x, at zoom 1."""
    cosine, sine = half_angle_nodes(degree).T[:, :, None]
    power = np.arange(2 * degree + 1)
    samples_by_coefficients = cosine ** (2 * degree - power) * sine**power
    return np.linalg.inv(samples_by_coefficients)


@kernel
def sample_angle(node: Array, zoom: float) -> tuple[float, float]:
    """Angle of a sample, and its weight.

    With ``x = tan(angle / 2) / zoom = sin / cos`` of `node` (2,), a row of `half_angle_nodes`, the
    weight ``((1 + zoom^2 x^2) / (1 + x^2))^n`` transforms a trigonometric polynomial of degree n
    in the angle to one of the same degree in ``2 atan(x)``; it is returned for n = 1.
    """
    c = node[0]
    s = zoom * node[1]
    return 2.0 * math.atan2(s, c), c * c + s * s


@kernel
def angles_of_zeros(p: Array, zoom: float, angles: Array, half_gaps: Array) -> int:
    """Find all angles ``2 atan(zoom x)`` at which a polynomial is zero; returns their number.

    `p` (2n + 1,): ascending coefficients in x, overwritten. `angles` (2n,) receives the angles
    [rad]. `half_gaps` (2n,) receives 0, or the distance from the unit circle of a pair of roots in
    ``exp(i psi)`` that is closer to it than PAIR_TOLERANCE.
    """
    largest = 0.0
    for value in p:
        largest = max(largest, abs(value))
    if not 0.0 < largest < math.inf:
        return 0
    p /= largest
    n = len(p) - 1
    roots = np.empty(n)
    gaps = np.empty(n)
    count = 0
    # Where |x| > 1, the substitution x = -1 / y gives p(-1 / y) y^2n = 0, and
    # 2 atan(zoom x) = 2 atan(y / zoom) + pi up to whole turns.
    outside = p[::-1].copy()
    outside[1::2] *= -1.0
    for q, scale, offset in ((p, zoom, 0.0), (outside, 1.0 / zoom, math.pi)):
        for k in range(roots_in_unit_interval(q, scale, roots, gaps)):
            root = roots[k]
            # A root at the border of both parts of the line belongs to the inner one.
            if count < n and (offset == 0.0 or abs(root) < 1.0):
                angles[count] = 2.0 * math.atan(scale * root) + offset
                half_gaps[count] = 2.0 * gaps[k] / (1.0 / scale + scale * root * root)
                count += 1
    return count
