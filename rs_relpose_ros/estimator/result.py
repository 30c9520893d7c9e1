"""The relative pose of two frames, or the reason why there is none."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.estimator.image_information import ImageInformation
from rs_relpose_ros.estimator.inertial_evidence import InertialEvidence
from rs_relpose_ros.geometry.so3 import skew

Array = NDArray[np.float64]


class Status(str, Enum):
    """Outcome of a frame pair; only `OK` carries a full pose."""

    OK = 'OK'
    TOO_FEW_MATCHES = 'TOO_FEW_MATCHES'
    NO_CONSENSUS = 'NO_CONSENSUS'
    LOW_PARALLAX = 'LOW_PARALLAX'
    PURE_ROTATION = 'PURE_ROTATION'
    BAD_INPUT = 'BAD_INPUT'
    WITHHELD = 'WITHHELD'   # what was told of camera or IMU is wrong, so the pose would be


def _nan(*shape: int) -> Array:
    return np.full(shape, np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """Pose of camera 2 in camera 1, ``X1 = R X2 + t`` with ``|t| = 1``; falsy without a pose.

    Attributes
    ----------
    status : Status
        `PURE_ROTATION` and `LOW_PARALLAX` still fill `R` and its part of `covariance`.
    reason : str
        One sentence; empty when there is a pose.
    R : (3, 3) ndarray
        ``R_1^T R_2``, between the two frames' reference rows.
    t : (3,) ndarray
        Unit direction of ``R_1^T (p_2 - p_1)``; NaN where it is not known.
    linear_velocity1, linear_velocity2 : (3,) ndarray
        Each in its own camera's frame [baselines per second].
    angular_velocity1, angular_velocity2 : (3,) ndarray
        As corrected by the estimate [rad/s], each in its own camera's frame.
    inliers : (N,) ndarray of bool
        One per match.
    covariance : (6, 6) ndarray
        Of ``(dt, dtheta)`` with ``t_true = t + dt`` (dt perpendicular to t) and
        ``R_true = Exp(dtheta) R``, both in camera 1; NaN where `t` or `R` is.
    velocity_covariance : (6, 6) ndarray
        Of `linear_velocity2` and `angular_velocity2`, in camera 2; NaN where they are not known.
    model : str
        'uniform', 'angular', 'linear' or 'global'.
    baseline : float
        Length of the translation [m]; NaN where it is not known: images and gyro do not tell it.
    baseline_log_sigma : float
        1 sigma of its logarithm.
    baseline_reason : str
        Why the baseline is not known; empty where it is, and without a pose.
    images : ImageInformation or None
        What the images alone say of it, without the priors of the IMU; None where they say
        nothing.
    inertial_evidence : InertialEvidence or None
        Whether the images show the acceleration that was given (`inertial`); None where nothing
        tells.
    pixels1_gs, pixels2_gs : (N, 2) ndarray or None
        Where global shutters at the instants of the reference rows would see the matches, on the
        sensor [px]: NaN for outliers; None unless asked for, and without a pose.
    velocity_sigma : float
        Prior sigma of the linear velocities that was used [baselines per second].
    iterations : int
        Hypothesis samples drawn.
    residual_rms : float
        Root mean square Sampson error of the inliers [px].
    duration : float
        Time of the estimate [s].
    """

    status: Status
    reason: str = ''
    R: Array = field(default_factory=lambda: _nan(3, 3))
    t: Array = field(default_factory=lambda: _nan(3))
    linear_velocity1: Array = field(default_factory=lambda: _nan(3))
    linear_velocity2: Array = field(default_factory=lambda: _nan(3))
    angular_velocity1: Array = field(default_factory=lambda: _nan(3))
    angular_velocity2: Array = field(default_factory=lambda: _nan(3))
    inliers: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    covariance: Array = field(default_factory=lambda: _nan(6, 6))
    velocity_covariance: Array = field(default_factory=lambda: _nan(6, 6))
    model: str = ''
    baseline: float = float('nan')
    baseline_log_sigma: float = float('nan')
    baseline_reason: str = ''
    images: ImageInformation | None = None
    inertial_evidence: InertialEvidence | None = None
    pixels1_gs: Array | None = None
    pixels2_gs: Array | None = None
    velocity_sigma: float = float('nan')
    iterations: int = 0
    residual_rms: float = float('nan')
    duration: float = float('nan')

    def __bool__(self) -> bool:
        """Whether there is a pose."""
        return self.status is Status.OK

    @property
    def rotation_known(self) -> bool:
        """Whether `R` and its covariance are known; of every pose they are."""
        return bool(np.isfinite(self.R).all())

    @property
    def metric_velocity1(self) -> Array:
        """`linear_velocity1` (3,) in m/s; NaN where the baseline is not known."""
        return self.baseline * self.linear_velocity1

    @property
    def metric_velocity2(self) -> Array:
        """`linear_velocity2` (3,) in m/s; NaN where the baseline is not known."""
        return self.baseline * self.linear_velocity2

    def without_translation(self, status: Status, reason: str) -> RelativePose:
        """The same with the rotation alone, and why."""
        covariance, velocity_covariance = self.covariance.copy(), self.velocity_covariance.copy()
        for matrix in (covariance, velocity_covariance):
            matrix[:3] = matrix[:, :3] = np.nan
        return replace(
            self, status=status, reason=reason, t=_nan(3), linear_velocity1=_nan(3),
            linear_velocity2=_nan(3), covariance=covariance, baseline=float('nan'),
            baseline_log_sigma=float('nan'), baseline_reason='',
            images=None if self.images is None else self.images.of_rotation(),
            velocity_covariance=velocity_covariance)

    def without_baseline(self, reason: str) -> RelativePose:
        """The same with a baseline that is not known, and why."""
        return replace(self, baseline=float('nan'), baseline_log_sigma=float('nan'),
                       baseline_reason=reason)

    def inverse(self) -> RelativePose:
        """Pose of camera 1 in camera 2, covariance and velocities exchanged accordingly.

        Without `images`: their information is about this pose, in the axes of camera 1.
        """
        R_inv = self.R.T
        # t' = -R^T t: dt' = -R^T (dt + t x dtheta); theta' = -R^T theta.
        tx = skew(self.t)
        jacobian = np.zeros((6, 6))
        jacobian[:3, :3] = -R_inv
        jacobian[:3, 3:] = -R_inv @ tx
        jacobian[3:, 3:] = -R_inv
        covariance = jacobian @ self.covariance @ jacobian.T
        # Known without a translation, too, whose NaN the product spreads.
        covariance[3:, 3:] = R_inv @ self.covariance[3:, 3:] @ self.R
        return RelativePose(
            status=self.status, reason=self.reason, R=R_inv, t=-R_inv @ self.t,
            linear_velocity1=self.linear_velocity2, linear_velocity2=self.linear_velocity1,
            angular_velocity1=self.angular_velocity2, angular_velocity2=self.angular_velocity1,
            inliers=self.inliers, covariance=covariance, baseline=self.baseline,
            baseline_log_sigma=self.baseline_log_sigma, baseline_reason=self.baseline_reason,
            model=self.model, velocity_sigma=self.velocity_sigma, iterations=self.iterations,
            residual_rms=self.residual_rms, duration=self.duration)

