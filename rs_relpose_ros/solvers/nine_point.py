"""Uniform and linear 9-point solvers: gravity known; yaw, translation and velocities unknown."""

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
from rs_relpose_ros.solvers.linear_algebra import (
    lu_factor,
    lu_solve,
    lu_solve_transposed,
    normalise,
)
from rs_relpose_ros.solvers.polynomial import (
    angles_of_zeros,
    half_angle_matrix,
    half_angle_nodes,
    sample_angle,
)
from rs_relpose_ros.solvers.uniform_columns import (
    fill_columns,
    row_time_factors,
    translation_and_velocities,
)

Array = NDArray[np.float64]


MAX_SOLUTIONS = 12
# A pair of roots of the polynomial in exp(i psi) that near to the unit circle is one real angle.
PAIR_TOLERANCE = 1e-3

# Not 9: the leading complex coefficient matrix of A(psi) loses rank.
_DEGREE = 6
_HALF_ANGLE = half_angle_matrix(_DEGREE)
_NODES = half_angle_nodes(_DEGREE)
_POLISH_STEPS = 8
# The null vector is that of the angle before the last step, from at least two iterations.
_LAST_STEP = 1e-13
# A root of the polynomial is off by rounding only.
_FARTHEST = 1e-3
# Angles [rad] that are one zero, reached from two roots.
_SAME_ANGLE = 1e-10


@kernel
def _null_vectors(A: Array, pivots: NDArray[np.int64], u: Array, v: Array) -> float:
    """One inverse iteration towards the singular vectors of the smallest singular value.

    `A` (n, n) is overwritten by its factors; `v` (n,) is the start and receives the right, `u`
    the left vector. Returns the singular value.
    """
    lu_factor(A, pivots)
    u[:] = v
    lu_solve_transposed(A, pivots, u)
    normalise(u)
    v[:] = u
    lu_solve(A, pivots, v)
    return 1.0 / normalise(v)


@kernel
def _polish(a: Array, b: Array, p: Array, q: Array, psi: float, farthest: float, work: Array,
            pivots: NDArray[np.int64], y: Array) -> tuple[float, bool]:
    """Newton's method on the determinant, and the null vector `y` (9,) there.

    The factors of A itself give its step, so that nothing is lost to a polynomial's rounding.

    Parameters
    ----------
    farthest : float
        The root lies within this of `psi`, or the iteration has not converged.
    work : (16, 9) ndarray
        Overwritten.

    Returns
    -------
    psi, converged : float, bool
    """
    A, u = work[:9], work[9]
    n, dn = work[10:13].reshape((9, 3)), work[13:16].reshape((9, 3))
    start = psi
    y[:] = 1.0
    for iteration in range(_POLISH_STEPS):
        normals_at_yaw(a, b, math.cos(psi), math.sin(psi), n, dn)
        fill_columns(n, p, q, A)
        sigma = _null_vectors(A, pivots, u, y)
        # d(log det) = trace(A^-1 dA) ~ u . (dA y) / sigma
        slope = 0.0
        for r in range(9):
            for i in range(3):
                slope += u[r] * dn[r, i] * (y[i] + p[r] * y[3 + i] + q[r] * y[6 + i])
        step = sigma / slope
        if iteration > 0 and abs(step) < _LAST_STEP:
            return psi - step, True
        psi -= step
        if not abs(psi - start) < farthest:
            break
    return psi, False


@kernel
def _is_known(psi: float, yaws: Array) -> bool:
    for yaw in yaws:
        gap = abs(psi - yaw)
        if gap < _SAME_ANGLE or abs(gap - 2.0 * math.pi) < _SAME_ANGLE:
            return True
    return False


@kernel
def _write_solution(psi: float, y: Array, A1: Array, A2: Array, f1: Array, f2: Array,
                    tau1: Array, tau2: Array, m: float, s_p: float, s_q: float, R: Array,
                    x: Array) -> bool:
    """R and x of one yaw and null vector; False where it is no finite solution."""
    if not (math.isfinite(y[0]) and translation_and_velocities(y, m, s_p, s_q, x)):
        return False
    rotation_from_yaw(psi, A1, A2, R)
    for block in range(0, 9, 3):
        vx, vy, vz = x[block], x[block + 1], x[block + 2]
        for i in range(3):
            x[block + i] = A1[0, i] * vx + A1[1, i] * vy + A1[2, i] * vz
    front, behind = cheirality_votes(f1, f2, tau1, tau2, R, x)
    if behind > front:
        for i in range(9):
            x[i] = -x[i]
    return True


@kernel
def uniform_9pt_kernel(f1: Array, f2: Array, tau1: Array, tau2: Array, A1: Array, A2: Array,
                       R_out: Array, x_out: Array) -> int:
    """All solutions of `uniform_9pt` (derotated rays) or `linear_9pt` (measured); their number.

    Parameters
    ----------
    f1, f2 : (9, 3) ndarray
        Unit rays.
    tau1, tau2 : (9,) ndarray
        Row times [s].
    A1, A2 : (3, 3) ndarray
        `gravity_alignment` of the two cameras' gravity.
    R_out, x_out : (>= 12, 3, 3), (>= 12, 9) ndarray
        Receive R and ``(t, d_1, d_2)`` in frame 1, t of unit length, the sign by the majority of
        the nine points.
    """
    a, b = np.empty((9, 3)), np.empty((9, 3))
    rotate_rows(A1, f1, a)
    rotate_rows(A2, f2, b)
    p, q = np.empty(9), np.empty(9)
    m, s_p, s_q = row_time_factors(tau1, tau2, p, q)
    if s_p == 0.0:
        return 0
    centre, zoom = centre_yaw(a, b)
    n, dn = np.empty((9, 3)), np.empty((9, 3))
    A, pivots = np.empty((9, 9)), np.empty(9, dtype=np.int64)
    samples = np.empty(_NODES.shape[0])
    for k in range(_NODES.shape[0]):
        c, s, weight = sample_angle(_NODES[k], zoom)
        normals_at_yaw(a, b, c, s, n, dn)
        fill_columns(n, p, q, A)
        samples[k] = lu_factor(A, pivots) * weight**_DEGREE
    angles, half_gaps = np.empty(MAX_SOLUTIONS), np.empty(MAX_SOLUTIONS)
    found = angles_of_zeros(samples, _HALF_ANGLE, zoom, PAIR_TOLERANCE, angles, half_gaps)
    work, y = np.empty((16, 9)), np.empty(9)
    yaws = np.empty(MAX_SOLUTIONS)
    count = 0
    for k in range(found):
        middle, gap = angles[k], half_gaps[k]
        farthest = gap if gap > 0.0 else _FARTHEST
        psi, converged = _polish(a, b, p, q, middle - gap, farthest, work, pivots, y)
        if not converged:
            # A pair of roots off the real line: the nearest angle, and its best vector.
            normals_at_yaw(a, b, math.cos(middle), math.sin(middle), n, dn)
            y[:] = 1.0
            for _ in range(2):
                fill_columns(n, p, q, A)
                _null_vectors(A, pivots, work[9], y)
            psi = middle
        if not _is_known(psi, yaws[:count]) and _write_solution(
                centre + psi, y, A1, A2, f1, f2, tau1, tau2, m, s_p, s_q, R_out[count],
                x_out[count]):
            yaws[count] = psi
            count += 1
        if gap > 0.0 and converged and count < MAX_SOLUTIONS:
            # The pair was two real roots, closer than the polynomial can tell.
            psi, converged = _polish(a, b, p, q, middle + gap, gap, work, pivots, y)
            if converged and not _is_known(psi, yaws[:count]) and _write_solution(
                    centre + psi, y, A1, A2, f1, f2, tau1, tau2, m, s_p, s_q, R_out[count],
                    x_out[count]):
                yaws[count] = psi
                count += 1
        if count == MAX_SOLUTIONS:
            break
    return count
