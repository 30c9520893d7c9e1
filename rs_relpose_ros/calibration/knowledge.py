"""What is known of a lens and a gyro before a fit: priors of its parameters.

A fit estimates these parameters together with those that a node needs. What the data determine of
them is no doubt any more; the rest is in the covariance of all parameters.
"""

from enum import Enum

import numpy as np

from rs_relpose_ros.calibration import model
from rs_relpose_ros.core.deviations import ASPECT_SIGMA, OFFLINE, TANGENTIAL_SIGMA
from rs_relpose_ros.core.radial import corner_radius, prior_covariance
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera

# Parameters of the lens that are estimated if it is not known.
LENS = OFFLINE.mask('focal_log', 'distortion', 'principal_point')
# Parameters that every recording from images may contradict: the claims of a CameraInfo, square
# pixels, a lens that is centred, and the axes of a gyro.
CLAIMED = LENS | OFFLINE.mask('aspect', 'tangential', 'gyro_scale', 'gyro_skew')


class LensKnowledge(str, Enum):
    """Where the camera matrix and the distortion come from."""

    CLAIMED = 'claimed'  # by a CameraInfo, which is used as it is
    GIVEN = 'given'  # by a CameraInfo, but the lens is to be estimated
    GUESSED = 'guessed'  # by nobody


# 1 sigma of a claimed focal length (relative). A smaller one would take a wrong claim for certain,
# a larger one would leave weak recordings without a scale of the rotation.
# [chosen: what a calibration by a target leaves]
_FOCAL_SIGMA = 0.005
# 1 sigma of a claimed principal point, as a share of the longer side of the image. A smaller one
# would put the errors of a principal point on the axes. [chosen: as that of the focal length]
_CLAIMED_CENTER_SIGMA = 0.005
# 1 sigma of the principal point of an unknown lens, as a share of the longer side. A smaller one
# would hold it in the middle, a larger one lets axes and principal point trade.
# [chosen: cameras of phones and drones are within 3 %]
_CENTER_SIGMA = 0.015
# 1 sigma of the first coefficient of the distortion of a lens of which nothing is known.
# [chosen: wide lenses have -0.3]
_RADIAL_SIGMA = 0.3
# 1 sigma of the scale of each axis of the gyro. [chosen: data sheets of MEMS gyros after the
# compensation of the manufacturer]
_SCALE_SIGMA = 0.005
# 1 sigma of the skew between each two axes of the gyro [rad]. [chosen: as that of the scale]
_SKEW_SIGMA = 0.005
# 1 sigma of a gyro's bias [rad/s]. A smaller one would hold a bias of a cheap gyro at zero.
# [chosen: 1.7 deg/s, the limit of data sheets of MEMS gyros]
_BIAS_SIGMA = 0.03
# 1 sigma of the offset's change by a covariate [s/s], which is between -1 and 1.
# [derived: a stamp at one or the other end of the exposure]
_SLOPE_SIGMA = 1.0


def distortion_prior(camera: RollingShutterCamera, *, given: bool) -> Array:
    """Covariance (3, 3) of k1, k2, k3 about those of a camera.

    It is on what the lens does to the image, since large coefficients may cancel each other.
    `given` is whether the camera is that of a CameraInfo, and not a guess.
    """
    covariance = prior_covariance(corner_radius(camera))
    if not given:
        covariance[0, 0] += _RADIAL_SIGMA**2
    return covariance


def prior_information(
    camera: RollingShutterCamera, lens: LensKnowledge, square_sigma: float
) -> Array:
    """Information (GLOBAL, GLOBAL) of the parameters before the fit; zero if nothing is known.

    `square_sigma` is 1 sigma of the square of the exposure [s^2], 0 if that is given.
    """
    sigmas = np.full(model.GLOBAL, np.inf)
    sigmas[model.BIAS] = _BIAS_SIGMA
    sigmas[model.SLOPE] = _SLOPE_SIGMA
    sigmas[model.SCALE] = _SCALE_SIGMA
    sigmas[model.SKEW] = _SKEW_SIGMA
    sigmas[model.ASPECT] = ASPECT_SIGMA
    sigmas[model.TANGENTIAL] = TANGENTIAL_SIGMA
    of_center = _CENTER_SIGMA
    if lens is LensKnowledge.CLAIMED:
        sigmas[model.FOCAL] = _FOCAL_SIGMA
        of_center = _CLAIMED_CENTER_SIGMA
    sigmas[model.CENTER] = of_center * max(camera.width, camera.height)
    if square_sigma:
        sigmas[model.EXPOSURE] = square_sigma
    whole = np.diag(sigmas**-2)
    of_lens = distortion_prior(camera, given=lens is not LensKnowledge.GUESSED)
    whole[model.DISTORTION, model.DISTORTION] = np.linalg.inv(of_lens)
    return whole


def prior_covariance_of_lens(camera: RollingShutterCamera) -> Array:
    """Covariance (9, 9) of a claimed lens about its claims, before the fit."""
    information = prior_information(camera, LensKnowledge.CLAIMED, 0.0)
    return np.asarray(np.linalg.inv(information[model.LENS, model.LENS]))
