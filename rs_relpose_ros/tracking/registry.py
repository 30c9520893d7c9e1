"""The choice of a tracker."""

from __future__ import annotations

import pkgutil

from rs_relpose_ros.config.tracking import TRACKERS, TrackingConfig
from rs_relpose_ros.tracking.tracker import Tracker


def make_tracker(config: TrackingConfig) -> Tracker:
    """Tracker that `config.detector` names; its module is imported now."""
    tracker: Tracker = pkgutil.resolve_name(TRACKERS[config.detector])(config)
    return tracker
