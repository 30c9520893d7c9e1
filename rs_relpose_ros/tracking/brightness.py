"""Brightness and contrast of one image made those of another.

Lucas-Kanade takes the brightness of a point for constant; automatic exposure changes it.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel, small_kernel
from rs_relpose_ros.geometry.order import median
from rs_relpose_ros.tracking.images import Image

Array = NDArray[np.float64]

# Exposure that changes by less is left alone: another rounding to whole gray levels costs more
# than it gains where texture is faint (a RealSense recording: half the cost of 0.03 and 3).
_LEAST_GAIN, _LEAST_OFFSET = 0.1, 10.0


def brightness_table(image1: Image, image2: Image, points1: Array, points2: Array,
                     side: int) -> Image | None:
    """The first image's brightness for each of the second's (256,); None where they are alike.

    Windows of `side` pixels around matches (N, 2) are compared, in images as the camera took
    them: interpolation smooths the noise, and contrast with it.
    """
    if not len(points1):
        return None
    gain, offset = _exposure(image1, image2, points1, points2, side)
    if abs(gain - 1.0) < _LEAST_GAIN and abs(offset) < _LEAST_OFFSET:
        return None
    return np.clip(np.round(gain * np.arange(256.0) + offset), 0.0, 255.0).astype(np.uint8)


def with_brightness(image: Image, table: Image | None) -> Image:
    """`image` as a table of `brightness_table` says, read-only as images are."""
    if table is None:
        return image
    changed: Image = cv2.LUT(image, table)  # type: ignore[assignment]
    changed.flags.writeable = False
    return changed


@kernel
def _exposure(image1: Image, image2: Image, points1: Array, points2: Array,
              side: int) -> tuple[float, float]:
    """Gain and offset that make the second image's windows like the first's, by their medians.

    1 and 0 where all windows of the second are flat.
    """
    mean1, contrast1 = _statistics(image1, points1, side)
    mean2, contrast2 = _statistics(image2, points2, side)
    textured = contrast2 > 0.0
    if not textured.any():
        return 1.0, 0.0
    gain = median(contrast1[textured] / contrast2[textured])
    return gain, median(mean1 - gain * mean2)


@kernel
def _statistics(image: Image, points: Array, side: int) -> tuple[Array, Array]:
    """Mean and standard deviation (N,) of the windows around `points` (N, 2), of whole pixels."""
    height, width = image.shape
    pixels = side * side
    mean, deviation = np.empty(len(points)), np.empty(len(points))
    for k in range(len(points)):
        left, top = round(points[k, 0]) - side // 2, round(points[k, 1]) - side // 2
        if left >= 0 and top >= 0 and left + side <= width and top + side <= height:
            total, squares = _sums_inside(image, left, top, side)
        else:
            total, squares = _sums_at_border(image, left, top, side)
        mean[k] = total / pixels
        deviation[k] = math.sqrt(max(squares / pixels - mean[k] * mean[k], 0.0))
    return mean, deviation


@small_kernel
def _sums_inside(image: Image, left: int, top: int, side: int,
                 ) -> tuple[np.int64, np.int64]:
    """Sum of the pixels of a window and of their squares."""
    total, squares = np.int64(0), np.int64(0)
    for i in range(side):
        row = image[top + i, left:left + side]
        # Integers of 32 bits, which are summed many at a time.
        row_total, row_squares = np.uint32(0), np.uint32(0)
        for j in range(side):
            value = np.uint32(row[j])
            row_total += value
            row_squares += value * value
        total += np.int64(row_total)
        squares += np.int64(row_squares)
    return total, squares


@kernel
def _sums_at_border(image: Image, left: int, top: int, side: int,
                    ) -> tuple[np.int64, np.int64]:
    """The same, the border repeated."""
    height, width = image.shape
    total, squares = np.int64(0), np.int64(0)
    for i in range(side):
        for j in range(side):
            value = np.int64(image[min(max(top + i, 0), height - 1),
                                   min(max(left + j, 0), width - 1)])
            total += value
            squares += value * value
    return total, squares
