"""Depths of a point along the two rays that observe it.

With the rays f and h in one frame and the baseline b between the two places of the camera, each
at the time of its own row, the depths l are the least-squares solution of::

    l_1 f = b + l_2 h

Its cross products with h and with f, along the normal ``n = f x h``, separate the two unknowns::

    l_1 |n|^2 = (b x h) . n        l_2 |n|^2 = (b x f) . n
"""

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import cross, dot, Vector
from rs_relpose_ros.jit import kernel, small_kernel

# Square of the sine of the angle between two rays below which `depths` gives NaN.
# [chosen: an angle of 1e-9 rad; the rounding of unit rays makes angles of 1e-16 rad, and a pixel
# has 1e-3 rad, so that any value in 1e-24..1e-12 would do]
PARALLEL = 1e-18


@small_kernel
def scaled_depths(
    f: Vector | Array, h: Vector | Array, b: Vector | Array
) -> tuple[float, float, float]:
    """Depths along f and h times the squared sine between the rays, and that squared sine.

    The products have the signs of the depths, and they are finite for parallel rays, too.
    """
    normal = cross(f, h)
    return dot(cross(b, h), normal), dot(cross(b, f), normal), dot(normal, normal)


@small_kernel
def depths(f: Vector | Array, h: Vector | Array, b: Vector | Array) -> tuple[float, float, float]:
    """Depths along the unit rays f and h [units of b], and the sine of the angle between them.

    The depths are NaN and the sine is 0 if the rays are parallel.
    """
    along_f, along_h, squared_sine = scaled_depths(f, h, b)
    if squared_sine < PARALLEL:
        return math.nan, math.nan, 0.0
    return along_f / squared_sine, along_h / squared_sine, math.sqrt(squared_sine)


@kernel
def depths_of_rays(
    f: Array, h: Array, baselines: Array, parallel: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Depths (N,) along rays (N, 3) and (N, 3), and whether the depths are usable.

    A match is not usable, and both of its depths are 1, if it lies behind a camera or if the
    squared sine of the angle between its rays is at most `parallel`.
    """
    count = len(f)
    l1 = np.ones(count)
    l2 = np.ones(count)
    usable = np.zeros(count, dtype=np.bool_)
    for i in range(count):
        along_f, along_h, squared_sine = scaled_depths(f[i], h[i], baselines[i])
        in_front = along_f > 0.0 and along_h > 0.0
        if in_front and squared_sine > parallel:
            l1[i] = along_f / squared_sine
            l2[i] = along_h / squared_sine
            usable[i] = True
    return l1, l2, usable
