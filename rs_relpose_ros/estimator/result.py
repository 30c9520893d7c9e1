"""The relative pose of two frames, or the reason why there is none; landmarks of its inliers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum
import math
from typing import Any, NamedTuple
import warnings

import numpy as np

from rs_relpose_ros.core.triangulate import scaled_depths
from rs_relpose_ros.estimator.covariance import ImageInformation
from rs_relpose_ros.estimator.velocity import InertialEvidence
from rs_relpose_ros.geometry import Array, Flags
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.so3 import add, rotated, scale, skew, subtract
from rs_relpose_ros.jit import kernel


class Status(str, Enum):
    """Outcome of a frame pair; only `OK` carries a full pose."""

    OK = 'OK'
    TOO_FEW_MATCHES = 'TOO_FEW_MATCHES'
    NO_CONSENSUS = 'NO_CONSENSUS'
    LOW_PARALLAX = 'LOW_PARALLAX'
    PURE_ROTATION = 'PURE_ROTATION'
    BAD_INPUT = 'BAD_INPUT'
    WITHHELD = 'WITHHELD'  # a configured parameter of camera or IMU contradicts the data


# Begin of the reason of a pair whose images reject the rotation of the gyro. The odometry, which
# has the pair as a message, reads it there. [derived: text for people, too]
GYRO_CONTRADICTION = 'images and gyro contradict each other'


def _nan(*shape: int) -> Callable[[], Array]:
    """Maker of an array of NaN, for the default of a field."""
    return lambda: np.full(shape, math.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Diagnostics:
    """How a pose was estimated.

    Attributes
    ----------
    model : str
        'uniform', 'angular', 'linear' or 'global'.
    iterations : int
        Hypothesis samples drawn.
    residual_rms : float
        Root mean square Sampson error of the inliers [px].
    pixel_sigma : float
        Noise of a match as estimated from the residuals, 1 sigma per coordinate [px].
    velocity_sigma : float
        Prior sigma of the linear velocities that was used [baselines per second].
    frames : int
        Number of views that the pose was estimated from; 2 without frames between.
    frames_reason : str
        Why given frames between were not used; empty if they were.
    gyro_square : float
        Chi-square of the rotation from all frames by that of the gyro, 3 degrees of freedom.
    baseline_reason : str
        Why the baseline is not known; empty if it is, and without a pose.
    inertial_evidence : InertialEvidence or None
        Whether the images are consistent with the given acceleration (`inertial`); None if that
        is not observable.
    rejected : RelativePose or None
        The estimate of two views that images and gyro contradict; then the pose is falsy.
    duration : float
        Time of the estimate [s].
    """

    model: str = ''
    iterations: int = 0
    residual_rms: float = math.nan
    pixel_sigma: float = math.nan
    velocity_sigma: float = math.nan
    frames: int = 2
    frames_reason: str = ''
    gyro_square: float = math.nan
    baseline_reason: str = ''
    inertial_evidence: InertialEvidence | None = None
    rejected: RelativePose | None = None
    duration: float = math.nan


def _of_diagnostics(name: str) -> Any:
    """A property of a pose that is an attribute of its diagnostics; to read it gives a warning."""
    text = f'RelativePose.{name} is deprecated and ends with 0.6.0: use .diagnostics.{name}'

    def read(pose: RelativePose) -> Any:
        warnings.warn(text, DeprecationWarning, stacklevel=2)
        return getattr(pose.diagnostics, name)

    return property(read, doc=f'Deprecated since 0.4.0: `diagnostics.{name}`.')


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """Pose of camera 2 in camera 1, ``X1 = R X2 + t`` with ``|t| = 1``; falsy without a pose.

    The attributes of `diagnostics` are also attributes of the pose, which are deprecated.

    Attributes
    ----------
    status : Status
        `PURE_ROTATION` and `LOW_PARALLAX` still fill `R` and its part of `covariance`.
    reason : str
        One line; empty if there is a pose.
    R : (3, 3) ndarray
        ``R_1^T R_2``, between the two frames' reference rows.
    t : (3,) ndarray
        Unit direction of ``R_1^T (p_2 - p_1)``; NaN if not known.
    covariance : (6, 6) ndarray
        Of ``(dt, dtheta)`` with ``t_true = t + dt`` (dt perpendicular to t) and
        ``R_true = Exp(dtheta) R``, both in camera 1; NaN where `t` or `R` is.
    linear_velocity1, linear_velocity2 : (3,) ndarray
        Each in its own camera's frame [baselines per second].
    linear_velocity1_covariance : (3, 3) ndarray
        In camera 1; NaN without frames between.
    angular_velocity1, angular_velocity2 : (3,) ndarray
        As corrected by the estimate [rad/s], each in its own camera's frame.
    velocity_covariance : (6, 6) ndarray
        Of `linear_velocity2` and `angular_velocity2`, in camera 2; NaN if they are not known.
    baseline : float
        Length of the translation [m]; NaN if not known: not observable from images and gyro.
    baseline_log_sigma : float
        1 sigma of its logarithm.
    inliers : (N,) ndarray of bool
        One per match.
    images : ImageInformation or None
        Information of the images alone, without the priors of the IMU; None if there is none.
    by_deviation : (6, K) ndarray or None
        Change of ``(dt, dtheta)`` by the deviations `LIVE` of `core.deviations`, if the pose is
        from all frames of the pair; None if it was not computed.
    pixels1_gs, pixels2_gs : (N, 2) ndarray or None
        Equivalent global-shutter pixels of the matches at the times of the reference rows, on the
        sensor: NaN for outliers; None unless requested, and without a pose.
    diagnostics : Diagnostics
        How the pose was estimated.
    """

    status: Status
    reason: str = ''
    R: Array = field(default_factory=_nan(3, 3))
    t: Array = field(default_factory=_nan(3))
    covariance: Array = field(default_factory=_nan(6, 6))
    linear_velocity1: Array = field(default_factory=_nan(3))
    linear_velocity1_covariance: Array = field(default_factory=_nan(3, 3))
    linear_velocity2: Array = field(default_factory=_nan(3))
    angular_velocity1: Array = field(default_factory=_nan(3))
    angular_velocity2: Array = field(default_factory=_nan(3))
    velocity_covariance: Array = field(default_factory=_nan(6, 6))
    baseline: float = math.nan
    baseline_log_sigma: float = math.nan
    inliers: Flags = field(default_factory=lambda: np.zeros(0, dtype=bool))
    images: ImageInformation | None = None
    by_deviation: Array | None = None
    pixels1_gs: Array | None = None
    pixels2_gs: Array | None = None
    diagnostics: Diagnostics = Diagnostics()

    def __bool__(self) -> bool:
        """Whether there is a pose."""
        return self.status is Status.OK

    @property
    def rotation_known(self) -> bool:
        """Whether `R` and its covariance are known, as of every pose."""
        return bool(np.isfinite(self.R).all())

    @property
    def metric_velocity1(self) -> Array:
        """`linear_velocity1` (3,) in m/s; NaN if the baseline is not known."""
        return self.baseline * self.linear_velocity1

    @property
    def metric_velocity2(self) -> Array:
        """`linear_velocity2` (3,) in m/s; NaN if the baseline is not known."""
        return self.baseline * self.linear_velocity2

    def diagnosed(self, **changes: Any) -> RelativePose:
        """The same with other `diagnostics`."""
        return replace(self, diagnostics=replace(self.diagnostics, **changes))

    def without_translation(
        self,
        status: Status,
        reason: str,
    ) -> RelativePose:
        """The same with the rotation alone, and the reason."""
        covariance = self.covariance.copy()
        velocity_covariance = self.velocity_covariance.copy()
        for matrix in (covariance, velocity_covariance):
            matrix[:3] = matrix[:, :3] = np.nan
        nothing = RelativePose(status)
        return replace(
            self.without_baseline(''),
            status=status,
            reason=reason,
            t=nothing.t,
            covariance=covariance,
            linear_velocity1=nothing.linear_velocity1,
            linear_velocity1_covariance=nothing.linear_velocity1_covariance,
            linear_velocity2=nothing.linear_velocity2,
            velocity_covariance=velocity_covariance,
            images=None if self.images is None else self.images.of_rotation(),
        )

    def without_baseline(self, reason: str) -> RelativePose:
        """The same without a baseline, and the reason."""
        unknown = replace(self, baseline=math.nan, baseline_log_sigma=math.nan)
        return unknown.diagnosed(baseline_reason=reason)

    def inverse(self) -> RelativePose:
        """Pose of camera 1 in camera 2, covariance and velocities exchanged accordingly.

        Without `images`, whose information refers to this pose, in the axes of camera 1.
        """
        R_inv = self.R.T
        # t' = -R^T t: dt' = -R^T (dt + t x dtheta); theta' = -R^T theta.
        jacobian = np.kron(np.eye(2), -R_inv)
        jacobian[:3, 3:] = -R_inv @ skew(self.t)
        covariance = jacobian @ self.covariance @ jacobian.T
        # Known without a translation, too, whose NaN spreads through the product.
        covariance[3:, 3:] = R_inv @ self.covariance[3:, 3:] @ self.R
        return RelativePose(
            self.status,
            self.reason,
            R=R_inv,
            t=-R_inv @ self.t,
            covariance=covariance,
            linear_velocity1=self.linear_velocity2,
            linear_velocity2=self.linear_velocity1,
            angular_velocity1=self.angular_velocity2,
            angular_velocity2=self.angular_velocity1,
            baseline=self.baseline,
            baseline_log_sigma=self.baseline_log_sigma,
            inliers=self.inliers,
            diagnostics=replace(self.diagnostics, inertial_evidence=None),
        )

    # Attributes of releases before 0.4.0, now of `diagnostics`; they end with 0.6.0.
    model = _of_diagnostics('model')
    iterations = _of_diagnostics('iterations')
    residual_rms = _of_diagnostics('residual_rms')
    pixel_sigma = _of_diagnostics('pixel_sigma')
    velocity_sigma = _of_diagnostics('velocity_sigma')
    frames = _of_diagnostics('frames')
    frames_reason = _of_diagnostics('frames_reason')
    gyro_square = _of_diagnostics('gyro_square')
    baseline_reason = _of_diagnostics('baseline_reason')
    inertial_evidence = _of_diagnostics('inertial_evidence')
    rejected = _of_diagnostics('rejected')
    duration = _of_diagnostics('duration')


# -- Landmarks and equivalent global-shutter pixels -----------------------------------------------
#
# Camera i is at ``tau_i v_i`` in its own stamped frame at the row time of a match, so that, with
# ``d_1 = v_1`` and ``d_2 = R v_2`` as in (4) of ``docs/conventions.md``,
#
#     tau_1 d_1 + l_1 f_1 = t + tau_2 d_2 + l_2 R f_2,
#
# which determines both distances l by least squares.

# Squared sine of the angle below which rays count as parallel, and their point as infinitely far
# away: an angle of 2e-4 rad is a tenth of a pixel, so that such a distance is noise. A larger
# value would lose far landmarks. [derived: 0.1 px at a focal length of 500 px]
_PARALLEL = 4e-8


class Landmarks(NamedTuple):
    """Points of the N matches of a pair with a pose; NaN for outliers."""

    # (N, 2) equivalent global-shutter pixels at the times of the stamped rows
    pixels1: Array
    pixels2: Array
    # (N, 3) in the reference camera [baselines]; NaN if the rays are parallel or meet behind a
    # camera: their pixels are then derotated as those of a point at infinity
    points: Array


def landmarks(
    pose: RelativePose,
    rays: Array,
    row_times: Array,
    camera: RollingShutterCamera,
) -> Landmarks:
    """Landmarks of the inliers of a pose, pixels on the sensor.

    `rays` (2, N, 3): unit rays of the matches, derotated to the stamped row of their frame.
    `row_times` (2, N): of the matches, from that of the stamped row [s].
    """
    velocities = np.stack([pose.linear_velocity1, pose.linear_velocity2])
    rays, points = _equivalent_rays(pose.inliers, rays, row_times, pose.R, pose.t, velocities)
    return Landmarks(camera.project(rays[0]), camera.project(rays[1]), points)


@kernel
def _equivalent_rays(
    use: Flags,
    rays: Array,
    row_times: Array,
    R: Array,
    t: Array,
    velocities: Array,
) -> tuple[Array, Array]:
    """Rays (2, N, 3) of the inliers at the stamped rows, of any length, and points (N, 3).

    `velocities` (2, 3): of each camera in its own frame. The rest is NaN.
    """
    out = np.full(rays.shape, np.nan)
    points = np.full(rays.shape[1:], np.nan)
    for i in range(len(use)):
        if not use[i]:
            continue
        ray1 = rays[0, i]
        ray2 = rays[1, i]
        moved1 = scale(row_times[0, i], velocities[0])
        moved2 = scale(row_times[1, i], velocities[1])
        baseline = subtract(add(t, rotated(R, moved2)), moved1)
        depth1, depth2, squared_sine = scaled_depths(ray1, rotated(R, ray2), baseline)
        near = squared_sine > _PARALLEL and depth1 > 0.0 and depth2 > 0.0
        # Inverse distances: 0 at infinity.
        inverse1 = squared_sine / depth1 if near else 0.0
        inverse2 = squared_sine / depth2 if near else 0.0
        equivalent1 = add(ray1, scale(inverse1, moved1))
        equivalent2 = add(ray2, scale(inverse2, moved2))
        # The middle of the two points, which the rays give.
        point1 = scale(depth1 / squared_sine, equivalent1)
        point2 = add(t, scale(depth2 / squared_sine, rotated(R, equivalent2)))
        middle = scale(0.5, add(point1, point2))
        for j in range(3):
            out[0, i, j] = equivalent1[j]
            out[1, i, j] = equivalent2[j]
            if near:
                points[i, j] = middle[j]
    return out, points
