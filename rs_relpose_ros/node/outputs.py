"""What the node publishes of a pair: its topics, and the transform where tf2_ros is installed."""

from __future__ import annotations

import importlib
from typing import Any

from geometry_msgs.msg import (
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Vector3,
)
from rclpy.exceptions import InvalidHandle
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from scipy.spatial.transform import Rotation

from rs_relpose_ros.config.parameters import PairConfig
from rs_relpose_ros.errors import MissingInputError
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.images.encoded import Pixels
from rs_relpose_ros.messages.outgoing import (
    DEBUG_IMAGE,
    image_message,
    pair_messages,
    PAIR_TOPICS,
)
from rs_relpose_ros.node.debug_image import draw_debug_image
from rs_relpose_ros.node.message_types import message_class

# Messages kept for a subscriber that is late: three seconds of pairs at 30 Hz.
_HISTORY = 100

# What rclpy raises where a signal has ended the context amid a call.
SHUT_DOWN = (rclpy_implementation.RCLError, InvalidHandle)


class PairPublishers:
    """Publishes pairs on the topics of the node, and as a transform if asked for."""

    def __init__(self, node: Node, config: PairConfig) -> None:
        self._pair = {name: node.create_publisher(message_class(msgtype), f'~/{name}', _HISTORY)
                      for name, msgtype in PAIR_TOPICS.items()}
        self._debug_image = node.create_publisher(
            message_class('sensor_msgs/msg/Image'), f'~/{DEBUG_IMAGE}', 2)
        self._transforms = _transform_broadcaster(node) if config.publish_tf else None

    def publish(self, result: PairResult, config: PairConfig) -> None:
        """Publish what is known of a pair."""
        messages = pair_messages(result, message_class, config.reference_frame)
        for topic, message in messages.by_topic():
            self._pair[topic].publish(message)
        if self._transforms is not None and messages.relative_pose is not None:
            self._transforms.sendTransform(
                _transform_to_reference(messages.relative_pose, result.frame_id))

    def publish_picture(self, result: PairResult, config: PairConfig) -> None:
        """Publish ~/debug_image of any pair, where somebody looks at it."""
        if config.publish_debug_image and self._debug_image.get_subscription_count():
            self._debug_image.publish(image_message(
                result.stamp_ns, result.frame_id, Pixels(draw_debug_image(result), 'bgr8'),
                message_class))


def _transform_broadcaster(node: Node) -> Any:
    try:
        return importlib.import_module('tf2_ros').TransformBroadcaster(node)
    except ImportError as error:
        raise MissingInputError('publish_tf needs tf2_ros, which is not installed: install '
                                'ros-jazzy-tf2-ros-py, or set publish_tf to false') from error


def _transform_to_reference(message: PoseWithCovarianceStamped,
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
