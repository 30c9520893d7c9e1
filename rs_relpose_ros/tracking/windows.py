"""Windows around points: patches in one small image, their correlation and their exposure.

OpenCV's Lucas-Kanade prepares a whole image for a few hundred windows. On a mosaic of patches its
cost does not depend on the size of the image.
"""

from dataclasses import dataclass
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry import Array, Indices
from rs_relpose_ros.geometry.so3 import median
from rs_relpose_ros.jit import kernel
from rs_relpose_ros.tracking.images import Image

Floats = NDArray[np.float32]

# Points further away than this [px] are moved to it: a wrong prediction may be anywhere, and a
# larger number overflows as an integer. [chosen: any value in 1e5..1e8 is outside of all images]
_FARTHEST = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Square patches of one image."""

    image: Image  # patch by patch, in rows
    # (N, 2), row k added to a point [px] near the centre of patch k gives its place in `image`
    shifts: Array

    def __post_init__(self) -> None:
        self.image.flags.writeable = False  # as images are: see `images.checked`


def cut(
    image: Image,
    points: Array,
    radius: int,
) -> Patches:
    """Patches of ``2 radius + 1`` pixels around points (N, 2), the border repeated."""
    centres, corners, shape = _layout(points, radius)
    # The unused places of the last row are not read, hence not initialised.
    mosaic = np.empty(shape, dtype=np.uint8)
    side = 2 * radius + 1
    _copy(
        image,
        centres - radius,
        side,
        corners,
        mosaic,
    )
    return Patches(mosaic, (corners + radius - centres).astype(np.float64))


def cut_warped(
    image: Image, points: Array, jacobians: Array, radius: int, points1: Array
) -> Patches:
    """Patches of this image, resampled to the geometry of another one.

    Pixel x of patch k, in the other image, has the value of this image at ``points + J (x -
    points1)`` for `points` (N, 2) here, `points1` (N, 2) there and `jacobians` (N, 2, 2).
    """
    centres, corners, shape = _layout(points1, radius)
    # Pixels outside the patches are not read, but need valid coordinates.
    x, y = np.zeros((2, *shape), dtype=np.float32)
    _fill_maps(
        points,
        jacobians,
        centres - points1,
        radius,
        corners,
        x,
        y,
    )
    mosaic: Image = cv2.remap(  # type: ignore[assignment]
        image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return Patches(mosaic, (corners + radius - centres).astype(np.float64))


def _layout(
    points: Array,
    radius: int,
) -> tuple[Indices, Indices, tuple[int, int]]:
    """Centre pixels (N, 2) of patches, their upper left corners (N, 2) in one image, its shape."""
    bounded = np.clip(points, -_FARTHEST, _FARTHEST)
    centres = np.rint(bounded).astype(np.int64)
    count = len(points)
    side = 2 * radius + 1
    columns = math.isqrt(max(count - 1, 0)) + 1
    full_rows = -(-count // columns)
    rows = max(full_rows, 1)
    row, column = np.divmod(np.arange(count), columns)
    corners = side * np.column_stack([column, row])
    return centres, corners, (side * rows, side * columns)


@kernel
def _copy(
    image: Image,
    first: Indices,
    side: int,
    corners: Indices,
    mosaic: Image,
) -> None:
    """Copy squares of pixels from `first` (N, 2) on to their `corners` (N, 2) in the mosaic."""
    height, width = image.shape
    rows, columns = mosaic.shape
    pixels = image.reshape(height * width)
    target = mosaic.reshape(rows * columns)
    for k in range(len(first)):
        left = first[k, 0]
        top = first[k, 1]
        at = corners[k, 1] * columns + corners[k, 0]
        if left >= 0 and top >= 0 and left + side <= width and top + side <= height:
            # Numbers that cannot be negative: rows are copied many bytes at a time.
            source = np.uint64(top * width + left)
            to = np.uint64(at)
            for _ in range(side):
                for j in range(np.uint64(side)):
                    target[to + j] = pixels[source + j]
                source += np.uint64(width)
                to += np.uint64(columns)
        else:
            for i in range(side):
                line = image[min(max(top + i, 0), height - 1)]
                for j in range(side):
                    target[at + i * columns + j] = line[min(max(left + j, 0), width - 1)]


@kernel
def _fill_maps(
    points: Array,
    jacobians: Array,
    offsets: Array,
    radius: int,
    corners: Indices,
    x: Floats,
    y: Floats,
) -> None:
    """Where patch k is sampled: ``point + J (offset + d)``, d whole pixels from its centre."""
    side = 2 * radius + 1
    for k in range(len(points)):
        across = offsets[k, 0] - radius
        for axis, target in ((0, x), (1, y)):
            start = points[k, axis]
            by_column = jacobians[k, axis, 0]
            by_row = jacobians[k, axis, 1]
            step = np.float32(by_column)
            for i in range(side):
                down = offsets[k, 1] + i - radius
                first = np.float32(start + by_column * across + by_row * down)
                values = target[corners[k, 1] + i, corners[k, 0] :]
                for j in range(side):
                    values[j] = first + step * np.float32(j)


@kernel
def _squares(
    image: Image,
    points: Array,
    side: int,
) -> Image:
    """Squares (N, side, side) of pixels from `points` (N, 2), whole numbers, on."""
    first = np.empty(points.shape, np.int64)
    corners = np.zeros(points.shape, np.int64)
    for k in range(len(points)):
        first[k, 0] = int(points[k, 0])
        first[k, 1] = int(points[k, 1])
        corners[k, 1] = k * side
    out = np.empty((len(points) * side, side), dtype=np.uint8)
    _copy(
        image,
        first,
        side,
        corners,
        out,
    )
    return out.reshape(len(points), side, side)


# -- Correlation of windows -----------------------------------------------------------------------
#
# Sums are kept by column, so that the compiler vectorises them: in one running sum each addition
# waits for the one before. Rows are padded to the width of vector registers; the sums over the
# columns leave the padding out.

# Numbers of 32 bits in a vector register. Another value gives the same result more slowly.
# [derived: AVX2 has registers of 256 bits]
_LANES = 8
# Least variance of a window that has texture [gray^2]: below it, the variance is rounding, and the
# correlation noise. [chosen: gray levels are integers, so that any value in 1e-9..1e-3 would do]
_FLAT = 1e-6


@kernel
def correlations(
    image1: Image,
    image2: Image,
    points1: Array,
    points2: Array,
    side: int,
) -> Array:
    """Normalised cross-correlation (N,) of the windows around matched points (N, 2).

    Zero where one of the windows is flat; the border is repeated.
    """
    padded = -(-side // _LANES) * _LANES
    window1 = np.zeros((side, padded), dtype=np.float32)
    window2 = np.zeros((side, padded), dtype=np.float32)
    power1 = np.empty(padded, dtype=np.float32)
    power2 = np.empty(padded, dtype=np.float32)
    product = np.empty(padded, dtype=np.float32)
    count = points1.shape[0]
    pixels = side * side
    result = np.zeros(count)
    whole1 = np.floor(points1)
    whole2 = np.floor(points2)
    squares1 = _squares(image1, whole1 - side // 2, padded + 1)
    squares2 = _squares(image2, whole2 - side // 2, padded + 1)
    for k in range(count):
        total1 = _sample(
            squares1[k],
            points1[k] - whole1[k],
            window1,
            power1,
        )
        total2 = _sample(
            squares2[k],
            points2[k] - whole2[k],
            window2,
            power2,
        )
        mean1 = np.float32(total1 / pixels)
        mean2 = np.float32(total2 / pixels)
        power1[:] = 0.0
        power2[:] = 0.0
        product[:] = 0.0
        for i in range(side):
            row1 = window1[i]
            row2 = window2[i]
            for j in range(padded):
                off1 = row1[j] - mean1
                off2 = row2[j] - mean2
                power1[j] += off1 * off1
                power2[j] += off2 * off2
                product[j] += off1 * off2
        total1 = _total(power1, side)
        total2 = _total(power2, side)
        if total1 > _FLAT * pixels and total2 > _FLAT * pixels:
            result[k] = _total(product, side) / math.sqrt(total1 * total2)
    return result


@kernel
def _sample(
    square: Image,
    shift: Array,
    window: Floats,
    by_column: Floats,
) -> float:
    """Fill the `window` (side, padded) from a square of pixels, shifted by part of a pixel.

    Returns the sum of its pixels, and writes the sums of its columns to `by_column` (padded,).
    """
    side, padded = window.shape
    dx = shift[0]
    dy = shift[1]
    # Weights of the four pixels around a sample: the same for all, as they lie on a grid.
    w00 = np.float32((1.0 - dx) * (1.0 - dy))
    w01 = np.float32(dx * (1.0 - dy))
    w10 = np.float32((1.0 - dx) * dy)
    w11 = np.float32(dx * dy)
    by_column[:] = 0.0
    for i in range(side):
        above = square[i]
        below = square[i + 1]
        row = window[i]
        above1 = above[1:]
        below1 = below[1:]
        for j in range(padded):
            value = (
                w00 * np.float32(above[j])
                + w01 * np.float32(above1[j])
                + w10 * np.float32(below[j])
                + w11 * np.float32(below1[j])
            )
            row[j] = value
            by_column[j] += value
    return _total(by_column, side)


@kernel
def _total(
    by_column: Floats,
    side: int,
) -> float:
    """Sum of the first `side` columns."""
    total = 0.0
    for j in range(side):
        total += by_column[j]
    return total


# -- Exposure: Lucas-Kanade assumes constant brightness, which automatic exposure changes ---------

# Smallest changes of gain and of offset [gray] that are compensated. For smaller ones the second
# rounding to whole gray levels costs more than it gains at faint texture; with larger limits,
# windows of another brightness are tracked with a bias. [measured: on a RealSense recording, half
# the cost of 0.03 and 3]
_LEAST_GAIN = 0.1
# [measured: the same]
_LEAST_OFFSET = 10.0


def brightness_table(
    image1: Image, image2: Image, points1: Array, points2: Array, side: int
) -> Image | None:
    """Gray level of the first image for each one of the second (256,); None if they agree.

    Windows of `side` pixels around matches (N, 2) are compared in the original images:
    interpolation smooths the noise and with it the contrast.
    """
    if not len(points1):
        return None
    mean1, contrast1 = _statistics(image1, points1, side)
    mean2, contrast2 = _statistics(image2, points2, side)
    textured = contrast2 > 0.0
    if not textured.any():
        return None
    # Medians over the windows.
    gain = median(contrast1[textured] / contrast2[textured])
    offset = median(mean1 - gain * mean2)
    if abs(gain - 1.0) < _LEAST_GAIN and abs(offset) < _LEAST_OFFSET:
        return None
    levels = np.round(gain * np.arange(256.0) + offset)
    return np.clip(levels, 0.0, 255.0).astype(np.uint8)


def with_brightness(
    image: Image,
    table: Image | None,
) -> Image:
    """`image` mapped through a table of `brightness_table`; read-only, as all images."""
    if table is None:
        return image
    changed: Image = cv2.LUT(image, table)  # type: ignore[assignment]
    changed.flags.writeable = False
    return changed


@kernel
def _statistics(
    image: Image,
    points: Array,
    side: int,
) -> tuple[Array, Array]:
    """Mean and standard deviation (N,) of windows of whole pixels around `points` (N, 2)."""
    pixels = side * side
    windows = _squares(image, np.rint(points) - side // 2, side)
    mean = np.empty(len(points))
    deviation = np.empty(len(points))
    for k in range(len(points)):
        total = np.int64(0)
        squares = np.int64(0)
        for i in range(side):
            row = windows[k, i]
            # Integers of 32 bits, which are summed many at a time.
            row_total = np.uint32(0)
            row_squares = np.uint32(0)
            for j in range(side):
                value = np.uint32(row[j])
                row_total += value
                row_squares += value * value
            total += np.int64(row_total)
            squares += np.int64(row_squares)
        mean[k] = total / pixels
        variance = squares / pixels - mean[k] * mean[k]
        deviation[k] = math.sqrt(max(variance, 0.0))
    return mean, deviation
