"""Real roots of polynomials, for compiled code.

The roots of a polynomial's derivative cut the line into pieces on which it is monotonic, so that
each piece holds at most one root; applied from the linear derivative upwards this isolates **all**
real roots without a start value and without division by a leading coefficient (Yuksel,
*High-Performance Polynomial Root Finding for Graphics*, HPG 2022). The whole line is covered as
[-1, 1] and, with the coefficients reversed, its outside: no value ever overflows.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel, linked_kernel

Array = NDArray[np.float64]


class PairRule(NamedTuple):
    """Which conjugate pairs ``c +- ih`` count as the real root c.

    Those whose angle ``2 atan(zoom x)`` has an imaginary part below `tolerance` [rad] there:
    ``2 zoom h / (1 + zoom^2 c^2)``.
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


@kernel
def _root_between(p: Array, degree: int, low: float, high: float, at_low: float,
                  last_step: float) -> float:
    """Root in a bracket on which the polynomial is monotonic: Newton, kept inside by bisection."""
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


@kernel
def _write_derivatives(p: Array, derivatives: Array) -> None:
    """Row m: the derivative of degree m, by (n - m)! smaller, so that coefficients stay moderate.

    Row n is `p` itself, ascending; `derivatives` (n + 1, n + 1) is overwritten.
    """
    n = p.shape[0] - 1
    derivatives[:] = 0.0
    for k in range(n + 1):
        derivatives[n, k] = p[k]
    for m in range(n - 1, 0, -1):
        scale = 1.0 / (n - m)
        for k in range(m + 1):
            derivatives[m, k] = derivatives[m + 1, k + 1] * ((k + 1) * scale)


@kernel
def _half_gap2(derivatives: Array, extremum: float, at_extremum: float, rule: PairRule) -> float:
    """``h^2`` of the pair ``extremum +- ih`` of the polynomial in the last row, if it counts.

    Else -1. Near its extremum c, ``p(x) = p(c) + p''(c) (x - c)^2 / 2``, of which the row of the
    second derivative holds the half.
    """
    n = derivatives.shape[0] - 1
    h2 = at_extremum / value(derivatives[n - 2], n - 2, extremum)
    limit = 0.5 * rule.tolerance * (1.0 / rule.zoom + rule.zoom * extremum * extremum)
    return h2 if 0.0 <= h2 < limit * limit else -1.0


@kernel
def _roots_between_cuts(derivatives: Array, m: int, cuts: Array, rule: PairRule, roots: Array,
                        half_gaps: Array) -> int:
    """Roots in [-1, 1] of row m of the derivatives, ascending; -1 where a value is not finite.

    `cuts` are the roots of the row before: row m is monotonic between them. Pairs count only in
    the last row, the polynomial itself.
    """
    p = derivatives[m]
    is_last = m == derivatives.shape[0] - 1
    # A step below this is the last one: Newton's iteration squares the error.
    last_step = 1e-8 if is_last else 1e-5
    count, left = 0, -1.0
    at_left = value(p, m, left)
    for k in range(cuts.shape[0] + 1):
        right = cuts[k] if k < cuts.shape[0] else 1.0
        at_right = value(p, m, right)
        if not (math.isfinite(at_left) and math.isfinite(at_right)):
            return -1
        if (at_left > 0.0) != (at_right > 0.0):
            # Exactly 0 counts as negative: a root at a cut is then found once.
            roots[count] = _root_between(p, m, left, right, at_left, last_step)
            half_gaps[count] = 0.0
            count += 1
        elif is_last and k < cuts.shape[0]:
            # An extremum, if no root follows: it may nearly touch zero.
            following = value(p, m, cuts[k + 1] if k + 1 < cuts.shape[0] else 1.0)
            h2 = _half_gap2(derivatives, right, at_right, rule)
            if (following > 0.0) == (at_right > 0.0) and h2 >= 0.0:
                roots[count], half_gaps[count] = right, math.sqrt(h2)
                count += 1
        left, at_left = right, at_right
    return count


@linked_kernel
def roots_in_unit_interval(p: Array, rule: PairRule, roots: Array, half_gaps: Array) -> int:
    """All real roots in [-1, 1], ascending; their number, 0 when a coefficient is not finite.

    Parameters
    ----------
    p : (n + 1,) ndarray
        Ascending coefficients, n >= 1.
    roots, half_gaps : (n,) ndarray
        Receive the roots, and h of those that stand for a conjugate pair (else 0).
    """
    n = p.shape[0] - 1
    derivatives, cuts = np.empty((n + 1, n + 1)), np.empty(n)
    _write_derivatives(p, derivatives)
    count = 0
    for m in range(1, n + 1):
        for k in range(count):
            cuts[k] = roots[k]
        count = _roots_between_cuts(derivatives, m, cuts[:count], rule, roots, half_gaps)
        if count < 0:
            return 0
    return count


@kernel
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
        # +-1 belongs to the inner part; 0 is a root at infinity.
        if 0.0 < abs(found[k]) < 1.0 and count < degree:
            roots[count] = 1.0 / found[k]
            count += 1
    return count
