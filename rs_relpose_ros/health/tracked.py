"""Figures that are followed while running, and what of them is applied: a little per pair."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.parameters import SensorConfig
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.health.deviation import BIAS, OFFSET, READOUT
from rs_relpose_ros.health.recursion import Calibration

Array = NDArray[np.float64]

# 1 sigma [s] from which on a figure is applied.
_APPLIED_SIGMA = 2e-3
# Largest offset that is applied [s], and largest change of it [s per pair].
_LARGEST, _LARGEST_STEP = 0.05, 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """Figures as seen after the pairs so far."""

    gyro_bias: Array   # (3,) [rad/s], IMU frame; the bias as a whole, not what is left of it
    gyro_bias_sigma: Array
    time_offset: float   # [s] IMU clock minus camera clock, as the parameter of this name
    time_offset_sigma: float
    pairs: int   # that take part

    @classmethod
    def of(cls, seen: Calibration, sensor: SensorConfig, gyro_bias: Array,
           middle_share: float) -> Tracked:
        """Absolute values: what was told, and the deviation that was seen.

        `middle_share`: rows from the stamped to the middle row, as a share of the read-out. The
        offset is the one that puts the middle row where it is seen, with the read-out as told.
        """
        along = np.zeros(len(seen.c))
        along[OFFSET], along[READOUT] = 1.0, middle_share
        return cls(gyro_bias + seen.c[BIAS], seen.sigma[BIAS],
                   sensor.time_offset + float(along @ seen.c),
                   math.sqrt(float(along @ seen.covariance @ along)), seen.pairs)


@dataclass(frozen=True, slots=True)
class Applied:
    """Deviations that the next frames get, beyond the parameters."""

    time_offset: float = 0.0   # [s]

    @property
    def time_offset_ns(self) -> int:
        """As whole nanoseconds."""
        return to_nanoseconds(self.time_offset)

    def moved(self, seen: Tracked, told: float, *, track_offset: bool) -> Applied:
        """One step towards what is seen, or back to none where it is not to be followed.

        `told` [s]: the parameter time_offset.
        """
        known = seen.time_offset_sigma < _APPLIED_SIGMA
        wanted = (seen.time_offset - told if known else self.time_offset) if track_offset else 0.0
        return replace(self, time_offset=_stepped(self.time_offset, wanted))


NOTHING_APPLIED = Applied()


def _stepped(value: float, target: float) -> float:
    target = min(max(target, -_LARGEST), _LARGEST)
    return value + min(max(target - value, -_LARGEST_STEP), _LARGEST_STEP)
