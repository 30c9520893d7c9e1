"""Solvers with linear velocities: uniform and linear 9-point (gravity known), uniform 11-point."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.jit import kernel
from rs_relpose_ros.solvers import algebra, common
from rs_relpose_ros.solvers.angular import MAX_5PT, solve_5pt
from rs_relpose_ros.solvers.common import AlignedRays, Knowledge, RowTimeFactors, Sample, Solutions

MAX_9PT = 12
# Of the determinant of A(psi). Not 9: its leading complex coefficient matrix loses rank.
DEGREE = 6
HALF_ANGLE, NODES = algebra.half_angle_matrix(DEGREE), algebra.half_angle_nodes(DEGREE)


class _NineEquations(NamedTuple):
    """``A(psi) y = 0`` with the rows ``[n, p n, q n]``, and work arrays for one psi."""

    rays: AlignedRays
    factors: RowTimeFactors
    A: Array
    pivots: NDArray[np.int64]
    n: Array
    dn: Array
    left: Array


@kernel
def _fill(equations: _NineEquations, c: float, s: float) -> None:
    """Write A, n and ``dn / dpsi`` at the yaw with cosine c and sine s."""
    A, n, p, q = equations.A, equations.n, equations.factors.p, equations.factors.q
    common.normals_at_yaw(equations.rays, c, s, n, equations.dn)
    for k in range(9):
        for i in range(3):
            A[k, i], A[k, 3 + i], A[k, 6 + i] = n[k, i], p[k] * n[k, i], q[k] * n[k, i]


@kernel
def _null_vectors(equations: _NineEquations, y: Array) -> float:
    """One inverse iteration for the smallest singular value, which is returned.

    A is overwritten by its factors; `y` (9,) is the first guess and receives the right singular
    vector, `left` the left one.
    """
    A, pivots, u = equations.A, equations.pivots, equations.left
    algebra.lu_factor(A, pivots)
    so3.copy_vector(y, u)
    algebra.lu_solve_transposed(A, pivots, u)
    algebra.normalise(u)
    so3.copy_vector(u, y)
    algebra.lu_solve(A, pivots, y)
    return 1.0 / algebra.normalise(y)


@kernel
def _polish(equations: _NineEquations, start: float, farthest: float,
            y: Array) -> tuple[float, bool]:
    """Newton's method on the determinant: its zero, whether it has converged, and `y` (9,) there.

    The step is that of the factors of A, without the rounding of a polynomial. A zero farther than
    `farthest` [rad] from the start counts as not converged.
    """
    p, q, u = equations.factors.p, equations.factors.q, equations.left
    psi = start
    y[:] = 1.0
    for iteration in range(8):
        _fill(equations, math.cos(psi), math.sin(psi))
        sigma = _null_vectors(equations, y)
        # d(log det) / dpsi = trace(A^-1 dA / dpsi) ~ u . (dA y) / sigma
        slope = 0.0
        for k in range(9):
            for i in range(3):
                slope += u[k] * equations.dn[k, i] * (y[i] + p[k] * y[3 + i] + q[k] * y[6 + i])
        step = sigma / slope
        # y is that of the angle before the last step, from at least two inverse iterations.
        if iteration > 0 and abs(step) < 1e-13:
            return psi - step, True
        psi -= step
        if not abs(psi - start) < farthest:
            break
    return psi, False


@kernel
def _nearest_vector(equations: _NineEquations, psi: float, y: Array) -> None:
    """Write to `y` (9,) the right singular vector of the smallest singular value of ``A(psi)``."""
    y[:] = 1.0
    for _ in range(2):
        _fill(equations, math.cos(psi), math.sin(psi))
        _null_vectors(equations, y)


@kernel
def _write_solution(equations: _NineEquations, psi: float, y: Array, sample: Sample,
                    known: Knowledge, R: Array, x: Array) -> bool:
    """R and x of one yaw and null vector; False if it is no finite solution."""
    if not (math.isfinite(y[0]) and common.translation_and_velocities(y, equations.factors, x)):
        return False
    common.rotation_from_yaw(equations.rays.centre + psi, known, R)
    for k in range(0, 9, 3):  # t, d_1, d_2, from the aligned frame to camera 1
        vector = so3.rotated_back(known.align1, (x[k], x[k + 1], x[k + 2]))
        for i in range(3):
            x[k + i] = vector[i]
    common.point_forward(sample, R, x)
    return True


@kernel
def solve_gravity_9pt(sample: Sample, known: Knowledge, out: Solutions) -> int:
    """A yaw psi at which the 9x9 matrix A(psi) is singular; its null vector is (t, d_1, d_2).

    With gravity on z in both frames ``R = A_1^T Rz(psi) A_2``, and the determinant of A(psi)
    (section 'Linear 9-point algorithm') is a trigonometric polynomial of degree 6. It is sampled
    at 13 angles; its zeros are those of a polynomial of degree 12 in the tangent of the half
    angle, each polished by Newton's method on the determinant. A conjugate pair of roots within
    1e-3 of a real angle counts as that angle.

    For a constant velocity (``d_1``, ``d_2`` parallel to t), and so for any global-shutter camera,
    A has a null space of dimension 3: R is found, but (t, d_1, d_2) is an arbitrary vector of that
    space. Use the angular solvers in this case.

    There is no solution if all row times of a frame, or all differences of row times, are equal:
    velocities are not observable.
    """
    factors = common.row_time_factors(sample)
    if not factors.observable:
        return 0
    equations = _NineEquations(
        common.align_rays(sample, known), factors, np.empty((9, 9)), np.empty(9, dtype=np.int64),
        np.empty((9, 3)), np.empty((9, 3)), np.empty(9))
    angles, half_gaps = np.empty(MAX_9PT), np.empty(MAX_9PT)
    zoom, samples = equations.rays.zoom, np.empty(NODES.shape[0])
    for k in range(NODES.shape[0]):
        c, s, weight = algebra.sample_angle(NODES[k], zoom)
        _fill(equations, c, s)
        samples[k] = algebra.lu_factor(equations.A, equations.pivots) * weight**DEGREE
    found = algebra.angles_of_zeros(samples, HALF_ANGLE, zoom, angles, half_gaps)
    y, yaws = np.empty(9), np.empty(MAX_9PT)
    count = 0
    for k in range(found):
        middle, gap = angles[k], half_gaps[k]
        # Two attempts: a pair may be two real roots that the polynomial does not resolve.
        for side in (-1.0, 1.0):
            # A single root is off by rounding only.
            psi, converged = _polish(equations, middle + side * gap, gap if gap > 0.0 else 1e-3, y)
            if side < 0.0 and not converged:
                # A conjugate pair: the nearest angle, and the singular vector there.
                psi = middle
                _nearest_vector(equations, psi, y)
            if (side < 0.0 or converged) and not algebra.is_known_angle(psi, yaws[:count], 1e-10) \
                    and _write_solution(equations, psi, y, sample, known, out.R[count],
                                        out.x[count]):
                yaws[count] = psi
                count += 1
            if count == MAX_9PT:
                return count
            if gap == 0.0 or not converged:
                break
    return count


# Uniform 11-point solver: the 11x9 matrix A(R) must have rank 8, three equations in the three
# unknowns of R. The paper uses three 9x9 determinants, which are badly scaled. Here, with the
# right singular vector y of the smallest singular value, A is written as ``A [Y, y]``; the part of
# ``A y`` that is perpendicular to the range of ``A Y`` has three components, which vanish exactly
# if the rank is 8, and whose length is the smallest singular value. Their zero is found by
# Levenberg-Marquardt with the derivative of ``A(R) y`` (variable projection, Golub and Pereyra
# 1973, in Kaufman's form).

MAX_11PT = MAX_5PT   # one per start
# Smallest singular value, relative to the size of A, at which the rank is 8.
_SINGULAR = 1e-13


class _ElevenEquations(NamedTuple):
    """``A(R) y = 0`` with the rows ``[n, p n, q n]``, and work arrays for one R."""

    sample: Sample
    factors: RowTimeFactors
    columns: Array   # (9, 11) of A
    # (12, 11) ``[A Y, dA y / dtheta, A y]``, triangularised: J^T in [8:11, 8:], r in [11, 8:].
    bordered: Array
    work: Array   # (11, 11), overwritten as the next two
    diagonal: Array   # (9,)
    scales: Array   # (9,)


@kernel
def _fill_columns(equations: _ElevenEquations, R: Array) -> float:
    """Write the nine columns of A(R); the Frobenius norm of A."""
    sample, columns = equations.sample, equations.columns
    p, q = equations.factors.p, equations.factors.q
    total = 0.0
    for k in range(sample.f1.shape[0]):
        n = so3.cross(sample.f1[k], so3.rotated(R, sample.f2[k]))
        for i in range(3):
            columns[i, k] = n[i]
            columns[3 + i, k] = p[k] * n[i]
            columns[6 + i, k] = q[k] * n[i]
            total += n[i] * n[i] * (1.0 + p[k] * p[k] + q[k] * q[k])
    return math.sqrt(total)


@kernel
def _null_vector(equations: _ElevenEquations, y: Array) -> float:
    """Smallest singular value, with its right singular vector in `y` (9,).

    Inverse iteration from `y` with the R factor of A, without ``A^T A``.
    """
    n = equations.columns.shape[0]
    factor, diagonal = equations.work[:n], equations.diagonal
    so3.copy_matrix(equations.columns, factor)
    algebra.triangularise(factor, n, diagonal, equations.scales)
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
        algebra.normalise(y)
        for k in range(n - 1, -1, -1):
            y[k] /= diagonal[k]
            for i in range(k):
                y[i] -= factor[k, i] * y[k]
        length = algebra.normalise(y)
    return 1.0 / length


@kernel
def _linearise(equations: _ElevenEquations, R: Array, y: Array) -> float:
    """Write the rank conditions r and J, R moving as ``Exp(theta) R``; ``|J|^2``."""
    sample, columns, bordered = equations.sample, equations.columns, equations.bordered
    p, q = equations.factors.p, equations.factors.q
    # A reflection maps e_9 to +-y; its other columns Y are perpendicular to y.
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
        by_theta = so3.cross(so3.rotated(R, sample.f2[k]), so3.cross(b, sample.f1[k]))
        for i in range(3):
            bordered[8 + i, k] = by_theta[i]
        bordered[11, k] = Ay
    algebra.triangularise(bordered, 8, equations.diagonal, equations.scales)
    jacobian2 = 0.0
    for j in range(3):
        for i in range(3):
            jacobian2 += bordered[8 + j, 8 + i] ** 2
    return jacobian2


@kernel
def _damped_step(equations: _ElevenEquations, damping: float, step: Array) -> None:
    """Least-squares solution of ``J step = -r`` and ``sqrt(damping) step = 0``: `step` (3,)."""
    bordered, diagonal, scales = equations.bordered, equations.diagonal, equations.scales
    system = np.empty((4, 6))
    for j in range(4):
        for i in range(3):
            system[j, i] = bordered[8 + j, 8 + i]
            system[j, 3 + i] = math.sqrt(damping) if i == j else 0.0
    algebra.triangularise(system[:3], 3, diagonal, scales)
    for k in range(3):
        algebra.reflect(system[k], scales[k], k, system[3])
    for k in range(2, -1, -1):
        total = -system[3, k]
        for j in range(k + 1, 3):
            total -= system[j, k] * step[j]
        step[k] = total / diagonal[k]


@kernel
def _reach_rank_8(equations: _ElevenEquations, R: Array, y: Array) -> bool:
    """Move `R` (3, 3) in place to a rotation with rank 8 of A(R) and null vector `y` (9,).

    Levenberg-Marquardt; the damping is relative to the squared norm of the Jacobian.
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
        length = algebra.normalise(step)
        if not length < math.inf:
            return False
        step *= min(length, 0.2)
        R_trial = so3.exp_so3(step) @ R
        limit = _SINGULAR * _fill_columns(equations, R_trial)
        so3.copy_vector(y, trial)
        sigma_trial = _null_vector(equations, trial)
        accepted = sigma_trial < sigma or sigma_trial < limit
        if accepted:
            so3.copy_matrix(R_trial, R)
            so3.copy_vector(trial, y)
            sigma = sigma_trial
            damping = max(0.01 * damping, 1e-20)
            # The next step would be as short as the square of this one.
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

    Iterative, from the known rotation, or from the rotations of the angular 5-point solver on the
    first five matches (section 'Uniform 11-point algorithm'). It does not find all solutions: at
    low velocities they are 0.1 to 0.3 degrees apart, and a start converges to any of them.

    For a constant velocity A has a null space of dimension 3, as for `linear_9pt`.
    """
    factors = common.row_time_factors(sample)
    if not factors.observable:
        return 0
    starts = 1
    start = Solutions(np.empty((MAX_5PT, 3, 3)), np.zeros((MAX_5PT, 9)))
    so3.copy_matrix(known.rotation, start.R[0])
    if not known.predicted:
        starts = solve_5pt(Sample(sample.f1[:5], sample.f2[:5], sample.tau1[:5], sample.tau2[:5]),
                           known, start)
    points = sample.f1.shape[0]
    equations = _ElevenEquations(
        sample, factors, np.empty((9, points)), np.empty((12, points)), np.empty((11, points)),
        np.empty(9), np.empty(9))
    y = np.empty(9)
    count = 0
    for k in range(starts):
        R, x = out.R[count], out.x[count]
        so3.copy_matrix(start.R[k], R)
        if _reach_rank_8(equations, R, y) and common.translation_and_velocities(y, factors, x):
            common.point_forward(sample, R, x)
            count += 1
    return count
