"""Solvers with linear velocities: uniform and linear 9-point (gravity known), uniform 11-point.

Both decompose the matrix A of their model, ``A y = 0``, by LAPACK: they are for comparison with
the paper, `auto` does not use them.
"""

import math
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.jit import kernel
from rs_relpose_ros.solvers import algebra, common
from rs_relpose_ros.solvers.angular import MAX_5PT, solve_5pt
from rs_relpose_ros.solvers.common import AlignedRays, Knowledge, RowTimeFactors, Sample, Solutions

MAX_9PT = 12
# Of the determinant of A(psi). Not 9: its leading complex coefficient matrix loses rank.
DEGREE = 6
HALF_ANGLE, NODES = algebra.half_angle_matrix(DEGREE), algebra.half_angle_nodes(DEGREE)


@kernel
def _rows(normals: Array, factors: RowTimeFactors) -> Array:
    """Rows ``[n, p n, q n]`` (n, 9) of A."""
    A = np.empty((len(normals), 9))
    for k in range(len(normals)):
        for i in range(3):
            A[k, i] = normals[k, i]
            A[k, 3 + i] = factors.p[k] * normals[k, i]
            A[k, 6 + i] = factors.q[k] * normals[k, i]
    return A


@kernel
def _at_yaw(rays: AlignedRays, factors: RowTimeFactors, c: float,
            s: float) -> tuple[Array, Array]:
    """A (9, 9) and ``dA / dpsi`` at the yaw with cosine c and sine s."""
    n, dn = np.empty((9, 3)), np.empty((9, 3))
    common.normals_at_yaw(rays, c, s, n, dn)
    return _rows(n, factors), _rows(dn, factors)


@kernel
def _polish(rays: AlignedRays, factors: RowTimeFactors, start: float,
            farthest: float) -> tuple[float, bool, Array]:
    """Newton's method on the determinant: its zero, whether it has converged, null vector there.

    The step is that of the singular vectors of A, without the rounding of a polynomial. A zero
    farther than `farthest` [rad] from the start counts as not converged.
    """
    psi, converged, y = start, False, np.empty(9)
    for _ in range(8):
        A, dA = _at_yaw(rays, factors, math.cos(psi), math.sin(psi))
        U, sigma, Vt = np.linalg.svd(A)
        y = Vt[8].copy()
        # d(log det) / dpsi = trace(A^-1 dA / dpsi) ~ u . (dA y) / sigma
        step = sigma[8] / (np.ascontiguousarray(U[:, 8]) @ (dA @ y))
        psi -= step
        converged = abs(step) < 1e-13
        if converged or not abs(psi - start) < farthest:
            break
    return psi, converged, y


@kernel
def _write_solution(rays: AlignedRays, factors: RowTimeFactors, psi: float, y: Array,
                    sample: Sample, known: Knowledge, R: Array, x: Array) -> bool:
    """R and x of one yaw and null vector; False if it is no finite solution."""
    if not common.translation_and_velocities(y, factors, x):
        return False
    common.rotation_from_yaw(rays.centre + psi, known, R)
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
    rays = common.align_rays(sample, known)
    angles, half_gaps, yaws = np.empty(MAX_9PT), np.empty(MAX_9PT), np.empty(MAX_9PT)
    samples = np.empty(NODES.shape[0])
    for k in range(NODES.shape[0]):
        c, s, weight = algebra.sample_angle(NODES[k], rays.zoom)
        samples[k] = np.linalg.det(_at_yaw(rays, factors, c, s)[0]) * weight**DEGREE
    found = algebra.angles_of_zeros(samples, HALF_ANGLE, rays.zoom, angles, half_gaps)
    count = 0
    for k in range(found):
        middle, gap = angles[k], half_gaps[k]
        # Two attempts: a pair may be two real roots that the polynomial does not resolve.
        for side in (-1.0, 1.0):
            # A single root is off by rounding only.
            psi, converged, y = _polish(rays, factors, middle + side * gap,
                                        gap if gap > 0.0 else 1e-3)
            if side < 0.0 and not converged:
                # A conjugate pair: the nearest angle, and the singular vector there.
                psi = middle
                A, _ = _at_yaw(rays, factors, math.cos(psi), math.sin(psi))
                y = np.linalg.svd(A)[2][8].copy()
            if (side < 0.0 or converged) and not algebra.is_known_angle(psi, yaws[:count], 1e-10) \
                    and _write_solution(rays, factors, psi, y, sample, known, out.R[count],
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
# right singular vector y of the smallest singular value, the part of ``A y`` that is perpendicular
# to the range of the other eight has three components, which vanish exactly if the rank is 8, and
# whose length is the smallest singular value. Their zero is found by Levenberg-Marquardt with the
# derivative of ``A(R) y`` (variable projection, Golub and Pereyra 1973, in Kaufman's form).

MAX_11PT = MAX_5PT   # one per start
# Smallest singular value, relative to the size of A, at which the rank is 8.
_SINGULAR = 1e-13


class _Decomposed(NamedTuple):
    """Smallest singular value of A(R), and below which the rank is 8; y (9,); left vectors."""

    sigma: float
    limit: float
    y: Array
    across: Array   # (3, 11) u of sigma, and the two that are perpendicular to the range of A


@kernel
def _decomposed(sample: Sample, factors: RowTimeFactors, R: Array) -> _Decomposed:
    normals = np.empty((len(sample.f1), 3))
    for k in range(len(normals)):
        n = so3.cross(sample.f1[k], so3.rotated(R, sample.f2[k]))
        normals[k, 0], normals[k, 1], normals[k, 2] = n
    U, sigma, Vt = np.linalg.svd(_rows(normals, factors))
    return _Decomposed(sigma[8], _SINGULAR * math.sqrt((sigma**2).sum()), Vt[8].copy(),
                       np.ascontiguousarray(U[:, 8:].T))


@kernel
def _reach_rank_8(sample: Sample, factors: RowTimeFactors, R: Array, y: Array) -> bool:
    """Move `R` (3, 3) in place to a rotation with rank 8 of A(R) and null vector `y` (9,).

    Levenberg-Marquardt; the damping is relative to the squared norm of the Jacobian.
    """
    now, damping, J = _decomposed(sample, factors, R), 1e-8, np.empty((3, 3))
    accepted, by_rotation, p, q = True, np.empty((len(sample.f1), 3)), factors.p, factors.q
    for _ in range(30):
        if accepted:
            for k in range(len(by_rotation)):
                # b = y_1 + p y_2 + q y_3, and d((f_1 x h) . b) / dtheta = h x (b x f_1), h = R f_2
                b = (now.y[0] + p[k] * now.y[3] + q[k] * now.y[6],
                     now.y[1] + p[k] * now.y[4] + q[k] * now.y[7],
                     now.y[2] + p[k] * now.y[5] + q[k] * now.y[8])
                by_rotation[k, 0], by_rotation[k, 1], by_rotation[k, 2] = so3.cross(
                    so3.rotated(R, sample.f2[k]), so3.cross(b, sample.f1[k]))
            J = now.across @ by_rotation   # R moving as Exp(theta) R
        # The conditions are (sigma, 0, 0); least squares with the damping.
        U, s, Vt = np.linalg.svd(J)
        step = -now.sigma * Vt.T @ (s / (s**2 + damping * (s**2).sum()) * U[0])
        length = algebra.normalise(step)
        if not length < math.inf:
            return False
        R_trial = so3.exp_so3(min(length, 0.2) * step) @ R
        trial = _decomposed(sample, factors, R_trial)
        accepted = trial.sigma < now.sigma or trial.sigma < trial.limit
        if accepted:
            so3.copy_matrix(R_trial, R)
            now, damping = trial, max(0.01 * damping, 1e-20)
            # The next step would be as short as the square of this one.
            if now.sigma < now.limit and length < 1e-6:
                so3.copy_vector(now.y, y)
                return True
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
    y = np.empty(9)
    count = 0
    for k in range(starts):
        R, x = out.R[count], out.x[count]
        so3.copy_matrix(start.R[k], R)
        if _reach_rank_8(sample, factors, R, y) and common.translation_and_velocities(
                y, factors, x):
            common.point_forward(sample, R, x)
            count += 1
    return count
