"""Common parts of the minimal solvers: signature, cheirality, gravity, columns of the model.

A solver is a kernel that is called by its address: the robust loop is compiled once, and a solver
only when it is used.
"""

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import NamedTuple

import numba
import numpy as np

from rs_relpose_ros.core.triangulate import scaled_depths
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import (
    copy_matrix,
    copy_vector,
    cross,
    dot,
    exp_so3,
    multiply,
    norm,
    rotated,
    rotated_back,
)
from rs_relpose_ros.jit import inlined_kernel, kernel, KernelInterface, small_kernel
from rs_relpose_ros.solvers.algebra import cholesky, lu_factor, lu_solve, newton_step, normalise


class Sample(NamedTuple):
    """A minimal sample of n matches."""

    f1: Array  # (n, 3) unit rays in their camera's frame, derotated by the gyro if the model is
    f2: Array  # likewise
    tau1: Array  # (n,) row times [s] relative to the reference row
    tau2: Array  # likewise


class Knowledge(NamedTuple):
    """Known quantities besides the matches; `Solver` has the ones that a solver uses."""

    align1: Array  # (3, 3) rotation of the camera's gravity onto +z (`gravity_alignment`)
    align2: Array  # likewise
    rotation: Array  # (3, 3) a predicted R, if `predicted`
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
    # Kernel that writes all solutions, the sign of t by the majority of the points; their number.
    solve: Callable[[Sample, Knowledge, Solutions], int]
    most_solutions: int
    summary: str  # first line of its documentation; the rest is that of `solve`
    needs_gravity: bool = False  # both alignments of `Knowledge`
    needs_rotation: bool = False  # the predicted rotation of `Knowledge`
    starts_from_rotation: bool = False  # iterative, with `Knowledge.rotation` as first guess

    @property
    def address(self) -> int:
        """Address of the compiled kernel, for `solve_at`; compiles it on first use."""
        return _INTERFACE.address(self.solve)


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
    """Write the solutions of one sample to `out`; their number."""
    return solve_at(address, sample, known, out)


@kernel
def cheirality_votes(sample: Sample, R: Array, x: Array) -> tuple[int, int]:
    """Number of points in front of both cameras for ``x = (t, d_1, d_2)`` (9,), and for ``-x``.

    Each point is triangulated from the positions of the cameras at its own rows:
    ``lambda_1 f_1 - lambda_2 R f_2 = b = t - tau_1 d_1 + tau_2 d_2`` in the least-squares sense.
    """
    front = 0
    behind = 0
    for k in range(sample.f1.shape[0]):
        f1, h = sample.f1[k], rotated(R, sample.f2[k])
        tau1, tau2 = sample.tau1[k], sample.tau2[k]
        b = (
            x[0] + (tau2 * x[6] - tau1 * x[3]),
            x[1] + (tau2 * x[7] - tau1 * x[4]),
            x[2] + (tau2 * x[8] - tau1 * x[5]),
        )
        along1, along2, _ = scaled_depths(f1, h, b)
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
    """Smallest rotation (3, 3) of `gravity` (3,), of any length, onto +z."""
    length = norm(gravity)
    x, y, z = gravity[0] / length, gravity[1] / length, gravity[2] / length
    horizontal2 = x * x + y * y
    A = np.zeros((3, 3))
    if z < 0.0 and horizontal2 < 1e-30:
        # Opposite to z: every half turn about a horizontal axis is a solution.
        A[0, 0], A[1, 1], A[2, 2] = 1.0, -1.0, -1.0
        return A
    # 1 / (1 + z), without cancellation near z = -1.
    k = 1.0 / (1.0 + z) if z >= 0.0 else (1.0 - z) / horizontal2
    A[0, 0], A[0, 1], A[0, 2] = 1.0 - k * x * x, -k * x * y, -x
    A[1, 0], A[1, 1], A[1, 2] = -k * x * y, 1.0 - k * y * y, -y
    A[2, 0], A[2, 1], A[2, 2] = x, y, z
    return A


@kernel
def rotation_from_yaw(psi: float, known: Knowledge, R: Array) -> None:
    """Write ``A_1^T Rz(psi) A_2`` into `R` (3, 3)."""
    c, s = math.cos(psi), math.sin(psi)
    A2 = known.align2
    for j in range(3):
        aligned = (c * A2[0, j] - s * A2[1, j], s * A2[0, j] + c * A2[1, j], A2[2, j])
        column = rotated_back(known.align1, aligned)
        for i in range(3):
            R[i, j] = column[i]


@kernel
def yaw_cluster(sample: Sample, known: Knowledge) -> tuple[float, float]:
    """Centre and width [rad] of the cluster of solutions in psi.

    The normals of distant points all nearly vanish at the true yaw, so that the zeros of their
    determinants cluster there, within about the parallax. With the aligned rays a and b, the
    centre is about ``argmax sum a . Rz(psi) b``, the width their rms distance, in [1e-3, 1].
    """
    count = sample.f1.shape[0]
    along, across, total = 0.0, 0.0, 0.0
    for k in range(count):
        a, b = rotated(known.align1, sample.f1[k]), rotated(known.align2, sample.f2[k])
        along += a[0] * b[0] + a[1] * b[1]
        across += a[1] * b[0] - a[0] * b[1]
        total += dot(a, a) + dot(b, b) - 2.0 * a[2] * b[2]
    # Less the largest sum of the horizontal parts.
    total -= 2.0 * math.sqrt(along * along + across * across)
    return math.atan2(across, along), min(max(math.sqrt(max(total, 0.0) / count), 1e-3), 1.0)


# The nine columns of the uniform and linear models, well conditioned. A row of the paper's
# ``A x = 0`` is ``[n, -tau_1 n, tau_2 n]`` with ``n = f_1 x R f_2`` and ``x = (t, d_1, d_2)``
# (docs/conventions.md, equation 4). Matched points are in similar rows, and row times are 1e-2 s:
# these three blocks are nearly parallel and badly scaled. The kernels therefore use
#
#     t - tau_1 d_1 + tau_2 d_2 = y_1 + p y_2 + q y_3
#     p = (tau_1 - m) / s_p,    q = (tau_2 - tau_1) / s_q
#
# with the mean row time m and p, q of size 1; the two sets of columns span the same space for any
# rotation: determinants differ by a constant factor, solutions by a linear map
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
    """Factors of a sample; p and q are not scaled if velocities are not observable."""
    tau1, tau2 = sample.tau1, sample.tau2
    n = tau1.shape[0]
    m = 0.0
    for k in range(n):
        m += tau1[k] / n
    p, q = np.empty(n), np.empty(n)
    s_p, s_q = 0.0, 0.0
    for k in range(n):
        p[k] = tau1[k] - m
        q[k] = tau2[k] - tau1[k]
        s_p = max(s_p, abs(p[k]))
        s_q = max(s_q, abs(q[k]))
    # Velocity and translation are not distinguishable for closer row times [s].
    least = 1e-12
    observable = least < s_p < math.inf and least < s_q < math.inf
    if observable:
        for k in range(n):
            p[k] /= s_p
            q[k] /= s_q
    return RowTimeFactors(p, q, m, s_p, s_q, observable)


# All solvers end with Newton's method on ``A(R) y = 0``, which removes the rounding of polynomials
# and eliminations: y is t, or (y_1, y_2, y_3), of length 1.


@kernel
def write_rows(sample: Sample, factors: RowTimeFactors, R: Array, A: Array, first: int) -> None:
    """Write A(R), rows n or ``[n, p n, q n]``, into the columns of `A` from `first` on."""
    for k in range(sample.f1.shape[0]):
        n = cross(sample.f1[k], rotated(R, sample.f2[k]))
        for i in range(3):
            A[k, first + i] = n[i]
            if A.shape[1] - first > 3:
                A[k, first + 3 + i] = factors.p[k] * n[i]
                A[k, first + 6 + i] = factors.q[k] * n[i]


@kernel
def write_nearest_vector(sample: Sample, factors: RowTimeFactors, R: Array, y: Array) -> None:
    """Write the vector of the smallest singular value of A(R) into `y`, by inverse iteration."""
    m = y.shape[0]
    A, factor = np.empty((sample.f1.shape[0], m)), np.zeros((m, m))
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
    """Write the n + 1 equations of a Newton step (`polish`); ``|A(R) y|^2`` and ``|A(R)|^2``."""
    n, k, m = sample.f1.shape[0], axes.shape[0], y.shape[0]
    write_rows(sample, factors, R, system, k)
    squares, size2 = 0.0, 0.0
    for i in range(n):
        # b = y_1 + p y_2 + q y_3, and d((f_1 x h) . b) = theta . (h x (b x f_1)), h = R f_2
        b = (y[0], y[1], y[2])
        if m > 3:
            p, q = factors.p[i], factors.q[i]
            b = (
                b[0] + p * y[3] + q * y[6],
                b[1] + p * y[4] + q * y[7],
                b[2] + p * y[5] + q * y[8],
            )
        by_theta = cross(rotated(R, sample.f2[i]), cross(b, sample.f1[i]))
        for j in range(k):
            system[i, j] = dot(axes[j], by_theta)
        right[i] = 0.0
        for j in range(m):
            right[i] -= system[i, k + j] * y[j]
            size2 += system[i, k + j] ** 2
        squares += right[i] * right[i]
    for j in range(n + 1):
        system[n, j] = y[j - k] if j >= k else 0.0
    right[n] = 0.0
    return squares, size2


@kernel
def polish(
    sample: Sample, factors: RowTimeFactors, axes: Array, R: Array, y: Array, steps: int
) -> bool:
    """Newton's method from `R` (3, 3) and `y` (m,), in place; whether it has converged.

    R moves about the `axes` (k, 3), n equations having n + 1 = m + k unknowns with ``|y| = 1``. A
    step that does not reduce the error is shortened.
    """
    n, k = sample.f1.shape[0], axes.shape[0]
    system, right, pivots = np.zeros((n + 1, n + 1)), np.empty(n + 1), np.empty(n + 1, np.int64)
    step, turn, error, size2 = np.zeros(n + 1), np.empty(3), math.inf, 0.0
    R_new, y_new = R.copy(), y.copy()
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
            gap += abs(other[i, 0] - R[i, 0]) + abs(other[i, 1] - R[i, 1])
        if gap < 1e-9:
            return True
    return False


@kernel
def write_solution(sample: Sample, factors: RowTimeFactors, R: Array, y: Array, x: Array) -> bool:
    """Write ``x = (t, d_1, d_2)`` with ``|t| = 1`` from `y`; False if there is no translation.

    With the sign that has more points in front of both cameras.
    """
    for i in range(3):
        difference = 0.0  # d_2 - d_1
        if len(y) > 3:
            difference, x[6 + i] = y[3 + i] / factors.s_p, y[6 + i] / factors.s_q
            x[3 + i] = x[6 + i] - difference
        x[i] = y[i] - factors.m * difference
    length2 = dot(x, x)
    # |y| = 1: a translation of this size is rounding.
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
    """Rotation known: t is perpendicular to the normals ``n = f_1 x R f_2`` of both matches."""
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
