"""Parallax: motion of matches that the rotation of the camera does not explain."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.vectors import cross, norm, rotated

Array = NDArray[np.float64]


@kernel
def median_parallax(rays1: Array, rays2: Array, rotation: Array) -> float:
    """Median of ``|f_1 x R f_2|`` [about rad] of unit rays (N, 3), ``R = R_1^T R_2`` (3, 3).

    Rays of NaN do not count; 0 where none does.
    """
    values = np.empty(len(rays1))
    count = 0
    for i in range(len(rays1)):
        value = norm(cross(rays1[i], rotated(rotation, rays2[i])))
        if not math.isnan(value):
            values[count] = value
            count += 1
    return float(np.median(values[:count])) if count else 0.0
