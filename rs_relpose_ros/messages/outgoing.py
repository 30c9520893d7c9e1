"""Results to messages, for the classes of rclpy and of rosbags alike.

`types` returns the class of a message type (``'geometry_msgs/msg/Pose'``). All messages of a pair
have the stamp of the current image.
"""

from array import array
import base64
from collections.abc import Callable, Mapping, Sequence
import math
import sys
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.calibration import findings_text
from rs_relpose_ros.calibration.findings import FindingState
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.covariance import ImageInformation
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import Intrinsics, RollingShutterCamera
from rs_relpose_ros.geometry.matches import Matches
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.messages.camera_info import info_field
from rs_relpose_ros.pipeline.pair import PAIR_METRICS, PairResult
from rs_relpose_ros.tracking.images import Pixels

MessageTypes = Callable[[str], Any]

# Columns of ~/matches, in the order of `inlier_records`. Floats come first:
# `point_cloud2.read_points_numpy` reads only fields of the type of the first. [derived: interface]
_FLOATS = (
    *('u1', 'v1', 'u2', 'v2'),
    *('tau1', 'tau2'),
    *('x1', 'y1', 'z1', 'x2', 'y2', 'z2'),
    *('x', 'y', 'z'),
    *('u1_gs', 'v1_gs', 'u2_gs', 'v2_gs'),
)
# Record of a match: the columns and the number of its track. [derived: interface]
MATCH_DTYPE = np.dtype([*((name, '<f4') for name in _FLOATS), ('id', '<u4')])
# Numbers of the types in sensor_msgs/PointField. [derived: FLOAT32 and UINT32 there]
_POINT_FIELDS = {'<f4': 7, '<u4': 6}
# Name, offset and type of each field, for sensor_msgs/PointField. [derived: the record]
MATCH_FIELDS = tuple(
    (name, int(offset), _POINT_FIELDS[dtype.str])
    for name, (dtype, offset, *_) in (MATCH_DTYPE.fields or {}).items()
)

# Size of a message [bytes] above which Fast DDS with its default transports loses it if it is sent
# best effort: it does not fit into a segment of shared memory. A smaller value would warn of
# images that arrive. [derived: the default segment of Fast DDS 2]
LARGE_MESSAGE = 512 * 1024
# Queue length of a pair topic. A shorter one loses pairs while a subscriber is busy; a longer one
# costs memory alone. [chosen: three seconds of pairs at 30 Hz; one second to a minute would do]
PAIR_HISTORY = 100
# Topics of a pair in the order of publication, and their types. [derived: interface]
PAIR_TOPICS = {
    'relative_pose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'reference': 'sensor_msgs/msg/TimeReference',
    'velocity': 'geometry_msgs/msg/TwistWithCovarianceStamped',
    'matches': 'sensor_msgs/msg/PointCloud2',
    'relative_rotation': 'sensor_msgs/msg/Imu',
    'pairs': 'diagnostic_msgs/msg/DiagnosticArray',
}
# Topics that are published only for pairs with a pose. [derived: interface]
POSE_TOPICS = ('relative_pose', 'reference', 'velocity', 'matches')
# Topic of the image on which `draw_pair` draws. [derived: interface]
DEBUG_IMAGE = 'debug_image'

# Quality of derotated JPEG images. Below it matching suffers, above it messages grow without use.
# [chosen: the default of image_transport, so that both kinds of publishers send alike]
_JPEG_QUALITY = 95
# Integer fields of sensor_msgs/RegionOfInterest. [derived: its definition]
_REGION = ('x_offset', 'y_offset', 'height', 'width')
# Least eigenvalue of a published covariance, relative to the largest one. The covariance of a
# direction has rank 5; with an eigenvalue that rounding made negative it could not be inverted or
# sampled. [chosen: above double rounding, 1e-15, and below each true variance, 1e-9]
_LEAST_EIGENVALUE = 1e-14


# -- ~/pairs: the keys of a status, for writing here and for reading in `published_pair` ---------


class PairValue(NamedTuple):
    """A key of the status of a pair; `field`: of `PublishedPair`, if it has the value."""

    key: str
    # Time: a timestamp [ns]; reals: any number of them. An unknown value is an empty text.
    # Packed: float32, little endian, in base64.
    kind: Literal['text', 'time', 'real', 'vector', 'reals', 'packed', 'findings']
    of: Callable[[PairResult], Any]
    field: str = ''

    def text(self, value: Any) -> str:
        """The value as in the message."""
        if self.kind == 'real':
            return number_text(value)
        if self.kind == 'findings':
            return findings_text.message_json(value)
        if value is None:
            return ''
        if self.kind == 'packed':
            return base64.b64encode(value.astype('<f4').tobytes()).decode()
        if self.kind in ('vector', 'reals'):
            return ' '.join(map(number_text, value))
        return str(value)

    def value(self, text: str) -> Any:
        """The value of a text; unknown numbers are NaN. InputError if it is malformed."""
        if self.kind == 'text':
            return text
        if self.kind == 'findings':
            return findings_text.read_message_json(text)
        if self.kind == 'time':
            # At most the digits of an int64.
            if not (text.isascii() and text.isdigit() and len(text) < 20):
                raise self._error('a timestamp [ns]', text[:40])
            return int(text)
        if self.kind == 'packed':
            return self._unpacked(text)
        try:
            values = [float(word) for word in text[:2000].split()]  # the longest list has 66
        except ValueError:
            values = []
        if text and not (values and all(map(math.isfinite, values))):
            raise self._error('finite', text[:60])
        if self.kind == 'real':
            return values[0] if values else math.nan
        if self.kind == 'vector':
            values = values or [math.nan] * 3
            if len(values) != 3:
                raise self._error('three numbers', text[:60])
        return np.array(values)

    def _error(self, legal: str, text: str) -> InputError:
        return InputError(f'{self.key} of ~/pairs must be {legal}, got {text!r}')

    def _unpacked(self, text: str) -> Array:
        try:
            data = base64.b64decode(text[:2000], validate=True)  # the longest array has 99
            values = np.frombuffer(data, dtype='<f4').astype(np.float64)
        except ValueError:
            values = np.full(1, np.nan)
        if not np.isfinite(values).all():
            raise self._error('finite float32 in base64', text[:60])
        return values


def _image_value(
    key: str,
    of: Callable[[ImageInformation], ArrayLike | None],
    kind: Literal['reals', 'packed'] = 'reals',
) -> PairValue:
    """Part of the images' estimate; none if it is not known."""

    def part(pair: PairResult) -> Array | None:
        images = pair.images
        value = None if images is None else of(images)
        numbers = np.atleast_1d(np.nan if value is None else value)
        return numbers if np.isfinite(numbers).all() else None

    return PairValue(key, kind, part)


# Values of the status by their keys, in the order of the message. [derived: interface]
PAIR_VALUES = {
    value.key: value
    for value in (
        PairValue(
            'reference_stamp_ns',
            'time',
            lambda pair: pair.reference_stamp_ns,
            'reference_stamp_ns',
        ),
        PairValue('status', 'text', lambda pair: pair.pose.status.value, 'status'),
        PairValue('reason', 'text', lambda pair: pair.pose.reason, 'reason'),
        PairValue('model', 'text', lambda pair: pair.pose.diagnostics.model),
        *(PairValue(metric.name, 'real', metric.of) for metric in PAIR_METRICS),
        PairValue('baseline_m', 'real', lambda pair: pair.pose.baseline, 'baseline'),
        PairValue(
            'baseline_log_sigma',
            'real',
            lambda pair: pair.pose.baseline_log_sigma,
            'baseline_log_sigma',
        ),
        PairValue('baseline_reason', 'text', lambda pair: pair.pose.diagnostics.baseline_reason),
        # The velocity of the current camera, in its own frame.
        PairValue(
            'linear_velocity_m_s',
            'vector',
            lambda pair: pair.pose.metric_velocity2 if math.isfinite(pair.pose.baseline) else None,
        ),
        # Times of the two stamped rows on the IMU's clock.
        PairValue('reference_imu_ns', 'time', lambda pair: pair.reference_ns1, 'reference_imu_ns'),
        PairValue('current_imu_ns', 'time', lambda pair: pair.reference_ns2, 'current_imu_ns'),
        # `ImageInformation`: the estimate of the images without the priors of the IMU.
        _image_value('image_by_deviation', lambda images: images.by_deviation, 'packed'),
        _image_value('image_row_s', lambda images: images.row_time),
        _image_value(
            'image_rotation_xyzw', lambda images: Rotation.from_matrix(images.R).as_quat()
        ),
        _image_value('image_direction', lambda images: images.t),
        _image_value('image_velocities', lambda images: images.velocities),
        _image_value('image_gradient', lambda images: images.gradient),
        _image_value(
            'image_information',
            lambda images: images.information[np.triu_indices(len(images.gradient))],
        ),
        PairValue('gyro_bias_rad_s', 'vector', lambda pair: pair.gyro_bias, 'gyro_bias'),
        PairValue('health', 'text', lambda pair: pair.health.state.value, 'health'),
        PairValue('health_findings', 'text', lambda pair: findings_text.one_line(pair.health)),
        PairValue('findings', 'findings', lambda pair: pair.health, 'findings'),
    )
}
# The last key of the status: it lists the other topics of the pair. [derived: interface]
TOPICS_KEY = 'topics'


# -- the messages of a pair ------------------------------------------------------------------


def pair_parts(
    result: PairResult, types: MessageTypes, reference_frame: str = ''
) -> dict[str, Callable[[], Any]]:
    """Functions that make the messages of a pair, by topic, in the order of `PAIR_TOPICS`.

    Every pair has `pairs`, every known rotation `relative_rotation`, every pose all of them: no
    message stands for a missing value. `reference_frame`: frame_id of relative pose and rotation;
    empty for ``<camera frame>_reference``.
    """
    pose = result.pose
    stamp_ns = result.stamp_ns
    in_camera = header(stamp_ns, result.frame_id, types)
    in_reference = header(stamp_ns, reference_frame or f'{result.frame_id}_reference', types)
    # The covariance needs no conversion: (dt, dtheta) with R_true = Exp(dtheta) R in camera 1
    # is ROS's order x, y, z and rotations about the fixed axes of the header's frame.
    parts: dict[str, Callable[[], Any]] = {}
    if pose:
        parts['relative_pose'] = lambda: types('geometry_msgs/msg/PoseWithCovarianceStamped')(
            header=in_reference,
            pose=types('geometry_msgs/msg/PoseWithCovariance')(
                pose=_pose(pose.R, pose.t, types),
                covariance=published_covariance(pose.covariance),
            ),
        )
        parts['reference'] = lambda: types('sensor_msgs/msg/TimeReference')(
            header=in_camera,
            time_ref=_time(result.reference_stamp_ns, types),
            source='reference_keyframe',
        )
        # The velocities of the current camera: angular in rad/s, linear in baselines per second.
        parts['velocity'] = lambda: types('geometry_msgs/msg/TwistWithCovarianceStamped')(
            header=in_camera,
            twist=twist_message(
                pose.linear_velocity2, pose.angular_velocity2, pose.velocity_covariance, types
            ),
        )
        parts['matches'] = lambda: _matches_message(inlier_records(result), in_reference, types)
    if pose.rotation_known:
        # Errors of the rotation are about the axes of the reference camera, as in
        # ``~/relative_pose``; ``~/velocity`` has the same rates.
        parts['relative_rotation'] = lambda: imu_message(
            stamp_ns,
            in_reference.frame_id,
            pose.angular_velocity2,
            None,
            types,
            orientation=quat_xyzw(pose.R),
            covariances={
                'angular_velocity': published_covariance(pose.velocity_covariance[3:, 3:]),
                'orientation': published_covariance(pose.covariance[3:, 3:]),
            },
        )
    topics = ' '.join(parts)
    parts['pairs'] = lambda: _status_of_pair(result, topics, types)
    return parts


def _status_of_pair(result: PairResult, topics: str, types: MessageTypes) -> Any:
    pose = result.pose
    values = [(value.key, value.text(value.of(result))) for value in PAIR_VALUES.values()]
    values.append((TOPICS_KEY, topics))
    text = f'{pose.status.value}: {pose.reason}' if pose.reason else pose.status.value
    if result.health.state is FindingState.WRONG:
        level = 2
    else:
        level = 0 if pose and result.health.state is not FindingState.SUSPECT else 1
    return diagnostics_message(
        result.stamp_ns, level, 'keyframe pair', text, result.frame_id, values, types
    )


def _matches_message(points: NDArray[np.void], in_reference: Any, types: MessageTypes) -> Any:
    """sensor_msgs/PointCloud2 of `inlier_records`, with landmarks in the frame of the header."""
    field_type = types('sensor_msgs/msg/PointField')
    fields = [
        field_type(name=name, offset=offset, datatype=datatype, count=1)
        for name, offset, datatype in MATCH_FIELDS
    ]
    message_type = types('sensor_msgs/msg/PointCloud2')
    return message_type(
        header=in_reference,
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=MATCH_DTYPE.itemsize,
        row_step=MATCH_DTYPE.itemsize * len(points),
        data=_byte_data(points, message_type),
        is_dense=not np.isnan(points['x']).any(),
    )


def inlier_records(result: PairResult) -> NDArray[np.void]:
    """Inlier matches (N,) as records of `MATCH_DTYPE`.

    Pixels of the published images, row times [s] from the stamped row, rays derotated to it,
    the landmark in the reference camera [baselines], global-shutter pixels at the stamped
    rows.
    """
    inliers = result.pose.inliers
    matches = result.matches
    found = result.landmarks
    assert found is not None, 'only pairs with a pose have inliers to publish'
    columns = [
        matches.points1,
        matches.points2,
        *matches.row_times,
        *matches.rays,
        found.points,
        found.pixels1,
        found.pixels2,
    ]
    values = np.column_stack(columns)[inliers]
    records = np.empty(len(values), dtype=MATCH_DTYPE)
    records['id'] = matches.track_ids[inliers]
    for name, column in zip(_FLOATS, values.T, strict=True):
        records[name] = column
    return records


# -- messages of any kind --------------------------------------------------------------------


# Covariance of a sensor that does not exist. [derived: REP-145]
_ABSENT_COVARIANCE = np.diag([-1.0, 0.0, 0.0]).ravel()


def header(stamp_ns: int, frame_id: str, types: MessageTypes) -> Any:
    """std_msgs/Header."""
    return types('std_msgs/msg/Header')(stamp=_time(stamp_ns, types), frame_id=frame_id)


def geometry_message(name: str, values: ArrayLike, types: MessageTypes) -> Any:
    """A message of geometry_msgs with the fields x, y, z and, of a quaternion, w."""
    fields = dict(zip('xyzw', map(float, np.asarray(values)), strict=False))
    return types(f'geometry_msgs/msg/{name}')(**fields)


def pose_stamped_message(
    stamp_ns: int, frame_id: str, rotation: ArrayLike, position: ArrayLike, types: MessageTypes
) -> Any:
    """geometry_msgs/PoseStamped; `rotation`: a matrix (3, 3) or a quaternion x, y, z, w."""
    return types('geometry_msgs/msg/PoseStamped')(
        header=header(stamp_ns, frame_id, types), pose=_pose(rotation, position, types)
    )


def transform_message(
    stamp_ns: int,
    frame_id: str,
    child_frame_id: str,
    rotation: ArrayLike,
    position: ArrayLike,
    types: MessageTypes,
) -> Any:
    """geometry_msgs/TransformStamped from the pose of the child, as `pose_stamped_message`."""
    pose = pose_stamped_message(stamp_ns, frame_id, rotation, position, types)
    return types('geometry_msgs/msg/TransformStamped')(
        header=pose.header,
        child_frame_id=child_frame_id,
        transform=types('geometry_msgs/msg/Transform')(
            translation=geometry_message('Vector3', position, types),
            rotation=pose.pose.orientation,
        ),
    )


def twist_message(
    linear: ArrayLike, angular: ArrayLike, covariance: Array, types: MessageTypes
) -> Any:
    """geometry_msgs/TwistWithCovariance."""
    return types('geometry_msgs/msg/TwistWithCovariance')(
        twist=types('geometry_msgs/msg/Twist')(
            linear=geometry_message('Vector3', linear, types),
            angular=geometry_message('Vector3', angular, types),
        ),
        covariance=published_covariance(covariance),
    )


def imu_message(
    stamp_ns: int,
    frame_id: str,
    angular_velocity: ArrayLike | None,
    linear_acceleration: ArrayLike | None,
    types: MessageTypes,
    *,
    orientation: ArrayLike | None = None,
    covariances: Mapping[str, Array] | None = None,
) -> Any:
    """sensor_msgs/Imu (REP-145).

    Rates (3,) [rad/s] and specific force (3,) [m/s^2], +g up at rest, in the frame; None is an
    absent measurement: the first element of its covariance is -1. `covariances`: 9 elements by
    the name of a measurement; others are unknown.
    """
    known = covariances or {}
    fields = {}
    for name, kind, absent, value in (
        ('orientation', 'Quaternion', (0.0, 0.0, 0.0, 1.0), orientation),
        ('angular_velocity', 'Vector3', (0.0, 0.0, 0.0), angular_velocity),
        ('linear_acceleration', 'Vector3', (0.0, 0.0, 0.0), linear_acceleration),
    ):
        covariance = np.ravel(known.get(name, np.zeros(9)))
        if value is None:
            value = absent
            covariance = _ABSENT_COVARIANCE
        fields[name] = geometry_message(kind, value, types)
        fields[f'{name}_covariance'] = covariance
    return types('sensor_msgs/msg/Imu')(header=header(stamp_ns, frame_id, types), **fields)


def image_message(stamp_ns: int, frame_id: str, pixels: Pixels, types: MessageTypes) -> Any:
    """sensor_msgs/Image."""
    values = np.ascontiguousarray(pixels.values)
    message_type = types('sensor_msgs/msg/Image')
    return message_type(
        header=header(stamp_ns, frame_id, types),
        height=values.shape[0],
        width=values.shape[1],
        encoding=pixels.encoding,
        is_bigendian=int(sys.byteorder == 'big'),
        step=values[0].nbytes,
        data=_byte_data(values, message_type),
    )


def compressed_image_message(
    stamp_ns: int, frame_id: str, pixels: Pixels, *, png: bool, types: MessageTypes
) -> Any:
    """sensor_msgs/CompressedImage: JPEG, or PNG, the only one for 16 bits."""
    kind, data = encode_pixels(pixels, png=png)
    values, name = pixels
    bits = 8 * values.itemsize
    order = '' if values.ndim == 2 else f'bgr{bits}'
    # The format string of image_transport.
    text = f'{name}; {kind} compressed {order}'
    return encoded_image_message(stamp_ns, frame_id, data, types, text)


def encode_pixels(pixels: Pixels, *, png: bool) -> tuple[str, bytes]:
    """Kind, 'jpeg' or 'png', and content of a file; 16 bits are always PNG."""
    values, name = pixels
    if name.startswith('rgb'):
        conversion = cv2.COLOR_RGBA2BGRA if name == 'rgba8' else cv2.COLOR_RGB2BGR
        values = cv2.cvtColor(values, conversion)
    kind = 'jpeg'
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    if png or values.dtype != np.uint8:
        kind = 'png'
        options = []
    _, data = cv2.imencode(f'.{kind}', values, options)
    return kind, data.tobytes()


def encoded_image_message(
    stamp_ns: int,
    frame_id: str,
    data: bytes | NDArray[np.uint8],
    types: MessageTypes,
    image_format: str = 'mono8; jpeg compressed ',
) -> Any:
    """sensor_msgs/CompressedImage of JPEG or PNG data; image_transport has the same formats."""
    message_type = types('sensor_msgs/msg/CompressedImage')
    return message_type(
        header=header(stamp_ns, frame_id, types),
        format=image_format,
        data=_byte_data(np.frombuffer(data, dtype=np.uint8), message_type),
    )


def camera_info_message(
    stamp_ns: int,
    frame_id: str,
    camera: Intrinsics | RollingShutterCamera,
    published: Any,
    types: MessageTypes,
) -> Any:
    """sensor_msgs/CameraInfo: a copy of `published` (ROS 1 or 2); the full sensor for None."""
    if published is None:
        model = camera.distortion_model
        binning = (0, 0)
        region = dict.fromkeys(_REGION, 0)
        pinhole = camera.global_shutter_camera() if isinstance(camera, Intrinsics) else camera
        p = np.zeros((3, 4))
        p[:, :3] = pinhole.camera_matrix
        # Without distortion ROS writes five zeros.
        d = camera.distortion or (0.0,) * (5 if model == 'plumb_bob' else 0)
        arrays = {
            'd': d,
            'k': pinhole.camera_matrix.ravel(),
            'r': np.eye(3).ravel(),
            'p': p.ravel(),
        }
    else:
        arrays = {name: info_field(published, name) for name in 'dkrp'}
        model = published.distortion_model
        binning = int(published.binning_x), int(published.binning_y)
        region = {name: int(getattr(published.roi, name)) for name in _REGION}
        region['do_rectify'] = bool(published.roi.do_rectify)
    return types('sensor_msgs/msg/CameraInfo')(
        header=header(stamp_ns, frame_id, types),
        height=camera.height,
        width=camera.width,
        distortion_model=model,
        binning_x=binning[0],
        binning_y=binning[1],
        roi=types('sensor_msgs/msg/RegionOfInterest')(**{'do_rectify': False, **region}),
        **{name: np.array(values, dtype=np.float64) for name, values in arrays.items()},
    )


def diagnostics_message(
    stamp_ns: int,
    level: int,
    name: str,
    text: str,
    hardware_id: str,
    values: Sequence[tuple[str, str]],
    types: MessageTypes,
) -> Any:
    """diagnostic_msgs/DiagnosticArray of one status; level 0 OK, 1 warning, 2 error, 3 stale."""
    key_value = types('diagnostic_msgs/msg/KeyValue')
    status_type = types('diagnostic_msgs/msg/DiagnosticStatus')
    return types('diagnostic_msgs/msg/DiagnosticArray')(
        header=header(stamp_ns, '', types),
        status=[
            status_type(
                level=bytes([level]) if _is_rclpy(status_type) else level,
                name=name,
                message=text,
                hardware_id=hardware_id,
                values=[key_value(key=key, value=value) for key, value in values],
            )
        ],
    )


def quat_xyzw(R: Array) -> Array:
    """Quaternion (4,) x, y, z, w of a rotation matrix, with w >= 0."""
    quaternion = Rotation.from_matrix(R).as_quat()
    return quaternion if quaternion[3] >= 0.0 else -quaternion


def published_covariance(covariance: Array) -> Array:
    """A covariance (N, N) as in messages (N * N,): symmetric, no eigenvalue below 0."""
    symmetric = 0.5 * (covariance + covariance.T)
    values, vectors = np.linalg.eigh(symmetric)
    least = _LEAST_EIGENVALUE * values[-1]
    whole = (vectors * np.maximum(values, least)) @ vectors.T
    return (0.5 * (whole + whole.T)).ravel()


def number_text(value: float) -> str:
    """Shortest text that reads back as the same number; empty for NaN."""
    if isinstance(value, int):
        return str(value)
    return '' if math.isnan(value) else repr(float(value))


def _time(stamp_ns: int, types: MessageTypes) -> Any:
    seconds, nanoseconds = divmod(int(stamp_ns), NANOSECONDS)
    return types('builtin_interfaces/msg/Time')(sec=seconds, nanosec=nanoseconds)


def _pose(rotation: ArrayLike, position: ArrayLike, types: MessageTypes) -> Any:
    quaternion = quat_xyzw(np.asarray(rotation)) if np.ndim(rotation) == 2 else rotation
    return types('geometry_msgs/msg/Pose')(
        position=geometry_message('Point', position, types),
        orientation=geometry_message('Quaternion', quaternion, types),
    )


def _byte_data(values: NDArray[Any], message_type: Any) -> Any:
    """Bytes in the container of the message; rclpy copies an ndarray element by element."""
    if _is_rclpy(message_type):
        data = array('B')
        contiguous = np.ascontiguousarray(values).ravel()
        data.frombytes(contiguous.view(np.uint8).data)
        return data
    return np.frombuffer(values.tobytes(), dtype=np.uint8)


def _is_rclpy(message_type: Any) -> bool:
    return hasattr(message_type, 'get_fields_and_field_types')


# -- ~/debug_image, and matches.png of `replay` ------------------------------------------------

Color = NDArray[np.uint8]

# Largest width [px]. A wider image is reduced, because publishing large messages is slow.
# [chosen: half of a screen; 640 to 1920 would do]
_MAX_WIDTH = 960
# Width of the bar with the colours of the rows [px]. [chosen: 8 to 30 would be readable]
_BAR_WIDTH = 14
# Height of the line of text below the image [px]. [derived: the font with a margin]
_CAPTION_HEIGHT = 24
# Colour of outliers: cyan does not occur among the colours of the rows. [chosen: for its contrast]
_OUTLIER = (255, 255, 0)
# Colour of all text. [chosen: for its contrast to the darkened image]
_WHITE = (255, 255, 255)
# Size of the text: the caption fits into a width of 640 px. [chosen: 0.35 to 0.5 would do]
_FONT_SCALE = 0.42
# Colours (216, 3) from the first row to the last one. [chosen: the dark end of the map is left
# out, as it cannot be distinguished from the image]
_COLORS = np.asarray(
    cv2.applyColorMap(np.arange(40, 256, dtype=np.uint8)[:, None], cv2.COLORMAP_PLASMA)[:, 0],
    dtype=np.uint8,
)
# Fractional bits of the coordinates that OpenCV draws at. [chosen: a sixteenth of a pixel is not
# visible; 3 to 8 would do]
_SHIFT = 4


def draw_pair(result: PairResult) -> Color:
    """The current image (H, W, 3) in blue, green, red, with the matches of its pair as lines.

    Inliers have the colour of their row (bar with times, on the left or above), outliers are
    cyan.
    """
    assert result.image2 is not None
    height, width = result.image2.shape
    scale = min(1.0, _MAX_WIDTH / width)
    size = (round(scale * width), round(scale * height))
    # Two thirds of the brightness, for the contrast of the lines.
    reduced = cv2.resize(result.image2, size, interpolation=cv2.INTER_AREA)
    darkened = reduced // 3 * 2
    canvas = np.asarray(cv2.cvtColor(darkened, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    inliers = result.pose.inliers
    if len(inliers) != len(result.matches):  # a pair without an estimate has none
        inliers = np.zeros(len(result.matches), dtype=bool)
    # Rows are columns of the image where the camera is read to the right or left.
    axis = result.readout_axis
    row_count = (width, height)[axis]
    shares = result.matches.points2[:, axis] / row_count
    _draw_matches(canvas, result.matches, inliers, shares, scale)
    _draw_row_times(canvas, result.matches, axis, row_count)
    caption = np.zeros((_CAPTION_HEIGHT, size[0], 3), dtype=np.uint8)
    _write(caption, _caption(result, int(inliers.sum())), (6, 16))
    return np.concatenate([canvas, caption])


def _draw_matches(
    canvas: Color, matches: Matches, inliers: NDArray[np.bool_], shares: Array, scale: float
) -> None:
    """Draw a line for each match; its dot is the point in the current image.

    `shares` (N,): rows of the points in the current image, as shares of all rows.
    """
    indices = shares * len(_COLORS)
    colors = _COLORS[indices.astype(int)].tolist()
    points = np.stack([matches.points1, matches.points2], axis=1)
    scaled = (points + 0.5) * scale - 0.5  # pixel centres lie at integer coordinates
    fixed_point = np.round(scaled * (1 << _SHIFT))
    ends = fixed_point.astype(int).tolist()
    for (start, end), inlier, color in zip(ends, inliers, colors, strict=True):
        drawn = color if inlier else _OUTLIER
        cv2.line(canvas, start, end, drawn, 1, cv2.LINE_AA, _SHIFT)
        cv2.circle(canvas, end, 2 << _SHIFT, drawn, -1, cv2.LINE_AA, _SHIFT)


def _draw_row_times(canvas: Color, matches: Matches, axis: int, row_count: int) -> None:
    """Draw the colours of the rows, and the times of the first and of the last one.

    The bar is at the left, or at the top for rows that are columns of the image (`axis` 0).
    """
    rows = matches.points2[:, axis]
    if not len(rows) or np.ptp(rows) < 1.0:
        return
    height, width = canvas.shape[:2]
    if axis == 1:
        canvas[:, :_BAR_WIDTH] = cv2.resize(_COLORS[:, None], (_BAR_WIDTH, height))
        beside = _BAR_WIDTH + 4
        places = (beside, 14), (beside, height - 6)
    else:
        canvas[:_BAR_WIDTH] = cv2.resize(_COLORS[None], (width, _BAR_WIDTH))
        below = _BAR_WIDTH + 14
        last = max(width - 64, 4)
        places = (4, below), (last, below)
    line = np.polyfit(rows, matches.row_times[1], 1)
    first_and_last = np.polyval(line, (0, row_count - 1))
    for time, place in zip(first_and_last, places, strict=True):
        # Adding zero makes a negative zero positive.
        rounded = round(1e3 * time, 1) + 0.0
        _write(canvas, f'{rounded:.1f} ms', place)


def _caption(result: PairResult, inliers: int) -> str:
    pose = result.pose
    found = pose.diagnostics
    model = f' {found.model}' if pose else ''
    residual = f', residual {found.residual_rms:.2f} px' if pose else ''
    return (
        f'{pose.status.value}{model}: {inliers} of {len(result.matches)} matches, '
        f'parallax {result.parallax:.1f} px, {1e3 * result.interval:.0f} ms{residual}'
    )


def _write(canvas: Color, text: str, place: tuple[int, int]) -> None:
    """Write a text in white; `place`: its lower left corner [px]."""
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(canvas, text, place, font, _FONT_SCALE, _WHITE, 1, cv2.LINE_AA)
