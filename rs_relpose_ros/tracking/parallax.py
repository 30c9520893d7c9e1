"""How far matches moved beyond what the camera's turn explains."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel

Array = NDArray[np.float64]


@kernel
def median_parallax(rays1: Array, rays2: Array, rotation: Array) -> float:
    """Median of ``|f_1 x R f_2|`` [about rad]; rays of NaN do not count, 0 where none does.

    Parameters
    ----------
    rays1, rays2 : (N, 3) ndarray
        Unit rays, derotated to their frames' reference rows.
    rotation : (3, 3) ndarray
        ``R_1^T R_2``.
    """
    values = np.empty(len(rays1))
    count = 0
    for i in range(len(rays1)):
        x, y, z = rays1[i, 0], rays1[i, 1], rays1[i, 2]
        u = (rotation[0, 0] * rays2[i, 0] + rotation[0, 1] * rays2[i, 1]
             + rotation[0, 2] * rays2[i, 2])
        v = (rotation[1, 0] * rays2[i, 0] + rotation[1, 1] * rays2[i, 1]
             + rotation[1, 2] * rays2[i, 2])
        w = (rotation[2, 0] * rays2[i, 0] + rotation[2, 1] * rays2[i, 1]
             + rotation[2, 2] * rays2[i, 2])
        a, b, c = y * w - z * v, z * u - x * w, x * v - y * u
        value = math.sqrt(a * a + b * b + c * c)
        if not math.isnan(value):
            values[count] = value
            count += 1
    return float(np.median(values[:count])) if count else 0.0
