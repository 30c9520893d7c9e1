"""Windows around matched points: how they are turned, scaled and lit, and how alike they are."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.tracking.images import Image

Array = NDArray[np.float64]

# Exposure that changes by less is left alone: another rounding to whole gray levels costs more
# than it gains where texture is faint (a RealSense recording: half the cost of 0.03 and 3).
_LEAST_GAIN, _LEAST_OFFSET = 0.1, 10.0
# Numbers of 32 bits that a vector register of AVX2 holds.
_LANES = 8
# The fit of a window's turn and scale needs no more points than about this; each one costs time.
_FITTED = 100
# A fit that stretches or squeezes areas by more than this is none.
_LARGEST_STRETCH = 4.0


def window_homography(points1: Array, points2: Array) -> Array:
    """Homography (3, 3) from the first image to the second that fits the points (N, 2).

    The identity where there is none: too few points, or a wild fit.
    """
    if len(points1) < 8:
        return np.eye(3)
    # None, where there is none, becomes an array without shape.
    some = slice(None, None, -(-len(points1) // _FITTED))
    H = np.asarray(cv2.findHomography(points1[some], points2[some], method=0)[0],
                   dtype=np.float64)
    if H.shape != (3, 3) or not np.isfinite(H).all():
        return np.eye(3)
    scale = points1 @ H[2, :2] + H[2, 2]
    # Area of the image of a small window: det H / scale^3.
    with np.errstate(all='ignore'):
        area = np.linalg.det(H) / scale**3
    if not ((area > 1.0 / _LARGEST_STRETCH) & (area < _LARGEST_STRETCH)).all():
        return np.eye(3)
    return H


def window_jacobians(points1: Array, points2: Array) -> Array:
    """How windows around points (N, 2) are turned and scaled in the second image (N, 2, 2).

    Derivatives of `window_homography`: a column for each axis of the first image.
    """
    H = window_homography(points1, points2)
    homogeneous = np.column_stack([points1, np.ones(len(points1))]) @ H.T
    depth = homogeneous[:, 2, None, None]
    mapped = homogeneous[:, :2] / depth[:, 0]
    return (H[:2, :2] - mapped[:, :, None] * H[2, :2]) / depth


def brightness_table(image1: Image, image2: Image, points1: Array, points2: Array,
                     side: int) -> Image | None:
    """What makes the second image as bright and as rich in contrast as the first.

    Lucas-Kanade takes brightness for constant, while automatic exposure changes it.

    Parameters
    ----------
    image1, image2 : (H, W) ndarray of uint8
        As the camera took them: interpolation smooths the noise, and contrast with it.
    points1, points2 : (N, 2) ndarray
        Matches, whose windows are compared.
    side : int
        Of the windows [px].

    Returns
    -------
    (256,) ndarray of uint8 or None
        The first image's brightness for each of the second's; None where they are alike.
    """
    if not len(points1):
        return None
    gain, offset = _exposure(image1, image2, points1, points2, side)
    if abs(gain - 1.0) < _LEAST_GAIN and abs(offset) < _LEAST_OFFSET:
        return None
    return np.clip(np.round(gain * np.arange(256.0) + offset), 0.0, 255.0).astype(np.uint8)


def with_brightness(image: Image, table: Image | None) -> Image:
    """`image` as a table of `brightness_table` says."""
    return image if table is None else cv2.LUT(image, table)  # type: ignore[return-value]


def correlations(image1: Image, image2: Image, points1: Array, points2: Array,
                 side: int) -> Array:
    """Normalised cross-correlation (N,) of the windows around matched points (N, 2).

    Zero where one of the windows is flat.
    """
    return _correlations(image1, image2, points1, points2, side)


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
    gain = float(np.median(contrast1[textured] / contrast2[textured]))
    return gain, float(np.median(mean1 - gain * mean2))


@kernel
def _statistics(image: Image, points: Array, side: int) -> tuple[Array, Array]:
    """Mean and standard deviation (N,) of the windows around `points` (N, 2), of whole pixels."""
    height, width = image.shape
    count, pixels = points.shape[0], side * side
    mean, deviation = np.empty(count), np.empty(count)
    for k in range(count):
        x, y = round(points[k, 0]), round(points[k, 1])
        left, top = x - side // 2, y - side // 2
        total, squares = np.int64(0), np.int64(0)
        if left >= 0 and top >= 0 and left + side <= width and top + side <= height:
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
        else:
            for i in range(side):
                for j in range(side):
                    inner = np.int64(image[min(max(top + i, 0), height - 1),
                                           min(max(left + j, 0), width - 1)])
                    total += inner
                    squares += inner * inner
        mean[k] = total / pixels
        deviation[k] = math.sqrt(max(squares / pixels - mean[k] * mean[k], 0.0))
    return mean, deviation


@kernel
def _correlations(image1: Image, image2: Image, points1: Array, points2: Array,
                  side: int) -> Array:
    # Rows as long as the processor's vectors like them; what is more than the window is not used.
    padded = -(-side // _LANES) * _LANES
    window1 = np.zeros((side, padded), dtype=np.float32)
    window2 = np.zeros((side, padded), dtype=np.float32)
    # Sums by column: of one running sum each addition would wait for the last.
    power1, power2 = np.empty(padded, dtype=np.float32), np.empty(padded, dtype=np.float32)
    product = np.empty(padded, dtype=np.float32)
    count, pixels = points1.shape[0], side * side
    result = np.zeros(count)
    for k in range(count):
        mean1 = np.float32(_window(image1, points1[k, 0], points1[k, 1], window1, power1) / pixels)
        mean2 = np.float32(_window(image2, points2[k, 0], points2[k, 1], window2, power2) / pixels)
        power1[:], power2[:], product[:] = 0.0, 0.0, 0.0
        for i in range(side):
            row1, row2 = window1[i], window2[i]
            for j in range(padded):
                off1, off2 = row1[j] - mean1, row2[j] - mean2
                power1[j] += off1 * off1
                power2[j] += off2 * off2
                product[j] += off1 * off2
        total1, total2 = _total(power1, side), _total(power2, side)
        # A flat window has nothing but rounding.
        if total1 > 1e-6 * pixels and total2 > 1e-6 * pixels:
            result[k] = _total(product, side) / math.sqrt(total1 * total2)
    return result


@kernel
def _window(image: Image, x: float, y: float, window: NDArray[np.float32],
            by_column: NDArray[np.float32]) -> float:
    """Sample the `window` centred at a point, the border repeated; the sum of its pixels.

    Square, but for its rows' end, which is padded; `by_column` is room to work in.
    """
    height, width = image.shape
    side, padded = window.shape
    left, top = math.floor(x) - side // 2, math.floor(y) - side // 2
    dx, dy = x - math.floor(x), y - math.floor(y)
    # One fraction for all pixels, as they lie on a grid.
    w00, w01 = np.float32((1.0 - dx) * (1.0 - dy)), np.float32(dx * (1.0 - dy))
    w10, w11 = np.float32((1.0 - dx) * dy), np.float32(dx * dy)
    by_column[:] = 0.0
    if left >= 0 and top >= 0 and left + padded < width and top + side < height:
        for i in range(side):
            above, below = image[top + i], image[top + i + 1]
            above0, above1 = above[left:left + padded], above[left + 1:left + padded + 1]
            below0, below1 = below[left:left + padded], below[left + 1:left + padded + 1]
            row = window[i]
            for j in range(padded):
                value = (w00 * np.float32(above0[j]) + w01 * np.float32(above1[j])
                         + w10 * np.float32(below0[j]) + w11 * np.float32(below1[j]))
                row[j] = value
                by_column[j] += value
    else:
        columns = np.empty(side + 1, dtype=np.int64)
        for j in range(side + 1):
            columns[j] = min(max(left + j, 0), width - 1)
        for i in range(side):
            above = image[min(max(top + i, 0), height - 1)]
            below = image[min(max(top + i + 1, 0), height - 1)]
            for j in range(side):
                value = (w00 * np.float32(above[columns[j]])
                         + w01 * np.float32(above[columns[j + 1]])
                         + w10 * np.float32(below[columns[j]])
                         + w11 * np.float32(below[columns[j + 1]]))
                window[i, j] = value
                by_column[j] += value
    return _total(by_column, side)


@kernel
def _total(by_column: NDArray[np.float32], side: int) -> float:
    total = 0.0
    for j in range(side):
        total += by_column[j]
    return total
