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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.so3 import exp_so3
from rs_relpose_ros.geometry.vectors import copy_matrix, copy_vector, cross, rotated
from rs_relpose_ros.solvers.cheirality import point_forward
from rs_relpose_ros.solvers.five_point import MAX_SOLUTIONS as MAX_STARTS
from rs_relpose_ros.solvers.five_point import solve_5pt
from rs_relpose_ros.solvers.linear_algebra import normalise, reflect, triangularise
from rs_relpose_ros.solvers.solver import Knowledge, Sample, Solutions
from rs_relpose_ros.solvers.uniform_columns import (
    row_time_factors,
    RowTimeFactors,
    translation_and_velocities,
)

Array = NDArray[np.float64]

# One from each start.
MAX_SOLUTIONS = MAX_STARTS
# Smallest singular value, relative to the size of A, at which the rank is 8.
_SINGULAR = 1e-13


class _Equations(NamedTuple):
    """``A(R) y = 0`` with the rows ``[n, p n, q n]``, and room for what belongs to one R.

    `columns` (9, 11): of A. `bordered` (12, 11): ``[A Y, dA y / dtheta, A y]``, triangularised;
    its last rows hold in ``[8:11, 8:]`` the transposed derivative J of the three conditions and
    in ``[11, 8:]`` the conditions r. `work` (11, 11), `diagonal`, `scales` (9,): overwritten.
    """

    sample: Sample
    factors: RowTimeFactors
    columns: Array
    bordered: Array
    work: Array
    diagonal: Array
    scales: Array


@kernel
def _fill_columns(equations: _Equations, R: Array) -> float:
    """Write the nine columns of A(R); the Frobenius norm of A."""
    sample, columns = equations.sample, equations.columns
    p, q = equations.factors.p, equations.factors.q
    total = 0.0
    for k in range(sample.f1.shape[0]):
        n = cross(sample.f1[k], rotated(R, sample.f2[k]))
        for i in range(3):
            columns[i, k] = n[i]
            columns[3 + i, k] = p[k] * n[i]
            columns[6 + i, k] = q[k] * n[i]
            total += n[i] * n[i] * (1.0 + p[k] * p[k] + q[k] * q[k])
    return math.sqrt(total)


@kernel
def _null_vector(equations: _Equations, y: Array) -> float:
    """Right singular vector of the smallest singular value; the singular value.

    Inverse iteration from `y` (9,) with the factor of a QR decomposition: the square of A is
    never formed. The columns stay as they are.
    """
    n = equations.columns.shape[0]
    factor, diagonal = equations.work[:n], equations.diagonal
    copy_matrix(equations.columns, factor)
    triangularise(factor, n, diagonal, equations.scales)
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
def _linearise(equations: _Equations, R: Array, y: Array) -> float:
    """Write the rank conditions r and J, R moving as ``Exp(theta) R``; ``|J|^2``."""
    sample, columns, bordered = equations.sample, equations.columns, equations.bordered
    p, q = equations.factors.p, equations.factors.q
    # A reflection exchanges y and +-e_9, so that its other columns Y are perpendicular to y.
    sign = 1.0 if y[8] >= 0.0 else -1.0
    scale = 1.0 / (1.0 + abs(y[8]))
    for k in range(sample.f1.shape[0]):
        Ay = 0.0
        for j in range(9):
            Ay += columns[j, k] * y[j]
        Aw = (Ay + sign * columns[8, k]) * scale
        for j in range(8):
            bordered[j, k] = columns[j, k] - Aw * y[j]
        # b = y_1 + p y_2 + q y_3, and d((f_1 x h) . b) / dtheta = h x (b x f_1) with h = R f_2
        b = (y[0] + p[k] * y[3] + q[k] * y[6], y[1] + p[k] * y[4] + q[k] * y[7],
             y[2] + p[k] * y[5] + q[k] * y[8])
        by_theta = cross(rotated(R, sample.f2[k]), cross(b, sample.f1[k]))
        for i in range(3):
            bordered[8 + i, k] = by_theta[i]
        bordered[11, k] = Ay
    triangularise(bordered, 8, equations.diagonal, equations.scales)
    jacobian2 = 0.0
    for j in range(3):
        for i in range(3):
            jacobian2 += bordered[8 + j, 8 + i] ** 2
    return jacobian2


@kernel
def _damped_step(equations: _Equations, damping: float, step: Array) -> None:
    """Least-squares solution of ``J step = -r`` and ``sqrt(damping) step = 0``: `step` (3,)."""
    bordered, diagonal, scales = equations.bordered, equations.diagonal, equations.scales
    system = np.empty((4, 6))
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
def _reach_rank_8(equations: _Equations, R: Array, y: Array) -> bool:
    """Move `R` (3, 3) in place to a rotation where A(R) has rank 8, with null vector `y` (9,).

    Levenberg-Marquardt; the damping is relative to the squared size of the Jacobian.
    """
    trial, step = np.empty(9), np.empty(3)
    y[:] = 1.0
    _fill_columns(equations, R)
    sigma = _null_vector(equations, y)
    damping = 1e-8
    jacobian2 = 0.0
    accepted = True
    for _ in range(30):
        if accepted:
            jacobian2 = _linearise(equations, R, y)
        _damped_step(equations, damping * jacobian2, step)
        length = normalise(step)
        if not length < math.inf:
            return False
        step *= min(length, 0.2)
        R_trial = exp_so3(step) @ R
        limit = _SINGULAR * _fill_columns(equations, R_trial)
        copy_vector(y, trial)
        sigma_trial = _null_vector(equations, trial)
        accepted = sigma_trial < sigma or sigma_trial < limit
        if accepted:
            copy_matrix(R_trial, R)
            copy_vector(trial, y)
            sigma = sigma_trial
            damping = max(0.01 * damping, 1e-20)
            # The step before the last is this long: the iteration squares it.
            if sigma < limit and length < 1e-6:
                return math.isfinite(y[0])
        else:
            damping *= 100.0
            if damping > 1e4:
                return False
    return False


@kernel
def solve_uniform_11pt(sample: Sample, known: Knowledge, out: Solutions) -> int:
    """A rotation at which the 11x9 matrix A(R) has rank 8; its null vector is (t, d_1, d_2).

    The solution that the known rotation reaches, or those that the rotations reach of the angular
    5-point solver on the first five matches (section 'Uniform 11-point algorithm'). These are not
    all that there are: at low velocities solutions lie within 0.1 to 0.3 degrees of each other,
    and a start is attracted by any of them.

    On a flight of constant velocity A has a null space of dimension 3, as for `linear_9pt`.
    """
    factors = row_time_factors(sample)
    if not factors.observable:
        return 0
    starts = 1
    start = Solutions(np.empty((MAX_STARTS, 3, 3)), np.zeros((MAX_STARTS, 9)))
    copy_matrix(known.rotation, start.R[0])
    if not known.predicted:
        starts = solve_5pt(Sample(sample.f1[:5], sample.f2[:5], sample.tau1[:5], sample.tau2[:5]),
                           known, start)
    points = sample.f1.shape[0]
    equations = _Equations(sample, factors, np.empty((9, points)), np.empty((12, points)),
                           np.empty((11, points)), np.empty(9), np.empty(9))
    y = np.empty(9)
    count = 0
    for k in range(starts):
        R, x = out.R[count], out.x[count]
        copy_matrix(start.R[k], R)
        if _reach_rank_8(equations, R, y) and translation_and_velocities(y, factors, x):
            point_forward(sample, R, x)
            count += 1
    return count
