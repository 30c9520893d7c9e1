"""Coplanarity of matches: residuals, their derivatives, and the direction of motion of a pair.

Frame i exposes row v at ``t_i(v) = stamp_i + offset + slope k_i + s(v) readout`` with
``s(v) = (v - middle row) / height``. With ``Q(t)`` the rotation by the gyro and ``n = (x, y, 1)``
the undistorted point, ``m_i = M_i n_i`` with ``M_i = Q(t_i) R_imu_cam`` is the ray in a frame that
does not rotate, and with the displacement b of the camera

    e = b . (m_1 x m_2) = 0,      r = e / s,  s = |de / d(pixels)|               [px]

Each pair has unknowns of its own: the unit vector `direction`; `bend`, a change of velocity, which
adds ``bend (s_1 + s_2)`` to b; and `turn`, the rotation that the noise of the gyro hides. The
prior of `bend` is in units of |b|: a readout time that is too long gains no freedom by it. Points
and their derivatives by the pixel are linear in the four parameters of the lens. All of it is in
docs/calibration.md, "Method".
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.core import deviations
from rs_relpose_ros.core.deviations import OFFLINE
from rs_relpose_ros.core.least_squares import first_indices
from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.geometry.gyro import GyroPath, knot_before, write_state
from rs_relpose_ros.geometry.so3 import cross, dot, multiply, norm, rotated, rotated_back, Vector
from rs_relpose_ros.jit import inlined_kernel, kernel

# -- Data and unknowns ----------------------------------------------------------------------------

# Places of the parameters of the calibration, which are values of `OFFLINE` of `core.deviations`;
# entries with more than one value have slices. The lens is beyond the assumed camera.
READOUT = OFFLINE.index('readout_time')
OFFSET = OFFLINE.index('time_offset')
SLOPE = OFFLINE.index('offset_per_interval')
ROTATION = OFFLINE.part('axes')
BIAS = OFFLINE.part('gyro_bias')
FOCAL = OFFLINE.index('focal_log')
RADIAL = OFFLINE.index('distortion')
CENTER = OFFLINE.part('principal_point')
EXPOSURE = OFFLINE.index('exposure_square')
GLOBAL = OFFLINE.size
LENS = slice(FOCAL, EXPOSURE)
# Deviations of the lens in the order of `geometry.lens` by the parameters `LENS`, (7, 4).
LENS_BASIS = np.ascontiguousarray(OFFLINE.basis[deviations.LENS, LENS])
# Kernels need numbers in place of slices.
_FIRST_AXIS = ROTATION.start
_FIRST_BIAS = BIAS.start
_OF_LENS = EXPOSURE - FOCAL
# Places of the unknowns of a pair, after the parameters: step of the direction in its tangent
# plane (2), bend (3), turn (3) [rad].
_UNKNOWNS = first_indices(parameters=GLOBAL, direction=2, bend=3, turn=3)
DIRECTION = _UNKNOWNS['direction']
BEND = _UNKNOWNS['bend']
TURN = _UNKNOWNS['turn']
ALL = _UNKNOWNS['end']
LOCAL = ALL - GLOBAL
# Residual [sigma] beyond which the Geman-McClure loss is nearly constant.
ROBUST = 3.0


class Problem(NamedTuple):
    """Data of a fit to P pairs with N matches in all."""

    gyro_times: Array  # (K,) [s]
    gyro_rates: Array  # (K, 3) mean over the assumed exposure [rad/s]
    # (K, 3) their derivative by the square of the exposure [rad/s^3], and its integral over time
    # [rad/s^2].
    blur_rates: Array
    blur_turns: Array
    times: Array  # (2, P) stamps of the frames of each pair [s]
    covariates: Array  # (2, P) covariates k_i of the offset; see `FrameTimes` [s]
    begin: NDArray[np.int64]  # (P + 1,) matches of pair p: begin[p] to begin[p + 1]
    # (P,) knot of the gyro near the middle of the pair. `direction`, `bend` and `turn` are in the
    # frame of that knot: in that of the start they would rotate with each step of the bias.
    middle: NDArray[np.int64]
    # Of both frames of each match:
    rows: Array  # (2, N) s(v) of the raw rows
    points: Array  # (2, N, 2) undistorted and normalised with the assumed camera
    by_pixel: Array  # (2, N, 2, 2) derivative of the normalised point by the pixel
    by_lens: Array  # (2, N, 2, 4) derivative of the normalised point by the lens
    by_pixel_by_lens: Array  # (2, N, 2, 2, 4) derivative of `by_pixel` by the lens
    bend_sigma: Array  # (P,) 1 sigma of each component of `bend`
    turn_sigma: Array  # (P,) 1 sigma of each component of `turn` [rad]
    prior: Array  # (GLOBAL,) inverse variances of the parameters
    center: Array  # (GLOBAL,) their means by the prior

    @property
    def pairs(self) -> int:
        """Number of pairs."""
        return len(self.middle)

    @property
    def pair(self) -> NDArray[np.int64]:
        """Pair (N,) of each match."""
        return np.repeat(np.arange(self.pairs), np.diff(self.begin))

    @property
    def middles(self) -> Array:
        """Times (P,) of the middle of each pair on the camera clock [s]."""
        return 0.5 * (self.times[0] + self.times[1])

    def matches(self, kept: NDArray[np.bool_]) -> Problem:
        """The same pairs with some of their matches (N,)."""
        some: dict[str, Any] = {
            name: np.compress(kept, getattr(self, name), axis=1)
            for name in ('rows', 'points', 'by_pixel', 'by_lens', 'by_pixel_by_lens')
        }
        return self._replace(begin=np.cumsum([0, *kept])[self.begin], **some)

    def pairs_of(self, kept: NDArray[np.bool_]) -> Problem:
        """Some of the pairs (P,)."""
        some = self.matches(kept[self.pair])
        return some._replace(
            times=np.compress(kept, self.times, axis=1),
            covariates=np.compress(kept, self.covariates, axis=1),
            begin=np.cumsum([0, *np.diff(self.begin)[kept]]),
            middle=self.middle[kept],
            bend_sigma=self.bend_sigma[kept],
            turn_sigma=self.turn_sigma[kept],
        )


class Unknowns(NamedTuple):
    """The calibration and the unknowns of the pairs."""

    # (GLOBAL,) with zeros in place of the rotation, which is `R_imu_cam`.
    parameters: Array
    R_imu_cam: Array  # (3, 3)
    own: Array  # (P, 9) of each pair: unit vector `direction`, `bend`, and `turn` [rad]
    noise: Array  # (P,) 1 sigma of the residuals [px]
    damping: Array  # (P,) Levenberg-Marquardt damping of the pair's own unknowns

    def pairs_of(self, kept: NDArray[np.bool_]) -> Unknowns:
        """The same calibration for some of the pairs (P,)."""
        return self._replace(
            own=self.own[kept], noise=self.noise[kept], damping=self.damping[kept]
        )


class Sums(NamedTuple):
    """Results of a pass over all matches; the last two are empty unless requested."""

    losses: Array  # (P,) robust loss
    residuals: Array  # (N,) [px]
    gradient: Array  # (P, ALL) of the losses
    hessian: Array  # (P, ALL, ALL) Gauss-Newton approximation, lower triangles


class _Sight(NamedTuple):
    """Memory for the camera at the time of a row; overwritten for each match."""

    Q: Array  # (3, 3) rotation of the IMU
    M: Array  # (3, 3) rotation of the camera
    rate: Array  # (3,) of the IMU [rad/s]
    blur: Array  # (3,) turn of the IMU by the square of the exposure [rad/s^2]
    by_bias: Array  # (3, 3) integral of the rotations since the middle of the pair [s]


@kernel
def _new_sight() -> _Sight:
    return _Sight(np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3), np.empty((3, 3)))


@inlined_kernel
def _look(
    path: GyroPath,
    R_imu_cam: Array,
    correction: Array,
    point: Array,
    time: float,
    near: int,
    sight: _Sight,
) -> tuple[int, Vector]:
    """Fill Q, M and rate of `sight` at a time; the knot before it, and the ray of a point."""
    k = knot_before(path.times, time, near)
    write_state(path, time, k, sight.M, sight.rate)
    multiply(correction, sight.M, sight.Q)
    multiply(sight.Q, R_imu_cam, sight.M)
    return k, rotated(sight.M, (point[0], point[1], 1.0))


@inlined_kernel
def _starts(problem: Problem, p: int, parameters: Array) -> tuple[float, float]:
    """Times of the middle rows of a pair on the clock of the gyro [s]."""
    return (
        problem.times[0, p] + parameters[OFFSET] + parameters[SLOPE] * problem.covariates[0, p],
        problem.times[1, p] + parameters[OFFSET] + parameters[SLOPE] * problem.covariates[1, p],
    )


@inlined_kernel
def _by_pixels(M: Array, P: Array, c: Vector) -> tuple[float, Vector]:
    """``|P^T M^T c|^2`` and ``k = M P P^T M^T c`` with P the derivative by the pixel."""
    h = rotated_back(M, c)
    q0 = P[0, 0] * h[0] + P[1, 0] * h[1]
    q1 = P[0, 1] * h[0] + P[1, 1] * h[1]
    k = rotated(M, (P[0, 0] * q0 + P[0, 1] * q1, P[1, 0] * q0 + P[1, 1] * q1, 0.0))
    return q0 * q0 + q1 * q1, k


@inlined_kernel
def _less(a: Vector, factor: float, b: Vector, divisor: float) -> Vector:
    """``(a - factor b) / divisor``."""
    return (
        (a[0] - factor * b[0]) / divisor,
        (a[1] - factor * b[1]) / divisor,
        (a[2] - factor * b[2]) / divisor,
    )


@inlined_kernel
def _derivatives(
    r: float,
    s: float,
    m1: Vector,
    m2: Vector,
    b: Vector,
    c1: Vector,
    c2: Vector,
    k1: Vector,
    k2: Vector,
) -> tuple[Vector, Vector, Vector, Vector, Vector]:
    """Of r by m_1 and m_2, by a small rotation of all of frame 1 and of frame 2, and by b.

    ``dr = (de - (e / s^2) (k_1 . dc_1 + k_2 . dc_2)) / s``.
    """
    ratio = r / s
    by_m1 = _less(c1, ratio, cross(k2, b), s)
    by_m2 = _less(c2, ratio, cross(b, k1), s)
    # A rotation of a frame rotates its M together with its ray.
    by_1 = _less(cross(m1, by_m1), -ratio / s, cross(c1, k1), 1.0)
    by_2 = _less(cross(m2, by_m2), -ratio / s, cross(c2, k2), 1.0)
    by_b = _less(_less(cross(m1, m2), ratio, cross(k1, m2), 1.0), ratio, cross(m1, k2), s)
    return by_m1, by_m2, by_1, by_2, by_b


@inlined_kernel
def _add_view(
    J: Array,
    by_turn: Vector,
    sight: _Sight,
    row: float,
    covariate: float,
    share: float,
    Q_middle: Array,
) -> None:
    """Add the derivatives through the orientation of one frame.

    `by_turn` is the derivative by a small rotation of the frame, of which `share` follows `turn`.
    """
    by_time = dot(by_turn, rotated(sight.Q, sight.rate))
    J[READOUT] += row * by_time
    J[OFFSET] += by_time
    J[SLOPE] += covariate * by_time
    J[EXPOSURE] += dot(by_turn, rotated(sight.Q, sight.blur))
    by_axes = rotated_back(sight.M, by_turn)  # R_imu_cam Exp(-c)
    by_bias = rotated_back(sight.by_bias, by_turn)
    by_own_turn = rotated_back(Q_middle, by_turn)
    for i in range(3):
        J[_FIRST_AXIS + i] -= by_axes[i]
        J[_FIRST_BIAS + i] -= by_bias[i]
        J[TURN + i] += share * by_own_turn[i]


@inlined_kernel
def _add_lens(
    J: Array, problem: Problem, side: int, n: int, by_m: Vector, c: Vector, M: Array, ratio: float
) -> None:
    """Add the derivatives by the lens through one frame: by its ray, and by s through P.

    ``s ds = (P^T h) . (dP^T h)`` with ``h = M^T c``; `ratio` is r / s^2.
    """
    by_point, h, P = rotated_back(M, by_m), rotated_back(M, c), problem.by_pixel[side, n]
    q0 = ratio * (P[0, 0] * h[0] + P[1, 0] * h[1])
    q1 = ratio * (P[0, 1] * h[0] + P[1, 1] * h[1])
    by_lens, dP = problem.by_lens[side, n], problem.by_pixel_by_lens[side, n]
    for k in range(_OF_LENS):
        J[FOCAL + k] += (
            by_point[0] * by_lens[0, k]
            + by_point[1] * by_lens[1, k]
            - q0 * (dP[0, 0, k] * h[0] + dP[1, 0, k] * h[1])
            - q1 * (dP[0, 1, k] * h[0] + dP[1, 1, k] * h[1])
        )


@inlined_kernel
def _integrate(
    problem: Problem,
    path: GyroPath,
    turned: Array,
    middle: int,
    k: int,
    time: float,
    sight: _Sight,
) -> None:
    """Fill blur and by_bias of `sight` at a time after knot `k`."""
    dt = time - path.times[k]
    half_share = 0.5 * dt / (path.times[k + 1] - path.times[k])
    for i in range(3):
        change = problem.blur_rates[k + 1, i] - problem.blur_rates[k, i]
        sight.blur[i] = problem.blur_turns[k, i] + dt * (
            problem.blur_rates[k, i] + half_share * change
        )
        for j in range(3):
            sight.by_bias[i, j] = (
                turned[k, i, j] - turned[middle, i, j] + dt * path.rotations[k, i, j]
            )


@inlined_kernel
def _add_match(J: Array, r: float, weight: float, gradient: Array, hessian: Array) -> None:
    """Add the residual of a match to the gradient and the lower triangle of the Hessian."""
    for i in range(ALL):
        gradient[i] += weight * r * J[i]
        for j in range(i + 1):
            hessian[i, j] += weight * J[i] * J[j]


@inlined_kernel
def _own_motion(Q_middle: Array, own: Array) -> tuple[Vector, Vector, Array, Array]:
    """Direction and bend of a pair, and half of its turn forwards (frame 2) and back (frame 1)."""
    half = so3.exp_so3(0.5 * (Q_middle @ own[6:]))
    straight, bend = rotated(Q_middle, own[:3]), rotated(Q_middle, own[3:6])
    return straight, bend, half, np.ascontiguousarray(half.T)


@inlined_kernel
def _add_own(J: Array, by_b: Vector, tangent: Array, rows: float) -> None:
    """Write the derivatives by direction and bend of the pair."""
    J[DIRECTION], J[DIRECTION + 1] = dot(tangent[0], by_b), dot(tangent[1], by_b)
    for i in range(3):
        J[BEND + i] = rows * by_b[i]


@kernel
def accumulate(
    problem: Problem,
    path: GyroPath,
    turned: Array,
    unknowns: Unknowns,
    tangent: Array,
    derivatives: bool,
    sums: Sums,
) -> None:
    """Sum robust losses, gradients and Hessians over the matches of each pair, without priors.

    `turned` (K, 3, 3) is the integral of the rotations over time at the knots [s]: a rate error db
    turns the rotation at knot k by ``turned_k db``, in the frame of the start. `tangent` (P, 2, 3)
    spans the steps of each direction. With ``d = r / noise`` and
    ``l = 1 / (1 + d^2 / ROBUST^2)`` the loss of a match is ``d^2 l / 2`` (Geman-McClure).
    """
    parameters = unknowns.parameters
    readout = parameters[READOUT]
    sight1, sight2, J = _new_sight(), _new_sight(), np.empty(ALL)
    for p in range(len(problem.middle)):
        middle, covariates = problem.middle[p], problem.covariates[:, p]
        Q_middle = path.rotations[middle]
        straight, bend, half, half_back = _own_motion(Q_middle, unknowns.own[p])
        starts = _starts(problem, p, parameters)
        k1 = k2 = middle
        per_noise2 = 1.0 / unknowns.noise[p] ** 2
        sums.losses[p] = 0.0
        for n in range(problem.begin[p], problem.begin[p + 1]):
            row1, row2 = problem.rows[0, n], problem.rows[1, n]
            t1, t2 = starts[0] + row1 * readout, starts[1] + row2 * readout
            k1, m1 = _look(
                path, unknowns.R_imu_cam, half_back, problem.points[0, n], t1, k1, sight1
            )
            k2, m2 = _look(path, unknowns.R_imu_cam, half, problem.points[1, n], t2, k2, sight2)
            rows = row1 + row2
            b = _less(straight, -rows, bend, 1.0)  # straight + rows bend
            c1, c2 = cross(m2, b), cross(b, m1)  # e = m_1 . c_1 = m_2 . c_2
            square1, by_pixels1 = _by_pixels(sight1.M, problem.by_pixel[0, n], c1)
            square2, by_pixels2 = _by_pixels(sight2.M, problem.by_pixel[1, n], c2)
            s = math.sqrt(max(square1 + square2, 1e-16))
            r = sums.residuals[n] = dot(m1, c1) / s
            distance2 = r**2 * per_noise2
            level = 1.0 / (1.0 + distance2 / ROBUST**2)
            sums.losses[p] += 0.5 * distance2 * level
            if not derivatives:
                continue
            by_m1, by_m2, by_1, by_2, by_b = _derivatives(
                r, s, m1, m2, b, c1, c2, by_pixels1, by_pixels2
            )
            J[:] = 0.0
            _integrate(problem, path, turned, middle, k1, t1, sight1)
            _integrate(problem, path, turned, middle, k2, t2, sight2)
            _add_view(J, by_1, sight1, row1, covariates[0], -0.5, Q_middle)
            _add_view(J, by_2, sight2, row2, covariates[1], 0.5, Q_middle)
            _add_lens(J, problem, 0, n, by_m1, c1, sight1.M, r / s**2)
            _add_lens(J, problem, 1, n, by_m2, c2, sight2.M, r / s**2)
            _add_own(J, rotated_back(Q_middle, by_b), tangent[p], rows)
            _add_match(J, r, level * level * per_noise2, sums.gradient[p], sums.hessian[p])


@kernel
def eliminate(
    sums: Sums, prior: Array, damping: Array, score: Array, reduced: Array, back: Array
) -> None:
    """Fill the normal equations of the parameters, and how the pairs' own unknowns follow them.

    With ``H_ll + prior = L L^T`` (diagonal times ``1 + damping``) and ``Y = L^-1 [H_lg, g_l]``:
    ``score = g_g - Y_g^T y_l``, ``reduced = H_gg - Y_g^T Y_g``, ``back = L^-T Y``.
    """
    L = np.empty((LOCAL, LOCAL))
    for p in range(len(prior)):
        gradient, H, Y = sums.gradient[p], sums.hessian[p], back[p]
        for i in range(LOCAL):
            for j in range(i):
                value = H[GLOBAL + i, GLOBAL + j]
                for k in range(j):
                    value -= L[i, k] * L[j, k]
                L[i, j] = value / L[j, j]
            value = (H[GLOBAL + i, GLOBAL + i] + prior[p, i]) * (1.0 + damping[p])
            for k in range(i):
                value -= L[i, k] ** 2
            L[i, i] = math.sqrt(value)
            for c in range(GLOBAL + 1):
                value = H[GLOBAL + i, c] if c < GLOBAL else gradient[GLOBAL + i]
                for k in range(i):
                    value -= L[i, k] * Y[k, c]
                Y[i, c] = value / L[i, i]
        for i in range(GLOBAL):
            score[p, i] = gradient[i]
            for k in range(LOCAL):
                score[p, i] -= Y[k, i] * Y[k, GLOBAL]
            for j in range(i + 1):
                value = H[i, j]
                for k in range(LOCAL):
                    value -= Y[k, i] * Y[k, j]
                reduced[p, i, j] = reduced[p, j, i] = value
        for i in range(LOCAL - 1, -1, -1):
            for c in range(GLOBAL + 1):
                for k in range(i + 1, LOCAL):
                    Y[i, c] -= L[k, i] * Y[k, c]
                Y[i, c] /= L[i, i]


@kernel
def find_directions(
    problem: Problem, path: GyroPath, unknowns: Unknowns, chosen: NDArray[np.int64]
) -> None:
    """Replace each direction by the best of itself and of those that two matches each fix.

    `chosen` (K, 2) are large random numbers that pick the matches. The best has the least sum of
    ``min((e / s)^2, limit)``; of each match ``e = normal . b`` and ``s^2 = b^T square b``.
    """
    most = np.diff(problem.begin).max()
    normals, squares = np.empty((most, 3)), np.empty((most, 3, 3))
    for p in range(len(problem.middle)):
        count = problem.begin[p + 1] - problem.begin[p]
        Q_middle = path.rotations[problem.middle[p]]
        _constraints(problem, path, unknowns, p, normals, squares)
        limit = (ROBUST * unknowns.noise[p]) ** 2
        least, best = np.inf, (0.0, 0.0, 0.0)
        for h in range(-1, len(chosen)):
            if h < 0:
                b = rotated(Q_middle, unknowns.own[p, :3])
            else:
                b = cross(normals[chosen[h, 0] % count], normals[chosen[h, 1] % count])
            length = norm(b)
            if length < 1e-14:
                continue
            b = (b[0] / length, b[1] / length, b[2] / length)
            cost = 0.0
            for i in range(count):
                s2 = max(dot(b, rotated(squares[i], b)), 1e-16)
                cost += min(dot(normals[i], b) ** 2 / s2, limit)
                if cost >= least:
                    break
            if cost < least:
                least, best = cost, b
        if least < np.inf:
            own = unknowns.own[p]
            own[0], own[1], own[2] = rotated_back(Q_middle, best)


@kernel
def _constraints(
    problem: Problem, path: GyroPath, unknowns: Unknowns, p: int, normals: Array, squares: Array
) -> None:
    """Fill `normals` and `squares` of the matches of a pair."""
    parameters = unknowns.parameters
    uncorrected, sight1, sight2 = np.eye(3), _new_sight(), _new_sight()
    starts = _starts(problem, p, parameters)
    k1 = k2 = problem.middle[p]
    for i in range(problem.begin[p + 1] - problem.begin[p]):
        n = problem.begin[p] + i
        k1, m1 = _look(
            path,
            unknowns.R_imu_cam,
            uncorrected,
            problem.points[0, n],
            starts[0] + problem.rows[0, n] * parameters[READOUT],
            k1,
            sight1,
        )
        k2, m2 = _look(
            path,
            unknowns.R_imu_cam,
            uncorrected,
            problem.points[1, n],
            starts[1] + problem.rows[1, n] * parameters[READOUT],
            k2,
            sight2,
        )
        normals[i, 0], normals[i, 1], normals[i, 2] = cross(m1, m2)
        squares[i] = 0.0
        _add_squares(problem.by_pixel[0, n], sight1.M, m2, squares[i])
        _add_squares(problem.by_pixel[1, n], sight2.M, m1, squares[i])


@inlined_kernel
def _add_squares(P: Array, M: Array, other: Vector, square: Array) -> None:
    """Add ``g g^T`` of both pixel coordinates of one frame, with ``de/dpixel = g . b``."""
    for r in range(2):
        g = cross(rotated(M, (P[0, r], P[1, r], 0.0)), other)
        for c in range(3):
            for d in range(3):
                square[c, d] += g[c] * g[d]
