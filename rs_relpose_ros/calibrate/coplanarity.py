"""Coplanarity of matches: residuals, their derivatives, and the direction of motion of a pair.

Frame i exposes row v at ``t_i(v) = stamp_i + offset + slope k_i + s(v) readout`` with
``s(v) = (v - middle row) / height``. With ``Q(t)`` the rotation by the gyro and ``n = (x, y, 1)``
the undistorted point, ``m_i = M_i n_i`` with ``M_i = Q(t_i) R_imu_cam`` is the ray in a frame that
does not rotate. Over a short span the velocity of the camera is assumed constant, so that between
any row of frame 1 and any row of frame 2 it moves in the same direction b, and

    e = b . (m_1 x m_2) = 0,      r = e / s,  s = |de / d(pixels)|               [px]

with the exact derivative by all four pixel coordinates. The distance that the camera moves and the
depth of the points cancel. Each pair has unknowns of its own: the unit vector `direction`; `bend`,
a change of velocity, which adds ``bend (s_1 + s_2)`` to b; and `turn`, the rotation from frame 1
to frame 2 that the noise of the gyro hides. Priors keep the last two small. The prior of `bend` is
in units of |b| and independent of the readout time: a readout time that is too long gains no
freedom by it.

A row shows the mean of its exposure, so the gyro is averaged over it
(`observations.exposed_rates`); what is not known of the exposure is an unknown with a prior. So is
the lens: a point and its derivative by the pixel are linear in four parameters about the assumed
camera (`observations.with_lens`), and the fit is repeated about its result.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibrate.start import GyroPath, knot_before, rotation_at
from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.geometry.so3 import cross, dot, multiply, norm, rotated, rotated_back, Vector
from rs_relpose_ros.jit import inlined_kernel, kernel

# Parameters of the calibration, in this order: readout time [s], offset of the middle row [s],
# slope of the offset, rotation vector on the left of R_imu_cam (3) [rad], bias (3) [rad/s]; of the
# lens, beyond the assumed camera: logarithm of the focal length, first coefficient of the
# distortion, principal point (2) [px]; square of the exposure beyond the assumed one [s^2].
READOUT, OFFSET, SLOPE, ROTATION, BIAS, FOCAL, RADIAL, CENTER, EXPOSURE = (
    0, 1, 2, 3, 6, 9, 10, 11, 13)
GLOBAL = 14
LENS = slice(FOCAL, EXPOSURE)
_OF_LENS = EXPOSURE - FOCAL
# Unknowns of a pair: step of the direction in its tangent plane (2), bend (3), turn (3) [rad].
DIRECTION, BEND, TURN = 14, 16, 19
ALL = 22
LOCAL = ALL - GLOBAL
# Residual [sigma] beyond which the Geman-McClure loss is nearly constant.
ROBUST = 3.0


class View(NamedTuple):
    """One of the two frames of each of P pairs, with its side of their N matches."""

    times: Array        # (P,) stamps [s]
    covariates: Array   # (P,) covariates k_i of the offset; see `FrameTimes` [s]
    points: Array       # (N, 2) undistorted and normalised with the assumed camera
    rows: Array         # (N,) s(v) of the raw rows
    by_pixel: Array     # (N, 2, 2) derivative of the normalised point by the pixel
    by_lens: Array      # (N, 2, 4) derivative of the normalised point by the lens
    by_pixel_by_lens: Array   # (N, 2, 2, 4) derivative of `by_pixel` by the lens


class Problem(NamedTuple):
    """Data of a fit to P pairs with N matches in all."""

    gyro_times: Array             # (K,) [s]
    gyro_rates: Array             # (K, 3) mean over the assumed exposure [rad/s]
    # (K, 3) their derivative by the square of the exposure [rad/s^3], and its integral over time
    # [rad/s^2].
    blur_rates: Array
    blur_turns: Array
    begin: NDArray[np.int64]      # (P + 1,) matches of pair p: begin[p] to begin[p + 1]
    # (P,) knot of the gyro near the middle of the pair. `direction`, `bend` and `turn` are in the
    # frame of that knot: in that of the start they would rotate with each step of the bias.
    middle: NDArray[np.int64]
    view1: View
    view2: View
    bend_sigma: Array             # (P,) 1 sigma of each component of `bend`
    turn_sigma: Array             # (P,) 1 sigma of each component of `turn` [rad]
    prior: Array                  # (GLOBAL,) inverse variances of the parameters
    center: Array                 # (GLOBAL,) their means by the prior

    @property
    def pairs(self) -> int:
        """Number of pairs."""
        return len(self.middle)

    @property
    def middles(self) -> Array:
        """Times (P,) of the middle of each pair on the camera clock [s]."""
        return 0.5 * (self.view1.times + self.view2.times)

    def matches(self, kept: NDArray[np.bool_]) -> Problem:
        """The same pairs with some of their matches (N,)."""
        view1, view2 = (view._replace(points=view.points[kept], rows=view.rows[kept],
                                      by_pixel=view.by_pixel[kept], by_lens=view.by_lens[kept],
                                      by_pixel_by_lens=view.by_pixel_by_lens[kept])
                        for view in (self.view1, self.view2))
        return self._replace(begin=np.cumsum([0, *kept])[self.begin], view1=view1, view2=view2)

    def pairs_of(self, kept: NDArray[np.bool_]) -> Problem:
        """Some of the pairs (P,)."""
        counts = np.diff(self.begin)
        some = self.matches(np.repeat(kept, counts))
        view1, view2 = (view._replace(times=view.times[kept], covariates=view.covariates[kept])
                        for view in (some.view1, some.view2))
        return some._replace(
            begin=np.cumsum([0, *counts[kept]]), middle=self.middle[kept],
            bend_sigma=self.bend_sigma[kept], turn_sigma=self.turn_sigma[kept], view1=view1,
            view2=view2)


class Unknowns(NamedTuple):
    """The calibration and the unknowns of the pairs."""

    # (GLOBAL,) with zeros in place of the rotation, which is `R_imu_cam`.
    parameters: Array
    R_imu_cam: Array    # (3, 3)
    direction: Array    # (P, 3) unit vectors
    bend: Array         # (P, 3)
    turn: Array         # (P, 3) [rad]
    noise: Array        # (P,) 1 sigma of the residuals [px]
    damping: Array      # (P,) Levenberg-Marquardt damping of the pair's own unknowns

    def pairs_of(self, kept: NDArray[np.bool_]) -> Unknowns:
        """The same calibration for some of the pairs (P,)."""
        return self._replace(direction=self.direction[kept], bend=self.bend[kept],
                             turn=self.turn[kept], noise=self.noise[kept],
                             damping=self.damping[kept])


class Sums(NamedTuple):
    """Results of a pass over all matches; the last two are empty unless requested."""

    losses: Array       # (P,) robust loss
    residuals: Array    # (N,) [px]
    gradient: Array     # (P, ALL) of the losses
    hessian: Array      # (P, ALL, ALL) Gauss-Newton approximation, lower triangles


class _Sight(NamedTuple):
    """Memory for the camera at the time of a row; overwritten for each match."""

    Q: Array         # (3, 3) rotation of the IMU
    M: Array         # (3, 3) rotation of the camera
    rate: Array      # (3,) of the IMU [rad/s]
    blur: Array      # (3,) turn of the IMU by the square of the exposure [rad/s^2]
    by_bias: Array   # (3, 3) integral of the rotations since the middle of the pair [s]
    point: Array     # (2,) normalised point through the lens
    by_pixel: Array   # (2, 2) its derivative by the pixel


class _Residual(NamedTuple):
    """Residual ``r = e / s`` of a match, and terms of its derivatives."""

    r: float         # [px]
    s: float
    c1: Vector       # c_1 = m_2 x b and c_2 = b x m_1: e = m_1 . c_1 = m_2 . c_2
    c2: Vector
    k1: Vector       # k_i = M_i P_i P_i^T M_i^T c_i, P_i the derivative by the pixel
    k2: Vector


class _Derivatives(NamedTuple):
    """Derivatives of a residual."""

    by_m1: Vector   # by the rays m_1 and m_2
    by_m2: Vector
    by_1: Vector    # by a small rotation of all of frame 1, and of frame 2
    by_2: Vector
    by_b: Vector


@kernel
def _new_sight() -> _Sight:
    return _Sight(np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3),
                  np.empty((3, 3)), np.empty(2), np.empty((2, 2)))


@inlined_kernel
def _look(path: GyroPath, R_imu_cam: Array, correction: Array, time: float, near: int,
          sight: _Sight) -> int:
    """Fill Q, M and rate of `sight` at a time, and return the gyro's knot before it."""
    k = knot_before(path.times, time, near)
    rotation_at(path, time, k, sight.M, sight.rate)
    multiply(correction, sight.M, sight.Q)
    multiply(sight.Q, R_imu_cam, sight.M)
    return k


@inlined_kernel
def _start(view: View, p: int, parameters: Array) -> float:
    """Time of the middle row on the clock of the gyro [s]."""
    return view.times[p] + parameters[OFFSET] + parameters[SLOPE] * view.covariates[p]


@inlined_kernel
def _through_lens(view: View, n: int, parameters: Array, sight: _Sight) -> Vector:
    """Fill point and by_pixel of `sight` for a match, and return its ray ``m = M (x, y, 1)``."""
    for i in range(2):
        sight.point[i] = view.points[n, i]
        for k in range(_OF_LENS):
            sight.point[i] += view.by_lens[n, i, k] * parameters[FOCAL + k]
        for j in range(2):
            sight.by_pixel[i, j] = view.by_pixel[n, i, j]
            for k in range(_OF_LENS):
                sight.by_pixel[i, j] += view.by_pixel_by_lens[n, i, j, k] * parameters[FOCAL + k]
    return rotated(sight.M, (sight.point[0], sight.point[1], 1.0))


@inlined_kernel
def _by_pixels(sight: _Sight, c: Vector) -> tuple[float, Vector]:
    """``|P^T M^T c|^2`` and ``k = M P P^T M^T c`` with P the derivative by the pixel."""
    h, P = rotated_back(sight.M, c), sight.by_pixel
    q0 = P[0, 0] * h[0] + P[1, 0] * h[1]
    q1 = P[0, 1] * h[0] + P[1, 1] * h[1]
    k = rotated(sight.M, (P[0, 0] * q0 + P[0, 1] * q1, P[1, 0] * q0 + P[1, 1] * q1, 0.0))
    return q0 * q0 + q1 * q1, k


@inlined_kernel
def _less(a: Vector, factor: float, b: Vector, divisor: float) -> Vector:
    """``(a - factor b) / divisor``."""
    return ((a[0] - factor * b[0]) / divisor, (a[1] - factor * b[1]) / divisor,
            (a[2] - factor * b[2]) / divisor)


@inlined_kernel
def _residual(sight1: _Sight, sight2: _Sight, m1: Vector, m2: Vector, b: Vector) -> _Residual:
    """``r = e / s`` with ``s^2 = |P_1^T M_1^T c_1|^2 + |P_2^T M_2^T c_2|^2``."""
    c1, c2 = cross(m2, b), cross(b, m1)
    square1, k1 = _by_pixels(sight1, c1)
    square2, k2 = _by_pixels(sight2, c2)
    s = math.sqrt(max(square1 + square2, 1e-16))
    return _Residual(dot(m1, c1) / s, s, c1, c2, k1, k2)


@inlined_kernel
def _derivatives(found: _Residual, m1: Vector, m2: Vector, b: Vector) -> _Derivatives:
    """``dr = (de - (e / s^2) (k_1 . dc_1 + k_2 . dc_2)) / s``."""
    s, c1, c2, k1, k2 = found.s, found.c1, found.c2, found.k1, found.k2
    ratio = found.r / s
    by_m1 = _less(c1, ratio, cross(k2, b), s)
    by_m2 = _less(c2, ratio, cross(b, k1), s)
    # A rotation of a frame rotates its M together with its ray.
    by_1 = _less(cross(m1, by_m1), -ratio / s, cross(c1, k1), 1.0)
    by_2 = _less(cross(m2, by_m2), -ratio / s, cross(c2, k2), 1.0)
    by_b = _less(_less(cross(m1, m2), ratio, cross(k1, m2), 1.0), ratio, cross(m1, k2), s)
    return _Derivatives(by_m1, by_m2, by_1, by_2, by_b)


@inlined_kernel
def _add_view(J: Array, by_turn: Vector, sight: _Sight, row: float, covariate: float, share: float,
              Q_middle: Array) -> None:
    """Add the derivatives through the orientation of one frame.

    `by_turn` is the derivative by a small rotation of the frame, of which `share` follows `turn`.
    """
    by_time = dot(by_turn, rotated(sight.Q, sight.rate))
    J[READOUT] += row * by_time
    J[OFFSET] += by_time
    J[SLOPE] += covariate * by_time
    J[EXPOSURE] += dot(by_turn, rotated(sight.Q, sight.blur))
    by_rotation = rotated_back(sight.Q, by_turn)
    by_bias = rotated_back(sight.by_bias, by_turn)
    by_own_turn = rotated_back(Q_middle, by_turn)
    for i in range(3):
        J[ROTATION + i] += by_rotation[i]
        J[BIAS + i] -= by_bias[i]
        J[TURN + i] += share * by_own_turn[i]


@inlined_kernel
def _add_lens(J: Array, view: View, n: int, by_m: Vector, c: Vector, sight: _Sight,
              ratio: float) -> None:
    """Add the derivatives by the lens through one frame: by its ray, and by s through P.

    ``s ds = (P^T h) . (dP^T h)`` with ``h = M^T c``; `ratio` is r / s^2.
    """
    by_point, h, P = rotated_back(sight.M, by_m), rotated_back(sight.M, c), sight.by_pixel
    q0 = ratio * (P[0, 0] * h[0] + P[1, 0] * h[1])
    q1 = ratio * (P[0, 1] * h[0] + P[1, 1] * h[1])
    by_lens, dP = view.by_lens[n], view.by_pixel_by_lens[n]
    for k in range(_OF_LENS):
        J[FOCAL + k] += (by_point[0] * by_lens[0, k] + by_point[1] * by_lens[1, k]
                         - q0 * (dP[0, 0, k] * h[0] + dP[1, 0, k] * h[1])
                         - q1 * (dP[0, 1, k] * h[0] + dP[1, 1, k] * h[1]))


@inlined_kernel
def _blur_at(problem: Problem, k: int, time: float, out: Array) -> None:
    """Turn (3,) by the square of the exposure at a time after knot `k` [rad/s^2]."""
    dt = time - problem.gyro_times[k]
    half_share = 0.5 * dt / (problem.gyro_times[k + 1] - problem.gyro_times[k])
    for i in range(3):
        change = problem.blur_rates[k + 1, i] - problem.blur_rates[k, i]
        out[i] = problem.blur_turns[k, i] + dt * (problem.blur_rates[k, i] + half_share * change)


@inlined_kernel
def _integral_since(path: GyroPath, middle: int, k: int, time: float, out: Array) -> None:
    """Integral (3, 3) of the rotations from knot `middle` to a time after knot `k` [s]."""
    dt = time - path.times[k]
    for i in range(3):
        for j in range(3):
            out[i, j] = (path.turned[k, i, j] - path.turned[middle, i, j]
                         + dt * path.rotations[k, i, j])


@inlined_kernel
def _add_match(J: Array, r: float, weight: float, gradient: Array, hessian: Array) -> None:
    """Add the residual of a match to the gradient and the lower triangle of the Hessian."""
    for i in range(ALL):
        gradient[i] += weight * r * J[i]
        for j in range(i + 1):
            hessian[i, j] += weight * J[i] * J[j]


@kernel
def accumulate(problem: Problem, path: GyroPath, unknowns: Unknowns, tangent: Array,
               derivatives: bool, sums: Sums) -> None:
    """Sum robust losses, gradients and Hessians over the matches of each pair, without priors.

    `tangent` (P, 2, 3) holds the tangent vectors that span the steps of each direction.

    With residual r, ``d^2 = (r / noise)^2`` and ``l = 1 / (1 + d^2 / ROBUST^2)`` the loss of a
    match is ``d^2 l / 2`` (Geman-McClure) and its weight ``l^2 / noise^2``.
    """
    view1, view2, parameters = problem.view1, problem.view2, unknowns.parameters
    readout = parameters[READOUT]
    sight1, sight2, J = _new_sight(), _new_sight(), np.empty(ALL)
    for p in range(len(problem.middle)):
        middle = problem.middle[p]
        Q_middle = path.rotations[middle]
        straight = rotated(Q_middle, unknowns.direction[p])
        bend = rotated(Q_middle, unknowns.bend[p])
        # Half of `turn` forwards in frame 2, and half of it backwards in frame 1.
        half = so3.exp_so3(0.5 * (Q_middle @ unknowns.turn[p]))
        half_back = np.ascontiguousarray(half.T)
        start1, start2 = _start(view1, p, parameters), _start(view2, p, parameters)
        k1 = k2 = middle
        per_noise2 = 1.0 / unknowns.noise[p] ** 2
        loss = 0.0
        for n in range(problem.begin[p], problem.begin[p + 1]):
            row1, row2 = view1.rows[n], view2.rows[n]
            t1, t2 = start1 + row1 * readout, start2 + row2 * readout
            k1 = _look(path, unknowns.R_imu_cam, half_back, t1, k1, sight1)
            k2 = _look(path, unknowns.R_imu_cam, half, t2, k2, sight2)
            m1 = _through_lens(view1, n, parameters, sight1)
            m2 = _through_lens(view2, n, parameters, sight2)
            rows = row1 + row2
            b = _less(straight, -rows, bend, 1.0)   # straight + rows bend
            found = _residual(sight1, sight2, m1, m2, b)
            sums.residuals[n] = found.r
            distance2 = found.r**2 * per_noise2
            level = 1.0 / (1.0 + distance2 / ROBUST**2)
            loss += 0.5 * distance2 * level
            if not derivatives:
                continue
            by = _derivatives(found, m1, m2, b)
            J[:] = 0.0
            _integral_since(path, middle, k1, t1, sight1.by_bias)
            _integral_since(path, middle, k2, t2, sight2.by_bias)
            _blur_at(problem, k1, t1, sight1.blur)
            _blur_at(problem, k2, t2, sight2.blur)
            _add_view(J, by.by_1, sight1, row1, view1.covariates[p], -0.5, Q_middle)
            _add_view(J, by.by_2, sight2, row2, view2.covariates[p], 0.5, Q_middle)
            ratio = found.r / found.s**2
            _add_lens(J, view1, n, by.by_m1, found.c1, sight1, ratio)
            _add_lens(J, view2, n, by.by_m2, found.c2, sight2, ratio)
            by_b = rotated_back(Q_middle, by.by_b)
            J[DIRECTION] = dot(tangent[p, 0], by_b)
            J[DIRECTION + 1] = dot(tangent[p, 1], by_b)
            for i in range(3):
                J[BEND + i] = rows * by_b[i]
            _add_match(J, found.r, level * level * per_noise2, sums.gradient[p], sums.hessian[p])
        sums.losses[p] = loss


@kernel
def eliminate(sums: Sums, prior: Array, damping: Array, score: Array, reduced: Array,
              back: Array) -> None:
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
def find_directions(problem: Problem, path: GyroPath, unknowns: Unknowns,
                    chosen: NDArray[np.int64], direction: Array) -> None:
    """Replace `direction` (P, 3) by the best of itself and of those that two matches each fix.

    `chosen` (K, 2) are large random numbers that pick the matches. The best has the least
    truncated cost.
    """
    most = 0
    for p in range(len(problem.middle)):
        most = max(most, problem.begin[p + 1] - problem.begin[p])
    normals, squares = np.empty((most, 3)), np.empty((most, 3, 3))
    for p in range(len(problem.middle)):
        count = problem.begin[p + 1] - problem.begin[p]
        Q_middle = path.rotations[problem.middle[p]]
        _constraints(problem, path, unknowns, p, normals, squares)
        limit = (ROBUST * unknowns.noise[p]) ** 2
        least, best = np.inf, (0.0, 0.0, 0.0)
        for h in range(-1, len(chosen)):
            if h < 0:
                b = rotated(Q_middle, direction[p])
            else:
                b = cross(normals[chosen[h, 0] % count], normals[chosen[h, 1] % count])
            length = norm(b)
            if length < 1e-14:
                continue
            b = (b[0] / length, b[1] / length, b[2] / length)
            cost = _truncated_cost(normals, squares, count, b, limit, least)
            if cost < least:
                least, best = cost, b
        if least < np.inf:
            in_middle = rotated_back(Q_middle, best)
            for i in range(3):
                direction[p, i] = in_middle[i]


@kernel
def _constraints(problem: Problem, path: GyroPath, unknowns: Unknowns, p: int, normals: Array,
                 squares: Array) -> None:
    """Fill `normals` and `squares` of a pair: ``e = normal . b`` and ``s^2 = b^T square b``."""
    view1, view2, parameters = problem.view1, problem.view2, unknowns.parameters
    uncorrected = np.eye(3)
    sight1, sight2 = _new_sight(), _new_sight()
    start1, start2 = _start(view1, p, parameters), _start(view2, p, parameters)
    k1 = k2 = problem.middle[p]
    for i in range(problem.begin[p + 1] - problem.begin[p]):
        n = problem.begin[p] + i
        k1 = _look(path, unknowns.R_imu_cam, uncorrected,
                   start1 + view1.rows[n] * parameters[READOUT], k1, sight1)
        k2 = _look(path, unknowns.R_imu_cam, uncorrected,
                   start2 + view2.rows[n] * parameters[READOUT], k2, sight2)
        m1 = _through_lens(view1, n, parameters, sight1)
        m2 = _through_lens(view2, n, parameters, sight2)
        normal = cross(m1, m2)
        for c in range(3):
            normals[i, c] = normal[c]
        squares[i] = 0.0
        _add_squares(sight1, m2, squares[i])
        _add_squares(sight2, m1, squares[i])


@inlined_kernel
def _add_squares(sight: _Sight, other: Vector, square: Array) -> None:
    """Add ``g g^T`` of both pixel coordinates of one frame, with ``de/dpixel = g . b``."""
    P = sight.by_pixel
    for r in range(2):
        g = cross(rotated(sight.M, (P[0, r], P[1, r], 0.0)), other)
        for c in range(3):
            for d in range(3):
                square[c, d] += g[c] * g[d]


@inlined_kernel
def _truncated_cost(normals: Array, squares: Array, count: int, b: Vector, limit: float,
                    least: float) -> float:
    """Sum of ``min((e / s)^2, limit)``; any number from `least` on if it is not less."""
    cost = 0.0
    for i in range(count):
        s2 = max(dot(b, rotated(squares[i], b)), 1e-16)
        cost += min(dot(normals[i], b) ** 2 / s2, limit)
        if cost >= least:
            break
    return cost
