"""One pass over a bag: everything that the verdicts are made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.bags.reader import BagMessage
from rs_relpose_ros.bags.topics import Topic
from rs_relpose_ros.check.inertial import Inertial
from rs_relpose_ros.check.streams import Stamps
from rs_relpose_ros.config.intrinsics import IntrinsicsConfig
from rs_relpose_ros.errors import MissingInputError, RsRelposeError
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.messages.incoming import PublishedImage
from rs_relpose_ros.messages.sensor_feed import Role, SensorFeed

# Images that are decoded, evenly over the recording.
_DECODED = 40
# Stamps that are kept, the first ones: enough to tell jitter from automatic exposure.
_MOST_STAMPS = 1000
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

    def __init__(self, images: int, told: IntrinsicsConfig, no_camera_info: bool) -> None:
        self._told = told
        # Whether the intrinsics are those of the parameters: there is no calibrated CameraInfo.
        self.by_parameters = no_camera_info and told.given
        self._every = max(images // _DECODED, 1)
        self._first_stamps: list[int] = []
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

    def _camera_info(self, intrinsics: Intrinsics) -> None:
        self.calibrations += intrinsics != self.intrinsics
        self.intrinsics, self.by_parameters = intrinsics, False

    def _image(self, published: PublishedImage) -> None:
        _count(self.encodings, published.image.encoding[:60])
        self.largest_image = max(self.largest_image, len(published.image.data))
        self.image_stamps.add(published.stamp_ns, self._recorded_ns)
        if len(self._first_stamps) < _MOST_STAMPS:
            self._first_stamps.append(published.stamp_ns)
        if (self.image_stamps.count - 1) % self._every:
            return
        height, width = published.image.decoded().shape
        _count(self.sizes, (width, height))
        if self.by_parameters:
            self.intrinsics = self._told.of_image(width, height)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """The first stamps of the images (at most 1000), each once, increasing."""
        return np.unique(np.array(self._first_stamps, dtype=np.int64))


def _count(counts: dict[_Key, int], key: _Key) -> None:
    """Count `key` in a dictionary that a source of ever new keys cannot fill."""
    if key in counts or len(counts) < _MOST_KEYS:
        counts[key] = counts.get(key, 0) + 1
