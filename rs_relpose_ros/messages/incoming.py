"""Image, CameraInfo, IMU and pose messages to data.

Messages are read by field name only, so those of rclpy and of rosbags (ROS 2 and ROS 1) do alike.
Nothing of a message is trusted: sizes are checked before memory is taken, and whatever cannot be
used raises `InputError` with one sentence.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any, NamedTuple

import numpy as np

from rs_relpose_ros.config.intrinsics import pinhole_of_matrix
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.images.encoded import (
    check_image_size,
    CompressedImage,
    EncodedImage,
    RawImage,
)
from rs_relpose_ros.imu.samples import ImuSample, Orientation

# Largest values of an IMU: far above any sensor, far below an overflow of the filters.
MAX_ANGULAR_VELOCITY = 1e3   # rad/s
MAX_LINEAR_ACCELERATION = 1e4   # m/s^2


@dataclass(frozen=True, slots=True, eq=False)
class PublishedImage:
    """An image message: its header and the image, not decoded yet."""

    stamp_ns: int
    frame_id: str
    image: EncodedImage


class TruePose(NamedTuple):
    """Pose of the camera in the world: position [m], rotation as quaternion."""

    stamp_ns: int
    position: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float]


def stamp_ns(header: Any) -> int:
    """Stamp [ns] of a std_msgs/Header."""
    return time_ns(header.stamp)


def time_ns(stamp: Any) -> int:
    """Instant [ns] of a builtin_interfaces/Time."""
    seconds, nanoseconds = int(stamp.sec), int(stamp.nanosec)
    if seconds < 0 or not 0 <= nanoseconds < NANOSECONDS:
        raise InputError(f'stamp is out of range: {seconds} s and {nanoseconds} ns')
    return seconds * NANOSECONDS + nanoseconds


def image_from_message(msg: Any) -> PublishedImage:
    """Image of a sensor_msgs/Image or CompressedImage; its `data` is a view of the message's.

    Only the stamp is checked: what else may be wrong is found when the image is decoded.
    """
    data = np.frombuffer(msg.data, dtype=np.uint8)
    image: EncodedImage
    if hasattr(msg, 'format'):
        image = CompressedImage(data, str(msg.format))
    else:
        image = RawImage(data, str(msg.encoding), int(msg.width), int(msg.height), int(msg.step),
                         bool(msg.is_bigendian))
    return PublishedImage(stamp_ns(msg.header), str(msg.header.frame_id), image)


def pose_from_message(msg: Any) -> TruePose:
    """Pose of a geometry_msgs/PoseStamped."""
    position, q = msg.pose.position, msg.pose.orientation
    return TruePose(stamp_ns(msg.header), (position.x, position.y, position.z),
                    (q.x, q.y, q.z, q.w))


def intrinsics_from_info(msg: Any) -> Intrinsics:
    """Intrinsics of a sensor_msgs/CameraInfo, region of interest and binning honoured.

    MissingInputError where it has none.
    """
    k = [float(value) for value in info_field(msg, 'k')]
    if len(k) == 9 and k[0] == 0.0:
        raise MissingInputError(
            'the camera is uncalibrated (k[0] of its CameraInfo is 0): calibrate it and let its '
            'driver publish the result, or give camera_matrix')
    pinhole = pinhole_of_matrix('k of CameraInfo', k)
    width, height = int(msg.width), int(msg.height)
    check_image_size(width, height)
    coefficients = info_field(msg, 'd')
    if len(coefficients) > 64:
        raise InputError(f'd of CameraInfo has {len(coefficients)} coefficients')
    # 0 in these fields means "not set": no binning, and the full sensor.
    binning_x, binning_y = max(int(msg.binning_x), 1), max(int(msg.binning_y), 1)
    roi = msg.roi
    roi_width, roi_height = int(roi.width) or width, int(roi.height) or height
    return Intrinsics(
        width=width, height=height, **pinhole._asdict(),
        distortion_model=str(msg.distortion_model)[:40],
        distortion=tuple(float(value) for value in coefficients),
        x_offset=int(roi.x_offset), y_offset=int(roi.y_offset),
        binning_x=binning_x, binning_y=binning_y,
        image_width=roi_width // binning_x, image_height=roi_height // binning_y)


def info_field(msg: Any, name: str) -> Any:
    """A field of a CameraInfo that ROS 1 writes in capitals."""
    return getattr(msg, name) if hasattr(msg, name) else getattr(msg, name.upper())


def imu_sample_from_message(msg: Any, *, with_gyro: bool = True) -> ImuSample:
    """Gyro and accelerometer of a sensor_msgs/Imu, each None where the message has no such sensor.

    By REP-145 a covariance whose first element is -1 means that the sensor does not exist; drivers
    that publish the two sensors apart leave the other vector zero, and an accelerometer that reads
    exactly zero in all axes is taken for such. Not `with_gyro`: the topic is the accelerometer's.
    """
    angular_velocity = linear_acceleration = None
    if with_gyro and msg.angular_velocity_covariance[0] != -1.0:
        angular_velocity = _vector('angular_velocity', msg.angular_velocity, MAX_ANGULAR_VELOCITY)
    if msg.linear_acceleration_covariance[0] != -1.0:
        linear_acceleration = _vector('linear_acceleration', msg.linear_acceleration,
                                      MAX_LINEAR_ACCELERATION)
        if linear_acceleration == (0.0, 0.0, 0.0):
            linear_acceleration = None
    if angular_velocity is None and linear_acceleration is None:
        raise InputError('an IMU message has neither gyro nor accelerometer: both are marked as '
                         'absent (covariance -1) or zero')
    return ImuSample(stamp_ns(msg.header), angular_velocity, linear_acceleration,
                     None if angular_velocity is None else _orientation(msg))


def _orientation(msg: Any) -> Orientation | None:
    """Down in the IMU frame; None unless the covariance block says how good the orientation is.

    All zeros, "unknown" by REP-145, is what drivers leave that compute none.
    """
    variance = max(float(msg.orientation_covariance[0]), float(msg.orientation_covariance[4]))
    q = msg.orientation
    x, y, z, w = float(q.x), float(q.y), float(q.z), float(q.w)
    norm2 = x * x + y * y + z * z + w * w
    if not (float(msg.orientation_covariance[0]) > 0.0 and 0.0 < variance < math.pi**2
            and abs(norm2 - 1.0) < 0.02):
        return None
    # Minus the third row of R(q), world from IMU.
    down = (-2.0 * (x * z - w * y) / norm2, -2.0 * (y * z + w * x) / norm2,
            -(w * w - x * x - y * y + z * z) / norm2)
    return Orientation(down, math.sqrt(variance))


def _vector(name: str, vector: Any, largest: float) -> tuple[float, float, float]:
    values = (float(vector.x), float(vector.y), float(vector.z))
    if not all(map(math.isfinite, values)):
        raise InputError(f'{name} of an IMU message must be finite, got {list(values)}')
    if max(map(abs, values)) > largest:
        raise InputError(f'{name} of an IMU message must be at most {largest:g}, '
                         f'got {list(values)}: is it in rad/s and m/s^2?')
    return values
