"""Recursive calibration from frame pairs, the unknowns of each pair eliminated.

Names are those of the equations in docs/monitor.md, "Recursive calibration". The deviations c (K,)
are values of the selection `LIVE` of `core.deviations`.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
import functools
import math
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.spatial.transform import Rotation

from rs_relpose_ros.core.deviations import (
    by_stamped_row,
    LENS,
    LIVE,
    N_DEVIATIONS,
    PARTS,
)
from rs_relpose_ros.core.epipolar import derivatives
from rs_relpose_ros.core.least_squares import inverse
from rs_relpose_ros.core.losses import cauchy_weight, robust_scale
from rs_relpose_ros.core.rows import row_states, RowStates
from rs_relpose_ros.estimator import priors
from rs_relpose_ros.estimator.covariance import image_regions, IMAGES, POSE, REGIONS
from rs_relpose_ros.estimator.fit import gauss_newton
from rs_relpose_ros.estimator.priors import PARAMETERS, TANGENT, THETA, TwoViewState
from rs_relpose_ros.estimator.problem import build_problem, TwoViewProblem
from rs_relpose_ros.estimator.sampling import translation_direction
from rs_relpose_ros.estimator.sampson import FitMatches, jacobian, residuals
from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.gyro import GyroPath
from rs_relpose_ros.geometry.lens import N_LENS
from rs_relpose_ros.geometry.motion import FrameMotion, rotations_at_rate
from rs_relpose_ros.geometry.timing import seconds_between, Stamps, to_nanoseconds
from rs_relpose_ros.imu.integration import ImuSlice

# Sigma of the velocities about the mean one [baselines per second]. A smaller one takes a change
# of velocity for a readout time, a larger one leaves the readout time undetermined.
# [chosen: as the estimate of a pair]
_VELOCITY_SIGMA = 1.0
# Residuals of this many sigmas have half the weight of small ones (Cauchy). Fewer lose
# information, more let wrong matches count. [derived: 95 % efficiency for normal residuals]
CAUCHY_SIGMAS = 2.4
# Least noise of matches [px]. It limits the information of matches without noise.
# [chosen: below the noise of any tracker]
LEAST_SIGMA = 0.05
# Least noise of the gyro's rotation between two frames [rad]; without it a gyro that is configured
# as free of noise has no finite information. [chosen: below that of any gyro]
_LEAST_ROTATION_SIGMA = 1e-5
# Largest number of matches, evenly over those of the pair. More cost time and add little, since
# neighbours have the same errors. [chosen: 80 to 200 would do]
_MOST_MATCHES = 120
# Time by which the gyro must extend beyond the rows [s], for rounding.
# [chosen: below any interval of a gyro]
_LEAST_SPAN = 1e-4
# Sigma of velocities [baselines/s] that matches of a global shutter do not observe: their change
# by deviations stays finite. [chosen: 10 to 1000 would do: above any velocity]
_UNKNOWN_VELOCITY = 30.0
# Steps of a new fit of a pair, which starts near its optimum. Fewer would leave it off, more cost
# time. [chosen: Gauss-Newton is quadratic; 3 to 5 would do]
_NEW_STEPS = 3
# Places of single deviations in the vector c: of the time offset of the stamped row,
_OFFSET = LIVE.index('time_offset')
# of the readout time,
_READOUT = LIVE.index('readout_time')
# Number of deviations before those of the lens, which come last.
_LENS = LIVE.part('focal_log').start
# Deviations that leave a pattern in the image: the entries of the lens.
OF_LENS = tuple(name for name in LIVE.parts if LENS.start <= PARTS[name].start < LENS.stop)
# Of a state: rotation and direction of translation.
_POSE = np.r_[THETA : THETA + 3, TANGENT : TANGENT + 2]


@dataclass(frozen=True, slots=True, eq=False)
class PairData:
    """Matches and motion of one pair, as configured, and the pose estimated from them."""

    points1: Array  # (N, 2) pixels of the sensor
    points2: Array
    camera: RollingShutterCamera
    motion1: FrameMotion  # about the stamped row
    motion2: FrameMotion
    interval: float  # [s]
    R: Array  # (3, 3) as estimated, between the stamped rows
    t: Array  # (3,) NaN where there is none
    segment: ImuSlice  # between the stamped rows
    R_cam_imu: Array
    gyro_sigma: float  # [rad/s] of the rate within a frame
    stamp_sigma: float = 0.0  # [s] of the stamp of each image


@dataclass(frozen=True, slots=True, eq=False)
class PairInformation:
    """Information of a pair on the calibration."""

    S: Array  # (K, K)
    b: Array  # (K,)
    # (K,) factors of both if a deviation is free: its residuals are no noise.
    if_free: Array
    pose_by_deviation: Array  # (6, K) of (dt, dtheta) in camera 1, first order
    # (5, K) the same in sigmas of a correctly configured pose, whitened; rotation in the first 3.
    shift_by_deviation: Array
    images_against_gyro: Array  # (3,) [rad] Log of the rotation by images alone and R_gyro^T
    # (11, 9) change of the estimate by the images alone, at the middle rows.
    images_by_deviation: Array


class _Linearised(NamedTuple):
    """A pair at its fitted state: residuals, and derivatives by the state and K deviations.

    The matches depend on both. The rotation by the gyro is a prior of the state, and the gyro
    depends on the deviations: ``theta = Log(R R_gyro^T)`` becomes smaller by ``gyro dc``.
    """

    state: TwoViewState
    observations: Array  # (N, 20) rows of `sampson`
    residuals: Array  # (N,) [px]
    by_state: Array  # (N, 17)
    by_deviation: Array  # (N, K)
    by_image: Array  # (N, 9) by the deviations of IMAGES
    prior: priors.Priors  # of the state
    theta: Array  # (3,)
    gyro: Array  # (3, K) rotation of R_gyro, on its left


class _Normal(NamedTuple):
    """Normal equations of a pair: H of the state, C of the state by the deviations."""

    H: Array  # (17, 17)
    gradient: Array  # (17,)
    mixed: Array  # (17, K)
    own: Array  # (K, K)
    own_gradient: Array  # (K,)


def pair_information(pair: PairData, active: Array, about: Array) -> PairInformation | None:
    """Information of a pair, linearised about the deviations `about` (K,).

    Those applied already are `active` (K,): about others the pair is fitted again. None if there
    are too few matches, or if a fit far from the gyro's rotation diverges.
    """
    at = about - active
    basis = LIVE.of_camera(pair.camera)
    pair = thinned(pair, at)
    problem = problem_of(pair)
    information = problem.rotation_information
    if np.count_nonzero(problem.valid) < PARAMETERS or information is None:
        return None
    linear = _linearised(pair, problem, at, basis)
    sigma = robust_scale(linear.residuals, LEAST_SIGMA, 0.0)
    weights = cauchy_weight((linear.residuals / (CAUCHY_SIGMAS * sigma)) ** 2) / sigma**2
    normal = _normal_equations(linear, weights, information)
    solved = inverse(normal.H) @ np.column_stack([normal.mixed, normal.gradient])
    if not np.isfinite(solved).all():
        return None
    S = normal.own - normal.mixed.T @ solved[:, :-1]
    S = 0.5 * (S + S.T)
    b = normal.mixed.T @ solved[:, -1] - normal.own_gradient
    ratio, if_free = _common_noise(
        FitMatches(linear.observations, weights, 1.0),
        linear.by_deviation - linear.by_state @ solved[:, :-1],
        linear.residuals - linear.by_state @ solved[:, -1],
        S,
    )
    S = S / ratio
    b = b / ratio
    by_deviation, whitened = _shifts(pair, problem, linear, normal)
    return PairInformation(
        S,
        b + S @ about,
        ratio / if_free,
        by_deviation,
        whitened,
        _images_against_gyro(linear, normal, information),
        _images_by_deviation(
            linear, weights, normal, information, bool(np.isfinite(pair.t).all())
        ),
    )


def thinned(pair: PairData, at: Array) -> PairData:
    """The pair with at most `_MOST_MATCHES` matches, through the lens of the deviations `at`."""
    step = math.ceil(len(pair.points1) / _MOST_MATCHES) or 1
    return replace(
        pair,
        camera=_with_lens(pair.camera, tuple(at[_LENS:])),
        points1=pair.points1[::step],
        points2=pair.points2[::step],
    )


def problem_of(pair: PairData) -> TwoViewProblem:
    """The pair at its middle rows, its rotation known by the gyro up to its noise and the stamps.

    Errors of the stamps are errors of the times between which the gyro is integrated.
    """
    covariance = pair.segment.noise_covariance + _LEAST_ROTATION_SIGMA**2 * np.eye(3)
    if pair.stamp_sigma:
        rates = pair.segment.angular_velocities[[0, -1]].T
        rates = np.column_stack([rates[:, 0], pair.segment.rotation @ rates[:, 1]])
        covariance = covariance + pair.stamp_sigma**2 * rates @ rates.T
    return build_problem(
        pair.points1,
        pair.points2,
        pair.camera,
        pair.motion1,
        pair.motion2,
        pair.segment.rotation,
        covariance,
    )


class Misfit(NamedTuple):
    """How badly a fitted pair agrees with a camera and deviations."""

    residuals: Array  # (N,) [px]
    of_gyro: float  # half the squared Mahalanobis distance from the gyro's rotation


def misfit_of(pair: PairData, at: Array) -> Misfit | None:
    """Misfit of a pair that is fitted again at deviations `at` (K,) from the active ones.

    None if there are too few matches.
    """
    basis = LIVE.of_camera(pair.camera)
    pair = replace(thinned(pair, at), R=pair.segment.rotation, t=np.full(3, np.nan))
    problem = problem_of(pair)
    information = problem.rotation_information
    if np.count_nonzero(problem.valid) < PARAMETERS or information is None:
        return None
    linear = _linearised(pair, problem, at, basis)
    return Misfit(linear.residuals, 0.5 * float(linear.theta @ information @ linear.theta))


class FrameRows(NamedTuple):
    """Matches of one frame at the deviations about which a pair is linearised."""

    views: Array  # (N, 3, 3) ray and its derivatives by u and v, in axes of the middle row
    times: Array  # (N,) of the rows after the middle row [s]
    states: RowStates  # rotation of the views on the left, and delay of the times
    views_by_lens: Array  # (N, 3, 3, 9)


def frame_rows(pair: PairData, problem: TwoViewProblem, image: int, at: Array) -> FrameRows:
    """The matches of an image with deviations `at` (D,) other than those of the lens."""
    camera = pair.camera
    points = (pair.points1, pair.points2)[image][problem.valid]
    motion = (problem.motion1, problem.motion2)[image]
    rate = motion.angular_velocity
    of_image = problem.observations[problem.valid]
    # A column of its own: kernels would be compiled again for one that is spread over the rows.
    times = np.ascontiguousarray(of_image[:, 18 + image])
    shares = camera.readout_shares(points)
    path = GyroPath.constant(rate, -1.0, 1.0) if motion.path is None else motion.path
    states = row_states(path, pair.R_cam_imu, times, shares)
    views = of_image[:, 9 * image : 9 * image + 9].reshape(-1, 3, 3)
    by_lens = camera.rays_by_lens(points)
    rays_by_lens = by_lens.by_lens[:, None], by_lens.by_pixel_by_lens.swapaxes(1, 2)
    moved = states.rotation[:, None] @ np.concatenate(rays_by_lens, axis=1)
    # One row further, the camera has rotated for one more line delay.
    moved[:, 1 + camera.readout_axis] += camera.line_delay * (so3.skew(rate) @ moved[:, 0])
    if at.any():
        turned = Rotation.from_rotvec(states.by_deviation @ at).as_matrix()
        views = views @ turned.swapaxes(1, 2)
        moved = turned[:, None] @ moved
        times = times + states.time_by_deviation @ at
    return FrameRows(views, times, states, moved)


def _linearised(pair: PairData, problem: TwoViewProblem, at: Array, basis: Array) -> _Linearised:
    """The pair fitted at deviations `at` (K,) from the active ones, and linearised there.

    `basis` (D, K) is that of `LIVE` for the camera as configured: `pair` has the lens of `at`.
    """
    share = middle_share(pair.camera)
    basis = by_stamped_row(LIVE, basis, share)
    of_images = by_stamped_row(IMAGES, IMAGES.basis, share)
    turning = basis[:, :_LENS] @ at[:_LENS]  # the lens is in the camera already
    frames = [frame_rows(pair, problem, image, turning) for image in (0, 1)]
    observations = np.column_stack(
        [*(rows.views.reshape(-1, 9) for rows in frames), *(rows.times for rows in frames)]
    )
    gyro = _gyro(pair)
    rotation = np.ascontiguousarray(so3.exp_so3(gyro @ turning) @ problem.rotation)
    assert problem.rotation_information is not None
    prior = priors.Priors(
        np.zeros(3),
        np.zeros(3),
        0.0,
        0.0,
        pair.gyro_sigma**-2,
        rotation,
        problem.rotation_information,
        priors.isotropic(_VELOCITY_SIGMA, 1.0 / pair.interval),
    )
    state = _state(pair, problem, observations, prior, fit=bool(at.any()))
    residuals, by_deviation = residuals_by_deviation(state, frames)
    return _Linearised(
        state,
        observations,
        residuals,
        jacobian(observations, state),
        by_deviation @ basis,
        by_deviation @ of_images,
        prior,
        so3.log_so3(np.ascontiguousarray(state.R @ rotation.T)),
        gyro @ basis,
    )


def residuals_by_deviation(state: TwoViewState, frames: list[FrameRows]) -> tuple[Array, Array]:
    """Residuals (N,) [px] and their derivatives (N, D) by all deviations."""
    first, second = frames
    baselines = state.t - np.outer(first.times, state.d1) + np.outer(second.times, state.d2)
    # Rotations of the views of each image into the axes of image 1.
    rotations = (
        rotations_at_rate(state.dw1, first.times),
        rotations_at_rate(state.dw2, second.times) @ state.R,
    )
    views = [
        rows.views @ to_first.swapaxes(1, 2)
        for to_first, rows in zip(rotations, frames, strict=True)
    ]
    by = derivatives(np.stack(views, axis=1), baselines)
    total = np.zeros((len(baselines), N_DEVIATIONS))
    rates = ((-state.d1, state.dw1), (state.d2, state.dw2))
    for k, (velocity, rate) in enumerate(rates):
        rows = frames[k]
        to_first = rotations[k]
        by_turn = by.by_rotation[:, k, None] @ to_first
        by_view = (by.by_rays[:, k] @ to_first).reshape(-1, 1, 9)
        by_time = by.by_baseline @ velocity + by.by_rotation[:, k] @ rate
        total += (by_turn @ rows.states.by_deviation)[:, 0]
        total += by_time[:, None] * rows.states.time_by_deviation
        total[:, LENS] += (by_view @ rows.views_by_lens.reshape(-1, 9, N_LENS))[:, 0]
    return by.residuals, total


def _gyro(pair: PairData) -> Array:
    """Rotation (3, D) of the gyro's rotation between the middle rows by all deviations."""
    path = pair.segment.path
    return row_states(path, pair.R_cam_imu, path.times[-1:], np.zeros(1)).by_deviation[0]


def _normal_equations(linear: _Linearised, weights: Array, information: Array) -> _Normal:
    """Normal equations with the priors of the state, of which `information` (3, 3) is the gyro."""
    H = np.zeros((PARAMETERS, PARAMETERS))
    gradient = np.zeros(PARAMETERS)
    priors.add_priors(linear.state, linear.prior, H, gradient)
    weighted = linear.by_state.T * weights
    mixed = weighted @ linear.by_deviation
    mixed[THETA : THETA + 3] -= information @ linear.gyro
    weighted_deviations = linear.by_deviation.T * weights
    of_gyro = linear.gyro.T @ information
    return _Normal(
        H + weighted @ linear.by_state,
        gradient + weighted @ linear.residuals,
        mixed,
        weighted_deviations @ linear.by_deviation + of_gyro @ linear.gyro,
        weighted_deviations @ linear.residuals - of_gyro @ linear.theta,
    )


def _images_against_gyro(linear: _Linearised, normal: _Normal, information: Array) -> Array:
    """Log (3,) [rad] of the rotation by images alone and R_gyro^T: a step without that prior."""
    part = slice(THETA, THETA + 3)
    H = normal.H.copy()
    gradient = normal.gradient.copy()
    H[part, part] -= information
    gradient[part] -= information @ linear.theta
    return np.asarray(linear.theta - (inverse(H) @ gradient)[part])


def _images_by_deviation(
    linear: _Linearised, weights: Array, normal: _Normal, information: Array, has_direction: bool
) -> Array:
    """Change of pose and velocities by the images alone (11, 9) with the deviations of IMAGES.

    Of the priors only that of the rates within the frames stays, as in `ImageInformation`. Without
    a direction only the rotation changes.
    """
    of_theta = slice(THETA, THETA + 3)
    of_priors = np.zeros((PARAMETERS, PARAMETERS))
    gradient = np.zeros(PARAMETERS)
    priors.add_priors(linear.state, linear.prior, of_priors, gradient)
    H = normal.H - of_priors
    H[POSE:, POSE:] += linear.prior.rate_weight * np.eye(PARAMETERS - POSE)
    mixed = (linear.by_state.T * weights) @ linear.by_image
    moved = np.zeros((POSE, IMAGES.size))
    if has_direction:
        velocities = slice(TANGENT + 2, POSE)
        H[velocities, velocities] += _UNKNOWN_VELOCITY**-2 * np.eye(6)
        moved[:] = -(inverse(H) @ mixed)[:POSE]
    else:
        moved[of_theta] = -np.linalg.solve(H[of_theta, of_theta], mixed[of_theta])
    return moved


def _shifts(
    pair: PairData, problem: TwoViewProblem, linear: _Linearised, normal: _Normal
) -> tuple[Array, Array]:
    """Shift of the estimated pose by the deviations, (6, K), and whitened, (5, K).

    With the prior of the estimate for the gyro's rotation. The state is that at the middle row,
    which a longer readout time delays by D = share c against the stamped row:
    ``t = Exp(w_1 D) t_middle, R = Exp(w_1 D) R_middle Exp(w_2 D)^T``; w in middle-row axes.
    """
    assert problem.rotation_information is not None
    part = slice(THETA, THETA + 3)
    direction = slice(TANGENT, TANGENT + 2)
    more = np.linalg.inv(pair.segment.covariance) - problem.rotation_information
    H = normal.H.copy()
    mixed = normal.mixed.copy()
    H[part, part] += more
    mixed[part] -= more @ linear.gyro
    covariance = inverse(H)
    tangent = so3.tangent_basis(linear.state.t)
    moved = -covariance @ mixed
    to_middle = problem.motion1.rotations([problem.reference_row_time])[0]
    share = middle_share(pair.camera)
    rates = pair.segment.angular_velocities
    rate1 = to_middle @ rates[0]
    rate2 = to_middle @ (pair.segment.rotation @ rates[-1])
    moved[direction, _READOUT] += share * (tangent.T @ so3.skew(rate1) @ linear.state.t)
    moved[part, _READOUT] += share * (rate1 - rate2)
    spread = np.linalg.cholesky(covariance[_POSE[:, None], _POSE])
    # In the axes of the stamped row.
    to_stamped = to_middle.T
    by_deviation = np.vstack([to_stamped @ tangent @ moved[direction], to_stamped @ moved[part]])
    return by_deviation, solve_triangular(spread, moved[_POSE], lower=True)


def _common_noise(matches: FitMatches, J: Array, r: Array, S: Array) -> tuple[float, Array]:
    """Variance of the score of the matches by image regions, over that by S; at least 1.

    The second one (K,) is without the residuals that a deviation of the lens explains, for each
    deviation: its pattern in the image is no noise if the deviation is free. J (N, K), r (N,):
    derivatives and residuals of the fitted matches, S (K, K): information of the pair.
    """
    scale = np.outer(LIVE.sigmas, LIVE.sigmas)
    covariance = inverse(S * scale + np.eye(LIVE.size)) * scale
    in_region = image_regions(matches) == np.arange(REGIONS[0] * REGIONS[1])[:, None]
    information = J.T * matches.weights @ J
    independent = float((covariance * information).sum())

    def ratio(left: Array) -> float:
        sums = (in_region * (matches.weights * left)) @ J
        return max((1.0 + float(((sums @ covariance) * sums).sum())) / (1.0 + independent), 1.0)

    by_regions = ratio(r)
    if_free = np.full(LIVE.size, by_regions)
    for name in OF_LENS:
        part = LIVE.part(name)
        along = J[:, part]
        own = information[part, part] + np.diag(LIVE.sigmas[part] ** -2.0)
        explained = along @ np.linalg.solve(own, (along.T * matches.weights) @ r)
        if_free[part] = min(ratio(r - explained), by_regions)
    return by_regions, if_free


def _state(
    pair: PairData, problem: TwoViewProblem, observations: Array, prior: priors.Priors, fit: bool
) -> TwoViewState:
    """The estimate at the middle rows, at constant velocity; fitted again if there is no t."""
    delay = problem.reference_row_time
    R = np.ascontiguousarray(
        problem.motion1.rotations([delay])[0] @ pair.R @ problem.motion2.rotations([delay])[0].T
    )
    t = pair.t
    if not np.isfinite(t).all():
        t = translation_direction(observations, R)
        fit = True
    velocity = t / pair.interval
    state = TwoViewState(R, t, velocity, velocity.copy(), np.zeros(3), np.zeros(3))
    if not fit:
        return state
    r = np.abs(residuals(observations, state))
    matches = FitMatches(
        observations, (r < 4.0 * np.median(r)).astype(float), robust_scale(r, LEAST_SIGMA, 0.0)
    )
    return gauss_newton(matches, state, prior, _NEW_STEPS)


@functools.lru_cache(maxsize=16)
def _with_lens(camera: RollingShutterCamera, lens: tuple[float, ...]) -> RollingShutterCamera:
    """The camera with deviations of its lens, the last ones of `LIVE`."""
    if not any(lens):
        return camera
    return camera.moved_lens(LIVE.of_camera(camera)[LENS, _LENS:] @ lens)


def middle_share(camera: RollingShutterCamera) -> float:
    """Rows from the stamped to the middle one, as a share of the readout: 0.5, 0 or -0.5."""
    return (camera.middle_row - camera.reference_row_index) / camera.row_count


# -- Other times of the rows -------------------------------------------------------------------

# Deviations that change the times of the rows.
_TIMES = [_OFFSET, _READOUT]


def at_other_times(pair: PairData, gyro: ImuSlice, deviations: Array) -> PairData | None:
    """The pair with rows at the times of the deviations, not yet fitted.

    `gyro`, which extends beyond the pair, is integrated again; None if it does not cover all rows.
    """
    camera = pair.camera.with_signed_readout_time(
        pair.camera.signed_readout_time + float(deviations[_READOUT])
    )
    known = (gyro.stamps_ns - gyro.stamps_ns[0]) * 1e-9
    begin, end = camera.row_time_span
    begin = begin - _LEAST_SPAN
    end = end + _LEAST_SPAN
    first, second = (
        seconds_between(gyro.stamps_ns[0], pair.segment.stamps_ns[k]) + float(deviations[_OFFSET])
        for k in (0, -1)
    )
    if first + begin < 0.0 or second + end > known[-1]:
        return None

    def between(start: float, stop: float) -> tuple[Array, Array]:
        times = np.concatenate([[start], known[(known > start) & (known < stop)], [stop]])
        return times, np.column_stack(
            [np.interp(times, known, axis) for axis in gyro.angular_velocities.T]
        )

    times, rates = between(first, second)
    segment = replace(
        pair.segment,
        angular_velocities=rates,
        stamps_ns=gyro.stamps_ns[0] + np.round(times * 1e9).astype(np.int64),
    )
    motions = []
    for stamped in (first, second):
        rows, row_rates = between(stamped + begin, stamped + end)
        motions.append(FrameMotion.from_gyro(rows - stamped, row_rates))
    return replace(
        pair,
        camera=camera,
        motion1=motions[0],
        motion2=motions[1],
        R=segment.rotation,
        t=np.full(3, np.nan),
        segment=segment,
    )


def _far_in_time(deviations: Array) -> bool:
    return float(np.linalg.norm((deviations / LIVE.sigmas)[_TIMES])) >= _NEAR


# -- Sums over pairs ---------------------------------------------------------------------------

# Pairs count for this time [ns]. Longer would average over a calibration that changes with
# temperature, shorter makes the sigmas larger. [chosen: 10 to 60 s would do]
WINDOW_NS = to_nanoseconds(20.0)
# Largest number of pairs. It bounds the work of `solved`. [derived: 5 pairs per second]
MOST_PAIRS = 100
# Older pairs that are linearised again with each new one. More cost time, each as much as a new
# pair; fewer leave the rest about old deviations for longer. [chosen: 2 to 5 would do]
_AGAIN = 3
# Distance between deviations, in sigmas of the prior, within which another linearisation changes
# nothing. [chosen: errors of second order are below 0.1 % there]
_NEAR = 0.02
# Sigmas of n pairs are widened by (n + 6) / n, since few scores scatter less than they should.
# Fewer make findings of the first pairs too certain, more make findings late. [measured: with 0,
# 11 of 117 right pairs of recordings are withheld, with 12 none, as with 6; docs/covariance.md]
_FEW_PAIRS = 6
# Share of a pair's sigma that is common to all pairs, and not reduced by averaging: blur, the
# tracker's bias, a lens that the model does not fit. Less would make sigmas of many pairs too
# small, more would hide deviations. [measured: with 0, one of 117 right pairs of recordings is
# withheld, with 0.3 wrong parameters are found 0.1 s later; docs/covariance.md]
_SHARED = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Estimated deviations from the configuration."""

    c: Array  # (K,)
    covariance: Array  # (K, K)
    S: Array  # (N, K, K) and (N, K): of the pairs, without a prior
    b: Array
    if_free: Array  # (N, K) factors of these if a deviation is free
    about: Array  # (K,) about which they are linearised, in the mean by their information
    scatter: float  # variance of the scores over that by S: 1 where residuals are independent
    shared: float  # factor of the variances by errors that are common to all pairs
    widened: float  # and by the number of pairs

    @property
    def sigma(self) -> Array:
        """(K,) 1 sigma."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


# Before the first pair.
NOTHING_ESTIMATED = Calibration(
    np.zeros(LIVE.size),
    np.diag(LIVE.sigmas**2),
    np.zeros((0, LIVE.size, LIVE.size)),
    np.zeros((0, LIVE.size)),
    np.zeros((0, LIVE.size)),
    np.zeros(LIVE.size),
    1.0,
    1.0,
    1.0,
)


class LastSeconds(deque[Any]):
    """Tuples of the last seconds, at most `most`, each with its stamp [ns] first."""

    def __init__(self, most: int, window_ns: int) -> None:
        super().__init__(maxlen=most)
        self._window_ns = window_ns

    def keep(self, item: tuple[Any, ...]) -> None:
        """Add a tuple, in the order of time; an earlier stamp restarts."""
        if self and item[0] < self[-1][0]:
            self.clear()
        self.append(item)
        while self[0][0] < item[0] - self._window_ns:
            self.popleft()


class _Entry(NamedTuple):
    """A pair and its linearisation."""

    stamp_ns: int
    data: PairData
    active: Array  # (K,)
    about: Array  # (K,)
    information: PairInformation


class Posterior:
    """The pairs of the last seconds."""

    def __init__(self) -> None:
        self._pairs = LastSeconds(MOST_PAIRS, WINDOW_NS)

    def add(
        self, stamp_ns: int, data: PairData, active: Array, about: Array
    ) -> PairInformation | None:
        """Add a pair, in the order of time; its information by `pair_information`."""
        information = pair_information(data, active, about)
        if information is not None:
            self._pairs.keep(_Entry(stamp_ns, data, active, about, information))
        return information

    def relinearise(self) -> bool:
        """Linearise the furthest pairs about the last one's deviations; whether there are any."""
        last = self._pairs[-1]
        apart = np.linalg.norm(
            (np.array([pair.about for pair in self._pairs]) - last.about) / LIVE.sigmas, axis=1
        )
        if len(apart) > 1 and _far_in_time(last.about - last.active):
            apart[-2] = math.inf  # now the gyro after it is known
        chosen = [k for k in np.argsort(apart, kind='stable')[::-1][:_AGAIN] if apart[k] >= _NEAR]
        for k in chosen:
            data = self._pairs[k].data
            active = self._pairs[k].active
            gyro = data.segment
            later = last.about - active
            if _far_in_time(later):  # by the gyro there
                for n in (k - 1, k + 1):
                    other = self._pairs[n].data.segment if 0 <= n < len(self._pairs) else gyro
                    first, second = (other, gyro) if n < k else (gyro, other)
                    if first.stamps_ns[-1] == second.stamps_ns[0]:
                        gyro = first.joined(second)
                if (moved := at_other_times(data, gyro, later)) is not None:
                    data = moved
                    active = active.copy()
                    active[_TIMES] = last.about[_TIMES]
            if (information := pair_information(data, active, last.about)) is not None:
                self._pairs[k] = self._pairs[k]._replace(about=last.about, information=information)
        return bool(chosen)

    @property
    def stamps_ns(self) -> Stamps:
        """Stamps (N,) of the pairs."""
        return np.array([pair.stamp_ns for pair in self._pairs], dtype=np.int64)

    def follow_offsets(self, offsets: Array, first: int = 0) -> None:
        """Refer the pairs from `first` on to a configuration whose offset is `offsets` (N,) later.

        Each pair has its own of N values [s]; pairs before `first` are dropped.
        """
        kept = list(self._pairs)[first:]
        self._pairs.clear()
        for pair, offset in zip(kept, offsets[first:], strict=True):
            change = np.zeros(LIVE.size)
            change[_OFFSET] = offset
            information = replace(
                pair.information, b=pair.information.b - pair.information.S @ change
            )
            self._pairs.append(
                pair._replace(
                    active=pair.active - change,
                    about=pair.about - change,
                    information=information,
                )
            )

    def solved(self) -> Calibration:
        """The calibration that fits all pairs."""
        n = len(self._pairs)
        if not n:
            return NOTHING_ESTIMATED
        S, b, if_free = (
            np.array([getattr(pair.information, name) for pair in self._pairs])
            for name in ('S', 'b', 'if_free')
        )
        # Scaled by the prior: the deviations have different units.
        scale = LIVE.sigmas
        hessian = S.sum(axis=0) * np.outer(scale, scale) + np.eye(LIVE.size)
        covariance = inverse(hessian) * np.outer(scale, scale)
        c = covariance @ b.sum(axis=0)
        # Sandwich (White, Econometrica 1982), about the solution: scores about zero contain it.
        scores = b - S @ c
        sandwich = covariance @ (scores.T @ scores) @ covariance
        widened = ((n + _FEW_PAIRS) / n) ** 2
        shared = 1.0 + _SHARED**2 * n
        ratios = np.maximum(np.diag(sandwich) / np.diag(covariance), 1.0) * widened
        weights = np.einsum('pii->pi', S)
        about = (weights * [pair.about for pair in self._pairs]).sum(axis=0) / np.maximum(
            weights.sum(axis=0), np.finfo(float).tiny
        )
        return Calibration(
            c,
            shared * covariance * np.sqrt(np.outer(ratios, ratios)),
            S,
            b,
            if_free,
            about,
            float(np.median(ratios)),
            shared,
            widened,
        )
