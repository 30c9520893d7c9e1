"""Metric odometry: pairs and IMU samples in one graph. Needs gtsam, an extra."""

import importlib.util

from rs_relpose_ros.errors import MissingInputError


def need_gtsam() -> None:
    """Raise MissingInputError, with the command to install it, if gtsam is missing."""
    if importlib.util.find_spec('gtsam') is None:
        raise MissingInputError(
            "odometry needs gtsam 4.3: pip install 'rs_relpose_ros[odometry]',"
            " on a ROS machine pip install --no-deps 'gtsam>=4.3,<4.4' in a "
            'venv (docs/odometry.md)'
        )
