"""Matches between the reference keyframe and the current frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Points of two images that show the same thing; the arrays are not written to."""

    track_ids: NDArray[np.uint32]   # (N,) the same for the same track in all pairs
    points1: Array   # (N, 2) raw pixels in the reference keyframe
    points2: Array   # (N, 2) and in the current frame
    quality: Array   # (N,) in [0, 1]; higher is more trustworthy

    @classmethod
    def none(cls) -> Matches:
        """No matches."""
        return cls(np.empty(0, dtype=np.uint32), np.empty((0, 2)), np.empty((0, 2)), np.empty(0))

    def __len__(self) -> int:
        return len(self.track_ids)

    def kept(self, mask: NDArray[np.bool_]) -> Matches:
        """Those of a mask (N,)."""
        return Matches(self.track_ids[mask], self.points1[mask], self.points2[mask],
                       self.quality[mask])


class TrackIds:
    """Ids of tracks: counted up, over all resets of a tracker."""

    def __init__(self) -> None:
        self._next = 0

    def take(self, count: int) -> NDArray[np.uint32]:
        """Ids (count,) that were not given before; from 2^32 on they start again."""
        ids = (np.arange(self._next, self._next + count) % 2**32).astype(np.uint32)
        self._next += count
        return ids
