"""Rays of tracked points, turned to the stamped row of their image, and their parallax."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.order import median
from rs_relpose_ros.geometry.vectors import cross, norm, rotated

Array = NDArray[np.float64]
Ids = NDArray[np.uint32]


class Sensor(NamedTuple):
    """Camera model of the full sensor, and the place of the published image on it."""

    camera: RollingShutterCamera
    intrinsics: Intrinsics

    def derotated(self, points: Array, motion: FrameMotion) -> tuple[Array, Array]:
        """Rays (N, 3) of pixels (N, 2) of a published image, and their row times (N,) [s]."""
        pixels = self.intrinsics.to_sensor(points)
        row_times = self.camera.row_times(pixels[:, 1])
        return motion.derotate(self.camera.unproject(pixels), row_times), row_times

    def seen(self, rays: Array, row_times: Array, motion: FrameMotion) -> Array:
        """Pixels (N, 2) of a published image at which rays (N, 3) are seen; NaN where nowhere.

        The inverse of `derotated`. The row that sees a ray depends on where the ray is seen, so
        `row_times` (N,) are a first guess that is improved twice.
        """
        camera = self.camera
        first, last = camera.row_time_span
        for _ in range(2):
            turned = motion.rotations(np.clip(row_times, first, last))
            pixels = camera.project(np.einsum('nji,nj->ni', turned, rays))
            row_times = np.where(np.isfinite(pixels[:, 1]), camera.row_times(pixels[:, 1]),
                                 row_times)
        return self.intrinsics.to_image(pixels)


@dataclass(frozen=True, slots=True, eq=False)
class DerotatedRays:
    """Points of one image with their rays."""

    track_ids: Ids   # (N,)
    points: Array   # (N, 2) pixels of the published image
    rays: Array   # (N, 3) unit, in the camera frame of the stamped row
    row_times: Array   # (N,) [s] from the stamped row

    @classmethod
    def from_points(cls, track_ids: Ids, points: Array, sensor: Sensor,
                    motion: FrameMotion) -> DerotatedRays:
        """Rays of points (N, 2) of a published image."""
        return cls(track_ids, points, *sensor.derotated(points, motion))

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


@kernel
def median_parallax(rays1: Array, rays2: Array, rotation: Array) -> float:
    """Median of ``|f_1 x R f_2|`` [about rad] of unit rays (N, 3), ``R = R_1^T R_2`` (3, 3).

    Rays of NaN do not count; 0 where none does.
    """
    values = np.empty(len(rays1))
    count = 0
    for i in range(len(rays1)):
        value = norm(cross(rays1[i], rotated(rotation, rays2[i])))
        if not math.isnan(value):
            values[count] = value
            count += 1
    return median(values[:count]) if count else 0.0
