"""Frames in, keyframe pairs out: tracks, closes pairs, estimates."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import MissingInputError
from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.front_end.derotated_rays import DerotatedRays, Sensor
from rs_relpose_ros.front_end.frame import Frame, sensor_camera
from rs_relpose_ros.front_end.frame_pair import (
    estimate_pair,
    evidence_without,
    GyroTurn,
    inertial_of,
    interval_of,
    pair_result,
    parallax_of,
    View,
)
from rs_relpose_ros.front_end.pair import closes_pair, PairResult, SinceKeyframe
from rs_relpose_ros.front_end.stamp_scatter import StampScatter
from rs_relpose_ros.geometry.inertial import InertialMotion
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.so3 import log_so3
from rs_relpose_ros.geometry.timing import NANOSECONDS, seconds_between
from rs_relpose_ros.health.deviation import BIAS, DEVIATIONS, OFFSET, READOUT
from rs_relpose_ros.health.judge import Told
from rs_relpose_ros.health.monitor import HealthMonitor, withheld
from rs_relpose_ros.health.pair_information import PairEvidence
from rs_relpose_ros.health.tracked import Applied, Tracked
from rs_relpose_ros.health.turning import rotation_of_rays
from rs_relpose_ros.imu.forces import ForceSegment
from rs_relpose_ros.imu.frame_imu import FrameImu, GyroSegment
from rs_relpose_ros.imu.integration import integrate_rotation, turn_sensitivity
from rs_relpose_ros.tracking.matches import Matches
from rs_relpose_ros.tracking.tracker import make_tracker, Tracker

Array = NDArray[np.float64]

# Points of which the turning of the images is taken, of the longest tracks, and frames between.
_TURN_POINTS, _TURN_FRAMES = 120, 3
# Why a pair does without the accelerometer.
_CONTRADICTED = 'images and accelerometer contradict each other (see health)'


@dataclass(slots=True, eq=False)
class _Turn:
    """An image that later ones are compared with, and how the gyro has turned since."""

    stamp_ns: int
    ids: NDArray[np.uint32]   # (N,) of tracks
    rays: Array   # (N, 3) as measured
    by_gyro: Array = field(default_factory=lambda: np.eye(3))
    frames: int = 0

    @classmethod
    def none(cls) -> _Turn:
        """No image yet: the next one is the first."""
        return cls(0, np.zeros(0, dtype=np.uint32), np.zeros((0, 3)), frames=_TURN_FRAMES)

    def go_on(self, rotation: Array) -> None:
        """Count a frame that the gyro has turned by `rotation` since the one before."""
        self.by_gyro, self.frames = self.by_gyro @ rotation, self.frames + 1


class Pipeline:
    """Tracks frames against a reference keyframe and estimates a pose whenever a pair closes.

    Parameters that may change while running (declared `live`) are not kept: `process` gets the
    current ones with each frame. With `keep_images` results carry the two images. `tracker`:
    instead of the one that the parameters name.
    """

    def __init__(self, parameters: Parameters, keep_images: bool = False,
                 tracker: Tracker | None = None) -> None:
        missing = parameters.sensor.missing()
        if missing:
            raise MissingInputError('parameters are missing: ' + ', '.join(missing))
        self._keep_images = keep_images
        self._tracker = make_tracker(parameters.tracking) if tracker is None else tracker
        self._stamps = StampScatter()
        self._health = HealthMonitor()
        self._seen: Tracked | None = None
        self._applied = Applied()
        self._sensor: Sensor | None = None
        self._readout = 0.0   # [s] that its camera has beyond the parameter
        self._reference: View | None = None
        self._previous: View | None = None
        self._frames = 0   # since the reference keyframe
        self._gyro: GyroTurn | None = None
        self._forces: ForceSegment | str = ''   # since the reference, or why they are not known
        self._reference_rays: DerotatedRays | None = None
        self._current_rays: DerotatedRays | None = None
        self._turn = _Turn.none()
        self._promotion_due = False

    @property
    def applied(self) -> Applied:
        """Tracked figures that the next frame is to have."""
        return self._applied

    def reset(self) -> None:
        """Forget the reference keyframe: the next frame starts anew."""
        self._tracker.reset()
        self._stamps.reset()
        self._reference = self._previous = self._gyro = None
        self._reference_rays = self._current_rays = None
        self._turn = _Turn.none()
        self._frames = 0
        self._promotion_due = False

    def process(self, frame: Frame, imu: FrameImu, parameters: Parameters) -> PairResult | None:
        """Track `frame`; the estimate of the pair that it closes, or None.

        Frames come in the order of their stamps. A frame whose intrinsics differ from the last
        one's, or that a gap of the gyro parts from it, starts anew.
        """
        self.prepare()
        sensor = self._sensor_of(frame, parameters)
        view = View(frame, imu)
        self._stamps.add(frame.stamp_ns)
        # Without the gyro tracks are not predicted, and wrong ones that agree by chance pass.
        if self._reference is None or self._previous is None or imu.since_previous is None:
            self._tracker.start(frame.image)
            self._restart_from(view)
            return None
        self._frames += 1
        rotation, _ = integrate_rotation(imu.since_previous.stamps_ns,
                                         imu.since_previous.angular_velocities, parameters.imu)
        self._turn.go_on(rotation)
        predicted = self._predicted(self._previous.imu.motion, imu.motion, rotation, sensor)
        matches = self._tracker.track(
            frame.image, predicted,
            seconds_between(self._previous.frame.stamp_ns, frame.stamp_ns))
        self._previous = view
        self._gyro = self._turn_with(imu.since_previous, parameters)
        self._forces = self._forces_with(imu)
        rays1, rays2 = self._derotate(matches, self._reference.imu.motion, imu.motion, sensor)
        since = SinceKeyframe(parallax_of(rays1, rays2, self._gyro, sensor),
                              interval_of(self._reference, view), self._frames,
                              self._tracker.tracked_fraction)
        closing = closes_pair(since, parameters.keyframes)
        # Where tracks are lost pairs close early, and few tracks outlive them.
        if closing or self._turn.frames >= _TURN_FRAMES:
            self._compare_turns(frame.stamp_ns, matches, sensor)
        if not closing:
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
            self._health.clear()
            self._sensor = None
        if self._sensor is None or self._readout != self._applied.readout_time:
            camera = sensor_camera(frame.intrinsics, parameters)
            self._readout = self._applied.readout_time
            self._sensor = Sensor(replace(
                camera, readout_time=max(camera.readout_time + self._readout, 0.0)),
                frame.intrinsics)
            # Row times of its rays are those of the camera before.
            self._current_rays = None
        return self._sensor

    def _restart_from(self, view: View) -> None:
        self._reference = self._previous = view
        self._gyro = self._reference_rays = None
        self._frames = 0

    # -- gyro and rays -----------------------------------------------------------------------

    def _predicted(self, previous: FrameMotion, current: FrameMotion, rotation: Array,
                   sensor: Sensor) -> Array | None:
        """Where the gyro expects the tracker's points (N, 2) in the current image [px].

        `rotation` (3, 3): ``R_1^T R_2`` since the previous image. None for a tracker that looks
        for no points.
        """
        points = self._tracker.points
        if not len(points):
            return None
        known = self._current_rays
        if known is not None and np.array_equal(known.points, points):
            rays, row_times = known.rays, known.row_times
        else:
            rays, row_times = sensor.derotated(points, previous)
        # f_2 = R^T f_1 for R = R_1^T R_2, in rows.
        return sensor.seen(rays @ rotation, row_times, current)

    def _turn_with(self, segment: GyroSegment, parameters: Parameters) -> GyroTurn | None:
        """Gyro since the reference, continued by a frame; None once a part was missing."""
        if self._frames > 1:
            if self._gyro is None:
                return None
            segment = self._gyro.segment.joined(segment)
        return GyroTurn.of(segment, parameters.imu)

    def _forces_with(self, imu: FrameImu) -> ForceSegment | str:
        """Specific force since the reference, continued by a frame; why not, once a part lacks."""
        if isinstance(imu.force, str):
            return imu.force
        if self._frames == 1:
            return imu.force.since_previous
        before = self._forces
        return before if isinstance(before, str) else before.joined(imu.force.since_previous)

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

    # -- one pair ----------------------------------------------------------------------------

    def _close_pair(self, reference: View, view: View, sensor: Sensor,
                    parameters: Parameters) -> PairResult:
        matches, gyro = self._tracker.refined_matches(), self._gyro
        pose = self._estimated(matches, reference, view, sensor, parameters)
        pose = self._judged(pose, matches, reference, view, sensor, parameters)
        rays1, rays2 = self._derotate(matches, reference.imu.motion, view.imu.motion, sensor)
        seen = self._health.latest
        return replace(
            pair_result(reference, view, matches, rays1, rays2, pose, gyro, sensor, parameters),
            images_against_gyro=None if seen is None else seen.images_against_gyro,
            health=self._health.health, tracked=self._seen, applied=self._applied,
            image1=reference.frame.image if self._keep_images else None,
            image2=view.frame.image if self._keep_images else None)

    def _estimated(self, matches: Matches, reference: View, view: View, sensor: Sensor,
                   parameters: Parameters) -> RelativePose:
        """The pose, without the accelerometer where images contradict it."""
        def estimate(acceleration: InertialMotion | str) -> RelativePose:
            return estimate_pair(
                reference, view, matches, sensor, self._gyro, acceleration, parameters,
                interval=interval_of(reference, view), stamp_sigma=self._stamps.sigma)

        inertial = inertial_of(reference, view, self._gyro, self._forces, parameters)
        if isinstance(inertial, str) or self._gyro is None:
            return estimate(inertial)
        believed = self._health.believes(None)
        pose = estimate(inertial if believed else _CONTRADICTED)
        evidence = pose.inertial_evidence if believed else evidence_without(
            pose, reference, view, sensor, self._gyro, inertial, parameters)
        if evidence is not None:
            self._health.add_acceleration(view.frame.stamp_ns, evidence)
            if believed and not self._health.believes(evidence):
                pose = estimate(_CONTRADICTED)
        return pose

    # -- health ------------------------------------------------------------------------------

    def _compare_turns(self, stamp_ns: int, matches: Matches, sensor: Sensor) -> None:
        """Compare how images turned over some frames, without the gyro, with the gyro."""
        before, ids = self._turn, matches.track_ids[:_TURN_POINTS]
        rays = sensor.camera.unproject(sensor.intrinsics.to_sensor(matches.points2[:_TURN_POINTS]))
        _, old, new = np.intersect1d(before.ids, ids, assume_unique=True, return_indices=True)
        turned = rotation_of_rays(before.rays[old], rays[new])
        if turned is not None:
            self._health.add_turn(stamp_ns, seconds_between(before.stamp_ns, stamp_ns), turned,
                                  log_so3(before.by_gyro))
        self._turn = _Turn(stamp_ns, ids, rays)

    def _judged(self, pose: RelativePose, matches: Matches, reference: View, view: View,
                sensor: Sensor, parameters: Parameters) -> RelativePose:
        """The pose with a covariance that holds, or withheld; what is tracked moves on."""
        evidence = None
        if self._gyro is not None and np.isfinite(pose.R).all():
            evidence = _evidence(pose, matches, reference, view, self._gyro, sensor, parameters)
        told = self._told(view, sensor, parameters)
        pose = self._health.add_pair(view.frame.stamp_ns, evidence, pose, told)
        self._seen = Tracked.of(self._health.calibration, told)
        self._applied = self._applied.moved(self._seen, parameters.sensor)
        return withheld(pose, self._health.health) if parameters.pair.withhold_when_wrong else pose

    def _told(self, view: View, sensor: Sensor, parameters: Parameters) -> Told:
        bias = np.array(parameters.imu.gyro_bias)
        in_force = np.zeros(DEVIATIONS)
        in_force[OFFSET] = view.imu.applied_offset_ns / NANOSECONDS
        if self._gyro is not None:
            in_force[BIAS] = parameters.sensor.R_cam_imu.T @ self._gyro.segment.bias - bias
        told = Told(parameters.sensor, sensor.camera, bias, parameters.imu.gyro_bias_sigma,
                    in_force)
        in_force[READOUT] = told.direction * self._readout
        return told


def _evidence(pose: RelativePose, matches: Matches, reference: View, view: View, gyro: GyroTurn,
              sensor: Sensor, parameters: Parameters) -> PairEvidence:
    """A pair as the recursive calibration needs it."""
    segment = gyro.segment
    return PairEvidence(
        sensor.intrinsics.to_sensor(matches.points1), sensor.intrinsics.to_sensor(matches.points2),
        sensor.camera, reference.imu.motion, view.imu.motion, interval_of(reference, view),
        pose.R, pose.t, gyro.rotation, gyro.covariance, turn_sensitivity(
            segment.stamps_ns, segment.angular_velocities, parameters.imu),
        (segment.angular_velocities[0], segment.angular_velocities[-1]),
        parameters.sensor.R_cam_imu, parameters.estimator.gyro_sigma)
