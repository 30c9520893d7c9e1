"""What gyro and accelerometer read over a recording."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.check.streams import Thinned
from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.imu.bias import BiasTracker, GyroBias
from rs_relpose_ros.imu.samples import ImuSample, Vector

Array = NDArray[np.float64]

# Uncertainty of the bias before it is measured at rest, 1 sigma [rad/s]; the gate is four times
# that.
_BIAS_SIGMA = 0.03
# Samples that are handed to the search for rest at once.
_PORTION = 512


class Inertial:
    """Readings of the IMU, taken in in the order of recording."""

    def __init__(self) -> None:
        self.forces = 0          # number of samples of the accelerometer
        self.orientations = 0    # number of orientations that say how good they are
        self._rest = BiasTracker(ImuConfig(gyro_bias_sigma=_BIAS_SIGMA))
        self._rates = Thinned(3)
        self._sum, self._length = np.zeros(3), 0.0
        self._newest_ns: int | None = None
        self._force: Vector = (float('nan'),) * 3
        self._portion: list[tuple[int, Vector, Vector]] = []

    def add(self, sample: ImuSample) -> None:
        """Take in a sample."""
        self.orientations += sample.orientation is not None
        if sample.linear_acceleration is not None:
            self._force = sample.linear_acceleration
            self._sum += self._force
            self._length += float(np.linalg.norm(self._force))
            self.forces += 1
        if sample.angular_velocity is None:
            return
        self._rates.add(*sample.angular_velocity)
        # The search for rest takes samples in the order of their stamps.
        if self._newest_ns is None or sample.stamp_ns > self._newest_ns:
            self._newest_ns = sample.stamp_ns
            self._portion.append((sample.stamp_ns, sample.angular_velocity, self._force))
            if len(self._portion) == _PORTION:
                self._search()

    @property
    def rates(self) -> Array:
        """Some of the gyro's rates (K, 3) [rad/s], evenly over the recording."""
        return self._rates.values

    @property
    def force(self) -> Array:
        """Mean specific force (3,) [m/s^2], IMU frame; NaN without accelerometer."""
        return self._sum / self.forces if self.forces else np.full(3, np.nan)

    @property
    def force_length(self) -> float:
        """Mean length of the specific force [m/s^2]; NaN without accelerometer."""
        return self._length / self.forces if self.forces else float('nan')

    def rest(self) -> GyroBias | None:
        """Mean rate while the IMU stood still; None where it never did."""
        self._search()
        rest = self._rest.estimate(self._newest_ns or 0)
        return rest if rest.sigma < _BIAS_SIGMA else None

    def _search(self) -> None:
        if self._portion:
            stamps, rates, forces = zip(*self._portion, strict=True)
            self._rest.run(np.array(stamps, dtype=np.int64), np.array(rates), np.array(forces))
            self._portion = []
