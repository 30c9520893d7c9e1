"""The frames between the two of a pair: their tracks and IMU data, and the pose from all of them.

Starts at the two-view estimate, whose inliers it uses; `adjustment` has the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rs_relpose_ros.config.settings import EstimatorConfig, MOTIONS
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator import adjustment
from rs_relpose_ros.estimator.adjustment import BIAS, PathPriors, PathState, TANGENT, Tracks
from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.estimator.velocity import CORRELATION_TIME, span_of_scales
from rs_relpose_ros.geometry import Array, validate
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.motion import FrameMotion, InertialMotion
from rs_relpose_ros.geometry.so3 import by_axes, exp_so3, log_so3, median, skew, tangent_basis

# Error of gravity and accelerometer together, 1 sigma per axis [m/s^2]: a camera in motion does
# not measure its tilt better.
_GRAVITY_SIGMA = 1.0
# Least noise of the gyro's rotation [rad/sqrt(s)].
_LEAST_WALK = 5e-4
# Degrees of freedom as which the configured noise of a match counts.
_SIGMA_FREEDOM = 10.0
# Least number of inliers that a frame between must have, and most of a pair: 200 of 280 cost 8 %
# of t and R on simulated walks, nothing on recordings, where tracks share larger errors.
_LEAST_TRACKS, _MOST_TRACKS = 10, 200
# Noise of the observations, as a part of `threshold`, beyond which tracks and gyro contradict each
# other: 4 sigmas are then twice that, the largest limit of an inlier. All tracks have the errors
# of the frames, so that the covariance would be too small.
_LARGEST_NOISE = 0.5
# Pixels beyond this are no pixels. Of a predicted rotation [rad^2]: far above that of an unknown
# rotation, which is 10.
LARGEST_PIXEL, _LARGEST_COVARIANCE = 1e6, 1e12


def checked_rotation(
    rotation: ArrayLike | None, covariance: ArrayLike | None, of: str = ''
) -> tuple[Array | None, Array | None]:
    """A predicted rotation with its covariance, or None twice."""
    if rotation is None and covariance is None:
        return None, None
    if rotation is None or covariance is None:
        raise InputError(
            f'relative_rotation and relative_rotation_covariance{of} go together: '
            'give both or neither'
        )
    return (
        validate.rotations(f'relative_rotation{of}', rotation),
        validate.covariance(
            f'relative_rotation_covariance{of}',
            covariance,
            3,
            largest=_LARGEST_COVARIANCE,
            unit='rad^2',
            rounding=1e-12,
        ),
    )


@dataclass(frozen=True, slots=True, eq=False)
class IntermediateFrame:
    """A frame between the two of a pair.

    Parameters
    ----------
    points : (N, 2) array_like
        Raw pixels, a row for each match of the pair; NaN where it was not tracked.
    motion : FrameMotion
        Angular velocity at its reference row.
    interval : float
        Seconds from the first frame's reference row to its own.
    relative_rotation, relative_rotation_covariance : (3, 3) array_like, optional
        ``R_1^T R`` of its reference row by the gyro, as for the second frame.
    inertial : InertialMotion, optional
        From the first frame to this one, with the gravity that the second frame's has.

    Raises
    ------
    InputError
        A value of the wrong shape, or not finite.
    """

    points: Array
    motion: FrameMotion
    interval: float
    relative_rotation: Array | None = None
    relative_rotation_covariance: Array | None = None
    inertial: InertialMotion | None = None

    def __post_init__(self) -> None:
        points = np.asarray(self.points, dtype=np.float64)
        validate.array(
            'points of a frame between',
            np.nan_to_num(points, nan=0.0, posinf=np.inf),
            ('N', 2),
            largest=LARGEST_PIXEL,
            unit='px',
        )
        object.__setattr__(self, 'points', np.ascontiguousarray(points))
        validate.number('interval of a frame between', self.interval, 1e-6, 1e6, 's')
        R, of_R = checked_rotation(
            self.relative_rotation, self.relative_rotation_covariance, ' of a frame between'
        )
        object.__setattr__(self, 'relative_rotation', R)
        object.__setattr__(self, 'relative_rotation_covariance', of_R)
        if self.inertial is not None and not math.isclose(
            self.inertial.duration, self.interval, abs_tol=1e-6
        ):
            raise InputError(
                'the interval of a frame between must equal the duration of its '
                f'inertial, got {self.interval:.9g} and '
                f'{self.inertial.duration:.9g} s'
            )


def check(
    between: Sequence[IntermediateFrame], points1: Array, interval: float | None
) -> float | None:
    """`interval` [s]; InputError unless the frames fit it and the matches `points1` (N, 2)."""
    if not between:
        return interval
    if interval is None:
        raise InputError('between requires interval (or inertial) of the second frame')
    before = 0.0
    for frame in between:
        if len(frame.points) != len(points1):
            raise InputError(
                'points of a frame between must have a row for each match, '
                f'{points1.shape}, got {frame.points.shape}'
            )
        if not before < frame.interval < interval:
            raise InputError(
                'intervals of the frames between must increase and be less than '
                f'interval = {interval:.9g} s, got {frame.interval:.9g} after '
                f'{before:.9g} s'
            )
        before = frame.interval
    return interval


class _View(NamedTuple):
    """A frame of the pair, first and last ones included; rotation by the gyro."""

    points: Array  # (N, 2) px, of the inliers
    motion: FrameMotion
    interval: float
    rotation: Array
    covariance: Array
    inertial: InertialMotion | None


def refined(
    pose: RelativePose,
    points1: Array,
    motion1: FrameMotion,
    second: tuple[Any, ...],
    between: Sequence[IntermediateFrame],
    camera: RollingShutterCamera,
    config: EstimatorConfig,
) -> RelativePose:
    """The pose from all frames, or that of two views with `frames_reason`.

    `points1` (N, 2), `motion1`: of the first frame; `second`: the second one of the pair, as
    arguments of `IntermediateFrame`.
    """
    if not (pose and between):
        return pose
    if config.refinement != 'map' or pose.model in ('linear', 'global'):
        return replace(pose, frames_reason='solver or refinement are for two views')
    inliers = np.flatnonzero(pose.inliers)  # new corners are spread in this order
    if len(inliers) > _MOST_TRACKS:
        inliers = inliers[np.linspace(0, len(inliers) - 1, _MOST_TRACKS).astype(int)]
    if second[3] is None:
        return replace(pose, frames_reason='there is no rotation by the gyro')
    last = _View(second[0][inliers], *second[1:])
    views = [_View(points1[inliers], motion1, 0.0, np.eye(3), np.zeros((3, 3)), None)]
    for frame in between:
        points, R, of_R = (
            frame.points[inliers],
            frame.relative_rotation,
            frame.relative_rotation_covariance,
        )
        if not (R is None or of_R is None) and (np.isfinite(points[:, 0]).sum() >= _LEAST_TRACKS):
            views.append(_View(points, frame.motion, frame.interval, R, of_R, frame.inertial))
    if len(views) == 1:
        return replace(
            pose,
            frames_reason='no frame between has a rotation by the gyro and '
            f'{_LEAST_TRACKS} inliers of the pair',
        )
    views.append(last)
    path = _Path.of(views)
    tracks = _tracks(views, path, camera)
    priors = _priors(views, path, config)
    state = _start(pose, views, tracks, priors)
    expected = min(max(pose.residual_rms, 0.1 * config.pixel_sigma), config.pixel_sigma)
    for _ in range(2):  # once more without the observations far from the first result
        adjusted = adjustment.adjust(tracks, priors, state, expected, _SIGMA_FREEDOM)
        state = adjusted.state
        tracks.used[adjusted.far] = False
        tracks.observations.swapaxes(2, 3)[
            adjusted.far, adjustment.TO_PIXELS : adjustment.TIME
        ] = 0.0
    distances = state.tracks[:, adjustment.INVERSE_DISTANCE][tracks.used[0]]  # a copy
    if not (np.isfinite(adjusted.covariance).all() and median(distances) > 0.0):
        return replace(pose, frames_reason='the adjustment of all frames does not converge')
    if adjusted.sigma > max(_LARGEST_NOISE * config.threshold, config.pixel_sigma):
        return replace(
            pose,
            frames_reason='tracks and gyro of the frames between contradict each '
            f'other: {adjusted.sigma:.1f} px',
        )
    return _result(pose, adjusted, tracks, priors, path, len(views))


class _Path(NamedTuple):
    """Acceleration of the IMU between the views, where all of them have it."""

    known: bool
    lever_arm: Array  # (3,) [m]
    alphas: Array  # (V, 3) integrated twice up to the reference row of each view [m]
    betas: Array  # (V, 3) once [m/s]
    accelerations: Array  # (V, 3) during the readout [m/s^2]
    chord: Array  # (3,) displacement of the camera by it, up to the last view [m]
    ends: tuple[Array, Array]  # (3,) velocities of the camera by it at the two ends [m/s]

    @classmethod
    def of(cls, views: Sequence[_View]) -> _Path:
        zero = np.zeros(3)
        motions = [view.inertial for view in views[1:]]
        given = [motion for motion in motions if motion is not None]
        if len(given) < len(motions):
            none = np.zeros((len(views), 3))
            return cls(False, zero, none, none, none, zero, (zero, zero))
        arm, R = np.asarray(given[-1].lever_arm), views[-1].rotation
        start, end = views[0].motion.angular_velocity, views[-1].motion.angular_velocity
        return cls(
            True,
            arm,
            np.array([zero, *(motion.alpha for motion in given)]),
            np.array([zero, *(motion.beta for motion in given)]),
            np.array([given[-1].acceleration1, *(motion.acceleration2 for motion in given)]),
            given[-1].alpha - (R @ arm - arm),
            (-skew(start) @ arm, given[-1].beta - R @ (skew(end) @ arm)),
        )


def _tracks(views: Sequence[_View], path: _Path, camera: RollingShutterCamera) -> Tracks:
    """Observations of the inliers."""
    points = np.array([view.points for view in views])
    shape = points.shape[:2]
    rays, jacobian = camera.unproject_with_jacobian(points.reshape(-1, 2))
    rays, jacobian = rays.reshape(*shape, 3), jacobian.reshape(*shape, 3, 2)
    # The gyro covers the rows of the image only.
    used = (
        np.isfinite(rays).all(axis=2)
        & (points[..., 1] >= 0.0)
        & (points[..., 1] <= camera.height - 1.0)
    )
    used &= used[0]
    rows = np.where(used, points[..., 1], camera.reference_row_index)
    blocks = shape[0], -(-shape[1] // adjustment.BLOCK)
    tracks = Tracks(
        np.zeros((*blocks, adjustment.VALUES, adjustment.BLOCK)),
        np.zeros((*blocks, adjustment.BLOCK), dtype=bool),
        np.array([view.rotation for view in views]),
        views[-1].interval,
        shape[1],
    )
    times = camera.row_times(rows)
    for v, view in enumerate(views):
        adjustment.fill_view(
            tracks,
            v,
            used[v],
            rays[v],
            jacobian[v],
            times[v],
            view.motion.rotations(times[v]),
            camera.line_delay * view.motion.angular_velocity,
            view.interval,
            path.alphas[v],
            path.betas[v],
            path.accelerations[v],
            path.lever_arm,
            path.chord,
        )
    return tracks


def _priors(views: Sequence[_View], path: _Path, config: EstimatorConfig) -> PathPriors:
    """Priors of the path, of the gyro's bias and of its rotations."""
    times = np.array([view.interval for view in views[1:]])
    # Of integrated white noise and a constant bias, as in the covariances n t + b t^2.
    variances = np.array([np.trace(view.covariance) / 3.0 for view in views[1:]])
    first, last = variances[0] / times[0], variances[-1] / times[-1]
    of_bias = max((last - first) / (times[-1] - times[0]), 1e-10)
    walk = max(first - of_bias * times[0], 0.0) + _LEAST_WALK**2
    # Errors of the stamps, of the first frame for all others.
    rates = np.array([view.rotation @ view.motion.angular_velocity for view in views])
    covariance = by_axes(walk * np.minimum.outer(times, times))
    covariance += np.tile(
        config.stamp_sigma**2 * np.outer(rates[0], rates[0]), (len(times), len(times))
    )
    for k, rate in enumerate(rates[1:]):
        block = slice(3 * k, 3 * k + 3)
        covariance[block, block] += config.stamp_sigma**2 * np.outer(rate, rate)
    lowest, highest = span_of_scales(config.motion, views[-1].interval)
    variances = (
        np.array([_GRAVITY_SIGMA**2])
        if path.known
        else _of_carrier(MOTIONS[config.motion].acceleration, views[-1].interval)
    )
    return PathPriors(
        -0.5 * (lowest + highest),
        12.0 / (highest - lowest) ** 2,
        1.0 / of_bias,
        1.0 / variances,
        np.asarray(np.linalg.inv(covariance), dtype=np.float64),
    )


def _of_carrier(sigma: float, interval: float) -> Array:
    """Variances (K,) of the Legendre coefficients of an exponentially correlated acceleration."""
    x, weights = np.polynomial.legendre.leggauss(16)
    order = np.arange(adjustment.MOST_ACCELERATIONS)
    to_coefficients = (
        (order[:, None] + 0.5)
        * weights
        * np.polynomial.legendre.legvander(x, adjustment.MOST_ACCELERATIONS - 1).T
    )
    correlation = np.exp(-0.5 * interval * np.abs(x[:, None] - x) / CORRELATION_TIME)
    return np.asarray(sigma**2 * np.diag(to_coefficients @ correlation @ to_coefficients.T))


def _start(
    pose: RelativePose, views: Sequence[_View], tracks: Tracks, priors: PathPriors
) -> PathState:
    """The state of the two-view estimate."""
    T = tracks.duration
    off = log_so3(np.ascontiguousarray(pose.R @ tracks.rotations[-1].T))
    # Half of the rotation's error to the bias, half to the noise.
    rotations = np.outer([view.interval / T for view in views], 0.5 * off)
    log_scale = -math.log(pose.baseline) if math.isfinite(pose.baseline) else priors.log_scale
    return PathState(
        pose.t.copy(),
        log_scale,
        0.5 * off / T,
        np.zeros((len(priors.acceleration_weights), 3)),
        rotations,
        adjustment.start_of_tracks(tracks, np.ascontiguousarray(pose.R), pose.t),
    )


def _result(
    pose: RelativePose,
    adjusted: adjustment.Adjusted,
    tracks: Tracks,
    priors: PathPriors,
    path: _Path,
    views: int,
) -> RelativePose:
    """The two-view result with the pose, its covariance and the velocities of all frames."""
    state, C, T = adjusted.state, adjusted.covariance, tracks.duration
    n, k = len(C), math.exp(state.log_scale)
    off = T * state.bias + state.rotations[-1]  # from the gyro's rotation
    R = exp_so3(off) @ tracks.rotations[-1]
    by_state = np.zeros((6, n))
    by_state[:3, TANGENT : adjustment.LOG_SCALE] = tangent_basis(state.t)
    by_state[3:, BIAS : BIAS + 3], by_state[3:, -3:] = T * np.eye(3), np.eye(3)
    # B_j' at both ends.
    bends = (
        T
        * np.array([[-0.5, 1.0 / 6.0, 0.0], [0.5, 1.0 / 6.0, 0.0]])[:, : len(state.accelerations)]
    )
    # p' at both ends (2, 3), in the axes of camera 1, and its derivatives.
    of_scale = k * (np.array(path.ends) - path.chord / T + bends @ state.accelerations)
    velocities, derivatives = state.t / T + of_scale, np.zeros((2, 3, n))
    derivatives[..., TANGENT : adjustment.LOG_SCALE] = (
        by_state[:3, TANGENT : adjustment.LOG_SCALE] / T
    )
    derivatives[..., adjustment.LOG_SCALE] = of_scale
    of_accelerations = derivatives[..., adjustment.ACCELERATION :]
    of_accelerations[..., : bends.shape[1] * 3] = k * by_axes(bends).reshape(2, 3, -1)
    by_first, by_second = derivatives
    # R^T p' rotates with the error of R.
    by_second = R.T @ (by_second + skew(velocities[1]) @ by_state[3:])
    velocity_covariance = pose.velocity_covariance.copy()
    velocity_covariance[:3] = velocity_covariance[:, :3] = 0.0
    velocity_covariance[:3, :3] = by_second @ C @ by_second.T
    of_gyro = (
        T * T / priors.bias_weight * np.eye(3)
        + np.linalg.inv(priors.rotation_information)[-3:, -3:]
    )
    known = path.known and math.isfinite(pose.baseline)
    return replace(
        pose,
        R=R,
        t=state.t,
        covariance=by_state @ C @ by_state.T,
        linear_velocity1=velocities[0],
        linear_velocity1_covariance=by_first @ C @ by_first.T,
        linear_velocity2=R.T @ velocities[1],
        velocity_covariance=velocity_covariance,
        baseline=1.0 / k if known else pose.baseline,
        baseline_log_sigma=(
            math.sqrt(C[adjustment.LOG_SCALE, adjustment.LOG_SCALE])
            if known
            else pose.baseline_log_sigma
        ),
        frames=views,
        gyro_square=float(off @ np.linalg.solve(of_gyro, off)),
        pixel_sigma=adjusted.sigma,
    )
