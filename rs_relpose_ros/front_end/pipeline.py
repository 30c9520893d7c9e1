"""Frames in, keyframe pairs out: the part that the live node and the replay share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import MissingInputError
from rs_relpose_ros.estimator.estimate import estimate_relative_pose
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.front_end.derotated_rays import DerotatedRays
from rs_relpose_ros.front_end.drift import DriftTracker, PairRotation
from rs_relpose_ros.front_end.frame import Frame
from rs_relpose_ros.front_end.keyframes import decide_keyframe, KeyframeDecision
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.so3 import aligning_rotation
from rs_relpose_ros.geometry.timing import NANOSECONDS, seconds_between
from rs_relpose_ros.imu.frame_imu import FrameImu, GyroSegment
from rs_relpose_ros.imu.integration import integrate_rotation
from rs_relpose_ros.tracking.matches import Matches
from rs_relpose_ros.tracking.parallax import median_parallax
from rs_relpose_ros.tracking.registry import make_tracker

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """A processed frame: what a later pair needs of it."""

    stamp_ns: int
    imu: FrameImu
    image: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class _GyroTurn:
    """``R_1^T R_2`` since the reference by the gyro, its covariance, and what was integrated."""

    rotation: Array
    covariance: Array
    segment: GyroSegment


class Pipeline:
    """Tracks frames against a reference keyframe and estimates a pose whenever a pair closes.

    Parameters
    ----------
    parameters : Parameters
    keep_images : bool
        Whether results carry the two images (for pictures).
    """

    def __init__(self, parameters: Parameters, keep_images: bool = False) -> None:
        missing = parameters.sensor.missing()
        if missing:
            raise MissingInputError('parameters are missing: ' + ', '.join(missing))
        self._parameters = parameters
        self._keep_images = keep_images
        self._tracker = make_tracker(parameters.tracking)
        self._drift = DriftTracker(parameters)
        self._calibration: Intrinsics | None = None
        self._camera: RollingShutterCamera | None = None
        self._reference: _View | None = None
        self._previous: _View | None = None
        self._gyro: _GyroTurn | None = None
        self._reference_rays: DerotatedRays | None = None
        self._current_rays: DerotatedRays | None = None
        self._frames = 0
        self._promotion_due = False

    @property
    def applied_offset_ns(self) -> int:
        """Tracked time offset that the next frame is to be shifted by [ns]."""
        return self._drift.applied_ns

    def update(self, parameters: Parameters) -> None:
        """Take over parameters that may change while running (settings declared `live`)."""
        self._parameters = parameters

    def reset(self) -> None:
        """Forget the reference keyframe: the next frame starts anew."""
        self._tracker.reset()
        self._reference = self._previous = self._gyro = None
        self._reference_rays = self._current_rays = None
        self._frames = 0
        self._promotion_due = False

    def process(self, frame: Frame, imu: FrameImu) -> PairResult | None:
        """Track `frame`; the estimate of the pair that it closes, or None.

        Frames come in the order of their stamps. A frame whose calibration differs from the last
        one's, or that a gap of the gyro parts from it, starts anew.
        """
        self.prepare()
        if frame.intrinsics != self._calibration:
            self.reset()
            self._calibration = frame.intrinsics
            self._camera = sensor_camera(frame.intrinsics, self._parameters)
        view = _View(frame.stamp_ns, imu, frame.image)
        # Over a gap of the gyro tracks are not predicted, and what is found by chance looks good.
        if self._reference is None or self._previous is None or imu.since_previous is None:
            self._tracker.start(frame.image)
            self._restart_from(view)
            return None
        self._frames += 1
        self._gyro = self._extended(imu.since_previous)
        matches = self._tracker.track(
            frame.image, self._predicted(self._previous.imu, imu),
            seconds_between(self._previous.stamp_ns, frame.stamp_ns))
        self._previous = view
        parallax, _ = self._parallax(matches, view)
        decision = decide_keyframe(
            self._parameters.keyframes, parallax, self._interval(view), self._frames,
            self._tracker.tracked_fraction)
        if decision is KeyframeDecision.WAIT:
            return None
        result = self._close_pair(frame, view)
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

    # -- one pair ----------------------------------------------------------------------------

    def _close_pair(self, frame: Frame, view: _View) -> PairResult:
        reference, camera = self._reference, self._camera
        assert reference is not None and camera is not None and self._calibration is not None
        matches = self._tracker.refined_matches()
        pixels1 = self._calibration.to_sensor(matches.points1)
        pixels2 = self._calibration.to_sensor(matches.points2)
        pair = self._parameters.pair
        gyro = self._gyro
        told = gyro if pair.use_gyro_rotation else None
        motion1, motion2 = reference.imu.motion, view.imu.motion
        config = self._parameters.estimator
        sigmas = [m.gravity_sigma for m in (reference.imu, view.imu)]
        if pair.use_gravity and None not in sigmas:
            # One figure for both frames; the filter's own, where it is worse than the told one.
            config = replace(config, gravity_sigma=min(
                max(config.gravity_sigma, *(s for s in sigmas if s is not None)), 1.5))
        else:
            motion1, motion2 = replace(motion1, gravity=None), replace(motion2, gravity=None)
        pose = estimate_relative_pose(
            pixels1, pixels2, camera, motion1, motion2,
            relative_rotation=None if told is None else told.rotation,
            relative_rotation_covariance=None if told is None else told.covariance,
            interval=self._interval(view), config=config, quality=matches.quality,
            rng=np.random.default_rng([pair.seed, reference.stamp_ns, view.stamp_ns]))
        if gyro is not None:
            self._drift.add(PairRotation(
                view.imu.reference_ns, pose.R, pose.covariance[3:, 3:], gyro.rotation,
                None if told is None else told.covariance, gyro.segment,
                reference.imu.applied_offset_ns / NANOSECONDS,
                view.imu.applied_offset_ns / NANOSECONDS))
        self._drift.apply(self._parameters.sensor.track_time_offset)
        parallax, (rays1, rays2, tau1, tau2) = self._parallax(matches, view)
        return PairResult(
            reference_stamp_ns=reference.stamp_ns, stamp_ns=view.stamp_ns,
            frame_id=frame.frame_id, interval=self._interval(view), pose=pose, matches=matches,
            row_times1=tau1, row_times2=tau2, rays1=rays1, rays2=rays2, parallax=parallax,
            gyro_rotation=None if gyro is None else gyro.rotation, drift=self._drift.estimate(),
            image1=reference.image if self._keep_images else None,
            image2=frame.image if self._keep_images else None)

    def _restart_from(self, view: _View) -> None:
        self._reference = self._previous = view
        self._gyro = self._reference_rays = None
        self._frames = 0

    def _interval(self, view: _View) -> float:
        assert self._reference is not None
        return seconds_between(self._reference.imu.reference_ns, view.imu.reference_ns)

    def _parallax(self, matches: Matches,
                  view: _View) -> tuple[float, tuple[Array, Array, Array, Array]]:
        """Median parallax [px] after derotation, and the derotated rays with their row times."""
        camera, calibration, reference = self._camera, self._calibration, self._reference
        assert camera is not None and calibration is not None and reference is not None
        known = self._reference_rays
        # What is tracked gets fewer from frame to frame, and the reference's points stay.
        first = None if known is None else known.of(matches.track_ids)
        if first is None:
            first = DerotatedRays.from_points(matches.track_ids, matches.points1, camera,
                                              calibration, reference.imu.motion)
        second = DerotatedRays.from_points(matches.track_ids, matches.points2, camera, calibration,
                                           view.imu.motion)
        self._reference_rays, self._current_rays = first, second
        rotation = (aligning_rotation(first.rays.T @ second.rays) if self._gyro is None
                    else self._gyro.rotation)
        return (camera.fx * median_parallax(first.rays, second.rays, rotation),
                (first.rays, second.rays, first.row_times, second.row_times))

    def _extended(self, segment: GyroSegment | None) -> _GyroTurn | None:
        """Gyro since the reference, continued by a frame; None as soon as a part is missing."""
        if segment is None:
            return None
        if self._frames > 1:
            if self._gyro is None:
                return None
            segment = self._gyro.segment.joined(segment)
        return _GyroTurn(*integrate_rotation(segment.stamps_ns, segment.angular_velocities,
                                             self._parameters.imu, segment.bias_sigma), segment)

    def _predicted(self, previous: FrameImu, current: FrameImu) -> Array | None:
        """Where the gyro expects the tracker's points (N, 2) in the current image [px].

        None without gyro, and for a tracker that looks for no points.
        """
        points = self._tracker.points
        if current.since_previous is None or not len(points):
            return None
        camera, calibration = self._camera, self._calibration
        assert camera is not None and calibration is not None
        rotation, _ = integrate_rotation(
            current.since_previous.stamps_ns, current.since_previous.angular_velocities,
            self._parameters.imu)
        known = self._current_rays
        if known is not None and np.array_equal(known.points, points):
            rays, row_times = known.rays @ rotation, known.row_times
        else:
            pixels = calibration.to_sensor(points)
            row_times = camera.row_times(pixels[:, 1])
            rays = previous.motion.derotate(camera.unproject(pixels), row_times) @ rotation
        first, last = camera.row_time_span
        for _ in range(2):   # the row that sees the point depends on where the point is
            turned = current.motion.rotations(np.clip(row_times, first, last))
            predicted = camera.project(np.einsum('nji,nj->ni', turned, rays))
            row_times = np.where(np.isfinite(predicted[:, 1]),
                                 camera.row_times(predicted[:, 1]), row_times)
        return calibration.to_image(predicted)


def sensor_camera(calibration: Intrinsics, parameters: Parameters) -> RollingShutterCamera:
    """Camera model of the full sensor; published pixels map to it by `Intrinsics.to_sensor`."""
    sensor = parameters.sensor
    if sensor.readout_time is None:
        raise MissingInputError('parameter readout_time is not set: give image height times line '
                                'delay in seconds (0 for a global shutter)')
    return RollingShutterCamera(
        width=calibration.width, height=calibration.height, fx=calibration.fx, fy=calibration.fy,
        cx=calibration.cx, cy=calibration.cy, distortion_model=calibration.distortion_model,
        distortion=calibration.distortion, readout_time=sensor.readout_time,
        readout_direction=sensor.readout_direction, reference_row=sensor.stamp_row)


__all__ = ['Pipeline', 'RelativePose', 'Status', 'sensor_camera']
