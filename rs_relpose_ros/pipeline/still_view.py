"""Repeated images, and parts of the image that the camera carries with it, in a stream of frames.

`StillParts` compares images; this module gives it the motion that the gyro predicts, and keeps the
gyro of the images that are skipped.
"""

from collections import deque
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from rs_relpose_ros.calibration.findings import Code, Evidence, Finding, FindingState, Why
from rs_relpose_ros.geometry import Array, Flags
from rs_relpose_ros.geometry.timing import Sensor
from rs_relpose_ros.imu.integration import FrameImu, ImuSlice
from rs_relpose_ros.tracking.images import Image
from rs_relpose_ros.tracking.still import (
    cell_centres,
    COLUMNS,
    free_of,
    ROWS,
    StillParts,
)

# Number of the last images among which repeated ones are counted. More would report a driver that
# has stopped repeating. [chosen: 20 s at 30 Hz]
_COUNTED = 600
# Least number of repeated images that is reported: one or two are no habit of a driver.
# [chosen: 3 to 10 would do]
_REPORTED = 3


class StillView:
    """Follows the frames of a camera in the order of time."""

    def __init__(self) -> None:
        self.static: Flags = np.zeros((ROWS, COLUMNS), dtype=bool)  # cells that do not move
        self._repeated: deque[bool] = deque(maxlen=_COUNTED)  # of the last images
        self._size = (0, 0)  # (H, W) of the images
        self._parts = StillParts()
        self._skipped: ImuSlice | None = None  # from the last new image to the last image

    def start(self, stamp_ns: int, image: Image) -> None:
        """Begin with an image, which is new by definition."""
        self._parts.reset()
        self._parts.add(stamp_ns, image, np.zeros(()))
        self._skipped = None
        self._size = image.shape

    def imu_of_new(
        self, stamp_ns: int, image: Image, imu: FrameImu, previous: FrameImu, sensor: Sensor
    ) -> FrameImu | None:
        """IMU data since the last new image, `previous`; None if this image is not new."""
        since = imu.since_previous
        assert since is not None
        if self._skipped is not None:
            since = self._skipped.joined(since)
        imu = replace(imu, since_previous=since)
        repeated = self._parts.add(stamp_ns, image, _motion_of_cells(previous, imu, sensor))
        self.static = self._parts.static()
        self._repeated.append(repeated)
        if repeated:
            self._skipped = since
            return None
        self._skipped = None
        return imu

    def allowed(self) -> Image | None:
        """Mask (H, W) of the image that is 0 in static parts; None where nothing is static."""
        height, width = self._size
        return free_of(self.static, width, height) if self.static.any() else None

    def findings(self) -> tuple[Finding, ...]:
        """Findings on repeated images and on static parts."""
        found = []
        repeated = sum(self._repeated)
        if repeated >= _REPORTED:
            measured = {'repeated': repeated, 'images': len(self._repeated)}
            found.append(_still(Code.REPEATED_IMAGES, measured))
        if self.static.any():
            found.append(_still(Code.STATIC_REGION, self._extent()))
        return tuple(found)

    def _extent(self) -> dict[str, Any]:
        """Share of the image that is static, and the rows and columns [px] that contain it."""
        height, width = self._size
        return {
            'share': float(self.static.mean()),
            'rows': _range(np.any(self.static, axis=1), height),
            'columns': _range(np.any(self.static, axis=0), width),
        }


def _range(are_static: Flags, size: int) -> list[int]:
    """First and last pixel of the flagged cells, which divide `size` pixels evenly."""
    cells = np.flatnonzero(are_static)
    first = cells[0]
    last = cells[-1] + 1
    return [round(size * cell / len(are_static)) for cell in (first, last)]


def _still(code: Code, measured: dict[str, Any]) -> Finding:
    return Finding(code, FindingState.SUSPECT, Why.STILL, evidence=Evidence(measured=measured))


def _motion_of_cells(previous: FrameImu, current: FrameImu, sensor: Sensor) -> Array:
    """Motion (ROWS, COLUMNS, 2) [px] of the cells' centres by the rotation of the camera alone."""
    assert current.since_previous is not None
    points, unrotated, row_times = _cells(sensor)
    rays = previous.motion.derotate(unrotated, row_times)
    turned = rays @ current.since_previous.rotation
    moved = sensor.project(turned, row_times, current.motion)
    return (moved - points).reshape(ROWS, COLUMNS, 2)


@lru_cache(maxsize=4)
def _cells(sensor: Sensor) -> tuple[Array, Array, Array]:
    """Centres (N, 2) [px] of the cells, row by row, their rays (N, 3) and row times (N,) [s]."""
    intrinsics = sensor.intrinsics
    points = cell_centres(intrinsics.image_width, intrinsics.image_height).reshape(-1, 2)
    pixels = intrinsics.to_sensor(points)
    return points, sensor.camera.unproject(pixels), sensor.camera.pixel_times(pixels)
