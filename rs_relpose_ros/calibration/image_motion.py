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
    points = np.count_nonzero(in_second)
    if min(points, len(first) - points) < _LEAST_POINTS:
        return None
    # A point that crosses the border between the views belongs to neither.
    stays = (second[:, axis] >= half) == in_second
    in_image = first[stays]
    motion = second[stays] - in_image
    in_view = in_image.copy()
    in_view[in_second[stays], axis] -= half
    size_of_image = np.array(size, dtype=np.float64)
    size_of_view = size_of_image.copy()
    size_of_view[axis] = half
    one = _residual(in_image / size_of_image, motion)
    two = _residual(in_view / size_of_view, motion)
    return two / one


def _residual(places: Array, motion: Array) -> float:
    """Median residual [px] of the quadratic function of places (N, 2) that fits motions (N, 2)."""
    x, y = 2.0 * places.T - 1.0
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    weights = np.ones(len(x))
    scale = _LEAST_SCALE
    for _ in range(_ROUNDS):
        root = np.sqrt(weights)[:, None]
        solution, *_ = np.linalg.lstsq(root * design, root * motion, rcond=None)
        sizes = np.linalg.norm(motion - design @ solution, axis=1)
        scale = max(float(np.median(sizes)), _LEAST_SCALE)
        squares = (sizes / scale) ** 2
        weights = np.asarray(cauchy_weight(squares))
    return scale


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
    bands_of_images = _bands(images[:, :2], count)
    bands_of_gyro = _bands(gyro[:, :2], count)
    for of_images, of_gyro in zip(bands_of_images, bands_of_gyro, strict=True):
        own = of_gyro[inner].ravel()
        other = of_images[inner].ravel()
        if np.sqrt(np.mean(own**2)) < _LEAST_RATE:
            return None
        bands.append(_slope(own, other))
    return Gains(*bands)


def _bands(rates: Array, count: int) -> tuple[Array, Array]:
    """Rates (N, C) in the fast and in the slow band, without their means."""
    kernel = np.full(count, 1.0 / count)
    means = [np.convolve(column, kernel, mode='same') for column in rates.T]
    slow = np.stack(means, axis=1)
    return rates - slow, slow - slow.mean(axis=0)


def _slope(x: Array, y: Array) -> float:
    """Slope of y (N,) over x (N,), with less weight for outliers."""
    weights = np.ones(len(x))
    slope = 0.0
    for _ in range(_ROUNDS):
        power = max((weights * x * x).sum(), _LEAST_RATE_SCALE**2)
        slope = float((weights * x * y).sum() / power)
        off = y - slope * x
        scale = _SCALE * robust_scale(off, _LEAST_RATE_SCALE, 0.0)
        squares = (off / scale) ** 2
        weights = np.asarray(cauchy_weight(squares))
    return slope
