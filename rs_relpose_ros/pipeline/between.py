"""Tracks and IMU data of the frames between the two of a keyframe pair, for the estimator.

Each step of a tracker adds its error, and the windows of a pair's last frame are aligned with
those of its first one: the drift of a track is known there. In the frames before, it was a part of
that in proportion to time, which is the mean of a random walk with known ends.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from rs_relpose_ros.estimator.frames_between import IntermediateFrame
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.motion import InertialMotion
from rs_relpose_ros.geometry.timing import seconds_between, Sensor
from rs_relpose_ros.imu.integration import FrameImu, motions_on_the_way
from rs_relpose_ros.pipeline.pair import GyroRotation, positions
from rs_relpose_ros.tracking.features import Matches

Frames = TypeVar('Frames')

# Frames between that are used, evenly in the pair: more of them add hardly any accuracy.
MOST_FRAMES = 3


def used_frames(between: Sequence[Frames]) -> list[Frames]:
    """Those of the frames between the two of a pair that its estimate uses."""
    places = np.linspace(-1, len(between), min(len(between), MOST_FRAMES) + 2)[1:-1]
    return [between[k] for k in np.round(places).astype(int)]


class _TrackedFrame(NamedTuple):
    """A frame after the reference."""

    imu: FrameImu
    gyro: GyroRotation   # since the reference
    matches: Matches   # as tracked


class TrackHistory:
    """The frames since a reference keyframe."""

    def __init__(self, reference: FrameImu) -> None:
        self._reference = reference
        self._frames: list[_TrackedFrame] = []

    def add(self, imu: FrameImu, gyro: GyroRotation, matches: Matches) -> None:
        """Add the current frame with its tracks."""
        self._frames.append(_TrackedFrame(imu, gyro, matches))

    def between(self, matches: Matches, sensor: Sensor, since: FrameImu,
                inertial: InertialMotion | str) -> list[IntermediateFrame]:
        """Frames between the reference and the last one, with the tracks of a pair's `matches`.

        `since`: IMU data of the last frame since the reference; `inertial`: motion of the pair.
        """
        *before, last = self._frames
        chosen = used_frames(before)
        motions: list[InertialMotion | None] = [None] * len(chosen)
        if not isinstance(inertial, str):
            motions = list(motions_on_the_way(inertial, self._reference, since,
                                              [frame.imu for frame in chosen]))
        drift = matches.points2 - _points(last.matches, matches)
        interval = self._interval(last.imu)
        return [IntermediateFrame(
            sensor.intrinsics.to_sensor(_points(frame.matches, matches)
                                        + self._interval(frame.imu) / interval * drift),
            frame.imu.motion, self._interval(frame.imu), frame.gyro.rotation,
            frame.gyro.covariance, motion)
            for frame, motion in zip(chosen, motions, strict=True)]

    def _interval(self, imu: FrameImu) -> float:
        """Seconds from the stamped row of the reference to that of a frame."""
        return seconds_between(self._reference.reference_ns, imu.reference_ns)


def _points(tracked: Matches, wanted: Matches) -> Array:
    """Second points (N, 2) of the `wanted` tracks (N); NaN where one was not tracked."""
    rows = positions(tracked.track_ids, wanted.track_ids)
    if len(rows) == len(wanted):   # no track was lost meanwhile, or changed its place
        return tracked.points2[rows]
    points = np.full((len(wanted), 2), np.nan)
    _, here, there = np.intersect1d(wanted.track_ids, tracked.track_ids, assume_unique=True,
                                    return_indices=True)
    points[here] = tracked.points2[there]
    return points
