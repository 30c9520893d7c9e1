"""Bias of the gyro, measured whenever the IMU stands still.

Samples are judged in windows of half a second. A window is at rest where gyro and accelerometer
hardly vary and the mean rate is within the bias' uncertainty. Its mean measures the bias:

    P <- min(P + q dt, P_0)        K = P / (P + s^2)        b <- b + K (mean - b)

`P_0` is the square of ``gyro_bias_sigma``. Of two consecutive windows at rest only the older one
is used: the newer one may hold the beginning of a motion.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.geometry.timing import to_nanoseconds

Array = NDArray[np.float64]

# Time in which the variance of a measured bias grows back to `gyro_bias_sigma` squared [s].
BIAS_MEMORY = 600.0

_WINDOW_NS = 500_000_000
_LEAST_SAMPLES = 10
# Largest standard deviation in a window at rest, per axis [rad/s], [m/s^2]: three times that of a
# MEMS IMU on a table, a third of that of a hand that tries to be still.
_REST_RATE = 0.01
_REST_FORCE = 0.1
# Correlation time of the remaining motion at rest [s].
_SWAY_TIME = 0.1
# Largest distance of the mean rate from the bias, in sigmas; beyond it is a slow turn.
_GATE = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class GyroBias:
    """Bias (3,) [rad/s] in the IMU frame and its `sigma` per axis."""

    value: Array
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class _Rest:
    """A window at rest: its end, its mean rate and the variance of that."""

    end_ns: int
    mean: Array
    variance: float


class BiasTracker:
    """Causal estimate of the gyro's bias; its state depends on the samples alone."""

    def __init__(self, config: ImuConfig) -> None:
        self._gap_ns = to_nanoseconds(config.max_imu_gap)
        self._follow = config.track_gyro_bias
        self._prior = config.gyro_bias_sigma**2
        self._growth = self._prior / BIAS_MEMORY
        self._bias = np.array(config.gyro_bias)
        self._variance = self._prior
        self._measured_ns: int | None = None
        self._rest: _Rest | None = None
        self._pending: tuple[NDArray[np.int64], Array, Array] = (
            np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty((0, 3)))

    def run(self, stamps_ns: NDArray[np.int64], rates: Array, forces: Array) -> None:
        """Take in samples (K,) that follow those before, their stamps strictly increasing.

        `rates` (K, 3) [rad/s] are those that the gyro reads, `forces` (K, 3) [m/s^2] the specific
        force at these stamps, NaN where there is none.
        """
        if not self._follow:
            return
        old = self._pending
        stamps_ns = np.concatenate([old[0], stamps_ns])
        rates, forces = np.concatenate([old[1], rates]), np.concatenate([old[2], forces])
        start = 0
        # A window is complete once a sample lies behind its end.
        while start < len(stamps_ns) and stamps_ns[-1] >= stamps_ns[start] + _WINDOW_NS:
            end = int(np.searchsorted(stamps_ns, stamps_ns[start] + _WINDOW_NS))
            self._judge(stamps_ns[start:end + 1], rates[start:end], forces[start:end])
            start = end
        self._pending = stamps_ns[start:], rates[start:], forces[start:]

    def estimate(self, at_ns: int) -> GyroBias:
        """The bias at an instant, from the windows that are known."""
        return GyroBias(self._bias, math.sqrt(self._variance_at(at_ns)))

    # -- inside ------------------------------------------------------------------------------

    def _judge(self, stamps_ns: NDArray[np.int64], rates: Array, forces: Array) -> None:
        """Look at one window; `stamps_ns` has one more, that of the sample behind it."""
        before, self._rest = self._rest, None
        if len(rates) < _LEAST_SAMPLES or int(np.diff(stamps_ns).max()) > self._gap_ns:
            return
        # Without accelerometer a steady slow turn looks like rest; NaN compares false.
        spread = float(rates.std(axis=0).max())
        if not (spread < _REST_RATE and float(forces.std(axis=0).max()) < _REST_FORCE):
            return
        seconds = _WINDOW_NS * 1e-9
        rest = _Rest(int(stamps_ns[-1]), rates.mean(axis=0), spread**2 * _SWAY_TIME / seconds)
        variance = self._variance_at(rest.end_ns) + rest.variance
        if float(np.abs(rest.mean - self._bias).max()) > _GATE * math.sqrt(variance):
            return
        if before is not None:
            self._measure(before)
        self._rest = rest

    def _measure(self, rest: _Rest) -> None:
        variance = self._variance_at(rest.end_ns)
        gain = variance / (variance + rest.variance) if variance > 0.0 else 0.0
        self._bias = self._bias + gain * (rest.mean - self._bias)
        self._variance = (1.0 - gain) * variance
        self._measured_ns = rest.end_ns

    def _variance_at(self, at_ns: int) -> float:
        if self._measured_ns is None:
            return self._prior
        passed = max(at_ns - self._measured_ns, 0) * 1e-9
        return min(self._variance + self._growth * passed, self._prior)
