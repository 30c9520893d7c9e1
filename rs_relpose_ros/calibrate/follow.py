"""Points followed through the images of a recording, by the chosen tracker."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibrate.tracks import Tracks
from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.tracking.tracker import make_tracker

Array = NDArray[np.float64]

# The current image becomes the reference when this share of the points is left, or after so many
# images.
_KEPT, _RENEWED_AFTER = 0.8, 30


class PointFollower:
    """Follows points from image to image and keeps where they were seen."""

    def __init__(self, tracking: TrackingConfig) -> None:
        self._tracker = make_tracker(tracking)
        self._started = False
        self._since_renewed = 0
        self._stamps: list[int] = []
        self._ids: list[NDArray[np.uint32]] = []
        self._points: list[Array] = []

    def __len__(self) -> int:
        """Images so far."""
        return len(self._stamps)

    @property
    def last_stamp_ns(self) -> int | None:
        """Stamp of the last image."""
        return self._stamps[-1] if self._stamps else None

    def restart(self) -> None:
        """Follow nothing into the next image: images in between were left out."""
        self._started = False

    def add(self, stamp_ns: int, image: NDArray[np.uint8]) -> int:
        """Follow all points into an image (H, W), and return how many were."""
        if not self._started:
            self._tracker.start(image)
            self._started = True
            self._since_renewed = 0
        # Matches with the reference, so that errors do not add up from frame to frame.
        self._tracker.track(image)
        matches = self._tracker.refined_matches()
        self._since_renewed += 1
        if self._tracker.tracked_fraction < _KEPT or self._since_renewed >= _RENEWED_AFTER:
            self._tracker.promote()
            self._since_renewed = 0
        self._stamps.append(stamp_ns)
        self._ids.append(matches.track_ids)
        self._points.append(matches.points2)
        return len(matches.points2)

    def tracks(self, to_sensor: Callable[[Array], Array] | None) -> Tracks:
        """All that was seen, by stamp; of images with the same stamp the first.

        `to_sensor` maps points (N, 2) of the images to pixels of the full sensor; None where they
        are that.
        """
        stamps, kept = np.unique(np.array(self._stamps, dtype=np.int64), return_index=True)
        ids = [self._ids[k] for k in kept]
        frames = np.repeat(np.arange(len(stamps)), [len(some) for some in ids])
        points = np.concatenate([np.empty((0, 2)), *(self._points[k] for k in kept)])
        return Tracks(stamps, frames, np.concatenate(
            [np.empty(0, dtype=np.int64), *(some.astype(np.int64) for some in ids)]),
            points if to_sensor is None else to_sensor(points))
