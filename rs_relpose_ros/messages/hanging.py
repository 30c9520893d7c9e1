"""Sensors that hang or are saturated: they repeat themselves bit by bit, which noise never does.

What they say under ever new stamps would make wrong poses that look good.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.timing import to_nanoseconds

_AXES = 'xyz'
# Drivers that publish faster than the sensor samples repeat a value now and then.
_FEWEST_SAMPLES = 4
# No gyro has a range below 125 deg/s; a coarse one repeats small values at rest.
_LEAST_RANGE = 2.0


class HangingCamera:
    """Compares each image with the one before."""

    def __init__(self) -> None:
        self._previous: NDArray[np.uint8] | None = None

    def problem(self, image: NDArray[np.uint8]) -> str:
        """Why this image (H, W) shows nothing new; empty for no reason."""
        previous, self._previous = self._previous, image
        # A few rows tell nearly always.
        if (previous is not None and previous.shape == image.shape
                and np.array_equal(previous[::32], image[::32])
                and np.array_equal(previous, image)):
            return ('the image repeats the one before bit by bit: the camera or its driver hangs, '
                    'or shows nothing at all')
        return ''


class HangingGyro:
    """Watches the gyro samples as they come.

    Parameters
    ----------
    longest : float
        Time [s] for which values may repeat; 0 to find nothing.
    """

    def __init__(self, longest: float) -> None:
        self._longest_ns = to_nanoseconds(longest)
        self._values = [math.nan] * 3
        self._since_ns = [0] * 3
        self._counts = [0] * 3

    def problem(self, sample: ImuSample) -> str:
        """Why the gyro of this sample cannot be believed; empty for no reason."""
        if sample.angular_velocity is None or self._longest_ns == 0:
            return ''
        repeats = []
        for axis, value in enumerate(sample.angular_velocity):
            # Also a clock that was set back begins anew.
            if value != self._values[axis] or sample.stamp_ns < self._since_ns[axis]:
                self._values[axis], self._since_ns[axis] = value, sample.stamp_ns
                self._counts[axis] = 0
            self._counts[axis] += 1
            repeats.append(self._counts[axis] >= _FEWEST_SAMPLES
                           and sample.stamp_ns - self._since_ns[axis] > self._longest_ns)
        if all(repeats):
            return ('the gyro repeats the same values bit by bit: it hangs (set stuck_gyro_time '
                    'to 0 for a simulation without noise)')
        for axis, (value, repeated) in enumerate(
                zip(sample.angular_velocity, repeats, strict=True)):
            if repeated and abs(value) >= _LEAST_RANGE:
                return (f'the {_AXES[axis]} axis of the gyro repeats {value:.4g} rad/s bit by '
                        'bit: it is saturated')
        return ''
