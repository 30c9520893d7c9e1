"""Shi-Tomasi corners, spread over the image."""

from __future__ import annotations

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.tracking.config import TrackingConfig

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Side of the window over which the structure tensor of the half-size image is summed.
_BLOCK = 5
# Images with a side shorter than this are searched at full size.
_SHORTEST_HALVED = 240


def find_corners(image: Image, taken: Array, count: int, config: TrackingConfig) -> Array:
    """New corners that keep their distance from the points that are there.

    Parameters
    ----------
    image : (H, W) ndarray of uint8
    taken : (M, 2) ndarray
        Points that are tracked already [px].
    count : int
        At most so many new ones.
    config : TrackingConfig

    Returns
    -------
    (K, 2) ndarray
        Whole pixels of the full image, best first. No sub-pixel refinement: a match is as exact
        as the second point follows the first, wherever that lies.
    """
    height, width = image.shape
    # Half size: noise counts for less, and the search costs a quarter.
    scale = 2 if min(height, width) >= _SHORTEST_HALVED else 1
    if scale == 2:
        image = cv2.pyrDown(image)  # type: ignore[assignment]
    margin = -(-(config.klt_window // 2 + 2) // scale)
    if count <= 0 or min(image.shape) <= 2 * margin + _BLOCK:
        return np.empty((0, 2))
    # OpenCV's value is the mean of (2 dI/dx / 255)^2 over the block.
    score = cv2.cornerMinEigenVal(image, _BLOCK, ksize=3)
    least = config.feature_quality * 4.0 / 255.0**2
    peak = (score >= least) & (score >= cv2.dilate(score, np.ones((3, 3), dtype=np.uint8)))
    first, last = feature_rows(config, height)
    top = max(margin, int(np.ceil(first / scale)))
    bottom = min(image.shape[0] - margin, int(np.floor(last / scale)) + 1)
    rows, columns = np.nonzero(peak[top:bottom, margin:image.shape[1] - margin])
    rows, columns = rows + top, columns + margin
    order = np.argsort(-score[rows, columns], kind='stable')
    candidates = np.stack([columns[order], rows[order]], axis=1).astype(np.int64)
    # Wide apart first, then closer, down to the least distance.
    even = np.sqrt(height * width / config.max_features)
    radii = np.array([r / scale for r in (0.8 * even, 0.5 * even) if
                      r > config.min_feature_distance] + [config.min_feature_distance / scale])
    chosen = _spread(candidates, np.asarray(taken, dtype=np.float64) / scale, radii, count,
                     image.shape[0], image.shape[1])
    return candidates[chosen].astype(np.float64) * scale


def feature_rows(config: TrackingConfig, height: int) -> tuple[float, float]:
    """First and last row that features may lie in."""
    first, last = config.feature_rows
    return (first, last) if last > 0.0 else (first, height - 1.0)


@numba.njit(cache=True, nogil=True)
def keep_apart(points: Array, radius: float, height: int, width: int) -> NDArray[np.bool_]:
    """Mask (N,) of points (N, 2) that are not within `radius` of one before them."""
    blocked = np.zeros((height, width), dtype=np.bool_)
    kept = np.zeros(len(points), dtype=np.bool_)
    for n in range(len(points)):
        column, row = round(points[n, 0]), round(points[n, 1])
        if 0 <= column < width and 0 <= row < height and not blocked[row, column]:
            kept[n] = True
            _block(blocked, column, row, radius)
    return kept


@numba.njit(cache=True, nogil=True)
def _block(blocked: NDArray[np.bool_], column: int, row: int, radius: float) -> None:
    reach = int(radius)
    height, width = blocked.shape
    for i in range(max(row - reach, 0), min(row + reach + 1, height)):
        for j in range(max(column - reach, 0), min(column + reach + 1, width)):
            if (i - row) * (i - row) + (j - column) * (j - column) < radius * radius:
                blocked[i, j] = True


@numba.njit(cache=True, nogil=True)
def _spread(candidates: NDArray[np.int64], taken: Array, radii: Array, count: int, height: int,
            width: int) -> NDArray[np.int64]:
    """Indices of at most `count` candidates, best first, at decreasing distances."""
    chosen = np.empty(min(count, len(candidates)), dtype=np.int64)
    used = np.zeros(len(candidates), dtype=np.bool_)
    found = 0
    for radius in radii:
        blocked = np.zeros((height, width), dtype=np.bool_)
        for n in range(len(taken)):
            _block(blocked, round(taken[n, 0]), round(taken[n, 1]), radius)
        for n in range(found):
            _block(blocked, candidates[chosen[n], 0], candidates[chosen[n], 1], radius)
        for n in range(len(candidates)):
            if found == count:
                return chosen[:found]
            column, row = candidates[n, 0], candidates[n, 1]
            if not used[n] and not blocked[row, column]:
                used[n] = True
                chosen[found] = n
                found += 1
                _block(blocked, column, row, radius)
    return chosen[:found]
