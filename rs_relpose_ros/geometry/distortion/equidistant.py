"""OpenCV's fisheye model, 'equidistant' in REP-104: the angle off the axis becomes the radius."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel

Array = NDArray[np.float64]


@kernel
def distort(x: float, y: float, k: Array, out: Array) -> None:
    """As `DistortionModel.distort`; `k` (4,)."""
    r2 = x * x + y * y
    r = math.sqrt(r2)
    theta = math.atan(r)
    t2 = theta * theta
    angle = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
    if r < 1e-8:
        scale, slope = 1.0, 0.0
    else:
        scale = angle / r
        by_theta = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (
            7.0 * k[2] + t2 * 9.0 * k[3])))
        # (d scale / d r) / r
        slope = (by_theta / (1.0 + r2) - scale) / r2
    out[0], out[1] = scale * x, scale * y
    out[2], out[3] = scale + slope * x * x, slope * x * y
    out[4], out[5] = slope * x * y, scale + slope * y * y


@kernel
def first_guess(u: float, v: float, out: Array) -> None:
    """The ideal fisheye's point: from the distorted one, Newton overshoots far off the axis."""
    out[0], out[1] = u, v
    angle = math.sqrt(u * u + v * v)
    if angle > 1e-8:
        scale = math.tan(min(angle, 1.5)) / angle
        out[0], out[1] = u * scale, v * scale
