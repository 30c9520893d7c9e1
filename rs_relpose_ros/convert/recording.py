"""A recording of any source, as it is written into a bag: images, IMU samples, camera, truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
import heapq
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from rs_relpose_ros.bags.layout import (
    ACCEL_TOPIC,
    CAMERA_FRAME,
    CAMERA_INFO_TOPIC,
    COMPRESSED_TOPIC,
    GROUND_TRUTH_TOPIC,
    GYRO_TOPIC,
    IMAGE_DELAY,
    IMU_DELAY,
    IMU_FRAME,
    IMU_TOPIC,
    WORLD_FRAME,
)
from rs_relpose_ros.bags.topics import CAMERA_INFO, COMPRESSED_IMAGE, IMU, POSE_STAMPED
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.config.parameter_file import SourcedValue
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds
from rs_relpose_ros.images.headers import encoded_image_size
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.messages.incoming import TruePose

# IMU samples after the last image serve nothing but its rows; those before it, the gravity filter.
_IMU_AFTER_NS = 3 * NANOSECONDS
# No camera makes JPEGs of this size.
_MAX_IMAGE_BYTES = 1 << 27

# Bag time [ns], topic, type, message.
_Entry = tuple[int, str, str, Any]


class RecordedImage(Protocol):
    """An image of a recording, read when it is asked for."""

    @property
    def stamp_ns(self) -> int:
        """Stamp [ns] by the camera's clock."""

    @property
    def name(self) -> str:
        """What errors call it."""

    def encoded(self) -> bytes:
        """JPEG data."""


@dataclass(frozen=True, slots=True)
class ImageFile:
    """A JPEG file and the stamp [ns] of its image."""

    stamp_ns: int
    path: Path

    @property
    def name(self) -> str:
        """Its path."""
        return str(self.path)

    def encoded(self) -> bytes:
        """The file's bytes."""
        if not self.path.is_file():
            raise MissingInputError(f'there is no image {self.path}')
        if self.path.stat().st_size > _MAX_IMAGE_BYTES:
            raise InputError(f'{self.path} has more than {_MAX_IMAGE_BYTES} bytes: it is no JPEG '
                             'image')
        return self.path.read_bytes()


@dataclass(frozen=True, slots=True)
class Recording:
    """One camera and one IMU, at least one image and one sample, each by its sensor's clock.

    Images, samples and poses in the order of their stamps.
    """

    camera: RollingShutterCamera | None   # None: not calibrated, and the bag has no CameraInfo
    images: Sequence[RecordedImage]
    image_format: str   # as in sensor_msgs/CompressedImage
    imu: tuple[ImuSample, ...]   # in its own axes; without `accel` gyro and accelerometer together
    accel: tuple[ImuSample, ...] = ()   # samples of an accelerometer with stamps of its own
    truth: tuple[TruePose, ...] = ()   # of the camera's optical frame, on the IMU's clock

    def __post_init__(self) -> None:
        if not self.images or not self.imu:
            raise MissingInputError('a recording needs at least one image and one IMU sample')
        for earlier, later in zip(self.images, self.images[1:], strict=False):
            if later.stamp_ns <= earlier.stamp_ns:
                raise InputError(f'{later.name} is stamped {later.stamp_ns} ns, not after '
                                 f'the {earlier.stamp_ns} ns of {earlier.name} before it')
        first, last = self.images[0].stamp_ns, self.images[-1].stamp_ns
        if self.imu[-1].stamp_ns < first or self.imu[0].stamp_ns > last:
            raise InputError(
                f'the IMU samples, from {self.imu[0].stamp_ns} to {self.imu[-1].stamp_ns} ns, '
                f'and the images, from {first} to {last} ns, have no time in common: they are '
                'not of the same recording, or their stamps are not on one clock')

    def cropped_imu(self) -> tuple[ImuSample, ...]:
        """The samples up to shortly after the last image."""
        return self._cropped(self.imu)

    def cropped_accel(self) -> tuple[ImuSample, ...]:
        """The same of an accelerometer apart."""
        return self._cropped(self.accel)

    def _cropped(self, samples: tuple[ImuSample, ...]) -> tuple[ImuSample, ...]:
        end_ns = self.images[-1].stamp_ns + _IMU_AFTER_NS
        return tuple(sample for sample in samples if sample.stamp_ns <= end_ns)


@dataclass(frozen=True, slots=True)
class Conversion:
    """What a source gives: its recording, and what the node must know of it."""

    recording: Recording
    title: str   # head of the parameter file
    parameters: tuple[SourcedValue, ...]


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
        gyro_topic = GYRO_TOPIC if recording.accel else IMU_TOPIC
        streams = (_images(recording, bag, on_image),
                   _imu(recording.cropped_imu(), gyro_topic, bag),
                   _imu(recording.cropped_accel(), ACCEL_TOPIC, bag),
                   _truth(recording.truth, bag))
        for bag_time_ns, topic, msgtype, message in heapq.merge(*streams, key=itemgetter(0)):
            bag.write(topic, msgtype, message, bag_time_ns)


def by_stamp(samples: Iterable[ImuSample]) -> tuple[ImuSample, ...]:
    """Samples in the order of their stamps, all of them: the node takes repeated ones once."""
    return tuple(sorted(samples, key=attrgetter('stamp_ns')))


def _images(recording: Recording, bag: BagWriter,
            on_image: Callable[[], object]) -> Iterator[_Entry]:
    camera = recording.camera
    size, whose = None, ''
    delay_ns = to_nanoseconds(IMAGE_DELAY)
    if camera is not None:
        size, whose = (camera.width, camera.height), 'the calibration is for'
        delay_ns = to_nanoseconds(camera.readout_time + IMAGE_DELAY)
    for image in recording.images:
        data = image.encoded()
        found = _size(image, data)
        if size is None:
            size, whose = found, 'the first image has'
        if found != size:
            raise InputError(f'{image.name} has {found[0]}x{found[1]} pixels, but {whose} '
                             f'{size[0]}x{size[1]}')
        bag_time_ns = image.stamp_ns + delay_ns
        if camera is not None:
            yield (bag_time_ns, CAMERA_INFO_TOPIC, CAMERA_INFO,
                   bag.camera_info(image.stamp_ns, CAMERA_FRAME, camera))
        yield (bag_time_ns, COMPRESSED_TOPIC, COMPRESSED_IMAGE,
               bag.compressed_image(image.stamp_ns, CAMERA_FRAME, data, recording.image_format))
        on_image()


def _imu(samples: tuple[ImuSample, ...], topic: str, bag: BagWriter) -> Iterator[_Entry]:
    delay_ns = to_nanoseconds(IMU_DELAY)
    for sample in samples:
        yield (sample.stamp_ns + delay_ns, topic, IMU,
               bag.imu(sample.stamp_ns, IMU_FRAME, sample.angular_velocity,
                       sample.linear_acceleration))


def _truth(poses: tuple[TruePose, ...], bag: BagWriter) -> Iterator[_Entry]:
    delay_ns = to_nanoseconds(IMU_DELAY)
    for pose in poses:
        yield (pose.stamp_ns + delay_ns, GROUND_TRUTH_TOPIC, POSE_STAMPED,
               bag.pose(pose.stamp_ns, WORLD_FRAME, pose.position, pose.quat_xyzw))


def _size(image: RecordedImage, data: bytes) -> tuple[int, int]:
    """Width and height [px] of JPEG data."""
    try:
        return encoded_image_size(np.frombuffer(data, dtype=np.uint8))
    except InputError as error:
        raise InputError(f'{image.name}: {error}') from error
