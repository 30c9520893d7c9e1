"""Patches around points, laid side by side in one small image.

The cost of OpenCV's Lucas-Kanade on it does not depend on the size of the image, of which it
would prepare the whole for a few hundred windows.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.tracking.images import Image

Array = NDArray[np.float64]
Map = NDArray[np.float32]

# Beyond any image, and small enough for integers [px].
_FARTHEST = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Square patches of one image."""

    image: Image   # patch by patch, in rows
    # (N, 2), row k added to a point [px] near the centre of patch k gives its place in `image`
    shifts: Array

    def __post_init__(self) -> None:
        self.image.flags.writeable = False   # as images are: see `images.checked`


def cut(image: Image, points: Array, radius: int) -> Patches:
    """Patches of ``2 radius + 1`` pixels around points (N, 2), the border repeated."""
    centres = _whole(points)
    side = 2 * radius + 1
    shape, corners = _layout(len(points), side)
    # The unused places of the last row are not read, so not initialised.
    mosaic = np.empty(shape, dtype=np.uint8)
    _copy(image, centres - radius, side, corners, mosaic)
    return Patches(mosaic, (corners + radius - centres).astype(np.float64))


def cut_warped(image: Image, points: Array, jacobians: Array, radius: int,
               points1: Array) -> Patches:
    """Patches of another image's geometry, filled with what this one shows.

    At pixel x of the other image patch k shows ``points + J (x - points1)`` of this one, for
    `points` (N, 2) in this image, `points1` (N, 2) in the other and `jacobians` (N, 2, 2).
    """
    centres = _whole(points1)
    side = 2 * radius + 1
    shape, corners = _layout(len(points), side)
    # What lies beside the patches is not read, but must be a place in the image.
    x, y = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    _maps(points, jacobians, centres - points1, side, corners, x, y)
    mosaic: Image = cv2.remap(  # type: ignore[assignment]
        image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return Patches(mosaic, (corners + radius - centres).astype(np.float64))


def _whole(points: Array) -> NDArray[np.int64]:
    return np.rint(np.clip(points, -_FARTHEST, _FARTHEST)).astype(np.int64)


def _layout(count: int, side: int) -> tuple[tuple[int, int], NDArray[np.int64]]:
    """Height and width of an image for so many patches, and their upper left corners (N, 2)."""
    columns = max(math.isqrt(max(count - 1, 0)) + 1, 1)
    k = np.arange(count)
    corners = side * np.column_stack([k % columns, k // columns])
    return (side * max(-(-count // columns), 1), side * columns), corners


@kernel
def _copy(image: Image, first: NDArray[np.int64], side: int, corners: NDArray[np.int64],
          mosaic: Image) -> None:
    height, width = image.shape
    rows, columns = mosaic.shape
    pixels, target = image.reshape(height * width), mosaic.reshape(rows * columns)
    for k in range(len(first)):
        left, top = first[k, 0], first[k, 1]
        at = corners[k, 1] * columns + corners[k, 0]
        if left >= 0 and top >= 0 and left + side <= width and top + side <= height:
            # Indices that cannot be negative: rows are copied many bytes at a time.
            source, to = np.uint64(top * width + left), np.uint64(at)
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
def _maps(points: Array, jacobians: Array, offsets: Array, side: int,
          corners: NDArray[np.int64], x: Map, y: Map) -> None:
    """Where patch k is sampled: ``point + J (offset + d)``, d whole pixels from its centre."""
    radius = side // 2
    for k in range(len(points)):
        a, c = np.float32(jacobians[k, 0, 0]), np.float32(jacobians[k, 1, 0])
        column, row = corners[k, 0], corners[k, 1]
        for i in range(side):
            across, down = offsets[k, 0] - radius, offsets[k, 1] + i - radius
            x0 = np.float32(points[k, 0] + jacobians[k, 0, 0] * across
                            + jacobians[k, 0, 1] * down)
            y0 = np.float32(points[k, 1] + jacobians[k, 1, 0] * across
                            + jacobians[k, 1, 1] * down)
            xs, ys = x[row + i, column:column + side], y[row + i, column:column + side]
            for j in range(side):
                xs[j] = x0 + a * np.float32(j)
                ys[j] = y0 + c * np.float32(j)
