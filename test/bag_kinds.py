"""Bags of every storage, with messages of a camera and an IMU."""

from collections.abc import Callable, Sequence
import math
from pathlib import Path
from typing import Any

import message_builders as build
import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.messages import outgoing

STAMP_NS = 1_700_000_000_123_456_789
IMAGE = 'sensor_msgs/msg/Image'
INFO = 'sensor_msgs/msg/CameraInfo'
IMU = 'sensor_msgs/msg/Imu'
POSE = 'geometry_msgs/msg/PoseStamped'
CAMERA = RollingShutterCamera(width=8, height=6, fx=5.0, fy=5.5, cx=3.5, cy=2.5, readout_time=0.03)
PIXELS = np.arange(48, dtype=np.uint8).reshape(6, 8)
JAZZY = build.TYPESTORE
NOETIC = get_typestore(Stores.ROS1_NOETIC)

ROSBAG2_KINDS = {
    f'{name}{suffix}': (storage, mode)
    for name, storage in (('sqlite3', StoragePlugin.SQLITE3), ('mcap', StoragePlugin.MCAP))
    for suffix, mode in (
        ('', CompressionMode.NONE),
        ('_zstd_files', CompressionMode.FILE),
        ('_zstd_messages', CompressionMode.MESSAGE),
        ('_zstd_chunks', CompressionMode.STORAGE),
    )
    if not (name == 'sqlite3' and mode is CompressionMode.STORAGE)
}
ROS1_KINDS = {
    'ros1': None,
    'ros1_lz4': Ros1Writer.CompressionFormat.LZ4,
    'ros1_bz2': Ros1Writer.CompressionFormat.BZ2,
}
KINDS = (*ROSBAG2_KINDS, *ROS1_KINDS)

# Topic, type, message and time after STAMP_NS.
Entry = tuple[str, str, Any, int]


def imu(t: int, rate: tuple[float, float, float]) -> Entry:
    return '/imu', IMU, build.imu(build.rosbags_types, STAMP_NS + t, rate, (0.0, 0.5, 9.8)), t


def image(t: int, pixels: np.ndarray) -> Entry:
    return (
        '/camera/image_raw',
        IMAGE,
        build.gray_image(build.rosbags_types, pixels, STAMP_NS + t),
        t,
    )


def info(t: int, camera: RollingShutterCamera) -> Entry:
    return (
        '/camera/camera_info',
        INFO,
        outgoing.camera_info_message(STAMP_NS + t, 'camera', camera, None, build.rosbags_types),
        t,
    )


def pose(t: int, position: tuple[float, float, float]) -> Entry:
    return (
        '/ground_truth/pose',
        POSE,
        outgoing.pose_stamped_message(
            STAMP_NS + t, 'world', (0.0, 0.0, 0.0, 1.0), position, build.rosbags_types
        ),
        t,
    )


def camera_messages() -> list[Entry]:
    """A short recording, not in the order of time."""
    return [
        *(imu(t, (0.1 * t, 0.2, 0.3)) for t in (1, 3, 5, 7)),
        image(4, PIXELS),
        info(2, CAMERA),
        pose(6, (1.0, 2.0, 3.0)),
    ]


def write_kind(
    kind: str,
    folder: Path,
    messages: list[Entry] | None = None,
    serialize: Callable[..., bytes] = JAZZY.serialize_cdr,
    **offered: Any,
) -> Path:
    """A bag of one of `KINDS`, by default with `camera_messages`; `offered`: of its topics."""
    writer: Any
    if kind in ROS1_KINDS:
        writer = Ros1Writer(folder / f'{kind}.bag')
        typestore = NOETIC
        if ROS1_KINDS[kind] is not None:
            writer.set_compression(ROS1_KINDS[kind])

        def serialize(message: Any, msgtype: str) -> bytes:
            return bytes(NOETIC.serialize_ros1(as_ros1(message), msgtype))
    else:
        storage, mode = ROSBAG2_KINDS[kind]
        writer = Writer(folder / kind, version=9, storage_plugin=storage)
        typestore = JAZZY
        if mode is not CompressionMode.NONE:
            writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, msgtype, message, time in camera_messages() if messages is None else messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, msgtype, typestore=typestore, **offered
                )
            writer.write(connections[topic], STAMP_NS + time, serialize(message, msgtype))
    return writer.path


def as_ros1(message: Any) -> Any:
    """The message of ROS 1: headers have a number, calibrations capitals."""
    values = {}
    for name, value in vars(message).items():
        if name == '__msgtype__':
            continue
        capital = name.upper() if message.__msgtype__ == INFO and name in 'dkrp' else name
        values[capital] = as_ros1(value) if hasattr(value, '__msgtype__') else value
    if message.__msgtype__ == 'std_msgs/msg/Header':
        values['seq'] = 17
    return NOETIC.types[message.__msgtype__](**values)


def copied(
    source: Path,
    path: Path,
    change: Callable[[Any], bool | None] = lambda message: None,
    seconds: float = math.inf,
    first: Sequence[tuple[str, Any]] = (),
) -> Path:
    """The first seconds of a bag, its messages changed in place; left out where that is true.

    `first`: topics and messages before them.
    """
    with open_bag(source) as bag, BagWriter(path) as out:
        for topic, message in first:
            out.write(topic, message.__msgtype__, message, 1)
        begin_ns = None
        for item in bag.messages(bag.topics):
            begin_ns = begin_ns or item.bag_time_ns
            if item.bag_time_ns <= begin_ns + seconds * 1e9 and not change(item.message):
                out.write(item.topic, item.message.__msgtype__, item.message, item.bag_time_ns)
    return path


def storage_file(bag: Path) -> Path:
    """The file with the messages."""
    return (
        bag
        if bag.is_file()
        else next(file for file in sorted(bag.iterdir()) if file.name != 'metadata.yaml')
    )
