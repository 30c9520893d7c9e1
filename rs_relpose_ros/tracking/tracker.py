"""What a tracker does, and the choice of one."""

from __future__ import annotations

import pkgutil
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.tracking import TRACKERS, TrackingConfig
from rs_relpose_ros.tracking.images import Image
from rs_relpose_ros.tracking.matches import Matches

Array = NDArray[np.float64]


class Tracker(Protocol):
    """Finds again in later images what the reference keyframe shows.

    All images between two resets have one size; another one raises InputError.
    """

    @property
    def tracked_fraction(self) -> float:
        """Share of the reference's features that the current image still shows."""

    def start(self, image: Image) -> None:
        """Make `image` (H, W) the reference keyframe."""

    @property
    def points(self) -> Array:
        """Points (N, 2) of the current image [px] that `track` will look for in the next one.

        None (0, 2) where the search is not local and a prediction is of no use.
        """

    def track(self, image: Image, predicted: Array | None = None,
              interval: float = 1.0) -> Matches:
        """Make `image` (H, W) the current one; its matches with the reference.

        `predicted` (N, 2) [px] is where each of `points` is expected in `image`, NaN where that is
        unknown. The part of a track's motion that was not predicted is extrapolated in proportion
        to `interval`, the time since the image before in any unit.
        """

    def refined_matches(self) -> Matches:
        """Matches of reference and current image, as exact as they get; for a closing pair."""

    def promote(self) -> None:
        """Make the current image the reference; tracks go on under their ids."""

    def reset(self) -> None:
        """Forget all images; ids are not used again."""


def make_tracker(config: TrackingConfig) -> Tracker:
    """Tracker that `config.detector` names; its module is imported now."""
    tracker: Tracker = pkgutil.resolve_name(TRACKERS[config.detector])(config)
    return tracker
