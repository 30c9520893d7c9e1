"""Windows around matched points: how they are turned, scaled and lit, and how alike they are."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.tracking.images import Image

Array = NDArray[np.float64]

# Exposure that changes by less is left alone: rounding would cost more than it gains.
_LEAST_GAIN, _LEAST_OFFSET = 0.03, 3.0
# A fit that stretches or squeezes areas by more than this is none.
_LARGEST_STRETCH = 4.0


def window_homography(points1: Array, points2: Array) -> Array:
    """Homography (3, 3) from the first image to the second that fits all points (N, 2).

    The identity where there is none: too few points, or a wild fit.
    """
    if len(points1) < 8:
        return np.eye(3)
    # None, where there is none, becomes an array without shape.
    H = np.asarray(cv2.findHomography(points1, points2, method=0)[0], dtype=np.float64)
    if H.shape != (3, 3) or not np.isfinite(H).all():
        return np.eye(3)
    scale = points1 @ H[2, :2] + H[2, 2]
    # Area of the image of a small window: det H / scale^3.
    with np.errstate(all='ignore'):
        area = np.linalg.det(H) / scale**3
    if not ((area > 1.0 / _LARGEST_STRETCH) & (area < _LARGEST_STRETCH)).all():
        return np.eye(3)
    return H


def with_brightness_of(image1: Image, image2: Image, points1: Array, points2: Array,
                       side: int) -> Image:
    """`image2` as bright and as rich in contrast as `image1`, as most windows tell.

    Lucas-Kanade takes brightness for constant, while automatic exposure changes it.
    """
    if not len(points1):
        return image2
    first, second = (_windows(image, points, side)
                     for image, points in ((image1, points1), (image2, points2)))
    contrast = second.std(axis=1)
    if not (contrast > 0.0).any():
        return image2
    gain = np.median((first.std(axis=1) / np.maximum(contrast, 1e-9))[contrast > 0.0])
    offset = np.median(first.mean(axis=1) - gain * second.mean(axis=1))
    if abs(gain - 1.0) < _LEAST_GAIN and abs(offset) < _LEAST_OFFSET:
        return image2
    table = np.clip(np.round(gain * np.arange(256.0) + offset), 0.0, 255.0).astype(np.uint8)
    return cv2.LUT(image2, table)  # type: ignore[return-value]


def correlations(image1: Image, image2: Image, points1: Array, points2: Array,
                 side: int) -> Array:
    """Normalised cross-correlation (N,) of the windows around matched points (N, 2).

    Zero where one of the windows is flat.
    """
    windows = []
    for image, points in ((image1, points1), (image2, points2)):
        sampled = _windows(image, points, side)
        sampled -= sampled.mean(axis=1, keepdims=True)
        windows.append(sampled)
    first, second = windows
    power = (first**2).sum(axis=1) * (second**2).sum(axis=1)
    product = (first * second).sum(axis=1)
    return np.where(power > 0.0, product / np.sqrt(np.maximum(power, 1e-30)), 0.0)


def _windows(image: Image, points: Array, side: int) -> Array:
    """Pixels (N, side^2) of the windows centred at `points` (N, 2), the border repeated."""
    offset = np.arange(side, dtype=np.float64) - side // 2
    x = (points[:, 0, None, None] + offset[None, None, :]).repeat(side, axis=1)
    y = (points[:, 1, None, None] + offset[None, :, None]).repeat(side, axis=2)
    shape = len(points), side * side
    sampled = cv2.remap(image, x.reshape(shape).astype(np.float32),
                        y.reshape(shape).astype(np.float32), cv2.INTER_LINEAR,
                        borderMode=cv2.BORDER_REPLICATE)
    return sampled.astype(np.float64)
