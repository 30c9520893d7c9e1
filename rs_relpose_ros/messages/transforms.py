"""Extrinsics from /tf_static and /tf, where the parameters do not give them.

A transform is the pose of a child frame in a parent: x y z [m], quaternion x y z w. Functions of
plain transforms, for the buffer of tf2_ros (live) and the messages of a bag alike.
"""

from collections.abc import Iterator
from itertools import islice
import logging
import math
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.geometry import Array

Transform = tuple[float, ...]

# Doubt of the rotation of a transform, 1 sigma per axis [rad]. URDFs hold drawings, not
# calibrations: a smaller sigma would report the tolerance of a mount as a contradiction, a larger
# one would hide a wrong transform. [chosen: 2 to 8 deg would do]
AXES_SIGMA = math.radians(5.0)
# Doubt of the position of a transform, 1 sigma per axis [m], for the same reasons. [chosen: 1 to 5
# cm would do]
POSITION_SIGMA = 0.02
# Type of the messages on /tf and /tf_static. [derived: interface of ROS]
TF_TYPE = 'tf2_msgs/msg/TFMessage'
# Number of messages of /tf that are read for a frame that /tf_static does not connect. More would
# delay the start with a long bag, fewer miss a publisher of 1 Hz among fast ones.
# [chosen: 100 to 10,000 would do]
_MOST_MESSAGES = 1000

_logger = logging.getLogger(__name__)


class FrameTree:
    """Transforms by child; of several for one child the first one holds."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Array]] = {}

    def add(self, message: Any) -> None:
        """Add the transforms of a tf2_msgs/TFMessage that are rigid."""
        for stamped in message.transforms:
            pose = _rigid(stamped.transform)
            if pose is not None:
                # ROS 1 has names with and without a slash.
                child = stamped.child_frame_id.lstrip('/')
                parent = stamped.header.frame_id.lstrip('/')
                self._parents.setdefault(child, (parent, pose))

    def lookup(self, parent: str, child: str) -> Transform | None:
        """Pose of `child` in `parent`; None if they are not connected."""
        root, of_parent = self._in_root(parent)
        other, of_child = self._in_root(child)
        if root != other:
            return None
        pose = np.linalg.inv(of_parent) @ of_child
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        position = pose[:3, 3].tolist()
        return *position, *quaternion.tolist()

    def _in_root(self, frame: str) -> tuple[str, Array]:
        """The frame without a parent above a frame, and the pose (4, 4) of the frame in it."""
        frame = frame.lstrip('/')
        pose = np.eye(4)
        for _ in self._parents:  # at most: a circle has no root
            if frame in self._parents:
                frame, step = self._parents[frame]
                pose = step @ pose
        return frame, pose


def _rigid(transform: Any) -> Array | None:
    """Pose (4, 4) of a geometry_msgs/Transform; None if it is not finite or not a rotation."""
    position = transform.translation
    rotation = transform.rotation
    quaternion = [rotation.x, rotation.y, rotation.z, rotation.w]
    pose = np.eye(4)
    pose[:3, 3] = position.x, position.y, position.z
    length = np.linalg.norm(quaternion)
    is_unit = abs(length - 1.0) < 1e-2
    if not (is_unit and np.isfinite(pose).all()):
        return None
    pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    return pose


def angle_between(R: Array, other: Array, sigma: float) -> float:
    """Angle [deg] between two rotations, R of `sigma` [rad]; 0 where they may be the same."""
    angle = float(Rotation.from_matrix(R @ other.T).magnitude())
    allowed = math.hypot(AXES_SIGMA, 3.0 * sigma)
    return math.degrees(angle) if angle > allowed else 0.0


def extrinsics(
    parameters: Parameters, found: Transform, camera: str, imu: str
) -> tuple[dict[str, Any], str]:
    """Parameters by the pose `found` of the IMU in the camera; and a contradiction, or ''."""
    sensor = parameters.sensor
    position = parameters.imu.imu_position
    found_position = found[:3]
    rotation = Rotation.from_quat(found[3:])
    head = f'/tf_static has {imu} in {camera}'
    values: dict[str, Any] = {}
    if sensor.quat_cam_imu_xyzw is None:
        values['quat_cam_imu_xyzw'] = tuple(rotation.as_quat().tolist())
        values['axes_sigma'] = AXES_SIGMA
    elif angle := angle_between(rotation.as_matrix(), sensor.R_cam_imu, sensor.axes_sigma):
        return {}, (
            f'{head} rotated by {_text(found[3:])}, quat_cam_imu_xyzw is '
            f'{_text(sensor.quat_cam_imu_xyzw)}, {angle:.1f} deg apart: the parameter is '
            'used, and nothing of the transform'
        )
    if not any(position):
        values['imu_position'] = found_position
        values['imu_position_sigma'] = POSITION_SIGMA
        return values, ''
    difference = np.subtract(found_position, position)
    apart = float(np.abs(difference).max())
    sigma = math.hypot(POSITION_SIGMA, parameters.imu.imu_position_sigma)
    if apart > 3.0 * sigma:
        return values, (
            f'{head} at {_text(found_position)} m, imu_position is {_text(position)} m: '
            'the parameter is used'
        )
    return values, ''


def _text(values: tuple[float, ...]) -> str:
    return f'[{", ".join(f"{value:.4f}" for value in values)}]'


# -- Bags -----------------------------------------------------------------------------------------


class BagFrames(NamedTuple):
    """Frames of a bag: names of camera and IMU, '' if unknown, and the transforms."""

    camera: str
    imu: str
    tree: FrameTree

    @property
    def imu_in_camera(self) -> Transform | None:
        """Pose of the IMU; None if it is unknown, or both have one frame_id."""
        known = self.camera and self.imu and self.camera != self.imu
        return self.tree.lookup(self.camera, self.imu) if known else None


def bag_frames(bag: Any, topics: Any, base: str = '') -> BagFrames:
    """Frames of a `Bag` with `SensorTopics`.

    /tf is read, too, until IMU and camera are connected, and the camera and `base` if it is given.
    """
    camera = _frame_id(bag, topics.image)
    imu = _frame_id(bag, topics.imu)
    frames = BagFrames(camera, imu, FrameTree())

    def messages_of(name: str) -> Iterator[Any]:
        of_transforms = [one for one in bag.topics if one.msgtype == TF_TYPE]
        topics = [one for one in of_transforms if one.name == name]
        return (found.message for found in bag.messages(topics))

    for message in messages_of('/tf_static'):
        frames.tree.add(message)
    for message in islice(messages_of('/tf'), _MOST_MESSAGES):
        base_known = not base or frames.tree.lookup(base, camera) is not None
        if base_known and frames.imu_in_camera is not None:
            break
        frames.tree.add(message)
    return frames


def _frame_id(bag: Any, topic: Any) -> str:
    """frame_id of the first message of a topic; empty without a topic or a message."""
    first = None if topic is None else next(iter(bag.messages([topic])), None)
    return '' if first is None else str(first.message.header.frame_id).lstrip('/')


def with_extrinsics(bag: Any, topics: Any, parameters: Parameters) -> tuple[Parameters, str]:
    """`parameters` completed by the transforms of a bag, and a contradiction ('' for none)."""
    base = parameters.odometry.base_frame
    if not parameters.calibration.use_tf:
        return parameters, ''
    frames = bag_frames(bag, topics, base)
    values: dict[str, Any] = {}
    contradiction = ''
    if (found := frames.imu_in_camera) is not None:
        values, contradiction = extrinsics(parameters, found, frames.camera, frames.imu)
    if base and parameters.odometry.base_to_camera is None:
        on_base = frames.tree.lookup(base, frames.camera)
        if on_base is not None:
            values['base_to_camera'] = on_base
    if values:
        _logger.info('from /tf_static: %s', ', '.join(values))
    return parameters.updated(values), contradiction
