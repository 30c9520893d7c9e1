"""Corners followed from frame to frame, and at last compared with the reference keyframe."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.tracking.alignment import aligned
from rs_relpose_ros.tracking.brightness import brightness_table, with_brightness
from rs_relpose_ros.tracking.corners import feature_rows, find_corners, keep_apart
from rs_relpose_ros.tracking.images import checked, Image
from rs_relpose_ros.tracking.lucas_kanade import follow
from rs_relpose_ros.tracking.matches import Matches, TrackIds

Array = NDArray[np.float64]

_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.02)
# Errors of a guess [px] that are found without a pyramid.
_NEAR = 2.0
# Levels of the pyramid where the motion is predicted, and where the guesses of the last frame
# were off by no more than half of _NEAR, but for a share.
_EXPECTED_LEVELS, _NEAR_LEVELS, _MOST_FAR = 2, 1, 0.05
# Share of tracks that may be lost before the search is repeated with all levels.
_MOST_LOST = 0.15
# Share from which on the prediction is not believed: a gyro in a wrong unit, or other axes.
_HOPELESS = 0.5


class KltTracker:
    """Lucas-Kanade tracking of Shi-Tomasi corners; see `rs_relpose_ros.tracking.tracker.Tracker`.

    From frame to frame windows hardly change, so that tracks live long, but errors add up. When a
    pair closes, `refined_matches` aligns each window with that of the reference keyframe.
    """

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._ids = TrackIds()
        self.reset()

    def reset(self) -> None:
        """Forget all images; ids are not used again."""
        self._reference: Image | None = None
        self._current: Image | None = None
        self._matches = Matches.none()
        # Motion of each track that the last prediction did not explain (parallax), per interval.
        self._unexplained = np.empty((0, 2))
        self._started = 0
        self._guesses_near = False
        self._refined = False

    @property
    def tracked_fraction(self) -> float:
        """Share of the reference's corners that are still tracked."""
        return len(self._matches) / self._started if self._started else 0.0

    @property
    def points(self) -> Array:
        """Corners (N, 2) in the current image [px] that `track` will look for."""
        return self._matches.points2

    def start(self, image: Image) -> None:
        """Make `image` (H, W) the reference keyframe, with new corners only."""
        image = checked(image, None if self._current is None else self._current.shape)
        self.reset()
        self._current = image
        self.promote()

    def track(self, image: Image, predicted: Array | None = None,
              interval: float = 1.0) -> Matches:
        """Follow the corners into `image`, which then is the current one; see `Tracker.track`."""
        if self._current is None:
            raise InputError('the tracker has no reference keyframe: call start() first')
        previous, points = self._current, self.points
        current = checked(image, previous.shape)
        expected = predicted is not None or bool(self._unexplained.any())
        predicted = points if predicted is None else _usable(predicted, points, image.shape)
        guess = _usable(predicted + interval * self._unexplained, predicted, image.shape)
        seen = with_brightness(current, brightness_table(
            previous, current, points, guess, self._config.klt_window))
        all_levels = self._config.klt_levels
        needed = _NEAR_LEVELS if self._guesses_near else _EXPECTED_LEVELS
        levels = min(needed, all_levels) if expected else all_levels
        found, good = self._follow_and_return(previous, seen, points, guess, levels)
        # Where many are lost the motion was not the expected one, where most are not even the
        # predicted one.
        for start, most, wanted in ((predicted, _MOST_LOST, levels < all_levels),
                                    (points, _HOPELESS, predicted is not points)):
            lost = ~good
            if wanted and np.count_nonzero(lost) > most * len(good):
                found[lost], good[lost] = self._follow_and_return(
                    previous, seen, points[lost], start[lost], all_levels)
        off = found[good] - guess[good]
        far = np.count_nonzero((off**2).sum(axis=1) > (0.5 * _NEAR)**2)
        self._guesses_near = bool(far <= _MOST_FAR * len(off))
        first, last = feature_rows(self._config, image.shape[0])
        good &= (found[:, 1] >= first) & (found[:, 1] <= last)
        self._set(replace(self._matches, points2=found), (found - predicted) / interval, good)
        self._current = current
        self._refined = False
        return self._matches

    def refined_matches(self) -> Matches:
        """Matches whose windows were aligned with the reference's own."""
        if (not self._refined and len(self._matches) and self._reference is not None
                and self._current is not None and self._current is not self._reference):
            refined, good = aligned(self._matches, self._reference, self._current, self._config)
            self._set(refined, self._unexplained, good)
        self._refined = True
        return self._matches

    def promote(self) -> None:
        """Make the current image the reference; tracks go on, new corners fill the gaps."""
        if self._current is None:
            raise InputError('the tracker has no current image: call start() first')
        # Of tracks that ran together the oldest stays.
        apart = keep_apart(self.points, 0.5 * self._config.min_feature_distance)
        kept = self.points[apart]
        new = find_corners(self._current, kept, self._config.max_features - len(kept),
                           self._config)
        points = np.concatenate([kept, new])
        self._matches = Matches(
            np.concatenate([self._matches.track_ids[apart], self._ids.take(len(new))]),
            points, points, np.ones(len(points)))
        self._unexplained = np.concatenate([self._unexplained[apart], np.zeros_like(new)])
        self._started = len(points)
        # The unexplained motion of new corners is not known.
        self._guesses_near = len(new) == 0
        self._reference = self._current
        self._refined = False

    # -- inside ------------------------------------------------------------------------------

    def _set(self, matches: Matches, unexplained: Array, good: NDArray[np.bool_]) -> None:
        self._matches, self._unexplained = matches.kept(good), unexplained[good]

    def _follow_and_return(self, image1: Image, image2: Image, points1: Array, guess: Array,
                           levels: int) -> tuple[Array, NDArray[np.bool_]]:
        """Points of `image2` that look like `points1` (N, 2), and which of them lead back."""
        there = follow(image1, image2, points1, guess, self._config.klt_window, levels, _CRITERIA)
        # The way back starts as far off as the way forth did: the guess must not be the answer.
        offset = there.points - guess
        good = there.found.copy()
        good[good] = self._return(image2, image1, there.points[good], points1[good],
                                  offset[good], 1)
        # Without a pyramid those come back that lie near; of the others some do, too.
        far = there.found & ~good & (np.linalg.norm(offset, axis=1) > _NEAR)
        if levels > 1 and far.any():
            good[far] = self._return(image2, image1, there.points[far], points1[far],
                                     offset[far], levels)
        return there.points, good

    def _return(self, image2: Image, image1: Image, found: Array, points1: Array, offset: Array,
                levels: int) -> NDArray[np.bool_]:
        """Which of the `found` points lead back to `points1`, from a guess that is off as told."""
        back = follow(image2, image1, found, points1 + offset, self._config.klt_window, levels,
                      _CRITERIA)
        error = np.linalg.norm(back.points - points1, axis=1)
        return back.found & (error <= self._config.forward_backward_threshold)


def _usable(guess: Array, otherwise: Array, shape: tuple[int, ...]) -> Array:
    """`guess` (N, 2) [px], `otherwise` where it is not finite or far outside of the image.

    A gyro in a wrong unit predicts points anywhere, which overflow as pixels.
    """
    size = np.array(shape[1::-1])
    near = np.abs(guess - 0.5 * size) <= 1.5 * size   # False for NaN
    return np.where(near.all(axis=1, keepdims=True), guess, otherwise)
