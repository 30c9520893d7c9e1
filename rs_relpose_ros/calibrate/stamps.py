"""What the stamps of the frames tell: exposure that changes, or stamps that jitter.

Both make the offset of a frame depend on the interval T to the frame before it, by about the same
-0.5: a driver that stamps a fixed instant of a longer and longer exposure, and a stamp that is
late by d, after which T is longer by d and the offset less by d. Only the first is the camera's.
They differ in time: automatic exposure keeps an interval for many frames (successive T are alike),
while jitter makes one interval longer and the next one shorter (their correlation is -0.5).
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry.timing import FrameIntervals, NANOSECONDS

Array = NDArray[np.float64]

# Intervals that differ by more than this share may have exposures that differ.
_VARYING = 0.02
# Correlation of successive intervals beyond which, up or down, they are told apart.
_TOLD_APART = 0.15
# Steps of so many medians have an image missing.
_MISSING = 1.8
# The smooth line: straight within so many frames (1 sigma of the weights).
_SMOOTH = 10.0


class Varying(str, Enum):
    """Why the intervals between frames vary."""

    NOT = 'not'             # all are alike
    EXPOSURE = 'exposure'
    JITTER = 'jitter'
    UNCLEAR = 'unclear'


class FrameTimes(NamedTuple):
    """Why the intervals vary, and what the offset of F frames may follow."""

    varying: Varying
    # (F,) [s]: T less its median where the exposure varies, the smooth line less the stamp where
    # stamps jitter; otherwise zero.
    covariates: Array
    jitter: float           # rms of the stamps about the smooth line [s]; 0 unless they jitter


def frame_times(stamps_ns: NDArray[np.int64]) -> FrameTimes:
    """What F stamps [ns] tell; at least two."""
    count, tracker = len(stamps_ns), FrameIntervals()
    kept = [tracker.add(int(stamp)) for stamp in stamps_ns]
    intervals = np.array(kept[1:], dtype=np.float64) / NANOSECONDS
    median = float(np.median(np.diff(stamps_ns))) / NANOSECONDS
    # As the node takes it: the first frame has no T, and so none that differs.
    longer = np.concatenate([[0.0], intervals - median])
    none = FrameTimes(Varying.NOT, np.zeros(count), 0.0)
    low, high = np.quantile(longer, (0.1, 0.9))
    if high - low <= _VARYING * median:
        return none
    correlation = _of_successive(np.diff(stamps_ns) / NANOSECONDS / median)
    if correlation > _TOLD_APART:
        return FrameTimes(Varying.EXPOSURE, longer, 0.0)
    if correlation < -_TOLD_APART:
        late = _smooth(stamps_ns, median)
        return FrameTimes(Varying.JITTER, late, float(np.sqrt((late**2).mean())))
    return none._replace(varying=Varying.UNCLEAR)


def _of_successive(steps: Array) -> float:
    """Correlation of successive steps, shares of their median; with no image missing between."""
    whole = steps < _MISSING
    if not whole.any():
        return 0.0
    # A few frames, as those of a camera that has just been started, must not decide.
    low, high = np.quantile(steps[whole], (0.05, 0.95))
    deviations = np.clip(steps, low, high)
    deviations -= deviations[whole].mean()
    both = whole[1:] & whole[:-1]
    first, second = deviations[:-1][both], deviations[1:][both]
    return float(first @ second) / max(0.5 * float(first @ first + second @ second), 1e-24)


def _smooth(stamps_ns: NDArray[np.int64], interval: float) -> Array:
    """A smooth line through the stamps less the stamps (F,) [s]: straight near each frame."""
    times = (stamps_ns - stamps_ns[0]) / NANOSECONDS
    numbers = np.concatenate([[0.0], np.cumsum(np.maximum(
        np.rint(np.diff(times) / interval), 1.0))])
    smooth = np.empty(len(times))
    for k, number in enumerate(numbers):
        apart = numbers - number
        line = np.polynomial.polynomial.polyfit(apart, times, 1,
                                                w=np.exp(-0.25 * (apart / _SMOOTH) ** 2))
        smooth[k] = line[0]
    return smooth - times
