"""The pose of a pair from all of its frames: tracks and IMU of the frames between the two as well.

Starts at the two-view estimate, whose inliers it uses; `adjustment` has the model.
"""

from __future__ import annotations

from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.settings import MOTIONS
from rs_relpose_ros.core.deviations import LIVE, N_DEVIATIONS
from rs_relpose_ros.core.reprojection import (
    ACCELERATION,
    BIAS,
    BLOCK,
    Changes,
    empty_blocks,
    fill_view,
    FrameInertia,
    FrameRays,
    INVERSE_DISTANCE,
    LOG_SCALE,
    MOST_ACCELERATIONS,
    start_of_tracks,
    TANGENT,
    TrackBlocks,
)
from rs_relpose_ros.core.rows import row_states, RowsOfFrames, turned_frames
from rs_relpose_ros.estimator import adjustment
from rs_relpose_ros.estimator.adjustment import Adjusted, PathPriors, PathState
from rs_relpose_ros.estimator.pair_problem import PairProblem
from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.estimator.velocity import CORRELATION_TIME, span_of_scales
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.gyro import GyroPath
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.so3 import by_axes, exp_so3, log_so3, median, skew, tangent_basis

# Error of gravity and accelerometer together, 1 sigma per axis [m/s^2]: a camera in motion does
# not measure its tilt better. With less, the path follows a wrong tilt; with more, the
# accelerometer no longer gives the scale. [derived: 6 deg of tilt at 9.81 m/s^2]
_GRAVITY_SIGMA = 1.0
# Least noise of the gyro's rotation [rad/sqrt(s)]. With less, a gyro that is configured as free of
# noise would decide alone. [chosen: a tenth of a MEMS gyro's noise with its scale errors]
_LEAST_WALK = 5e-4
# Degrees of freedom as which the configured noise of a match counts against the estimated one. A
# larger value keeps the noise at the parameter, a smaller one lets ten tracks decide.
# [chosen: a pair has some 400 degrees of freedom, any value in 5..40 changes its noise by 5 %]
_SIGMA_FREEDOM = 10.0
# Least number of inliers that a frame between must have, to be worth its six unknowns.
# [chosen: 20 coordinates; frames with 5..20 inliers are rare]
_LEAST_TRACKS = 10
# Most inliers of a pair that are adjusted, in whole blocks: more cost time, fewer accuracy.
# [measured: 200 of 280 cost 8 % of t and R on simulated walks, nothing on recordings, where tracks
# share larger errors; 256 take 1.2 of the time]
_MOST_TRACKS = 5 * BLOCK
# Noise of the observations, as a part of `threshold`, beyond which tracks and gyro contradict each
# other: 4 sigmas are then twice that, the largest limit of an inlier. All tracks have the errors
# of the frames, so that the covariance would be too small. [derived: 4 sigmas in 2 thresholds]
_LARGEST_NOISE = 0.5
# Scatter of the stamps [s] from which each frame's own error is in the covariance. Less would cost
# time for shifts that are smaller than the noise, more would make the covariance of a camera that
# is stamped on arrival too small. [chosen: 0.2 to 1 ms would do: a camera that turns by 1 rad/s
# moves by a quarter of a pixel in half a millisecond]
_JITTER = 5e-4
# Least time between the first and the last sample of a frame [s], by which its rate changes. It
# keeps the change of a global shutter finite. [chosen: below any readout; 1e-4 to 1e-3 would do]
_LEAST_SPAN = 1e-3
# Of the residuals of two views, at least this part of the configured noise starts the adjustment:
# exact matches would make the first weights infinite. [chosen: any value in 0.01..0.3 would do]
_LEAST_NOISE = 0.1


def refined(
    pose: RelativePose,
    problem: PairProblem,
) -> RelativePose:
    """The pose from all frames, or the pose of two views with `frames_reason`."""
    if not pose or len(problem.motions) == 2:
        return pose
    config = problem.config
    if config.refinement != 'map' or pose.diagnostics.model in ('linear', 'global'):
        return pose.diagnosed(frames_reason='solver or refinement are for two views')
    if not problem.knows_rotation:
        return pose.diagnosed(frames_reason='there is no rotation by the gyro')
    path = _with_inliers(pose, problem)
    if len(path.motions) == 2:
        return pose.diagnosed(
            frames_reason='no frame between has a rotation by the gyro and '
            f'{_LEAST_TRACKS} inliers of the pair',
        )
    observed = _observed(path)
    tracks = _track_blocks(path, observed)
    priors = _priors(path)
    adjusted = _adjusted(_start(pose, path, tracks, priors), pose, path, tracks, priors)
    distances = adjusted.state.tracks[:, INVERSE_DISTANCE][tracks.used[0]]  # a copy
    if not (np.isfinite(adjusted.covariance).all() and median(distances) > 0.0):
        return pose.diagnosed(frames_reason='the adjustment of all frames does not converge')
    if adjusted.sigma > max(_LARGEST_NOISE * config.threshold, config.pixel_sigma):
        return pose.diagnosed(
            frames_reason='tracks and gyro of the frames between contradict each '
            f'other: {adjusted.sigma:.1f} px',
        )
    pose = _result(pose, adjusted, path, tracks, priors)
    return _with_changes(pose, adjusted, path, tracks, observed)


def _adjusted(
    start: PathState,
    pose: RelativePose,
    path: PairProblem,
    tracks: TrackBlocks,
    priors: PathPriors,
) -> Adjusted:
    """The adjusted path, with the noise of two views as the expected one."""
    sigma = path.config.pixel_sigma
    expected = min(max(pose.diagnostics.residual_rms, _LEAST_NOISE * sigma), sigma)
    return adjustment.adjust(
        tracks,
        priors,
        start,
        expected,
        _SIGMA_FREEDOM,
        adjustment.CONVERGED,
    )


def _with_changes(
    pose: RelativePose,
    adjusted: Adjusted,
    path: PairProblem,
    tracks: TrackBlocks,
    observed: _Observed,
) -> RelativePose:
    """The pose with its derivative by the deviations, and with the doubt of each frame's rows."""
    knows_gyro = path.gyro is not None and path.R_cam_imu is not None
    doubts_frames = path.rate_doubt > 0.0 or path.config.stamp_sigma > _JITTER
    if not knows_gyro and not doubts_frames:
        return pose
    changes = _changes(path, observed, doubts_frames)
    moved = adjustment.path_by_deviations(tracks, adjusted.normal, changes)
    pose_moved = _pose_by_path(adjusted, tracks) @ moved
    by_frame = pose_moved[:, N_DEVIATIONS:]
    pose_moved[3:, :N_DEVIATIONS] += changes.rotations[-1]
    if doubts_frames:
        of_rate = path.rate_doubt**2
        of_stamp = path.config.stamp_sigma**2
        variances = np.tile([of_rate, of_rate, of_rate, of_stamp], len(path.motions))
        of_frames = by_frame * variances @ by_frame.T
        pose = replace(pose, covariance=pose.covariance + of_frames)
    if knows_gyro:
        by_deviation = pose_moved[:, :N_DEVIATIONS] @ LIVE.of_camera(path.camera)
        pose = replace(pose, by_deviation=by_deviation)
    return pose


def _with_inliers(
    pose: RelativePose,
    problem: PairProblem,
) -> PairProblem:
    """The problem of the inliers alone, in the frames that have enough of them."""
    inliers = np.flatnonzero(pose.inliers)  # new corners are spread in this order
    if len(inliers) > _MOST_TRACKS:
        inliers = inliers[np.linspace(0, len(inliers) - 1, _MOST_TRACKS).astype(int)]
    matches = problem.matches
    points = matches.points.take(inliers, axis=1)
    tracked = np.isfinite(points[:, :, 0]).sum(axis=1)
    turned = np.isfinite(problem.rotations).all(axis=(1, 2))
    used = turned & (tracked >= _LEAST_TRACKS)
    used[[0, -1]] = True
    views = np.flatnonzero(used)
    return replace(
        problem,
        matches=replace(
            matches,
            track_ids=matches.track_ids[inliers],
            points=points[views],
            quality=matches.quality[inliers],
        ),
        motions=tuple(problem.motions[view] for view in views),
        seconds=problem.seconds[views],
        rotations=problem.rotations[views],
        covariances=problem.covariances[views],
        inertial=tuple(problem.inertial[view] for view in views),
    )


# -- Acceleration of the IMU between the frames ---------------------------------------------------


def _knows_inertial(path: PairProblem) -> bool:
    """Whether all frames have the acceleration since the first one."""
    return all(motion is not None for motion in path.inertial[1:])


def _moved_by_imu(path: PairProblem) -> tuple[Array, Array, Array]:
    """Acceleration up to each frame: integrated twice [m], once [m/s], and during the readout.

    Arrays (V, 3); zero if it is not known for all frames.
    """
    alphas, betas, accelerations = np.zeros((3, len(path.motions), 3))
    if _knows_inertial(path):
        for view, motion in enumerate(path.inertial):
            if motion is not None:
                alphas[view] = motion.alpha
                betas[view] = motion.beta
                accelerations[view] = motion.acceleration2
                accelerations[0] = motion.acceleration1
    return alphas, betas, accelerations


def _camera_by_imu(path: PairProblem) -> tuple[Array, Array, Array]:
    """Lever arm of the IMU, and the path of the camera by the acceleration alone.

    The path starts at rest with the IMU: displacement (3,) up to the last frame [m], and the
    camera's velocities (2, 3) at the two ends [m/s]. Zero if it is not known for all frames.
    """
    whole = path.inertial[-1]
    if whole is None or not _knows_inertial(path):
        return np.zeros(3), np.zeros(3), np.zeros((2, 3))
    arm = np.asarray(whole.lever_arm)
    R = path.rotations[-1]
    start = path.motions[0].angular_velocity
    end = path.motions[-1].angular_velocity
    chord = whole.alpha - (R @ arm - arm)
    ends = np.array([-skew(start) @ arm, whole.beta - R @ (skew(end) @ arm)])
    return arm, chord, ends


# -- The adjustment's data, priors and start ------------------------------------------------------


class _Observed(NamedTuple):
    """The inliers of a pair in its V frames, as observed; arbitrary where they are not used."""

    used: NDArray[np.bool_]  # (V, N) in the image, of tracks that start in it
    rows: Array  # (V, N)
    times: Array  # (V, N) of the rows after the reference row of the frame [s]
    rays: Array  # (V, N, 3) unit rays in the camera's axes at their rows
    by_pixel: Array  # (V, N, 3, 2) derivatives of the rays by their pixels
    by_lens: Array  # (V, N, 3, L) derivatives of the rays by the entries of the lens


def _observed(path: PairProblem) -> _Observed:
    """Rays and row times of the observations; the gyro covers the rows of the image only."""
    camera = path.camera
    points = path.matches.points
    views, count = points.shape[:2]
    rows = camera.rows_of(points)
    known = np.isfinite(points).all(axis=2)
    inside = known & (rows >= 0.0) & (rows <= camera.row_count - 1.0)
    middle = 0.5 * (camera.width - 1.0), 0.5 * (camera.height - 1.0)
    pixels = np.where(inside[..., None], points, middle)
    rays, by_pixel, by_lens = camera.unproject_by_lens(pixels.reshape(-1, 2))
    rays = rays.reshape(views, count, 3)
    used = inside & np.isfinite(rays).all(axis=2)
    rows = np.where(used, rows, camera.reference_row_index)
    return _Observed(
        used & used[0],
        rows,
        camera.row_times(rows),
        rays,
        by_pixel.reshape(views, count, 3, -1),
        by_lens.reshape(views, count, 3, -1),
    )


def _track_blocks(path: PairProblem, observed: _Observed) -> TrackBlocks:
    """Observations of the inliers in blocks."""
    camera = path.camera
    count = observed.used.shape[1]
    tracks = empty_blocks(path.rotations, float(path.seconds[-1]), count)
    alphas, betas, accelerations = _moved_by_imu(path)
    arm, chord, _ = _camera_by_imu(path)
    for view, motion in enumerate(path.motions):
        times = observed.times[view]
        frame = FrameRays(
            observed.used[view],
            observed.rays[view],
            observed.by_pixel[view],
            times,
            motion.rotations(times),
            camera.line_delay * motion.angular_velocity,
            camera.readout_axis,
            motion.angular_velocity,
        )
        inertia = FrameInertia(
            float(path.seconds[view]),
            alphas[view],
            betas[view],
            accelerations[view],
            arm,
            chord,
        )
        fill_view(
            tracks,
            view,
            frame,
            inertia,
        )
    return tracks


def _priors(path: PairProblem) -> PathPriors:
    """Priors of the path, of the gyro's bias and of its rotations."""
    config = path.config
    interval = float(path.seconds[-1])
    bias_variance, covariance = _gyro_errors(path)
    lowest, highest = span_of_scales(config.motion, interval)
    if _knows_inertial(path):
        accelerations = np.array([_GRAVITY_SIGMA**2])
    else:
        accelerations = _of_carrier(MOTIONS[config.motion].acceleration, interval)
    return PathPriors(
        -0.5 * (lowest + highest),
        12.0 / (highest - lowest) ** 2,
        1.0 / bias_variance,
        1.0 / accelerations,
        np.asarray(np.linalg.inv(covariance), dtype=np.float64),
    )


def _gyro_errors(path: PairProblem) -> tuple[float, Array]:
    """Variance of the gyro's bias [rad^2/s^2], covariance (3 V - 3, 3 V - 3) of its rotations.

    The covariance of each rotation is that of integrated white noise and of a constant bias,
    ``n t + b t^2``: n and b follow from the first and the last one.
    """
    times = path.seconds[1:]
    variances = np.trace(path.covariances[1:], axis1=1, axis2=2) / 3.0
    first = variances[0] / times[0]
    last = variances[-1] / times[-1]
    of_bias = max((last - first) / (times[-1] - times[0]), 1e-10)
    walk = max(first - of_bias * times[0], 0.0) + _LEAST_WALK**2
    covariance = by_axes(walk * np.minimum.outer(times, times))
    # Errors of the stamps rotate each frame; that of the first frame is in all rotations.
    stamp_variance = path.config.stamp_sigma**2
    rates = np.array(
        [
            R @ motion.angular_velocity
            for R, motion in zip(path.rotations, path.motions, strict=True)
        ]
    )
    covariance += np.tile(stamp_variance * np.outer(rates[0], rates[0]), (len(times), len(times)))
    for k, rate in enumerate(rates[1:]):
        block = slice(3 * k, 3 * k + 3)
        covariance[block, block] += stamp_variance * np.outer(rate, rate)
    return float(of_bias), covariance


def _of_carrier(
    sigma: float,
    interval: float,
) -> Array:
    """Variances (K,) of the Legendre coefficients of an exponentially correlated acceleration."""
    x, weights = np.polynomial.legendre.leggauss(16)
    count = MOST_ACCELERATIONS
    polynomials = np.polynomial.legendre.legvander(x, count - 1).T
    norms = np.arange(count)[:, None] + 0.5
    to_coefficients = norms * weights * polynomials
    apart = np.abs(x[:, None] - x)
    correlation = np.exp(-0.5 * interval * apart / CORRELATION_TIME)
    return np.asarray(sigma**2 * np.diag(to_coefficients @ correlation @ to_coefficients.T))


def _start(
    pose: RelativePose, path: PairProblem, tracks: TrackBlocks, priors: PathPriors
) -> PathState:
    """The state of the two-view estimate."""
    T = tracks.duration
    off = log_so3(np.ascontiguousarray(pose.R @ tracks.rotations[-1].T))
    # Half of the rotation's error to the bias, half to the noise.
    rotations = np.outer(path.seconds / T, 0.5 * off)
    log_scale = -math.log(pose.baseline) if math.isfinite(pose.baseline) else priors.log_scale
    return PathState(
        pose.t.copy(),
        log_scale,
        0.5 * off / T,
        np.zeros((len(priors.acceleration_weights), 3)),
        rotations,
        start_of_tracks(tracks, np.ascontiguousarray(pose.R), pose.t),
    )


# -- The pose of all frames -----------------------------------------------------------------------

# Derivatives of B_j at both ends of the interval, by its length.
_BENDS = np.array([[-0.5, 1.0 / 6.0, 0.0], [0.5, 1.0 / 6.0, 0.0]])


def _result(
    pose: RelativePose,
    adjusted: Adjusted,
    path: PairProblem,
    tracks: TrackBlocks,
    priors: PathPriors,
) -> RelativePose:
    """The two-view result with the pose, its covariance and the velocities of all frames."""
    state = adjusted.state
    C = adjusted.covariance
    T = tracks.duration
    off = T * state.bias + state.rotations[-1]  # from the gyro's rotation
    R = exp_so3(off) @ tracks.rotations[-1]
    by_state = _pose_by_path(adjusted, tracks)
    velocities, (by_first, by_second) = _velocities(state, path, len(C))
    # R^T p' rotates with the error of R.
    by_second = R.T @ (by_second + skew(velocities[1]) @ by_state[3:])
    velocity_covariance = pose.velocity_covariance.copy()
    velocity_covariance[:3] = velocity_covariance[:, :3] = 0.0
    velocity_covariance[:3, :3] = by_second @ C @ by_second.T
    of_bias = T * T / priors.bias_weight * np.eye(3)
    of_gyro = of_bias + np.linalg.inv(priors.rotation_information)[-3:, -3:]
    baseline = pose.baseline
    log_sigma = pose.baseline_log_sigma
    if _knows_inertial(path) and math.isfinite(pose.baseline):
        baseline = 1.0 / math.exp(state.log_scale)
        log_sigma = math.sqrt(C[LOG_SCALE, LOG_SCALE])
    pose = replace(
        pose,
        R=R,
        t=state.t,
        covariance=by_state @ C @ by_state.T,
        linear_velocity1=velocities[0],
        linear_velocity1_covariance=by_first @ C @ by_first.T,
        linear_velocity2=R.T @ velocities[1],
        velocity_covariance=velocity_covariance,
        baseline=baseline,
        baseline_log_sigma=log_sigma,
    )
    return pose.diagnosed(
        frames=len(path.motions),
        gyro_square=float(off @ np.linalg.solve(of_gyro, off)),
        pixel_sigma=adjusted.sigma,
    )


def _pose_by_path(adjusted: Adjusted, tracks: TrackBlocks) -> Array:
    """Derivative (6, n) of the pose by the unknowns of the path."""
    by_path = np.zeros((6, len(adjusted.covariance)))
    by_path[:3, TANGENT:LOG_SCALE] = tangent_basis(adjusted.state.t)
    by_path[3:, BIAS : BIAS + 3] = tracks.duration * np.eye(3)
    by_path[3:, -3:] = np.eye(3)
    return by_path


def _velocities(
    state: PathState,
    path: PairProblem,
    n: int,
) -> tuple[Array, Array]:
    """P' at both ends (2, 3), in the axes of camera 1, and its derivatives (2, 3, n)."""
    T = float(path.seconds[-1])
    k = math.exp(state.log_scale)
    _, chord, ends = _camera_by_imu(path)
    bends = T * _BENDS[:, : len(state.accelerations)]
    of_scale = k * (ends - chord / T + bends @ state.accelerations)
    derivatives = np.zeros((2, 3, n))
    derivatives[..., TANGENT:LOG_SCALE] = tangent_basis(state.t) / T
    derivatives[..., LOG_SCALE] = of_scale
    of_accelerations = derivatives[..., ACCELERATION:]
    of_accelerations[..., : bends.shape[1] * 3] = k * by_axes(bends).reshape(2, 3, -1)
    return state.t / T + of_scale, derivatives


# -- What deviations of the configuration change in the observations ------------------------------
#
# The reference of the rows of a frame is its stamped row: shares of the readout are counted from
# it, and the time offset of a selection is the one of the stamped row, as the parameter.


def _changes(path: PairProblem, observed: _Observed, doubts_frames: bool) -> Changes:
    """What deviations change, and with `doubts_frames` the errors that each frame has for itself.

    Without the gyro of the pair the changes of the rotations between frames are zero.
    """
    camera = path.camera
    parts = [_path_of_rows(motion) for motion in path.motions]
    rows = RowsOfFrames(
        GyroPath(*(np.concatenate(values) for values in zip(*parts, strict=True))),
        np.cumsum([0, *(len(part.times) for part in parts)]),
        observed.times,
        (observed.rows - camera.reference_row_index) / camera.row_count,
    )
    rate_changes = [_change_of_rate(part) for part in parts] if doubts_frames else []
    R_cam_imu = np.eye(3) if path.R_cam_imu is None else path.R_cam_imu
    if path.gyro is None:
        rotations = np.zeros((len(parts), 3, N_DEVIATIONS))
    else:
        at_stamps = np.zeros(len(path.seconds))
        rotations = row_states(path.gyro, R_cam_imu, path.seconds, at_stamps).by_deviation
    return Changes(
        rows,
        turned_frames(rows, R_cam_imu),
        rotations,
        observed.by_lens,
        np.array(rate_changes).reshape(-1, 3),
    )


def _change_of_rate(rows: GyroPath) -> Array:
    """Change (3,) of the rate by time within a frame [rad/s^2]."""
    lasted = max(float(rows.times[-1] - rows.times[0]), _LEAST_SPAN)
    return np.asarray((rows.rates[-1] - rows.rates[0]) / lasted)


def _path_of_rows(motion: FrameMotion) -> GyroPath:
    """The rotation within a frame, also where it is known by its rate alone."""
    if motion.path is not None:
        return motion.path
    return GyroPath.constant(motion.angular_velocity, -1.0, 1.0)
