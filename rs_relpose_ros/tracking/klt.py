"""Corners followed from frame to frame, and at last compared with the reference keyframe."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.tracking.alignment import align
from rs_relpose_ros.tracking.config import TrackingConfig
from rs_relpose_ros.tracking.corners import feature_rows, find_corners, keep_apart
from rs_relpose_ros.tracking.images import checked, Image, pyramid
from rs_relpose_ros.tracking.matches import Matches
from rs_relpose_ros.tracking.tracker import Predict

Array = NDArray[np.float64]

_ITERATIONS = 10
# Last step [px]: of coarse levels, from frame to frame, and against the reference.
_COARSE_TOLERANCE = 0.1
_FOLLOW_TOLERANCE = 0.03
_FINE_TOLERANCE = 0.01
# Corrections of the guess [px] that one level makes up for.
_NEAR = 2.0
# Correlation with the previous frame; the stricter one is with the reference.
_MIN_STEP_CORRELATION = 0.6
# The comparison with the reference corrects drift; what it moves further was lost before.
_LARGEST_CORRECTION = 3.0
_NO_WARPS = np.empty((0, 2, 2))


class KltTracker:
    """Lucas-Kanade tracking of Shi-Tomasi corners; see `rs_relpose_ros.tracking.tracker.Tracker`.

    From frame to frame windows hardly change, so that tracks live long, but errors add up. When a
    pair closes each window is aligned once more with that of the reference keyframe, turned and
    scaled as the tracks tell: that leaves the error of a single alignment.
    """

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._half = config.klt_window // 2
        # Room for the margin of the gradient and for the neighbours of the interpolation.
        self._padding = self._half + 3
        self._next_id = 0
        self.reset()

    def reset(self) -> None:
        """Forget all images; ids are not used again."""
        self._reference: list[Image] = []
        self._current: list[Image] = []
        self._set(np.empty(0, dtype=np.uint32), np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
        self._started = 0
        self._refined = False

    @property
    def tracked_fraction(self) -> float:
        """Share of the reference's corners that are still tracked."""
        return len(self._ids) / self._started if self._started else 0.0

    def start(self, image: Image) -> None:
        """Make `image` (H, W) the reference keyframe, with new corners only."""
        image = checked(image, self._current[0].shape if self._current else None)
        self.reset()
        self._current = self._pyramid(image)
        self._renew()

    def track(self, image: Image, predict: Predict | None = None) -> Matches:
        """Follow the corners from the current image into `image`, which then is the current one.

        Parameters
        ----------
        image : (H, W) ndarray of uint8
        predict : callable, optional
            Maps points of the previous image to where they are expected in this one.
        """
        if not self._current:
            raise InputError('the tracker has no reference keyframe: call start() first')
        previous, points = self._current, self._points
        current = self._pyramid(checked(image, previous[0].shape))
        found = points.copy()
        if predict is not None and len(points):
            guess = np.asarray(predict(points), dtype=np.float64)
            found = np.where(np.isfinite(guess).all(axis=1, keepdims=True), guess, points)
        guess = found.copy()
        correlation = self._follow(previous, current, points, found, len(current))
        # The way back starts as far off as the way forth did: the guess must not be the answer.
        back = points + (found - guess)
        far = np.linalg.norm(found - guess, axis=1) > _NEAR
        back_correlation = np.empty(len(points))
        for mask, levels in ((far, len(current)), (~far, 1)):
            partial = back[mask]
            back_correlation[mask] = self._follow(current, previous, found[mask], partial, levels)
            back[mask] = partial
        first, last = feature_rows(self._config, image.shape[0])
        good = ((correlation >= _MIN_STEP_CORRELATION)
                & (back_correlation >= _MIN_STEP_CORRELATION)
                & (np.linalg.norm(back - points, axis=1)
                   <= self._config.forward_backward_threshold)
                & (found[:, 1] >= first) & (found[:, 1] <= last))
        self._set(self._ids[good], self._reference_points[good], found[good],
                  np.minimum(self._quality, correlation)[good])
        self._current = current
        self._refined = False
        return self._matches()

    def refined_matches(self) -> Matches:
        """Matches whose windows were aligned with the reference's own."""
        if not self._refined and len(self._ids) and self._current is not self._reference:
            found = self._points.copy()
            correlation, eigenvalue = align(
                self._reference[0], self._current[0], self._reference_points, found,
                _warps(self._reference_points, self._points), self._half, _ITERATIONS,
                _FINE_TOLERANCE)
            good = ((correlation >= self._config.min_correlation)
                    & (np.linalg.norm(found - self._points, axis=1) <= _LARGEST_CORRECTION))
            # A faint corner is worth less than a strong one of the same correlation.
            quality = correlation * eigenvalue / (eigenvalue + self._config.feature_quality)
            self._set(self._ids[good], self._reference_points[good], found[good], quality[good])
        self._refined = True
        return self._matches()

    def promote(self) -> None:
        """Make the current image the reference; tracks go on, new corners fill the gaps."""
        if not self._current:
            raise InputError('the tracker has no current image: call start() first')
        self._renew()

    # -- inside ------------------------------------------------------------------------------

    def _pyramid(self, image: Image) -> list[Image]:
        return pyramid(image, self._config.klt_levels, self._padding)

    def _follow(self, first: list[Image], second: list[Image], points1: Array, points2: Array,
                levels: int) -> Array:
        """Improve `points2` (N, 2) in place, from coarse to fine; the correlations (N,)."""
        correlation = np.empty(0)
        for level in reversed(range(levels)):
            padding, scale = (self._padding, 2.0**-level) if level else (0, 1.0)
            scaled = points2 * scale + padding
            correlation, _ = align(
                first[level], second[level], points1 * scale + padding, scaled, _NO_WARPS,
                self._half, _ITERATIONS, _COARSE_TOLERANCE if level else _FOLLOW_TOLERANCE)
            points2[:] = (scaled - padding) / scale
        return correlation

    def _renew(self) -> None:
        height, width = self._current[0].shape
        # Of tracks that ran together the oldest stays.
        apart = keep_apart(self._points, 0.5 * self._config.min_feature_distance, height, width)
        kept = self._points[apart]
        new = find_corners(self._current[0], kept, self._config.max_features - len(kept),
                           self._config)
        ids = np.concatenate([self._ids[apart], (
            np.arange(self._next_id, self._next_id + len(new)) % 2**32).astype(np.uint32)])
        self._next_id += len(new)
        points = np.concatenate([kept, new])
        self._set(ids, points, points.copy(), np.ones(len(points)))
        self._started = len(points)
        self._reference = self._current
        self._refined = False

    def _set(self, ids: NDArray[np.uint32], reference_points: Array, points: Array,
             quality: Array) -> None:
        self._ids, self._reference_points = ids, reference_points
        self._points, self._quality = points, quality

    def _matches(self) -> Matches:
        # Copies: the tracker goes on, the matches do not change.
        return Matches(self._ids.copy(), self._reference_points.copy(), self._points.copy(),
                       self._quality.copy())


def _warps(points1: Array, points2: Array) -> Array:
    """Derivatives (N, 2, 2) of the homography that fits all tracks; empty where none does."""
    if len(points1) < 8:
        return _NO_WARPS
    # None, where there is none, becomes an array without shape.
    H = np.asarray(cv2.findHomography(points1, points2, method=0)[0], dtype=np.float64)
    if H.shape != (3, 3):
        return _NO_WARPS
    x, y = points1[:, 0], points1[:, 1]
    scale = H[2, 0] * x + H[2, 1] * y + H[2, 2]
    with np.errstate(all='ignore'):
        u = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / scale
        v = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / scale
        warps = np.empty((len(points1), 2, 2))
        for row, value in enumerate((u, v)):
            for column in range(2):
                warps[:, row, column] = (H[row, column] - value * H[2, column]) / scale
        area = np.linalg.det(warps)
    # A fit that stretches this much is none.
    wild = ~(np.isfinite(warps).all(axis=(1, 2)) & (area > 0.25) & (area < 4.0)
             & (np.abs(warps).max(axis=(1, 2)) < 3.0))
    warps[wild] = np.eye(2)
    return warps
