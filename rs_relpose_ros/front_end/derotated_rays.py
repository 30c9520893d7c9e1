"""Rays of tracked points, turned to the stamped row of their image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.motion import FrameMotion

Array = NDArray[np.float64]
Ids = NDArray[np.uint32]


@dataclass(frozen=True, slots=True, eq=False)
class DerotatedRays:
    """Points of one image and what follows from them.

    Attributes
    ----------
    track_ids : (N,) ndarray of uint32
    points : (N, 2) ndarray
        Pixels of the published image.
    rays : (N, 3) ndarray
        Unit rays in the camera frame of the stamped row.
    row_times : (N,) ndarray
        From the stamped row [s].
    """

    track_ids: Ids
    points: Array
    rays: Array
    row_times: Array

    @classmethod
    def from_points(cls, track_ids: Ids, points: Array, camera: RollingShutterCamera,
                    calibration: Intrinsics, motion: FrameMotion) -> DerotatedRays:
        """Rays of points (N, 2) of a published image."""
        pixels = calibration.to_sensor(points)
        row_times = camera.row_times(pixels[:, 1])
        return cls(track_ids, points, motion.derotate(camera.unproject(pixels), row_times),
                   row_times)

    def of(self, track_ids: Ids) -> DerotatedRays | None:
        """Those of some of the tracks, in the same order; None where one is missing."""
        rows = _positions(self.track_ids, track_ids)
        if len(rows) < len(track_ids):
            return None
        if len(rows) == len(self.track_ids):
            return self
        return DerotatedRays(self.track_ids[rows], self.points[rows], self.rays[rows],
                             self.row_times[rows])


@kernel
def _positions(ids: Ids, wanted: Ids) -> NDArray[np.int64]:
    """Where the `wanted` stand among the ids, up to the first one that is not there in order."""
    found = np.empty(len(wanted), dtype=np.int64)
    k = 0
    for i in range(len(wanted)):
        while k < len(ids) and ids[k] != wanted[i]:
            k += 1
        if k == len(ids):
            return found[:i]
        found[i] = k
        k += 1
    return found
