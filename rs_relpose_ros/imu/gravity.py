"""Direction of gravity from accelerometer and gyro, causally.

The filter carries the direction along with the gyro and pulls it towards the accelerometer's. It
is a Kalman filter of the direction ``u`` (up, IMU frame) and of what is left of the gyro's bias
``b``, with the errors ``u_true = Exp(d) u`` and ``b_true = b + e``:

    u <- Exp(-(w - b) dt) u            d <- Exp(-(w - b) dt) d + e dt
    f / |f| = u_true + noise           f / |f| - u = -[u]x d + noise

The noise is the camera's own acceleration over 9.81 m/s^2. A specific force that differs from
that in length is known to hold acceleration and gets less weight.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.geometry.so3 import exp_so3
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.imu.bias import BIAS_MEMORY

Array = NDArray[np.float64]

STANDARD_GRAVITY = 9.80665
MEAN_WINDOW_NS = 100_000_000
# Time over which hand-held acceleration stays correlated [s]: samples within it are one.
_CORRELATION_TIME = 0.2
# Acceleration that lasts longer than this [s] drags the filter along.
_LASTING = 1.0
# No IMU knows the direction better than so while it is carried about [rad].
_LEAST_OWN_SIGMA = 0.01
# Further from the direction of the accelerometer, in sigmas, it counts from another world.
_OWN_GATE = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class GravityEstimate:
    """Direction (3,) of free fall, unit, IMU frame; `sigma` [rad] per axis."""

    direction: Array
    sigma: float


class GravityFilter:
    """Runs over samples in the order of their stamps; its state depends on nothing else."""

    def __init__(self, config: ImuConfig) -> None:
        self._config = config
        self._gap_ns = to_nanoseconds(config.max_imu_gap)
        across = (config.gravity_acceleration_sigma / STANDARD_GRAVITY)**2
        # The growth of the direction's variance that makes the stationary gain dt / time constant.
        growth = (across * _CORRELATION_TIME / config.gravity_time_constant**2
                  + config.gyro_noise_density**2)
        self._noise = np.array([config.gravity_acceleration_sigma**2, growth,
                                config.gyro_bias_sigma**2 / BIAS_MEMORY])
        self._bias = np.zeros(3)
        self._bias_covariance = config.gyro_bias_sigma**2 * np.eye(3)
        self._restart()

    def _restart(self) -> None:
        """The direction is unknown; the bias is what it was."""
        self._stamp_ns: int | None = None
        self._up = np.zeros(3)
        self._rate = np.zeros(3)
        self._covariance = np.zeros((6, 6))
        # Residual of the last second, in the IMU frame.
        self._residual = np.zeros(3)

    @property
    def stamp_ns(self) -> int | None:
        """Stamp of the last sample taken in; None while there is no direction."""
        return self._stamp_ns

    def run(self, stamps_ns: NDArray[np.int64], rates: Array, forces: Array) -> None:
        """Take in samples that follow those before.

        Parameters
        ----------
        stamps_ns : (K,) ndarray of int64
            Strictly increasing.
        rates : (K, 3) ndarray
            Gyro [rad/s], known bias removed.
        forces : (K, 3) ndarray
            Specific force [m/s^2] at these stamps; NaN where there is none.
        """
        k = 0
        while k < len(stamps_ns):
            if self._stamp_ns is None:
                k = self._begin(k, stamps_ns, rates, forces)
                continue
            done = _advance(self._up, self._bias, self._residual, self._covariance,
                            self._stamp_ns, self._rate, stamps_ns[k:], rates[k:], forces[k:],
                            self._noise, self._gap_ns)
            if done:
                k += done
                self._stamp_ns, self._rate = int(stamps_ns[k - 1]), rates[k - 1].copy()
            if k < len(stamps_ns):
                # Nobody knows how the IMU turned in the gap.
                self._bias_covariance = self._covariance[3:, 3:].copy()
                self._restart()

    def estimate(self) -> GravityEstimate | None:
        """Gravity at the stamp of the last sample; None without accelerometer."""
        if self._stamp_ns is None:
            return None
        # An error along the direction itself turns nothing.
        spread = self._covariance[:3, :3]
        variance = 0.5 * float(np.trace(spread) - self._up @ spread @ self._up)
        dragged = (float(np.linalg.norm(self._residual))
                   * min(_LASTING / self._config.gravity_time_constant, 1.0))
        return GravityEstimate(-self._up, math.sqrt(variance + dragged * dragged))

    def _begin(self, k: int, stamps_ns: NDArray[np.int64], rates: Array, forces: Array) -> int:
        """Start from the first specific force at or after sample `k`; the index after it."""
        lengths = np.linalg.norm(forces[k:], axis=1)
        usable = np.flatnonzero(lengths > 0.0)
        if len(usable) == 0:
            return len(stamps_ns)
        first = k + int(usable[0])
        length = float(lengths[first - k])
        self._up = forces[first] / length
        excess = length - STANDARD_GRAVITY
        variance = (self._config.gravity_acceleration_sigma**2
                    + 4.0 * excess**2) / STANDARD_GRAVITY**2
        self._covariance[:3, :3] = variance * np.eye(3)
        self._covariance[3:, 3:] = self._bias_covariance
        self._stamp_ns, self._rate = int(stamps_ns[first]), rates[first].copy()
        return first + 1


@kernel
def _advance(up: Array, bias: Array, residual: Array, covariance: Array, stamp_ns: int,
             rate: Array, stamps_ns: NDArray[np.int64], rates: Array, forces: Array, noise: Array,
             gap_ns: int) -> int:
    """Filter samples up to the first gap; their number. The first four are updated in place.

    `noise`: variance of the acceleration, growth per second of the variances of direction and
    bias.
    """
    transition = np.eye(6)
    turned = np.empty((6, 6))
    slope = np.empty((3, 3))
    gain = np.empty((6, 3))
    cross = np.empty((6, 3))
    for k in range(stamps_ns.shape[0]):
        if stamps_ns[k] - stamp_ns > gap_ns:
            return k
        dt = (stamps_ns[k] - stamp_ns) * 1e-9
        # A direction that is fixed in the world turns backwards in the IMU frame.
        back = exp_so3(-(0.5 * (rate + rates[k]) - bias) * dt)
        stamp_ns, rate = stamps_ns[k], rates[k]
        up[:] = _product(back, up)
        residual[:] = _product(back, residual)
        for i in range(3):
            for j in range(3):
                transition[i, j] = back[i, j]
            transition[i, 3 + i] = dt
        for i in range(6):
            for j in range(6):
                total = 0.0
                for m in range(6):
                    total += transition[i, m] * covariance[m, j]
                turned[i, j] = total
        for i in range(6):
            for j in range(6):
                total = 0.0
                for m in range(6):
                    total += turned[i, m] * transition[j, m]
                covariance[i, j] = total
            covariance[i, i] += noise[1 if i < 3 else 2] * dt
        force = forces[k]
        length = math.sqrt(force[0] * force[0] + force[1] * force[1] + force[2] * force[2])
        if length > 0.0:
            # |f| off by some acceleration along gravity means about as much across it.
            excess = length - STANDARD_GRAVITY
            sigma2 = (noise[0] + 4.0 * excess * excess) / (STANDARD_GRAVITY * STANDARD_GRAVITY)
            # Samples closer than the correlation time share one measurement's weight.
            sigma2 *= max(_CORRELATION_TIME / dt, 1.0)
            _correct(up, bias, residual, covariance, force / length, sigma2, dt, slope, cross,
                     gain)
    return stamps_ns.shape[0]


@kernel
def _correct(up: Array, bias: Array, residual: Array, covariance: Array, measured: Array,
             sigma2: float, dt: float, slope: Array, cross: Array, gain: Array) -> None:
    """Kalman update by a measured direction (3,) of variance `sigma2` per axis."""
    # H = -[u]x, the derivative of the residual by d.
    slope[0, 0] = slope[1, 1] = slope[2, 2] = 0.0
    slope[0, 1], slope[1, 0] = up[2], -up[2]
    slope[0, 2], slope[2, 0] = -up[1], up[1]
    slope[1, 2], slope[2, 1] = up[0], -up[0]
    for i in range(6):
        for j in range(3):
            cross[i, j] = (covariance[i, 0] * slope[j, 0] + covariance[i, 1] * slope[j, 1]
                           + covariance[i, 2] * slope[j, 2])
    # S = H P H^T + sigma2 I, inverted by its cofactors.
    s00, s01, s02 = sigma2, 0.0, 0.0
    s11, s12, s22 = sigma2, 0.0, sigma2
    for m in range(3):
        s00 += slope[0, m] * cross[m, 0]
        s01 += slope[0, m] * cross[m, 1]
        s02 += slope[0, m] * cross[m, 2]
        s11 += slope[1, m] * cross[m, 1]
        s12 += slope[1, m] * cross[m, 2]
        s22 += slope[2, m] * cross[m, 2]
    i00, i01, i02 = s11 * s22 - s12 * s12, s02 * s12 - s01 * s22, s01 * s12 - s02 * s11
    i11, i12, i22 = s00 * s22 - s02 * s02, s01 * s02 - s00 * s12, s00 * s11 - s01 * s01
    determinant = s00 * i00 + s01 * i01 + s02 * i02
    for i in range(6):
        a, b, c = cross[i, 0], cross[i, 1], cross[i, 2]
        gain[i, 0] = (a * i00 + b * i01 + c * i02) / determinant
        gain[i, 1] = (a * i01 + b * i11 + c * i12) / determinant
        gain[i, 2] = (a * i02 + b * i12 + c * i22) / determinant
    turn = np.zeros(3)
    share = min(dt / _LASTING, 1.0)
    for j in range(3):
        off = measured[j] - up[j]
        residual[j] += share * (off - residual[j])
        for i in range(3):
            turn[i] += gain[i, j] * off
            bias[i] += gain[3 + i, j] * off
    for i in range(6):
        for j in range(i, 6):
            covariance[i, j] -= (gain[i, 0] * cross[j, 0] + gain[i, 1] * cross[j, 1]
                                 + gain[i, 2] * cross[j, 2])
            covariance[j, i] = covariance[i, j]
    moved = _product(exp_so3(turn), up)
    norm = math.sqrt(moved[0] * moved[0] + moved[1] * moved[1] + moved[2] * moved[2])
    for i in range(3):
        up[i] = moved[i] / norm


@kernel
def _product(matrix: Array, vector: Array) -> Array:
    out = np.empty(3)
    for i in range(3):
        out[i] = (matrix[i, 0] * vector[0] + matrix[i, 1] * vector[1]
                  + matrix[i, 2] * vector[2])
    return out


def mean_gravity(forces: Array) -> GravityEstimate | None:
    """The paper's estimate: minus the mean specific force (K, 3) of a short window."""
    if len(forces) == 0:
        return None
    mean = forces.mean(axis=0)
    length = float(np.linalg.norm(mean))
    if not length > 0.0:
        return None
    # Acceleration hides in the window as a whole; its length shows the part along gravity.
    excess = abs(length - STANDARD_GRAVITY) / STANDARD_GRAVITY
    return GravityEstimate(-mean / length, math.hypot(0.1, excess))


def agreed_gravity(own: GravityEstimate | None,
                   measured: GravityEstimate | None) -> GravityEstimate | None:
    """The IMU's own estimate, unless it is absent or contradicts the accelerometer's.

    An orientation may count from another world (north-east-down), from the start, or be a filler:
    it is believed only where the accelerometer allows it.
    """
    if own is None:
        return measured
    own = GravityEstimate(own.direction, max(own.sigma, _LEAST_OWN_SIGMA))
    if measured is None:
        return own
    apart = math.atan2(float(np.linalg.norm(np.cross(own.direction, measured.direction))),
                       float(own.direction @ measured.direction))
    return own if apart <= _OWN_GATE * math.hypot(own.sigma, measured.sigma) else measured
