"""The state of the base, or of the camera without one, that follows from a state of the body."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.special import fdtri, gammaincinv

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import skew
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.odometry.doubts import by_gyro_matrix, Doubts
from rs_relpose_ros.odometry.graph import (
    ARM,
    DOUBTS,
    GYRO_BIAS,
    KeyframeState,
    ROTATION,
    TRANSLATION,
    VELOCITY,
)
from rs_relpose_ros.odometry.starts import PathEnd
from rs_relpose_ros.odometry.states import Base, Odometry

# Share of errors that `untested_scale` keeps within 3 sigma. A smaller one would leave the tail of
# the distribution out. [derived: as `beyond` of summary.json counts]
_WITHIN = 0.997
# Number of values whose error has one covariance. [derived: of a position or a rotation]
_COMPARED = 3
# Noise of a single sample of the gyro in units of its density [sqrt(Hz)]. A smaller one would make
# published rates too certain. [derived: bandwidth of 100 Hz]
_RATE_NOISE = 10.0


class Stamp(NamedTuple):
    """When and on which path a state is."""

    stamp_ns: int  # on the clock of the camera, by the configured offset
    imu_ns: int
    path: int  # number of earlier starts
    corrections: int  # of the keyframe, since the first start


@lru_cache(maxsize=16)  # of each state; the number changes with a pair
def untested_scale(pairs: int) -> float:
    """Factor of a covariance whose own size is known from so many pairs.

    Models and noises that the pairs have not tested yet may be wrong: errors by a covariance of
    uncertain size have the distribution F instead of chi squared, whose bound is further out.
    """
    if not pairs:
        return 1.0
    bound = 2.0 * gammaincinv(0.5 * _COMPARED, _WITHIN)
    return float(_COMPARED * fdtri(_COMPARED, pairs, _WITHIN) / bound)


def at_unknown_time(state: Odometry, acceleration: Array, rates: Array, sigma: float) -> Odometry:
    """The same of a time that is known to `sigma` [s] only.

    `acceleration` (3,): in the world; `rates` (K, 3): recent ones, as the body turns otherwise
    within that time.
    """
    by_time = np.concatenate([state.velocity, state.angular_velocity])
    moving = np.concatenate([state.R @ by_time[:3], state.R @ by_time[3:]])
    turning = np.cross(state.angular_velocity, state.velocity)
    accelerating = np.concatenate([state.R.T @ acceleration - turning, np.zeros(3)])
    more = np.outer(moving, moving)
    more[3:, 3:] += (rates**2).sum(axis=1).mean() / 3.0 * np.eye(3)
    more_velocity = np.outer(accelerating, accelerating)
    return replace(
        state,
        pose_covariance=state.pose_covariance + sigma**2 * more,
        velocity_covariance=state.velocity_covariance + sigma**2 * more_velocity,
    )


class Publication(NamedTuple):
    """What is the same for all states of a path."""

    base: Base
    frame_id: str
    origin_axes: Array  # of the body at the first start: the origin
    path_end: PathEnd  # of the path before
    unknown: Doubts
    gyro_noise_density: float
    scale: float  # of covariances, by what pairs have tested: `untested_scale`

    def state(self, body: KeyframeState, gyro: Array, stamp: Stamp) -> Odometry:
        """The base at a state of the body; `gyro` (3,): the rate that it measures."""
        base = self.base
        R_cam_body = self.unknown.R_cam_body(body.doubts)
        C = base.R @ R_cam_body
        arm = body.arm - C.T @ base.position
        unbiased = gyro - body.gyro_bias
        by_matrix = by_gyro_matrix(unbiased)
        rate = unbiased + by_matrix @ body.doubts[self.unknown.gyro_matrix]
        R = body.R @ C.T
        # It is at the origin at first: p + (R - R_first) c, in the world.
        position = body.position + (body.R - self.origin_axes) @ arm
        velocity = R.T @ (body.velocity + body.R @ skew(rate) @ arm)
        by_axes = self._by_axes(len(body.covariance))
        to_world = self._pose_by_body(body, arm, R_cam_body, by_axes)
        to_twist = self._twist_by_body(body, arm, rate, velocity, R_cam_body, by_axes)
        matrix = self.unknown.gyro_matrix
        columns = slice(DOUBTS.start + matrix.start, DOUBTS.start + matrix.stop)
        to_twist[:, columns] -= to_twist[:, GYRO_BIAS] @ by_matrix
        by_rate = to_twist[:, GYRO_BIAS] * self.gyro_noise_density * _RATE_NOISE
        covariance = self.scale * body.covariance
        of_body = to_world @ covariance @ to_world.T
        of_twist = to_twist @ covariance @ to_twist.T
        inherited = self.path_end.of_pose(body.position + body.R @ arm)
        # The rows of images are read later than configured by what the graph has learned.
        _, delay = self.unknown.mount(body.doubts)
        return Odometry(
            stamp_ns=stamp.stamp_ns - to_nanoseconds(delay),
            imu_ns=stamp.imu_ns,
            frame_id=self.frame_id,
            path=stamp.path,
            corrections=stamp.corrections,
            R=R,
            position=position,
            pose_covariance=of_body + inherited,
            velocity=velocity,
            angular_velocity=C @ rate,
            velocity_covariance=of_twist + by_rate @ by_rate.T,
        )

    def _by_axes(self, size: int) -> Array:
        """Derivative (3, n) of the camera's axes by the unknowns of a keyframe."""
        by_axes = np.zeros((3, size))
        images = self.unknown.images
        first = DOUBTS.start
        by_axes[:, first + images.start : first + images.stop] = self.unknown.by_mount[:3]
        return by_axes

    def _pose_by_body(
        self,
        body: KeyframeState,
        arm: Array,
        R_cam_body: Array,
        by_axes: Array,
    ) -> Array:
        """Derivative (6, n) of position and rotation by the unknowns of a keyframe.

        `by_axes`: as `_by_axes`.
        """
        # The camera's axes turn the base about the camera: derivatives by these axes.
        to_body = -R_cam_body.T
        axes_on_body = to_body @ by_axes
        across = skew(self.base.R.T @ self.base.position)
        arm_by_axes = to_body @ across @ by_axes
        moved = body.R - self.origin_axes
        by = np.zeros((6, by_axes.shape[1]))
        by[:3, ROTATION] = -body.R @ skew(arm)
        by[:3, TRANSLATION] = body.R
        by[:3, ARM] = moved
        by[:3] += moved @ arm_by_axes
        by[3:, ROTATION] = body.R
        by[3:] += body.R @ axes_on_body
        return by

    def _twist_by_body(
        self,
        body: KeyframeState,
        arm: Array,
        rate: Array,
        velocity: Array,
        R_cam_body: Array,
        by_axes: Array,
    ) -> Array:
        """Derivative (6, n) of velocity and rate of the base, in its axes.

        `by_axes`: as `_by_axes`.
        """
        base_R = self.base.R
        C = base_R @ R_cam_body
        across = skew(base_R.T @ self.base.position)
        swing_by_arm = C @ skew(rate)
        arm_by_axes = -R_cam_body.T @ across @ by_axes
        velocity_on_body = body.R.T @ body.velocity
        base_by_axes = base_R @ by_axes
        by = np.zeros((6, by_axes.shape[1]))
        by[:3, ROTATION] = C @ skew(velocity_on_body)
        by[:3, VELOCITY] = C @ body.R.T
        by[:3, ARM] = swing_by_arm
        by[:3, GYRO_BIAS] = C @ skew(arm)
        by[3:, GYRO_BIAS] = -C
        by[:3] += swing_by_arm @ arm_by_axes - skew(velocity) @ base_by_axes
        by[3:] -= skew(C @ rate) @ base_by_axes
        return by
