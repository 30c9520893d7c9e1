"""gtsam, which is an extra: nothing else of the package needs it."""

from __future__ import annotations

import importlib.util

from rs_relpose_ros.errors import MissingInputError


def need_gtsam() -> None:
    """Raise MissingInputError, with how to get it, where gtsam is not installed."""
    if importlib.util.find_spec('gtsam') is None:
        raise MissingInputError("odometry needs gtsam 4.3: pip install 'rs_relpose_ros[odometry]'"
                                " (or pip install 'gtsam>=4.3,<4.4')")
