"""Solvers with gravity known, and the uniform 11-point solver."""

import numpy as np

from rs_relpose_ros.core.least_squares import cholesky, newton_step
from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.jit import kernel
from rs_relpose_ros.solvers import algebra, common
from rs_relpose_ros.solvers.angular import MAX_5PT, solve_5pt
from rs_relpose_ros.solvers.common import Knowledge, Sample, Solutions

# Degree in the yaw of the determinant of 3 points. A smaller degree would lose solutions.
# [derived: each row is linear in the cosine and the sine, and one combination of rows is constant]
_DEGREE_3 = 2
# Degree in the yaw of the determinant of 9 points. It is 6 and not 9, because the leading complex
# coefficient matrix loses rank. [derived: rank 6 of the coefficients of exp(i psi)]
_DEGREE_9 = 6
# Most solutions with 3 points. [derived: a trigonometric polynomial has two zeros per degree]
MAX_3PT = 2 * _DEGREE_3
# Most solutions with 9 points. [derived: as with 3 points]
MAX_9PT = 2 * _DEGREE_9
# Most solutions with 11 points: one per start, and the 5-point solver gives the starts.
# [derived: its number of solutions]
MAX_11PT = MAX_5PT
# Matrix from samples of the determinant of 3 points to its coefficients. [derived: interpolation
# at the nodes below]
_MATRIX_3 = algebra.half_angle_matrix(_DEGREE_3)
# The same for 9 points. [derived: as with 3 points]
_MATRIX_9 = algebra.half_angle_matrix(_DEGREE_9)
# Half angles of the samples with 3 points. [derived: evenly distributed]
_NODES_3 = algebra.half_angle_nodes(_DEGREE_3)
# The same for 9 points. [derived: as with 3 points]
_NODES_9 = algebra.half_angle_nodes(_DEGREE_9)
# Most steps that polish a yaw. A double root, towards which each step only halves the error, needs
# this many; fewer would lose it. [chosen: any value in 15..30 would do]
_YAW_STEPS = 20
# Most steps that polish a rotation of rank 8: it is nearly exact before them.
# [chosen: any value in 4..15 would do]
_RANK_STEPS = 8


@kernel
def solve_with_gravity(sample: Sample, known: Knowledge, out: Solutions) -> int:
    """Find each yaw psi at which A(psi) is singular; its null vector is t, or (t, d_1, d_2).

    With gravity on z in both frames ``R = A_1^T Rz(psi) A_2``, and the determinant of A(psi)
    (sections 'Angular 3-point algorithm' and 'Linear 9-point algorithm') is a trigonometric
    polynomial of degree 2 with 3 points and of degree 6 with 9 points. It is sampled at 5 or 13
    angles. Its zeros are the zeros of a polynomial of twice that degree in the tangent of the half
    angle, and Newton's method polishes each of them. A conjugate pair of roots within 1e-3 of a
    real angle counts as that angle.

    With 3 points the result is exact for a global shutter, for which this is the upright 3-point
    problem of Fraundorfer et al. (ECCV 2010), and for a constant velocity. With 9 points and a
    constant velocity (``d_1``, ``d_2`` parallel to t), and so for any global-shutter camera, A has
    a null space of dimension 3: R is found, but (t, d_1, d_2) is an arbitrary vector of that
    space. There is no solution if all row times of a frame, or all differences of row times, are
    equal, because velocities are not observable then.
    """
    factors = common.row_time_factors(sample)
    n = len(sample.f1)
    degree = _DEGREE_3
    matrix = _MATRIX_3
    nodes = _NODES_3
    if n == 9:
        if not factors.observable:
            return 0
        degree = _DEGREE_9
        matrix = _MATRIX_9
        nodes = _NODES_9
    centre, zoom = common.yaw_cluster(sample, known)
    R = np.empty((3, 3))
    A = np.empty((n, n))
    pivots = np.empty(n, np.int64)
    samples = np.empty(len(nodes))
    for k in range(len(nodes)):
        angle, weight = algebra.sample_angle(nodes[k], zoom)
        common.rotation_from_yaw(centre + angle, known, R)
        common.write_rows(sample, factors, R, A, 0)
        samples[k] = algebra.lu_factor(A, pivots) * weight**degree
    angles = np.empty(2 * degree)
    half_gaps = np.empty(2 * degree)
    found = algebra.angles_of_zeros(matrix @ samples, zoom, angles, half_gaps)
    return _solutions_of_yaws(
        sample, known, factors, centre + angles[:found], half_gaps[:found], out
    )


@kernel
def _solutions_of_yaws(
    sample: Sample,
    known: Knowledge,
    factors: common.RowTimeFactors,
    yaws: Array,
    half_gaps: Array,
    out: Solutions,
) -> int:
    """Polish each yaw (K,) [rad] and write the solutions to `out`; returns their number.

    `half_gaps` (K,): half the distance of the two roots of which a yaw is the mean, otherwise 0.
    """
    n = len(sample.f1)
    A = np.empty((n, n))
    pivots = np.empty(n, np.int64)
    y = np.empty(n)
    axes = known.align1[2:]  # R moves about gravity
    count = 0
    for k in range(len(yaws)):
        # Two attempts: a pair may be two real roots that the polynomial does not resolve.
        for side in (-1.0, 1.0):
            R = out.R[count]
            common.rotation_from_yaw(yaws[k] + side * half_gaps[k], known, R)
            common.write_rows(sample, factors, R, A, 0)
            algebra.lu_factor(A, pivots)
            y[:] = 1.0
            algebra.lu_solve(A, pivots, y)  # one step of inverse iteration
            algebra.normalise(y)
            converged = common.polish(sample, factors, axes, R, y, int(_YAW_STEPS))
            if not converged:  # a conjugate pair: its real angle is the nearest one
                common.rotation_from_yaw(yaws[k], known, R)
                common.write_nearest_vector(sample, factors, R, y)
            if (
                (converged or side < 0.0)
                and not common.is_known(R, out.R[:count])
                and common.write_solution(sample, factors, R, y, out.x[count])
            ):
                count += 1
            if count == len(out.R):
                return count
            if half_gaps[k] == 0.0 or not converged:
                break
    return count


@kernel
def _reach_rank_8(sample: Sample, factors: common.RowTimeFactors, R: Array, y: Array) -> bool:
    """Move `R` (3, 3) in place to a rotation with rank 8 of A(R) and null vector `y` (9,).

    Levenberg-Marquardt minimises the smallest singular value, whose vector y is a function of R
    (variable projection); then Newton's method polishes. Returns whether that has converged.
    """
    axes = np.eye(3)
    R_new = R.copy()
    error = np.inf
    damping = 0.1
    system = np.zeros((12, 12))
    right = np.empty(12)
    factor = np.zeros((12, 12))
    hessian = np.zeros((12, 12))
    gradient = np.zeros(12)
    damped = np.eye(12)
    damped[3:] *= 1e-9  # y needs just enough damping for Cholesky's method
    for _ in range(30):
        common.write_nearest_vector(sample, factors, R_new, y)
        squares, size2 = common.linearise(sample, factors, axes, R_new, y, system, right)
        damping *= 0.1 if squares < error else 10.0
        if squares < error:
            error = squares
            so3.copy_matrix(R_new, R)
            if error < 1e-20 * size2:
                return common.polish(sample, factors, axes, R, y, int(_RANK_STEPS))
            hessian = system.T @ system
            gradient = -(system.T @ right)
        cholesky(hessian + damping * damped, factor)
        so3.multiply(so3.exp_so3(newton_step(factor, gradient)[:3]), R, R_new)
    return False


@kernel
def solve_uniform_11pt(sample: Sample, known: Knowledge, out: Solutions) -> int:
    """Find a rotation at which the 11x9 matrix A(R) has rank 8; its null vector is (t, d_1, d_2).

    The solver iterates from the known rotation, or from the rotations of the angular 5-point
    solver on the first five matches (section 'Uniform 11-point algorithm'; the paper's three 9x9
    determinants are badly scaled). It does not find all solutions: at low velocities they are 0.1
    to 0.3 degrees apart, and a start converges to any of them. For a constant velocity A has a
    null space of dimension 3, as for `linear_9pt`.
    """
    factors = common.row_time_factors(sample)
    if not factors.observable:
        return 0
    starts = 1
    start = Solutions(np.empty((MAX_5PT, 3, 3)), np.zeros((MAX_5PT, 9)))
    so3.copy_matrix(known.rotation, start.R[0])
    if not known.predicted:
        starts = solve_5pt(
            Sample(sample.f1[:5], sample.f2[:5], sample.tau1[:5], sample.tau2[:5]), known, start
        )
    y = np.empty(9)
    count = 0
    for k in range(starts):
        R = out.R[count]
        so3.copy_matrix(start.R[k], R)
        if (
            _reach_rank_8(sample, factors, R, y)
            and not common.is_known(R, out.R[:count])
            and common.write_solution(sample, factors, R, y, out.x[count])
        ):
            count += 1
    return count
