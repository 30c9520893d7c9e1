"""Matches of SIFT or ORB descriptors: for baselines over which corners cannot be followed."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.tracking.corners import feature_rows
from rs_relpose_ros.tracking.images import checked, Image
from rs_relpose_ros.tracking.matches import Matches, TrackIds

Array = NDArray[np.float64]
Descriptors = NDArray[np.uint8] | NDArray[np.float32]

# ORB's patch and its border; below that it has nothing to describe.
_SMALLEST_SIDE = 32


@dataclass(frozen=True, slots=True, eq=False)
class _Keypoints:
    """Keypoints of an image: ids (N,), pixels (N, 2), descriptors (N, D)."""

    ids: NDArray[np.uint32]
    points: Array
    descriptors: Descriptors


class DescriptorTracker:
    """Mutual nearest neighbours under a ratio test; see `rs_relpose_ros.tracking.tracker.Tracker`.

    A keypoint of a new reference keeps the id of the keypoint that it was matched with.
    """

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        if config.detector == 'sift':
            self._detector: cv2.Feature2D = cv2.SIFT.create(nfeatures=config.max_descriptors)
            self._norm, self._depth = cv2.NORM_L2, cv2.CV_32F
        else:
            self._detector = cv2.ORB.create(nfeatures=config.max_descriptors)
            self._norm, self._depth = cv2.NORM_HAMMING, cv2.CV_32S
        self._ids = TrackIds()
        self.reset()

    def reset(self) -> None:
        """Forget all images; ids are not used again."""
        self._shape: tuple[int, ...] | None = None
        self._reference: _Keypoints | None = None
        self._current: _Keypoints | None = None
        self._matches = Matches.none()
        self._most = 0

    @property
    def tracked_fraction(self) -> float:
        """Matches, as a share of the most that an image had with this reference.

        Only some of the keypoints of an image are found again in any other one.
        """
        return len(self._matches) / self._most if self._most else 0.0

    def start(self, image: Image) -> None:
        """Make `image` (H, W) the reference keyframe."""
        image = checked(image, self._shape)
        self.reset()
        self._shape = image.shape
        self._reference = self._current = self._detect(image)

    @property
    def points(self) -> Array:
        """None (0, 2): all keypoints of the next image are compared, wherever they lie."""
        return np.empty((0, 2))

    def track(self, image: Image, predicted: Array | None = None,
              interval: float = 1.0) -> Matches:
        """Match `image`, which then is the current one, with the reference."""
        if self._reference is None:
            raise InputError('the tracker has no reference keyframe: call start() first')
        image = checked(image, self._shape)
        found = self._detect(image)
        indices1, indices2, quality = self._match(self._reference, found)
        # What is matched takes over the reference's id.
        found.ids[indices2] = self._reference.ids[indices1]
        self._current = found
        self._matches = Matches(self._reference.ids[indices1], self._reference.points[indices1],
                                found.points[indices2], quality)
        self._most = max(self._most, len(self._matches))
        return self._matches

    def refined_matches(self) -> Matches:
        """The matches of the current image: each stands for itself, nothing has drifted."""
        return self._matches

    def promote(self) -> None:
        """Make the current image the reference."""
        if self._current is None:
            raise InputError('the tracker has no current image: call start() first')
        self._reference = self._current
        self._matches = Matches.none()
        self._most = 0

    # -- inside ------------------------------------------------------------------------------

    def _detect(self, image: Image) -> _Keypoints:
        nothing = _Keypoints(self._ids.take(0), np.empty((0, 2)), np.empty((0, 0), dtype=np.uint8))
        if min(image.shape) < _SMALLEST_SIDE:
            return nothing
        keypoints, descriptors = self._detector.detectAndCompute(image, None)
        if not keypoints:
            return nothing
        points = np.array([k.pt for k in keypoints], dtype=np.float64)
        first, last = feature_rows(self._config, image.shape[0])
        # One keypoint per place: SIFT gives a place with several orientations several times.
        _, once = np.unique(points, axis=0, return_index=True)
        kept = np.sort(once)
        kept = kept[(points[kept, 1] >= first) & (points[kept, 1] <= last)]
        return _Keypoints(self._ids.take(len(kept)), points[kept],
                          np.ascontiguousarray(descriptors[kept]))

    def _match(self, first: _Keypoints,
               second: _Keypoints) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        """Indices into both and quality: 1 - (best / second best distance)."""
        if len(first.ids) < 2 or len(second.ids) < 2:
            return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0)
        distances, nearest = self._nearest(first.descriptors, second.descriptors, 2)
        best, other = distances[:, 0], distances[:, 1]
        # Two equally good ones, be they perfect, are no match.
        ratio = np.divide(best, other, out=np.ones_like(best), where=other > 0.0)
        matched = np.flatnonzero(ratio < self._config.match_ratio)
        partners = nearest[matched, 0]
        if len(matched):
            _, back = self._nearest(second.descriptors[partners], first.descriptors, 1)
            mutual = back[:, 0] == matched
            matched, partners = matched[mutual], partners[mutual]
        return matched, partners, 1.0 - ratio[matched]

    def _nearest(self, first: Descriptors, second: Descriptors,
                 count: int) -> tuple[Array, NDArray[np.int64]]:
        """Distances (N, count) and indices (N, count) of the nearest in `second`."""
        distances, indices = cv2.batchDistance(first, second, self._depth, normType=self._norm,
                                               K=count)
        return distances.astype(np.float64), indices.astype(np.int64)
