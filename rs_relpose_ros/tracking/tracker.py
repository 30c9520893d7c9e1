"""What a tracker does."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.tracking.matches import Matches

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Points (N, 2) of the previous image -> (N, 2) where they are expected now; NaN where unknown.
Predict = Callable[[Array], Array]


class Tracker(Protocol):
    """Finds again in later images what the reference keyframe shows.

    All images between two resets have one size; another one raises InputError.
    """

    @property
    def tracked_fraction(self) -> float:
        """Share of the reference's features that the current image still shows."""

    def start(self, image: Image) -> None:
        """Make `image` (H, W) the reference keyframe."""

    def track(self, image: Image, predict: Predict | None = None,
              interval: float = 1.0) -> Matches:
        """Make `image` the current one; its matches with the reference."""

    def refined_matches(self) -> Matches:
        """Matches of reference and current image, as exact as they get; for a closing pair."""

    def promote(self) -> None:
        """Make the current image the reference; tracks go on under their ids."""

    def reset(self) -> None:
        """Forget all images; ids are not used again."""
