"""Metric odometry: pairs and IMU samples in one graph. Needs gtsam, an extra."""
