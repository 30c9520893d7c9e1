"""What the radial coefficients of a lens do to an image, and what is known of them beforehand.

Large coefficients may cancel each other: what a lens does is the displacement of the points of an
image, over their radius, which is ``k1 r^2 + k2 r^4 + k3 r^6``. So a prior is on displacements,
and covers the displacement of a lens that is given as without distortion.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import ArrayLike

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera

# Shares of the radius of the image's corner at which the displacement by a lens has a prior. Three
# make the prior of three coefficients complete. [derived: half of the radius, the edge, between]
_PRIOR_RADII = np.array([0.5, 0.75, 1.0])
# 1 sigma of the displacement there, over the radius, of a lens that is given as without distortion
# or with one. A smaller one would hold k1 and k2 of two cameras that cancel at the edge, a larger
# one leaves their sum undetermined. [measured: 1.5 % and 1.3 % at half of the radius, 1.7 % and
# 1.3 % at the edge, of two cameras that are given as without distortion]
_PRIOR_DISPLACEMENTS = np.array([0.01, 0.015, 0.02])
# 1 sigma of k1 of a lens that may be configured wrongly by accident. A smaller one would pull the
# estimate of a lens whose distortion was left out. [chosen: wide lenses have -0.3]
WRONG_SIGMA = 0.5
# Shares of the corner's radius at which displacements are compared. Nearer to the middle there are
# few pixels. [chosen: the outer three quarters of the area]
_COMPARED_RADII = np.linspace(0.5, 1.0, 6)


def displacements(radii: ArrayLike) -> Array:
    """Derivatives (N, 3) of the displacement at radii (N,), over the radius, by k1, k2, k3."""
    squares = np.asarray(radii)[:, None] ** 2
    return np.asarray(squares ** [1, 2, 3])


def corner_radius(camera: RollingShutterCamera) -> float:
    """Radius of the corner of the image, normalised by the focal length."""
    return math.hypot(0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy)


def prior_covariance(radius: float) -> Array:
    """Covariance (3, 3) of k1, k2, k3 about those of a camera with this corner radius."""
    scaled = np.linalg.inv(_whitening(radius))
    return np.asarray(scaled @ scaled.T)


def equivalent_sigma(radius: float, covariance: Array) -> float:
    """Sigma of k1 that alone displaces as much as the covariance (3, 3) of k1, k2, k3."""
    by_coefficients = displacements(radius * _COMPARED_RADII)
    variances = np.einsum('ni,ij,nj->n', by_coefficients, covariance, by_coefficients)
    return float(np.max(np.sqrt(variances) / by_coefficients[:, 0]))


def _whitening(radius: float) -> Array:
    """Displacements (3, 3) of the prior, in their sigmas, by k1, k2, k3."""
    by_coefficients = displacements(radius * _PRIOR_RADII)
    return np.asarray(by_coefficients / _PRIOR_DISPLACEMENTS[:, None])


@functools.lru_cache(maxsize=16)
def independent_shapes(radius: float) -> Array:
    """Coefficients k1, k2, k3 (3, 3), row by row, by three independent values.

    The first value is a change of k1 alone, which may be large. The other two are what else the
    prior of the displacements leaves: combinations of all three. 1 sigma of each is WRONG_SIGMA.
    """
    whitening = _whitening(radius)
    of_first = whitening[:, :1]
    others = np.linalg.qr(of_first, mode='complete')[0][:, 1:]
    shapes = np.column_stack([np.eye(3)[:, 0], np.linalg.solve(whitening, others) / WRONG_SIGMA])
    shapes.setflags(write=False)
    return shapes


def independent_sigmas(radius: float, sigma: float) -> Array:
    """1 sigma (3,) of the values of `independent_shapes` of a lens that was calibrated.

    `sigma` is the one of k1 that displaces as much as the errors of k1, k2, k3. Their covariance
    has the shape of the prior.
    """
    of_prior = equivalent_sigma(radius, prior_covariance(radius))
    first = 1.0 / float(np.linalg.norm(_whitening(radius)[:, 0]))
    return np.asarray(sigma / of_prior * np.array([first, WRONG_SIGMA, WRONG_SIGMA]))
