"""Chain the relative poses of relpose_node into a path, in units of the first pair's baseline."""

# python3 docs/examples/chain_poses.py --ros-args -r __ns:=/relpose_node

from contextlib import suppress

from nav_msgs.msg import Path
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from rs_relpose_ros import PairSynchronizer, PoseChain
from rs_relpose_ros.messages.outgoing import PAIR_TOPICS, pose_stamped_message
from rs_relpose_ros.nodes.inputs import message_class


class PathNode(Node):
    """Publishes ~/path; logs each restart of the path."""

    def __init__(self):
        super().__init__('pose_chain')
        self.pairs = PairSynchronizer()
        self.chain = PoseChain()
        self.path, self.publisher = Path(), self.create_publisher(Path, '~/path', 10)
        for topic, kind in PAIR_TOPICS.items():
            self.create_subscription(
                message_class(kind), topic, lambda m, topic=topic: self.receive(topic, m), 10
            )

    def receive(self, topic, message):
        """Extend the path where the message completes a pair."""
        pair = self.pairs.add(topic, message)
        if pair is None:
            return
        step = self.chain.add(pair)
        if step.new_path:
            self.get_logger().warning(step.new_path)
            self.path.poses = []
        if not step.poses:
            return
        self.path.poses += [
            pose_stamped_message(pose.stamp_ns, 'path', pose.R, pose.position, message_class)
            for pose in step.poses
        ]
        self.path.header = self.path.poses[-1].header
        self.publisher.publish(self.path)


if __name__ == '__main__':
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(PathNode())
