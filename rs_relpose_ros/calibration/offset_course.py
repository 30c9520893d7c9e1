"""The course of the time offset within a recording: steps and a drift of a clock.

The rotation of the images between neighbours is compared with the gyro at many offsets. One offset
for all images, a step at any time, and a drift are hypotheses about the same costs: the course
with steps is the cheapest path through the offsets (Viterbi), each step at a price. What is found
is a proposal, whose size the fit estimates and confirms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.core.losses import SIGMA_PER_MEDIAN
from rs_relpose_ros.geometry import Array

# Time [s] beside a step whose images are not used, on either side, beyond the step itself. Less
# would use images near a step that is not known to the image; more loses images.
# [chosen: an interval between frames at 30 Hz, and some]
_BESIDE = 0.05


@dataclass(frozen=True, slots=True)
class OffsetStep:
    """A step of the time offset."""

    begin: float  # times of images [s] between which the step is
    end: float
    seconds: float  # change of the offset
    sigma: float = math.inf  # of that change; infinite where it is only proposed

    @property
    def middle(self) -> float:
        """Time [s] from which on the offset counts as changed."""
        return 0.5 * (self.begin + self.end)


@dataclass(frozen=True, slots=True)
class OffsetCourse:
    """How the time offset changes within a recording, about its value at `origin`."""

    steps: tuple[OffsetStep, ...] = ()  # in the order of time
    drift: float = 0.0  # change per second [s/s]
    origin: float = 0.0  # time [s] of the images to which the offset refers

    @property
    def is_constant(self) -> bool:
        """Whether there is one offset for all images."""
        return not (self.steps or self.drift)

    def at(self, times: Array) -> Array:
        """Offsets of images at times of any shape [s], less the one at the origin."""
        total = self.drift * (times - self.origin)
        for step in self.steps:
            after = (times >= step.middle).astype(np.float64)
            total = total + step.seconds * (after - float(self.origin >= step.middle))
        return np.asarray(total, dtype=np.float64)

    def covariates(self, times: Array) -> Array:
        """Derivatives of these offsets by the change that a fit estimates.

        That is the step next to the origin [s], or the drift [s/s] without steps.
        """
        if not self.steps:
            return np.asarray(times - self.origin)
        border = self._nearest.middle
        after = (times >= border).astype(np.float64)
        return np.asarray(after - float(self.origin >= border))

    def changed(self, change: float) -> OffsetCourse:
        """The course after `change` of what the covariates stand for."""
        if not self.steps:
            return replace(self, drift=self.drift + change)
        nearest = self._nearest
        moved = replace(nearest, seconds=nearest.seconds + change)
        return replace(self, steps=tuple(moved if s is nearest else s for s in self.steps))

    def about(self, origin: float) -> OffsetCourse:
        """The same course with the offset of another time [s]."""
        return replace(self, origin=origin)

    @property
    def size(self) -> float:
        """Value of what the covariates stand for [s or s/s]."""
        return self._nearest.seconds if self.steps else self.drift

    def clear_of_steps(self, begins: Array, ends: Array) -> NDArray[np.bool_]:
        """Which of the spans of time of images (P,) [s] are beside all steps."""
        clear = np.ones(len(begins), dtype=bool)
        for step in self.steps:
            beside = abs(step.seconds) + _BESIDE
            clear &= (ends < step.begin - beside) | (begins > step.end + beside)
        return clear

    @property
    def _nearest(self) -> OffsetStep:
        return min(self.steps, key=lambda step: abs(step.middle - self.origin))


# -- Search by the rotation between neighbours --------------------------------------------------

# Largest change of the offset that is looked for [s]. A longer range finds larger steps, and costs
# time. [chosen: the steps of user reports are below 0.5 s]
_RANGE = 0.7
# Interval of the offsets that are compared [s]. A longer one would miss an optimum, a shorter one
# costs time; the fit refines them. [chosen: as the search of one offset]
_INTERVAL = 5e-3
# Sigmas beyond which a pair counts as an outlier. [chosen: 3, as in the fit]
_ROBUST = 3.0
# Neighbours that count as one: a translation that is no part of the model lasts as long. Fewer
# would find steps in correct recordings, more would miss steps. [chosen: a fifth of a second]
_ALIKE = 6.0
# Price of a step in log-likelihood. Less would find steps by chance, more would miss small ones,
# which the trends of the fit show. [chosen: odds of a step in a recording of 1 to 100, times a
# thousand places]
_PRICE = 12.0
# Smallest change [s] that is proposed. Smaller ones are left to the trends of the fit.
# [chosen: three intervals]
_SMALLEST = 0.015
# Loss of log-likelihood within which the place of a step is not known. [derived: 3 sigmas]
_NOT_KNOWN = 4.5
# Largest drift that is compared [s/s]. A larger one costs time. [chosen: twice a bad clock]
_MOST_DRIFT = 2e-3
# Least noise of the rate of a pair [rad/s]. [chosen: below that of any tracker]
_LEAST_NOISE = 1e-3
# Rounds of the noise and the mean, which depend on the course. [chosen: a third changes nothing]
_ROUNDS = 2


class RatesAtOffsets(NamedTuple):
    """Rates of the images between P neighbours, and those of the gyro at M offsets."""

    middles: Array  # (P,) times of the images [s], increasing
    offsets: Array  # (M,) [s], evenly `interval` apart
    images: Array  # (P, 3) [rad/s]
    gyro: Array  # (M, P, 3) in the axes of the camera; NaN where it is not known


def tried_offsets(near: float) -> Array:
    """Offsets [s] about one that is right for a part of the images."""
    count = round(_RANGE / _INTERVAL)
    return np.asarray(near + _INTERVAL * np.arange(-count, count + 1), dtype=np.float64)


def proposed(rates: RatesAtOffsets) -> OffsetCourse:
    """The course of the offset that explains the rates best, about the first image."""
    left = rates.images - rates.gyro
    path = np.full(len(rates.middles), len(rates.offsets) // 2)
    course = OffsetCourse()
    for _ in range(_ROUNDS):
        costs = _costs(left, path)
        drift, gain_of_drift, drifting = _best_drift(costs, rates.middles)
        stepping, gain_of_steps = _cheapest(costs)
        if max(gain_of_drift, gain_of_steps) <= 0.0:
            return OffsetCourse()
        if gain_of_drift >= gain_of_steps:
            path = drifting
            course = OffsetCourse(drift=drift)
        else:
            path = stepping
            course = OffsetCourse(_steps(costs, path, rates))
    return course


def _costs(left: Array, path: NDArray[np.int64]) -> Array:
    """Minus the log-likelihoods (M, P) of the differences (M, P, 3), by their noise on a path."""
    on_path = left[path, np.arange(len(path))]
    is_known = np.isfinite(on_path).all(axis=1)
    known = on_path[is_known]
    mean = np.median(known, axis=0)
    deviation = float(np.median(np.abs(known - mean)))
    noise = max(SIGMA_PER_MEDIAN * deviation, _LEAST_NOISE)
    scaled = (left - mean) / noise
    squares = (scaled**2).sum(axis=2) / _ROBUST**2
    squares[~np.isfinite(squares)] = np.inf
    # The loss of Geman and McClure, q / (1 + q), which is 1 where nothing is known.
    losses = 1.0 - 1.0 / (1.0 + squares)
    return np.asarray(0.5 * _ROBUST**2 / _ALIKE * losses)


def _cheapest(costs: Array) -> tuple[NDArray[np.int64], float]:
    """Cheapest path (P,) through the offsets (M, P), and its gain over the best single one."""
    count, pairs = costs.shape
    total = costs[:, 0].copy()
    came = np.empty((pairs, count), dtype=np.int64)
    stay = np.arange(count)
    for p in range(1, pairs):
        best = int(np.argmin(total))
        after_jump = total[best] + _PRICE
        jumps = total > after_jump
        came[p] = np.where(jumps, best, stay)
        total = np.minimum(total, after_jump) + costs[:, p]
    path = np.empty(pairs, dtype=np.int64)
    path[-1] = int(np.argmin(total))
    for p in range(pairs - 1, 0, -1):
        path[p - 1] = came[p, path[p]]
    of_one_offset = costs.sum(axis=1)
    return path, float(of_one_offset.min() - total.min())


def _best_drift(costs: Array, middles: Array) -> tuple[float, float, NDArray[np.int64]]:
    """Drift [s/s], its gain over one offset beyond its price, and its path (P,)."""
    count, pairs = costs.shape
    since = middles - middles.mean()
    duration = max(float(np.ptp(middles)), _INTERVAL)
    step = 2.0 * _INTERVAL / duration
    most = math.floor(min(_MOST_DRIFT, 0.5 * _RANGE / duration) / step)
    best = (0.0, -math.inf, np.zeros(pairs, dtype=np.int64))
    constant = float(costs.sum(axis=1).min())
    for number in range(-most, most + 1):
        if not number:
            continue
        drift = number * step
        shifts = np.rint(drift * since / _INTERVAL).astype(np.int64)
        largest = np.abs(shifts).max()
        starts = np.arange(largest, count - largest)
        places = starts[:, None] + shifts
        totals = costs[places, np.arange(pairs)].sum(axis=1)
        cheapest = int(np.argmin(totals))
        gain = constant - float(totals[cheapest]) - _PRICE
        if gain > best[1]:
            best = drift, gain, places[cheapest]
    return best


def _steps(costs: Array, path: NDArray[np.int64], rates: RatesAtOffsets) -> tuple[OffsetStep, ...]:
    """The steps of a path (P,), each with the images between which it may be."""
    changes = np.flatnonzero(np.diff(path)) + 1
    borders = [0, *changes.tolist(), len(path)]
    middles = rates.middles
    found = []
    for begin, border, end in zip(borders, borders[1:], borders[2:], strict=False):
        before = path[begin]
        after = path[border]
        seconds = float(rates.offsets[after] - rates.offsets[before])
        if abs(seconds) < _SMALLEST:
            continue
        differences = costs[before, begin:end] - costs[after, begin:end]
        first, last = _place(differences)
        # One image more at the begin: the rates are those between images.
        first = max(begin + first - 1, 0)
        last = min(begin + last, len(path) - 1)
        step = OffsetStep(float(middles[first]), float(middles[last]), seconds)
        found.append(step)
    return tuple(found)


def _place(differences: Array) -> tuple[int, int]:
    """First and last number of the pairs (N,) before which the step may be.

    `differences` are the costs of the offset before the step less those of the offset after it.
    """
    # Cost of a border before each pair, but for a constant.
    at_border = np.cumsum(differences) - differences
    likely = np.flatnonzero(at_border <= at_border.min() + _NOT_KNOWN)
    return int(likely[0]), int(likely[-1])
