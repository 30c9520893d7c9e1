"""Matches between the reference keyframe and the current frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Points of two images that show the same thing.

    Attributes
    ----------
    track_ids : (N,) ndarray of uint32
        Unique within a pair; the same for the same track in all pairs.
    points1, points2 : (N, 2) ndarray
        Raw pixels in the reference keyframe and in the current frame.
    quality : (N,) ndarray
        In [0, 1]; higher is more trustworthy.
    """

    track_ids: NDArray[np.uint32]
    points1: Array
    points2: Array
    quality: Array

    def __len__(self) -> int:
        return len(self.track_ids)
