"""Lucas-Kanade by OpenCV, at a cost that hardly depends on the size of the images."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.tracking.images import Image
from rs_relpose_ros.tracking.patches import cut

Array = NDArray[np.float64]

# OpenCV's termination criteria: kind, steps, step [px].
Criteria = tuple[int, int, float]

# OpenCV's eigenvalues are those of Scharr gradients, 32 times the derivative, divided by 2^20.
_SCHARR = 2.0**20 / 32.0**2
# Without a pyramid a window finds what lies this near [px]; with one level more, twice that.
_REACH = 4
# Derivatives, interpolation and rounding need so many pixels around a window.
_FRINGE = 3
# Patches are worth cutting out where the images are this many times larger.
_WORTH = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Flow:
    """Where points were found again."""

    points: Array   # (N, 2) in the second image
    found: NDArray[np.bool_]   # (N,)
    strength: Array   # (N,) [gray^2/px^2] least eigenvalue of each window's structure tensor


def follow(image1: Image, image2: Image, points1: Array, guess: Array, side: int, levels: int,
           criteria: Criteria) -> Flow:
    """Points of `image2` near the `guess` (N, 2) that look like `points1` (N, 2) of `image1`.

    Windows of `side` pixels are compared; `levels` of the pyramid: 1 for the images themselves.
    """
    if not len(points1):
        return Flow(points1, np.empty(0, dtype=bool), np.empty(0))
    radius = patch_radius(side, _REACH)
    if levels <= 2 and image1.size > _WORTH * len(points1) * (2 * radius + 1)**2:
        if levels == 2:
            # As in a pyramid: what the coarse level says is where the fine one starts.
            coarse = _near(cv2.pyrDown(image1), cv2.pyrDown(image2),  # type: ignore[arg-type]
                           0.5 * points1, 0.5 * guess, side, radius, criteria)
            guess = np.where(coarse.found[:, None], 2.0 * coarse.points, guess)
        flow = _near(image1, image2, points1, guess, side, radius, criteria)
    else:
        flow = whole_images(image1, image2, points1, guess, side, levels, criteria)
    return Flow(flow.points, flow.found & inside(image2, flow.points), flow.strength)


def inside(image: Image, points: Array, margin: float = 0.0) -> NDArray[np.bool_]:
    """Which of the points (N, 2) lie `margin` pixels within an image's outermost pixel centres."""
    height, width = image.shape
    within = (points >= margin) & (points <= (width - 1.0 - margin, height - 1.0 - margin))
    return within[:, 0] & within[:, 1]


def patch_radius(side: int, reach: int) -> int:
    """Of patches in which windows of `side` can be followed over `reach` pixels."""
    return side // 2 + reach + _FRINGE


def whole_images(image1: Image, image2: Image, points1: Array, guess: Array, side: int,
                 levels: int, criteria: Criteria) -> Flow:
    """`follow` as OpenCV does it, over any distance."""
    points2, status, eigenvalues = cv2.calcOpticalFlowPyrLK(
        image1, image2, points1.astype(np.float32, order='C'),
        guess.astype(np.float32, order='C'), winSize=(side, side), maxLevel=levels - 1,
        criteria=criteria, flags=cv2.OPTFLOW_USE_INITIAL_FLOW | cv2.OPTFLOW_LK_GET_MIN_EIGENVALS)
    return Flow(np.asarray(points2, dtype=np.float64), np.asarray(status)[:, 0] == 1,
                _SCHARR * np.asarray(eigenvalues, dtype=np.float64)[:, 0])


def _near(image1: Image, image2: Image, points1: Array, guess: Array, side: int, radius: int,
          criteria: Criteria) -> Flow:
    """On patches, which end `_REACH` pixels from the guess."""
    first, second = cut(image1, points1, radius), cut(image2, guess, radius)
    flow = whole_images(first.image, second.image, points1 + first.shifts,
                        guess + second.shifts, side, 1, criteria)
    points2 = flow.points - second.shifts
    near = (np.abs(points2 - guess) <= _REACH).all(axis=1)
    return Flow(points2, flow.found & near, flow.strength)
