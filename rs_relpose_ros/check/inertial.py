"""What gyro and accelerometer read over a recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.check.streams import Thinned
from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.imu.bias import BiasTracker
from rs_relpose_ros.imu.samples import ImuSample, Vector

Array = NDArray[np.float64]

# How far off a bias may be that is still found at rest, 1 sigma [rad/s]; gate of four times that.
_BIAS_SIGMA = 0.03
# Samples that are handed to the search for rest at once.
_PORTION = 512


@dataclass(frozen=True, slots=True, eq=False)
class InertialSummary:
    """Readings of the IMU.

    Attributes
    ----------
    rates : (K, 3) ndarray
        Some of the gyro's [rad/s], evenly over the recording.
    force_length : float
        Mean length of the specific force [m/s^2]; NaN without accelerometer.
    force : (3,) ndarray
        Mean specific force [m/s^2], IMU frame.
    rest_bias : (3,) ndarray or None
        Mean rate while the IMU stood still [rad/s]; None where it never did.
    rest_sigma : float
        Of it, per axis [rad/s].
    orientations : int
        Messages with an orientation that says how good it is.
    """

    rates: Array
    force_length: float
    force: Array
    rest_bias: Array | None
    rest_sigma: float
    orientations: int


class Inertial:
    """Takes in IMU samples in the order of recording."""

    def __init__(self) -> None:
        config = ImuConfig(gyro_bias_sigma=_BIAS_SIGMA)
        self._rest = BiasTracker(config)
        self._rates = Thinned(3)
        self._sum, self._length, self._forces = np.zeros(3), 0.0, 0
        self._orientations = 0
        self._newest_ns: int | None = None
        self._force: Vector | None = None
        self._portion: list[tuple[int, Vector, Vector]] = []

    def add(self, sample: ImuSample) -> None:
        """Take in a sample."""
        self._orientations += sample.orientation is not None
        if sample.linear_acceleration is not None:
            self._force = sample.linear_acceleration
            self._sum += self._force
            self._length += float(np.linalg.norm(self._force))
            self._forces += 1
        if sample.angular_velocity is None:
            return
        self._rates.add(*sample.angular_velocity)
        # The search for rest wants them in order.
        if self._newest_ns is None or sample.stamp_ns > self._newest_ns:
            self._newest_ns = sample.stamp_ns
            nothing = (float('nan'),) * 3
            self._portion.append((sample.stamp_ns, sample.angular_velocity,
                                  nothing if self._force is None else self._force))
            if len(self._portion) == _PORTION:
                self._search()

    def summary(self) -> InertialSummary:
        """Figures of what came so far."""
        self._search()
        rest = self._rest.estimate(self._newest_ns or 0)
        found = rest.sigma < _BIAS_SIGMA
        mean = self._sum / self._forces if self._forces else np.full(3, np.nan)
        return InertialSummary(
            rates=self._rates.values,
            force_length=self._length / self._forces if self._forces else float('nan'),
            force=mean, rest_bias=rest.value if found else None, rest_sigma=rest.sigma,
            orientations=self._orientations)

    def _search(self) -> None:
        if self._portion:
            stamps, rates, forces = zip(*self._portion, strict=True)
            self._rest.run(np.array(stamps, dtype=np.int64), np.array(rates), np.array(forces))
            self._portion = []
