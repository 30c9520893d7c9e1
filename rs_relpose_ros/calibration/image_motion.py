"""What the motion in the images shows before anything is fitted: two views, or stabilised images.

The image motion of one camera is smooth over the image, but for parallax: a quadratic function of
the pixel. Where two views of a stereo camera are published as one image, it begins again in the
middle: both halves have the same function, each of its own pixels. Both hypotheses have equally
many unknowns.

A stabilised lens, sensor or video holds the view while the camera shakes, and follows it when it
pans. The rates of the images are compared with the gyro in two bands. A wrong focal length, or a
part of the view that turns with the camera, lowers the gain in both of them alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.core.losses import cauchy_weight, robust_scale
from rs_relpose_ros.geometry import Array

# -- Two views in one image ---------------------------------------------------------------------

# Points that each half of an image needs. Fewer than twice the unknowns fit any motion.
# [chosen: 15 to 40 would do]
_LEAST_POINTS = 20
# Pairs that are needed. [chosen: 5 to 20 would do]
_LEAST_PAIRS = 8
# Share of the residual of one view that two views leave in the median of the pairs. One camera
# that only turns to the side has the same motion everywhere, which both fit alike: about 1.
# [measured: 0.33 and 0.43 of two views; 1.2 to 4.7 of one view, 0.9 with a large object]
_LEFT_OF_TWO = 0.65
# Rounds of weights. [chosen: 2 to 6 would do]
_ROUNDS = 4
# Least scale of residuals [px]. [chosen: below that of any tracker]
_LEAST_SCALE = 0.02


def repeated_axis(pairs: Sequence[tuple[Array, Array]], size: tuple[int, int]) -> int | None:
    """Axis of the pixels along which two views lie, 0 (beside) or 1 (above); None for one view.

    `pairs` are points (N, 2) each in two images of a `size` of width and height [px].
    """
    for axis in (0, 1):
        shares = [share for pair in pairs if (share := _left(*pair, size, axis)) is not None]
        if len(shares) >= _LEAST_PAIRS and np.median(shares) < _LEFT_OF_TWO:
            return axis
    return None


def _left(first: Array, second: Array, size: tuple[int, int], axis: int) -> float | None:
    """Residual of two views over that of one; None for too few points in one of the halves."""
    half = 0.5 * size[axis]
    in_second = first[:, axis] >= half
    if min(np.count_nonzero(in_second), np.count_nonzero(~in_second)) < _LEAST_POINTS:
        return None
    motion = second - first
    # A point that crosses the border between the views belongs to neither.
    same_side = (second[:, axis] >= half) == in_second
    own = first.copy()
    own[:, axis] = np.where(in_second, own[:, axis] - half, own[:, axis])
    sizes = np.array(size, dtype=np.float64)
    sizes_of_view = sizes.copy()
    sizes_of_view[axis] = half
    one = _residual(first[same_side] / sizes, motion[same_side])
    two = _residual(own[same_side] / sizes_of_view, motion[same_side])
    return two / one


def _residual(places: Array, motion: Array) -> float:
    """Median residual [px] of the quadratic function of places (N, 2) that fits motions (N, 2)."""
    x, y = 2.0 * places.T - 1.0
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    weights = np.ones(len(x))
    sizes = np.zeros(len(x))
    for _ in range(_ROUNDS):
        root = np.sqrt(weights)[:, None]
        solution = np.linalg.lstsq(root * design, root * motion, rcond=None)[0]
        sizes = np.linalg.norm(motion - design @ solution, axis=1)
        scale = max(float(np.median(sizes)), _LEAST_SCALE)
        weights = np.asarray(cauchy_weight((sizes / scale) ** 2))
    return max(float(np.median(sizes)), _LEAST_SCALE)


# -- Stabilised images --------------------------------------------------------------------------

# Time [s] of the running mean that separates the bands. Stabilisation holds a view for tenths of a
# second. [chosen: 0.2 to 0.6 would do]
_MEAN = 0.35
# Gain of the fast band, over that of the slow one, below which images are stabilised.
# [measured: 0.3 to 0.5 with 0.8 to 0.9 of the fast rotation compensated; from 0.75 on of eighteen
# simulated and five real recordings without]
_LOWER = 0.6
# Rms of the rates of the gyro in the fast band [rad/s] below which nothing shows.
# [chosen: 0.5 deg/s; a hand has some degrees per second]
_LEAST_RATE = 0.01
# Least number of rates. [chosen: 2 s at 30 Hz]
_FEWEST = 60
# Scale of the weights, in sigmas of the differences. [chosen: 1.5 to 4 would do]
_SCALE = 2.0
# Least scale of rates [rad/s]. [chosen: below the noise of any tracker]
_LEAST_RATE_SCALE = 1e-4


class Gains(NamedTuple):
    """Rates of images over those of the gyro."""

    fast: float
    slow: float

    @property
    def are_stabilised(self) -> bool:
        """Whether the images follow slow rotations only."""
        return self.fast < _LOWER * min(self.slow, 1.0)


def gains(images: Array, gyro: Array, interval: float) -> Gains | None:
    """Gains of rates (N, 3) of images in both bands, in the order of time; None for too little.

    `gyro` (N, 3) are those of the gyro in the axes of the camera, and `interval` [s] is between
    two of them. Rotations about the optical axis are not stabilised by a lens, and not used.
    """
    count = 2 * round(0.5 * _MEAN / interval) + 1
    if len(images) < max(_FEWEST, 4 * count):
        return None
    inner = slice(count, -count)
    bands: list[float] = []
    for of_images, of_gyro in _bands(images[:, :2], gyro[:, :2], count):
        own, other = of_gyro[inner].ravel(), of_images[inner].ravel()
        bands.append(_slope(own, other))
        if np.sqrt(np.mean(own**2)) < _LEAST_RATE:
            return None
    return Gains(*bands)


def _bands(images: Array, gyro: Array, count: int) -> list[tuple[Array, Array]]:
    """Rates of images and gyro in the fast and the slow band, without their means."""
    kernel = np.full(count, 1.0 / count)
    slow = [
        np.stack([np.convolve(column, kernel, mode='same') for column in rates.T], axis=1)
        for rates in (images, gyro)
    ]
    of_images, of_gyro = slow
    return [
        (images - of_images, gyro - of_gyro),
        (of_images - of_images.mean(axis=0), of_gyro - of_gyro.mean(axis=0)),
    ]


def _slope(x: Array, y: Array) -> float:
    """Slope of y (N,) over x (N,), with less weight for outliers."""
    weights = np.ones(len(x))
    slope = 0.0
    for _ in range(_ROUNDS):
        slope = float((weights * x * y).sum() / max((weights * x * x).sum(), _LEAST_RATE_SCALE**2))
        off = y - slope * x
        scale = _SCALE * robust_scale(off, _LEAST_RATE_SCALE, 0.0)
        weights = np.asarray(cauchy_weight((off / scale) ** 2))
    return slope
