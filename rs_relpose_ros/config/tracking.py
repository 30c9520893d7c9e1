"""Defaults of the feature tracker."""

from __future__ import annotations

from dataclasses import dataclass

from rs_relpose_ros.config.declarations import check_settings, setting
from rs_relpose_ros.errors import InputError

# Tracker by name: the class that implements `rs_relpose_ros.tracking.tracker.Tracker`, imported
# when it is chosen. A new tracker is its module and a row here.
TRACKERS = {
    'klt': 'rs_relpose_ros.tracking.klt:KltTracker',
    'orb': 'rs_relpose_ros.tracking.descriptors:DescriptorTracker',
    'sift': 'rs_relpose_ros.tracking.descriptors:DescriptorTracker',
}


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """How features are found, followed and thrown away."""

    detector: str = setting(
        'klt', 'klt follows corners from frame to frame; orb and sift match descriptors, for '
        'baselines that are too wide to follow', choices=tuple(TRACKERS))
    max_features: int = setting(
        300, 'corners that a reference keyframe starts with', low=8, high=5000)
    max_descriptors: int = setting(
        1500, 'keypoints per image for orb and sift', low=8, high=20000)
    min_feature_distance: float = setting(
        10.0, 'least distance between corners', 'px', low=1.0, high=500.0)
    feature_quality: float = setting(
        4.0, 'least eigenvalue of the structure tensor of a corner, mean over its window',
        'gray^2/px^2', low=1e-3, high=1e4)
    feature_rows: tuple[float, ...] = setting(
        (0.0, 0.0), 'first and last image row that features may lie in; 0, 0 for all', 'px',
        low=0.0, high=1e5, length=2)
    klt_window: int = setting(
        15, 'side of the window of a corner, odd', 'px', low=5, high=63)
    klt_levels: int = setting(
        4, 'levels of the image pyramid', low=1, high=8)
    forward_backward_threshold: float = setting(
        0.7, 'largest distance after tracking forth and back', 'px', low=0.01, high=20.0)
    min_correlation: float = setting(
        0.75, 'least correlation of a window with that in the reference keyframe',
        low=0.0, high=1.0)
    match_ratio: float = setting(
        0.8, 'largest ratio of best to second best descriptor distance', low=0.1, high=1.0)

    def __post_init__(self) -> None:
        check_settings(self)
        if self.klt_window % 2 == 0:
            raise InputError(f'klt_window must be odd, got {self.klt_window}')
        first, last = self.feature_rows
        if last != 0.0 and last <= first:
            raise InputError('feature_rows must be first row, last row with first < last '
                             f'(0, 0 for all), got {list(self.feature_rows)}')
