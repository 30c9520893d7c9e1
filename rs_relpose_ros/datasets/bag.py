"""A recording as a bag, in the layout of the project's bags."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import heapq
from pathlib import Path
from typing import Any

from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.datasets.recording import Recording
from rs_relpose_ros.timing import to_nanoseconds

IMAGE_TOPIC = '/camera/image_raw/compressed'
CAMERA_INFO_TOPIC = '/camera/camera_info'
IMU_TOPIC = '/imu/data_raw'

CAMERA_FRAME = 'camera_optical_frame'
IMU_FRAME = 'imu_link'

# How long after the read-out of an image, and after an IMU sample, a driver delivers it [s].
_IMAGE_DELAY = 0.005
_IMU_DELAY = 0.002

# Bag time [ns], topic, type and a function that makes the message.
_Entry = tuple[int, str, str, Callable[[], Any]]


def write_recording(recording: Recording, path: Path,
                    on_image: Callable[[], object] = lambda: None) -> None:
    """Write a bag; the JPEG bytes and all stamps as recorded.

    Parameters
    ----------
    recording : Recording
    path : Path
        Directory to create.
    on_image : callable
        Called after each image.
    """
    with BagWriter(path) as bag:
        entries = heapq.merge(_images(recording, bag, on_image), _imu(recording, bag),
                              key=lambda entry: entry[0])
        for bag_time_ns, topic, msgtype, make in entries:
            bag.write(topic, msgtype, make(), bag_time_ns)


def _images(recording: Recording, bag: BagWriter,
            on_image: Callable[[], object]) -> Iterator[_Entry]:
    delay_ns = to_nanoseconds(recording.camera.readout_time + _IMAGE_DELAY)
    for index, stamp_ns in enumerate(recording.stamps_ns):
        def info(stamp_ns: int = stamp_ns) -> Any:
            return bag.camera_info(stamp_ns, CAMERA_FRAME, recording.camera)

        def image(index: int = index, stamp_ns: int = stamp_ns) -> Any:
            message = bag.compressed_image(stamp_ns, CAMERA_FRAME, recording.jpeg(index),
                                           recording.image_format)
            on_image()
            return message

        yield stamp_ns + delay_ns, CAMERA_INFO_TOPIC, 'sensor_msgs/msg/CameraInfo', info
        yield stamp_ns + delay_ns, IMAGE_TOPIC, 'sensor_msgs/msg/CompressedImage', image


def _imu(recording: Recording, bag: BagWriter) -> Iterator[_Entry]:
    delay_ns = to_nanoseconds(_IMU_DELAY)
    for index, stamp_ns in enumerate(recording.imu_stamps_ns):
        def message(index: int = index, stamp_ns: int = stamp_ns) -> Any:
            forces = recording.linear_accelerations
            return bag.imu(stamp_ns, IMU_FRAME, recording.angular_velocities[index],
                           None if forces is None else forces[index])

        yield stamp_ns + delay_ns, IMU_TOPIC, 'sensor_msgs/msg/Imu', message
