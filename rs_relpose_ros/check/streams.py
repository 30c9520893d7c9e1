"""Statistics of streams of any length in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass
import heapq

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_KEPT = 8192
_LONGEST_KEPT = 4096


class Thinned:
    """Every n-th value of a stream; n doubles whenever too many have come.

    Parameters
    ----------
    width : int
        Numbers per value.
    """

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


@dataclass(frozen=True, slots=True)
class StampSummary:
    """Stamps of a topic.

    Attributes
    ----------
    count : int
    first_ns, last_ns : int
        Smallest and largest stamp.
    interval : float
        Median of the steps between consecutive messages [s]; NaN of fewer than two.
    jitter : float
        Their spread, 1.48 times the median deviation [s].
    repeated, backwards : int
        Steps of zero, and back in time.
    furthest_back : float
        The largest of the latter [s].
    delay : float
        Median of recording time minus stamp [s].
    """

    count: int
    first_ns: int
    last_ns: int
    interval: float
    jitter: float
    repeated: int
    backwards: int
    furthest_back: float
    delay: float

    @property
    def duration(self) -> float:
        """From the smallest to the largest stamp [s]."""
        return (self.last_ns - self.first_ns) * 1e-9


class Stamps:
    """Takes in the stamps of a topic in the order of recording."""

    def __init__(self) -> None:
        self._count = self._repeated = self._backwards = self._furthest_back = 0
        self._first_ns = self._last_ns = 0
        self._before_ns: int | None = None
        self._steps, self._delays = Thinned(), Thinned()
        self._longest: list[int] = []

    def add(self, stamp_ns: int, recorded_ns: int) -> None:
        """Take in the next message."""
        self._count += 1
        self._delays.add((recorded_ns - stamp_ns) * 1e-9)
        if self._before_ns is None:
            self._first_ns = self._last_ns = self._before_ns = stamp_ns
            return
        step = stamp_ns - self._before_ns
        self._before_ns = stamp_ns
        self._first_ns, self._last_ns = min(self._first_ns, stamp_ns), max(self._last_ns, stamp_ns)
        if step == 0:
            self._repeated += 1
        elif step < 0:
            self._backwards += 1
            self._furthest_back = max(self._furthest_back, -step)
        else:
            self._steps.add(step * 1e-9)
            if len(self._longest) < _LONGEST_KEPT:
                heapq.heappush(self._longest, step)
            else:
                heapq.heappushpop(self._longest, step)

    def summary(self) -> StampSummary:
        """Figures of what came so far."""
        steps = self._steps.values
        median = float(np.median(steps)) if len(steps) else float('nan')
        return StampSummary(
            count=self._count, first_ns=self._first_ns, last_ns=self._last_ns, interval=median,
            jitter=1.4826 * float(np.median(np.abs(steps - median))) if len(steps) else 0.0,
            repeated=self._repeated, backwards=self._backwards,
            furthest_back=self._furthest_back * 1e-9,
            delay=float(np.median(self._delays.values)) if self._count else float('nan'))

    def longer_than(self, seconds: float) -> tuple[int, float]:
        """Number of steps that are longer (at most some thousand are told) and the longest [s]."""
        steps = np.array(self._longest) * 1e-9
        return int((steps > seconds).sum()), float(steps.max()) if len(steps) else 0.0
