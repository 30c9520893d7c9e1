"""Metric odometry: pairs and IMU samples in one graph. Needs gtsam, an extra."""

from __future__ import annotations

import importlib.util

from rs_relpose_ros.errors import MissingInputError


def need_gtsam() -> None:
    """Raise MissingInputError, with the command to install it, if gtsam is missing."""
    if importlib.util.find_spec('gtsam') is None:
        raise MissingInputError("odometry needs gtsam 4.3: pip install 'rs_relpose_ros[odometry]'"
                                " (or pip install 'gtsam>=4.3,<4.4')")
