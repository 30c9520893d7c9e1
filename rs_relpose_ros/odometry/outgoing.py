"""Odometry as messages of ROS."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.messages.outgoing import (
    header,
    MessageTypes,
    pose_stamped_message,
    published_covariance,
    vector_message,
)
from rs_relpose_ros.odometry.odometry import Odometry

Array = NDArray[np.float64]


def odometry_message(odometry: Odometry, frame: str, types: MessageTypes) -> Any:
    """nav_msgs/Odometry: the camera in `frame`, its twist in its own axes."""
    pose = pose_stamped_message(odometry.stamp_ns, frame, odometry.R, odometry.position, types)
    twist = types('geometry_msgs/msg/Twist')(
        linear=vector_message(odometry.velocity, types),
        angular=vector_message(odometry.angular_velocity, types))
    return types('nav_msgs/msg/Odometry')(
        header=pose.header, child_frame_id=odometry.frame_id,
        pose=types('geometry_msgs/msg/PoseWithCovariance')(
            pose=pose.pose, covariance=published_covariance(odometry.pose_covariance)),
        twist=types('geometry_msgs/msg/TwistWithCovariance')(
            twist=twist, covariance=published_covariance(odometry.velocity_covariance)))


def transform_message(odometry: Odometry, frame: str, types: MessageTypes) -> Any:
    """geometry_msgs/TransformStamped from `frame` to the camera."""
    pose = pose_stamped_message(odometry.stamp_ns, frame, odometry.R, odometry.position, types)
    return types('geometry_msgs/msg/TransformStamped')(
        header=pose.header, child_frame_id=odometry.frame_id,
        transform=types('geometry_msgs/msg/Transform')(
            translation=vector_message(odometry.position, types),
            rotation=pose.pose.orientation))


def path_message(poses: list[Any], stamp_ns: int, frame: str, types: MessageTypes) -> Any:
    """nav_msgs/Path of geometry_msgs/PoseStamped."""
    return types('nav_msgs/msg/Path')(header=header(stamp_ns, frame, types), poses=poses)
