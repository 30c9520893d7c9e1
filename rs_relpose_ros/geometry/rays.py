"""Unit rays through points of the plane z = 1, with their derivatives."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel

Array = NDArray[np.float64]


@kernel
def rays_with_jacobian(normalized: Array, by_pixel: Array) -> tuple[Array, Array]:
    """Unit rays (N, 3) through points (N, 2) at z = 1, and their derivatives (N, 3, 2).

    `by_pixel` (N, 2, 2) holds the derivatives of the points by whatever the rays are derived by.
    """
    n = normalized.shape[0]
    rays, jacobian = np.empty((n, 3)), np.empty((n, 3, 2))
    for i in range(n):
        x, y = normalized[i, 0], normalized[i, 1]
        scale = 1.0 / math.sqrt(1.0 + x * x + y * y)
        rays[i, 0], rays[i, 1], rays[i, 2] = x * scale, y * scale, scale
        for k in range(2):
            # m = n / |n| with n = (x, y, 1): dm = (dn - m (m . dn)) / |n|.
            dx, dy = by_pixel[i, 0, k], by_pixel[i, 1, k]
            along = rays[i, 0] * dx + rays[i, 1] * dy
            jacobian[i, 0, k] = (dx - rays[i, 0] * along) * scale
            jacobian[i, 1, k] = (dy - rays[i, 1] * along) * scale
            jacobian[i, 2, k] = -rays[i, 2] * along * scale
    return rays, jacobian
