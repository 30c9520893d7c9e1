"""Distortion models by name: kernels, the registry, and the distortion of many points.

To add a model: write its kernel and its row of `DISTORTION_MODELS`; camera, calibration and checks
use the registry only.
"""

from collections.abc import Callable
from dataclasses import dataclass
import math

import numba
import numpy as np

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.jit import kernel, KernelInterface


@kernel
def distort_equidistant(x: float, y: float, k: Array, out: Array) -> None:
    """OpenCV's fisheye model: the angle off the axis becomes the radius; `k` (4,)."""
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
def ideal_fisheye(points: Array) -> Array:
    """Undistorted points of the ideal fisheye: from the distorted ones, Newton overshoots."""
    out = points.copy()
    for i in range(len(points)):
        u, v = points[i, 0], points[i, 1]
        angle = math.sqrt(u * u + v * v)
        if angle > 1e-8:
            scale = math.tan(min(angle, 1.5)) / angle
            out[i, 0], out[i, 1] = u * scale, v * scale
    return out


@kernel
def distort_rational(x: float, y: float, k: Array, out: Array) -> None:
    """OpenCV's rational model with thin-prism terms; plumb_bob is a part of it.

    `k` (12,): k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4.
    """
    r2 = x * x + y * y
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


# In compiled code: distort_at(address, x, y, k, out).
_DISTORT = KernelInterface(numba.void, 0.0, 0.0, np.empty(1), np.empty(1))
distort_at = _DISTORT.call


@dataclass(frozen=True, slots=True)
class DistortionModel:
    """Map of a lens on points of the plane z = 1."""

    name: str   # as in sensor_msgs/CameraInfo (REP-104)
    coefficient_counts: tuple[int, ...]   # legal ones, in the order of CameraInfo and OpenCV
    size: int   # number of coefficients of `distort`; those not given are zero
    # Kernel distort(x, y, k, out): `out` (6,) = x', y', and d(x', y')/d(x, y) row by row.
    distort: Callable[[float, float, Array, Array], None]
    # Of the undistorted points (N, 2), from the distorted ones.
    first_guess: Callable[[Array], Array] = np.copy
    is_pinhole_at_zero: bool = True   # whether coefficients of zero distort nothing

    def compiled(self, coefficients: tuple[float, ...]) -> tuple[int, Array]:
        """Address of the compiled kernel `distort`, and its coefficients (size,)."""
        k = np.zeros(self.size)
        k[:len(coefficients)] = coefficients
        return _DISTORT.address(self.distort), k


DISTORTION_MODELS = {model.name: model for model in (
    DistortionModel('plumb_bob', (0, 4, 5, 8), 12, distort_rational),
    DistortionModel('rational_polynomial', (8, 12), 12, distort_rational),
    DistortionModel('equidistant', (4,), 4, distort_equidistant, ideal_fisheye,
                    is_pinhole_at_zero=False),
)}


# ``cv2.undistortPoints`` stops after five fixed-point steps, with pixels of error on strong
# distortion, and the calls that iterate longer differ between OpenCV 4 and 5.

@kernel
def project_points(points: Array, distort: int, k: Array) -> Array:
    """Distorted normalised points (N, 2) of points (N, 3); NaN behind the camera.

    `distort` is the address of the model's kernel, `k` its coefficients.
    """
    nearest = 1e-9  # least depth in front of the camera
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
def undistort_points(points: Array, first_guesses: Array, distort: int,
                     k: Array) -> tuple[Array, Array]:
    """Undistorted normalised points (N, 2) and their derivatives (N, 2, 2) by the distorted ones.

    NaN if there is no inverse. A root beyond the turning point of the polynomial is a mirror image
    and not an inverse. `distort` and `k` as in `project_points`.
    """
    n = points.shape[0]
    out, inverse = np.empty((n, 2)), np.empty((n, 2, 2))
    v = np.empty(6)
    for i in range(n):
        x, y, converged = first_guesses[i, 0], first_guesses[i, 1], False
        for _ in range(50):
            distort_at(distort, x, y, k, v)
            e0, e1 = points[i, 0] - v[0], points[i, 1] - v[1]
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
        determinant = v[2] * v[5] - v[3] * v[4]
        if not (converged and determinant > 0.0):
            x, y, determinant = math.nan, math.nan, math.nan
        out[i, 0], out[i, 1] = x, y
        inverse[i, 0, 0], inverse[i, 0, 1] = v[5] / determinant, -v[3] / determinant
        inverse[i, 1, 0], inverse[i, 1, 1] = -v[4] / determinant, v[2] / determinant
    return out, inverse
