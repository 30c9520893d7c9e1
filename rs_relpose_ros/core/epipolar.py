"""The exact residual of a match: the rolling-shutter Sampson error in pixels, with derivatives.

All vectors of a match are in one frame: the rays f of image 1 and h of image 2, their derivatives
by the two coordinates of their pixels, and the baseline b between the places of the camera at the
times of the two rows. The rays need not have the length 1. Constraint e and residual r::

    e = (f x h) . b = 0
    r = e / sqrt(sum_k q_k^2),   q_k = de / d(pixel coordinate k)          [px]

The derivatives of a ray by its pixel include the distortion of the lens and the rotation of the
camera from row to row, so that r is in raw pixels.

Each of e and q_k is a triple product of b with one vector of image 1 and one vector of image 2.
The variation of r is therefore the variation of two triple products::

    dr = d(b . (f' x h)) + d(b . (f x h'))
    f' = c_0 f + c_1 df/du + c_2 df/dv,   h' = c_3 dh/du + c_4 dh/dv

with the factors c held constant: ``c_0 = 1 / |q|`` and ``c_k = -r q_k / |q|^2``. The functions
below name f' and h' the scaled rays.
"""

import math
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import add, copy_vector, cross, dot, scale, Vector
from rs_relpose_ros.jit import inlined_kernel, kernel

# Square of the least gradient of e by the pixels, added to every square. A ray on the epipole has
# no gradient. [chosen: gradients of a real match are above 1e-6 of the baseline per pixel, so that
# any value in 1e-40..1e-16 would do]
LEAST_SQUARE = 1e-30


class View(NamedTuple):
    """A ray of one image, and its derivatives by the pixel's coordinates u and v [1/px]."""

    ray: Vector
    by_u: Vector
    by_v: Vector


class Residual(NamedTuple):
    """The residual of a match [px], and the vectors that its derivatives need."""

    value: float
    scaled_1: Vector  # f'
    scaled_2: Vector  # h'
    inverse_gradient: float  # c_0 = 1 / |q|
    factors: tuple[float, float, float, float]  # c_1 to c_4


@inlined_kernel
def residual(first: View, second: View, baseline: Vector) -> Residual:
    """Evaluate the residual of a match."""
    # Derivatives of e by the two rays.
    by_ray_1 = cross(second.ray, baseline)
    by_ray_2 = cross(baseline, first.ray)
    e = dot(by_ray_1, first.ray)
    q1 = dot(by_ray_1, first.by_u)
    q2 = dot(by_ray_1, first.by_v)
    q3 = dot(by_ray_2, second.by_u)
    q4 = dot(by_ray_2, second.by_v)
    gradient_square = q1 * q1 + q2 * q2 + q3 * q3 + q4 * q4 + LEAST_SQUARE
    inverse = 1.0 / math.sqrt(gradient_square)
    value = e * inverse
    c = -value * inverse * inverse
    c1 = c * q1
    c2 = c * q2
    c3 = c * q3
    c4 = c * q4
    by_pixel_1 = add(scale(c1, first.by_u), scale(c2, first.by_v))
    by_pixel_2 = add(scale(c3, second.by_u), scale(c4, second.by_v))
    scaled_1 = add(scale(inverse, first.ray), by_pixel_1)
    return Residual(value, scaled_1, by_pixel_2, inverse, (c1, c2, c3, c4))


@inlined_kernel
def by_motion(
    first: View, second: View, baseline: Vector, at: Residual
) -> tuple[Vector, Vector, Vector]:
    """Derivatives of the residual by the baseline, and by a rotation of each image's vectors.

    A rotation vector turns the ray and its derivatives on the left.
    """
    by_baseline = add(cross(at.scaled_1, second.ray), cross(first.ray, at.scaled_2))
    by_rotation_2 = add(
        cross(second.ray, cross(baseline, at.scaled_1)),
        cross(at.scaled_2, cross(baseline, first.ray)),
    )
    # Rotating both images and the baseline together changes nothing.
    by_both = add(by_rotation_2, cross(baseline, by_baseline))
    by_rotation_1 = scale(-1.0, by_both)
    return by_baseline, by_rotation_1, by_rotation_2


@inlined_kernel
def by_rays(first: View, second: View, baseline: Vector, at: Residual) -> tuple[View, View]:
    """Derivatives of the residual by each ray and by each ray's derivatives.

    A change of the lens, for example, changes all six vectors.
    """
    # Derivatives of e by the two rays.
    by_ray_1 = cross(second.ray, baseline)
    by_ray_2 = cross(baseline, first.ray)
    c1, c2, c3, c4 = at.factors
    through_e = scale(at.inverse_gradient, by_ray_1)
    by_view_1 = View(
        add(through_e, cross(at.scaled_2, baseline)),
        scale(c1, by_ray_1),
        scale(c2, by_ray_1),
    )
    by_view_2 = View(
        cross(baseline, at.scaled_1),
        scale(c3, by_ray_2),
        scale(c4, by_ray_2),
    )
    return by_view_1, by_view_2


@inlined_kernel
def write_constraint(first: View, second: View, out: Array) -> None:
    """Write the vectors (5, 3) whose products with the baseline are e and the q_k, in this order.

    With them, residuals of a match with many baselines cost five products each
    (`square_at_baseline`).
    """
    copy_vector(cross(first.ray, second.ray), out[0])
    copy_vector(cross(first.by_u, second.ray), out[1])
    copy_vector(cross(first.by_v, second.ray), out[2])
    copy_vector(cross(first.ray, second.by_u), out[3])
    copy_vector(cross(first.ray, second.by_v), out[4])


@inlined_kernel
def square_at_baseline(constraint: Array, baseline: Vector) -> float:
    """Square of the residual [px^2] by the vectors of `write_constraint`."""
    e = dot(constraint[0], baseline)
    square = LEAST_SQUARE
    for k in range(1, 5):
        q = dot(constraint[k], baseline)
        square += q * q
    return e * e / square


class Derivatives(NamedTuple):
    """Residuals of N matches and all their derivatives (`derivatives`)."""

    residuals: Array  # (N,) [px]
    by_baseline: Array  # (N, 3)
    # (N, 2, 3) by a rotation vector on the left of all vectors of image 1, and of image 2.
    by_rotation: Array
    # (N, 2, 3, 3) by the ray of each image, and by the derivatives of this ray by u and by v.
    by_rays: Array


@kernel
def derivatives(views: Array, baselines: Array) -> Derivatives:
    """Residuals and derivatives of matches whose vectors are in one frame.

    `views` (N, 2, 3, 3) hold the ray of each image, its derivative by u and its derivative by v.
    `baselines` (N, 3) lead from the place of the camera at the row of image 1 to its place at the
    row of image 2.
    """
    n = len(views)
    out = Derivatives(
        residuals=np.empty(n),
        by_baseline=np.empty((n, 3)),
        by_rotation=np.empty((n, 2, 3)),
        by_rays=np.empty((n, 2, 3, 3)),
    )
    for i in range(n):
        first = _view(views[i, 0])
        second = _view(views[i, 1])
        baseline = (baselines[i, 0], baselines[i, 1], baselines[i, 2])
        at = residual(first, second, baseline)
        by_baseline, by_rotation_1, by_rotation_2 = by_motion(first, second, baseline, at)
        by_view_1, by_view_2 = by_rays(first, second, baseline, at)
        out.residuals[i] = at.value
        for axis in range(3):
            out.by_baseline[i, axis] = by_baseline[axis]
            out.by_rotation[i, 0, axis] = by_rotation_1[axis]
            out.by_rotation[i, 1, axis] = by_rotation_2[axis]
            for k in range(3):
                out.by_rays[i, 0, k, axis] = by_view_1[k][axis]
                out.by_rays[i, 1, k, axis] = by_view_2[k][axis]
    return out


@inlined_kernel
def _view(vectors: Array) -> View:
    """Read a ray and its derivatives from the rows of an array (3, 3)."""
    return View(
        (vectors[0, 0], vectors[0, 1], vectors[0, 2]),
        (vectors[1, 0], vectors[1, 1], vectors[1, 2]),
        (vectors[2, 0], vectors[2, 1], vectors[2, 2]),
    )
