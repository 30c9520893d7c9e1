"""Uniform 11-point solver: derotated rays; rotation, translation and velocities unknown.

The 11x9 matrix A(R) must have rank 8: three equations in the three unknowns of R. The paper takes
three 9x9 determinants, which are badly scaled. Here, with the right singular vector y of the
smallest singular value, A is written as ``A [Y, y]``; the part of ``A y`` that is perpendicular
to the range of ``A Y`` has three components, which vanish exactly where the rank is 8, and whose
length is the smallest singular value. They are brought to zero by Levenberg-Marquardt with the
derivative of ``A(R) y`` (variable projection, Golub and Pereyra 1973, in Kaufman's form).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.so3 import exp_so3
from rs_relpose_ros.solvers.cheirality import cheirality_votes
from rs_relpose_ros.solvers.linear_algebra import normalise, reflect, triangularise
from rs_relpose_ros.solvers.uniform_columns import row_time_factors, translation_and_velocities

Array = NDArray[np.float64]


_ITERATIONS = 30
# Damping relative to the squared size of the Jacobian.
_DAMPING = 1e-8
_LEAST_DAMPING = 1e-20
_LARGEST_DAMPING = 1e4
_LONGEST_STEP = 0.2
# Smallest singular value, relative to the size of A, at which the rank is 8.
_CONVERGED = 1e-13
# The step before the last: the iteration squares it.
_LAST_STEP = 1e-6


@kernel
def _rotated(R: Array, f2: Array, k: int) -> tuple[float, float, float]:
    return (R[0, 0] * f2[k, 0] + R[0, 1] * f2[k, 1] + R[0, 2] * f2[k, 2],
            R[1, 0] * f2[k, 0] + R[1, 1] * f2[k, 1] + R[1, 2] * f2[k, 2],
            R[2, 0] * f2[k, 0] + R[2, 1] * f2[k, 1] + R[2, 2] * f2[k, 2])


@kernel
def _columns(f1: Array, f2: Array, p: Array, q: Array, R: Array, columns: Array) -> float:
    """Write the nine columns of A(R) into `columns` (9, 11); the Frobenius norm of A."""
    total = 0.0
    for k in range(f1.shape[0]):
        hx, hy, hz = _rotated(R, f2, k)
        n = (f1[k, 1] * hz - f1[k, 2] * hy, f1[k, 2] * hx - f1[k, 0] * hz,
             f1[k, 0] * hy - f1[k, 1] * hx)
        for i in range(3):
            columns[i, k] = n[i]
            columns[3 + i, k] = p[k] * n[i]
            columns[6 + i, k] = q[k] * n[i]
            total += n[i] * n[i] * (1.0 + p[k] * p[k] + q[k] * q[k])
    return math.sqrt(total)


@kernel
def _null_vector(columns: Array, y: Array, work: Array) -> float:
    """Right singular vector of the smallest singular value; the singular value.

    Inverse iteration with the factor of a QR decomposition: the square of A is never formed.

    Parameters
    ----------
    columns : (9, 11) ndarray
        Of A; not changed.
    y : (9,) ndarray
        Start, and result.
    work : (>= 11, 11) ndarray
        Overwritten.
    """
    n = columns.shape[0]
    factor, diagonal, scales = work[:n], work[n], work[n + 1]
    for k in range(n):
        for i in range(columns.shape[1]):
            factor[k, i] = columns[k, i]
    triangularise(factor, n, diagonal, scales)
    tiny = 0.0
    for k in range(n):
        tiny = max(tiny, 1e-18 * abs(diagonal[k]))
    for k in range(n):
        if abs(diagonal[k]) <= tiny:
            diagonal[k] = max(tiny, 1e-280)
    length = 1.0
    for _ in range(2):
        for k in range(n):
            total = y[k]
            for i in range(k):
                total -= factor[k, i] * y[i]
            y[k] = total / diagonal[k]
        normalise(y)
        for k in range(n - 1, -1, -1):
            y[k] /= diagonal[k]
            for i in range(k):
                y[i] -= factor[k, i] * y[k]
        length = normalise(y)
    return 1.0 / length


@kernel
def _conditions(f1: Array, f2: Array, p: Array, q: Array, R: Array, columns: Array, y: Array,
                bordered: Array, diagonal: Array, scales: Array) -> None:
    """The three rank conditions and their derivative by theta, R moving as ``Exp(theta) R``.

    Parameters
    ----------
    bordered : (12, 11) ndarray
        Receives in ``[8:11, 8:]`` the transposed derivative and in ``[11, 8:]`` the conditions.
    """
    # A reflection exchanges y and +-e_9, so that its other columns are perpendicular to y.
    sign = 1.0 if y[8] >= 0.0 else -1.0
    scale = 1.0 / (1.0 + abs(y[8]))
    for k in range(f1.shape[0]):
        Ay = 0.0
        for j in range(9):
            Ay += columns[j, k] * y[j]
        Aw = (Ay + sign * columns[8, k]) * scale
        for j in range(8):
            bordered[j, k] = columns[j, k] - Aw * y[j]
        hx, hy, hz = _rotated(R, f2, k)
        bx = y[0] + p[k] * y[3] + q[k] * y[6]
        by = y[1] + p[k] * y[4] + q[k] * y[7]
        bz = y[2] + p[k] * y[5] + q[k] * y[8]
        # d((f_1 x h) . b) / d theta = h x (b x f_1)
        mx = by * f1[k, 2] - bz * f1[k, 1]
        my = bz * f1[k, 0] - bx * f1[k, 2]
        mz = bx * f1[k, 1] - by * f1[k, 0]
        bordered[8, k] = hy * mz - hz * my
        bordered[9, k] = hz * mx - hx * mz
        bordered[10, k] = hx * my - hy * mx
        bordered[11, k] = Ay
    triangularise(bordered, 8, diagonal, scales)


@kernel
def _damped_step(bordered: Array, damping: float, step: Array, work: Array, diagonal: Array,
                 scales: Array) -> None:
    """Least-squares solution of ``J step = -r`` and ``sqrt(damping) step = 0``: `step` (3,)."""
    system = work[:4, :6]
    for j in range(4):
        for i in range(3):
            system[j, i] = bordered[8 + j, 8 + i]
            system[j, 3 + i] = math.sqrt(damping) if i == j else 0.0
    triangularise(system[:3], 3, diagonal, scales)
    for k in range(3):
        reflect(system[k], scales[k], k, system[3])
    for k in range(2, -1, -1):
        total = -system[3, k]
        for j in range(k + 1, 3):
            total -= system[j, k] * step[j]
        step[k] = total / diagonal[k]


@kernel
def _reach_rank_8(f1: Array, f2: Array, p: Array, q: Array, R: Array, y: Array) -> bool:
    """Move `R` (3, 3) in place to a rotation where A(R) has rank 8, with null vector `y` (9,)."""
    points = f1.shape[0]
    columns, bordered = np.empty((9, points)), np.empty((12, points))
    work, diagonal, scales = np.empty((11, points)), np.empty(9), np.empty(9)
    trial, step = np.empty(9), np.empty(3)
    y[:] = 1.0
    _columns(f1, f2, p, q, R, columns)
    sigma = _null_vector(columns, y, work)
    damping = _DAMPING
    jacobian2 = 0.0
    accepted = True
    for _ in range(_ITERATIONS):
        if accepted:
            _conditions(f1, f2, p, q, R, columns, y, bordered, diagonal, scales)
            jacobian2 = 0.0
            for j in range(3):
                for i in range(3):
                    jacobian2 += bordered[8 + j, 8 + i] ** 2
        _damped_step(bordered, damping * jacobian2, step, work, diagonal, scales)
        length = normalise(step)
        if not length < math.inf:
            return False
        step *= min(length, _LONGEST_STEP)
        R_trial = exp_so3(step) @ R
        limit = _CONVERGED * _columns(f1, f2, p, q, R_trial, columns)
        trial[:] = y
        sigma_trial = _null_vector(columns, trial, work)
        accepted = sigma_trial < sigma or sigma_trial < limit
        if accepted:
            R[:], y[:], sigma = R_trial, trial, sigma_trial
            damping = max(0.01 * damping, _LEAST_DAMPING)
            if sigma < limit and length < _LAST_STEP:
                return math.isfinite(y[0])
        else:
            damping *= 100.0
            if damping > _LARGEST_DAMPING:
                return False
    return False


@kernel
def uniform_11pt_kernel(f1: Array, f2: Array, tau1: Array, tau2: Array, R_start: Array,
                        R_out: Array, x_out: Array) -> bool:
    """The solution of `uniform_11pt` that a start rotation reaches; whether it reaches one.

    Parameters
    ----------
    f1, f2 : (11, 3) ndarray
        Derotated unit rays.
    tau1, tau2 : (11,) ndarray
        Row times [s].
    R_start : (3, 3) ndarray
        Rotation to start from.
    R_out, x_out : (3, 3), (9,) ndarray
        Receive R and ``(t, d_1, d_2)`` in frame 1, t of unit length, the sign by the majority of
        the points; without meaning when no solution is reached.
    """
    points = f1.shape[0]
    p, q = np.empty(points), np.empty(points)
    m, s_p, s_q = row_time_factors(tau1, tau2, p, q)
    if s_p == 0.0:
        return False
    y = np.empty(9)
    R_out[:] = R_start
    if not (_reach_rank_8(f1, f2, p, q, R_out, y)
            and translation_and_velocities(y, m, s_p, s_q, x_out)):
        return False
    front, behind = cheirality_votes(f1, f2, tau1, tau2, R_out, x_out)
    if behind > front:
        for i in range(9):
            x_out[i] = -x_out[i]
    return True
