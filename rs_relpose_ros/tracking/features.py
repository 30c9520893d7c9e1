"""Shi-Tomasi corners, SIFT and ORB descriptors, matches, and the protocol of a tracker."""

from __future__ import annotations

from dataclasses import dataclass
import math
import pkgutil
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from rs_relpose_ros.config.settings import TRACKERS, TrackingConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array, Flags, Indices
from rs_relpose_ros.geometry.matches import Ids, Matches
from rs_relpose_ros.jit import kernel
from rs_relpose_ros.tracking.images import checked, Image

# Side of the window [px] over which the structure tensor of the half-size image is summed. A
# smaller one finds single pixels of noise, a larger one blurs corners that lie together.
# [chosen: 5 px there are 10 px of the image, less than a window of Lucas-Kanade]
_BLOCK = 5
# Images with a side shorter than this [px] are searched at full size: of half of them little would
# be left beside the margins. [chosen: cameras of 320x240 are halved]
_SHORTEST_HALVED = 240
# OpenCV's threshold, relative to the best corner, must be positive; the one used is absolute.
# [chosen: any value below the quality of the faintest corner by the brightest one]
_ALL = 1e-9


def find_corners(
    image: Image,
    taken: Array,
    count: int,
    config: TrackingConfig,
    allowed: Image | None = None,
) -> Array:
    """At most `count` new corners (K, 2) [px], at a distance from existing ones `taken` (M, 2).

    `allowed` (H, W) is not zero where corners may lie; None allows the whole image.

    The best of each cell of a grid first, then the second best, and so on. Whole pixels: the
    accuracy of a match is that of the second point relative to the first one.
    """
    height, width = image.shape
    # Half size: less noise, and the search costs a quarter.
    scale = 2 if min(height, width) >= _SHORTEST_HALVED else 1
    if scale == 2:
        image = cv2.pyrDown(image)  # type: ignore[assignment]
    margin = -(-(config.klt_window // 2 + 2) // scale)
    if count <= 0 or min(image.shape) <= 2 * margin + _BLOCK:
        return np.empty((0, 2))
    first, last = feature_rows(config, height)
    top = max(margin, math.ceil(first / scale))
    bottom = math.floor(last / scale) + 1
    distance = config.min_feature_distance / scale
    free = np.zeros(image.shape, dtype=np.uint8)
    free[top:bottom, margin:-margin] = 255
    free[-margin:] = 0
    if allowed is not None:
        reduced = cv2.resize(allowed, free.shape[::-1], interpolation=cv2.INTER_NEAREST)
        free[reduced == 0] = 0
    _occupy(free, taken / scale, math.ceil(distance))
    points = scale * _strong_corners(
        image,
        free,
        distance,
        config.feature_quality,
    )
    cell = math.sqrt(height * width / config.max_features)
    return points[_spread(points, taken, cell)[:count]]


def _strong_corners(
    image: Image,
    free: Image,
    distance: float,
    least: float,
) -> Array:
    """Corners (N, 2) at nonzero pixels of `free` (H, W), best first, at a mutual distance.

    `least`: smallest eigenvalue of the structure tensor [gray^2/px^2].
    """
    corners, quality = cv2.goodFeaturesToTrackWithQuality(
        image, 0, _ALL, distance, free, blockSize=_BLOCK
    )
    if corners is None:
        return np.empty((0, 2))  # type: ignore[unreachable]
    # OpenCV's value is the mean of (2 dI/dx / 255)^2 over the block.
    strong = np.ravel(quality) >= least * 4.0 / 255.0**2
    return np.reshape(corners, (-1, 2))[strong].astype(np.float64)


@kernel
def _occupy(
    free: Image,
    points: Array,
    radius: int,
) -> None:
    """Clear the discs around `points` (M, 2)."""
    height, width = free.shape
    for k in range(points.shape[0]):
        x = round(points[k, 0])
        y = round(points[k, 1])
        top = max(y - radius, 0)
        left = max(x - radius, 0)
        for row in range(top, min(y + radius + 1, height)):
            for column in range(left, min(x + radius + 1, width)):
                if (column - x) ** 2 + (row - y) ** 2 <= radius * radius:
                    free[row, column] = 0


def feature_rows(
    config: TrackingConfig,
    height: int,
) -> tuple[float, float]:
    """First and last row of features."""
    first, last = config.feature_rows
    return (first, last) if last > 0.0 else (first, height - 1.0)


def within(
    points: Array,
    allowed: Image | None,
) -> Flags:
    """Mask (N,) of points (N, 2) of an image that lie where `allowed` (H, W) is not zero."""
    if allowed is None:
        return np.ones(len(points), dtype=bool)
    last = np.array(allowed.shape[::-1]) - 1
    pixels = np.rint(np.nan_to_num(points, nan=-1.0)).astype(np.int64)
    nearest = pixels.clip(0, last)
    inside = (pixels == nearest).all(axis=1)
    u, v = nearest.T
    return np.asarray(inside & (allowed[v, u] > 0))


def keep_apart(
    points: Array,
    radius: float,
) -> Flags:
    """Mask (N,) of points (N, 2) that are not within `radius` of one before them."""
    kept = np.ones(len(points), dtype=bool)
    if len(points) > 1:
        for before, after in sorted(KDTree(points).query_pairs(radius)):
            if kept[before]:
                kept[after] = False
    return kept


def _spread(
    points: Array,
    taken: Array,
    cell: float,
) -> Indices:
    """Order of `points` (N, 2), best first, that fills the cells of a grid evenly.

    A point ranks behind the better ones of its cell and behind those `taken` (M, 2) in it.
    """
    both = np.concatenate([taken, points])
    column, row = (both // cell).astype(np.int64).T
    columns = column.max(initial=0) + 1
    cells = row * columns + column
    by_cell = np.argsort(cells, kind='stable')
    _, starts, sizes = np.unique(cells[by_cell], return_index=True, return_counts=True)
    place = np.arange(len(both)) - np.repeat(starts, sizes)  # within the cell
    rank = np.empty(len(both), dtype=np.int64)
    rank[by_cell] = place
    return np.argsort(rank[len(taken) :], kind='stable')


class TrackIds:
    """Ids of tracks, counted over all resets of a tracker."""

    def __init__(self) -> None:
        self._next = 0

    def take(self, count: int) -> Ids:
        """New ids (count,); from 2^32 on they start again."""
        first = self._next
        self._next += count
        return (np.arange(first, self._next) % 2**32).astype(np.uint32)


Descriptors = NDArray[np.uint8] | NDArray[np.float32]

# Smallest side of an image [px] with descriptors: in a smaller one none has a place.
# [derived: ORB's patch of 31 px]
_SMALLEST_SIDE = 32


@dataclass(frozen=True, slots=True, eq=False)
class _Keypoints:
    """Keypoints of an image."""

    ids: Ids  # (N,)
    points: Array  # (N, 2) pixels
    descriptors: Descriptors  # (N, D)


class DescriptorTracker:
    """Mutual nearest neighbours under a ratio test; see `Tracker`. For wide baselines.

    A keypoint of a new reference keeps the id of the keypoint that it was matched with.
    """

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        if config.detector == 'sift':
            self._detector: cv2.Feature2D = cv2.SIFT.create(nfeatures=config.max_descriptors)
            self._norm = cv2.NORM_L2
            self._depth = cv2.CV_32F
        else:
            self._detector = cv2.ORB.create(nfeatures=config.max_descriptors)
            self._norm = cv2.NORM_HAMMING
            self._depth = cv2.CV_32S
        self._ids = TrackIds()
        self._allowed: Image | None = None
        self.reset()

    def allow(self, allowed: Image | None) -> None:
        """Search features where `allowed` (H, W) is not zero; None allows the whole image."""
        self._allowed = allowed

    def reset(self) -> None:
        """Forget all images; ids are not used again."""
        self._shape: tuple[int, ...] | None = None
        self._reference: _Keypoints | None = None
        self._current: _Keypoints | None = None
        self._matches = Matches.none()
        self._most = 0

    @property
    def tracked_fraction(self) -> float:
        """Matches relative to the largest number that an image had with this reference.

        Only some of the keypoints of an image are found in any other one.
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
        """None (0, 2): all keypoints of the next image are compared, at any place."""
        return np.empty((0, 2))

    def track(
        self, image: Image, predicted: Array | None = None, interval: float = 1.0
    ) -> Matches:
        """Match `image`, the new current one, with the reference."""
        if self._reference is None:
            raise InputError('the tracker has no reference keyframe: call start() first')
        reference = self._reference
        found = self._detect(checked(image, self._shape))
        indices1, indices2, quality = self._match(reference, found)
        ids = reference.ids[indices1]
        # A matched keypoint takes the id of the reference.
        found.ids[indices2] = ids
        points = np.stack([reference.points[indices1], found.points[indices2]])
        self._current = found
        self._matches = Matches(ids, points, quality)
        self._most = max(self._most, len(self._matches))
        return self._matches

    def refined_matches(self) -> Matches:
        """The matches of the current image: descriptors do not drift."""
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
        no_descriptors = np.empty((0, 0), dtype=np.uint8)
        nothing = _Keypoints(self._ids.take(0), np.empty((0, 2)), no_descriptors)
        if min(image.shape) < _SMALLEST_SIDE:
            return nothing
        keypoints, descriptors = self._detector.detectAndCompute(image, None)
        if not keypoints:
            return nothing
        points = np.array([k.pt for k in keypoints], dtype=np.float64)
        rows = points[:, 1]
        first, last = feature_rows(self._config, image.shape[0])
        in_rows = (rows >= first) & (rows <= last)
        # One keypoint a place: SIFT repeats a place with several orientations.
        _, once = np.unique(points, axis=0, return_index=True)
        is_first = np.zeros(len(points), dtype=bool)
        is_first[once] = True
        kept = in_rows & is_first & within(points, self._allowed)
        ids = self._ids.take(int(kept.sum()))
        chosen: Descriptors = np.ascontiguousarray(descriptors[kept])  # type: ignore[assignment]
        return _Keypoints(ids, points[kept], chosen)

    def _match(
        self,
        first: _Keypoints,
        second: _Keypoints,
    ) -> tuple[Indices, Indices, Array]:
        """Indices into both and quality: 1 - (best / second best distance)."""
        if len(first.ids) < 2 or len(second.ids) < 2:
            nothing = np.empty(0, dtype=np.int64)
            return nothing, nothing, np.empty(0)
        distances, nearest = self._nearest(first.descriptors, second.descriptors, 2)
        best, other = distances.T
        # Two equally good neighbours, even perfect ones, are no match.
        ratio = np.divide(
            best,
            other,
            out=np.ones_like(best),
            where=other > 0.0,
        )
        matched = np.flatnonzero(ratio < self._config.match_ratio)
        partners = nearest[matched, 0]
        if len(matched):
            _, back = self._nearest(second.descriptors[partners], first.descriptors, 1)
            mutual = back[:, 0] == matched
            matched = matched[mutual]
            partners = partners[mutual]
        return matched, partners, 1.0 - ratio[matched]

    def _nearest(
        self, first: Descriptors, second: Descriptors, count: int
    ) -> tuple[Array, Indices]:
        """Distances (N, count) and indices (N, count) of the nearest in `second`."""
        distances, indices = cv2.batchDistance(
            first, second, self._depth, normType=self._norm, K=count
        )
        return distances.astype(np.float64), indices.astype(np.int64)


class Tracker(Protocol):
    """Finds features of the reference keyframe in later images.

    All images between two resets have one size, otherwise InputError is raised.
    """

    @property
    def tracked_fraction(self) -> float:
        """Share of the reference's features that are still tracked."""

    def allow(self, allowed: Image | None) -> None:
        """Search features where `allowed` (H, W) is not zero; None allows the whole image."""

    def start(self, image: Image) -> None:
        """Make `image` (H, W) the reference keyframe."""

    @property
    def points(self) -> Array:
        """Points (N, 2) of the current image [px] that `track` searches in the next one.

        None (0, 2) if the search is not local and needs no prediction.
        """

    def track(
        self, image: Image, predicted: Array | None = None, interval: float = 1.0
    ) -> Matches:
        """Make `image` (H, W) the current one; its matches with the reference.

        `predicted` (N, 2) [px]: expected places of `points` in `image`, NaN if unknown. The part
        of a track's motion beyond the prediction is extrapolated in proportion to `interval`,
        the time since the image before in any unit.
        """

    def refined_matches(self) -> Matches:
        """Matches of a keyframe pair at the best accuracy."""

    def promote(self) -> None:
        """Make the current image the reference; tracks keep their ids."""

    def reset(self) -> None:
        """Forget all images; ids are not used again."""


def make_tracker(config: TrackingConfig) -> Tracker:
    """Tracker that `config.detector` names; its module is imported now."""
    tracker: Tracker = pkgutil.resolve_name(TRACKERS[config.detector])(config)
    return tracker
