"""Real roots of polynomials and of trigonometric polynomials, for compiled code.

The roots of a polynomial's derivative cut the line into pieces on which it is monotonic, so that
each piece holds at most one root; applied from the linear derivative upwards this isolates **all**
real roots without a start value and without division by a leading coefficient (Yuksel,
*High-Performance Polynomial Root Finding for Graphics*, HPG 2022). The whole line is covered as
[-1, 1] and, with the coefficients reversed, its outside: no value ever overflows.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel

Array = NDArray[np.float64]


# A step below this is the last one: Newton's iteration squares the error.
_LAST_STEP = 1e-8
_LAST_STEP_OF_DERIVATIVES = 1e-5
_MAX_STEPS = 80


@kernel
def value(p: Array, degree: int, x: float) -> float:
    """Value at `x` of the polynomial with ascending coefficients ``p[:degree + 1]``."""
    y = p[degree]
    for k in range(degree - 1, -1, -1):
        y = y * x + p[k]
    return y


@kernel
def _root_between(p: Array, degree: int, low: float, high: float, at_low: float,
                  last_step: float) -> float:
    """Root in a bracket on which the polynomial is monotonic: Newton, kept inside by bisection."""
    x = 0.5 * (low + high)
    for _ in range(_MAX_STEPS):
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


@kernel
def roots_in_unit_interval(p: Array, pair_tolerance: float, zoom: float, roots: Array,
                           half_gaps: Array, work: Array) -> int:
    """All real roots in [-1, 1], ascending.

    Parameters
    ----------
    p : (n + 1,) ndarray
        Ascending coefficients, n >= 1.
    pair_tolerance, zoom : float
        A conjugate pair ``c +- ih`` counts as the root c if the *angle* ``2 atan(zoom x)`` has an
        imaginary part below the tolerance there: ``2 zoom h / (1 + zoom^2 c^2)``.
    roots, half_gaps : (n,) ndarray
        Receive the roots, and h of those that stand for a pair (else 0).
    work : (>= n + 3, n + 1) ndarray
        Overwritten.

    Returns
    -------
    int
        Number of roots; 0 when a coefficient is not finite.
    """
    n = p.shape[0] - 1
    # Row m: the derivative of degree m, divided by (n - m)!, so that coefficients stay moderate.
    for m in range(n + 1):
        for k in range(m + 1):
            work[m, k] = p[k] if m == n else 0.0
    for m in range(n - 1, 0, -1):
        scale = 1.0 / (n - m)
        for k in range(m + 1):
            work[m, k] = work[m + 1, k + 1] * ((k + 1) * scale)
    cuts = work[n + 1]
    found = work[n + 2]
    cut_count = 0
    for m in range(1, n + 1):
        last_step = _LAST_STEP if m == n else _LAST_STEP_OF_DERIVATIVES
        count = 0
        left = -1.0
        at_left = value(work[m], m, left)
        for k in range(cut_count + 1):
            right = cuts[k] if k < cut_count else 1.0
            at_right = value(work[m], m, right)
            if not (math.isfinite(at_left) and math.isfinite(at_right)):
                return 0
            if (at_left > 0.0) != (at_right > 0.0):
                # Exactly 0 counts as negative: a root at a cut is then found once.
                found[count] = _root_between(work[m], m, left, right, at_left, last_step)
                if m == n:
                    half_gaps[count] = 0.0
                count += 1
            elif m == n and k < cut_count:
                # An extremum that nearly touches zero: p'' = 2 work[n - 2].
                following = value(work[m], m, cuts[k + 1] if k + 1 < cut_count else 1.0)
                bend = value(work[n - 2], n - 2, right) if n >= 2 else 0.0
                h2 = at_right / bend
                limit = 0.5 * pair_tolerance * (1.0 / zoom + zoom * right * right)
                if (following > 0.0) == (at_right > 0.0) and 0.0 <= h2 < limit * limit:
                    found[count] = right
                    half_gaps[count] = math.sqrt(h2)
                    count += 1
            left, at_left = right, at_right
        if m == n:
            for k in range(count):
                roots[k] = found[k]
        else:
            for k in range(count):
                cuts[k] = found[k]
            cut_count = count
    return count


def half_angle_matrix(degree: int) -> Array:
    """Samples of a trigonometric polynomial to its half-angle polynomial.

    A trigonometric polynomial D of degree n is fixed by 2n + 1 samples at ``2 pi k / (2n + 1)``.
    With ``x = tan(psi / 2)``, ``exp(i psi) = (1 + ix)^2 / (1 + x^2)``, hence
    ``(1 + x^2)^n D(psi)`` is a polynomial of degree 2n in x.

    Returns
    -------
    (2n + 1, 2n + 1) ndarray
        Its product with the samples gives the ascending coefficients.
    """
    n = degree
    size = 2 * n + 1
    angles = 2.0 * np.pi * np.arange(size) / size
    matrix = np.zeros((size, size))
    one_plus_x2 = np.polynomial.Polynomial([1.0, 0.0, 1.0])
    turn = np.polynomial.Polynomial([1.0, 1.0j])
    for k in range(n + 1):
        basis = (one_plus_x2 ** (n - k) * turn ** (2 * k)).coef
        basis = np.concatenate([basis, np.zeros(size - len(basis))])
        weight = (1.0 if k == 0 else 2.0) / size
        matrix += weight * (np.outer(basis.real, np.cos(k * angles))
                            + np.outer(basis.imag, np.sin(k * angles)))
    return matrix


def half_angle_nodes(degree: int) -> Array:
    """Cosine and sine (2n + 1, 2) of the half angles at which `angles_of_zeros` wants samples."""
    half = np.pi * np.arange(2 * degree + 1) / (2 * degree + 1)
    return np.stack([np.cos(half), np.sin(half)], axis=1)


@kernel
def sample_angle(node: Array, zoom: float) -> tuple[float, float, float]:
    """Cosine and sine of the angle of a sample, and the weight that it gets.

    With ``x = tan(angle / 2) / zoom = sin / cos`` of `node` (2,), a row of `half_angle_nodes`, the
    weight ``((1 + zoom^2 x^2) / (1 + x^2))^n`` makes a trigonometric polynomial of degree n in the
    angle one of the same degree in ``2 atan(x)``; it is returned for n = 1.
    """
    c, s = node[0], zoom * node[1]
    weight = c * c + s * s
    return (c * c - s * s) / weight, 2.0 * c * s / weight, weight


@kernel
def _append_angles(p: Array, outside: bool, pair_tolerance: float, zoom: float, work: Array,
                   angles: Array, half_gaps: Array, count: int) -> int:
    """Add the zeros with ``|x| <= 1`` of `p`, or `outside` those with ``x = -1 / y``."""
    size = p.shape[0]
    roots, gaps = work[size + 2], work[size + 3]
    # 2 atan(zoom x) = 2 atan(y / zoom) - pi: outside, a step of y turns by 1 / zoom.
    scale = 1.0 / zoom if outside else zoom
    found = roots_in_unit_interval(p, pair_tolerance, scale, roots, gaps, work)
    for k in range(found):
        angle = 2.0 * math.atan(scale * roots[k])
        if outside:
            angle += math.pi
        # A root on the border of both halves is found twice.
        repeated = False
        for j in range(count):
            gap = abs(angle - angles[j])
            if gap < 1e-12 or abs(gap - 2.0 * math.pi) < 1e-12:
                repeated = True
        if not repeated and count < angles.shape[0]:
            angles[count] = angle
            half_gaps[count] = 2.0 * gaps[k] / (1.0 / scale + scale * roots[k] * roots[k])
            count += 1
    return count


@kernel
def angles_of_zeros(samples: Array, matrix: Array, zoom: float, pair_tolerance: float,
                    angles: Array, half_gaps: Array) -> int:
    """All zeros of a real trigonometric polynomial D of degree n.

    With ``x = tan(psi / 2) / zoom``, ``(1 + zoom^2 x^2)^n D`` is a polynomial of degree 2n in x,
    sampled at the tangents of equally spaced half angles. A zoom below 1 crowds the samples around
    angle 0: zeros that are clustered there within about `zoom`, where D is smaller by many orders
    of magnitude than on the rest of the circle, are then resolved as well as any others.

    Parameters
    ----------
    samples : (2n + 1,) ndarray
        D at the angles of `sample_angle`, times its weight to the power n.
    matrix : (2n + 1, 2n + 1) ndarray
        Of `half_angle_matrix`.
    pair_tolerance : float
        A pair of roots in ``exp(i psi)`` that near to the unit circle counts as its angle.
    angles, half_gaps : (2n,) ndarray
        Receive the zeros [rad], and for those that stand for such a pair its distance.

    Returns
    -------
    int
        Number of zeros.
    """
    size = samples.shape[0]
    largest = 0.0
    for k in range(size):
        largest = max(largest, abs(samples[k]))
    if not 0.0 < largest < math.inf:
        return 0
    work = np.empty((size + 5, size))
    p = work[size + 4]
    for i in range(size):
        total = 0.0
        for k in range(size):
            total += matrix[i, k] * samples[k]
        p[i] = total / largest
    count = _append_angles(p, False, pair_tolerance, zoom, work, angles, half_gaps, 0)
    # p(-1 / y) y^2n
    for i in range(size // 2):
        p[i], p[size - 1 - i] = p[size - 1 - i], p[i]
    for i in range(1, size, 2):
        p[i] = -p[i]
    return _append_angles(p, True, pair_tolerance, zoom, work, angles, half_gaps, count)


@kernel
def real_roots(p: Array, pair_tolerance: float, roots: Array) -> int:
    """All real roots of a polynomial with ascending coefficients `p` (n + 1,) into `roots` (n,).

    Conjugate pairs within `pair_tolerance` (see `roots_in_unit_interval`) count as one root.
    """
    size = p.shape[0]
    found, gaps = np.empty(size - 1), np.empty(size - 1)
    work = np.empty((size + 2, size))
    count = roots_in_unit_interval(p, pair_tolerance, 1.0, found, gaps, work)
    for k in range(count):
        roots[k] = found[k]
    outside = roots_in_unit_interval(p[::-1].copy(), pair_tolerance, 1.0, found, gaps, work)
    for k in range(outside):
        # +-1 belongs to the inner part; 0 is a root at infinity.
        if 0.0 < abs(found[k]) < 1.0 and count < size - 1:
            roots[count] = 1.0 / found[k]
            count += 1
    return count
