"""All zeros of a real trigonometric polynomial D(psi) of degree n, for compiled code.

With ``x = tan(psi / 2) / zoom``, ``exp(i psi) = (1 + i zoom x)^2 / (1 + zoom^2 x^2)``, hence
``(1 + zoom^2 x^2)^n D`` is a polynomial of degree 2n in x, which 2n + 1 samples fix. A zoom below
1 crowds the samples around angle 0: zeros that are clustered there within about `zoom`, where D is
smaller by many orders of magnitude than on the rest of the circle, are then resolved as well as
any others.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel, linked_kernel
from rs_relpose_ros.solvers.polynomial import PairRule, roots_in_unit_interval

Array = NDArray[np.float64]

# A pair of roots in exp(i psi) that near to the unit circle counts as one real angle.
PAIR_TOLERANCE = 1e-3


def half_angle_matrix(degree: int) -> Array:
    """Matrix (2n + 1, 2n + 1) that turns samples into ascending coefficients in x, at zoom 1.

    The samples are those of D at ``psi_k = 2 pi k / (2n + 1)``.
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


class _Zeros(NamedTuple):
    """Zeros [rad] (2n,), and for those that stand for a pair of roots its distance (else 0)."""

    angles: Array
    half_gaps: Array


@kernel
def _is_known(angle: float, angles: Array) -> bool:
    for known in angles:
        gap = abs(angle - known)
        if gap < 1e-12 or abs(gap - 2.0 * math.pi) < 1e-12:
            return True
    return False


@linked_kernel
def _append_angles(p: Array, scale: float, offset: float, zeros: _Zeros, count: int) -> int:
    """Add the angles ``2 atan(scale x) + offset`` of the roots of `p` in [-1, 1]; new count."""
    degree = p.shape[0] - 1
    roots, half_gaps = np.empty(degree), np.empty(degree)
    found = roots_in_unit_interval(p, PairRule(PAIR_TOLERANCE, scale), roots, half_gaps)
    for k in range(found):
        angle = 2.0 * math.atan(scale * roots[k]) + offset
        # A root on the border of both halves of the line is found twice.
        if not _is_known(angle, zeros.angles[:count]) and count < degree:
            zeros.angles[count] = angle
            zeros.half_gaps[count] = 2.0 * half_gaps[k] / (
                1.0 / scale + scale * roots[k] * roots[k])
            count += 1
    return count


@kernel
def angles_of_zeros(samples: Array, matrix: Array, zoom: float, angles: Array,
                    half_gaps: Array) -> int:
    """All zeros of D; their number.

    Parameters
    ----------
    samples : (2n + 1,) ndarray
        D at the angles of `sample_angle`, times its weight to the power n.
    matrix : (2n + 1, 2n + 1) ndarray
        Of `half_angle_matrix`.
    angles, half_gaps : (2n,) ndarray
        Receive the zeros [rad], and for those that stand for a pair of roots in ``exp(i psi)``
        within PAIR_TOLERANCE of the unit circle its distance (else 0).
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
    zeros = _Zeros(angles, half_gaps)
    count = _append_angles(p, zoom, 0.0, zeros, 0)
    return _append_angles(reversed_p, 1.0 / zoom, math.pi, zeros, count)
