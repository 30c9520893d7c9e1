"""The relative pose as a transform, where tf2_ros is installed."""

from __future__ import annotations

from collections.abc import Callable
import importlib
from typing import Any

from geometry_msgs.msg import (
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Vector3,
)
from rclpy.node import Node
from scipy.spatial.transform import Rotation

from rs_relpose_ros.errors import MissingInputError

Broadcast = Callable[[PoseWithCovarianceStamped, str], None]


def transform_broadcaster(node: Node) -> Broadcast:
    """A function that broadcasts a relative pose, given with the camera's frame.

    Raises
    ------
    MissingInputError
        tf2_ros is not installed.
    """
    try:
        tf2_ros: Any = importlib.import_module('tf2_ros')
    except ImportError as error:
        raise MissingInputError('publish_tf needs tf2_ros, which is not installed: install '
                                'ros-jazzy-tf2-ros-py, or set publish_tf to false') from error
    broadcaster = tf2_ros.TransformBroadcaster(node)

    def broadcast(message: PoseWithCovarianceStamped, camera_frame: str) -> None:
        broadcaster.sendTransform(reference_transform(message, camera_frame))

    return broadcast


def reference_transform(message: PoseWithCovarianceStamped,
                        camera_frame: str) -> TransformStamped:
    """Transform from the camera to the reference keyframe: the pose's inverse.

    The camera has its parent in the robot's tree already, and a frame has one parent: so the
    reference is the child. Its origin is one baseline away, whatever that is in metres.
    """
    pose = message.pose.pose
    q, t = pose.orientation, pose.position
    inverse = Rotation.from_quat([q.x, q.y, q.z, q.w]).inv()
    x, y, z = (float(value) for value in -inverse.apply([t.x, t.y, t.z]))
    transform = TransformStamped(child_frame_id=message.header.frame_id, transform=Transform(
        translation=Vector3(x=x, y=y, z=z), rotation=Quaternion(x=-q.x, y=-q.y, z=-q.z, w=q.w)))
    transform.header.stamp = message.header.stamp
    transform.header.frame_id = camera_frame
    return transform
