"""Distortion of many points, forwards and, by Newton's method, backwards, for any model.

``cv2.undistortPoints`` stops after five fixed-point steps, which leaves pixels of error on strong
distortion, and the calls that iterate longer differ between OpenCV 4 and 5.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.distortion.models import distort_at, first_guess_at

Array = NDArray[np.float64]


@kernel
def project_points(points: Array, distort: int, k: Array) -> Array:
    """Distorted normalised points (N, 2) of points (N, 3); NaN behind the camera.

    `distort` is the address of the model's kernel, `k` its coefficients.
    """
    nearest = 1e-9  # depth from which a point lies before the camera
    out = np.empty((points.shape[0], 2))
    values = np.empty(6)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if z > nearest:
            distort_at(distort, x / z, y / z, k, values)
            out[i, 0], out[i, 1] = values[0], values[1]
        else:
            out[i, 0], out[i, 1] = math.nan, math.nan
    return out


@kernel
def _undistort(u0: float, u1: float, distort: int, first_guess: int, k: Array,
               v: Array) -> tuple[float, float, bool]:
    """Undistorted point of one distorted point (u0, u1), and whether the search has converged.

    `v` (6,) receives what `distort` gives there.
    """
    first_guess_at(first_guess, u0, u1, v)
    x, y = v[0], v[1]
    converged = False
    for _ in range(50):
        distort_at(distort, x, y, k, v)
        e0, e1 = u0 - v[0], u1 - v[1]
        determinant = v[2] * v[5] - v[3] * v[4]
        dx = (v[5] * e0 - v[3] * e1) / determinant
        dy = (v[2] * e1 - v[4] * e0) / determinant
        length = math.sqrt(dx * dx + dy * dy)
        # A step may not leave the region in which the model is monotonic.
        limit = 0.5 * (1.0 + math.sqrt(x * x + y * y))
        if length > limit:
            dx, dy = dx * limit / length, dy * limit / length
        x, y = x + dx, y + dy
        # Relative to the point: 1e-9 px at any focal length.
        if length < 1e-13 * (1.0 + limit):
            converged = True
            break
    distort_at(distort, x, y, k, v)
    return x, y, converged


@kernel
def undistort_points(points: Array, distort: int, first_guess: int,
                     k: Array) -> tuple[Array, Array]:
    """Undistorted normalised points (N, 2) and their derivatives (N, 2, 2) by the distorted ones.

    NaN where there is no inverse. Past the turning point of the polynomial a root exists but is a
    mirror image: it counts as none.

    Parameters
    ----------
    distort, first_guess : int
        Addresses of the model's kernels.
    k : (n,) ndarray
        Its coefficients.
    """
    n = points.shape[0]
    out, inverse = np.empty((n, 2)), np.empty((n, 2, 2))
    v = np.empty(6)
    for i in range(n):
        x, y, converged = _undistort(points[i, 0], points[i, 1], distort, first_guess, k, v)
        determinant = v[2] * v[5] - v[3] * v[4]
        if not (converged and determinant > 0.0):
            x, y, determinant = math.nan, math.nan, math.nan
        out[i, 0], out[i, 1] = x, y
        inverse[i, 0, 0], inverse[i, 0, 1] = v[5] / determinant, -v[3] / determinant
        inverse[i, 1, 0], inverse[i, 1, 1] = -v[4] / determinant, v[2] / determinant
    return out, inverse
