"""Camera, calibration and IMU messages to data.

Messages are read by field name only, so those of rclpy and of rosbags (ROS 2 and ROS 1) do alike.
Nothing of a message is trusted: sizes are checked before memory is taken, and whatever cannot be
used raises `InputError` with one sentence.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.imu.samples import ImuSample, Orientation
from rs_relpose_ros.messages.image_headers import encoded_image_size

Gray = NDArray[np.uint8]

# Longest side of an image [px]: far above any camera, far below what exhausts memory.
MAX_IMAGE_SIDE = 16384
MAX_IMAGE_PIXELS = 64 * 1024 * 1024

# Largest values of an IMU, far above any sensor, far below what filters overflow at.
MAX_ANGULAR_VELOCITY = 1e3   # rad/s
MAX_LINEAR_ACCELERATION = 1e4   # m/s^2

# Encoding -> (channels, conversion of OpenCV). The order of a '8UC3' is not told; as cv_bridge.
_COLOR = {
    'bgr8': (3, cv2.COLOR_BGR2GRAY),
    '8UC3': (3, cv2.COLOR_BGR2GRAY),
    'rgb8': (3, cv2.COLOR_RGB2GRAY),
    'bgra8': (4, cv2.COLOR_BGRA2GRAY),
    'rgba8': (4, cv2.COLOR_RGBA2GRAY),
}
# OpenCV names a Bayer pattern by the second row from its second pixel on, ROS from the corner.
_BAYER = {
    'bayer_rggb': cv2.COLOR_BayerBG2GRAY,
    'bayer_bggr': cv2.COLOR_BayerRG2GRAY,
    'bayer_gbrg': cv2.COLOR_BayerGR2GRAY,
    'bayer_grbg': cv2.COLOR_BayerGB2GRAY,
}
# Packed YUV 4:2:2 -> which of two successive bytes is the luma.
_PACKED_YUV = {'yuv422_yuy2': 0, 'yuyv': 0, 'yuv422': 1, 'uyvy': 1}
# Planar YUV begins with the whole luma plane.
_PLANAR_YUV = ('nv21', 'nv12', 'nv24')

ENCODINGS = ('mono8', '8UC1', 'mono16', *_COLOR, *(f'{name}8' for name in _BAYER),
             *(f'{name}16' for name in _BAYER), *_PACKED_YUV, *_PLANAR_YUV)


def stamp_ns(header: Any) -> int:
    """Stamp [ns] of a std_msgs/Header."""
    return time_ns(header.stamp)


def time_ns(stamp: Any) -> int:
    """Instant [ns] of a builtin_interfaces/Time."""
    seconds, nanoseconds = int(stamp.sec), int(stamp.nanosec)
    if seconds < 0 or not 0 <= nanoseconds < NANOSECONDS:
        raise InputError(f'stamp is out of range: {seconds} s and {nanoseconds} ns')
    return seconds * NANOSECONDS + nanoseconds


# -- images ----------------------------------------------------------------------------------


def image_from_message(msg: Any) -> Gray:
    """Gray image (H, W) of a sensor_msgs/Image.

    A mono8 image without padding is a view of the message's memory.

    Raises
    ------
    InputError
        Unknown encoding, zero or absurd size, or less data than its size needs.
    """
    height, width, step = int(msg.height), int(msg.width), int(msg.step)
    encoding = str(msg.encoding)
    _check_image_size(width, height)
    if encoding in ('mono8', '8UC1'):
        return np.ascontiguousarray(_rows(msg, height, width, step))
    if encoding == 'mono16':
        return _to_8_bit(_rows16(msg, height, width, step))
    if encoding in _COLOR:
        channels, conversion = _COLOR[encoding]
        rows = _rows(msg, height, width * channels, step)
        pixels = np.ascontiguousarray(rows).reshape(height, width, channels)
        return np.asarray(cv2.cvtColor(pixels, conversion), dtype=np.uint8)
    if encoding in _PACKED_YUV:
        return np.ascontiguousarray(
            _rows(msg, height, 2 * width, step)[:, _PACKED_YUV[encoding]::2])
    if encoding in _PLANAR_YUV:
        return np.ascontiguousarray(_rows(msg, height, width, step))
    pattern = encoding.removesuffix('16').removesuffix('8')
    if encoding in ENCODINGS and pattern in _BAYER:
        if height < 3 or width < 3:
            raise InputError(f'a Bayer image must be at least 3x3, got {width}x{height}')
        if encoding.endswith('16'):
            mosaic = _to_8_bit(_rows16(msg, height, width, step))
        else:
            mosaic = np.ascontiguousarray(_rows(msg, height, width, step))
        return np.asarray(cv2.cvtColor(mosaic, _BAYER[pattern]), dtype=np.uint8)
    raise InputError(f'image encoding {encoding[:40]!r} is not known; '
                     f'publish one of {", ".join(ENCODINGS)}')


def image_from_compressed(msg: Any) -> Gray:
    """Gray image (H, W) of a sensor_msgs/CompressedImage (JPEG or PNG).

    Raises
    ------
    InputError
        Neither JPEG nor PNG, truncated or corrupt, or of zero or absurd size.
    """
    data = _bytes(msg.data)
    width, height = encoded_image_size(data)
    _check_image_size(width, height)
    # A rotated image would have its rows in another order than they were read.
    try:
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    if image is None or image.shape != (height, width):
        raise InputError(f'compressed image of {len(data)} bytes cannot be decoded: it is corrupt')
    return np.asarray(image, dtype=np.uint8)


def _check_image_size(width: int, height: int) -> None:
    if not (0 < width <= MAX_IMAGE_SIDE and 0 < height <= MAX_IMAGE_SIDE
            and width * height <= MAX_IMAGE_PIXELS):
        raise InputError(f'image size {width}x{height} is not usable: sides must be 1 to '
                         f'{MAX_IMAGE_SIDE} px and the area at most {MAX_IMAGE_PIXELS} px')


def _bytes(data: Any) -> NDArray[np.uint8]:
    return np.frombuffer(data, dtype=np.uint8)


def _rows(msg: Any, height: int, row_bytes: int, step: int) -> NDArray[np.uint8]:
    """View (height, row_bytes) of an image message's data, padding left out."""
    if step < row_bytes:
        raise InputError(f'image step is {step} bytes, but a row of {msg.width} px in '
                         f'{msg.encoding} has {row_bytes}')
    data = _bytes(msg.data)
    needed = step * (height - 1) + row_bytes
    if len(data) < needed:
        raise InputError(f'image has {len(data)} bytes of data, but {msg.width}x{msg.height} in '
                         f'{msg.encoding} with step {step} needs {needed}')
    return np.lib.stride_tricks.as_strided(
        data, shape=(height, row_bytes), strides=(step, 1), writeable=False)


def _rows16(msg: Any, height: int, width: int, step: int) -> NDArray[np.uint16]:
    order = '>u2' if msg.is_bigendian else '<u2'
    return np.ascontiguousarray(_rows(msg, height, 2 * width, step)).view(order)


def _to_8_bit(image: NDArray[np.uint16]) -> Gray:
    return (image >> 8).astype(np.uint8)


# -- calibration -----------------------------------------------------------------------------


def intrinsics_from_info(msg: Any) -> Intrinsics:
    """Calibration of a sensor_msgs/CameraInfo, region of interest and binning honoured.

    Raises
    ------
    MissingInputError
        The camera is not calibrated (``k[0] == 0``).
    InputError
        Unknown distortion model or number of coefficients, or figures that contradict each other.
    """
    k = [float(value) for value in _field(msg, 'k')]
    if len(k) != 9:
        raise InputError(f'k of CameraInfo must have 9 elements, got {len(k)}')
    if k[0] == 0.0:
        raise MissingInputError(
            'the camera is uncalibrated (k[0] of its CameraInfo is 0): calibrate it and let its '
            'driver publish the result')
    if not all(math.isfinite(value) for value in k):
        raise InputError(f'k of CameraInfo must be finite, got {k}')
    if any(k[i] != 0.0 for i in (1, 3, 6, 7)) or k[8] != 1.0:
        raise InputError(f'k of CameraInfo must be [fx 0 cx 0 fy cy 0 0 1], got {k}')
    width, height = int(msg.width), int(msg.height)
    _check_image_size(width, height)
    coefficients = _field(msg, 'd')
    if len(coefficients) > 64:
        raise InputError(f'd of CameraInfo has {len(coefficients)} coefficients')
    # 0 means "not told" in both fields: no binning, and the full sensor.
    binning_x, binning_y = max(int(msg.binning_x), 1), max(int(msg.binning_y), 1)
    roi = msg.roi
    roi_width, roi_height = int(roi.width) or width, int(roi.height) or height
    return Intrinsics(
        width=width, height=height, fx=k[0], fy=k[4], cx=k[2], cy=k[5],
        distortion_model=str(msg.distortion_model)[:40],
        distortion=tuple(float(value) for value in coefficients),
        x_offset=int(roi.x_offset), y_offset=int(roi.y_offset),
        binning_x=binning_x, binning_y=binning_y,
        image_width=roi_width // binning_x, image_height=roi_height // binning_y)


def _field(msg: Any, name: str) -> Any:
    """A field that ROS 1 writes in capitals."""
    return getattr(msg, name) if hasattr(msg, name) else getattr(msg, name.upper())


# -- IMU -------------------------------------------------------------------------------------


def imu_sample_from_message(msg: Any) -> ImuSample:
    """Gyro and accelerometer of a sensor_msgs/Imu, each None where the message has no such sensor.

    By REP-145 a covariance whose first element is -1 means that the sensor does not exist; drivers
    that publish the two sensors apart leave the other vector zero, and an accelerometer that reads
    exactly zero in all axes is taken for such.

    Raises
    ------
    InputError
        NaN, infinite or beyond any sensor, or neither of the two sensors.
    """
    return _imu_sample(msg, gyro=_has_sensor(msg.angular_velocity_covariance))


def accelerometer_sample_from_message(msg: Any) -> ImuSample:
    """The accelerometer alone of a sensor_msgs/Imu (drivers with a topic of its own for it)."""
    return _imu_sample(msg, gyro=False)


def _imu_sample(msg: Any, gyro: bool) -> ImuSample:
    angular_velocity = (_vector('angular_velocity', msg.angular_velocity, MAX_ANGULAR_VELOCITY)
                        if gyro else None)
    linear_acceleration = None
    if _has_sensor(msg.linear_acceleration_covariance):
        linear_acceleration = _vector('linear_acceleration', msg.linear_acceleration,
                                      MAX_LINEAR_ACCELERATION)
        if linear_acceleration == (0.0, 0.0, 0.0):
            linear_acceleration = None
    if angular_velocity is None and linear_acceleration is None:
        raise InputError('an IMU message has neither gyro nor accelerometer: both are marked as '
                         'absent (covariance -1) or zero')
    return ImuSample(stamp_ns(msg.header), angular_velocity, linear_acceleration,
                     _orientation(msg) if gyro else None)


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


def _has_sensor(covariance: Any) -> bool:
    return bool(covariance[0] != -1.0)


def _vector(name: str, vector: Any, largest: float) -> tuple[float, float, float]:
    values = (float(vector.x), float(vector.y), float(vector.z))
    if not all(map(math.isfinite, values)):
        raise InputError(f'{name} of an IMU message must be finite, got {list(values)}')
    if max(map(abs, values)) > largest:
        raise InputError(f'{name} of an IMU message must be at most {largest:g}, '
                         f'got {list(values)}: is it in rad/s and m/s^2?')
    return values
