"""Lens distortion, forwards with its derivative and backwards by Newton's method, compiled.

The models are OpenCV's (and REP-104's): the rational model, of which plumb_bob is a part, with its
thin-prism terms, and the equidistant fisheye. ``cv2.undistortPoints`` stops after five fixed-point
steps, which leaves pixels of error on strong distortion, and the calls that iterate longer differ
between OpenCV 4 and 5.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel

Array = NDArray[np.float64]

# Coefficients of the rational model: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4.
RATIONAL_COEFFICIENTS = 12
_ITERATIONS = 50
# Step [1] below which Newton has converged: 1e-9 px at any focal length.
_CONVERGED = 1e-13
# Depth from which a point lies before the camera.
_NEAREST = 1e-9


@kernel
def distort(x: float, y: float, k: Array, fisheye: bool, out: Array) -> None:
    """Distorted normalised point and its derivative: `out` (6,) = x', y', and d(x', y')/d(x, y).

    `k` holds 12 coefficients of the rational model, or 4 of the fisheye.
    """
    r2 = x * x + y * y
    if fisheye:
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
        return
    above = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    below = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    radial = above / below
    # d radial / d(r^2)
    slope = ((k[0] + r2 * (2.0 * k[1] + r2 * 3.0 * k[4]))
             - radial * (k[5] + r2 * (2.0 * k[6] + r2 * 3.0 * k[7]))) / below
    p1, p2 = k[2], k[3]
    out[0] = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (k[8] + r2 * k[9])
    out[1] = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (k[10] + r2 * k[11])
    prism_x, prism_y = k[8] + 2.0 * r2 * k[9], k[10] + 2.0 * r2 * k[11]
    cross = 2.0 * slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    out[2] = radial + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * x * prism_x
    out[3] = cross + 2.0 * y * prism_x
    out[4] = cross + 2.0 * x * prism_y
    out[5] = radial + 2.0 * slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x + 2.0 * y * prism_y


@kernel
def project_points(points: Array, k: Array, fisheye: bool) -> Array:
    """Distorted normalised points (N, 2) of points (N, 3); NaN behind the camera."""
    out = np.empty((points.shape[0], 2))
    values = np.empty(6)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if z > _NEAREST:
            distort(x / z, y / z, k, fisheye, values)
            out[i, 0], out[i, 1] = values[0], values[1]
        else:
            out[i, 0], out[i, 1] = math.nan, math.nan
    return out


@kernel
def undistort_points(points: Array, k: Array, fisheye: bool) -> tuple[Array, Array]:
    """Undistorted normalised points (N, 2) and their derivatives (N, 2, 2) by the distorted ones.

    NaN where there is no inverse. Past the turning point of the polynomial a root exists but is a
    mirror image: it counts as none.
    """
    n = points.shape[0]
    out, inverse = np.empty((n, 2)), np.empty((n, 2, 2))
    v = np.empty(6)
    for i in range(n):
        u0, u1 = points[i, 0], points[i, 1]
        x, y = u0, u1
        if fisheye:
            # The identity overshoots far off the axis; the ideal fisheye is a safe start.
            angle = math.sqrt(u0 * u0 + u1 * u1)
            if angle > 1e-8:
                scale = math.tan(min(angle, 1.5)) / angle
                x, y = u0 * scale, u1 * scale
        converged = False
        for _ in range(_ITERATIONS):
            distort(x, y, k, fisheye, v)
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
            if length < _CONVERGED * (1.0 + limit):
                converged = True
                break
        distort(x, y, k, fisheye, v)
        determinant = v[2] * v[5] - v[3] * v[4]
        if not (converged and determinant > 0.0):
            x, y, determinant = math.nan, math.nan, math.nan
        out[i, 0], out[i, 1] = x, y
        inverse[i, 0, 0], inverse[i, 0, 1] = v[5] / determinant, -v[3] / determinant
        inverse[i, 1, 0], inverse[i, 1, 1] = -v[4] / determinant, v[2] / determinant
    return out, inverse


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
