"""How far image stamps scatter about an even rhythm: phones stamp some ms early or late."""

from __future__ import annotations

from collections import deque

import numpy as np

from rs_relpose_ros.geometry.timing import NANOSECONDS

_FRAMES = 32
# Intervals below this quantile of theirs hold no lost frame.
_WHOLE = 0.25
# A larger scatter, as a share of the interval, is a camera without a rhythm.
_LARGEST_SHARE = 0.1


class StampScatter:
    """Scatter of the last stamps.

    Their intervals d_i, frames that were lost between two of them taken out, change by
    ``d_i+1 - d_i = e_i+2 - 2 e_i+1 + e_i`` for errors e of the stamps: six times their variance.
    A rhythm that changes, as by auto exposure, shows in one of these differences only; hence their
    mean magnitude and not their variance.
    """

    def __init__(self) -> None:
        self._stamps_ns: deque[int] = deque(maxlen=_FRAMES)

    def reset(self) -> None:
        """Forget all stamps."""
        self._stamps_ns.clear()

    def add(self, stamp_ns: int) -> None:
        """Take in the next frame's stamp."""
        self._stamps_ns.append(stamp_ns)

    @property
    def sigma(self) -> float:
        """1 sigma of a stamp [s]; 0 as long as there are too few to show any."""
        intervals = np.diff(np.array(self._stamps_ns)) / NANOSECONDS
        if len(intervals) < 2:
            return 0.0
        period = float(np.quantile(intervals, _WHOLE, method='lower'))
        if not period > 0.0:
            return 0.0
        changes = np.diff(intervals - np.round(intervals / period) * period)
        # Mean magnitude of a normal variable: sqrt(2 / pi) sigma.
        sigma = float(np.sqrt(np.pi / 2.0) * np.abs(changes).mean() / np.sqrt(6.0))
        return min(sigma, _LARGEST_SHARE * period)
