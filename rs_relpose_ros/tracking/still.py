"""Images and parts of images that stay still although the gyro says that the camera turns.

A driver that sends the last image again, a caption, a dirty lens, the legs of a drone and the
cabin of a vehicle have one property: where a rotation of the camera has to move the image, the
image does not change. The change is compared cell by cell with the change that the rotation alone
would make:

    D = mean |I_k - I_j|,    E = mean |W(I_j) - I_j|    [gray levels], over the pixels of a cell

with I_j the last image that was new, I_k the current image, both reduced in size, and W(I_j) the
image I_j moved by the rotation. A cell is informative where E is large, and still where D is small
against E. An image whose informative cells are all still is a repetition of the image before.
Where the camera hardly turns, one that has changed as little as known repetitions did is, too.
A cell that is still in most of the images of some seconds, and also against an image of half a
second before, is static: an object that moves slowly is not.
"""

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry import Array, Flags
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.tracking.images import Image

# Columns and rows of the cells. [chosen: a cell of 40 px in 640x480 holds some texture, and a
# static part of a tenth of the image covers several cells; 10..24 columns would do]
COLUMNS = 16
# [chosen: cells that are nearly square in 4:3]
ROWS = 12
# Width of the reduced image [px]. Averaging reduces the noise of the sensor and of the
# compression; a smaller image loses the texture. [chosen: 10 px for each cell]
_WIDTH = 160
# Least motion [px of the reduced image] that the rotation has to make in an informative cell. Less
# motion changes the image by no more than its noise. [derived: a change of half the gradient]
_LEAST_MOTION = 0.5
# Least change E of an informative cell [gray levels]. [derived: six times the noise of a mean of
# 4 x 4 pixels with a noise of 2 gray levels]
_LEAST_CHANGE = 3.0
# Largest D of a still cell as a share of E. Cells that move as the rotation says have D near E,
# as E is their change; a larger share takes slow motion for none, a smaller one takes the noise
# of repeated images for motion. [chosen: separates both kinds in test_still.py; half and double of
# it were not tried]
_STILL = 0.25
# Least share of the cells that have to be informative for a verdict on the whole image. A wall
# without texture tells nothing. [chosen: a tenth to a half would do]
_INFORMATIVE = 0.2
# Least share of the informative cells that have to be still in a repeated image. A window in the
# cabin of a vehicle moves in a smaller share. [chosen: a few cells may flicker]
_ALL = 0.97
# Number of the last repeated images whose change [gray levels] is kept. More follow a new quality
# of compression later. [chosen: 10 to 100 would do]
_ALIKE_KEPT = 30
# Least number of these with which an image is compared where the rotation tells nothing. Fewer
# may be a chance. [chosen: 3 to 10 would do]
_ALIKE_LEAST = 3
# Largest change of an image, in units of the median change of repeated images, that is a
# repetition, too. A larger one takes slow motion for none. [measured: copies of a walk change by
# 0.98 to 1.02, other images by 8.8 at least]
_ALIKE = 2.0
# Longest time [ns] for which images that are alike count as repetitions of the last new one: a
# camera at rest sends such images, too. A longer one hides the rest, a shorter one takes the image
# of a frozen driver for new. [chosen: 0.2 to 1 s would do]
_ALIKE_NS = to_nanoseconds(0.5)
# Time over which cells are counted [ns]. In a shorter time a person may keep one point of the
# scene at its place in the image. [chosen: 3 to 10 s would do]
_WINDOW_NS = to_nanoseconds(5.0)
# Age [ns] that the image before has at least with which static cells are compared as well. A lower
# one takes an object that moves by a pixel an image for a static part, a higher one finds static
# parts later. [chosen: 0.3 to 1 s would do]
_EARLIER_NS = to_nanoseconds(0.5)
# Least number of images of that time in which a static cell has to be informative. Fewer images
# name a static part by chance. [chosen: a walk of 5 s has 150 images, 50 of which turn enough]
_LEAST_IMAGES = 20
# Least share of these images in which a static cell is still. A cell at the border of a static
# part is still in about half of the images. [chosen: 0.7 to 0.9 would do]
_STATIC = 0.8


class StillParts:
    """Compares images with the rotation of the camera, in the order of time."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all images."""
        self._before: NDArray[np.float32] | None = None  # the last new image, reduced
        self._before_ns = 0  # its stamp
        self._alike: deque[float] = deque(maxlen=_ALIKE_KEPT)  # changes of repeated images
        # Two images of before with their stamps: the older one is that for comparison.
        self._earlier: list[tuple[int, NDArray[np.float32]]] = []
        self._counted: deque[tuple[int, Flags, Flags]] = deque()
        # Of these images, in how many each cell was informative, and in how many it was still.
        cells = (ROWS, COLUMNS)
        self._informative = np.zeros(cells, dtype=int)
        self._still = np.zeros(cells, dtype=int)

    def add(self, stamp_ns: int, image: Image, motion: Array) -> bool:
        """Add the next image (H, W); whether it repeats the last new image.

        `motion` (ROWS, COLUMNS, 2): displacement [px] of the centres of the cells by the rotation
        since the last new image; NaN where it is not known. The first image needs none.
        """
        height, width = image.shape
        scale = _WIDTH / width
        reduced_height = max(round(height * scale), ROWS)
        small = cv2.resize(image, (_WIDTH, reduced_height), interpolation=cv2.INTER_AREA)
        reduced = small.astype(np.float32)
        before = self._before
        if before is None or before.shape != reduced.shape:
            self._before = reduced
            self._before_ns = stamp_ns
            return False
        informative, expected, still = _compared(before, reduced, motion * scale)
        enough = informative.mean() >= _INFORMATIVE
        change = float(np.abs(reduced - before).mean())
        if enough:
            repeated = bool(still[informative].mean() >= _ALL)
            if repeated:
                self._alike.append(change)
        else:
            repeated = self._is_alike(stamp_ns, change)
        if not repeated:
            lasting = self._lasts(stamp_ns, reduced, expected)
            self._count(stamp_ns, informative, still & lasting)
            self._before = reduced
            self._before_ns = stamp_ns
        return repeated

    def _is_alike(self, stamp_ns: int, change: float) -> bool:
        """Whether an image has changed as little [gray levels] as known repetitions did."""
        if len(self._alike) < _ALIKE_LEAST or stamp_ns - self._before_ns > _ALIKE_NS:
            return False
        return change <= _ALIKE * float(np.median(self._alike))

    def _lasts(self, stamp_ns: int, reduced: NDArray[np.float32], expected: Array) -> Flags:
        """Which cells are as in an image of at least `_EARLIER_NS` before; none without one.

        `expected` (ROWS, COLUMNS) [gray levels]: the change that the rotation since the last
        image would make.
        """
        earlier = self._earlier
        if not earlier or stamp_ns - earlier[-1][0] >= _EARLIER_NS:
            earlier.append((stamp_ns, reduced))
            del earlier[:-2]
        first_ns, first = earlier[0]
        if stamp_ns - first_ns < _EARLIER_NS:
            return np.zeros(expected.shape, dtype=bool)
        changed = _cell_means(np.abs(reduced - first))
        return np.asarray(changed < _STILL * expected)

    def static(self) -> Flags:
        """Cells (ROWS, COLUMNS) that are static by the images of the last seconds."""
        enough = self._informative >= _LEAST_IMAGES
        return np.asarray(enough & (self._still >= _STATIC * self._informative))

    def _count(self, stamp_ns: int, informative: Flags, still: Flags) -> None:
        still = still & informative
        self._counted.append((stamp_ns, informative, still))
        self._informative += informative
        self._still += still
        while self._counted[0][0] < stamp_ns - _WINDOW_NS:
            _, no_longer_informative, no_longer_still = self._counted.popleft()
            self._informative -= no_longer_informative
            self._still -= no_longer_still


def cell_centres(width: int, height: int) -> Array:
    """Pixels (ROWS, COLUMNS, 2) of the centres of the cells of an image."""
    cell_width = width / COLUMNS
    cell_height = height / ROWS
    u = (np.arange(COLUMNS) + 0.5) * cell_width - 0.5
    v = (np.arange(ROWS) + 0.5) * cell_height - 0.5
    return np.stack(np.meshgrid(u, v), axis=-1)


def free_of(static: Flags, width: int, height: int) -> NDArray[np.uint8]:
    """Mask (H, W): 255 where new features may lie, 0 in static cells and their neighbours."""
    neighbours = np.ones((3, 3), dtype=np.uint8)
    grown = cv2.dilate(static.astype(np.uint8), neighbours)
    allowed = 255 * (1 - grown)
    mask = cv2.resize(allowed, (width, height), interpolation=cv2.INTER_NEAREST)
    return mask.astype(np.uint8, copy=False)


def _compared(
    before: NDArray[np.float32], now: NDArray[np.float32], motion: Array
) -> tuple[Flags, Array, Flags]:
    """Which cells (ROWS, COLUMNS) are informative, the change E of all, and which are still."""
    width = before.shape[1]
    # Content that comes from far outside the image is not known. A wrong gyro makes motions of
    # many image widths, which `remap` would reflect at the border one width at a time.
    known = (np.abs(motion) < width).all(axis=2)  # NaN is not known either
    field = np.where(known[..., np.newaxis], motion, 0.0).astype(np.float32)
    lengths = np.linalg.norm(field, axis=2)
    turned = known & (lengths >= _LEAST_MOTION)
    if not turned.any():
        return turned, np.zeros(turned.shape), turned
    expected = _cell_means(np.abs(_moved(before, field) - before))
    changed = _cell_means(np.abs(now - before))
    informative = turned & (expected >= _LEAST_CHANGE)
    still = changed < _STILL * expected
    return np.asarray(informative), expected, np.asarray(still)


def _moved(image: NDArray[np.float32], field: NDArray[np.float32]) -> NDArray[np.float32]:
    """The image W(I) whose content has moved by a field (ROWS, COLUMNS, 2) [px]."""
    height, width = image.shape
    dense = cv2.resize(field, (width, height), interpolation=cv2.INTER_LINEAR)
    # The content of a pixel comes from where the motion began.
    u = np.arange(width, dtype=np.float32) - dense[..., 0]
    v = np.arange(height, dtype=np.float32)[:, np.newaxis] - dense[..., 1]
    moved = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(moved, dtype=np.float32)


def _cell_means(values: NDArray[np.float32]) -> Array:
    means = cv2.resize(values, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA)
    return np.asarray(means, dtype=np.float64)
