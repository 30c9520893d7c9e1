"""Where a path starts: the end of the path before it, and the state of the body at a start."""

from __future__ import annotations

from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.config.settings import ImuConfig
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import exp_so3, heading, skew, STANDARD_GRAVITY
from rs_relpose_ros.imu.buffer import ImuInterval
from rs_relpose_ros.messages.published_pair import PublishedPair
from rs_relpose_ros.odometry.graph import (
    BIAS,
    DOUBTS,
    KeyframeState,
    POSE,
    ROTATION,
    TRANSLATION,
    VELOCITY,
)
from rs_relpose_ros.odometry.states import Base

# 1 sigma of the direction of gravity for a moving body [rad]: 1 m/s^2 of mean acceleration. A
# smaller one takes accelerations for tilt, a larger one delays starts.
# [derived: hand-held accelerations are 0.3 to 3 m/s^2 rms, averaged over a second]
_MOVING_TILT = 0.1
# Least 1 sigma of the accelerometer's bias [m/s^2]: factory calibration leaves 0.2 to 0.4. A
# smaller one makes wrong starts, a larger one late ones.
# [measured: docs/lab/odometry.md, "Starts", bias]
_ACCEL_BIAS = 0.3
# 1 sigma of the velocity at a start at rest [m/s], per axis. A larger one would delay the scale, a
# smaller one hold a body that creeps. [chosen: 5 to 20 mm/s: images are at rest within half a
# pixel]
_REST_VELOCITY = 0.01
# 1 sigma of the velocity at a start in motion [m/s], per axis: no information. A smaller one would
# pull fast starts to slow ones. [chosen: 2 to 10]
_ANY_VELOCITY = 3.0
# 1 sigma of heading and position at a start [rad, m]: they are the origin of the world. A larger
# one would be published, a smaller one makes the linear algebra singular.
# [chosen: 1e-5 to 1e-3: small against all errors]
_GAUGE_SIGMA = 1e-4
# Largest 1 sigma of the logarithm of a baseline that starts a graph; a less certain one is a worse
# first guess than `_GUESSED_SPEED`. [chosen: 0.4 to 1: a factor of two]
_START_LOG_SIGMA = 0.7
# Initial speed without a baseline [m/s]: pairs of a global shutter have none. Far from the true
# speed the first steps of the optimisation converge slowly. [derived: a walk]
_GUESSED_SPEED = 1.0
# Longest propagation of a lost path by the IMU [s]: later its error is larger than a room, and a
# start from the accelerometer alone is as good. [chosen: 5 to 20 s would do]
LONGEST_PROPAGATED = 10.0
# 1 sigma of the acceleration of a body whose IMU had a gap [m/s^2]. A smaller one would exclude
# motions of a hand. [derived: the most that hands do, `_MOVING_TILT`]
_UNKNOWN_ACCELERATION = 3.0
# The same of its rate [rad/s]. [derived: the most that hands do]
_UNKNOWN_RATE = 1.0
# Time for which a body has moved until the next start, if the clock was set back [s].
# [chosen: nobody knows it: a second, as of a driver that restarts]
_UNKNOWN_TIME = 1.0
# Cosine of the angle from upside down within which the smallest rotation upwards is not unique.
# [chosen: -0.9999 to -0.99 would do]
_UPSIDE_DOWN = -0.999

# Number of values of a path end: position (3) and heading.
_PLACE = 4


class PathEnd(NamedTuple):
    """End of a path, from which the next one continues.

    `covariance` is that of position and heading; it is common to all states of the next path.
    """

    R: Array | None  # of the body; None: any heading
    position: Array  # (3,) [m]
    covariance: Array  # (4, 4)

    @classmethod
    def origin(cls) -> PathEnd:
        """The origin of the world, which the first path starts from."""
        return cls(None, np.zeros(3), np.zeros((_PLACE, _PLACE)))

    def of_pose(self, position: Array) -> Array:
        """Covariance (6, 6) of position and rotation at a position (3,), by the path end."""
        x, y, _ = (position - self.position).tolist()
        by = np.zeros((6, _PLACE))
        by[0, 0] = by[1, 1] = by[2, 2] = 1.0
        by[0, 3] = -y  # z axis x way
        by[1, 3] = x
        by[5, 3] = 1.0
        return np.asarray(by @ self.covariance @ by.T)


def end_of(state: KeyframeState, earlier: PathEnd) -> PathEnd:
    """The end of a path at a state; `earlier`: from which that path continued."""
    own = _place_covariance(state)
    places = [0, 1, 2, 5]
    inherited = earlier.of_pose(state.position)[np.ix_(places, places)]
    return PathEnd(state.R, state.position, own + inherited)


def end_without_samples(end: PathEnd, state: KeyframeState, seconds: float) -> PathEnd:
    """The end of a path after a gap of the IMU of some seconds; negative: a clock was set back.

    The body has moved on at its velocity, within the accelerations and rates of a hand.
    """
    position = end.position
    unknown_way = 0.0
    if seconds > 0.0:
        position = position + seconds * state.velocity
    else:
        seconds = _UNKNOWN_TIME
        speed = float(np.linalg.norm(state.velocity))
        unknown_way = seconds * speed
    moved = 0.5 * _UNKNOWN_ACCELERATION * seconds**2 + unknown_way
    turned = _UNKNOWN_RATE * seconds
    of_velocity = state.covariance[VELOCITY, VELOCITY]
    covariance = end.covariance.copy()
    covariance[:3, :3] += moved**2 * np.eye(3)
    covariance[:3, :3] += seconds**2 * of_velocity
    # A heading that is wrong by more than half a turn is any heading.
    of_heading = covariance[3, 3] + turned**2
    covariance[3, 3] = min(of_heading, math.pi**2)
    return PathEnd(end.R, position, covariance)


def _place_covariance(state: KeyframeState) -> Array:
    """Covariance (4, 4) of position and heading in the axes of the world."""
    by = np.zeros((_PLACE, 6))
    by[:3, TRANSLATION] = state.R
    by[3, ROTATION] = state.R[2]
    return np.asarray(by @ state.covariance[POSE, POSE] @ by.T)


def place_variances(state: KeyframeState) -> tuple[float, float]:
    """Variances of the position (of its length) and of the heading."""
    covariance = _place_covariance(state)
    return float(np.trace(covariance[:3, :3])), float(covariance[3, 3])


class Surroundings(NamedTuple):
    """What is known about the body at a start from the samples and the path before."""

    interval: ImuInterval  # samples of the pair
    before: ImuInterval | None  # samples of the time before the pair
    path_end: PathEnd
    at_rest: bool


def start_state(
    pair: PublishedPair,
    known: Surroundings,
    R_cam_body: Array,
    unknown: tuple[Array, Array],
    base: Base,
    imu: ImuConfig,
) -> KeyframeState:
    """The body at the reference of the first pair of a path, with the covariance of a start.

    `unknown`: the vector of `doubts` and its covariance.
    """
    values, covariance_of_values = unknown
    bias = np.where(np.isfinite(pair.gyro_bias), pair.gyro_bias, imu.gyro_bias)
    # The base keeps its heading; without one the body does.
    axes = base.R @ R_cam_body if base.frame_id else np.eye(3)
    R = _levelled(_force_at_start(known, bias), known.path_end, axes)
    velocity = np.zeros(3)
    if not known.at_rest:
        velocity = _start_velocity(pair, known.interval.rates[0] - bias, R, R_cam_body, values)
    accel_bias_sigma = max(imu.accel_bias_sigma, _ACCEL_BIAS)
    tilt = accel_bias_sigma / STANDARD_GRAVITY if known.at_rest else _MOVING_TILT
    speed_sigma = _REST_VELOCITY if known.at_rest else _ANY_VELOCITY
    size = BIAS.stop + len(values)
    covariance = np.zeros((size, size))
    of_turn = np.diag(np.square([tilt, tilt, _GAUGE_SIGMA]))
    covariance[ROTATION, ROTATION] = R.T @ of_turn @ R
    covariance[TRANSLATION, TRANSLATION] = _GAUGE_SIGMA**2 * np.eye(3)
    covariance[VELOCITY, VELOCITY] = speed_sigma**2 * np.eye(3)
    gyro_bias_sigma = max(imu.gyro_bias_sigma, LEAST_GYRO_BIAS_SIGMA)
    bias_sigmas = np.repeat([accel_bias_sigma, gyro_bias_sigma], 3)
    covariance[BIAS, BIAS] = np.diag(np.square(bias_sigmas))
    covariance[DOUBTS, DOUBTS] = covariance_of_values
    return KeyframeState(
        R=R,
        position=known.path_end.position,
        velocity=velocity,
        gyro_bias=bias,
        accel_bias=np.zeros(3),
        doubts=values,
        covariance=covariance,
    )


# Least 1 sigma of the bias of the gyro at a start [rad/s]. With 0 its information is not finite; a
# larger one would exceed what an hour at rest leaves. [chosen: 1e-6 to 3e-5 would do]
LEAST_GYRO_BIAS_SIGMA = 1e-5


def _force_at_start(known: Surroundings, bias: Array) -> Array:
    """Mean specific force (3,) in the axes of the body at the reference of the pair."""
    interval, before = known.interval, known.before
    if known.at_rest or before is None or before.duration < interval.duration:
        # Rotated back by the gyro over the interval.
        back = ImuInterval(interval.seconds, -interval.rates[::-1], interval.forces[::-1])
        return back.mean_force(-bias)
    return before.mean_force(bias)


def _start_velocity(
    pair: PublishedPair,
    rate: Array,
    R: Array,
    R_cam_body: Array,
    values: Array,
) -> Array:
    """Velocity (3,) of the body in the world; `rate`: of its gyro without bias."""
    images = pair.images
    assert images is not None
    moving = _GUESSED_SPEED * images.t
    if pair.baseline_log_sigma < _START_LOG_SIGMA:
        moving = pair.baseline * images.velocities[:3]
    swing = np.cross(rate, values[:3])
    return np.asarray(R @ (R_cam_body.T @ moving - swing))


def _levelled(
    force: Array,
    path_end: PathEnd,
    axes: Array,
) -> Array:
    """Rotation (3, 3) from the body to the world, by the specific force at rest.

    `axes` (3, 3): from the body to the axes that keep their heading.
    """
    up = axes @ force / np.linalg.norm(force)
    # The smallest rotation that takes it upwards, then one about z to the last heading.
    if up[2] > _UPSIDE_DOWN:
        turn = skew(np.cross(up, [0.0, 0.0, 1.0]))
        R = np.eye(3) + turn + turn @ turn / (1.0 + up[2])
    else:
        R = np.diag([1.0, -1.0, -1.0])
    R = R @ axes
    if path_end.R is not None:
        R = exp_so3(heading(path_end.R @ R.T)) @ R
    return np.asarray(R)


def continued(state: KeyframeState) -> KeyframeState:
    """A propagated state as the start of a graph: nothing is certain to the last digit."""
    size = len(state.covariance)
    more = np.zeros(size)
    more[: ROTATION.stop] = _GAUGE_SIGMA**2
    more[TRANSLATION] = _GAUGE_SIGMA**2
    return replace(state, covariance=state.covariance + np.diag(more))
