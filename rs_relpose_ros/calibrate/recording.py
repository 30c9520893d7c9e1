"""Tracks and gyro of a recording: read from a bag, or collected from the messages of a node."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
import logging
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.bags.reader import Bag
from rs_relpose_ros.bags.sensor_topics import SensorTopics
from rs_relpose_ros.calibration.knowledge import LensKnowledge
from rs_relpose_ros.calibration.observations import GyroSeries, TrackedPoints
from rs_relpose_ros.config.settings import TrackingConfig
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
from rs_relpose_ros.geometry.camera import Intrinsics, RollingShutterCamera
from rs_relpose_ros.geometry.lens import DISTORTION_MODELS
from rs_relpose_ros.geometry.timing import seconds_between, to_nanoseconds
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.messages.burst_times import SampleTimes
from rs_relpose_ros.messages.incoming import PARTS, ReasonCounts, Role, sensor_messages
from rs_relpose_ros.messages.streams import burst_warning
from rs_relpose_ros.tracking.features import make_tracker
from rs_relpose_ros.tracking.images import EncodedImage, GrayLevels

# Guess of an unknown focal length, share of the longer side: 64 deg of view.
_FOCAL_GUESS = 0.8
# The current image becomes the reference when less than this share of the points is left. A larger
# share adds up errors from reference to reference, a smaller one loses points.
# [chosen: 0.7 to 0.9 would do]
_KEPT = 0.8
# It also does after so many images, by which the appearance of points has changed.
# [chosen: a second at 30 Hz]
_RENEWED_AFTER = 30
# The gyro is kept for longer than the images [ns], as the clocks may differ.
_MARGIN_NS = to_nanoseconds(1.0)
# A driver repeats the last sample for at most this time [ns]. A gyro that gives equal values for
# longer is one of a simulation at rest, whose samples are kept. [chosen: the largest gap that is
# interpolated, 30 ms; above the period of a slow sensor, 20 ms]
_LONGEST_HELD_NS = to_nanoseconds(0.03)

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationInput:
    """Tracks (pixels of the full sensor), gyro and camera of a bag."""

    tracks: TrackedPoints
    gyro: GyroSeries
    camera: RollingShutterCamera  # of the full sensor, its readout time 0
    focal_known: bool  # by the CameraInfo; else `camera` is a guess
    unused: dict[str, int]  # messages that were not used, by reason
    is_whole: bool = True  # whether the images show the whole sensor, without binning
    lens_given: bool = False  # whether the distortion is that of a CameraInfo, yet estimated

    @property
    def lens_knowledge(self) -> LensKnowledge:
        """Where its lens comes from."""
        if self.focal_known:
            return LensKnowledge.CLAIMED
        return LensKnowledge.GIVEN if self.lens_given else LensKnowledge.GUESSED

    def with_unknown_lens(self, distortion_model: str) -> CalibrationInput:
        """The same for a lens that is to be estimated, about the distortion of its CameraInfo.

        Without a distortion there, the lens is of this model.
        """
        if not self.is_whole:
            raise InputError(
                'the CameraInfo has a region of interest or binning, which '
                'camera_matrix cannot describe: calibrate without --lens'
            )
        if any(self.camera.distortion):
            return replace(self, focal_known=False, lens_given=True)
        counts = DISTORTION_MODELS[distortion_model].coefficient_counts
        none = (0.0,) * max(counts[0], 5 if len(counts) > 2 else 4)
        return replace(
            self,
            focal_known=False,
            lens_given=self.focal_known,
            camera=replace(self.camera, distortion_model=distortion_model, distortion=none),
        )


def read_recording(
    bag: Bag, topics: SensorTopics, tracking: TrackingConfig, *, images: range | None = None
) -> CalibrationInput:
    """Follow points through the images of an open bag, and collect its gyro.

    Of `images`, by their number in the bag, and of the gyro meanwhile; None: all. InputError or
    MissingInputError if the bag is damaged, or has no usable image or no gyro.
    """
    recorder = Recorder(tracking)
    number = 0
    if topics.camera_info is None:
        recorder.uncalibrated = True
    wanted = (Role.IMU, Role.CAMERA_INFO, Role.IMAGE)
    for role, message in sensor_messages(bag, topics, wanted):
        if images is None or role is Role.CAMERA_INFO or number in images:
            error = recorder.add(role, message.message)
            if error is not None:
                reason = f'{message.topic}: {error}'
                if recorder.unused.add(reason):
                    _logger.info('not used: %s', reason)
        number += role is Role.IMAGE
    return recorder.recording()


class Recorder:
    """Follows points by the chosen tracker, and keeps the gyro, of the last `longest` seconds."""

    def __init__(self, tracking: TrackingConfig, longest: float = math.inf) -> None:
        self.intrinsics: Intrinsics | None = None
        self.uncalibrated = False  # whether there is no calibrated CameraInfo
        self.unused = ReasonCounts()  # messages
        self._longest = longest
        self._tracker = make_tracker(tracking)
        self._levels = GrayLevels()
        self._since_renewed = 0  # images
        # Stamps of the images, ids and pixels (N, 2) of their points.
        self._frames: deque[tuple[int, NDArray[np.uint32], NDArray[np.float32]]] = deque()
        self.size = (0, 0)  # of the images [px]
        self._times = SampleTimes()
        self._gyro: dict[int, tuple[float, float, float]] = {}
        self._last_rates: tuple[float, ...] = ()  # of the last sample
        self._changed_ns = 0  # stamp of the first sample with these rates

    @property
    def seconds(self) -> float:
        """Time between the first and the last image."""
        frames = self._frames
        return seconds_between(frames[0][0], frames[-1][0]) if frames else 0.0

    @property
    def warning(self) -> str:
        """What is wrong with the stamps of the gyro, which are corrected; empty for nothing."""
        return burst_warning('the IMU', self._times)

    @property
    def last_ns(self) -> int:
        """Stamp of the last image."""
        return self._frames[-1][0]

    def add(self, role: Role, message: Any) -> RsRelposeError | None:
        """Use a message; the error of one that cannot be used."""
        try:
            value = PARTS[role].read(message)
            if role is Role.IMAGE:
                self.follow(value)
            elif role is Role.CAMERA_INFO:
                self.intrinsics = value
            elif value.angular_velocity is None:
                raise MissingInputError('an IMU message has no gyro')
            else:
                self._add_gyro(value)
        except RsRelposeError as error:
            # Without a calibration the focal length is guessed.
            if role is Role.CAMERA_INFO and isinstance(error, MissingInputError):
                self.uncalibrated = True
                return None
            return error
        return None

    def _add_gyro(self, sample: ImuSample) -> None:
        """Keep the samples whose times are known by the next one."""
        timed = self._times.add(sample)
        if timed and self._times.corrects:
            self._times.corrects = False
            self._gyro.clear()
        for one in timed:
            rates = one.angular_velocity
            if rates is not None and not self._is_held(one.stamp_ns, rates):
                self._gyro.setdefault(one.stamp_ns, rates)

    def _is_held(self, stamp_ns: int, rates: tuple[float, float, float]) -> bool:
        """Whether a driver has repeated the last sample; its stamp would make the gyro late."""
        since_ns = stamp_ns - self._changed_ns
        if rates == self._last_rates:
            return 0 <= since_ns < _LONGEST_HELD_NS
        self._last_rates = rates
        self._changed_ns = stamp_ns
        return False

    def follow(self, encoded: EncodedImage) -> None:
        """Track the points of the images before in another one; InputError if it is unusable."""
        if self._frames and encoded.stamp_ns <= self.last_ns:
            raise InputError('the stamp of an image is not later than the previous one')
        image = encoded.decoded(self._levels)
        tracker = self._tracker
        if not self._frames:
            tracker.start(image)
        # Matches with the reference, so that errors do not add up from frame to frame.
        tracker.track(image)
        matches = tracker.refined_matches()
        self._since_renewed += 1
        if tracker.tracked_fraction < _KEPT or self._since_renewed >= _RENEWED_AFTER:
            tracker.promote()
            self._since_renewed = 0
        points = matches.points2.astype(np.float32)  # to 1e-4 px
        self._frames.append((encoded.stamp_ns, matches.track_ids, points))
        self.size = image.shape[1], image.shape[0]
        while self.seconds > self._longest:
            self._frames.popleft()
            begin_ns = self._frames[0][0] - _MARGIN_NS
            self._forget_gyro_before(begin_ns)

    def _forget_gyro_before(self, begin_ns: int) -> None:
        """Drop the samples before a stamp."""
        while self._gyro:
            first_ns = next(iter(self._gyro))
            if first_ns >= begin_ns:
                break
            del self._gyro[first_ns]

    def set_back(self, stamp_ns: int) -> None:
        """Move all that is recorded to end a second before `stamp_ns`, on a clock set back."""
        earlier_ns = self.last_ns - stamp_ns + _MARGIN_NS
        self._frames = deque(
            (stamp - earlier_ns, ids, points) for stamp, ids, points in self._frames
        )
        moved: dict[int, tuple[float, float, float]] = {}
        last_ns = next(iter(self._gyro), 0)
        for stamp, rates in self._gyro.items():
            if stamp < last_ns - _MARGIN_NS:  # since then
                break
            last_ns = stamp
            moved[stamp - earlier_ns] = rates
        self._gyro = moved

    def recording(self) -> CalibrationInput:
        """All that was recorded; InputError or MissingInputError if something is missing."""
        unused = self.unused.most_common()
        why = ''.join(f'; {reason}' for reason in list(unused)[:2])
        if not self._frames:
            raise InputError(f'no image can be used{why}')
        if not self._gyro:
            raise MissingInputError(
                f'no message of the IMU has a gyro{why}: record the angular '
                'velocity together with the images'
            )
        intrinsics = self.intrinsics
        if intrinsics is None and not self.uncalibrated:
            raise MissingInputError(f'no CameraInfo can be used{why}')
        of_frames, ids, pixels = zip(*self._frames, strict=True)
        points = np.concatenate(pixels, dtype=np.float64)
        stamps = sorted(self._gyro)
        if intrinsics is not None:
            points = intrinsics.to_sensor(points)
        counts = [len(one) for one in ids]
        frames = np.repeat(np.arange(len(ids)), counts)
        tracks = TrackedPoints(np.array(of_frames), frames, np.concatenate(ids), points)
        rates = np.array([self._gyro[stamp] for stamp in stamps])
        gyro = GyroSeries(np.array(stamps), rates, self._times.delay_sigma)
        width, height = self.size
        if intrinsics is None:
            guess = _FOCAL_GUESS * max(width, height)
            camera = RollingShutterCamera(
                width=width,
                height=height,
                fx=guess,
                fy=guess,
                cx=0.5 * (width - 1),
                cy=0.5 * (height - 1),
                readout_time=0.0,
            )
        elif (width, height) == (intrinsics.image_width, intrinsics.image_height):
            camera = intrinsics.global_shutter_camera()
        else:
            raise InputError(
                f'the images are {width}x{height}, but the CameraInfo is for '
                f'{intrinsics.image_width}x{intrinsics.image_height}: a resized image needs a '
                'CameraInfo of its own'
            )
        return CalibrationInput(
            tracks,
            gyro,
            camera,
            intrinsics is not None,
            unused,
            is_whole=self.size == (camera.width, camera.height),
        )
