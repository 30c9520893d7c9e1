"""Correlation of windows around matched points.

Sums run by column of a window, many columns at a time: of one running sum each addition would
wait for the last. Rows are padded to what vector registers hold; the padding is not used.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel, small_kernel
from rs_relpose_ros.tracking.images import Image

Array = NDArray[np.float64]
Window = NDArray[np.float32]
Weights = tuple[np.float32, np.float32, np.float32, np.float32]

# Numbers of 32 bits in a vector register of AVX2.
_LANES = 8


@kernel
def correlations(image1: Image, image2: Image, points1: Array, points2: Array,
                 side: int) -> Array:
    """Normalised cross-correlation (N,) of the windows around matched points (N, 2).

    Zero where one of the windows is flat.
    """
    padded = -(-side // _LANES) * _LANES
    window1 = np.zeros((side, padded), dtype=np.float32)
    window2 = np.zeros((side, padded), dtype=np.float32)
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
        # What varies in a flat window is rounding.
        if total1 > 1e-6 * pixels and total2 > 1e-6 * pixels:
            result[k] = _total(product, side) / math.sqrt(total1 * total2)
    return result


@kernel
def _window(image: Image, x: float, y: float, window: Window, by_column: Window) -> float:
    """Fill the `window` (side, padded) centred at a point, the border repeated.

    The sum of its pixels is returned, that of its columns written to `by_column` (padded,).
    """
    height, width = image.shape
    side, padded = window.shape
    left, top = math.floor(x) - side // 2, math.floor(y) - side // 2
    dx, dy = x - math.floor(x), y - math.floor(y)
    # Weights of the four pixels around a sample: the same for all, as they lie on a grid.
    weights = (np.float32((1.0 - dx) * (1.0 - dy)), np.float32(dx * (1.0 - dy)),
               np.float32((1.0 - dx) * dy), np.float32(dx * dy))
    by_column[:] = 0.0
    if left >= 0 and top >= 0 and left + padded < width and top + side < height:
        _sample_inside(image, left, top, weights, window, by_column)
    else:
        _sample_at_border(image, left, top, weights, window, by_column)
    return _total(by_column, side)


@small_kernel
def _sample_inside(image: Image, left: int, top: int, weights: Weights, window: Window,
                   by_column: Window) -> None:
    """Samples whose pixels all lie in the image: whole rows, padding included."""
    w00, w01, w10, w11 = weights
    side, padded = window.shape
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


@kernel
def _sample_at_border(image: Image, left: int, top: int, weights: Weights, window: Window,
                      by_column: Window) -> None:
    """Samples of which some lie outside: there the nearest pixel counts."""
    w00, w01, w10, w11 = weights
    height, width = image.shape
    side = len(window)
    for i in range(side):
        above = image[min(max(top + i, 0), height - 1)]
        below = image[min(max(top + i + 1, 0), height - 1)]
        for j in range(side):
            j0, j1 = min(max(left + j, 0), width - 1), min(max(left + j + 1, 0), width - 1)
            value = (w00 * np.float32(above[j0]) + w01 * np.float32(above[j1])
                     + w10 * np.float32(below[j0]) + w11 * np.float32(below[j1]))
            window[i, j] = value
            by_column[j] += value


@kernel
def _total(by_column: Window, side: int) -> float:
    """Sum of the first `side` columns."""
    total = 0.0
    for j in range(side):
        total += by_column[j]
    return total
