"""One pass over a bag: everything that the verdicts are made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from rs_relpose_ros.bags.reader import Bag, BagMessage
from rs_relpose_ros.bags.topics import Topic
from rs_relpose_ros.check.inertial import Inertial
from rs_relpose_ros.check.streams import Stamps
from rs_relpose_ros.check.turning import TurningImages
from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.errors import RsRelposeError
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


@dataclass(slots=True, eq=False)
class Scan:
    """What one pass saw.

    Attributes
    ----------
    encodings : dict
        Number of images by encoding or format.
    sizes : dict
        Number of decoded images by (width, height).
    largest_image : int
        Bytes of the largest image message.
    image_problem, calibration_problem, imu_problem : str
        The first reason why a message cannot be used; `bad_images` and so on count them.
    calibrations : int
        Number of different ones in turn.
    """

    turning: TurningImages
    image_stamps: Stamps = field(default_factory=Stamps)
    imu_stamps: Stamps = field(default_factory=Stamps)
    inertial: Inertial = field(default_factory=Inertial)
    encodings: dict[str, int] = field(default_factory=dict)
    sizes: dict[tuple[int, int], int] = field(default_factory=dict)
    largest_image: int = 0
    image_problem: str = ''
    bad_images: int = 0
    intrinsics: Intrinsics | None = None
    calibrations: int = 0
    calibration_problem: str = ''
    imu_problem: str = ''
    bad_imu: int = 0
    gyro_samples: int = 0
    accel_samples: int = 0


def scan(bag: Bag, chosen: Chosen, tracking: TrackingConfig,
         on_message: Callable[[], object]) -> Scan:
    """Read `chosen` topics of a bag once, and follow points by the detector of `tracking`.

    Raises
    ------
    InputError
        The bag is damaged.
    """
    seen = Scan(turning=TurningImages(chosen.image.count if chosen.image else 0, tracking))
    reader = _Reader(seen)
    for role, message in reader.feed.messages(bag, chosen):
        reader.take(role, message)
        on_message()
    return seen


class _Reader:
    """Sorts messages into a `Scan`."""

    def __init__(self, seen: Scan) -> None:
        self._seen = seen
        self._recorded_ns = 0
        self.feed = SensorFeed({Role.IMU: self._imu, Role.ACCEL: self._accel,
                                Role.CAMERA_INFO: self._camera_info, Role.IMAGE: self._image})

    def take(self, role: Role, message: BagMessage) -> None:
        seen, self._recorded_ns = self._seen, message.bag_time_ns
        try:
            self.feed.receive(role, message.message)
        except RsRelposeError as error:
            if role is Role.IMAGE:
                seen.bad_images += 1
                seen.image_problem = seen.image_problem or str(error)
            elif role is Role.CAMERA_INFO:
                seen.calibration_problem = seen.calibration_problem or str(error)
            else:
                seen.bad_imu += 1
                seen.imu_problem = seen.imu_problem or str(error)

    def _imu(self, sample: ImuSample) -> None:
        seen = self._seen
        seen.imu_stamps.add(sample.stamp_ns, self._recorded_ns)
        seen.inertial.add(sample)
        seen.accel_samples += sample.linear_acceleration is not None
        if sample.angular_velocity is not None:
            seen.gyro_samples += 1
            seen.turning.add_rate(sample.stamp_ns, self._recorded_ns,
                                  np.array(sample.angular_velocity))

    def _accel(self, sample: ImuSample) -> None:
        self._seen.accel_samples += 1
        self._seen.inertial.add(sample)

    def _camera_info(self, intrinsics: Intrinsics) -> None:
        self._seen.calibrations += intrinsics != self._seen.intrinsics
        self._seen.intrinsics = intrinsics

    def _image(self, published: PublishedImage) -> None:
        seen = self._seen
        _count(seen.encodings, published.image.encoding[:60])
        seen.largest_image = max(seen.largest_image, len(published.image.data))
        seen.image_stamps.add(published.stamp_ns, self._recorded_ns)
        if not seen.turning.wants_next():
            return
        image = published.image.decoded()
        size = image.shape[1], image.shape[0]
        _count(seen.sizes, size)
        intrinsics = seen.intrinsics
        if intrinsics is not None and (intrinsics.image_width, intrinsics.image_height) == size:
            seen.turning.add_image(published.stamp_ns, self._recorded_ns, image, intrinsics)


def _count(counts: dict[_Key, int], key: _Key) -> None:
    """Count `key` in a dictionary that a source of ever new keys cannot fill."""
    if key in counts or len(counts) < _MOST_KEYS:
        counts[key] = counts.get(key, 0) + 1
