"""Frames in, keyframe pairs out: tracks, closes pairs, estimates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import MissingInputError
from rs_relpose_ros.estimator.estimate import estimate_relative_pose
from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.front_end.derotated_rays import DerotatedRays, median_parallax, Sensor
from rs_relpose_ros.front_end.drift import DriftTracker, PairRotation
from rs_relpose_ros.front_end.frame import Frame, sensor_camera
from rs_relpose_ros.front_end.pair import closes_pair, PairResult, SinceKeyframe
from rs_relpose_ros.front_end.stamp_scatter import StampScatter
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.so3 import aligning_rotation
from rs_relpose_ros.geometry.timing import NANOSECONDS, seconds_between
from rs_relpose_ros.imu.frame_imu import FrameImu, GyroSegment
from rs_relpose_ros.imu.integration import integrate_rotation
from rs_relpose_ros.tracking.matches import Matches
from rs_relpose_ros.tracking.tracker import make_tracker

Array = NDArray[np.float64]

# Largest 1 sigma of the gravity direction that the estimator takes [rad].
_LARGEST_GRAVITY_SIGMA = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """A processed frame."""

    frame: Frame
    imu: FrameImu


@dataclass(frozen=True, slots=True, eq=False)
class _GyroTurn:
    """``R_1^T R_2`` since the reference by the gyro, its covariance, and what was integrated."""

    rotation: Array
    covariance: Array
    segment: GyroSegment


class _GravityPrior(NamedTuple):
    """Motions of both frames, with gravity where it is used, and its sigma for the estimator."""

    motion1: FrameMotion
    motion2: FrameMotion
    sigma: float


class Pipeline:
    """Tracks frames against a reference keyframe and estimates a pose whenever a pair closes.

    Parameters that may change while running (declared `live`) are not kept: `process` gets the
    current ones with each frame. With `keep_images` results carry the two images.
    """

    def __init__(self, parameters: Parameters, keep_images: bool = False) -> None:
        missing = parameters.sensor.missing()
        if missing:
            raise MissingInputError('parameters are missing: ' + ', '.join(missing))
        self._keep_images = keep_images
        self._tracker = make_tracker(parameters.tracking)
        self._drift = DriftTracker(parameters)
        self._stamps = StampScatter()
        self._sensor: Sensor | None = None
        self._reference: _View | None = None
        self._previous: _View | None = None
        self._frames = 0   # since the reference keyframe
        self._gyro: _GyroTurn | None = None
        self._reference_rays: DerotatedRays | None = None
        self._current_rays: DerotatedRays | None = None
        self._promotion_due = False

    @property
    def applied_offset_ns(self) -> int:
        """Tracked time offset that the next frame is to be shifted by [ns]."""
        return self._drift.applied_ns

    def reset(self) -> None:
        """Forget the reference keyframe: the next frame starts anew."""
        self._tracker.reset()
        self._stamps.reset()
        self._reference = self._previous = self._gyro = None
        self._reference_rays = self._current_rays = None
        self._frames = 0
        self._promotion_due = False

    def process(self, frame: Frame, imu: FrameImu, parameters: Parameters) -> PairResult | None:
        """Track `frame`; the estimate of the pair that it closes, or None.

        Frames come in the order of their stamps. A frame whose intrinsics differ from the last
        one's, or that a gap of the gyro parts from it, starts anew.
        """
        self.prepare()
        sensor = self._sensor_of(frame, parameters)
        view = _View(frame, imu)
        self._stamps.add(frame.stamp_ns)
        # Without the gyro tracks are not predicted, and wrong ones that agree by chance pass.
        if self._reference is None or self._previous is None or imu.since_previous is None:
            self._tracker.start(frame.image)
            self._restart_from(view)
            return None
        self._frames += 1
        predicted = self._predicted(self._previous.imu.motion, imu, sensor, parameters)
        matches = self._tracker.track(
            frame.image, predicted,
            seconds_between(self._previous.frame.stamp_ns, frame.stamp_ns))
        self._previous = view
        self._gyro = self._turn_with(imu.since_previous, parameters)
        rays1, rays2 = self._derotate(matches, self._reference.imu.motion, imu.motion, sensor)
        since = SinceKeyframe(self._parallax(rays1, rays2, sensor),
                              _interval(self._reference, view), self._frames,
                              self._tracker.tracked_fraction)
        if not closes_pair(since, parameters.keyframes):
            return None
        result = self._close_pair(self._reference, view, sensor, parameters)
        self._restart_from(view)
        self._promotion_due = True
        return result

    def prepare(self) -> None:
        """Do what the next frame needs ahead of it; `process` does it where nobody has.

        New corners are sought in a keyframe after its pair is out: nobody waits for them.
        """
        if self._promotion_due:
            self._promotion_due = False
            self._tracker.promote()

    def _sensor_of(self, frame: Frame, parameters: Parameters) -> Sensor:
        """Camera model of the frame; another one than before starts anew."""
        if self._sensor is None or frame.intrinsics != self._sensor.intrinsics:
            self.reset()
            self._sensor = Sensor(sensor_camera(frame.intrinsics, parameters), frame.intrinsics)
        return self._sensor

    def _restart_from(self, view: _View) -> None:
        self._reference = self._previous = view
        self._gyro = self._reference_rays = None
        self._frames = 0

    # -- gyro and rays -----------------------------------------------------------------------

    def _predicted(self, previous: FrameMotion, imu: FrameImu, sensor: Sensor,
                   parameters: Parameters) -> Array | None:
        """Where the gyro expects the tracker's points (N, 2) in the current image [px].

        None without gyro, and for a tracker that looks for no points.
        """
        points, segment = self._tracker.points, imu.since_previous
        if segment is None or not len(points):
            return None
        rotation, _ = integrate_rotation(segment.stamps_ns, segment.angular_velocities,
                                         parameters.imu)
        known = self._current_rays
        if known is not None and np.array_equal(known.points, points):
            rays, row_times = known.rays, known.row_times
        else:
            rays, row_times = sensor.derotated(points, previous)
        # f_2 = R^T f_1 for R = R_1^T R_2, in rows.
        return sensor.seen(rays @ rotation, row_times, imu.motion)

    def _turn_with(self, segment: GyroSegment, parameters: Parameters) -> _GyroTurn | None:
        """Gyro since the reference, continued by a frame; None once a part was missing."""
        if self._frames > 1:
            if self._gyro is None:
                return None
            segment = self._gyro.segment.joined(segment)
        return _GyroTurn(*integrate_rotation(segment.stamps_ns, segment.angular_velocities,
                                             parameters.imu, segment.bias_sigma), segment)

    def _derotate(self, matches: Matches, motion1: FrameMotion, motion2: FrameMotion,
                  sensor: Sensor) -> tuple[DerotatedRays, DerotatedRays]:
        """Rays of matches in the reference and in the current image, which are kept."""
        # In the reference image points do not move: their rays are kept for the tracks that go on.
        known = self._reference_rays
        first = None if known is None else known.of(matches.track_ids)
        if first is None:
            first = DerotatedRays.from_points(matches.track_ids, matches.points1, sensor, motion1)
        second = DerotatedRays.from_points(matches.track_ids, matches.points2, sensor, motion2)
        self._reference_rays, self._current_rays = first, second
        return first, second

    def _parallax(self, first: DerotatedRays, second: DerotatedRays, sensor: Sensor) -> float:
        """Median parallax [px] of matched rays, beyond what the rotation explains."""
        rotation = aligning_rotation(first.rays.T @ second.rays) if self._gyro is None else (
            self._gyro.rotation)
        return sensor.camera.fx * median_parallax(first.rays, second.rays, rotation)

    # -- one pair ----------------------------------------------------------------------------

    def _close_pair(self, reference: _View, view: _View, sensor: Sensor,
                    parameters: Parameters) -> PairResult:
        stamp1_ns, stamp2_ns = reference.frame.stamp_ns, view.frame.stamp_ns
        matches, gyro = self._tracker.refined_matches(), self._gyro
        told = gyro if parameters.pair.use_gyro_rotation else None
        gravity = _gravity_prior(reference.imu, view.imu, parameters)
        pose = estimate_relative_pose(
            sensor.intrinsics.to_sensor(matches.points1),
            sensor.intrinsics.to_sensor(matches.points2),
            sensor.camera, gravity.motion1, gravity.motion2,
            relative_rotation=None if told is None else told.rotation,
            relative_rotation_covariance=None if told is None else told.covariance,
            interval=_interval(reference, view),
            config=replace(parameters.estimator, gravity_sigma=gravity.sigma, stamp_sigma=max(
                parameters.estimator.stamp_sigma, self._stamps.sigma)),
            quality=matches.quality,
            rng=np.random.default_rng([parameters.pair.seed, stamp1_ns, stamp2_ns]))
        self._follow_drift(pose, reference.imu, view.imu, parameters)
        rays1, rays2 = self._derotate(matches, reference.imu.motion, view.imu.motion, sensor)
        return PairResult(
            reference_stamp_ns=stamp1_ns, stamp_ns=stamp2_ns,
            reference_ns1=reference.imu.reference_ns, reference_ns2=view.imu.reference_ns,
            frame_id=view.frame.frame_id, interval=_interval(reference, view), pose=pose,
            matches=matches, row_times1=rays1.row_times, row_times2=rays2.row_times,
            rays1=rays1.rays, rays2=rays2.rays, parallax=self._parallax(rays1, rays2, sensor),
            gyro_rotation=None if gyro is None else gyro.rotation, drift=self._drift.estimate(),
            image1=reference.frame.image if self._keep_images else None,
            image2=view.frame.image if self._keep_images else None)

    def _follow_drift(self, pose: RelativePose, imu1: FrameImu, imu2: FrameImu,
                      parameters: Parameters) -> None:
        """Compare the pair's rotation with the gyro's, and decide on the offset to apply."""
        gyro = self._gyro
        if gyro is not None:
            self._drift.add(PairRotation(
                stamp_ns=imu2.reference_ns, R=pose.R,
                covariance=pose.fitted_rotation_covariance,
                gyro_rotation=gyro.rotation,
                gyro_covariance=gyro.covariance if parameters.pair.use_gyro_rotation else None,
                gyro=gyro.segment, applied1=imu1.applied_offset_ns / NANOSECONDS,
                applied2=imu2.applied_offset_ns / NANOSECONDS))
        self._drift.apply(parameters.sensor.track_time_offset)


def _interval(reference: _View, view: _View) -> float:
    """Seconds between the stamped rows of two frames."""
    return seconds_between(reference.imu.reference_ns, view.imu.reference_ns)


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
