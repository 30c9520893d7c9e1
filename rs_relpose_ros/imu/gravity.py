"""Direction of gravity from accelerometer and gyro, causally.

The complementary filter carries the direction along with the gyro and pulls it towards the
accelerometer's. It is the stationary Kalman filter of a direction: a sample whose specific force
differs from 9.81 m/s^2 in length is known to hold acceleration and gets less weight.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numba
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.imu.config import ImuConfig
from rs_relpose_ros.so3 import exp_so3

Array = NDArray[np.float64]

STANDARD_GRAVITY = 9.80665
# Time over which hand-held acceleration stays correlated: samples within it are one measurement.
ACCELERATION_CORRELATION = 0.3
MEAN_WINDOW_NS = 100_000_000


@dataclass(frozen=True, slots=True, eq=False)
class GravityEstimate:
    """Direction (3,) of free fall, unit, IMU frame; `sigma` [rad] per axis."""

    direction: Array
    sigma: float


@numba.njit(cache=True, nogil=True)
def advance(up: Array, variance: float, turn: Array, dt: float, force: Array,
            acceleration_sigma: float, floor: float, rate_variance: float) -> float:
    """One step of the filter: turn `up` (3,) in place, then correct it; the new variance.

    Parameters
    ----------
    up : (3,) ndarray
        Estimated direction of the specific force at rest (upwards), unit; updated in place.
    variance : float
        Of that direction, per axis [rad^2].
    turn : (3,) ndarray
        Rotation vector of the IMU since the last step [rad].
    force : (3,) ndarray
        Specific force [m/s^2]; NaN for a sample without accelerometer.
    floor : float
        Variance below which the filter does not go (its gain never vanishes) [rad^2].
    rate_variance : float
        Growth of the variance by the gyro's bias error [rad^2/s].
    """
    # A world-fixed direction turns backwards in the IMU frame.
    moved = exp_so3(-turn) @ up
    variance += rate_variance * dt
    length = math.sqrt(force[0] * force[0] + force[1] * force[1] + force[2] * force[2])
    if length > 0.0:
        # |force| off by a means acceleration of at least that size along gravity, so about as
        # much across it.
        excess = length - STANDARD_GRAVITY
        sigma2 = (acceleration_sigma * acceleration_sigma + 4.0 * excess * excess) \
            / (STANDARD_GRAVITY * STANDARD_GRAVITY)
        # Correlated acceleration: a sample counts only for its share of the correlation time.
        measured = sigma2 * max(ACCELERATION_CORRELATION / dt, 1.0)
        gain = variance / (variance + measured)
        for i in range(3):
            moved[i] += gain * (force[i] / length - moved[i])
        variance = max((1.0 - gain) * variance, floor)
    norm = math.sqrt(moved[0] * moved[0] + moved[1] * moved[1] + moved[2] * moved[2])
    for i in range(3):
        up[i] = moved[i] / norm
    return variance


class GravityFilter:
    """Runs over samples in the order of their stamps; its state depends on nothing else."""

    def __init__(self, config: ImuConfig) -> None:
        self._config = config
        self._up: Array | None = None
        self._variance = 0.0
        self._stamp_ns = 0
        self._rate = np.zeros(3)
        # At rest, gain * dt = dt / time_constant: the stationary variance of that gain.
        across = (config.gravity_acceleration_sigma / STANDARD_GRAVITY)**2
        self._floor = across * ACCELERATION_CORRELATION / config.gravity_time_constant
        self._rate_variance = (config.gyro_noise_density**2
                               + config.gyro_bias_sigma**2 * config.gravity_time_constant)

    @property
    def stamp_ns(self) -> int | None:
        """Stamp of the last sample taken in; None before the first."""
        return None if self._up is None else self._stamp_ns

    def add(self, stamp_ns: int, rate: Array, force: Array) -> None:
        """Take in a sample: rate (3,) [rad/s] bias removed, force (3,) [m/s^2] or NaN."""
        if self._up is None:
            length = float(np.linalg.norm(force))
            if not length > 0.0:
                return
            self._up = force / length
            # One sample: all of the acceleration is in it.
            excess = length - STANDARD_GRAVITY
            self._variance = (self._config.gravity_acceleration_sigma**2
                              + 4.0 * excess**2) / STANDARD_GRAVITY**2
        else:
            dt = (stamp_ns - self._stamp_ns) * 1e-9
            if dt <= 0.0:
                return
            self._variance = advance(
                self._up, self._variance, 0.5 * (self._rate + rate) * dt, dt, force,
                self._config.gravity_acceleration_sigma, self._floor, self._rate_variance)
        self._stamp_ns, self._rate = stamp_ns, rate

    def estimate(self) -> GravityEstimate | None:
        """Gravity at the stamp of the last sample; None without accelerometer."""
        if self._up is None:
            return None
        return GravityEstimate(-self._up, math.sqrt(self._variance))


def mean_gravity(forces: Array) -> GravityEstimate | None:
    """The paper's estimate: minus the mean specific force (K, 3) of a short window."""
    forces = forces[np.isfinite(forces).all(axis=1)]
    if len(forces) == 0:
        return None
    mean = forces.mean(axis=0)
    length = float(np.linalg.norm(mean))
    if not length > 0.0:
        return None
    # Acceleration hides in the window as a whole; its length shows the part along gravity.
    excess = abs(length - STANDARD_GRAVITY) / STANDARD_GRAVITY
    return GravityEstimate(-mean / length, math.hypot(0.1, excess))
