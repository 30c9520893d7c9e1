"""The paper's five minimal algorithms and the global-shutter 5-point, as pure functions.

All solve ``(f_1 x R f_2) . (t - tau_1 d_1 + tau_2 d_2) = 0`` (docs/conventions.md, equation 4),
with ``d_1 = v_1`` and ``d_2 = R v_2``, and differ in the rays, the columns kept and what is known
of R:

=============  ========  =======  ==========================
algorithm      rays      columns  unknown of the rotation
=============  ========  =======  ==========================
`linear_9pt`   measured  9        yaw about gravity
`angular_5pt`  derotated 3        all
`angular_3pt`  derotated 3        yaw about gravity
`uniform_11pt` derotated 9        all
`uniform_9pt`  derotated 9        yaw about gravity
`global_5pt`   measured  3        all
=============  ========  =======  ==========================

The constraint is the same for (t, d_1, d_2) and its negative; the sign returned is the one that
puts more of the points in front of both cameras, each seen from where the cameras were at its own
rows (as the paper's section 'Solver' leaves open).

References
----------
C.-R. Lee and K.-J. Yoon, *Inertial-aided Rolling Shutter Relative Pose Estimation*, sections
'Minimal Algorithms' and 'Solver'.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.solvers import eleven_point, five_point, inputs, nine_point, three_point
from rs_relpose_ros.solvers.gravity import gravity_alignment
from rs_relpose_ros.solvers.solution import MinimalSolution

Array = NDArray[np.float64]

# Rotations closer than this [rad] were reached from different starts but are one solution.
_SAME_SOLUTION = 1e-7


def linear_9pt(rays1: ArrayLike, rays2: ArrayLike, tau1: ArrayLike, tau2: ArrayLike, *,
               gravity1: ArrayLike | None = None, gravity2: ArrayLike | None = None,
               start_rotations: ArrayLike | None = None) -> list[MinimalSolution]:
    """Linear 9-point algorithm: gravity known, no angular velocity.

    Parameters
    ----------
    rays1, rays2 : (9, 3) array_like
        Rays as measured, each in its own camera's frame; any length but zero.
    tau1, tau2 : (9,) array_like
        Row times [s] relative to the reference row.
    gravity1, gravity2 : (3,) array_like
        Direction of free fall in each camera's frame at the reference row, any length.
    start_rotations : optional
        Not used: all solutions are found without.

    Returns
    -------
    list of MinimalSolution
        All real solutions, at most 12. Empty where all row times of a frame, or all differences
        of row times, are equal: velocities are then not observable.

    Raises
    ------
    InputError
        A wrong shape, a value that is not finite, a zero vector, or no gravity.

    Notes
    -----
    With gravity on z in both frames ``R = A_1^T Rz(psi) A_2``, and the determinant of the 9x9
    matrix A(psi) (section 'Linear 9-point algorithm') is a trigonometric polynomial of degree 6.
    It is sampled at 13 angles; its zeros are those of a polynomial of degree 12 in the tangent of
    the half angle, each polished by Newton's method on the determinant. A conjugate pair of roots
    within 1e-3 of a real angle counts as that angle.

    On a flight of constant velocity (``d_1``, ``d_2`` parallel to t), and so for any
    global-shutter camera, A has a null space of dimension 3: R is found, but (t, d_1, d_2) is an
    arbitrary vector of that space. Use the angular solvers there.
    """
    return _gravity_9pt(rays1, rays2, tau1, tau2, gravity1, gravity2)


def uniform_9pt(rays1: ArrayLike, rays2: ArrayLike, tau1: ArrayLike, tau2: ArrayLike, *,
                gravity1: ArrayLike | None = None, gravity2: ArrayLike | None = None,
                start_rotations: ArrayLike | None = None) -> list[MinimalSolution]:
    """Uniform 9-point algorithm: gravity and angular velocity known.

    As `linear_9pt`, but the rays are derotated, ``f_i = Exp(w_i tau_i) m_i``
    (section 'Uniform 9-point algorithm').
    """
    return _gravity_9pt(rays1, rays2, tau1, tau2, gravity1, gravity2)


def _gravity_9pt(rays1: ArrayLike, rays2: ArrayLike, tau1: ArrayLike, tau2: ArrayLike,
                 gravity1: ArrayLike | None, gravity2: ArrayLike | None) -> list[MinimalSolution]:
    f1, f2, times1, times2 = _matches(rays1, rays2, tau1, tau2, 9)
    A1, A2 = _alignments(gravity1, gravity2)
    R = np.empty((nine_point.MAX_SOLUTIONS, 3, 3))
    x = np.empty((nine_point.MAX_SOLUTIONS, 9))
    count = nine_point.uniform_9pt_kernel(f1, f2, times1, times2, A1, A2, R, x)
    return [_solution(R[k], x[k]) for k in range(count)]


def angular_3pt(rays1: ArrayLike, rays2: ArrayLike, tau1: ArrayLike, tau2: ArrayLike, *,
                gravity1: ArrayLike | None = None, gravity2: ArrayLike | None = None,
                start_rotations: ArrayLike | None = None) -> list[MinimalSolution]:
    """Angular 3-point algorithm: gravity and angular velocity known, no linear velocity.

    Parameters
    ----------
    rays1, rays2 : (3, 3) array_like
        Derotated rays, one per row, each in its own camera's frame; any length but zero.
    tau1, tau2 : (3,) array_like
        Row times [s]. They are in the rays already: checked, not used.
    gravity1, gravity2 : (3,) array_like
        Direction of free fall in each camera's frame at the reference row, any length.
    start_rotations : optional
        Not used: all solutions are found without.

    Returns
    -------
    list of MinimalSolution
        All real solutions, at most 4, with zero velocities. The model is exact for a global
        shutter and on a flight of constant velocity.

    Raises
    ------
    InputError
        A wrong shape, a value that is not finite, a zero vector, or no gravity.

    Notes
    -----
    As `linear_9pt`, with a 3x3 matrix (section 'Angular 3-point algorithm') whose determinant has
    degree 2: five samples, a polynomial of degree 4. For the global shutter it is the upright
    3-point problem of Fraundorfer et al. (ECCV 2010).
    """
    f1, f2, _, _ = _matches(rays1, rays2, tau1, tau2, 3)
    A1, A2 = _alignments(gravity1, gravity2)
    R = np.empty((three_point.MAX_SOLUTIONS, 3, 3))
    t = np.empty((three_point.MAX_SOLUTIONS, 3))
    count = three_point.angular_3pt_kernel(f1, f2, A1, A2, R, t)
    return [_solution(R[k], t[k]) for k in range(count)]


def angular_5pt(rays1: ArrayLike, rays2: ArrayLike, tau1: ArrayLike, tau2: ArrayLike, *,
                gravity1: ArrayLike | None = None, gravity2: ArrayLike | None = None,
                start_rotations: ArrayLike | None = None) -> list[MinimalSolution]:
    """Angular 5-point algorithm: angular velocity known, no linear velocity.

    Parameters
    ----------
    rays1, rays2 : (5, 3) array_like
        Derotated rays, each in its own camera's frame; any length but zero.
    tau1, tau2 : (5,) array_like
        Row times [s]. They are in the rays already: checked, not used.
    gravity1, gravity2, start_rotations : optional
        Not used.

    Returns
    -------
    list of MinimalSolution
        One for each real essential matrix, at most 10, with zero velocities: of its four
        decompositions the one that puts most points in front of both cameras.

    Raises
    ------
    InputError
        A wrong shape, a value that is not finite, or a zero vector.

    Notes
    -----
    On derotated rays (section 'Angular 5-point algorithm') this is the calibrated 5-point problem;
    see `rs_relpose_ros.solvers.five_point`.
    """
    return _calibrated_5pt(rays1, rays2, tau1, tau2)


def global_5pt(rays1: ArrayLike, rays2: ArrayLike, tau1: ArrayLike, tau2: ArrayLike, *,
               gravity1: ArrayLike | None = None, gravity2: ArrayLike | None = None,
               start_rotations: ArrayLike | None = None) -> list[MinimalSolution]:
    """Global-shutter 5-point algorithm, the paper's baseline: `angular_5pt` on measured rays."""
    return _calibrated_5pt(rays1, rays2, tau1, tau2)


def _calibrated_5pt(rays1: ArrayLike, rays2: ArrayLike, tau1: ArrayLike,
                    tau2: ArrayLike) -> list[MinimalSolution]:
    f1, f2, _, _ = _matches(rays1, rays2, tau1, tau2, 5)
    R = np.empty((five_point.MAX_SOLUTIONS, 3, 3))
    t = np.empty((five_point.MAX_SOLUTIONS, 3))
    count = five_point.five_point_kernel(f1, f2, R, t)
    return [_solution(R[k], t[k]) for k in range(count)]


def uniform_11pt(rays1: ArrayLike, rays2: ArrayLike, tau1: ArrayLike, tau2: ArrayLike, *,
                 gravity1: ArrayLike | None = None, gravity2: ArrayLike | None = None,
                 start_rotations: ArrayLike | None = None) -> list[MinimalSolution]:
    """Uniform 11-point algorithm: angular velocity known.

    Parameters
    ----------
    rays1, rays2 : (11, 3) array_like
        Derotated rays, each in its own camera's frame; any length but zero.
    tau1, tau2 : (11,) array_like
        Row times [s] relative to the reference row.
    gravity1, gravity2 : optional
        Not used.
    start_rotations : (K, 3, 3) array_like
        Rotations to start from: the gyro's prediction, or those of `angular_5pt`.

    Returns
    -------
    list of MinimalSolution
        The distinct solutions reached, at most one from each start; not all that there are. At
        low velocities solutions lie within 0.1 to 0.3 degrees of each other, and a start is
        attracted by any of them.

    Raises
    ------
    InputError
        A wrong shape, a value that is not finite, a zero vector, no start, or a start that is no
        rotation.

    Notes
    -----
    R makes the rank of the 11x9 matrix (section 'Uniform 11-point algorithm') 8; see
    `rs_relpose_ros.solvers.eleven_point`. What `linear_9pt` says of constant velocity holds.
    """
    f1, f2, times1, times2 = _matches(rays1, rays2, tau1, tau2, 11)
    starts = inputs.rotations('start_rotations', start_rotations)
    solutions: list[MinimalSolution] = []
    for start in starts:
        R, x = np.empty((3, 3)), np.empty(9)
        if not eleven_point.uniform_11pt_kernel(f1, f2, times1, times2, start, R, x):
            continue
        # |R - R'| = 2 sqrt(2) |sin(angle / 2)|
        if all(np.linalg.norm(R - known.R) > np.sqrt(2.0) * _SAME_SOLUTION for known in solutions):
            solutions.append(_solution(R, x))
    return solutions


def _matches(rays1: ArrayLike, rays2: ArrayLike, tau1: ArrayLike, tau2: ArrayLike,
             count: int) -> tuple[Array, Array, Array, Array]:
    return (inputs.rays('rays1', rays1, count), inputs.rays('rays2', rays2, count),
            inputs.row_times('tau1', tau1, count), inputs.row_times('tau2', tau2, count))


def _alignments(gravity1: ArrayLike | None, gravity2: ArrayLike | None) -> tuple[Array, Array]:
    return (gravity_alignment(inputs.gravity('gravity1', gravity1)),
            gravity_alignment(inputs.gravity('gravity2', gravity2)))


def _solution(R: Array, x: Array) -> MinimalSolution:
    """From t or ``(t, d_1, d_2)`` in frame 1."""
    if len(x) == 3:
        return MinimalSolution(R.copy(), x.copy(), np.zeros(3), np.zeros(3))
    return MinimalSolution(R.copy(), x[:3].copy(), x[3:6].copy(), R.T @ x[6:])
