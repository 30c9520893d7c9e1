"""Repeated images, and parts of the image that the camera carries with it, in a stream of frames.

`StillParts` compares images; this module gives it the motion that the gyro predicts, and keeps the
gyro of the images that are skipped.
"""

from collections import deque
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

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
# Share of the image from which a part that does not move is most of the view: the interior of a
# vehicle, and not what covers a part of the lens. Images alone cannot tell them: neither moves in
# the camera. A lower share names a wide hood so, a higher one misses a cabin with large windows.
# [chosen: hoods and captions cover up to a third, windows of a cabin a fifth to two fifths]
_MOST_OF_VIEW = 0.5
# Least number of repeated images that is reported: one or two are no habit of a driver.
# [chosen: 3 to 10 would do]
_REPORTED = 3
# Number of the last stamps that show the interval of the camera. Fewer may all be after lost
# images, more follow a new rate later. [chosen: a second at 30 Hz]
_STAMPS = 32
# Quantile of the intervals of stamps that contains no lost image. A larger one fails where fewer
# images are lost, a smaller one takes the jitter of stamps for the rate. [derived: less than three
# of four intervals contain a lost image]
_WHOLE = 0.25
# An interval that is longer than the camera's by this factor contains a lost image. A smaller one
# takes jitter for a loss, a larger one does not find the loss of one image. [derived: halfway
# between one and two intervals]
_LOST = 1.5


class _Doubtful(NamedTuple):
    """An image that may repeat a lost one, and that later ones are compared with."""

    imu: FrameImu
    passed: ImuSlice | None  # gyro from it to the last image; None: it is the last one


class StillView:
    """Follows the frames of a camera in the order of time."""

    def __init__(self) -> None:
        self.static: Flags = np.zeros((ROWS, COLUMNS), dtype=bool)  # cells that do not move
        self._repeated: deque[bool] = deque(maxlen=_COUNTED)  # of the last images
        self._size = (0, 0)  # (H, W) of the images
        self._parts = StillParts()
        self._skipped: ImuSlice | None = None  # from the last new image to the last image
        self._stamps_ns: deque[int] = deque(maxlen=_STAMPS)  # of the last images
        self._doubtful: _Doubtful | None = None  # since the last new image

    def start(self, stamp_ns: int, image: Image) -> None:
        """Begin with an image, which is new by definition."""
        self._parts.reset()
        self._parts.add(stamp_ns, image, np.zeros(()))
        self._skipped = None
        self._doubtful = None
        self._stamps_ns.clear()
        self._stamps_ns.append(stamp_ns)
        self._size = image.shape

    def imu_of_new(
        self, stamp_ns: int, image: Image, imu: FrameImu, previous: FrameImu, sensor: Sensor
    ) -> FrameImu | None:
        """IMU data since the last new image, `previous`; None if this image is not new.

        An image after a lost one may repeat that one, which nobody can compare it with: where a
        driver has repeated an image it is not used, and the next one is compared with it.
        """
        since = imu.since_previous
        assert since is not None
        since_new = _joined(self._skipped, since)
        compared, since_compared = previous, since_new
        if self._doubtful is not None:
            compared, since_compared = self._doubtful.imu, _joined(self._doubtful.passed, since)
        step = replace(imu, since_previous=since_compared)
        repeated = self._parts.add(stamp_ns, image, _motion_of_cells(compared, step, sensor))
        self.static = self._parts.static()
        self._repeated.append(repeated)
        self._stamps_ns.append(stamp_ns)
        may_repeat = any(self._repeated) and self._follows_a_loss()
        if not repeated and not may_repeat:
            self._skipped = self._doubtful = None
            return replace(imu, since_previous=since_new)
        self._skipped = since_new
        if not repeated:
            self._doubtful = _Doubtful(imu, None)
        elif self._doubtful is not None:
            self._doubtful = self._doubtful._replace(passed=since_compared)
        return None

    def _follows_a_loss(self) -> bool:
        """Whether images before the last one are missing, by the interval of the camera."""
        intervals = np.diff(np.array(self._stamps_ns))
        return bool(intervals[-1] > _LOST * np.quantile(intervals, _WHOLE))

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
            extent = self._extent()
            is_most = extent['share'] >= _MOST_OF_VIEW
            found.append(_still(Code.INTERIOR if is_most else Code.STATIC_REGION, extent))
        return tuple(found)

    def _extent(self) -> dict[str, Any]:
        """Share of the image that is static, and the rows and columns [px] that contain it."""
        height, width = self._size
        return {
            'share': float(self.static.mean()),
            'rows': _range(np.any(self.static, axis=1), height),
            'columns': _range(np.any(self.static, axis=0), width),
        }


def _joined(earlier: ImuSlice | None, later: ImuSlice) -> ImuSlice:
    return later if earlier is None else earlier.joined(later)


def _range(are_static: Flags, size: int) -> list[int]:
    """First and last pixel of the flagged cells, which divide `size` pixels evenly."""
    cells = np.flatnonzero(are_static)
    first = cells[0]
    last = cells[-1] + 1
    return [round(size * cell / len(are_static)) for cell in (first, last)]


def _still(code: Code, measured: dict[str, Any]) -> Finding:
    """A finding on what does not move; what covers most of a lens looks like an interior."""
    fitting = (Code.INTERIOR, Code.STATIC_REGION) if code is Code.INTERIOR else ()
    return Finding(
        code,
        FindingState.SUSPECT,
        Why.STILL,
        evidence=Evidence(measured=measured),
        candidates=fitting,
    )


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
