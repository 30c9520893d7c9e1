"""States of the odometry, as published: with their reasons, at increasing times, without steps.

Free of gtsam.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
import math
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import exp_so3, log_so3, skew
from rs_relpose_ros.geometry.timing import seconds_between

# A larger step back of the stamps is a clock that was set back; a smaller one is a state that was
# requested twice. [chosen: 0.2 to 10 s would do: queries are at most a sample apart]
_JUMP_NS = 1_000_000_000
# Time constant in which corrections are blended in [s]. A shorter one makes steps, which a
# controller follows; a longer one publishes states that are known to be off for longer.
# [chosen: 0.1 to 1 s would do; with 0.3 s the largest step is 0.15 sigma, docs/lab/odometry.md]
_BLENDING = 0.3


class OdometryState(str, Enum):
    """State of the odometry, as published."""

    STARTING = 'starting'
    TRACKING = 'tracking'
    UNCERTAIN = 'uncertain'  # on the IMU alone
    LOST = 'lost'  # until the next start


class Notice(NamedTuple):
    """A line for the log."""

    text: str
    state: OdometryState | None = None  # that was entered; None for any other reason


class StateInterval(NamedTuple):
    """A state with its reason; times on the camera's clock, None for a state that is not over."""

    state: OdometryState
    reason: str
    begin_ns: int
    end_ns: int | None


class Base(NamedTuple):
    """The frame that is published, with the camera on it: ``X_base = R X_cam + position``."""

    frame_id: str = ''  # empty: the camera itself
    R: Array = np.eye(3)
    position: Array = np.zeros(3)  # of the camera [m]

    @classmethod
    def of(
        cls,
        frame_id: str,
        base_to_camera: Sequence[float],
    ) -> Base:
        """From x y z, quaternion x y z w of the camera in the base."""
        R = Rotation.from_quat(base_to_camera[3:]).as_matrix()
        return cls(frame_id, R, np.array(base_to_camera[:3]))

    def camera(self, base: Odometry) -> Odometry:
        """The state of the camera instead of that of the base, with its covariances."""
        arm = base.R @ self.position
        by_pose = np.eye(6)
        by_pose[:3, 3:] = -skew(arm)
        to_camera = self.R.T
        by_twist = np.zeros((6, 6))
        by_twist[:3, :3] = to_camera
        by_twist[3:, 3:] = to_camera
        by_twist[:3, 3:] = -to_camera @ skew(self.position)
        swing = np.cross(base.angular_velocity, self.position)
        pose_covariance = by_pose @ base.pose_covariance @ by_pose.T
        velocity_covariance = by_twist @ base.velocity_covariance @ by_twist.T
        return replace(
            base,
            R=base.R @ self.R,
            position=base.position + arm,
            pose_covariance=pose_covariance,
            velocity=to_camera @ (base.velocity + swing),
            angular_velocity=to_camera @ base.angular_velocity,
            velocity_covariance=velocity_covariance,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """The base, or without one the camera, in a metric world with z up, at a time."""

    stamp_ns: int  # on the camera's clock, as image stamps
    imu_ns: int  # the same time on the IMU clock
    frame_id: str  # of the base
    path: int  # number of earlier starts in the same world
    corrections: int  # of the keyframe from which it is propagated, since the first start
    R: Array  # (3, 3) from the base
    position: Array  # (3,) [m]
    pose_covariance: Array  # (6, 6) of (position, rotation), in the axes of the world
    velocity: Array  # (3,) of the base, in its axes [m/s]
    angular_velocity: Array  # (3,) likewise [rad/s]
    velocity_covariance: Array  # (6, 6) of the two


@dataclass(frozen=True, slots=True)
class StartReport:
    """A start of the odometry."""

    at_rest: bool
    imu_ns: int
    seconds: float  # since its first pair
    scale_sigma: float  # relative


class ContinuousPath:
    """States at increasing times, without steps: corrections are blended in.

    What is not blended in yet is part of the covariance. `propagated`: of an estimator.
    """

    def __init__(self, propagated: Callable[[int], Odometry | None]) -> None:
        self._propagated = propagated
        self._offset = np.zeros(6)  # position, rotation; in the world
        self.reset()

    def reset(self) -> None:
        """Begin another path."""
        self._last: Odometry | None = None

    def at(self, imu_ns: int) -> Odometry | None:
        """The state at a time; None without one, and if the time is not new."""
        last = self._last
        if last is not None and last.imu_ns - _JUMP_NS < imu_ns <= last.imu_ns:
            return None
        state = self._propagated(imu_ns)
        if state is None:
            return None
        if last is None or last.path != state.path or imu_ns < last.imu_ns:
            self._offset = np.zeros(6)
        else:
            if state.corrections != last.corrections:
                self._offset = self._corrected_by(last, state)
            seconds = seconds_between(last.imu_ns, imu_ns)
            self._offset = self._offset * math.exp(-seconds / _BLENDING)
        self._last = replace(
            state,
            position=state.position + self._offset[:3],
            R=exp_so3(self._offset[3:]) @ state.R,
            pose_covariance=state.pose_covariance + np.outer(self._offset, self._offset),
        )
        return self._last

    def _corrected_by(
        self,
        last: Odometry,
        state: Odometry,
    ) -> Array:
        """Offset (6,) of the last published state from the path as it is known now."""
        before = self._propagated(last.imu_ns)
        if before is not None:
            R, position = before.R, before.position
        else:  # the newest keyframe is later: back at the mean velocity
            seconds = seconds_between(last.imu_ns, state.imu_ns)
            velocity = last.R @ last.velocity + state.R @ state.velocity
            rate = last.angular_velocity + state.angular_velocity
            position = state.position - 0.5 * seconds * velocity
            R = state.R @ exp_so3(-0.5 * seconds * rate)
        return np.concatenate([last.position - position, log_so3(last.R @ R.T)])
