"""The choice of a tracker."""

from __future__ import annotations

from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.tracking.descriptors import DescriptorTracker
from rs_relpose_ros.tracking.klt import KltTracker
from rs_relpose_ros.tracking.tracker import Tracker


def make_tracker(config: TrackingConfig) -> Tracker:
    """The tracker that `config.detector` names."""
    return KltTracker(config) if config.detector == 'klt' else DescriptorTracker(config)
