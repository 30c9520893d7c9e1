"""Write rosbag2 directories (MCAP storage) with ROS 2 Jazzy's messages."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
import shutil
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import NANOSECONDS

# sensor_msgs/CameraInfo of plumb_bob holds five coefficients even where there is no distortion.
_PLUMB_BOB_COEFFICIENTS = 5

_IMAGE_CHANNELS = {'mono8': 1, 'bgr8': 3, 'rgb8': 3}


class BagWriter:
    """Writes one bag; use it as a context manager.

    The bag is whole when the block ends normally. When it ends with an exception the directory is
    removed again, so that no half bag is taken for a whole one.

    Parameters
    ----------
    path : path-like
        Directory to create; its parents are created as needed.

    Raises
    ------
    InputError
        The path exists already, or cannot be created.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        _refuse_existing(self.path)
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        self._writer = Writer(self.path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> BagWriter:
        # Asked again: the path may have come into being since.
        _refuse_existing(self.path)
        try:
            self._writer.open()
        except OSError as error:
            raise InputError(
                f'cannot create the bag {self.path}: {error.strerror}; choose a writable path'
            ) from error
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        if kind is None:
            try:
                self._writer.close()
                return
            except BaseException:
                self._discard()
                raise
        self._discard()

    def _discard(self) -> None:
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
        """Append a message; a topic is announced at its first message.

        Parameters
        ----------
        topic : str
            Absolute topic name.
        msgtype : str
            Type name with ``/msg/``; one type per topic.
        message : message
            Instance of `type(msgtype)`, e.g. from one of the builders below.
        bag_time_ns : int
            When a recorder would have received it [ns]; the header's stamp is another matter.
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

    # -- messages from plain data ------------------------------------------------------------

    def time(self, stamp_ns: int) -> Any:
        """builtin_interfaces/Time of an instant [ns]."""
        seconds, nanoseconds = divmod(int(stamp_ns), NANOSECONDS)
        return self.type('builtin_interfaces/msg/Time')(sec=seconds, nanosec=nanoseconds)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """std_msgs/Header."""
        return self.type('std_msgs/msg/Header')(stamp=self.time(stamp_ns), frame_id=frame_id)

    def camera_info(self, stamp_ns: int, frame_id: str, camera: RollingShutterCamera) -> Any:
        """sensor_msgs/CameraInfo of a camera whose whole sensor is published.

        The message has no field for the read-out: that is a parameter of whoever reads it.
        """
        distortion = camera.distortion
        if camera.distortion_model == 'plumb_bob' and not distortion:
            distortion = (0.0,) * _PLUMB_BOB_COEFFICIENTS
        projection = np.zeros((3, 4))
        projection[:, :3] = camera.camera_matrix
        region = self.type('sensor_msgs/msg/RegionOfInterest')(
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self.type('sensor_msgs/msg/CameraInfo')(
            header=self.header(stamp_ns, frame_id), height=camera.height, width=camera.width,
            distortion_model=camera.distortion_model, d=np.array(distortion, dtype=np.float64),
            k=camera.camera_matrix.ravel(), r=np.eye(3).ravel(), p=projection.ravel(),
            binning_x=0, binning_y=0, roi=region)

    def image(self, stamp_ns: int, frame_id: str, pixels: NDArray[np.uint8],
              encoding: str = 'mono8') -> Any:
        """sensor_msgs/Image of (H, W) or (H, W, 3) pixels; `encoding` mono8, bgr8 or rgb8."""
        if encoding not in _IMAGE_CHANNELS:
            raise InputError(
                f'encoding must be one of {tuple(_IMAGE_CHANNELS)}, got {encoding!r}')
        channels = _IMAGE_CHANNELS[encoding]
        shape = pixels.shape if channels > 1 else (*pixels.shape, 1)
        if pixels.dtype != np.uint8 or len(shape) != 3 or shape[2] != channels:
            raise InputError(f'an image of encoding {encoding} needs {channels} channel(s) of '
                             f'uint8, got {pixels.dtype} of shape {pixels.shape}')
        return self.type('sensor_msgs/msg/Image')(
            header=self.header(stamp_ns, frame_id), height=shape[0], width=shape[1],
            encoding=encoding, is_bigendian=0, step=shape[1] * channels,
            data=np.ascontiguousarray(pixels).reshape(-1))

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

        Parameters
        ----------
        angular_velocity : (3,) array_like or None
            Rates [rad/s] in the IMU frame; None where there is no gyro: its covariance block
            then starts with -1.
        linear_acceleration : (3,) array_like or None
            Specific force [m/s^2] in the IMU frame, +g up at rest; None as above.
        angular_velocity_variance, linear_acceleration_variance : float
            Per axis; 0 is unknown.
        """
        quaternion = self.type('geometry_msgs/msg/Quaternion')(x=0.0, y=0.0, z=0.0, w=1.0)
        return self.type('sensor_msgs/msg/Imu')(
            header=self.header(stamp_ns, frame_id), orientation=quaternion,
            orientation_covariance=_covariance(None, 0.0),
            angular_velocity=self._vector3(angular_velocity),
            angular_velocity_covariance=_covariance(angular_velocity, angular_velocity_variance),
            linear_acceleration=self._vector3(linear_acceleration),
            linear_acceleration_covariance=_covariance(
                linear_acceleration, linear_acceleration_variance))

    def pose(self, stamp_ns: int, frame_id: str, position: ArrayLike,
             quat_xyzw: ArrayLike) -> Any:
        """geometry_msgs/PoseStamped of a position (3,) [m] and a unit quaternion (4,)."""
        x, y, z = (float(v) for v in np.asarray(position))
        point = self.type('geometry_msgs/msg/Point')(x=x, y=y, z=z)
        x, y, z, w = (float(v) for v in np.asarray(quat_xyzw))
        quaternion = self.type('geometry_msgs/msg/Quaternion')(x=x, y=y, z=z, w=w)
        pose = self.type('geometry_msgs/msg/Pose')(position=point, orientation=quaternion)
        return self.type('geometry_msgs/msg/PoseStamped')(
            header=self.header(stamp_ns, frame_id), pose=pose)

    def _vector3(self, value: ArrayLike | None) -> Any:
        x, y, z = (0.0, 0.0, 0.0) if value is None else (float(v) for v in np.asarray(value))
        return self.type('geometry_msgs/msg/Vector3')(x=x, y=y, z=z)


def _refuse_existing(path: Path) -> None:
    if path.exists():
        raise InputError(f'{path} exists already: remove it or choose another path')


def _covariance(value: ArrayLike | None, variance: float) -> NDArray[np.float64]:
    if value is None:
        # REP-145: a first element of -1 says that there is no such measurement.
        covariance = np.zeros(9)
        covariance[0] = -1.0
        return covariance
    return np.diag([variance] * 3).ravel()
