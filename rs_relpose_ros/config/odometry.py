"""Metric odometry: the settings of odometry_node and `rs_relpose odometry`."""

from __future__ import annotations

from dataclasses import dataclass

from rs_relpose_ros.config.declarations import check_settings, setting


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    """The graph of keyframes, when it starts and ends, and what is published."""

    odometry_frame: str = setting(
        'odom', 'frame_id of the odometry: z up, origin and heading those of the first keyframe')
    odometry_rate: float = setting(
        30.0, 'rate at which the IMU carries the newest keyframe on to be published', 'Hz',
        low=0.0, high=1000.0)
    publish_odometry_tf: bool = setting(
        False, 'broadcast the camera as a child of odometry_frame on /tf; needs tf2_ros')
    smoothing_lag: float = setting(
        4.0, 'length of the window of keyframes that is optimised', 's', low=0.5, high=60.0)
    max_scale_sigma: float = setting(
        0.1, 'relative uncertainty of the speed below which odometry starts', low=1e-3, high=1.0)
    max_coast: float = setting(
        2.0, 'longest time on the IMU alone, without a pair; then it starts anew', 's', low=0.1,
        high=60.0)
    gyro_bias_walk: float = setting(
        2e-5, 'random walk of the gyro bias', 'rad/s^2/sqrt(Hz)', low=1e-9, high=0.1)
    accel_bias_walk: float = setting(
        1e-3, 'random walk of the accelerometer bias', 'm/s^3/sqrt(Hz)', low=1e-9, high=1.0)
    pure_rotation_motion: float = setting(
        0.02, 'largest displacement of a pair without visible translation, 1 sigma per axis: the '
        'noise of a match times the distance of the scene', 'm', low=1e-3, high=1e3)

    def __post_init__(self) -> None:
        check_settings(self)
