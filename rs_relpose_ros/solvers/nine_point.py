"""Uniform and linear 9-point solvers: gravity known; yaw, translation and velocities unknown."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.vectors import copy_vector, rotated_back
from rs_relpose_ros.solvers.cheirality import point_forward
from rs_relpose_ros.solvers.gravity import (
    align_rays,
    AlignedRays,
    normals_at_yaw,
    rotation_from_yaw,
)
from rs_relpose_ros.solvers.linear_algebra import (
    lu_factor,
    lu_solve,
    lu_solve_transposed,
    normalise,
)
from rs_relpose_ros.solvers.solver import Knowledge, Sample, Solutions
from rs_relpose_ros.solvers.trigonometric import (
    angles_of_zeros,
    half_angle_matrix,
    half_angle_nodes,
    sample_angle,
)
from rs_relpose_ros.solvers.uniform_columns import (
    row_time_factors,
    RowTimeFactors,
    translation_and_velocities,
)

Array = NDArray[np.float64]

MAX_SOLUTIONS = 12
# Of the determinant of A(psi). Not 9: its leading complex coefficient matrix loses rank.
DEGREE = 6
HALF_ANGLE, NODES = half_angle_matrix(DEGREE), half_angle_nodes(DEGREE)


class _Equations(NamedTuple):
    """``A(psi) y = 0`` with the rows ``[n, p n, q n]``, and room for what belongs to one psi."""

    rays: AlignedRays
    factors: RowTimeFactors
    A: Array
    pivots: NDArray[np.int64]
    n: Array
    dn: Array
    left: Array


@kernel
def _fill(equations: _Equations, c: float, s: float) -> None:
    """Write A, n and ``dn / dpsi`` at the yaw with cosine c and sine s."""
    A, n, p, q = equations.A, equations.n, equations.factors.p, equations.factors.q
    normals_at_yaw(equations.rays, c, s, n, equations.dn)
    for k in range(9):
        for i in range(3):
            A[k, i], A[k, 3 + i], A[k, 6 + i] = n[k, i], p[k] * n[k, i], q[k] * n[k, i]


@kernel
def _null_vectors(equations: _Equations, y: Array) -> float:
    """One inverse iteration towards the singular vectors of the smallest singular value.

    A is overwritten by its factors; `y` (9,) is the start and receives the right, `left` the left
    vector. Returns the singular value.
    """
    A, pivots, u = equations.A, equations.pivots, equations.left
    lu_factor(A, pivots)
    copy_vector(y, u)
    lu_solve_transposed(A, pivots, u)
    normalise(u)
    copy_vector(u, y)
    lu_solve(A, pivots, y)
    return 1.0 / normalise(y)


@kernel
def _polish(equations: _Equations, start: float, farthest: float, y: Array) -> tuple[float, bool]:
    """Newton's method on the determinant: its zero, whether that was reached, and `y` (9,) there.

    The factors of A itself give the step, so that nothing is lost to a polynomial's rounding.
    The zero lies within `farthest` [rad] of the start, or the iteration has not converged.
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
def _nearest_vector(equations: _Equations, psi: float, y: Array) -> None:
    """Write to `y` (9,) what ``A(psi)`` shortens most, where its determinant is not zero."""
    y[:] = 1.0
    for _ in range(2):
        _fill(equations, math.cos(psi), math.sin(psi))
        _null_vectors(equations, y)


@kernel
def _is_known(psi: float, yaws: Array) -> bool:
    """Whether two roots of the polynomial led to one zero of the determinant."""
    same = 1e-10
    for yaw in yaws:
        gap = abs(psi - yaw)
        if gap < same or abs(gap - 2.0 * math.pi) < same:
            return True
    return False


@kernel
def _write_solution(equations: _Equations, psi: float, y: Array, sample: Sample, known: Knowledge,
                    R: Array, x: Array) -> bool:
    """R and x of one yaw and null vector; False where it is no finite solution."""
    if not (math.isfinite(y[0]) and translation_and_velocities(y, equations.factors, x)):
        return False
    rotation_from_yaw(equations.rays.centre + psi, known, R)
    for k in range(0, 9, 3):  # t, d_1, d_2, from the aligned frame to camera 1
        vector = rotated_back(known.align1, (x[k], x[k + 1], x[k + 2]))
        for i in range(3):
            x[k + i] = vector[i]
    point_forward(sample, R, x)
    return True


@kernel
def _zeros_of_the_determinant(equations: _Equations, angles: Array, half_gaps: Array) -> int:
    """Zeros of ``det A(psi)``, from 13 samples of it, to the rounding of a polynomial."""
    samples = np.empty(NODES.shape[0])
    for k in range(NODES.shape[0]):
        c, s, weight = sample_angle(NODES[k], equations.rays.zoom)
        _fill(equations, c, s)
        samples[k] = lu_factor(equations.A, equations.pivots) * weight**DEGREE
    return angles_of_zeros(samples, HALF_ANGLE, equations.rays.zoom, angles, half_gaps)


@kernel
def solve_gravity_9pt(sample: Sample, known: Knowledge, out: Solutions) -> int:
    """A yaw psi at which the 9x9 matrix A(psi) is singular; its null vector is (t, d_1, d_2).

    With gravity on z in both frames ``R = A_1^T Rz(psi) A_2``, and the determinant of A(psi)
    (section 'Linear 9-point algorithm') is a trigonometric polynomial of degree 6. It is sampled
    at 13 angles; its zeros are those of a polynomial of degree 12 in the tangent of the half
    angle, each polished by Newton's method on the determinant. A conjugate pair of roots within
    1e-3 of a real angle counts as that angle.

    On a flight of constant velocity (``d_1``, ``d_2`` parallel to t), and so for any
    global-shutter camera, A has a null space of dimension 3: R is found, but (t, d_1, d_2) is an
    arbitrary vector of that space. Use the angular solvers there.

    There is no solution where all row times of a frame, or all differences of row times, are
    equal: velocities are then not observable.
    """
    factors = row_time_factors(sample)
    if not factors.observable:
        return 0
    equations = _Equations(align_rays(sample, known), factors, np.empty((9, 9)),
                           np.empty(9, dtype=np.int64), np.empty((9, 3)), np.empty((9, 3)),
                           np.empty(9))
    angles, half_gaps = np.empty(MAX_SOLUTIONS), np.empty(MAX_SOLUTIONS)
    found = _zeros_of_the_determinant(equations, angles, half_gaps)
    y, yaws = np.empty(9), np.empty(MAX_SOLUTIONS)
    count = 0
    for k in range(found):
        middle, gap = angles[k], half_gaps[k]
        # Two tries: a pair of roots may be two real ones, closer than the polynomial can tell.
        for side in (-1.0, 1.0):
            # A single root is off by rounding only.
            psi, converged = _polish(equations, middle + side * gap, gap if gap > 0.0 else 1e-3, y)
            if side < 0.0 and not converged:
                # A pair of roots off the real line: the nearest angle, and its best vector.
                psi = middle
                _nearest_vector(equations, psi, y)
            if (side < 0.0 or converged) and not _is_known(psi, yaws[:count]) \
                    and _write_solution(equations, psi, y, sample, known, out.R[count],
                                        out.x[count]):
                yaws[count] = psi
                count += 1
            if count == MAX_SOLUTIONS:
                return count
            if gap == 0.0 or not converged:
                break
    return count
