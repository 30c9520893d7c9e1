"""Shi-Tomasi corners, spread over the image."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.tracking.images import Image

Array = NDArray[np.float64]

# Side of the window over which the structure tensor of the half-size image is summed.
_BLOCK = 5
# Images with a side shorter than this are searched at full size.
_SHORTEST_HALVED = 240
# OpenCV's threshold, relative to the best corner, must be positive; the one used is absolute.
_ALL = 1e-9


def find_corners(image: Image, taken: Array, count: int, config: TrackingConfig) -> Array:
    """At most `count` new corners (K, 2) [px], at a distance from those `taken` (M, 2) already.

    The best of each cell of a grid first, then the second best, and so on. Whole pixels, not
    refined: the accuracy of a match is that of the second point relative to the first one.
    """
    height, width = image.shape
    # Half size: less noise, and the search costs a quarter.
    scale = 2 if min(height, width) >= _SHORTEST_HALVED else 1
    if scale == 2:
        image = cv2.pyrDown(image)  # type: ignore[assignment]
    margin = -(-(config.klt_window // 2 + 2) // scale)
    if count <= 0 or min(image.shape) <= 2 * margin + _BLOCK:
        return np.empty((0, 2))
    first, last = feature_rows(config, height)
    distance = config.min_feature_distance / scale
    free = np.zeros(image.shape, dtype=np.uint8)
    free[max(margin, math.ceil(first / scale)):math.floor(last / scale) + 1, margin:-margin] = 255
    free[-margin:] = 0
    _occupy(free, taken / scale, math.ceil(distance))
    points = scale * _strong_corners(image, free, distance, config.feature_quality)
    cell = math.sqrt(height * width / config.max_features)
    return points[_spread(points, taken, cell)[:count]]


def _strong_corners(image: Image, free: Image, distance: float, least: float) -> Array:
    """Corners (N, 2) where `free` (H, W) is not 0, best first, at a distance from each other.

    `least`: least eigenvalue of the structure tensor [gray^2/px^2].
    """
    corners, quality = cv2.goodFeaturesToTrackWithQuality(
        image, 0, _ALL, distance, free, blockSize=_BLOCK)
    if corners is None:  # where there is none
        return np.empty((0, 2))  # type: ignore[unreachable]
    # OpenCV's value is the mean of (2 dI/dx / 255)^2 over the block.
    strong = np.ravel(quality) >= least * 4.0 / 255.0**2
    return np.reshape(corners, (-1, 2))[strong].astype(np.float64)


@kernel
def _occupy(free: Image, points: Array, radius: int) -> None:
    """Clear the discs around `points` (M, 2)."""
    height, width = free.shape
    for k in range(points.shape[0]):
        x, y = round(points[k, 0]), round(points[k, 1])
        for row in range(max(y - radius, 0), min(y + radius + 1, height)):
            for column in range(max(x - radius, 0), min(x + radius + 1, width)):
                if (column - x)**2 + (row - y)**2 <= radius * radius:
                    free[row, column] = 0


def feature_rows(config: TrackingConfig, height: int) -> tuple[float, float]:
    """First and last row that features may lie in."""
    first, last = config.feature_rows
    return (first, last) if last > 0.0 else (first, height - 1.0)


def keep_apart(points: Array, radius: float) -> NDArray[np.bool_]:
    """Mask (N,) of points (N, 2) that are not within `radius` of one before them."""
    kept = np.ones(len(points), dtype=bool)
    if len(points) > 1:
        for before, after in sorted(KDTree(points).query_pairs(radius)):
            if kept[before]:
                kept[after] = False
    return kept


def _spread(points: Array, taken: Array, cell: float) -> NDArray[np.intp]:
    """Order of `points` (N, 2), best first, that fills the cells of a grid evenly.

    A point ranks behind the better ones of its cell and behind those `taken` (M, 2) in it.
    """
    both = np.concatenate([taken, points])
    column, row = (both // cell).astype(np.int64).T
    cells = row * (column.max(initial=0) + 1) + column
    by_cell = np.argsort(cells, kind='stable')
    _, starts, sizes = np.unique(cells[by_cell], return_index=True, return_counts=True)
    rank = np.empty(len(both), dtype=np.int64)
    rank[by_cell] = np.arange(len(both)) - np.repeat(starts, sizes)
    return np.argsort(rank[len(taken):], kind='stable')
