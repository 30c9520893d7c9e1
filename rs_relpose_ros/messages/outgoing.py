"""Results to messages, for rclpy's classes and for those of rosbags alike.

`types` gives the class of a message type name (``'geometry_msgs/msg/Pose'``), so that the node and
the bag writer share these functions. All messages of a pair carry the stamp of the current image.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
import sys
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.health.findings import HealthState
from rs_relpose_ros.images.encoded import Pixels
from rs_relpose_ros.messages.incoming import info_field
from rs_relpose_ros.messages.pair_status import PAIR_VALUES, TOPICS_KEY

MessageTypes = Callable[[str], Any]

_UINT32, _FLOAT32 = 6, 7   # sensor_msgs/PointField

# The id comes last: `sensor_msgs_py.point_cloud2.read_points_numpy` reads only fields of the type
# of the first.
MATCH_DTYPE = np.dtype([(name, '<f4') for name in (
    'u1', 'v1', 'u2', 'v2', 'tau1', 'tau2', 'x1', 'y1', 'z1', 'x2', 'y2', 'z2', 'x', 'y', 'z',
    'u1_gs', 'v1_gs', 'u2_gs', 'v2_gs')] + [('id', '<u4')])
# Name, offset and type of each, for sensor_msgs/PointField.
MATCH_FIELDS = tuple(
    (name, int(offset), _UINT32 if name == 'id' else _FLOAT32)
    for name, (_, offset, *_) in (MATCH_DTYPE.fields or {}).items())

# What the node publishes of a pair, in this order: topic and message type.
PAIR_TOPICS = {
    'relative_pose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'reference': 'sensor_msgs/msg/TimeReference',
    'velocity': 'geometry_msgs/msg/TwistWithCovarianceStamped',
    'matches': 'sensor_msgs/msg/PointCloud2',
    'relative_rotation': 'sensor_msgs/msg/Imu',
    'pairs': 'diagnostic_msgs/msg/DiagnosticArray',
}
# Those of a pair with a pose only.
POSE_TOPICS = ('relative_pose', 'reference', 'velocity', 'matches')
# A picture of a pair, for people.
DEBUG_IMAGE = 'debug_image'

# Of images that are turned; as image_transport's default.
_JPEG_QUALITY = 95
# Fields of sensor_msgs/RegionOfInterest with numbers.
_REGION = ('x_offset', 'y_offset', 'height', 'width')

# Least eigenvalue of a published covariance, as a share of the largest: that of a matrix of rank 5
# is then not below 0 by rounding.
_LEAST_EIGENVALUE = 1e-14


@dataclass(frozen=True, slots=True)
class PairMessages:
    """The messages of one pair, all of the same stamp; None where the pair has none.

    `pairs` is there for every pair, `relative_rotation` with every rotation, the others with every
    pose: there is no message that says "none".
    """

    relative_pose: Any
    reference: Any
    velocity: Any
    matches: Any
    relative_rotation: Any
    pairs: Any

    def by_topic(self) -> Iterator[tuple[str, Any]]:
        """Topic and message of what is to be published, in the order of `PAIR_TOPICS`."""
        for topic in PAIR_TOPICS:
            message = getattr(self, topic)
            if message is not None:
                yield topic, message


def pair_messages(result: PairResult, types: MessageTypes,
                  reference_frame: str = '') -> PairMessages:
    """Messages of a pair.

    `reference_frame`: frame_id of relative pose and rotation; empty for
    ``<camera frame>_reference``.
    """
    in_reference = header(result.stamp_ns, reference_frame or f'{result.frame_id}_reference',
                          types)
    messages: dict[str, Any] = dict.fromkeys(PAIR_TOPICS)
    if result.pose:
        messages |= _pose_messages(result, in_reference, types)
    if result.pose.rotation_known:
        messages['relative_rotation'] = _rotation_message(result.pose, in_reference, types)
    messages['pairs'] = _pair_status_message(
        result, [topic for topic, message in messages.items() if message is not None], types)
    return PairMessages(**messages)


def _pose_messages(result: PairResult, in_reference: Any, types: MessageTypes) -> dict[str, Any]:
    """Messages of `POSE_TOPICS`."""
    pose, in_camera = result.pose, header(result.stamp_ns, result.frame_id, types)
    twist = types('geometry_msgs/msg/Twist')(
        linear=_geometry('Vector3', pose.linear_velocity2, types),
        angular=_geometry('Vector3', pose.angular_velocity2, types))
    return {
        # The covariance needs no conversion: (dt, dtheta) with R_true = Exp(dtheta) R in camera 1
        # is ROS's order x, y, z and rotations about the fixed axes of the header's frame.
        'relative_pose': types('geometry_msgs/msg/PoseWithCovarianceStamped')(
            header=in_reference, pose=types('geometry_msgs/msg/PoseWithCovariance')(
                pose=_pose(pose.R, pose.t, types),
                covariance=published_covariance(pose.covariance))),
        'reference': types('sensor_msgs/msg/TimeReference')(
            header=in_camera, time_ref=time(result.reference_stamp_ns, types),
            source='reference_keyframe'),
        # Of the current camera: angular in rad/s, linear in baselines per second.
        'velocity': types('geometry_msgs/msg/TwistWithCovarianceStamped')(
            header=in_camera, twist=types('geometry_msgs/msg/TwistWithCovariance')(
                twist=twist, covariance=published_covariance(pose.velocity_covariance))),
        'matches': matches_message(result, in_reference, types)}


def _rotation_message(pose: RelativePose, in_reference: Any, types: MessageTypes) -> Any:
    """sensor_msgs/Imu: how the current camera is turned in the reference camera, and turns.

    Errors of the rotation are about the axes of the header's frame, as in ``~/relative_pose``; the
    angular velocity is in the camera's own axes, as in ``~/velocity``.
    """
    return types('sensor_msgs/msg/Imu')(
        header=in_reference, orientation=_geometry('Quaternion', quat_xyzw(pose.R), types),
        orientation_covariance=published_covariance(pose.covariance[3:, 3:]),
        angular_velocity=_geometry('Vector3', pose.angular_velocity2, types),
        angular_velocity_covariance=published_covariance(pose.velocity_covariance[3:, 3:]),
        linear_acceleration=_geometry('Vector3', np.zeros(3), types),
        # REP-145: there is no accelerometer.
        linear_acceleration_covariance=np.array([-1.0, *[0.0] * 8]))


def _pair_status_message(result: PairResult, others: Sequence[str], types: MessageTypes) -> Any:
    """diagnostic_msgs/DiagnosticArray of one status; `others`: topics of the other messages."""
    pose = result.pose
    text = f'{pose.status.value}: {pose.reason}' if pose.reason else pose.status.value
    values = [(value.key, value.text(result)) for value in PAIR_VALUES]
    return diagnostics_message(result.stamp_ns, status_message(
        _level(result), 'keyframe pair', text, result.frame_id,
        [*values, (TOPICS_KEY, ' '.join(others))], types), types)


def matches_message(result: PairResult, in_reference: Any, types: MessageTypes) -> Any:
    """sensor_msgs/PointCloud2 of the inliers, fields as in `MATCH_DTYPE`.

    Pixels of the published images, row times [s] against the stamped row, rays turned to it, the
    landmark in the frame of the header, which is the reference camera [baselines], and pixels as
    global shutters would see it at the stamped rows' instants.
    """
    points = inlier_records(result)
    field_type = types('sensor_msgs/msg/PointField')
    fields = [field_type(name=name, offset=offset, datatype=datatype, count=1)
              for name, offset, datatype in MATCH_FIELDS]
    message_type = types('sensor_msgs/msg/PointCloud2')
    return message_type(
        header=in_reference, height=1, width=len(points),
        fields=fields, is_bigendian=False, point_step=MATCH_DTYPE.itemsize,
        row_step=MATCH_DTYPE.itemsize * len(points), data=_byte_data(points, message_type),
        is_dense=not np.isnan(points['x']).any())


def pose_stamped_message(stamp_ns: int, frame_id: str, R: NDArray[np.float64],
                         position: NDArray[np.float64], types: MessageTypes) -> Any:
    """geometry_msgs/PoseStamped."""
    return types('geometry_msgs/msg/PoseStamped')(
        header=header(stamp_ns, frame_id, types), pose=_pose(R, position, types))


def image_message(stamp_ns: int, frame_id: str, pixels: Pixels, types: MessageTypes) -> Any:
    """sensor_msgs/Image."""
    values = np.ascontiguousarray(pixels.values)
    message_type = types('sensor_msgs/msg/Image')
    return message_type(
        header=header(stamp_ns, frame_id, types), height=values.shape[0], width=values.shape[1],
        encoding=pixels.encoding, is_bigendian=int(sys.byteorder == 'big'),
        step=values[0].nbytes, data=_byte_data(values, message_type))


def compressed_image_message(stamp_ns: int, frame_id: str, pixels: Pixels, *, png: bool,
                             types: MessageTypes) -> Any:
    """sensor_msgs/CompressedImage: a JPEG, or a PNG, which alone takes 16 bits."""
    values, name = pixels
    if name.startswith('rgb'):
        values = cv2.cvtColor(values, cv2.COLOR_RGBA2BGRA if name == 'rgba8'
                              else cv2.COLOR_RGB2BGR)
    kind = 'png' if png or values.dtype != np.uint8 else 'jpeg'
    _, data = cv2.imencode(f'.{kind}', values, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
                           if kind == 'jpeg' else [])
    # As image_transport writes it.
    text = f'{name}; {kind} compressed {"" if values.ndim == 2 else f"bgr{8 * values.itemsize}"}'
    message_type = types('sensor_msgs/msg/CompressedImage')
    return message_type(header=header(stamp_ns, frame_id, types), format=text,
                        data=_byte_data(data, message_type))


def camera_info_message(stamp_ns: int, frame_id: str, intrinsics: Intrinsics, published: Any,
                        types: MessageTypes) -> Any:
    """sensor_msgs/CameraInfo of intrinsics; all but the stamp as `published`, where that is given.

    `published`: the CameraInfo that they are from, of ROS 1 or 2; None where parameters told them.
    """
    if published is None:
        told = intrinsics.global_shutter_camera()
        p = np.zeros((3, 4))
        p[:, :3] = told.camera_matrix
        arrays = {'d': intrinsics.distortion, 'k': told.camera_matrix.ravel(),
                  'r': np.eye(3).ravel(), 'p': p.ravel()}
        model, binning, region = intrinsics.distortion_model, (0, 0), dict.fromkeys(_REGION, 0)
    else:
        arrays = {name: info_field(published, name) for name in 'dkrp'}
        model = published.distortion_model
        binning = int(published.binning_x), int(published.binning_y)
        region = {name: int(getattr(published.roi, name)) for name in _REGION}
        region['do_rectify'] = bool(published.roi.do_rectify)
    return types('sensor_msgs/msg/CameraInfo')(
        header=header(stamp_ns, frame_id, types), height=intrinsics.height, width=intrinsics.width,
        distortion_model=model, binning_x=binning[0], binning_y=binning[1],
        roi=types('sensor_msgs/msg/RegionOfInterest')(**{'do_rectify': False, **region}),
        **{name: np.array(values, dtype=np.float64) for name, values in arrays.items()})


def inlier_records(result: PairResult) -> NDArray[np.void]:
    """Inlier matches (N,) as records of `MATCH_DTYPE`."""
    inliers, found = result.pose.inliers, result.landmarks
    assert found is not None, 'only pairs with a pose have inliers to publish'
    records = np.empty(int(np.count_nonzero(inliers)), dtype=MATCH_DTYPE)
    records['id'] = result.matches.track_ids[inliers]
    for names, values in (
            ('u1 v1', result.matches.points1), ('u2 v2', result.matches.points2),
            ('tau1', result.row_times1[:, None]), ('tau2', result.row_times2[:, None]),
            ('x1 y1 z1', result.rays1), ('x2 y2 z2', result.rays2), ('x y z', found.points),
            ('u1_gs v1_gs', found.pixels1), ('u2_gs v2_gs', found.pixels2)):
        for column, name in enumerate(names.split()):
            records[name] = values[inliers, column]
    return records


def diagnostics_message(stamp_ns: int, status: Any, types: MessageTypes) -> Any:
    """diagnostic_msgs/DiagnosticArray of one status."""
    return types('diagnostic_msgs/msg/DiagnosticArray')(
        header=header(stamp_ns, '', types), status=[status])


def status_message(level: int, name: str, text: str, hardware_id: str,
                   values: Sequence[tuple[str, str]], types: MessageTypes) -> Any:
    """diagnostic_msgs/DiagnosticStatus; `level` 0 OK, 1 warning, 2 error, 3 stale."""
    key_value = types('diagnostic_msgs/msg/KeyValue')
    status_type = types('diagnostic_msgs/msg/DiagnosticStatus')
    return status_type(
        level=bytes([level]) if _is_rclpy(status_type) else level, name=name, message=text,
        hardware_id=hardware_id, values=[key_value(key=key, value=value) for key, value in values])


def _level(result: PairResult) -> int:
    """2: what was told is wrong; 1: it may be, or there is no pose; 0: all is well."""
    if result.health.state is HealthState.WRONG:
        return 2
    return 0 if result.pose and result.health.state is not HealthState.SUSPECT else 1


# -- parts -----------------------------------------------------------------------------------


def time(stamp_ns: int, types: MessageTypes) -> Any:
    """builtin_interfaces/Time of an instant [ns]."""
    seconds, nanoseconds = divmod(int(stamp_ns), NANOSECONDS)
    return types('builtin_interfaces/msg/Time')(sec=seconds, nanosec=nanoseconds)


def header(stamp_ns: int, frame_id: str, types: MessageTypes) -> Any:
    """std_msgs/Header."""
    return types('std_msgs/msg/Header')(stamp=time(stamp_ns, types), frame_id=frame_id)


def quat_xyzw(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternion (4,) x, y, z, w of a rotation matrix, with w >= 0."""
    quaternion = Rotation.from_matrix(R).as_quat()
    return quaternion if quaternion[3] >= 0.0 else -quaternion


def _pose(R: NDArray[np.float64], position: NDArray[np.float64], types: MessageTypes) -> Any:
    return types('geometry_msgs/msg/Pose')(
        position=_geometry('Point', position, types),
        orientation=_geometry('Quaternion', quat_xyzw(R), types))


def vector_message(values: NDArray[np.float64], types: MessageTypes) -> Any:
    """geometry_msgs/Vector3."""
    return _geometry('Vector3', values, types)


def _geometry(name: str, values: NDArray[np.float64], types: MessageTypes) -> Any:
    """geometry_msgs message with the fields x, y, z and, of a quaternion, w."""
    fields = dict(zip('xyzw', map(float, values), strict=False))
    return types(f'geometry_msgs/msg/{name}')(**fields)


def published_covariance(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """A covariance (N, N) as a message has it (N * N,): symmetric, no eigenvalue below 0.

    By rounding one that is 0 may be below: that of the translation along itself.
    """
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    values = np.maximum(values, _LEAST_EIGENVALUE * values[-1])
    whole = (vectors * values) @ vectors.T
    return (0.5 * (whole + whole.T)).ravel()


def _byte_data(values: NDArray[Any], message_type: Any) -> Any:
    """Bytes in the container that is cheap: rclpy copies an ndarray element by element."""
    if _is_rclpy(message_type):
        data = array('B')
        data.frombytes(values.tobytes())
        return data
    return np.frombuffer(values.tobytes(), dtype=np.uint8)


def _is_rclpy(message_type: Any) -> bool:
    return hasattr(message_type, 'get_fields_and_field_types')
