"""Messages for tests, of rclpy's classes or of those of rosbags."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from rosbags.typesys import get_typestore, Stores

Types = Callable[[str], Any]
TYPESTORE = get_typestore(Stores.ROS2_JAZZY)


def rosbags_types(name: str) -> Any:
    return TYPESTORE.types[name]


def rclpy_types(name: str) -> Any:
    from rs_relpose_ros.node.message_types import message_class
    return message_class(name)


def byte_data(types: Types, data: bytes) -> Any:
    if types is rosbags_types:
        return np.frombuffer(data, dtype=np.uint8)
    out = array('B')
    out.frombytes(data)
    return out


def header(types: Types, stamp_ns: int, frame_id: str = 'camera') -> Any:
    stamp = types('builtin_interfaces/msg/Time')(
        sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return types('std_msgs/msg/Header')(stamp=stamp, frame_id=frame_id)


def image(types: Types, width: int, height: int, encoding: str, data: bytes, *, step: int,
          is_bigendian: int = 0, stamp_ns: int = 0) -> Any:
    return types('sensor_msgs/msg/Image')(
        header=header(types, stamp_ns), height=height, width=width, encoding=encoding,
        is_bigendian=is_bigendian, step=step, data=byte_data(types, data))


def gray_image(types: Types, pixels: np.ndarray, stamp_ns: int = 0) -> Any:
    height, width = pixels.shape
    return image(types, width, height, 'mono8', pixels.tobytes(), step=width, stamp_ns=stamp_ns)


def compressed(types: Types, data: bytes, stamp_ns: int = 0) -> Any:
    return types('sensor_msgs/msg/CompressedImage')(
        header=header(types, stamp_ns), format='jpeg', data=byte_data(types, data))


def jpeg(pixels: np.ndarray) -> bytes:
    return cv2.imencode('.jpg', pixels)[1].tobytes()


def camera_info(types: Types, *, width: int = 640, height: int = 480,
                k: tuple[float, ...] = (450.0, 0.0, 319.5, 0.0, 451.0, 239.5, 0.0, 0.0, 1.0),
                model: str = 'plumb_bob', d: tuple[float, ...] = (0.0,) * 5,
                binning: tuple[int, int] = (0, 0), roi: tuple[int, int, int, int] = (0, 0, 0, 0),
                stamp_ns: int = 0) -> Any:
    """`roi`: x_offset, y_offset, width, height."""
    region = types('sensor_msgs/msg/RegionOfInterest')(
        x_offset=roi[0], y_offset=roi[1], height=roi[3], width=roi[2], do_rectify=False)
    return types('sensor_msgs/msg/CameraInfo')(
        header=header(types, stamp_ns), height=height, width=width, distortion_model=model,
        d=np.array(d, dtype=np.float64), k=np.array(k), r=np.eye(3).ravel(),
        p=np.eye(3, 4).ravel(), binning_x=binning[0], binning_y=binning[1], roi=region)


def imu(types: Types, stamp_ns: int, gyro: tuple[float, float, float] = (0.1, 0.2, 0.3),
        accelerometer: tuple[float, float, float] = (0.0, 0.0, 9.8), *,
        gyro_covariance: float = 0.0, accelerometer_covariance: float = 0.0) -> Any:
    """The covariances are the first elements of their blocks; -1 is "no such sensor"."""
    def vector(values: tuple[float, float, float]) -> Any:
        return types('geometry_msgs/msg/Vector3')(x=values[0], y=values[1], z=values[2])

    def block(first: float) -> np.ndarray:
        return np.diag([first, 0.0, 0.0]).ravel()

    return types('sensor_msgs/msg/Imu')(
        header=header(types, stamp_ns, 'imu'),
        orientation=types('geometry_msgs/msg/Quaternion')(x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=block(-1.0), angular_velocity=vector(gyro),
        angular_velocity_covariance=block(gyro_covariance),
        linear_acceleration=vector(accelerometer),
        linear_acceleration_covariance=block(accelerometer_covariance))
