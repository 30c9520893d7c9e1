"""Statistics of streams of any length in bounded memory."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_KEPT = 8192
_LONGEST_KEPT = 4096


class Thinned:
    """Every n-th value, of `width` numbers, of a stream; n doubles whenever too many have come."""

    def __init__(self, width: int = 1) -> None:
        self._values = np.empty((2 * _KEPT, width))
        self._kept = self._skipped = 0
        self._every = 1

    def add(self, *value: float) -> None:
        """Take in the next value."""
        self._skipped += 1
        if self._skipped < self._every:
            return
        self._skipped = 0
        self._values[self._kept] = value
        self._kept += 1
        if self._kept == len(self._values):
            self._values[:_KEPT] = self._values[::2].copy()
            self._kept = _KEPT
            self._every *= 2

    @property
    def values(self) -> Array:
        """What is kept, (K, width)."""
        return self._values[:self._kept]


class Stamps:
    """Stamps of a topic, in the order of recording."""

    def __init__(self) -> None:
        self.count = 0
        self.first_ns = self.last_ns = 0         # smallest and largest stamp
        self.repeated = self.backwards = 0       # steps of zero, and back in time
        self.furthest_back = 0.0                 # largest of the latter [s]
        self._before_ns: int | None = None
        self._steps, self._delays = Thinned(), Thinned()
        self._longest: list[int] = []

    def add(self, stamp_ns: int, recorded_ns: int) -> None:
        """Take in the next message."""
        self.count += 1
        self._delays.add((recorded_ns - stamp_ns) * 1e-9)
        if self._before_ns is None:
            self.first_ns = self.last_ns = self._before_ns = stamp_ns
            return
        step = stamp_ns - self._before_ns
        self._before_ns = stamp_ns
        self.first_ns, self.last_ns = min(self.first_ns, stamp_ns), max(self.last_ns, stamp_ns)
        if step == 0:
            self.repeated += 1
        elif step < 0:
            self.backwards += 1
            self.furthest_back = max(self.furthest_back, -step * 1e-9)
        else:
            self._steps.add(step * 1e-9)
            if len(self._longest) < _LONGEST_KEPT:
                heapq.heappush(self._longest, step)
            else:
                heapq.heappushpop(self._longest, step)

    @property
    def interval(self) -> float:
        """Median of the steps forwards [s]; NaN where there is none."""
        steps = self._steps.values
        return float(np.median(steps)) if len(steps) else float('nan')

    @property
    def jitter(self) -> float:
        """Spread of these steps, 1.48 times the median deviation [s]."""
        steps = self._steps.values
        return 1.4826 * float(np.median(np.abs(steps - self.interval))) if len(steps) else 0.0

    @property
    def delay(self) -> float:
        """Median of recording time minus stamp [s]; NaN without a message."""
        return float(np.median(self._delays.values)) if self.count else float('nan')

    @property
    def duration(self) -> float:
        """From the smallest to the largest stamp [s]."""
        return (self.last_ns - self.first_ns) * 1e-9

    def longer_than(self, seconds: float) -> tuple[int, float]:
        """Number of steps that are longer (at most some thousand are told) and the longest [s]."""
        steps = np.array(self._longest) * 1e-9
        return int((steps > seconds).sum()), float(steps.max()) if len(steps) else 0.0
