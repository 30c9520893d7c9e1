"""~/odometry of odometry_node to PX4: axes forward, right, down in place of forward, left, up."""

# python3 docs/examples/px4_odometry.py --ros-args -r odometry:=/odometry_node/odometry
# Needs px4_msgs; parameters of PX4: docs/odometry.md.

from contextlib import suppress

from nav_msgs.msg import Odometry
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from scipy.spatial.transform import Rotation

SIGNS = np.array([1.0, -1.0, -1.0])
# Pause of the states after which they are of another path [us]: it was lost in between.
PAUSE = 500_000


def px4_fields(odometry):
    """Fields of px4_msgs/VehicleOdometry without frames and `timestamp`, float32 as there."""
    stamp = odometry.header.stamp
    pose = odometry.pose.pose
    twist = odometry.twist.twist
    q = pose.orientation
    R = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    of_pose, of_twist = (
        np.reshape(part.covariance, (6, 6)) for part in (odometry.pose, odometry.twist)
    )
    values = {
        'position': SIGNS * [getattr(pose.position, axis) for axis in 'xyz'],
        'q': [q.w, q.x, -q.y, -q.z],
        'velocity': SIGNS * [getattr(twist.linear, axis) for axis in 'xyz'],
        'angular_velocity': SIGNS * [getattr(twist.angular, axis) for axis in 'xyz'],
        'position_variance': np.diag(of_pose)[:3],
        'orientation_variance': np.diag(R.T @ of_pose[3:, 3:] @ R),
        'velocity_variance': np.diag(of_twist)[:3],
    }
    return {
        'timestamp_sample': stamp.sec * 10**6 + stamp.nanosec // 1000,
        **{name: np.float32(value) for name, value in values.items()},
    }


class Px4Node(Node):
    """Publishes /fmu/in/vehicle_visual_odometry."""

    def __init__(self):
        super().__init__('px4_odometry')
        self.last = None
        self.resets = 0
        from px4_msgs.msg import VehicleOdometry

        self.kind = VehicleOdometry
        self.publisher = self.create_publisher(
            VehicleOdometry, '/fmu/in/vehicle_visual_odometry', qos_profile_sensor_data
        )
        self.create_subscription(Odometry, 'odometry', self.receive, 10)

    def receive(self, odometry):
        """Publish a state in the axes of PX4."""
        fields = px4_fields(odometry)
        last = self.last
        self.last = fields['timestamp_sample']
        self.resets += last is not None and not 0 < self.last - last < PAUSE
        self.publisher.publish(
            self.kind(
                timestamp=self.get_clock().now().nanoseconds // 1000,
                pose_frame=self.kind.POSE_FRAME_FRD,
                velocity_frame=self.kind.VELOCITY_FRAME_BODY_FRD,
                reset_counter=self.resets % 256,
                **fields,
            )
        )


if __name__ == '__main__':
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Px4Node())
