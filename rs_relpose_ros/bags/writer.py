"""Write rosbag2 directories (MCAP storage) with ROS 2 Jazzy's messages."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
import shutil
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

from rs_relpose_ros.bags.reader import RawMessage, TopicOrigin
from rs_relpose_ros.bags.topics import Topic
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import NANOSECONDS

# Where a bag tells no hash of a type that is not known here: players go by its name.
_UNKNOWN_HASH = f'RIHS01_{64 * "0"}'


class BagWriter:
    """Writes one bag into a directory that it creates, with parents; use it as a context manager.

    The bag is whole when the block ends normally. When it ends with an exception the directory is
    removed again, so that no half bag is taken for a whole one. A path that exists already or
    cannot be created raises InputError.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        refuse_existing(self.path)
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        self._writer = Writer(self.path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._connections: dict[str, Connection] = {}
        self._copied: dict[tuple[str, str], Connection] = {}

    def __enter__(self) -> Self:
        # Asked again: the path may have come into being since.
        refuse_existing(self.path)
        try:
            self._writer.open()
        except OSError as error:
            raise InputError(
                f'cannot create the bag {self.path}: {error.strerror}; choose a writable path'
            ) from error
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        whole = False
        try:
            if kind is None:
                self._writer.close()
                whole = True
        finally:
            if not whole:
                with suppress(Exception):
                    self._writer.abort()
                shutil.rmtree(self.path, ignore_errors=True)

    def type(self, msgtype: str) -> Any:
        """Message class of a type name such as ``'sensor_msgs/msg/Imu'``."""
        try:
            return self._typestore.types[msgtype]
        except KeyError:
            raise InputError(
                f'ROS 2 Jazzy has no message type {msgtype!r}; names look like '
                "'sensor_msgs/msg/Imu'") from None

    def write(self, topic: str, msgtype: str, message: Any, bag_time_ns: int) -> None:
        """Append a message; a topic is announced at its first message and has one type.

        `message` is an instance of `type(msgtype)`, e.g. from one of the builders below;
        `bag_time_ns` is when a recorder would have received it, which is not the header's stamp.
        """
        self.type(msgtype)
        connection = self._connections.get(topic)
        if connection is None:
            connection = self._writer.add_connection(topic, msgtype, typestore=self._typestore)
            self._connections[topic] = connection
        elif connection.msgtype != msgtype:
            raise InputError(f'topic {topic} of the bag {self.path} carries {connection.msgtype}, '
                             f'it cannot carry {msgtype} as well')
        self._writer.write(
            connection, bag_time_ns, self._typestore.serialize_cdr(message, msgtype))

    def announce(self, topic: Topic, origin: TopicOrigin) -> None:
        """Announce a topic whose messages are copied, or written anew at the same quality."""
        known = topic.msgtype in self._typestore.fielddefs
        definition = {} if known and not origin.definition else {
            'msgdef': origin.definition, 'rihs01': origin.type_hash or _UNKNOWN_HASH}
        connection = self._writer.add_connection(
            topic.name, topic.msgtype, typestore=self._typestore,
            serialization_format=origin.serialization, offered_qos_profiles=origin.qos,
            **definition)
        self._copied[topic.name, topic.msgtype] = connection
        self._connections.setdefault(topic.name, connection)

    def copy(self, raw: RawMessage) -> None:
        """Append a message of an announced topic as it is."""
        self._writer.write(self._copied[raw.topic, raw.msgtype], raw.bag_time_ns, raw.data)

    # -- messages from plain data ------------------------------------------------------------

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """std_msgs/Header of an instant [ns]."""
        stamp = self.type('builtin_interfaces/msg/Time')(*divmod(int(stamp_ns), NANOSECONDS))
        return self.type('std_msgs/msg/Header')(stamp=stamp, frame_id=frame_id)

    def camera_info(self, stamp_ns: int, frame_id: str, camera: RollingShutterCamera) -> Any:
        """sensor_msgs/CameraInfo of a camera whose whole sensor is published.

        The message has no field for the read-out: that is a parameter of whoever reads it.
        """
        distortion = camera.distortion
        if camera.distortion_model == 'plumb_bob' and not distortion:
            distortion = (0.0,) * 5   # as ROS writes this model without distortion
        projection = np.zeros((3, 4))
        projection[:, :3] = camera.camera_matrix
        region = self.type('sensor_msgs/msg/RegionOfInterest')(
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self.type('sensor_msgs/msg/CameraInfo')(
            header=self.header(stamp_ns, frame_id), height=camera.height, width=camera.width,
            distortion_model=camera.distortion_model, d=np.array(distortion, dtype=np.float64),
            k=camera.camera_matrix.ravel(), r=np.eye(3).ravel(), p=projection.ravel(),
            binning_x=0, binning_y=0, roi=region)

    def image(self, stamp_ns: int, frame_id: str, pixels: NDArray[np.uint8]) -> Any:
        """sensor_msgs/Image, mono8, of (H, W) pixels."""
        if pixels.dtype != np.uint8 or pixels.ndim != 2:
            raise InputError('an image of encoding mono8 needs 1 channel of uint8, got '
                             f'{pixels.dtype} of shape {pixels.shape}')
        height, width = pixels.shape
        return self.type('sensor_msgs/msg/Image')(
            header=self.header(stamp_ns, frame_id), height=height, width=width, encoding='mono8',
            is_bigendian=0, step=width, data=np.ascontiguousarray(pixels).reshape(-1))

    def compressed_image(self, stamp_ns: int, frame_id: str, data: bytes,
                         image_format: str = 'mono8; jpeg compressed ') -> Any:
        """sensor_msgs/CompressedImage; `image_format` as image_transport writes it."""
        return self.type('sensor_msgs/msg/CompressedImage')(
            header=self.header(stamp_ns, frame_id), format=image_format,
            data=np.frombuffer(data, dtype=np.uint8))

    def imu(self, stamp_ns: int, frame_id: str, angular_velocity: ArrayLike | None,
            linear_acceleration: ArrayLike | None, *, angular_velocity_variance: float = 0.0,
            linear_acceleration_variance: float = 0.0) -> Any:
        """sensor_msgs/Imu without orientation (REP-145).

        Rates (3,) [rad/s] and specific force (3,) [m/s^2], +g up at rest, in the IMU frame; None
        for a sensor that is absent: its covariance block then starts with -1. A variance, per
        axis, of 0 is unknown.
        """
        zero = (0.0, 0.0, 0.0)
        return self.type('sensor_msgs/msg/Imu')(
            header=self.header(stamp_ns, frame_id),
            orientation=self._geometry('Quaternion', (0.0, 0.0, 0.0, 1.0)),
            orientation_covariance=_covariance(None, 0.0),
            angular_velocity=self._geometry(
                'Vector3', zero if angular_velocity is None else angular_velocity),
            angular_velocity_covariance=_covariance(angular_velocity, angular_velocity_variance),
            linear_acceleration=self._geometry(
                'Vector3', zero if linear_acceleration is None else linear_acceleration),
            linear_acceleration_covariance=_covariance(
                linear_acceleration, linear_acceleration_variance))

    def pose(self, stamp_ns: int, frame_id: str, position: ArrayLike,
             quat_xyzw: ArrayLike) -> Any:
        """geometry_msgs/PoseStamped of a position (3,) [m] and a unit quaternion (4,)."""
        pose = self.type('geometry_msgs/msg/Pose')(
            position=self._geometry('Point', position),
            orientation=self._geometry('Quaternion', quat_xyzw))
        return self.type('geometry_msgs/msg/PoseStamped')(
            header=self.header(stamp_ns, frame_id), pose=pose)

    def _geometry(self, name: str, values: ArrayLike) -> Any:
        """geometry_msgs message with the fields x, y, z and, of a quaternion, w."""
        return self.type(f'geometry_msgs/msg/{name}')(*map(float, np.asarray(values)))


def refuse_existing(*paths: Path) -> None:
    """Raise an InputError where one of the files or folders to be written exists."""
    for path in paths:
        if path.exists():
            raise InputError(f'{path} exists already: remove it or choose another path')


def _covariance(value: ArrayLike | None, variance: float) -> NDArray[np.float64]:
    # REP-145: a first element of -1 says that there is no such measurement.
    diagonal = [-1.0, 0.0, 0.0] if value is None else [variance] * 3
    return np.diag(diagonal).ravel()
