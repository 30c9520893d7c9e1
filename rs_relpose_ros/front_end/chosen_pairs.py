"""Relative poses of chosen frames, however far apart: loop closures, wide baselines.

Frames are matched by descriptors, and nothing is followed in between. The IMU derotates the rows
of each frame and tells gravity; the gyro between the frames is used where it has no gap. The time
between them tells the velocities only of frames that are close to each other.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import reduce

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.errors import InputError, RsRelposeError
from rs_relpose_ros.front_end.derotated_rays import DerotatedRays, Sensor
from rs_relpose_ros.front_end.frame import Frame, image_clock, sensor_camera
from rs_relpose_ros.front_end.frame_pair import (
    estimate_pair,
    GyroTurn,
    inertial_of,
    interval_of,
    pair_result,
    View,
)
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.health.tracked import Applied, NOTHING_APPLIED
from rs_relpose_ros.imu.buffer import ImuBuffer
from rs_relpose_ros.imu.forces import ForceSegment
from rs_relpose_ros.imu.frame_imu import frame_imu, FrameImu
from rs_relpose_ros.tracking.descriptors import DescriptorTracker
from rs_relpose_ros.tracking.images import Image
from rs_relpose_ros.tracking.matches import Matches


def view_frame(frame: Frame, imu: ImuBuffer, parameters: Parameters,
               since: View | None = None) -> View:
    """A frame with what the IMU says of it, to be related to others by `estimate_wide_pair`.

    Parameters
    ----------
    frame : Frame
    imu : ImuBuffer
        Must cover the read-out; ask in the order of time.
    parameters : Parameters
        Those of camera and IMU.
    since : View, optional
        An earlier frame: where the buffer reaches back to it, the gyro between is kept, too.

    Raises
    ------
    InputError
        The gyro does not cover the frame.
    """
    clock = image_clock(sensor_camera(frame.intrinsics, parameters), parameters.sensor)
    return View(frame, frame_imu(
        imu, clock.row_span_ns(frame.stamp_ns), clock.reference_ns(frame.stamp_ns),
        parameters.sensor.R_cam_imu, None if since is None else since.imu.reference_ns))


def estimate_wide_pair(first: View, second: View, parameters: Parameters) -> PairResult:
    """The relative pose of two frames, matched by descriptors.

    Parameters
    ----------
    first, second : View
        In the order of time, of one camera with one calibration.
    parameters : Parameters
        `detector` chooses the descriptors; SIFT where it is klt.

    Returns
    -------
    PairResult
        Its `pose` is falsy, with `status` and `reason`, where the images hold none.

    Raises
    ------
    InputError
        The frames come in the wrong order, or their intrinsics differ.
    """
    if second.frame.stamp_ns <= first.frame.stamp_ns:
        raise InputError('the second frame must be later than the first: exchange them')
    intrinsics = first.frame.intrinsics
    if second.frame.intrinsics != intrinsics:
        raise InputError('the intrinsics changed between the two frames: one calibration must '
                         'hold for both')
    sensor = Sensor(sensor_camera(intrinsics, parameters), intrinsics)
    matches = _matched(first.frame.image, second.frame.image, parameters.tracking)
    gyro, forces = _between(first, second, parameters)
    inertial, interval = inertial_of(first, second, gyro, forces, parameters), None
    if interval_of(first, second) <= parameters.keyframes.max_keyframe_interval:
        interval = interval_of(first, second)
    elif not isinstance(inertial, str):
        inertial = 'the frames are further apart than max_keyframe_interval'
    pose = estimate_pair(first, second, matches, sensor, gyro, inertial, parameters,
                         interval=interval)
    rays1, rays2 = (DerotatedRays.from_points(matches.track_ids, points, sensor, view.imu.motion)
                    for points, view in ((matches.points1, first), (matches.points2, second)))
    return pair_result(first, second, matches, rays1, rays2, pose, gyro, sensor, parameters)


@dataclass(frozen=True, slots=True, eq=False)
class ChosenPair:
    """A chosen pair by the stamps of its images, with its result or why there is none."""

    stamps_ns: tuple[int, int]
    result: PairResult | str


class ChosenPairs:
    """What a `FrameLoop` makes of chosen frames: those of the `wanted` pairs that a frame ends.

    `wanted`: stamps of the earlier and of the later image. Frames are kept until the last of their
    pairs, and what the IMU says of all frames since the oldest of them.
    """

    def __init__(self, wanted: Collection[tuple[int, int]]) -> None:
        self._wanted = frozenset(wanted)
        self._last: dict[int, int] = {}
        for first_ns, second_ns in self._wanted:
            self._last[first_ns] = max(second_ns, self._last.get(first_ns, second_ns))
        self._views: dict[int, View] = {}   # by stamp
        self._imus: dict[int, FrameImu] = {}

    @property
    def applied(self) -> Applied:
        """None: what is told is believed."""
        return NOTHING_APPLIED

    def prepare(self) -> None:
        """Nothing can be done ahead."""

    def reset(self) -> None:
        """Forget the frames so far."""
        self._views.clear()
        self._imus.clear()

    def process(self, frame: Frame, imu: FrameImu,
                parameters: Parameters) -> tuple[ChosenPair, ...] | None:
        """The pairs of this frame with earlier ones."""
        current_ns = frame.stamp_ns
        self._imus[current_ns] = imu
        view = View(frame, imu)
        pairs = tuple(self._pair(first_ns, view, parameters) for first_ns in self._views
                      if (first_ns, current_ns) in self._wanted)
        self._views[current_ns] = view
        self._views = {stamp_ns: one for stamp_ns, one in self._views.items()
                       if self._last.get(stamp_ns, 0) > current_ns}
        oldest_ns = min(self._views, default=current_ns)
        self._imus = {stamp_ns: one for stamp_ns, one in self._imus.items()
                      if stamp_ns > oldest_ns}
        return pairs or None

    def _pair(self, first_ns: int, second: View, parameters: Parameters) -> ChosenPair:
        """Of a frame that is kept and the current one."""
        first, stamps = self._views[first_ns], (first_ns, second.frame.stamp_ns)
        second = replace(second, imu=_joined([
            imu for stamp_ns, imu in self._imus.items() if stamp_ns > first_ns]))
        try:
            return ChosenPair(stamps, estimate_wide_pair(first, second, parameters))
        except RsRelposeError as error:
            return ChosenPair(stamps, str(error))


def _matched(image1: Image, image2: Image, config: TrackingConfig) -> Matches:
    """Mutual nearest descriptors of two images."""
    tracker = DescriptorTracker(replace(config, detector='sift') if config.detector == 'klt'
                                else config)
    tracker.start(image1)
    return tracker.track(image2)


def _between(first: View, second: View,
             parameters: Parameters) -> tuple[GyroTurn | None, ForceSegment | str]:
    """Gyro and specific force from the one frame to the other, as far as the second has them."""
    segment, force = second.imu.since_previous, second.imu.force
    if segment is None or segment.stamps_ns[0] != first.imu.reference_ns:
        return None, 'the gyro has a gap'
    return (GyroTurn.of(segment, parameters.imu),
            force if isinstance(force, str) else force.since_previous)


def _joined(imus: list[FrameImu]) -> FrameImu:
    """The last of some frames in a row, with gyro and force since the frame before the first."""
    last = imus[-1]
    segments = [imu.since_previous for imu in imus if imu.since_previous is not None]
    if len(segments) < len(imus):
        return replace(last, since_previous=None)
    joined = replace(last, since_previous=reduce(lambda a, b: a.joined(b), segments))
    forces = [imu.force for imu in imus if not isinstance(imu.force, str)]
    if isinstance(last.force, str) or len(forces) < len(imus):
        return replace(joined, force='the accelerometer has a gap')
    since = reduce(lambda a, b: a.joined(b), [force.since_previous for force in forces])
    return replace(joined, force=replace(last.force, since_previous=since))
