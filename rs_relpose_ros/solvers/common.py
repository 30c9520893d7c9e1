"""Common parts of the minimal solvers: signature, cheirality, gravity, columns of the model.

A solver is a kernel that is called by its address. So the robust loop is compiled once, and a
solver is compiled only when it is used.
"""

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import NamedTuple

import numba
import numpy as np

from rs_relpose_ros.core.least_squares import cholesky, newton_step
from rs_relpose_ros.core.triangulate import scaled_depths
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import (
    add,
    column,
    copy_matrix,
    copy_vector,
    cross,
    dot,
    exp_so3,
    multiply,
    norm,
    rotated,
    rotated_back,
    scale,
    subtract,
    write_column,
)
from rs_relpose_ros.jit import inlined_kernel, kernel, KernelInterface, small_kernel
from rs_relpose_ros.solvers.algebra import lu_factor, lu_solve, normalise


class Sample(NamedTuple):
    """A minimal sample of n matches."""

    # (n, 3) unit rays in the frame of camera 1, derotated by the gyro if `Model.derotated`.
    f1: Array
    f2: Array  # (n, 3) the same in the frame of camera 2
    tau1: Array  # (n,) row times in frame 1 [s], relative to the reference row
    tau2: Array  # (n,) row times in frame 2 [s]


class Knowledge(NamedTuple):
    """What is known besides the matches; the flags of `Solver` say which of it a solver uses."""

    align1: Array  # (3, 3) rotates gravity in camera 1 onto +z (`gravity_alignment`)
    align2: Array  # (3, 3) rotates gravity in camera 2 onto +z
    rotation: Array  # (3, 3) the predicted R if `predicted`, otherwise meaningless
    predicted: bool


class Solutions(NamedTuple):
    """Rotations R (K, 3, 3), and x (K, 9): ``t`` (unit), ``d_1, d_2`` in frame 1."""

    R: Array
    x: Array


def empty_solutions(most: int) -> Solutions:
    """Space for `most` solutions; their velocities are zero."""
    return Solutions(np.empty((most, 3, 3)), np.zeros((most, 9)))


def no_knowledge() -> Knowledge:
    """Neither gravity nor a predicted rotation."""
    return Knowledge(np.eye(3), np.eye(3), np.eye(3), False)


class Model(NamedTuple):
    """Model of a solver: rays derotated by the gyro or not, with linear velocities or without."""

    name: str
    derotated: bool
    velocities: bool


@dataclass(frozen=True, slots=True)
class Solver:
    """A row of the table of solvers."""

    name: str
    sample_size: int  # matches of a minimal sample
    model: Model
    # Kernel that writes all solutions and returns their number. The majority of the points
    # decides the sign of t.
    solve: Callable[[Sample, Knowledge, Solutions], int]
    most_solutions: int
    summary: str  # first line of its documentation, which goes on with the docstring of `solve`
    needs_gravity: bool = False  # both alignments of `Knowledge`
    needs_rotation: bool = False  # the predicted rotation of `Knowledge`
    starts_from_rotation: bool = False  # iterative, with `Knowledge.rotation` as first guess

    @property
    def address(self) -> int:
        """Address of the compiled kernel, for `solve_at`; the first use compiles it."""
        return _INTERFACE.address(self.solve)


# The one signature that all solvers have. [derived: `Solver.solve`]
_INTERFACE = KernelInterface(
    numba.int64,
    Sample(*np.empty((2, 1, 3)), *np.empty((2, 1))),
    no_knowledge(),
    empty_solutions(1),
)
# In compiled code: solve_at(address, sample, known, out).
solve_at: Callable[[int, Sample, Knowledge, Solutions], int] = _INTERFACE.call


@kernel
def run_solver(address: int, sample: Sample, known: Knowledge, out: Solutions) -> int:
    """Write the solutions of one sample to `out`; returns their number."""
    return solve_at(address, sample, known, out)


@kernel
def cheirality_votes(sample: Sample, R: Array, x: Array) -> tuple[int, int]:
    """Count the points in front of both cameras for ``x = (t, d_1, d_2)`` (9,), and for ``-x``.

    Each point is triangulated from the positions of the cameras at its own rows:
    ``lambda_1 f_1 - lambda_2 R f_2 = b = t - tau_1 d_1 + tau_2 d_2`` in the least-squares sense.
    """
    front = 0
    behind = 0
    for k in range(len(sample.f1)):
        h = rotated(R, sample.f2[k])
        moved = subtract(scale(sample.tau2[k], x[6:]), scale(sample.tau1[k], x[3:]))
        along1, along2, _ = scaled_depths(sample.f1[k], h, add(x, moved))
        if along1 > 0.0 and along2 > 0.0:
            front += 1
        elif along1 < 0.0 and along2 < 0.0:
            behind += 1
    return front, behind


# Gravity as two degrees of freedom of the relative rotation: with ``A_i g_i = z`` for the unit
# gravity directions g_i of the two cameras,
#
#     R = A_1^T Rz(psi) A_2
#
# has one unknown angle psi. The paper has ``R = R(phi_2, theta_2)^T R(psi) R(phi_1, theta_1)``
# (section 'Gravity and Angular Velocity Measurements'), for the inverse R and a vertical along y.


@kernel
def gravity_alignment(gravity: Array) -> Array:
    """Smallest rotation (3, 3) that takes `gravity` (3,), of any length, to the direction +z."""
    length = norm(gravity)
    x = gravity[0] / length
    y = gravity[1] / length
    z = gravity[2] / length
    horizontal2 = x * x + y * y
    if z < 0.0 and horizontal2 < 1e-30:
        # Opposite to z: every half turn about a horizontal axis is a solution.
        return np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    # 1 / (1 + z), without cancellation near z = -1.
    k = 1.0 / (1.0 + z) if z >= 0.0 else (1.0 - z) / horizontal2
    mixed = -k * x * y
    row_x = [1.0 - k * x * x, mixed, -x]
    row_y = [mixed, 1.0 - k * y * y, -y]
    return np.array([row_x, row_y, [x, y, z]])


@kernel
def rotation_from_yaw(psi: float, known: Knowledge, R: Array) -> None:
    """Write ``A_1^T Rz(psi) A_2`` into `R` (3, 3)."""
    c = math.cos(psi)
    s = math.sin(psi)
    for j in range(3):
        x, y, z = column(known.align2, 0, j)
        turned = (c * x - s * y, s * x + c * y, z)
        write_column(rotated_back(known.align1, turned), R, 0, j)


@kernel
def yaw_cluster(sample: Sample, known: Knowledge) -> tuple[float, float]:
    """Centre and width [rad] of the cluster of solutions in psi.

    The normals of distant points all nearly vanish at the true yaw, so the zeros of their
    determinants cluster there, within about the parallax. With the aligned rays a and b, the
    centre is about ``argmax sum a . Rz(psi) b``, and the width is the rms distance of a and
    Rz(psi) b, limited to [1e-3, 1].
    """
    count = len(sample.f1)
    along = 0.0
    across = 0.0
    total = 0.0
    for k in range(count):
        a = rotated(known.align1, sample.f1[k])
        b = rotated(known.align2, sample.f2[k])
        a_x, a_y, a_z = a
        b_x, b_y, b_z = b
        along += a_x * b_x + a_y * b_y
        across += a_y * b_x - a_x * b_y
        total += dot(a, a) + dot(b, b) - 2.0 * a_z * b_z
    # The largest sum of the products of the horizontal parts is at the centre.
    total -= 2.0 * math.sqrt(along * along + across * across)
    width = math.sqrt(max(total, 0.0) / count)
    return math.atan2(across, along), min(max(width, 1e-3), 1.0)


# The nine columns of the uniform and linear models are made well conditioned here. A row of the
# paper's ``A x = 0`` is ``[n, -tau_1 n, tau_2 n]`` with ``n = f_1 x R f_2`` and
# ``x = (t, d_1, d_2)`` (docs/conventions.md, equation 4). Matched points lie in similar rows, and
# row times are 1e-2 s, so these three blocks are nearly parallel and badly scaled. The kernels
# therefore use
#
#     t - tau_1 d_1 + tau_2 d_2 = y_1 + p y_2 + q y_3
#     p = (tau_1 - m) / s_p,    q = (tau_2 - tau_1) / s_q
#
# with the mean row time m, and p, q of size 1. Both sets of columns span the same space for any
# rotation: their determinants differ by a constant factor, their solutions by a linear map
# (`write_solution`).


class RowTimeFactors(NamedTuple):
    """Row times of a sample, scaled."""

    p: Array  # (n,)
    q: Array  # (n,)
    m: float  # mean row time [s]
    s_p: float  # [s]
    s_q: float  # [s]
    observable: bool  # False for equal row times: velocities are then not observable


@kernel
def row_time_factors(sample: Sample) -> RowTimeFactors:
    """Scale the row times of a sample; p and q stay in [s] if velocities are not observable."""
    tau1 = sample.tau1
    tau2 = sample.tau2
    n = len(tau1)
    m = 0.0
    for k in range(n):
        m += tau1[k] / n
    p = np.empty(n)
    q = np.empty(n)
    s_p = 0.0
    s_q = 0.0
    for k in range(n):
        p[k] = tau1[k] - m
        q[k] = tau2[k] - tau1[k]
        s_p = max(s_p, abs(p[k]))
        s_q = max(s_q, abs(q[k]))
    # Velocity and translation cannot be distinguished if row times are closer than this [s].
    least = 1e-12
    observable = least < s_p < math.inf and least < s_q < math.inf
    if observable:
        for k in range(n):
            p[k] /= s_p
            q[k] /= s_q
    return RowTimeFactors(p, q, m, s_p, s_q, observable)


# All solvers end with Newton's method on ``A(R) y = 0``, which removes the rounding of polynomials
# and eliminations. The unit vector y is t, or (y_1, y_2, y_3).


@kernel
def write_rows(sample: Sample, factors: RowTimeFactors, R: Array, A: Array, first: int) -> None:
    """Write A(R), rows n or ``[n, p n, q n]``, into the columns of `A` from `first` on."""
    with_velocities = A.shape[1] - first > 3
    for k in range(len(sample.f1)):
        n = cross(sample.f1[k], rotated(R, sample.f2[k]))
        row = A[k, first:]
        p = factors.p[k]
        q = factors.q[k]
        for i in range(3):
            row[i] = n[i]
            if with_velocities:
                row[3 + i] = p * n[i]
                row[6 + i] = q * n[i]


@kernel
def write_nearest_vector(sample: Sample, factors: RowTimeFactors, R: Array, y: Array) -> None:
    """Write the vector of the smallest singular value of A(R) into `y`, by inverse iteration."""
    m = len(y)
    A = np.empty((len(sample.f1), m))
    factor = np.zeros((m, m))
    write_rows(sample, factors, R, A, 0)
    gram = A.T @ A
    for i in range(m):
        gram[i, i] += 1e-13
        y[i] = 1.0
    cholesky(gram, factor)
    for _ in range(3):
        copy_vector(newton_step(factor, y), y)
        normalise(y)


@inlined_kernel
def linearise(
    sample: Sample,
    factors: RowTimeFactors,
    axes: Array,
    R: Array,
    y: Array,
    system: Array,
    right: Array,
) -> tuple[float, float]:
    """Write the n + 1 equations of a Newton step of `polish` into `system` and `right`.

    Returns ``|A(R) y|^2`` and ``|A(R)|^2``.
    """
    n = len(sample.f1)
    k = len(axes)
    m = len(y)
    write_rows(sample, factors, R, system, k)
    squares = 0.0
    size2 = 0.0
    for i in range(n):
        # With b = y_1 + p y_2 + q y_3 and h = R f_2, d((f_1 x h) . b) = theta . (h x (b x f_1)).
        b = (y[0], y[1], y[2])
        if m > 3:
            b = add(add(b, scale(factors.p[i], y[3:])), scale(factors.q[i], y[6:]))
        by_theta = cross(rotated(R, sample.f2[i]), cross(b, sample.f1[i]))
        row = system[i]
        for j in range(k):
            row[j] = dot(axes[j], by_theta)
        error = 0.0
        for j in range(m):
            error -= row[k + j] * y[j]
            size2 += row[k + j] ** 2
        right[i] = error
        squares += error * error
    for j in range(n + 1):
        system[n, j] = y[j - k] if j >= k else 0.0
    right[n] = 0.0
    return squares, size2


@kernel
def polish(
    sample: Sample, factors: RowTimeFactors, axes: Array, R: Array, y: Array, steps: int
) -> bool:
    """Improve `R` (3, 3) and `y` (m,) in place by Newton's method; returns whether it converged.

    `steps` is the largest number of steps. Callers convert their constant by ``int``, since Numba
    would compile the kernel again for each constant.

    R moves about the `axes` (k, 3). The n equations have m + k = n + 1 unknowns, and ``|y| = 1``
    is the last equation. A step that does not reduce the error is shortened.
    """
    size = len(sample.f1) + 1
    k = len(axes)
    system = np.zeros((size, size))
    right = np.empty(size)
    pivots = np.empty(size, np.int64)
    step = np.zeros(size)
    turn = np.empty(3)
    error = math.inf
    size2 = 0.0
    R_new = R.copy()
    y_new = y.copy()
    for _ in range(steps):
        squares, size2 = linearise(sample, factors, axes, R_new, y_new, system, right)
        if squares < error:
            error = squares
            copy_matrix(R_new, R)
            copy_vector(y_new, y)
            if error < 1e-30 * size2:  # rounding
                return True
            lu_factor(system, pivots)
            lu_solve(system, pivots, right)
            copy_vector(right, step)
        elif error < 1e-27 * size2:
            return True
        else:
            step *= 0.25
        turn[:] = 0.0
        for j in range(k):
            for i in range(3):
                turn[i] += step[j] * axes[j, i]
        length = norm(turn)
        if length > 0.2:
            step *= 0.2 / length
            turn *= 0.2 / length
        multiply(exp_so3(turn), R, R_new)
        for j in range(len(y)):
            y_new[j] = y[j] + step[k + j]
        normalise(y_new)
    return error < 1e-24 * size2


@small_kernel
def is_known(R: Array, rotations: Array) -> bool:
    """Whether a rotation (3, 3) repeats one of `rotations` (K, 3, 3)."""
    for other in rotations:
        gap = 0.0
        for i in range(3):
            for j in range(2):  # the third column follows from the first two
                gap += abs(other[i, j] - R[i, j])
        if gap < 1e-9:
            return True
    return False


@kernel
def write_solution(sample: Sample, factors: RowTimeFactors, R: Array, y: Array, x: Array) -> bool:
    """Write ``x = (t, d_1, d_2)`` with ``|t| = 1`` from `y`; False if there is no translation.

    Of x and -x, the one with more points in front of both cameras is written.
    """
    for i in range(3):
        difference = 0.0  # ``d_2 - d_1``
        if len(y) > 3:
            difference = y[3 + i] / factors.s_p
            d2 = y[6 + i] / factors.s_q
            x[3 + i] = d2 - difference
            x[6 + i] = d2
        x[i] = y[i] - factors.m * difference
    length2 = dot(x, x)
    # As |y| = 1, a translation of this size is rounding.
    if not 1e-20 < length2 < math.inf:
        return False
    x *= 1.0 / math.sqrt(length2)
    front, behind = cheirality_votes(sample, R, x)
    if behind > front:
        for i in range(9):
            x[i] = 0.0 - x[i]  # not -x: a velocity of zero stays +0
    return True


@kernel
def solve_gyro_2pt(sample: Sample, known: Knowledge, out: Solutions) -> int:
    """With R known, t is perpendicular to the normals ``n = f_1 x R f_2`` of both matches."""
    R = known.rotation
    n1 = cross(sample.f1[0], rotated(R, sample.f2[0]))
    n2 = cross(sample.f1[1], rotated(R, sample.f2[1]))
    t = cross(n1, n2)
    length = norm(t)
    if not length > 1e-14:
        return 0
    copy_matrix(R, out.R[0])
    for i in range(3):
        out.x[0, i] = t[i] / length
    return 1
