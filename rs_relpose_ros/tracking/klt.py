"""Corners followed from frame to frame, and at last compared with the reference keyframe."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.tracking.corners import feature_rows, find_corners, keep_apart
from rs_relpose_ros.tracking.images import checked, Image
from rs_relpose_ros.tracking.lucas_kanade import (
    Flow,
    follow,
    inside,
    patch_radius,
    whole_images,
)
from rs_relpose_ros.tracking.matches import Matches
from rs_relpose_ros.tracking.patches import cut, cut_warped
from rs_relpose_ros.tracking.windows import (
    brightness_table,
    correlations,
    window_jacobians,
    with_brightness,
)

Array = NDArray[np.float64]

_FOLLOW = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.02)
_REFINE = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.005)
# Corrections of the guess [px] that the image itself, without its pyramid, makes up for.
_NEAR = 2.0
# Levels of the pyramid where the gyro says where to look, and where the guesses of the last frame
# were off by no more than half of that, but for a share.
_EXPECTED_LEVELS, _NEAR_LEVELS, _MOST_FAR = 2, 1, 0.05
# Share of tracks that may be lost before all levels are asked.
_MOST_LOST = 0.15
# The comparison with the reference corrects drift; what it moves further was lost before.
_LARGEST_CORRECTION = 3.0


class KltTracker:
    """Lucas-Kanade tracking of Shi-Tomasi corners; see `rs_relpose_ros.tracking.tracker.Tracker`.

    From frame to frame windows hardly change, so that tracks live long, but errors add up. When a
    pair closes each window is aligned once more with that of the reference keyframe, in the
    current image turned and scaled as the tracks tell: that leaves the error of a single
    alignment.
    """

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._next_id = 0
        self.reset()

    def reset(self) -> None:
        """Forget all images; ids are not used again."""
        self._reference: Image | None = None
        self._current: Image | None = None
        self._set(np.empty(0, dtype=np.uint32), np.empty((0, 2)), np.empty((0, 2)), np.empty(0),
                  np.empty((0, 2)))
        self._started = 0
        self._guessed_well = False
        self._refined = False

    @property
    def tracked_fraction(self) -> float:
        """Share of the reference's corners that are still tracked."""
        return len(self._ids) / self._started if self._started else 0.0

    def start(self, image: Image) -> None:
        """Make `image` (H, W) the reference keyframe, with new corners only."""
        image = checked(image, None if self._current is None else self._current.shape)
        self.reset()
        self._current = image
        self._renew()

    @property
    def points(self) -> Array:
        """Corners (N, 2) in the current image [px] that `track` will look for."""
        return self._points

    def track(self, image: Image, predicted: Array | None = None,
              interval: float = 1.0) -> Matches:
        """Follow the corners from the current image into `image`, which then is the current one.

        Parameters are those of `rs_relpose_ros.tracking.tracker.Tracker.track`.
        """
        if self._current is None:
            raise InputError('the tracker has no reference keyframe: call start() first')
        previous, points = self._current, self._points
        current = checked(image, previous.shape)
        expected = predicted is not None or self._residual_flow.any()
        if predicted is None:
            predicted = points
        predicted = np.where(np.isfinite(predicted).all(axis=1, keepdims=True), predicted, points)
        # What the gyro did not tell (parallax) goes on as it did.
        guess = predicted + interval * self._residual_flow
        seen = with_brightness(current, brightness_table(
            previous, current, points, guess, self._config.klt_window))
        levels = self._config.klt_levels
        depth = levels
        if expected:
            depth = min(_NEAR_LEVELS if self._guessed_well else _EXPECTED_LEVELS, levels)
        found, good = self._follow_and_return(previous, seen, points, guess, depth)
        if depth < levels and np.count_nonzero(~good) > _MOST_LOST * len(good):
            # Something unexpected: the lost ones once more, with all of the pyramid.
            lost = ~good
            found[lost], good[lost] = self._follow_and_return(
                previous, seen, points[lost], predicted[lost], levels)
        off = found[good] - guess[good]
        far = np.count_nonzero((off**2).sum(axis=1) > (0.5 * _NEAR)**2)
        self._guessed_well = bool(far <= _MOST_FAR * len(off))
        first, last = feature_rows(self._config, image.shape[0])
        good &= (found[:, 1] >= first) & (found[:, 1] <= last)
        self._set(self._ids[good], self._reference_points[good], found[good], self._quality[good],
                  (found - predicted)[good] / interval)
        self._current = current
        self._refined = False
        return self._matches()

    def refined_matches(self) -> Matches:
        """Matches whose windows were aligned with the reference's own."""
        if (not self._refined and len(self._ids) and self._reference is not None
                and self._current is not None and self._current is not self._reference):
            side = self._config.klt_window
            radius = patch_radius(side, math.ceil(_LARGEST_CORRECTION))
            # Turned and scaled as the reference sees them.
            jacobians = window_jacobians(self._reference_points, self._points)
            seen = cut_warped(self._current, self._points, jacobians, radius,
                              self._reference_points)
            here = cut(self._reference, self._reference_points, radius)
            windows = self._reference_points + here.shifts
            image = with_brightness(seen.image, brightness_table(
                self._reference, self._current, self._reference_points, self._points, side))
            aligned = whole_images(here.image, image, windows, windows, side, 1, _REFINE)
            correction = np.einsum('nij,nj->ni', jacobians, aligned.points - windows)
            found = self._points + correction
            correlation = correlations(here.image, image, windows, aligned.points, side)
            # The border that is repeated in a patch is no image.
            good = (aligned.found & inside(self._current, found, side // 4)
                    & (correlation >= self._config.min_correlation)
                    & (np.linalg.norm(correction, axis=1) <= _LARGEST_CORRECTION))
            strength = aligned.strength
            # A faint corner is worth less than a strong one of the same correlation.
            quality = correlation * strength / (strength + self._config.feature_quality)
            self._set(self._ids[good], self._reference_points[good], found[good], quality[good],
                      self._residual_flow[good])
        self._refined = True
        return self._matches()

    def promote(self) -> None:
        """Make the current image the reference; tracks go on, new corners fill the gaps."""
        if self._current is None:
            raise InputError('the tracker has no current image: call start() first')
        self._renew()

    # -- inside ------------------------------------------------------------------------------

    def _follow_and_return(self, image1: Image, image2: Image, points1: Array, guess: Array,
                           levels: int) -> tuple[Array, NDArray[np.bool_]]:
        """Points of `image2` that look like `points1` (N, 2), and which of them lead back."""
        there = self._follow(image1, image2, points1, guess, levels)
        found, good = there.points, there.found
        # The way back starts as far off as the way forth did: the guess must not be the answer.
        offset = found - guess
        leads_back = np.zeros(len(points1), dtype=bool)
        # From nearby the image itself, without its pyramid, leads back; from afar it may.
        far = np.linalg.norm(offset, axis=1) > _NEAR
        for depth, tried in ((1, np.ones(len(points1), dtype=bool)), (levels, far)):
            mask = good & tried & ~leads_back
            if depth == 1 or (levels > 1 and mask.any()):
                back = self._follow(image2, image1, found[mask], (points1 + offset)[mask], depth)
                error = np.linalg.norm(back.points - points1[mask], axis=1)
                leads_back[mask] = back.found & (error <= self._config.forward_backward_threshold)
        return found, leads_back

    def _follow(self, image1: Image, image2: Image, points1: Array, guess: Array,
                levels: int) -> Flow:
        return follow(image1, image2, points1, guess, self._config.klt_window, levels, _FOLLOW)

    def _renew(self) -> None:
        assert self._current is not None
        # Of tracks that ran together the oldest stays.
        apart = keep_apart(self._points, 0.5 * self._config.min_feature_distance)
        kept = self._points[apart]
        new = find_corners(self._current, kept, self._config.max_features - len(kept),
                           self._config)
        ids = np.concatenate([self._ids[apart], (
            np.arange(self._next_id, self._next_id + len(new)) % 2**32).astype(np.uint32)])
        self._next_id += len(new)
        points = np.concatenate([kept, new])
        self._set(ids, points, points.copy(), np.ones(len(points)),
                  np.concatenate([self._residual_flow[apart], np.zeros_like(new)]))
        self._started = len(points)
        # Nobody knows how the new ones will move.
        self._guessed_well = len(new) == 0
        self._reference = self._current
        self._refined = False

    def _set(self, ids: NDArray[np.uint32], reference_points: Array, points: Array,
             quality: Array, residual_flow: Array) -> None:
        self._ids, self._reference_points = ids, reference_points
        self._points, self._quality, self._residual_flow = points, quality, residual_flow

    def _matches(self) -> Matches:
        # Copies: the tracker goes on, the matches do not change.
        return Matches(self._ids.copy(), self._reference_points.copy(), self._points.copy(),
                       self._quality.copy())
