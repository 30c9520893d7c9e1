"""Two frames and their matches: what images and IMU say of them, given to the estimator.

The same for keyframes, whose corners were followed (`pipeline.py`), and for chosen frames, however
far apart (`chosen_pairs.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.estimator.estimate import estimate_relative_pose
from rs_relpose_ros.estimator.inertial_evidence import inertial_evidence, InertialEvidence
from rs_relpose_ros.estimator.landmarks import Landmarks, landmarks
from rs_relpose_ros.estimator.problem import build_problem
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.estimator.velocities_expected import velocities_expected
from rs_relpose_ros.front_end.derotated_rays import DerotatedRays, median_parallax, Sensor
from rs_relpose_ros.front_end.frame import Frame, pose_row_delay
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.geometry.inertial import InertialMotion
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.so3 import aligning_rotation
from rs_relpose_ros.geometry.timing import seconds_between, to_nanoseconds
from rs_relpose_ros.images.gray_levels import is_dark
from rs_relpose_ros.imu.forces import ForceSegment
from rs_relpose_ros.imu.frame_imu import FrameImu, GyroSegment
from rs_relpose_ros.imu.integration import integrate_rotation
from rs_relpose_ros.imu.preintegration import inertial_motion
from rs_relpose_ros.tracking.matches import Matches

Array = NDArray[np.float64]

# Largest 1 sigma of the gravity direction that the estimator takes [rad].
_LARGEST_GRAVITY_SIGMA = 1.5
_LACK_OF_MATCHES = (Status.TOO_FEW_MATCHES, Status.NO_CONSENSUS)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A frame with what the IMU says of it."""

    frame: Frame
    imu: FrameImu


@dataclass(frozen=True, slots=True, eq=False)
class GyroTurn:
    """``R_1^T R_2`` of two frames by the gyro, its covariance, and what was integrated."""

    rotation: Array
    covariance: Array
    segment: GyroSegment

    @classmethod
    def of(cls, segment: GyroSegment, config: ImuConfig) -> GyroTurn:
        """The turn over a segment."""
        return cls(*integrate_rotation(segment.stamps_ns, segment.angular_velocities, config,
                                       segment.bias_sigma), segment)


class _GravityPrior(NamedTuple):
    """Motions of both frames, with gravity where it is used, and its sigma for the estimator."""

    motion1: FrameMotion
    motion2: FrameMotion
    sigma: float


def interval_of(first: View, second: View) -> float:
    """Seconds between the stamped rows of two frames."""
    return seconds_between(first.imu.reference_ns, second.imu.reference_ns)


def inertial_of(first: View, second: View, gyro: GyroTurn | None, forces: ForceSegment | str,
                parameters: Parameters) -> InertialMotion | str:
    """What the accelerometer says of a pair, or why it says nothing.

    `gyro` and `forces` (or why these are not known) reach from the one frame to the other.
    """
    if not parameters.pair.use_accelerometer:
        return 'use_accelerometer is false'
    if not parameters.pair.use_gyro_rotation:
        # The gyro turns what the accelerometer feels.
        return 'use_gyro_rotation is false'
    if gyro is None:
        return 'the gyro has a gap'
    if isinstance(forces, str):
        return forces
    return inertial_motion(gyro.segment, forces, first.imu, second.imu, parameters.imu)


def estimate_pair(first: View, second: View, matches: Matches, sensor: Sensor,
                  gyro: GyroTurn | None, inertial: InertialMotion | str, parameters: Parameters, *,
                  interval: float | None, stamp_sigma: float = 0.0) -> RelativePose:
    """The relative pose of two frames, of whatever is known of them.

    `interval` [s]: None where the time between them says nothing of the velocities.
    `stamp_sigma` [s]: scatter of the stamps, where it is larger than the parameter.
    """
    told = gyro if parameters.pair.use_gyro_rotation else None
    gravity = _gravity_prior(first.imu, second.imu, parameters)
    pose = estimate_relative_pose(
        sensor.intrinsics.to_sensor(matches.points1), sensor.intrinsics.to_sensor(matches.points2),
        sensor.camera, gravity.motion1, gravity.motion2,
        relative_rotation=None if told is None else told.rotation,
        relative_rotation_covariance=None if told is None else told.covariance,
        interval=interval,
        config=replace(parameters.estimator, gravity_sigma=gravity.sigma, stamp_sigma=max(
            parameters.estimator.stamp_sigma, stamp_sigma)),
        quality=matches.quality,
        inertial=None if isinstance(inertial, str) else inertial,
        rng=np.random.default_rng([parameters.pair.seed, first.frame.stamp_ns,
                                   second.frame.stamp_ns]))
    if isinstance(inertial, str):
        pose = pose.without_baseline(f'baseline not known: {inertial}')
    if pose.status in _LACK_OF_MATCHES and is_dark(second.frame.image):
        pose = replace(pose, reason=f'the image is dark: {pose.reason}')
    return pose


def evidence_without(pose: RelativePose, first: View, second: View, sensor: Sensor,
                     gyro: GyroTurn, inertial: InertialMotion,
                     parameters: Parameters) -> InertialEvidence | None:
    """What the images of a pair say of an acceleration that was not used; None where nothing."""
    if pose.images is None:
        return None
    nothing, interval = np.empty((0, 2)), interval_of(first, second)
    problem = build_problem(nothing, nothing, sensor.camera, first.imu.motion, second.imu.motion,
                            gyro.rotation, gyro.covariance)
    motion = parameters.estimator.motion
    return inertial_evidence(problem, pose.images, motion, interval, velocities_expected(
        problem, motion, interval, inertial)[0])


def parallax_of(rays1: DerotatedRays, rays2: DerotatedRays, gyro: GyroTurn | None,
                sensor: Sensor) -> float:
    """Median parallax [px] of matched rays, beyond what the rotation explains."""
    rotation = aligning_rotation(rays1.rays.T @ rays2.rays) if gyro is None else gyro.rotation
    return sensor.camera.fx * median_parallax(rays1.rays, rays2.rays, rotation)


def pair_result(first: View, second: View, matches: Matches, rays1: DerotatedRays,
                rays2: DerotatedRays, pose: RelativePose, gyro: GyroTurn | None, sensor: Sensor,
                parameters: Parameters) -> PairResult:
    """The pair with its pose, and with what follows from it."""
    later_ns = to_nanoseconds(pose_row_delay(sensor.camera, parameters.sensor))
    return PairResult(
        reference_stamp_ns=first.frame.stamp_ns + later_ns,
        stamp_ns=second.frame.stamp_ns + later_ns,
        reference_ns1=first.imu.reference_ns, reference_ns2=second.imu.reference_ns,
        frame_id=second.frame.frame_id, interval=interval_of(first, second), pose=pose,
        matches=matches, row_times1=rays1.row_times, row_times2=rays2.row_times,
        rays1=rays1.rays, rays2=rays2.rays, parallax=parallax_of(rays1, rays2, gyro, sensor),
        landmarks=_landmarks(pose, rays1, rays2, sensor) if pose else None,
        gyro_rotation=None if gyro is None else gyro.rotation,
        gyro_bias=None if gyro is None else parameters.sensor.R_cam_imu.T @ gyro.segment.bias)


def _landmarks(pose: RelativePose, rays1: DerotatedRays, rays2: DerotatedRays,
               sensor: Sensor) -> Landmarks:
    """Landmarks with pixels of the published images."""
    found = landmarks(pose, rays1.rays, rays2.rays, rays1.row_times, rays2.row_times,
                      sensor.camera)
    to_image = sensor.intrinsics.to_image
    return found._replace(pixels1=to_image(found.pixels1), pixels2=to_image(found.pixels2))


def _gravity_prior(imu1: FrameImu, imu2: FrameImu, parameters: Parameters) -> _GravityPrior:
    """Gravity as the estimator is to use it: of both frames, or of none."""
    sigma1, sigma2 = imu1.gravity_sigma, imu2.gravity_sigma
    told = parameters.estimator.gravity_sigma
    if not parameters.pair.use_gravity or sigma1 is None or sigma2 is None:
        return _GravityPrior(replace(imu1.motion, gravity=None),
                             replace(imu2.motion, gravity=None), told)
    # One sigma for both frames: that of the filter where it is larger than the parameter.
    return _GravityPrior(imu1.motion, imu2.motion,
                         min(max(told, sigma1, sigma2), _LARGEST_GRAVITY_SIGMA))
