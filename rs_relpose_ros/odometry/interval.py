"""IMU samples between two instants."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry.gyro import integrated_rotations

Array = NDArray[np.float64]

# Largest standard deviation at rest, per axis [rad/s], [m/s^2]: as of the bias tracker.
_REST_RATE, _REST_FORCE = 0.01, 0.1
_LEAST_SAMPLES = 10


class ImuInterval(NamedTuple):
    """Seconds (K,) from the first instant, rates and forces (K, 3) in the IMU frame."""

    seconds: Array
    rates: Array
    forces: Array

    @property
    def duration(self) -> float:
        """From the first to the last sample [s]."""
        return float(self.seconds[-1] - self.seconds[0])

    @property
    def at_rest(self) -> bool:
        """Whether gyro and accelerometer hardly vary."""
        return bool(len(self.seconds) >= _LEAST_SAMPLES
                    and self.rates.std(axis=0).max() < _REST_RATE
                    and self.forces.std(axis=0).max() < _REST_FORCE)

    def mean_force(self, gyro_bias: Array) -> Array:
        """Mean specific force (3,) in the axes of the last instant."""
        rotations = integrated_rotations(self.seconds, np.ascontiguousarray(
            self.rates - gyro_bias))
        mean = np.einsum('kij,kj->i', rotations, self.forces) / len(self.forces)
        return np.asarray(rotations[-1].T @ mean)
