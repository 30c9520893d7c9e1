"""Tracks and gyro of a bag, for `rs_relpose_ros.calibrate.procedure.calibrate`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import logging

from rs_relpose_ros.bags.reader import Bag, BagMessage
from rs_relpose_ros.bags.topics import SensorTopics
from rs_relpose_ros.calibrate.follow import PointFollower
from rs_relpose_ros.calibrate.gyro_path import GyroSeries
from rs_relpose_ros.calibrate.tracks import Tracks
from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.images.gray_levels import GrayLevels
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.messages.incoming import PublishedImage
from rs_relpose_ros.messages.sensor_feed import Role, SensorFeed

# Guess of an unknown focal length, share of the longer side: 64 deg of view.
_FOCAL_GUESS = 0.8

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationInput:
    """Tracks (pixels of the full sensor), gyro and camera of a bag."""

    tracks: Tracks
    gyro: GyroSeries
    camera: RollingShutterCamera    # of the full sensor, its read-out time 0
    focal_known: bool               # by the CameraInfo; else `camera` is a guess
    unused: dict[str, int]          # messages that were not used, by the sentence that says why


def read_recording(bag: Bag, topics: SensorTopics, tracking: TrackingConfig | None = None, *,
                   images: range | None = None,
                   on_image: Callable[[], object] = lambda: None) -> CalibrationInput:
    """Follow points through the images of an open bag, and collect its gyro.

    Of `images`, by their number in the bag, and of the gyro meanwhile; None takes all. `on_image`
    is called after each image, for a progress bar.

    Raises
    ------
    InputError, MissingInputError
        The bag is damaged, or has no usable image or no gyro.
    """
    reader = _Reader(topics, TrackingConfig() if tracking is None else tracking)
    number = 0
    for role, message in reader.feed.messages(bag, topics):
        if images is None or role is Role.CAMERA_INFO or number in images:
            reader.take(role, message)
        if role is Role.IMAGE:
            number += 1
            on_image()
    return reader.recording()


class _Reader:
    def __init__(self, topics: SensorTopics, tracking: TrackingConfig) -> None:
        self._topics = topics
        self._follower = PointFollower(tracking)
        self.feed = SensorFeed({Role.IMU: self._take_sample, Role.CAMERA_INFO: self._take_info,
                                Role.IMAGE: self._take_image})
        self._intrinsics: Intrinsics | None = None
        self._uncalibrated = topics.camera_info is None
        self._size: tuple[int, int] | None = None
        self._gyro: dict[int, tuple[float, float, float]] = {}
        self._levels = GrayLevels()
        self._unused: dict[str, int] = {}

    def take(self, role: Role, message: BagMessage) -> None:
        try:
            self.feed.receive(role, message.message)
        except RsRelposeError as error:
            # The camera is not calibrated: its focal length is guessed.
            if role is Role.CAMERA_INFO and isinstance(error, MissingInputError):
                self._uncalibrated = True
                return
            reason = f'{message.topic}: {error}'
            if reason not in self._unused:
                _logger.info('not used: %s', reason)
            self._unused[reason] = self._unused.get(reason, 0) + 1

    def _take_sample(self, sample: ImuSample) -> None:
        if sample.angular_velocity is None:
            raise MissingInputError('an IMU message has no gyro')
        self._gyro.setdefault(sample.stamp_ns, sample.angular_velocity)

    def _take_info(self, intrinsics: Intrinsics) -> None:
        self._intrinsics = intrinsics

    def _take_image(self, published: PublishedImage) -> None:
        last = self._follower.last_stamp_ns
        if last is not None and published.stamp_ns <= last:
            raise InputError('the stamp of an image is not later than that of the one before')
        image = published.image.decoded(self._levels)
        self._follower.add(published.stamp_ns, image)
        self._size = image.shape[1], image.shape[0]

    def recording(self) -> CalibrationInput:
        if self._size is None:
            raise InputError(f'no image of {self._topics.image.name} can be used{self._why()}')
        if not self._gyro:
            raise MissingInputError(f'no message of {self._topics.imu.name} has a gyro'
                                    f'{self._why()}: record the angular velocity together with '
                                    'the images')
        camera, intrinsics = self._camera(self._size), self._intrinsics
        tracks = self._follower.tracks(None if intrinsics is None else intrinsics.to_sensor)
        return CalibrationInput(tracks, GyroSeries.by_stamp(self._gyro), camera,
                                intrinsics is not None, self._unused)

    def _why(self) -> str:
        return ''.join(f'; {reason}' for reason in list(self._unused)[:2])

    def _camera(self, size: tuple[int, int]) -> RollingShutterCamera:
        intrinsics = self._intrinsics
        if intrinsics is not None:
            if size != (intrinsics.image_width, intrinsics.image_height):
                raise InputError(
                    f'the images are {size[0]}x{size[1]}, but the CameraInfo is for '
                    f'{intrinsics.image_width}x{intrinsics.image_height}: a resized image '
                    'needs a CameraInfo of its own')
            return intrinsics.global_shutter_camera()
        if not self._uncalibrated:
            raise MissingInputError(f'no message of {self._topics.camera_info} can be used'
                                    f'{self._why()}')
        guess = _FOCAL_GUESS * max(size)
        return RollingShutterCamera(
            width=size[0], height=size[1], fx=guess, fy=guess, cx=0.5 * (size[0] - 1),
            cy=0.5 * (size[1] - 1), readout_time=0.0)
