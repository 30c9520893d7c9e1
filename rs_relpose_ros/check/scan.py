"""One pass over a bag: everything that the verdicts are made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rs_relpose_ros.bags.reader import Bag, COMPRESSED_IMAGE, Topic
from rs_relpose_ros.check.inertial import Inertial
from rs_relpose_ros.check.streams import Stamps
from rs_relpose_ros.check.turning import TurningImages
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.messages.incoming import (
    accelerometer_sample_from_message,
    image_from_compressed,
    image_from_message,
    imu_sample_from_message,
    intrinsics_from_info,
    stamp_ns,
)


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

    image_stamps: Stamps = field(default_factory=Stamps)
    imu_stamps: Stamps = field(default_factory=Stamps)
    accel_stamps: Stamps = field(default_factory=Stamps)
    inertial: Inertial = field(default_factory=Inertial)
    turning: TurningImages = field(default_factory=lambda: TurningImages(0))
    encodings: dict[str, int] = field(default_factory=dict)
    sizes: dict[tuple[int, int], int] = field(default_factory=dict)
    largest_image: int = 0
    image_problem: str = ''
    bad_images: int = 0
    calibration: Intrinsics | None = None
    calibrations: int = 0
    calibration_problem: str = ''
    imu_problem: str = ''
    bad_imu: int = 0
    gyro_samples: int = 0
    accel_samples: int = 0


def scan(bag: Bag, chosen: Chosen, on_message: Callable[[], object]) -> Scan:
    """Read `chosen` topics of a bag once.

    Raises
    ------
    InputError
        The bag is damaged.
    """
    seen = Scan(turning=TurningImages(chosen.image.count if chosen.image else 0))
    reader = _Reader(seen, chosen)
    for message in bag.messages(chosen.all):
        reader.take(message.topic, message.message, message.bag_time_ns)
        on_message()
    return seen


class _Reader:
    """Sorts messages into a `Scan`."""

    def __init__(self, seen: Scan, chosen: Chosen) -> None:
        self._seen, self._chosen = seen, chosen
        self._compressed = chosen.image is not None and chosen.image.msgtype == COMPRESSED_IMAGE

    def take(self, topic: str, msg: Any, recorded_ns: int) -> None:
        chosen, seen = self._chosen, self._seen
        if chosen.image is not None and topic == chosen.image.name:
            self._image(msg, recorded_ns)
        elif chosen.camera_info is not None and topic == chosen.camera_info.name:
            self._camera_info(msg)
        elif chosen.accel is not None and topic == chosen.accel.name:
            sample = self._sample(msg, accelerometer_sample_from_message)
            if sample is not None:
                seen.accel_stamps.add(sample.stamp_ns, recorded_ns)
                seen.accel_samples += 1
                seen.inertial.add(sample)
        else:
            sample = self._sample(msg, imu_sample_from_message)
            if sample is not None:
                seen.imu_stamps.add(sample.stamp_ns, recorded_ns)
                seen.inertial.add(sample)
                seen.accel_samples += sample.linear_acceleration is not None
                if sample.angular_velocity is not None:
                    seen.gyro_samples += 1
                    seen.turning.add_rate(sample.stamp_ns, recorded_ns,
                                          np.array(sample.angular_velocity))

    def _sample(self, msg: Any, read: Callable[[Any], ImuSample]) -> ImuSample | None:
        try:
            return read(msg)
        except RsRelposeError as error:
            self._seen.bad_imu += 1
            self._seen.imu_problem = self._seen.imu_problem or str(error)
            return None

    def _camera_info(self, msg: Any) -> None:
        seen = self._seen
        try:
            calibration = intrinsics_from_info(msg)
        except RsRelposeError as error:
            seen.calibration_problem = seen.calibration_problem or str(error)
            return
        seen.calibrations += calibration != seen.calibration
        seen.calibration = calibration

    def _image(self, msg: Any, recorded_ns: int) -> None:
        seen = self._seen
        name = str(msg.format if self._compressed else msg.encoding)[:60]
        if name in seen.encodings or len(seen.encodings) < 20:
            seen.encodings[name] = seen.encodings.get(name, 0) + 1
        seen.largest_image = max(seen.largest_image, len(msg.data))
        try:
            stamp = stamp_ns(msg.header)
            seen.image_stamps.add(stamp, recorded_ns)
            if not seen.turning.wants_next():
                return
            image = (image_from_compressed if self._compressed else image_from_message)(msg)
        except RsRelposeError as error:
            seen.bad_images += 1
            seen.image_problem = seen.image_problem or str(error)
            return
        size = image.shape[1], image.shape[0]
        if size in seen.sizes or len(seen.sizes) < 20:
            seen.sizes[size] = seen.sizes.get(size, 0) + 1
        calibration = seen.calibration
        if calibration is not None and (
                calibration.image_width, calibration.image_height) == size:
            seen.turning.add_image(stamp, recorded_ns, image, calibration)
