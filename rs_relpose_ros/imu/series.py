"""Stamped vectors in the order of their stamps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Series:
    """Stamped vectors (K, width) in the order of their stamps, in growing contiguous arrays."""

    def __init__(self, width: int = 3) -> None:
        self._stamps = np.empty(256, dtype=np.int64)
        self._values = np.empty((256, width))
        self._start = 0
        self._end = 0

    @property
    def stamps(self) -> NDArray[np.int64]:
        """Stamps (K,) [ns], strictly increasing; a view that the next insertion may change."""
        return self._stamps[self._start:self._end]

    @property
    def values(self) -> Array:
        """Values (K, width); such a view, too."""
        return self._values[self._start:self._end]

    @property
    def newest_ns(self) -> int | None:
        """The last stamp; None without any."""
        return int(self._stamps[self._end - 1]) if self._end > self._start else None

    def insert(self, stamp_ns: int, value: tuple[float, ...] | None) -> bool:
        """Insert in order; False for no value, and for a stamp that is there already."""
        if value is None:
            return False
        stamps = self.stamps
        position = len(stamps)
        if position and stamp_ns <= stamps[-1]:
            position = int(np.searchsorted(stamps, stamp_ns))
            if stamps[position] == stamp_ns:
                return False
        if self._end == len(self._stamps):
            self._make_room()
        at = self._start + position
        self._stamps[at + 1:self._end + 1] = self._stamps[at:self._end]
        self._values[at + 1:self._end + 1] = self._values[at:self._end]
        self._stamps[at], self._values[at] = stamp_ns, value
        self._end += 1
        return True

    def prune(self, before_ns: int) -> None:
        """Forget samples before `before_ns`, but for the last of them: borders interpolate."""
        keep = int(np.searchsorted(self.stamps, before_ns, side='right')) - 1
        if keep > 0:
            self._start += keep

    def between(self, start_ns: int, end_ns: int) -> tuple[NDArray[np.int64], Array]:
        """Stamps and values from `start_ns` to `end_ns`, both within the series.

        The values at the two borders are interpolated; one entry where they are equal.
        """
        inner = slice(int(np.searchsorted(self.stamps, start_ns, side='right')),
                      int(np.searchsorted(self.stamps, end_ns, side='left')))
        borders = np.unique(np.array([start_ns, end_ns], dtype=np.int64))
        values = np.array([self._interpolated(int(border)) for border in borders])
        return (np.concatenate([borders[:1], self.stamps[inner], borders[1:]]),
                np.concatenate([values[:1], self.values[inner], values[1:]]))

    def _interpolated(self, at_ns: int) -> Array:
        stamps, values = self.stamps, self.values
        after = int(np.searchsorted(stamps, at_ns))
        if stamps[after] == at_ns:
            return values[after]
        before = after - 1
        fraction = (at_ns - stamps[before]) / (stamps[after] - stamps[before])
        return np.asarray(values[before] + fraction * (values[after] - values[before]))

    def _make_room(self) -> None:
        count = self._end - self._start
        size = max(256, 2 * count)
        stamps = np.empty(size, dtype=np.int64)
        values = np.empty((size, self._values.shape[1]))
        stamps[:count], values[:count] = self.stamps, self.values
        self._stamps, self._values, self._start, self._end = stamps, values, 0, count
