"""Residuals of the matches of a recording, their derivatives, and the direction of a pair.

Frame i exposes row v at ``t_i(v) = stamp_i + offset + slope k_i + s(v) readout`` with
``s(v) = (v - middle row) / height``. With ``A(t)`` the rotation of the camera by the gyro and
``n = (x, y, 1)`` the undistorted point, ``A(t_i) n_i`` is the ray in a frame that does not rotate.
The residual of two rays and the displacement of the camera is that of `core.epipolar`; rotation
and derivatives at a row are those of `core.rows`.

Each pair has unknowns of its own: the unit vector `direction` of the displacement; `bend`, a
change of velocity, which adds ``bend (s_1 + s_2)`` to it; and `turn`, the rotation that the noise
of the gyro hides. The prior of `bend` is in units of the displacement: a readout time that is too
long gains no freedom by it. Points and their derivatives by the pixel are linear in the parameters
of the lens. All of it is in docs/calibration.md, "Method".
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.core import deviations
from rs_relpose_ros.core.deviations import OFFLINE
from rs_relpose_ros.core.epipolar import (
    by_motion,
    by_rays,
    Residual,
    residual,
    square_at_baseline,
    View,
    write_constraint,
)
from rs_relpose_ros.core.least_squares import first_indices
from rs_relpose_ros.core.losses import geman_mcclure_cost, geman_mcclure_weight, truncated_cost
from rs_relpose_ros.core.rows import add_by_axes, add_by_gyro, add_by_time, TurnedPath
from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.geometry.gyro import GyroPath, knot_before, write_state
from rs_relpose_ros.geometry.lens import N_LENS
from rs_relpose_ros.geometry.so3 import (
    add,
    cross,
    dot,
    multiply,
    norm,
    rotated,
    rotated_back,
    scale,
    Vector,
)
from rs_relpose_ros.jit import inlined_kernel, kernel

# -- Data and unknowns ----------------------------------------------------------------------------

# Places of the parameters of the calibration, which are the values of `OFFLINE`; entries with more
# than one value have slices. From the first to the last row [s].
READOUT = OFFLINE.index('readout_time')
# Offset of the clocks at the middle row [s].
OFFSET = OFFLINE.index('time_offset')
# Change of the offset by the covariate of a frame [s/s].
SLOPE = OFFLINE.index('offset_per_interval')
# Turn of the camera's axes [rad].
ROTATION = OFFLINE.part('axes')
# Bias of the gyro [rad/s].
BIAS = OFFLINE.part('gyro_bias')
# Errors of the scale of each axis of the gyro.
SCALE = OFFLINE.part('gyro_scale')
# Skew between each two axes of the gyro [rad].
SKEW = OFFLINE.part('gyro_skew')
# Logarithm of the focal length over the assumed one. All of the lens is beyond that camera.
FOCAL = OFFLINE.index('focal_log')
# Ratio fy / fx.
ASPECT = OFFLINE.index('aspect')
# Coefficients k1, k2, k3.
DISTORTION = OFFLINE.part('distortion')
# Coefficients p1, p2.
TANGENTIAL = OFFLINE.part('tangential')
# Principal point [px].
CENTER = OFFLINE.part('principal_point')
# Square of the exposure beyond the assumed one [s^2].
EXPOSURE = OFFLINE.index('exposure_square')
# All of the lens, in the order of `geometry.lens`, at the end of the vector.
LENS = deviations.LENS
# Number of the parameters.
GLOBAL = OFFLINE.size
# Places of the unknowns of a pair, after the parameters.
_UNKNOWNS = first_indices(parameters=GLOBAL, direction=2, bend=3, turn=3)
# Step of the direction in its tangent plane.
DIRECTION = _UNKNOWNS['direction']
# Change of the velocity, over the displacement.
BEND = _UNKNOWNS['bend']
# Rotation that the noise of the gyro hides [rad].
TURN = _UNKNOWNS['turn']
# Number of the parameters and the unknowns of a pair.
ALL = _UNKNOWNS['end']
# Number of the unknowns of a pair.
LOCAL = ALL - GLOBAL
# Residual [sigma] beyond which the Geman-McClure loss is nearly constant. A smaller one takes good
# matches for outliers, a larger one lets outliers move the optimum. [chosen: 3 sigmas, which one
# match in 370 exceeds by chance]
ROBUST = 3.0
# Length below which the cross product of two constraints is no direction: the matches coincide.
# [chosen: constraints of real matches are above 1e-6; any value in 1e-20..1e-10 would do]
_LEAST_LENGTH = 1e-14


class Problem(NamedTuple):
    """Data of a fit to P pairs with N matches in all."""

    gyro_times: Array  # (K,) [s]
    gyro_rates: Array  # (K, 3) mean over the assumed exposure [rad/s]
    blur_rates: Array  # (K, 3) their derivative by the square of the exposure [rad/s^3]
    times: Array  # (2, P) stamps of the frames of each pair [s]
    covariates: Array  # (2, P) covariates k_i of the offset; see `FrameTimes` [s]
    begin: NDArray[np.int64]  # (P + 1,) matches of pair p: begin[p] to begin[p + 1]
    # (P,) knot of the gyro near the middle of the pair. `direction`, `bend` and `turn` are in the
    # axes of the camera at that knot: in those of the start they would rotate with each step of
    # the bias.
    middle: NDArray[np.int64]
    # Of both frames of each match:
    rows: Array  # (2, N) s(v) of the raw rows
    points: Array  # (2, N, 2) undistorted and normalised with the assumed camera
    by_pixel: Array  # (2, N, 2, 2) derivative of the normalised point by the pixel
    by_lens: Array  # (2, N, 2, 9) derivative of the normalised point by the lens
    by_pixel_by_lens: Array  # (2, N, 2, 2, 9) derivative of `by_pixel` by the lens
    bend_sigma: Array  # (P,) 1 sigma of each component of `bend`
    turn_sigma: Array  # (P,) 1 sigma of each component of `turn` [rad]
    prior: Array  # (GLOBAL, GLOBAL) information of the parameters before the fit
    center: Array  # (GLOBAL,) their means by the prior
    # (P,) of the cost of each pair: below 1 where pairs scatter more than their noise. No kernel
    # reads it.
    weight: Array

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
            weight=self.weight[kept],
        )


class Unknowns(NamedTuple):
    """The calibration and the unknowns of the pairs."""

    # (GLOBAL,) with zeros in place of the axes, which are `R_cam_imu`.
    parameters: Array
    R_cam_imu: Array  # (3, 3)
    own: Array  # (P, 9) of each pair: unit vector `direction`, `bend`, and `turn` [rad]
    noise: Array  # (P,) 1 sigma of the residuals [px]
    damping: Array  # (P,) Levenberg-Marquardt damping of the pair's own unknowns

    def pairs_of(self, kept: NDArray[np.bool_]) -> Unknowns:
        """The same calibration for some of the pairs (P,)."""
        return self._replace(
            own=self.own[kept], noise=self.noise[kept], damping=self.damping[kept]
        )


class Sums(NamedTuple):
    """Results of a pass over all matches; the last two are empty unless requested.

    Their k parameters are those of `accumulate`.
    """

    losses: Array  # (P,) robust loss
    residuals: Array  # (N,) [px]
    gradient: Array  # (P, k + LOCAL) of the losses
    hessian: Array  # (P, k + LOCAL, k + LOCAL) Gauss-Newton approximation, lower triangles


# -- One match ------------------------------------------------------------------------------------


class _Sight(NamedTuple):
    """Memory for the camera at the time of a row; overwritten for each match."""

    by_gyro: Array  # (3, 3) rotation by the gyro alone, to the axes of the start
    rate: Array  # (3,) of the camera [rad/s]
    rotation: Array  # (3, 3) the same rotation with the `turn` of the pair


@inlined_kernel
def _new_sight() -> _Sight:
    return _Sight(np.empty((3, 3)), np.empty(3), np.empty((3, 3)))


@inlined_kernel
def _look(path: GyroPath, correction: Array, time: float, near: int, sight: _Sight) -> int:
    """Fill `sight` at a time; return the knot before it."""
    k = knot_before(path.times, time, near)
    write_state(path, time, k, sight.by_gyro, sight.rate)
    multiply(correction, sight.by_gyro, sight.rotation)
    return k


@inlined_kernel
def _view(rotation: Array, point: Array, by_pixel: Array) -> View:
    """Ray of a match, and its derivatives by the pixel, in the axes of the start."""
    return View(
        rotated(rotation, (point[0], point[1], 1.0)),
        rotated(rotation, (by_pixel[0, 0], by_pixel[1, 0], 0.0)),
        rotated(rotation, (by_pixel[0, 1], by_pixel[1, 1], 0.0)),
    )


@inlined_kernel
def _starts(problem: Problem, p: int, parameters: Array) -> tuple[float, float]:
    """Times of the middle rows of a pair on the clock of the gyro [s]."""
    return (
        problem.times[0, p] + parameters[OFFSET] + parameters[SLOPE] * problem.covariates[0, p],
        problem.times[1, p] + parameters[OFFSET] + parameters[SLOPE] * problem.covariates[1, p],
    )


@inlined_kernel
def _add_lens(J: Array, rotation: Array, by: View, problem: Problem, side: int, n: int) -> None:
    """Add the derivatives by the lens through the ray of one frame and its derivatives."""
    ray = rotated_back(rotation, by.ray)
    by_u, by_v = rotated_back(rotation, by.by_u), rotated_back(rotation, by.by_v)
    by_lens, by_pixel = problem.by_lens[side, n], problem.by_pixel_by_lens[side, n]
    for k in range(N_LENS):
        for i in range(2):
            J[FOCAL + k] += ray[i] * by_lens[i, k]
            J[FOCAL + k] += by_u[i] * by_pixel[i, 0, k] + by_v[i] * by_pixel[i, 1, k]


@inlined_kernel
def _add_match(
    J: Array,
    columns: NDArray[np.int64],
    chosen: Array,
    r: float,
    weight: float,
    gradient: Array,
    hessian: Array,
) -> None:
    """Add the residual of a match to the gradient and the lower triangle of the Hessian."""
    for i in range(len(columns)):
        chosen[i] = J[columns[i]]
        weighted = weight * chosen[i]
        gradient[i] += r * weighted
        for j in range(i + 1):
            hessian[i, j] += weighted * chosen[j]


# -- All matches ----------------------------------------------------------------------------------


class _Pair(NamedTuple):
    """A pair at the current unknowns, in the axes of the start."""

    number: int
    Q_middle: Array  # (3, 3) rotation of the camera at the middle knot
    straight: Vector
    bend: Vector
    # (3, 3) rotations by half of the turn, back for frame 1 and forwards for frame 2.
    turn1: Array
    turn2: Array
    starts: tuple[float, float]  # times of the middle rows [s]


class _Match(NamedTuple):
    """A match at the current unknowns."""

    number: int
    first: View
    second: View
    baseline: Vector
    residual: Residual
    # Times of the rows, and the knots before them.
    time1: float
    time2: float
    knot1: int
    knot2: int


@inlined_kernel
def _pair(problem: Problem, path: GyroPath, unknowns: Unknowns, p: int) -> _Pair:
    """Read pair p."""
    Q_middle, own = path.rotations[problem.middle[p]], unknowns.own[p]
    half = so3.exp_so3(0.5 * (Q_middle @ own[6:]))
    return _Pair(
        p,
        Q_middle,
        rotated(Q_middle, own[:3]),
        rotated(Q_middle, own[3:6]),
        np.ascontiguousarray(half.T),
        half,
        _starts(problem, p, unknowns.parameters),
    )


@inlined_kernel
def _match(
    problem: Problem,
    path: GyroPath,
    pair: _Pair,
    readout: float,
    n: int,
    near: tuple[int, int],
    sight1: _Sight,
    sight2: _Sight,
) -> _Match:
    """Evaluate match n, and fill the sights of its two rows; `near` are knots to search from."""
    row1, row2 = problem.rows[0, n], problem.rows[1, n]
    time1, time2 = pair.starts[0] + row1 * readout, pair.starts[1] + row2 * readout
    knot1 = _look(path, pair.turn1, time1, near[0], sight1)
    knot2 = _look(path, pair.turn2, time2, near[1], sight2)
    first = _view(sight1.rotation, problem.points[0, n], problem.by_pixel[0, n])
    second = _view(sight2.rotation, problem.points[1, n], problem.by_pixel[1, n])
    baseline = add(pair.straight, scale(row1 + row2, pair.bend))
    at = residual(first, second, baseline)
    return _Match(n, first, second, baseline, at, time1, time2, knot1, knot2)


@inlined_kernel
def _write_derivatives(
    J: Array,
    problem: Problem,
    turned: TurnedPath,
    tangent: Array,
    pair: _Pair,
    match: _Match,
    sight1: _Sight,
    sight2: _Sight,
) -> None:
    """Write the derivatives of a match by all parameters but the lens, and by the pair's own."""
    n, p = match.number, pair.number
    row1, row2 = problem.rows[0, n], problem.rows[1, n]
    for i in range(ALL):
        J[i] = 0.0
    by_b, by_1, by_2 = by_motion(match.first, match.second, match.baseline, match.residual)
    by_path1, by_path2 = rotated_back(pair.turn1, by_1), rotated_back(pair.turn2, by_2)
    add_by_axes(J, by_path1, sight1.by_gyro)
    add_by_axes(J, by_path2, sight2.by_gyro)
    covariate1, covariate2 = problem.covariates[0, p], problem.covariates[1, p]
    add_by_time(J, by_path1, sight1.by_gyro, sight1.rate, row1, covariate1)
    add_by_time(J, by_path2, sight2.by_gyro, sight2.rate, row2, covariate2)
    add_by_gyro(J, by_path1, turned, match.time1, match.knot1)
    add_by_gyro(J, by_path2, turned, match.time2, match.knot2)
    # The displacement rotates with the camera at the middle of the pair.
    by_middle = cross(match.baseline, by_b)
    middle = problem.middle[p]
    add_by_axes(J, by_middle, pair.Q_middle)
    times = turned.path.times
    add_by_gyro(J, by_middle, turned, times[middle], min(middle, len(times) - 2))
    by_direction = rotated_back(pair.Q_middle, by_b)
    J[DIRECTION] = dot(tangent[0], by_direction)
    J[DIRECTION + 1] = dot(tangent[1], by_direction)
    by_turn = rotated_back(pair.Q_middle, add(by_2, scale(-1.0, by_1)))
    for i in range(3):
        J[BEND + i] = (row1 + row2) * by_direction[i]
        J[TURN + i] = 0.5 * by_turn[i]


@kernel
def accumulate(
    problem: Problem,
    turned: TurnedPath,
    unknowns: Unknowns,
    tangent: Array,
    columns: NDArray[np.int64],
    sums: Sums,
) -> None:
    """Sum robust losses, gradients and Hessians over the matches of each pair, without priors.

    `tangent` (P, 2, 3) spans the steps of each direction. `columns` are the places of the k
    parameters of `sums` and of the unknowns of a pair; without any, the losses alone are summed.
    With ``q = (r / noise / ROBUST)^2`` the loss of a match is ``ROBUST^2 q / (1 + q) / 2``
    (Geman-McClure).
    """
    readout = unknowns.parameters[READOUT]
    sight1, sight2 = _new_sight(), _new_sight()
    J, chosen = np.empty(ALL), np.empty(len(columns))
    has_lens = False
    for column in columns:
        has_lens = has_lens or FOCAL <= column < GLOBAL
    for p in range(len(problem.middle)):
        pair = _pair(problem, turned.path, unknowns, p)
        near = (problem.middle[p], problem.middle[p])
        variance = unknowns.noise[p] ** 2
        limit = ROBUST**2 * variance
        sums.losses[p] = 0.0
        for n in range(problem.begin[p], problem.begin[p + 1]):
            match = _match(problem, turned.path, pair, readout, n, near, sight1, sight2)
            near = (match.knot1, match.knot2)
            r = sums.residuals[n] = match.residual.value
            sums.losses[p] += 0.5 * ROBUST**2 * geman_mcclure_cost(r * r / limit)
            if len(columns) == 0:
                continue
            _write_derivatives(J, problem, turned, tangent[p], pair, match, sight1, sight2)
            if has_lens:
                by1, by2 = by_rays(match.first, match.second, match.baseline, match.residual)
                _add_lens(J, sight1.rotation, by1, problem, 0, n)
                _add_lens(J, sight2.rotation, by2, problem, 1, n)
            weight = geman_mcclure_weight(r * r / limit) / variance
            _add_match(J, columns, chosen, r, weight, sums.gradient[p], sums.hessian[p])


@kernel
def find_directions(
    problem: Problem, path: GyroPath, unknowns: Unknowns, chosen: NDArray[np.int64]
) -> None:
    """Replace each direction by the best of itself and of those that two matches each fix.

    `chosen` (K, 2) are large random numbers that pick the matches. The best has the least sum of
    the squared residuals, each limited to that of an outlier.
    """
    most = np.diff(problem.begin).max()
    constraints = np.empty((most, 5, 3))
    for p in range(len(problem.middle)):
        count = problem.begin[p + 1] - problem.begin[p]
        Q_middle = path.rotations[problem.middle[p]]
        _write_constraints(problem, path, unknowns, p, constraints)
        limit = (ROBUST * unknowns.noise[p]) ** 2
        own = unknowns.own[p]
        least, best = np.inf, (0.0, 0.0, 0.0)
        for h in range(-1, len(chosen)):
            if h < 0:
                b = rotated(Q_middle, own[:3])
            else:
                one, other = chosen[h, 0] % count, chosen[h, 1] % count
                b = cross(constraints[one, 0], constraints[other, 0])
            length = norm(b)
            if length < _LEAST_LENGTH:
                continue
            b = scale(1.0 / length, b)
            cost = 0.0
            for i in range(count):
                cost += truncated_cost(square_at_baseline(constraints[i], b), limit)
                if cost >= least:
                    break
            if cost < least:
                least, best = cost, b
        if least < np.inf:
            own[0], own[1], own[2] = rotated_back(Q_middle, best)


@kernel
def _write_constraints(
    problem: Problem, path: GyroPath, unknowns: Unknowns, p: int, constraints: Array
) -> None:
    """Write the constraints of the matches of a pair on its direction."""
    parameters, uncorrected = unknowns.parameters, np.eye(3)
    sight1, sight2 = _new_sight(), _new_sight()
    starts = _starts(problem, p, parameters)
    k1 = k2 = problem.middle[p]
    for i in range(problem.begin[p + 1] - problem.begin[p]):
        n = problem.begin[p] + i
        t1 = starts[0] + problem.rows[0, n] * parameters[READOUT]
        t2 = starts[1] + problem.rows[1, n] * parameters[READOUT]
        k1 = _look(path, uncorrected, t1, k1, sight1)
        k2 = _look(path, uncorrected, t2, k2, sight2)
        first = _view(sight1.rotation, problem.points[0, n], problem.by_pixel[0, n])
        second = _view(sight2.rotation, problem.points[1, n], problem.by_pixel[1, n])
        write_constraint(first, second, constraints[i])
