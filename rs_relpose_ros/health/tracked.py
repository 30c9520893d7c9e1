"""Figures that are followed while running, and what of them is applied: a little per pair."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.parameters import SensorConfig
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.health.deviation import BIAS, LARGEST_OFFSET, LARGEST_READOUT, OFFSET, READOUT
from rs_relpose_ros.health.judge import Told
from rs_relpose_ros.health.pair_information import middle_share
from rs_relpose_ros.health.recursion import Calibration

Array = NDArray[np.float64]

# 1 sigma [s] below which a figure is applied.
_APPLIED_SIGMA = 2e-3
# Largest changes of what is applied [s per pair].
_OFFSET_STEP, _READOUT_STEP = 1e-3, 5e-4


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """Figures as seen after the pairs so far."""

    gyro_bias: Array   # (3,) [rad/s], IMU frame; the bias as a whole, not what is left of it
    gyro_bias_sigma: Array
    time_offset: float   # [s] IMU clock minus camera clock, as the parameter of this name
    time_offset_sigma: float
    readout_time: float   # [s] as the parameter; negative where rows are read the other way
    readout_time_sigma: float
    pairs: int   # that take part

    @classmethod
    def of(cls, seen: Calibration, told: Told) -> Tracked:
        """Absolute values: what was told, and the deviation that was seen.

        The offset is the one that puts the middle row where it is seen, with the read-out that is
        in force.
        """
        along = np.zeros(len(seen.c))
        along[OFFSET], along[READOUT] = 1.0, middle_share(told.camera)
        offset = told.sensor.time_offset + float(along @ seen.c)
        signed = told.camera.line_delay * told.camera.height   # in force
        readout = signed - told.in_force[READOUT] + seen.c[READOUT]
        return cls(told.gyro_bias + seen.c[BIAS], seen.sigma[BIAS],
                   offset - along[READOUT] * float(told.in_force[READOUT]),
                   math.sqrt(float(along @ seen.covariance @ along)),
                   float(readout) * told.direction, float(seen.sigma[READOUT]), seen.pairs)


@dataclass(frozen=True, slots=True)
class Applied:
    """Deviations that the next frames get, beyond the parameters."""

    time_offset: float = 0.0   # [s]
    readout_time: float = 0.0   # [s]
    # [s] before the first and after the last row as told that the IMU must cover, too: a longer
    # read-out is applied to a keyframe that was taken before.
    margin: float = 0.0

    @property
    def time_offset_ns(self) -> int:
        """As whole nanoseconds."""
        return to_nanoseconds(self.time_offset)

    @property
    def margin_ns(self) -> int:
        """As whole nanoseconds."""
        return to_nanoseconds(self.margin)

    def moved(self, seen: Tracked, sensor: SensorConfig) -> Applied:
        """One step towards what is seen, or back to none where it is not to be followed."""
        offset = readout = 0.0
        if sensor.track_time_offset:
            known = seen.time_offset_sigma < _APPLIED_SIGMA
            offset = seen.time_offset - sensor.time_offset if known else self.time_offset
        if sensor.track_readout_time:
            told = sensor.readout_time or 0.0
            known = seen.readout_time_sigma < _APPLIED_SIGMA
            readout = max(seen.readout_time, 0.0) - told if known else self.readout_time
        # What the frames so far cover, and no more.
        readout = min(_stepped(self.readout_time, readout, LARGEST_READOUT, _READOUT_STEP),
                      self.margin)
        ahead = _READOUT_STEP if sensor.track_readout_time else 0.0
        return Applied(_stepped(self.time_offset, offset, LARGEST_OFFSET, _OFFSET_STEP),
                       readout, max(readout + ahead, 0.0))


NOTHING_APPLIED = Applied()


def _stepped(value: float, target: float, largest: float, step: float) -> float:
    target = min(max(target, -largest), largest)
    return value + min(max(target - value, -step), step)
