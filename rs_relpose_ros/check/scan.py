"""One pass over a bag: everything that the verdicts are made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from rs_relpose_ros.bags.reader import Bag, BagMessage
from rs_relpose_ros.bags.topics import Topic
from rs_relpose_ros.check.inertial import Inertial
from rs_relpose_ros.check.streams import Stamps
from rs_relpose_ros.check.turning import TurningImages
from rs_relpose_ros.config.intrinsics import IntrinsicsConfig
from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.errors import MissingInputError, RsRelposeError
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.messages.incoming import PublishedImage
from rs_relpose_ros.messages.sensor_feed import Role, SensorFeed

_MOST_KEYS = 20
_Key = TypeVar('_Key')


@dataclass(frozen=True, slots=True)
class Chosen:
    """The topics that are looked at; None where there is none of that kind."""

    image: Topic | None
    camera_info: Topic | None
    imu: Topic | None
    accel: Topic | None

    @property
    def all(self) -> list[Topic]:
        """Those that there are."""
        return [topic for topic in (self.image, self.camera_info, self.imu, self.accel) if topic]


class Scan:
    """What one pass saw; `images` is the number of images to come.

    `told`: intrinsics for a camera whose CameraInfo has none.
    """

    def __init__(self, images: int, tracking: TrackingConfig, told: IntrinsicsConfig,
                 no_camera_info: bool) -> None:
        self._told = told
        # Whether the intrinsics are those of the parameters: there is no calibrated CameraInfo.
        self.by_parameters = no_camera_info and told.given
        self.turning = TurningImages(images, tracking)
        self.image_stamps, self.imu_stamps, self.inertial = Stamps(), Stamps(), Inertial()
        self.encodings: dict[str, int] = {}            # number of images by encoding or format
        self.sizes: dict[tuple[int, int], int] = {}    # of decoded images by (width, height)
        self.largest_image = 0                         # message of an image [bytes]
        self.intrinsics: Intrinsics | None = None
        self.calibrations = 0                          # number of different ones in turn
        self.bad_images = self.bad_imu = 0             # messages that cannot be used
        self.problems: dict[Role, str] = {}            # the first reason for that
        self.feed = SensorFeed({Role.IMU: self._imu, Role.ACCEL: self.inertial.add,
                                Role.CAMERA_INFO: self._camera_info, Role.IMAGE: self._image})
        self._recorded_ns = 0

    def take(self, role: Role, message: BagMessage) -> None:
        """Take in the next message."""
        self._recorded_ns = message.bag_time_ns
        try:
            self.feed.receive(role, message.message)
        except RsRelposeError as error:
            if role is Role.CAMERA_INFO and isinstance(error, MissingInputError):
                self.by_parameters = self._told.given
            self.bad_images += role is Role.IMAGE
            self.bad_imu += role in (Role.IMU, Role.ACCEL)
            self.problems.setdefault(Role.IMU if role is Role.ACCEL else role, str(error))

    def _imu(self, sample: ImuSample) -> None:
        self.imu_stamps.add(sample.stamp_ns, self._recorded_ns)
        self.inertial.add(sample)
        if sample.angular_velocity is not None:
            self.turning.add_rate(sample.stamp_ns, self._recorded_ns,
                                  np.array(sample.angular_velocity))

    def _camera_info(self, intrinsics: Intrinsics) -> None:
        self.calibrations += intrinsics != self.intrinsics
        self.intrinsics, self.by_parameters = intrinsics, False

    def _image(self, published: PublishedImage) -> None:
        _count(self.encodings, published.image.encoding[:60])
        self.largest_image = max(self.largest_image, len(published.image.data))
        self.image_stamps.add(published.stamp_ns, self._recorded_ns)
        if not self.turning.wants_next():
            return
        image = published.image.decoded()
        size = image.shape[1], image.shape[0]
        _count(self.sizes, size)
        if self.by_parameters:
            self.intrinsics = self._told.of_image(*size)
        intrinsics = self.intrinsics
        if intrinsics is not None and (intrinsics.image_width, intrinsics.image_height) == size:
            self.turning.add_image(published.stamp_ns, self._recorded_ns, image, intrinsics)


def scan(bag: Bag, chosen: Chosen, tracking: TrackingConfig, on_message: Callable[[], object],
         told: IntrinsicsConfig | None = None) -> Scan:
    """Read `chosen` topics of a bag once, and follow points by the detector of `tracking`.

    `told`: intrinsics for a camera whose CameraInfo has none.

    Raises
    ------
    InputError
        The bag is damaged.
    """
    seen = Scan(chosen.image.count if chosen.image else 0, tracking, told or IntrinsicsConfig(),
                no_camera_info=chosen.camera_info is None)
    for role, message in seen.feed.messages(bag, chosen):
        seen.take(role, message)
        on_message()
    return seen


def _count(counts: dict[_Key, int], key: _Key) -> None:
    """Count `key` in a dictionary that a source of ever new keys cannot fill."""
    if key in counts or len(counts) < _MOST_KEYS:
        counts[key] = counts.get(key, 0) + 1
