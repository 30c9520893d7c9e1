"""Tracks that are matched in several frames, on their way from the tracker to the messages."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry import Array

Ids = NDArray[np.uint32]


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Points of N tracks in V frames; read-only.

    A tracker matches two frames, the reference keyframe and the current one: V is 2. For an
    estimate, frames between the two are added in the order of time, and a point is NaN in a frame
    where its track was lost.
    """

    track_ids: Ids  # (N,) the same for the same track in all pairs
    points: Array  # (V, N, 2) raw pixels
    quality: Array  # (N,) in [0, 1], higher is better
    # The next two are empty until the gyro derotates the matches.
    rays: Array = field(default_factory=lambda: np.empty((0, 0, 3)))  # (V, N, 3) unit
    row_times: Array = field(default_factory=lambda: np.empty((0, 0)))  # (V, N) [s] from the
    # stamped row, in whose camera frame the rays are

    @classmethod
    def none(cls) -> Matches:
        """No matches of two frames."""
        return cls(np.empty(0, dtype=np.uint32), np.empty((2, 0, 2)), np.empty(0))

    def __len__(self) -> int:
        return len(self.track_ids)

    @property
    def points1(self) -> Array:
        """Pixels (N, 2) in the first frame, the reference keyframe of a pair."""
        return np.asarray(self.points[0])

    @property
    def points2(self) -> Array:
        """Pixels (N, 2) in the last frame, the current one of a pair."""
        return np.asarray(self.points[-1])

    def followed(self, points2: Array) -> Matches:
        """The same tracks of two frames with other points (N, 2) in the second one."""
        return replace(self, points=np.stack([self.points1, points2]))

    def kept(self, mask: NDArray[np.bool_]) -> Matches:
        """The tracks of a mask (N,)."""
        return Matches(
            self.track_ids[mask],
            # In the order of memory that compiled functions expect.
            self.points.compress(mask, axis=1),
            self.quality[mask],
        )
