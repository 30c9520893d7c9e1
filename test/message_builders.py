"""Messages for tests, of rclpy's classes or of those of rosbags; and damage to them."""

from array import array
from collections.abc import Callable, Iterator, Sequence
import copy
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.typesys import get_typestore, Stores

from rs_relpose_ros.calibration.findings import Code, Finding, FindingState, Why
from rs_relpose_ros.messages import outgoing
from rs_relpose_ros.pipeline.pair import PairResult

Types = Callable[[str], Any]
TYPESTORE = get_typestore(Stores.ROS2_JAZZY)


def rosbags_types(name: str) -> Any:
    return TYPESTORE.types[name]


def rclpy_types(name: str) -> Any:
    from rs_relpose_ros.nodes.inputs import message_class

    return message_class(name)


both_types = pytest.mark.parametrize(
    'types', [rclpy_types, rosbags_types], ids=['rclpy', 'rosbags']
)


def serialized(message: Any) -> bytes:
    """CDR of a message of either kind."""
    if hasattr(message, '__msgtype__'):
        return bytes(TYPESTORE.serialize_cdr(message, message.__msgtype__))
    from rclpy.serialization import serialize_message

    return bytes(serialize_message(message))


def pair_messages(pair: PairResult, types: Types, reference_frame: str = '') -> dict[str, Any]:
    parts = outgoing.pair_parts(pair, types, reference_frame)
    return {topic: make() for topic, make in parts.items()}


def byte_data(types: Types, data: bytes) -> Any:
    if types is rosbags_types:
        return np.frombuffer(data, dtype=np.uint8)
    out = array('B')
    out.frombytes(data)
    return out


def header(types: Types, stamp_ns: int, frame_id: str = 'camera') -> Any:
    stamp = types('builtin_interfaces/msg/Time')(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return types('std_msgs/msg/Header')(stamp=stamp, frame_id=frame_id)


def image(
    types: Types,
    width: int,
    height: int,
    encoding: str,
    data: bytes,
    *,
    step: int,
    is_bigendian: int = 0,
    stamp_ns: int = 0,
) -> Any:
    return types('sensor_msgs/msg/Image')(
        header=header(types, stamp_ns),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=is_bigendian,
        step=step,
        data=byte_data(types, data),
    )


def gray_image(types: Types, pixels: np.ndarray, stamp_ns: int = 0) -> Any:
    height, width = pixels.shape
    return image(types, width, height, 'mono8', pixels.tobytes(), step=width, stamp_ns=stamp_ns)


def compressed(types: Types, data: bytes, stamp_ns: int = 0) -> Any:
    return types('sensor_msgs/msg/CompressedImage')(
        header=header(types, stamp_ns), format='jpeg', data=byte_data(types, data)
    )


def jpeg(pixels: np.ndarray) -> bytes:
    return cv2.imencode('.jpg', pixels)[1].tobytes()


def camera_info(
    types: Types,
    *,
    width: int = 640,
    height: int = 480,
    k: tuple[float, ...] = (450.0, 0.0, 319.5, 0.0, 451.0, 239.5, 0.0, 0.0, 1.0),
    model: str = 'plumb_bob',
    d: tuple[float, ...] = (0.0,) * 5,
    binning: tuple[int, int] = (0, 0),
    roi: tuple[int, int, int, int] = (0, 0, 0, 0),
    stamp_ns: int = 0,
) -> Any:
    """`roi`: x_offset, y_offset, width, height."""
    region = types('sensor_msgs/msg/RegionOfInterest')(
        x_offset=roi[0], y_offset=roi[1], height=roi[3], width=roi[2], do_rectify=False
    )
    return types('sensor_msgs/msg/CameraInfo')(
        header=header(types, stamp_ns),
        height=height,
        width=width,
        distortion_model=model,
        d=np.array(d, dtype=np.float64),
        k=np.array(k),
        r=np.eye(3).ravel(),
        p=np.eye(3, 4).ravel(),
        binning_x=binning[0],
        binning_y=binning[1],
        roi=region,
    )


def imu(
    types: Types,
    stamp_ns: int,
    gyro: tuple[float, float, float] = (0.1, 0.2, 0.3),
    accelerometer: tuple[float, float, float] = (0.0, 0.0, 9.8),
    *,
    gyro_covariance: float = 0.0,
    accelerometer_covariance: float = 0.0,
) -> Any:
    """The covariances are the first elements of their blocks; -1 is "no such sensor"."""

    def vector(values: tuple[float, float, float]) -> Any:
        return types('geometry_msgs/msg/Vector3')(x=values[0], y=values[1], z=values[2])

    def block(first: float) -> np.ndarray:
        return np.diag([first, 0.0, 0.0]).ravel()

    return types('sensor_msgs/msg/Imu')(
        header=header(types, stamp_ns, 'imu'),
        orientation=types('geometry_msgs/msg/Quaternion')(x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=block(-1.0),
        angular_velocity=vector(gyro),
        angular_velocity_covariance=block(gyro_covariance),
        linear_acceleration=vector(accelerometer),
        linear_acceleration_covariance=block(accelerometer_covariance),
    )


# --- damage to bytes and messages, described by numbers: an edit is place, way and value

# Each number of an edit is below this one; a place is a share of it.
WHOLE = 1 << 16
Edit = Sequence[int]

INTEGERS = (
    0,
    1,
    -1,
    2,
    3,
    7,
    0xFF,
    0x7FFF,
    0xFFFF,
    2**31 - 1,
    -(2**31),
    2**32 - 1,
    16384,
    16385,
)  # no field has more than 32 bits
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-320, 1e308, -1e308, float('nan'), float('inf'), float('-inf'))
STRINGS = (
    '',
    '\0',
    'mono8',
    'MONO8',
    'bgr8',
    'mono16',
    'plumb_bob',
    'fisheye',
    'x' * 100_000,
    'äöü\u202e',
    '%s%n{0}',
    '../../etc/passwd',
)


def _at(place: int, length: int) -> int:
    """An index up to `length`; small numbers, which Hypothesis prefers, are spread as well."""
    return place * 40_503 % WHOLE * length // WHOLE


def damaged(data: bytes, edits: Sequence[Edit]) -> bytes:
    """`data` with places flipped, overwritten, cut out or repeated."""
    out = bytearray(data)
    for place, way, value in edits:
        at = _at(place, len(out) + 1)
        kind = way % 6
        size = 1 + way % 63
        if kind == 0 and at < len(out):
            out[at] ^= 1 << value % 8
        elif kind == 1:
            out[at : at + 1 + way % 8] = value.to_bytes(2, 'little') * (1 + way % 4)
        elif kind == 2:
            width = 4 + 4 * (way % 2)
            number = INTEGERS[value % len(INTEGERS)] & (2 ** (8 * width) - 1)
            out[at : at + width] = number.to_bytes(width, 'little')
        elif kind == 3:
            del out[at : at + size]
        elif kind == 4:
            source = _at(value, len(out) + 1)
            out[at:at] = out[source : source + size]
        elif value % 3 == 0:
            del out[at:]
    return bytes(out)


def with_other_fields(message: Any, edits: Sequence[Edit]) -> Any:
    """A message some of whose fields have other values that their types allow."""
    message = copy.deepcopy(message)
    for place, way, value in edits:
        fields = list(_fields(message))
        owner, name = fields[_at(place, len(fields))]
        old = getattr(owner, name)
        if isinstance(old, bool):
            new: Any = not old
        elif isinstance(old, int):
            new = INTEGERS[value % len(INTEGERS)]
        elif isinstance(old, float):
            new = FLOATS[value % len(FLOATS)]
        elif isinstance(old, str):
            new = STRINGS[value % len(STRINGS)]
        else:
            fixed = name in ('k', 'r', 'p') or name.endswith('covariance')
            new = _other_array(old, 0 if fixed else way % 4, value)
        setattr(owner, name, new)
    return message


def _fields(message: Any) -> Iterator[tuple[Any, str]]:
    for name, value in vars(message).items():
        if hasattr(value, '__msgtype__'):
            yield from _fields(value)
        elif name != '__msgtype__':
            yield message, name


def _other_array(values: np.ndarray, way: int, value: int) -> np.ndarray:
    """Other values, or another length."""
    place = _at(value, len(values))
    if way == 0 and len(values):
        values = values.copy()
        if values.dtype == np.uint8:
            values[place : place + 8] = value % 256
        else:
            values[place] = FLOATS[value % len(FLOATS)]
        return values
    if way == 1:
        return values[:place]
    if way == 2:
        return np.concatenate([values, values])
    return np.zeros((0, 1, 9, 65, 1000)[value % 5], dtype=values.dtype)


# Its text holds ';' and quotes.
WRONG_AXES = Finding(
    Code.AXES,
    FindingState.WRONG,
    Why.GROSS,
    (0.0,),
    (90.0,),
    unit='deg',
    settings={'quat_cam_imu_xyzw': [0.5, -0.5, 0.5, -0.5]},
)
WRONG_AXES_TEXT = (
    'rotation axes of the images are 90 deg from those of the gyro by quat_cam_imu_xyzw; about '
    '[0.5, -0.5, 0.5, -0.5] fits: refine it with "rs_relpose calibrate" (a static transform with '
    'parent imu holds the inverse)'
)
