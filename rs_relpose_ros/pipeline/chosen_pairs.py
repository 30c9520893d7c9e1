"""Relative poses of chosen frames, however far apart: loop closures, wide baselines.

Frames are matched by descriptors, without tracks in between. The IMU derotates the rows of each
frame and gives gravity; the gyro between the frames is used unless it has a gap. Of frames that
are close to each other the interval constrains the velocities, and the frames between are used.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import reduce
from typing import Any, TypeVar

from rs_relpose_ros.config.settings import Parameters, sensor_model, TrackingConfig
from rs_relpose_ros.errors import InputError, RsRelposeError
from rs_relpose_ros.estimator.estimate import estimate
from rs_relpose_ros.geometry.matches import Matches
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.imu.buffer import frame_imu, ImuBuffer
from rs_relpose_ros.imu.integration import FrameImu, ImuSlice
from rs_relpose_ros.pipeline import pair
from rs_relpose_ros.pipeline.monitor import with_scale_doubt
from rs_relpose_ros.pipeline.pair import Frame, PairResult, TrackHistory, used_frames
from rs_relpose_ros.pipeline.pipeline import Processor
from rs_relpose_ros.tracking.features import DescriptorTracker


def view_frame(
    frame: Frame[Any], imu: ImuBuffer, parameters: Parameters, since: Frame[Any] | None = None
) -> Frame[Any]:
    """A frame with its IMU data, to be related to others by `estimate_wide_pair`.

    Parameters
    ----------
    frame : Frame
    imu : ImuBuffer
        Must cover the readout; frames are to be given in the order of time.
    parameters : Parameters
        Camera and IMU.
    since : Frame, optional
        An earlier result: if the buffer extends back to it, the gyro between is kept, too.

    Returns
    -------
    Frame
        A copy with `imu`.

    Raises
    ------
    InputError
        The gyro does not cover the frame.
    """
    clock = sensor_model(frame.intrinsics, parameters.sensor).clock
    return replace(
        frame,
        imu_data=frame_imu(
            imu,
            clock.exposed_span_ns(frame.stamp_ns),
            clock.reference_ns(frame.stamp_ns),
            parameters.sensor.R_cam_imu,
            None if since is None else since.imu.reference_ns,
            clock.exposure(),
        ),
        exposure=clock.exposure(),
    )


def estimate_wide_pair(
    first: Frame[Any],
    second: Frame[Any],
    parameters: Parameters,
    between: Sequence[Frame[Any]] = (),
) -> PairResult:
    """The relative pose of two frames, matched by descriptors.

    Parameters
    ----------
    first, second : Frame
        Of `view_frame`, in the order of time, of one camera with one calibration.
    parameters : Parameters
        `detector` chooses the descriptors; SIFT if it is klt.
    between : sequence of Frame, optional
        Frames between the two, of `view_frame` since the first one, with its intrinsics; used if
        the gyro has no gap and the two are at most `max_keyframe_interval` apart.

    Returns
    -------
    PairResult
        Its `pose` is falsy, with `status` and `reason`, if none can be estimated.

    Raises
    ------
    InputError
        The frames are in the wrong order, have no IMU data, or their intrinsics differ.
    """
    if second.stamp_ns <= first.stamp_ns:
        raise InputError('the second frame must be later than the first: exchange them')
    if second.intrinsics != first.intrinsics:
        raise InputError(
            'the intrinsics changed between the two frames: one calibration must hold for both'
        )
    sensor = sensor_model(first.intrinsics, parameters.sensor)
    interval = pair.interval_of(first.imu, second.imu)
    near = interval <= parameters.keyframes.max_keyframe_interval
    history, matches = _matched(first, second, parameters.tracking, between if near else ())
    problem = history.problem(second.stamp_ns, matches, sensor, parameters, near=near)
    pose = with_scale_doubt(estimate(problem), parameters.imu)
    rays = pair.derotated(matches, first.imu.motion, second.imu.motion, sensor)
    return history.result(second, rays, pose, sensor, parameters)


def _matched(
    first: Frame[Any],
    second: Frame[Any],
    tracking: TrackingConfig,
    between: Sequence[Frame[Any]],
) -> tuple[TrackHistory, Matches]:
    """The frames of a pair with their matches to the first one, and the matches of the second."""
    if tracking.detector == 'klt':  # it has no descriptors
        tracking = replace(tracking, detector='sift')
    tracker = DescriptorTracker(tracking)
    tracker.start(first.image)
    history = TrackHistory(first.stamp_ns, first.imu)
    since = _since(first, second)
    if since is not None:
        for frame in used_frames(between):
            to_frame = _since(first, frame)
            if to_frame is not None and frame.intrinsics == first.intrinsics:
                history.add(frame.imu, to_frame, tracker.track(frame.image))
    matches = tracker.track(second.image)
    history.add(second.imu, since, matches)
    return history, matches


def _since(
    first: Frame[Any],
    frame: Frame[Any],
) -> ImuSlice | None:
    """The IMU since the first frame; None if the frame's samples begin at another one."""
    since = frame.imu.since_previous
    if since is None or since.stamps_ns[0] != first.imu.reference_ns:
        return None
    return since


# Stamps of the earlier and of the later image of a pair [ns].
PairStamps = tuple[int, int]
Kept = TypeVar('Kept')


def _after(first_ns: int, by_stamp: dict[int, Kept]) -> dict[int, Kept]:
    """The entries with a stamp later than the first one."""
    return {stamp_ns: one for stamp_ns, one in by_stamp.items() if stamp_ns > first_ns}


class ChosenPairs(Processor[dict[PairStamps, PairResult | str]]):
    """Estimates the `wanted` pairs: results by their stamps, or the reasons for none.

    A frame is kept until the last of its pairs, the frames after it for `max_keyframe_interval`,
    and the IMU data of all frames since the oldest frame that is kept.
    """

    def __init__(self, wanted: Collection[PairStamps]) -> None:
        self._wanted = frozenset(wanted)
        # Stamp of the last frame that each first frame is related to.
        self._last = dict(sorted(self._wanted))
        # All by the stamp of the frame.
        self._frames: dict[int, Frame[Any]] = {}
        self._recent: dict[int, Frame[Any]] = {}
        self._imus: dict[int, FrameImu] = {}

    def reset(self) -> None:
        """Forget the frames so far."""
        self._frames.clear()
        self._recent.clear()
        self._imus.clear()

    def process(
        self, frame: Frame[Any], parameters: Parameters
    ) -> dict[PairStamps, PairResult | str] | None:
        """The pairs of this frame with earlier ones."""
        current_ns = frame.stamp_ns
        self._imus[current_ns] = frame.imu
        pairs = {
            (first_ns, current_ns): self._pair(first_ns, frame, parameters)
            for first_ns in self._frames
            if (first_ns, current_ns) in self._wanted
        }
        self._frames[current_ns] = frame
        self._recent[current_ns] = frame
        last = self._last
        self._frames = {
            stamp_ns: one
            for stamp_ns, one in self._frames.items()
            if last.get(stamp_ns, 0) > current_ns
        }
        longest_ns = to_nanoseconds(parameters.keyframes.max_keyframe_interval)
        near = [stamp_ns for stamp_ns in self._frames if stamp_ns > current_ns - longest_ns]
        self._recent = _after(min(near, default=current_ns), self._recent)
        self._imus = _after(min(self._frames, default=current_ns), self._imus)
        return pairs or None

    def _pair(
        self,
        first_ns: int,
        second: Frame[Any],
        parameters: Parameters,
    ) -> PairResult | str:
        """The pair of an earlier frame and the current one, or the reason for none."""

        def since_first(frame: Frame[Any]) -> Frame[Any]:
            slices = [
                imu.since_previous
                for stamp_ns, imu in self._imus.items()
                if first_ns < stamp_ns <= frame.stamp_ns
            ]
            known = [one for one in slices if one is not None]
            since = reduce(ImuSlice.joined, known) if len(known) == len(slices) else None
            return replace(frame, imu_data=replace(frame.imu, since_previous=since))

        between = [frame for stamp_ns, frame in self._recent.items() if stamp_ns > first_ns]
        try:
            return estimate_wide_pair(
                self._frames[first_ns],
                since_first(second),
                parameters,
                [since_first(frame) for frame in used_frames(between)],
            )
        except RsRelposeError as error:
            return str(error)
