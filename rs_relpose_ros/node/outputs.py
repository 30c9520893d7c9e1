"""What the node publishes of a pair."""

from __future__ import annotations

from rclpy.exceptions import InvalidHandle
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from rs_relpose_ros.config.parameters import PairConfig
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.messages.outgoing import color_image_message, pair_messages, PAIR_TOPICS
from rs_relpose_ros.node.debug_image import draw_debug_image
from rs_relpose_ros.node.message_types import message_class
from rs_relpose_ros.node.transform import Broadcast, transform_broadcaster

# What rclpy raises where a signal has ended the context amid a call.
SHUT_DOWN = (rclpy_implementation.RCLError, InvalidHandle)


class PairPublishers:
    """Publishes pairs on the topics of the node, and as a transform if asked for.

    Raises
    ------
    MissingInputError
        `publish_tf` is set and tf2_ros is not installed.
    """

    def __init__(self, node: Node, config: PairConfig) -> None:
        self._node = node
        self._pair = {name: node.create_publisher(message_class(msgtype), f'~/{name}', 10)
                      for name, msgtype in PAIR_TOPICS.items()}
        self._debug_image = node.create_publisher(
            message_class('sensor_msgs/msg/Image'), '~/debug_image', 2)
        self._broadcast: Broadcast | None = (
            transform_broadcaster(node) if config.publish_tf else None)

    def publish(self, result: PairResult, config: PairConfig) -> None:
        """Publish a pair; one without a pose publishes nothing."""
        if not result.pose:
            return
        messages = pair_messages(result, message_class, config.reference_frame)
        for name, publisher in self._pair.items():
            publisher.publish(getattr(messages, name))
        if self._broadcast is not None:
            self._broadcast(messages.relative_pose, result.frame_id)

    def publish_picture(self, result: PairResult, config: PairConfig) -> None:
        """Publish ~/debug_image of any pair, where somebody looks at it."""
        if config.publish_debug_image and self._debug_image.get_subscription_count():
            self._debug_image.publish(color_image_message(
                result.stamp_ns, result.frame_id, draw_debug_image(result), message_class))
