"""A recording of any dataset: images as they lie on the disk, IMU samples, and the camera."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
import heapq
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from rs_relpose_ros.bags.layout import (
    CAMERA_FRAME,
    CAMERA_INFO_TOPIC,
    COMPRESSED_TOPIC,
    IMAGE_DELAY,
    IMU_DELAY,
    IMU_FRAME,
    IMU_TOPIC,
)
from rs_relpose_ros.bags.topics import CAMERA_INFO, COMPRESSED_IMAGE, IMU
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds
from rs_relpose_ros.images.headers import encoded_image_size
from rs_relpose_ros.imu.samples import ImuSample

# IMU samples after the last image serve nothing but its rows; those before it, the gravity filter.
_IMU_AFTER_NS = 3 * NANOSECONDS
# No camera makes JPEGs of this size.
_MAX_IMAGE_BYTES = 1 << 27

# Bag time [ns], topic, type, message.
_Entry = tuple[int, str, str, Any]


@dataclass(frozen=True, slots=True)
class ImageFile:
    """A JPEG file and the stamp [ns] of its image."""

    stamp_ns: int
    path: Path


@dataclass(frozen=True, slots=True)
class Recording:
    """One camera and one IMU, at least one image and one sample, each by its sensor's clock."""

    camera: RollingShutterCamera
    images: tuple[ImageFile, ...]
    image_format: str   # as in sensor_msgs/CompressedImage
    imu: tuple[ImuSample, ...]   # in its own axes

    def __post_init__(self) -> None:
        if not self.images or not self.imu:
            raise MissingInputError('a recording needs at least one image and one IMU sample')
        for earlier, later in zip(self.images, self.images[1:], strict=False):
            if later.stamp_ns <= earlier.stamp_ns:
                raise InputError(f'{later.path.name} is stamped {later.stamp_ns} ns, not after '
                                 f'the {earlier.stamp_ns} ns of {earlier.path.name} before it')
        first, last = self.images[0].stamp_ns, self.images[-1].stamp_ns
        if self.imu[-1].stamp_ns < first or self.imu[0].stamp_ns > last:
            raise InputError(
                f'the IMU samples, from {self.imu[0].stamp_ns} to {self.imu[-1].stamp_ns} ns, '
                f'and the images, from {first} to {last} ns, have no time in common: they are '
                'not of the same recording, or their stamps are not on one clock')

    def cropped_imu(self) -> tuple[ImuSample, ...]:
        """The samples up to shortly after the last image."""
        end_ns = self.images[-1].stamp_ns + _IMU_AFTER_NS
        return tuple(sample for sample in self.imu if sample.stamp_ns <= end_ns)


def ordered_samples(samples: Iterable[ImuSample]) -> tuple[ImuSample, ...]:
    """Samples by stamp, exact duplicates once."""
    by_stamp: dict[int, ImuSample] = {}
    for sample in samples:
        if by_stamp.setdefault(sample.stamp_ns, sample) != sample:
            raise InputError(f'two IMU samples of the stamp {sample.stamp_ns} ns differ')
    return tuple(by_stamp[stamp_ns] for stamp_ns in sorted(by_stamp))


def write_bag(recording: Recording, path: Path | str,
              on_image: Callable[[], object] = lambda: None) -> None:
    """Write a recording as a bag, in the order in which drivers would have delivered.

    Stamps stay as recorded, JPEG bytes unchanged. `on_image` is called after each image. Where the
    bag cannot be created or an image cannot be used, no bag is left behind.
    """
    with BagWriter(path) as bag:
        for bag_time_ns, topic, msgtype, message in heapq.merge(
                _images(recording, bag, on_image), _imu(recording, bag), key=itemgetter(0)):
            bag.write(topic, msgtype, message, bag_time_ns)


def _images(recording: Recording, bag: BagWriter,
            on_image: Callable[[], object]) -> Iterator[_Entry]:
    delay_ns = to_nanoseconds(recording.camera.readout_time + IMAGE_DELAY)
    for image in recording.images:
        bag_time_ns = image.stamp_ns + delay_ns
        yield (bag_time_ns, CAMERA_INFO_TOPIC, CAMERA_INFO,
               bag.camera_info(image.stamp_ns, CAMERA_FRAME, recording.camera))
        yield (bag_time_ns, COMPRESSED_TOPIC, COMPRESSED_IMAGE,
               bag.compressed_image(image.stamp_ns, CAMERA_FRAME,
                                    _read_jpeg(image.path, recording.camera),
                                    recording.image_format))
        on_image()


def _imu(recording: Recording, bag: BagWriter) -> Iterator[_Entry]:
    delay_ns = to_nanoseconds(IMU_DELAY)
    for sample in recording.cropped_imu():
        yield (sample.stamp_ns + delay_ns, IMU_TOPIC, IMU,
               bag.imu(sample.stamp_ns, IMU_FRAME, sample.angular_velocity,
                       sample.linear_acceleration))


def _read_jpeg(path: Path, camera: RollingShutterCamera) -> bytes:
    if not path.is_file():
        raise MissingInputError(f'there is no image {path}')
    if path.stat().st_size > _MAX_IMAGE_BYTES:
        raise InputError(f'{path} has more than {_MAX_IMAGE_BYTES} bytes: it is no JPEG image')
    data = path.read_bytes()
    try:
        size = encoded_image_size(np.frombuffer(data, dtype=np.uint8))
    except InputError as error:
        raise InputError(f'{path}: {error}') from error
    if size != (camera.width, camera.height):
        raise InputError(f'{path} has {size[0]}x{size[1]} pixels, but the calibration is for '
                         f'{camera.width}x{camera.height}')
    return data
