"""Interruptions of the IMU: a clock that is set, samples that are missing, times that are unknown.

Samples that are late fill a hole of the samples before; those of a clock that was set back do
not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import STANDARD_GRAVITY
from rs_relpose_ros.geometry.timing import seconds_between
from rs_relpose_ros.imu.buffer import ImuSample, ImuSamples, Series
from rs_relpose_ros.odometry.graph import KeyframeState, ROTATION, TRANSLATION, VELOCITY

# Largest delay of a message [ns]. With a smaller one samples of a busy driver are lost; a larger
# one delays each keyframe where a sample is missing. [chosen: 0.05 to 0.2 s: drivers are late by
# less]
LATE_NS = 100_000_000
# Consecutive samples at times of other samples from which the clock was set back. Fewer may be the
# messages of a second publisher, more would not show a small step. [chosen: 3 to 6 would do: at
# 200 Hz four are a step of 20 ms]
_SET_BACK = 4
# Usual steps between two samples above which one may be missing between them.
# [derived: halfway between one step and two]
_HOLE = 1.5
# Longest time of unknown length [s] over which a path goes on: later the attitude that is left is
# worse than that of a start by gravity. [chosen: 0.2 to 0.5 s: a hand turns by 0.1 to 0.3 rad]
LONGEST_UNKNOWN = 0.3
# Acceleration of a body meanwhile [m/s^2], 1 sigma. A smaller one would exclude motions of a hand.
# [derived: hand-held accelerations are 0.3 to 3 m/s^2 rms]
_ACCELERATION = 2.0
# Rate of it [rad/s] that is possible beyond the last one, 1 sigma. [derived: as of a hand]
_RATE = 0.5


class SampleOrder:
    """Keeps samples that belong to times of others until it is known what they are."""

    def __init__(self) -> None:
        self._kept: list[ImuSample] = []

    def add(self, sample: ImuSample, known: ImuSamples) -> tuple[Sequence[ImuSample], bool]:
        """The samples that can be stored now, and whether the clock was set back before them."""
        if _is_taken(sample, known):
            self._kept.append(sample)
            if len(self._kept) < _SET_BACK:
                return (), False
            kept, self._kept = self._kept, []
            return kept, True
        kept, self._kept = [*self._kept, sample], []
        return kept, False

    def clear(self) -> None:
        """Forget the samples that are not stored yet."""
        self._kept = []


def _is_taken(sample: ImuSample, known: ImuSamples) -> bool:
    """Whether there are samples around the time of one that leave no place for it."""
    series: Series = known.force
    value = sample.linear_acceleration
    if sample.angular_velocity is not None:
        series, value = known.gyro, sample.angular_velocity
    stamps = series.stamps
    if value is None or len(stamps) < _SET_BACK or sample.stamp_ns > stamps[-1]:
        return False
    after = int(stamps.searchsorted(sample.stamp_ns))
    if stamps[after] == sample.stamp_ns:
        return bool((series.values[after] != value).any())  # else it is repeated
    if after == 0:
        return bool(stamps[-1] - sample.stamp_ns > LATE_NS)
    usual = float(np.median(np.diff(stamps)))
    return bool(stamps[after] - stamps[after - 1] < _HOLE * usual)


class Interruption(NamedTuple):
    """A part of the IMU's time whose true duration is between 0 and that of the stamps."""

    last_ns: int  # of the last sample before it
    next_ns: int  # of the first sample after it, on a clock that may be another one

    @property
    def seconds(self) -> float:
        """The difference of the stamps, in which direction ever [s]."""
        return abs(seconds_between(self.last_ns, self.next_ns))


def first_gap(samples: ImuSamples, since_ns: int, longest_ns: int) -> Interruption | None:
    """The first gap after a time of either sensor that is longer than `longest_ns`, if any."""
    found = []
    for series in (samples.gyro, samples.force):
        stamps = series.stamps[max(series.number_until(since_ns) - 1, 0) :]
        numbers = np.flatnonzero(np.diff(stamps) > longest_ns)
        if len(numbers):
            k = int(numbers[0])
            found.append(Interruption(int(stamps[k]), int(stamps[k + 1])))
    if not found:
        return None
    # Both sensors are known before and after it.
    return Interruption(min(one.last_ns for one in found), max(one.next_ns for one in found))


def after_unknown_time(
    state: KeyframeState, seconds: float, rate: Array, *, passed: float
) -> KeyframeState:
    """A state after a time of at most `seconds`, of which the share `passed` is expected.

    `rate` (3,): of the body before [rad/s]. It moves on as before, within accelerations and rates
    of a hand.
    """
    along = seconds * (state.R.T @ state.velocity)
    turn = seconds * rate
    moved = 0.5 * _ACCELERATION * seconds**2
    faster = _ACCELERATION * seconds
    turned = _RATE * seconds
    covariance = state.covariance.copy()
    eye = np.eye(3)
    covariance[TRANSLATION, TRANSLATION] += np.outer(along, along) + moved**2 * eye
    covariance[ROTATION, ROTATION] += np.outer(turn, turn) + turned**2 * eye
    covariance[VELOCITY, VELOCITY] += faster**2 * eye
    position = state.position + passed * seconds * state.velocity
    return replace(state, position=position, covariance=covariance)


def acceleration(R: Array, force: Array) -> Array:
    """Acceleration (3,) in the world of a body of rotation R, by its specific force (3,)."""
    return np.asarray(R @ force - np.array([0.0, 0.0, STANDARD_GRAVITY]))
