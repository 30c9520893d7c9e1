"""Chain the relative poses of relpose_node into a path, in units of the first pair's baseline.

    python3 docs/examples/chain_poses.py --ros-args -r __ns:=/relpose_node

Two views show no scale. But the current camera of a pair is the reference of the next, and many
tracks are seen in both: the ratio of their depths there is the ratio of the two baselines.
"""

from contextlib import suppress

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Path
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2, TimeReference

FEWEST_SHARED_TRACKS = 8
TOPICS = {'relative_pose': PoseWithCovarianceStamped, 'reference': TimeReference,
          'velocity': TwistWithCovarianceStamped, 'matches': PointCloud2}


def vector(v):
    """A point or vector message as an array."""
    return np.array([v.x, v.y, v.z])


def track_depths(R, t, velocity, matches):
    """Depths of the tracks in both cameras [baselines]: id -> (in reference, in current)."""
    m = np.frombuffer(matches.data, np.dtype([(f.name, '<u4' if f.name == 'id' else '<f4')
                                              for f in matches.fields]))
    f1, f2 = (np.stack([m[a + n] for a in 'xyz'], axis=1).astype(float) for n in '12')
    # The camera moves on while the rows are read: each match has a baseline of its own.
    t = t + np.outer(m['tau2'] - m['tau1'], R @ velocity)
    f2 = f2 @ R.T
    # d1 f1 = d2 f2 + t, in the sense of least squares.
    c = np.sum(f1 * f2, axis=1)
    a, b = np.sum(f1 * t, axis=1), np.sum(f2 * t, axis=1)
    with np.errstate(divide='ignore', invalid='ignore'):
        d1, d2 = (a - c * b) / (1.0 - c * c), (c * a - b) / (1.0 - c * c)
    good = (d1 > 0.0) & (d2 > 0.0)
    return dict(zip(m['id'][good].tolist(), zip(d1[good], d2[good], strict=True), strict=True))


class PoseChain(Node):
    """Publishes ~/path; says where it has to start anew."""

    def __init__(self):
        super().__init__('pose_chain')
        self.parts, self.path = {}, self.create_publisher(Path, '~/path', 10)
        self.start_anew()
        for name, kind in TOPICS.items():
            self.create_subscription(kind, name, lambda m, n=name: self.collect(n, m), 100)

    def start_anew(self):
        """The world is the next pair's reference camera, its baseline the unit."""
        self.R, self.p, self.scale, self.end, self.depths = np.eye(3), np.zeros(3), 1.0, None, {}
        self.poses = [PoseStamped()]
        self.poses[0].pose.orientation.w = 1.0

    def collect(self, name, message):
        """The four messages of a pair carry the same stamp."""
        key = message.header.stamp.sec, message.header.stamp.nanosec
        self.parts.setdefault(key, {})[name] = message
        if len(self.parts[key]) == len(TOPICS):
            self.extend(**self.parts[key])
            self.parts.clear()   # of earlier pairs nothing more comes

    def extend(self, relative_pose, reference, velocity, matches):
        """Append a pair to the path."""
        pose, q = relative_pose.pose.pose, relative_pose.pose.pose.orientation
        R, t = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), vector(pose.position)
        depths = track_depths(R, t, vector(velocity.twist.twist.linear), matches)
        shared = [self.depths[k][1] / depths[k][0] for k in depths.keys() & self.depths.keys()]
        if self.end is not None and reference.time_ref != self.end:
            self.get_logger().warning('a pair is missing: the path starts anew, at another scale')
            self.start_anew()
        elif self.end is not None and len(shared) < FEWEST_SHARED_TRACKS:
            self.get_logger().warning(f'{len(shared)} shared tracks do not carry the scale: the '
                                      'path starts anew')
            self.start_anew()
        elif self.end is not None:
            self.scale *= float(np.median(shared))
        self.p, self.R = self.p + self.scale * self.R @ t, self.R @ R
        self.end, self.depths = relative_pose.header.stamp, depths
        at = PoseStamped(header=relative_pose.header)
        at.header.frame_id = 'path'
        at.pose.position.x, at.pose.position.y, at.pose.position.z = self.p.tolist()
        q = at.pose.orientation
        q.x, q.y, q.z, q.w = Rotation.from_matrix(self.R).as_quat().tolist()
        self.poses.append(at)
        if len(self.poses) == 2:
            self.poses[0].header.frame_id, self.poses[0].header.stamp = 'path', reference.time_ref
        self.path.publish(Path(header=at.header, poses=self.poses))


if __name__ == '__main__':
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(PoseChain())
