"""Repeated images, and parts of the image that the camera carries with it, in a stream of frames.

`StillParts` compares images; this module gives it the motion that the gyro predicts, and keeps the
gyro of the images that are skipped.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.timing import Sensor
from rs_relpose_ros.imu.integration import FrameImu, ImuSlice
from rs_relpose_ros.tracking.images import Image
from rs_relpose_ros.tracking.still import cell_centres, Flags, free_of, StillParts


class StillView:
    """Follows the frames of a camera in the order of time."""

    def __init__(self) -> None:
        self.repeated = 0  # number of images that were not new
        self.static: Flags | None = None  # cells (ROWS, COLUMNS) that do not move
        self._parts = StillParts()
        self._skipped: ImuSlice | None = None  # from the last new image to the last image

    def start(self, stamp_ns: int, image: Image) -> None:
        """Begin with an image, which is new by definition."""
        self._parts.reset()
        self._parts.add(stamp_ns, image, np.zeros(()))
        self._skipped = None

    def imu_of_new(
        self, stamp_ns: int, image: Image, imu: FrameImu, previous: FrameImu, sensor: Sensor
    ) -> FrameImu | None:
        """IMU data since the last new image, `previous`; None if this image is not new."""
        since = imu.since_previous
        assert since is not None
        if self._skipped is not None:
            since = self._skipped.joined(since)
        imu = replace(imu, since_previous=since)
        change = self._parts.add(stamp_ns, image, _motion_of_cells(previous, imu, sensor))
        self.static = change.static
        if change.repeated:
            self.repeated += 1
            self._skipped = since
            return None
        self._skipped = None
        return imu

    def allowed(self, height: int, width: int) -> NDArray[np.uint8] | None:
        """Mask (H, W) of the image that is 0 in static parts; None where nothing is static."""
        if self.static is None or not self.static.any():
            return None
        return free_of(self.static, width, height)


def _motion_of_cells(previous: FrameImu, current: FrameImu, sensor: Sensor) -> Array:
    """Motion (ROWS, COLUMNS, 2) [px] of the cells' centres by the rotation of the camera alone."""
    assert current.since_previous is not None
    intrinsics = sensor.intrinsics
    centres = cell_centres(intrinsics.image_width, intrinsics.image_height)
    points = centres.reshape(-1, 2)
    rays, row_times = sensor.derotated(points, previous.motion)
    rotation = current.since_previous.rotation
    moved = sensor.project(rays @ rotation, row_times, current.motion)
    return (moved - points).reshape(centres.shape)
