"""Angular 3-point solver: derotated rays and gravity, yaw and translation unknown."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.solvers.cheirality import cheirality_votes
from rs_relpose_ros.solvers.gravity import (
    centre_yaw,
    normals_at_yaw,
    rotate_rows,
    rotation_from_yaw,
)
from rs_relpose_ros.solvers.polynomial import (
    angles_of_zeros,
    half_angle_matrix,
    half_angle_nodes,
    sample_angle,
)

Array = NDArray[np.float64]


MAX_SOLUTIONS = 4
# A pair of roots of the polynomial in exp(i psi) that near to the unit circle is one real angle.
PAIR_TOLERANCE = 1e-3

_DEGREE = 2
_HALF_ANGLE = half_angle_matrix(_DEGREE)
_NODES = half_angle_nodes(_DEGREE)
_NO_TIMES = np.zeros(3)


@kernel
def _triple(a: Array, b: Array, c: Array) -> float:
    return (a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2])
            + a[2] * (b[0] * c[1] - b[1] * c[0]))


@kernel
def angular_3pt_kernel(f1: Array, f2: Array, A1: Array, A2: Array, R_out: Array,
                       t_out: Array) -> int:
    """All solutions of `angular_3pt` for unit rays `f1`, `f2` (3, 3); their number.

    Parameters
    ----------
    A1, A2 : (3, 3) ndarray
        `gravity_alignment` of the two cameras' gravity.
    R_out, t_out : (>= 4, 3, 3), (>= 4, 3) ndarray
        Receive R and the unit t in frame 1, its sign by the majority of the three points.
    """
    a, b = np.empty((3, 3)), np.empty((3, 3))
    rotate_rows(A1, f1, a)
    rotate_rows(A2, f2, b)
    centre, zoom = centre_yaw(a, b)
    n, dn = np.empty((3, 3)), np.empty((3, 3))
    samples = np.empty(_NODES.shape[0])
    for k in range(_NODES.shape[0]):
        c, s, weight = sample_angle(_NODES[k], zoom)
        normals_at_yaw(a, b, c, s, n, dn)
        samples[k] = _triple(n[0], n[1], n[2]) * weight**_DEGREE
    angles, half_gaps = np.empty(MAX_SOLUTIONS), np.empty(MAX_SOLUTIONS)
    found = angles_of_zeros(samples, _HALF_ANGLE, zoom, PAIR_TOLERANCE, angles, half_gaps)
    t = np.empty(3)
    count = 0
    for k in range(found):
        psi = angles[k]
        normals_at_yaw(a, b, math.cos(psi), math.sin(psi), n, dn)
        if half_gaps[k] == 0.0:
            # One Newton step on the determinant itself, free of the polynomial's rounding.
            slope = (_triple(dn[0], n[1], n[2]) + _triple(n[0], dn[1], n[2])
                     + _triple(n[0], n[1], dn[2]))
            step = _triple(n[0], n[1], n[2]) / slope
            if abs(step) < 1e-4:
                psi -= step
                normals_at_yaw(a, b, math.cos(psi), math.sin(psi), n, dn)
        # t is perpendicular to all three normals: the longest of their cross products.
        longest = 0.0
        for i in range(3):
            p, q = n[i], n[(i + 1) % 3]
            x = p[1] * q[2] - p[2] * q[1]
            y = p[2] * q[0] - p[0] * q[2]
            z = p[0] * q[1] - p[1] * q[0]
            length2 = x * x + y * y + z * z
            if length2 > longest:
                longest = length2
                t[0], t[1], t[2] = x, y, z
        if not longest > 1e-28:
            continue
        rotation_from_yaw(centre + psi, A1, A2, R_out[count])
        scale = 1.0 / math.sqrt(longest)
        for i in range(3):
            t_out[count, i] = scale * (A1[0, i] * t[0] + A1[1, i] * t[1] + A1[2, i] * t[2])
        front, behind = cheirality_votes(f1, f2, _NO_TIMES, _NO_TIMES, R_out[count],
                                         t_out[count])
        if behind > front:
            for i in range(3):
                t_out[count, i] = -t_out[count, i]
        count += 1
    return count
