"""Metric odometry: pairs and IMU samples in one graph. Needs gtsam, an extra."""

import importlib.util

from rs_relpose_ros.errors import MissingInputError


def need_gtsam() -> None:
    """Raise MissingInputError, with the command to install it, if gtsam is missing."""
    if importlib.util.find_spec('gtsam') is None:
        raise MissingInputError(
            "odometry needs gtsam 4.3: pip install 'gtsam>=4.3,<4.4', on a ROS machine with "
            '--no-deps in a venv (docs/odometry.md)'
        )
