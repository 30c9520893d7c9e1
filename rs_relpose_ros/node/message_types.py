"""rclpy's message classes by type name."""

from __future__ import annotations

import functools
import importlib
from typing import Any

from rs_relpose_ros.errors import MissingInputError


@functools.cache
def message_class(msgtype: str) -> Any:
    """Class of a message type name such as ``'sensor_msgs/msg/Imu'``."""
    package, _, name = msgtype.split('/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError):
        raise MissingInputError(f'message type {msgtype} is not installed; install its package, '
                                'or choose other topics') from None
