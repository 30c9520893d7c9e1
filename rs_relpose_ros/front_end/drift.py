"""Gyro bias and residual time offset, followed slowly from the pairs that were estimated.

A pair's rotation by the images differs from that of the gyro by what is wrong with the gyro's:

    Log(R_images R_gyro^T) = -B (b - b_removed) + R w_2 (o - c_2) - w_1 (o - c_1) + noise

``b``: bias; ``B``: derivative of the integrated rotation by a constant rate; ``o``: time offset
beyond ``time_offset``; ``c_i``: the share of it that was applied to frame i already; ``w_i``: rate
at the frames' instants. A Kalman filter over (b, o), both random walks, takes one such
measurement per pair. It depends on the pairs alone, so that live and replay agree.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.geometry.so3 import log_so3
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds
from rs_relpose_ros.imu.bias import BIAS_MEMORY
from rs_relpose_ros.imu.frame_imu import GyroSegment
from rs_relpose_ros.imu.integration import bias_jacobian

Array = NDArray[np.float64]

# 1 sigma of the time offset before the first pair [s]; larger ones are for `calibrate` to find.
OFFSET_SIGMA = 0.02
# Random walk of the time offset [s per square root of a second]: clocks drift by some ppm.
_OFFSET_WALK = 1.5e-4
# 1 sigma [rad] of systematic errors of a rotation by images (intrinsics, read-out).
_LEAST_ROTATION_SIGMA = 3e-4
# Innovation, in sigmas, above which the noise of a measurement is inflated to explain it.
_SURPRISE = 3.0
# Least share of the information on a pair's rotation that must come from the images.
_LEAST_SHARE = 0.02
# 1 sigma [s] from which on the offset is applied.
_APPLIED_SIGMA = 2e-3
# Largest offset that is applied [s], and largest change of it [s per pair].
_LARGEST_APPLIED = 0.05
_LARGEST_STEP = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """Gyro bias and time offset after the pairs so far."""

    gyro_bias: Array   # (3,) [rad/s], IMU frame; the bias as a whole, not what is left of it
    gyro_bias_sigma: Array
    time_offset: float   # [s] IMU clock minus camera clock, as the parameter of this name
    time_offset_sigma: float
    applied: float   # [s] share of it, beyond the parameter, that the next frames get
    pairs: int   # that held information on the gyro


@dataclass(frozen=True, slots=True, eq=False)
class PairRotation:
    """A pair's rotation by images and gyro."""

    stamp_ns: int   # of the second frame
    R: Array   # (3, 3) as estimated, R_true = Exp(dtheta) R
    covariance: Array   # (3, 3) of dtheta
    gyro_rotation: Array   # (3, 3) as integrated from `gyro`
    gyro_covariance: Array | None   # None where the estimator did not get the gyro's rotation
    gyro: GyroSegment
    applied1: float   # [s] time offset applied to each frame
    applied2: float


class DriftTracker:
    """Follows bias and offset over pairs in the order of time."""

    def __init__(self, parameters: Parameters) -> None:
        imu = parameters.imu
        self._R_cam_imu = parameters.sensor.R_cam_imu
        self._told_offset = parameters.sensor.time_offset
        self._state = np.array([*imu.gyro_bias, 0.0])
        self._prior = np.diag([imu.gyro_bias_sigma**2] * 3 + [OFFSET_SIGMA**2])
        self._covariance = self._prior.copy()
        self._growth = np.diag([imu.gyro_bias_sigma**2 / BIAS_MEMORY] * 3 + [_OFFSET_WALK**2])
        self._last_ns: int | None = None
        self._pairs = 0
        self._applied = 0.0

    @property
    def applied_ns(self) -> int:
        """Time offset [ns] beyond the parameter that frames get from now on."""
        return to_nanoseconds(self._applied)

    def estimate(self) -> Drift:
        """The state after the last pair."""
        sigmas = np.sqrt(np.diag(self._covariance))
        return Drift(self._state[:3].copy(), sigmas[:3], self._told_offset + float(self._state[3]),
                     float(sigmas[3]), self._applied, self._pairs)

    def add(self, pair: PairRotation) -> None:
        """Take in a pair; one whose rotation the images did not see changes nothing."""
        self._pass_time(pair.stamp_ns)
        seen = _by_images(pair)
        if seen is None:
            return
        difference, noise = seen
        segment = pair.gyro
        jacobian = bias_jacobian(segment.stamps_ns, segment.angular_velocities) @ self._R_cam_imu
        w1 = segment.angular_velocities[0]
        w2 = pair.gyro_rotation @ segment.angular_velocities[-1]
        H = np.column_stack([-jacobian, w2 - w1])
        measured = (difference - jacobian @ (self._R_cam_imu.T @ segment.bias)
                    + w2 * pair.applied2 - w1 * pair.applied1)
        innovation = measured - H @ self._state
        spread = H @ self._covariance @ H.T + noise
        surprise = float(innovation @ np.linalg.solve(spread, innovation)) / _SURPRISE**2
        if surprise > 1.0:
            spread = spread + (surprise - 1.0) * noise
        gain = np.linalg.solve(spread, H @ self._covariance).T
        self._state = self._state + gain @ innovation
        covariance = self._covariance - gain @ H @ self._covariance
        self._covariance = 0.5 * (covariance + covariance.T)
        self._pairs += 1

    def apply(self, wanted: bool) -> None:
        """Move the applied offset towards the known one, or back to none."""
        known = self._covariance[3, 3] < _APPLIED_SIGMA**2
        target = (float(self._state[3]) if known else self._applied) if wanted else 0.0
        target = min(max(target, -_LARGEST_APPLIED), _LARGEST_APPLIED)
        self._applied += min(max(target - self._applied, -_LARGEST_STEP), _LARGEST_STEP)

    def _pass_time(self, stamp_ns: int) -> None:
        if self._last_ns is not None:
            seconds = max(stamp_ns - self._last_ns, 0) / NANOSECONDS
            # The uncertainty grows to that of the start, not beyond.
            grown = self._covariance + seconds * self._growth
            excess = np.sqrt(np.minimum(
                np.diag(self._prior) / np.maximum(np.diag(grown), 1e-30), 1.0))
            self._covariance = grown * np.outer(excess, excess)
        self._last_ns = stamp_ns


def _by_images(pair: PairRotation) -> tuple[Array, Array] | None:
    """Rotation by the images alone against the gyro's (3,) and its covariance.

    The estimate holds the gyro's rotation as a prior, in information form ``I = I_images +
    I_gyro``: taken out again. None where the images say too little.
    """
    if not (np.isfinite(pair.R).all() and np.isfinite(pair.covariance).all()):
        return None
    difference = log_so3(np.ascontiguousarray(pair.R @ pair.gyro_rotation.T))
    information = np.linalg.inv(pair.covariance)
    of_images = information
    if pair.gyro_covariance is not None:
        of_images = information - np.linalg.inv(pair.gyro_covariance)
    values, axes = np.linalg.eigh(0.5 * (of_images + of_images.T))
    # Information of images and gyro along these axes; where the gyro has all of it, what is left
    # for the images is rounding.
    total = np.einsum('ij,ik,kj->j', axes, information, axes)
    if not (values > _LEAST_SHARE * total).all():
        return None
    by_images = axes @ ((axes.T @ (information @ difference)) / values)
    noise = (axes / values) @ axes.T + _LEAST_ROTATION_SIGMA**2 * np.eye(3)
    if math.sqrt(float(by_images @ by_images)) > 0.2:
        return None   # more than any drift: the estimate is wrong
    return by_images, noise
