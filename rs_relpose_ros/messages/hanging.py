"""Sensors that hang or are saturated: they repeat their values bit by bit, which noise never does.

Repeated values under new stamps would give wrong poses that look good.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.imu.samples import ImuSample

# Every so many bytes of two images are compared first: nearly always one of them differs.
_STRIDE = 1009
# Fewest equal samples of a hanging gyro: two or three of a slow one may be equal by chance.
_FEWEST_SAMPLES = 4
# Smallest range of a gyro [rad/s]: no product has less than 125 deg/s.
_LEAST_RANGE = 2.0
# Smallest value [rad/s] at which a driver or filter clips: it is the largest value seen so far,
# and larger than the bias that a gyro of coarse resolution repeats at rest.
_LEAST_CLIPPING = 0.2


class HangingCamera:
    """Compares each image, as it came, with the one before."""

    def __init__(self) -> None:
        self._previous: NDArray[np.uint8] | None = None
        self._stamp_ns = 0

    def problem(self, stamp_ns: int, data: NDArray[np.uint8]) -> str:
        """Why an image message's data (K,) shows nothing new; empty for no reason."""
        previous, self._previous = self._previous, data
        # A message that is delivered twice is no fault of the camera.
        again, self._stamp_ns = stamp_ns == self._stamp_ns, stamp_ns
        if (previous is not None and not again and len(previous) == len(data)
                and np.array_equal(previous[::_STRIDE], data[::_STRIDE])
                and np.array_equal(previous, data)):
            return ('the image repeats the one before bit by bit: the camera or its driver hangs, '
                    'or shows nothing at all')
        return ''


class HangingGyro:
    """Watches the gyro samples as they come.

    Repetitions are not used from the first one on: between equal values interpolation gives the
    same, if they were true, and drivers that publish faster than the sensor measures do repeat.
    After `longest` [s] repetitions are a fault; 0 believes everything.
    """

    def __init__(self, longest: float) -> None:
        self._longest_ns = to_nanoseconds(longest)
        self._values = [math.nan] * 3
        self._largest = [0.0] * 3
        self._since_ns = [0] * 3
        self._counts = [0] * 3

    def repeats(self, sample: ImuSample) -> bool:
        """Whether this sample says nothing new; InputError where that lasts too long."""
        if sample.angular_velocity is None or self._longest_ns == 0:
            return False
        for axis, value in enumerate(sample.angular_velocity):
            # After the clock was set back the time of repetition counts from here.
            if value != self._values[axis] or sample.stamp_ns < self._since_ns[axis]:
                self._values[axis], self._since_ns[axis] = value, sample.stamp_ns
                self._counts[axis] = 0
            self._counts[axis] += 1
            self._largest[axis] = max(self._largest[axis], abs(value))
        if min(self._counts) > 1:
            if self._too_long(sample, max(self._since_ns), min(self._counts)):
                raise InputError('the gyro repeats the same values bit by bit: it hangs (set '
                                 'stuck_gyro_time to 0 for a simulation without noise)')
            return True
        for name, value, largest, since_ns, count in zip(
                'xyz', sample.angular_velocity, self._largest, self._since_ns, self._counts,
                strict=True):
            if count > 1 and abs(value) >= min(_LEAST_RANGE, max(_LEAST_CLIPPING, largest)):
                if self._too_long(sample, since_ns, count):
                    raise InputError(f'the {name} axis of the gyro repeats {value:.4g} rad/s bit '
                                     'by bit: it is saturated')
                return True
        return False

    def _too_long(self, sample: ImuSample, since_ns: int, count: int) -> bool:
        return count >= _FEWEST_SAMPLES and sample.stamp_ns - since_ns > self._longest_ns
