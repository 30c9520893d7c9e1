"""Lucas-Kanade tracking of corners; alignment of their windows with the reference keyframe."""

from dataclasses import replace
import math
from typing import NamedTuple

import cv2
import numpy as np

from rs_relpose_ros.config.settings import TrackingConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array, Flags
from rs_relpose_ros.geometry.matches import Matches
from rs_relpose_ros.tracking import features, windows
from rs_relpose_ros.tracking.images import checked, Image

# Factor from OpenCV's eigenvalues to the smallest eigenvalue of the structure tensor of the gray
# levels. [derived: OpenCV divides by 2^20, and a Scharr gradient is 32 times the derivative]
_SCHARR = 2.0**20 / 32.0**2
# Search radius [px] of a window without a pyramid; one level more doubles it. With less, fast
# points are lost at the first level; the cost of a patch grows with its square.
# [chosen: 3..6; predictions are off by less than 2 px]
_REACH = 4
# Pixels around a window for derivatives (1), interpolation (1) and rounding (1). [derived]
_FRINGE = 3
# Patches are cut out of images that are larger than all patches together by this factor: below
# it, preparing the whole image costs as much. [chosen: cutting costs about a copy]
_WORTH = 2.0
# OpenCV's criteria to end the search of a window: number of steps and size of a step [px]. The
# alignment has the accuracy of a match, tracking only has to stay on the point.
# [chosen: a step of 0.02 px is a tenth of the noise of a match, one of 0.005 px a fortieth]
_ENDS = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS
# Criteria of tracking from frame to frame. [chosen: as above]
_TRACKING_CRITERIA = (_ENDS, 15, 0.02)
# Criteria of the alignment. [chosen: as above]
_ALIGNMENT_CRITERIA = (_ENDS, 20, 0.005)
# Errors of a guess [px] that are corrected without a pyramid. A larger value lets windows find
# neighbours of the same look, a smaller one costs a pyramid more often. [derived: half of _REACH]
_NEAR = 2.0
# Levels of the pyramid for a predicted motion.
# [derived: one level more than none corrects the parallax of a frame at 30 Hz]
_EXPECTED_LEVELS = 2
# Levels of the pyramid after guesses that were off by at most half of _NEAR. [derived: no pyramid]
_NEAR_LEVELS = 1
# Share of guesses that may be further off than that: their tracks are found again by a second
# search, while one pyramid for all costs more. [chosen: few tracks of some hundred]
_MOST_FAR = 0.05
# Share of lost tracks above which the search is repeated with all levels. With less, each frame
# with moving objects is searched twice; with more, a sudden motion loses its tracks.
# [chosen: far above the losses of a steady motion, far below _HOPELESS]
_MOST_LOST = 0.15
# Share of lost tracks above which the prediction is not used: a gyro in a wrong unit or axes.
# [chosen: a right prediction loses less than _MOST_LOST, a wrong one nearly all]
_HOPELESS = 0.5
# Largest correction [px] of an alignment. A larger one is another point: a track drifts by less
# over the frames of a pair. [chosen: errors of a step are a fraction of a pixel]
_LARGEST_CORRECTION = 3.0
# Points of a window homography: more of them cost time and gain nothing.
# [derived: eight unknowns from 200 coordinates]
_FITTED = 100
# Fewest points of a window homography: with less, its eight unknowns follow the noise.
# [derived: twice the four points that determine it]
_LEAST_FITTED = 8
# Largest change of area of a window homography that is not degenerate: windows that shrink by more
# have no texture left. [chosen: twice as near, any value in 2..10 would do]
_LARGEST_STRETCH = 4.0


class Search(NamedTuple):
    """How windows are searched."""

    side: int  # [px] of a window
    levels: int  # of the pyramid, 1 for the original images only
    criteria: tuple[int, int, float]  # of OpenCV: kind, steps, step [px]


class Flow(NamedTuple):
    """Points tracked into a second image."""

    points: Array  # (N, 2) in the second image
    found: Flags  # (N,)
    strength: Array  # (N,) [gray^2/px^2] smallest eigenvalue of each window's structure tensor


def follow(
    image1: Image,
    image2: Image,
    points1: Array,
    guess: Array,
    search: Search,
) -> Flow:
    """Points of `image2` near the `guess` (N, 2) that match `points1` (N, 2) of `image1`."""
    if not len(points1):
        return Flow(points1, np.empty(0, dtype=bool), np.empty(0))
    patch = 2 * patch_radius(search.side, _REACH) + 1
    if search.levels <= 2 and image1.size > _WORTH * len(points1) * patch**2:
        if search.levels == 2:
            # As in a pyramid: the coarse level gives the start of the fine one.
            half1: Image = cv2.pyrDown(image1)  # type: ignore[assignment]
            half2: Image = cv2.pyrDown(image2)  # type: ignore[assignment]
            coarse = _near(
                half1,
                half2,
                0.5 * points1,
                0.5 * guess,
                search,
            )
            guess = np.where(coarse.found[:, None], 2.0 * coarse.points, guess)
        flow = _near(
            image1,
            image2,
            points1,
            guess,
            search,
        )
    else:
        flow = whole_images(
            image1,
            image2,
            points1,
            guess,
            search,
        )
    return flow._replace(found=flow.found & inside(image2, flow.points))


def inside(image: Image, points: Array, margin: float = 0.0) -> Flags:
    """Which of the points (N, 2) lie `margin` pixels within an image's outermost pixel centres."""
    height, width = image.shape
    last = width - 1.0 - margin, height - 1.0 - margin
    within = (points >= margin) & (points <= last)
    return within[:, 0] & within[:, 1]


def patch_radius(side: int, reach: int) -> int:
    """Radius of patches in which windows of `side` can be followed over `reach` pixels."""
    return side // 2 + reach + _FRINGE


def whole_images(
    image1: Image, image2: Image, points1: Array, guess: Array, search: Search
) -> Flow:
    """`follow` by OpenCV on whole images, over any distance."""
    points2, status, eigenvalues = cv2.calcOpticalFlowPyrLK(
        image1,
        image2,
        points1.astype(np.float32, order='C'),
        guess.astype(np.float32, order='C'),
        winSize=(search.side, search.side),
        maxLevel=search.levels - 1,
        criteria=search.criteria,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW | cv2.OPTFLOW_LK_GET_MIN_EIGENVALS,
    )
    return Flow(
        np.asarray(points2, dtype=np.float64),
        np.asarray(status)[:, 0] == 1,
        _SCHARR * np.asarray(eigenvalues, dtype=np.float64)[:, 0],
    )


def _near(
    image1: Image,
    image2: Image,
    points1: Array,
    guess: Array,
    search: Search,
) -> Flow:
    """`follow` on patches, which end `_REACH` pixels from the guess."""
    radius = patch_radius(search.side, _REACH)
    first = windows.cut(image1, points1, radius)
    second = windows.cut(image2, guess, radius)
    flow = whole_images(
        first.image,
        second.image,
        points1 + first.shifts,
        guess + second.shifts,
        search._replace(levels=1),
    )
    points2 = flow.points - second.shifts
    near = (np.abs(points2 - guess) <= _REACH).all(axis=1)
    return flow._replace(points=points2, found=flow.found & near)


# -- Alignment removes the drift of a track: the error of one alignment is left -------------------
#
# The current image is resampled to the geometry of the reference, by a homography fitted to the
# tracks.


def aligned(
    matches: Matches, reference: Image, current: Image, config: TrackingConfig
) -> tuple[Matches, Flags]:
    """`matches` (N) with their second points aligned, and a mask (N,) of those that correlate."""
    points1 = matches.points1
    points2 = matches.points2
    search = Search(config.klt_window, 1, _ALIGNMENT_CRITERIA)
    radius = patch_radius(search.side, math.ceil(_LARGEST_CORRECTION))
    jacobians = window_jacobians(points1, points2)
    there = windows.cut_warped(
        current,
        points2,
        jacobians,
        radius,
        points1,
    )
    here = windows.cut(reference, points1, radius)
    table = windows.brightness_table(
        reference,
        current,
        points1,
        points2,
        search.side,
    )
    image = windows.with_brightness(there.image, table)
    start = points1 + here.shifts
    flow = whole_images(
        here.image,
        image,
        start,
        start,
        search,
    )
    # From the pixels of the reference to those of the current image: p2 + J (x - p1).
    correction = np.einsum('nij,nj->ni', jacobians, flow.points - start)
    found = points2 + correction
    correlation = windows.correlations(
        here.image,
        image,
        start,
        flow.points,
        search.side,
    )
    # Patches repeat the border of the image: a match there is not in the image.
    good = (
        flow.found
        & inside(current, found, search.side // 4)
        & (correlation >= config.min_correlation)
        & (np.linalg.norm(correction, axis=1) <= _LARGEST_CORRECTION)
    )
    # At equal correlation a faint corner ranks behind a strong one.
    quality = correlation * flow.strength / (flow.strength + config.feature_quality)
    return replace(matches.followed(found), quality=quality), good


def window_homography(points1: Array, points2: Array) -> Array:
    """Homography (3, 3) from the first image to the second that fits the points (N, 2).

    The identity if there are too few points or the fit is degenerate.
    """
    if len(points1) < _LEAST_FITTED:
        return np.eye(3)
    step = -(-len(points1) // _FITTED)
    some = slice(None, None, step)
    fitted, _ = cv2.findHomography(points1[some], points2[some], method=0)
    # Without a solution OpenCV returns None: an array without shape.
    H = np.asarray(fitted, dtype=np.float64)
    if H.shape != (3, 3) or not np.isfinite(H).all():
        return np.eye(3)
    scale = points1 @ H[2, :2] + H[2, 2]
    # Area of the image of a small window: det H / scale^3.
    with np.errstate(all='ignore'):
        area = np.linalg.det(H) / scale**3
    is_large = area > 1.0 / _LARGEST_STRETCH
    is_small = area < _LARGEST_STRETCH
    if not (is_large & is_small).all():
        return np.eye(3)
    return H


def window_jacobians(points1: Array, points2: Array) -> Array:
    """Derivatives (N, 2, 2) of `window_homography` at points (N, 2).

    A column for each axis of the first image.
    """
    H = window_homography(points1, points2)
    ones = np.ones(len(points1))
    homogeneous = np.column_stack([points1, ones]) @ H.T
    depth = homogeneous[:, 2:]
    mapped = homogeneous[:, :2] / depth
    by_depth = mapped[:, :, None] * H[2, :2]
    return (H[:2, :2] - by_depth) / depth[:, :, None]


class KltTracker:
    """Lucas-Kanade tracking of Shi-Tomasi corners; see `rs_relpose_ros.tracking.features.Tracker`.

    From frame to frame windows hardly change, so that tracks are long, but errors add up. For a
    keyframe pair `refined_matches` aligns each window with the window of the reference keyframe.
    """

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._ids = features.TrackIds()
        self._allowed: Image | None = None
        self.reset()

    def allow(self, allowed: Image | None) -> None:
        """Search corners where `allowed` (H, W) is not zero; None allows the whole image."""
        self._allowed = allowed

    def reset(self) -> None:
        """Forget all images; ids are not used again."""
        self._reference: Image | None = None
        self._current: Image | None = None
        self._matches = Matches.none()
        # Motion of each track beyond the last prediction (parallax), per interval.
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

    def track(
        self, image: Image, predicted: Array | None = None, interval: float = 1.0
    ) -> Matches:
        """Follow the corners into `image`, the new current one; see `Tracker.track`."""
        if self._current is None:
            raise InputError('the tracker has no reference keyframe: call start() first')
        previous = self._current
        points = self.points
        current = checked(image, previous.shape)
        expected = predicted is not None or bool(self._unexplained.any())
        predicted = points if predicted is None else _usable(predicted, points, image.shape)
        guess = _usable(predicted + interval * self._unexplained, predicted, image.shape)
        side = self._config.klt_window
        table = windows.brightness_table(
            previous,
            current,
            points,
            guess,
            side,
        )
        observed = windows.with_brightness(current, table)
        all_levels = self._config.klt_levels
        needed = _NEAR_LEVELS if self._guesses_near else _EXPECTED_LEVELS
        levels = min(needed, all_levels) if expected else all_levels
        found, good = self._follow_and_return(
            previous,
            observed,
            points,
            guess,
            levels,
        )
        # Many losses: the motion was not the expected one. Losses of most: nor the predicted one.
        for start, most, wanted in (
            (predicted, _MOST_LOST, levels < all_levels),
            (points, _HOPELESS, predicted is not points),
        ):
            lost = ~good
            if wanted and np.count_nonzero(lost) > most * len(good):
                found[lost], good[lost] = self._follow_and_return(
                    previous, observed, points[lost], start[lost], all_levels
                )
        off = found[good] - guess[good]
        far = (off**2).sum(axis=1) > (0.5 * _NEAR) ** 2
        self._guesses_near = bool(np.count_nonzero(far) <= _MOST_FAR * len(off))
        first, last = features.feature_rows(self._config, image.shape[0])
        good &= (found[:, 1] >= first) & (found[:, 1] <= last)
        good &= features.within(found, self._allowed)
        self._set(self._matches.followed(found), (found - predicted) / interval, good)
        self._current = current
        self._refined = False
        return self._matches

    def refined_matches(self) -> Matches:
        """Matches with windows aligned to those of the reference."""
        if (
            not self._refined
            and len(self._matches)
            and self._reference is not None
            and self._current is not None
            and self._current is not self._reference
        ):
            refined, good = aligned(
                self._matches,
                self._reference,
                self._current,
                self._config,
            )
            self._set(refined, self._unexplained, good)
        self._refined = True
        return self._matches

    def promote(self) -> None:
        """Make the current image the reference; tracks continue, new corners fill the gaps."""
        if self._current is None:
            raise InputError('the tracker has no current image: call start() first')
        # Where tracks have merged the oldest one is kept.
        apart = features.keep_apart(self.points, 0.5 * self._config.min_feature_distance)
        kept = self.points[apart]
        wanted = self._config.max_features - len(kept)
        new = features.find_corners(
            self._current,
            kept,
            wanted,
            self._config,
            self._allowed,
        )
        points = np.concatenate([kept, new])
        ids = np.concatenate([self._matches.track_ids[apart], self._ids.take(len(new))])
        self._matches = Matches(ids, np.stack([points, points]), np.ones(len(points)))
        self._unexplained = np.concatenate([self._unexplained[apart], np.zeros_like(new)])
        self._started = len(points)
        # The parallax of new corners is not known.
        self._guesses_near = len(new) == 0
        self._reference = self._current
        self._refined = False

    # -- inside ------------------------------------------------------------------------------

    def _set(self, matches: Matches, unexplained: Array, good: Flags) -> None:
        self._matches = matches.kept(good)
        self._unexplained = unexplained[good]

    def _follow_and_return(
        self,
        image1: Image,
        image2: Image,
        points1: Array,
        guess: Array,
        levels: int,
    ) -> tuple[Array, Flags]:
        """Points of `image2` that match `points1` (N, 2), and a mask of those tracked back."""
        search = Search(self._config.klt_window, levels, _TRACKING_CRITERIA)
        there = follow(
            image1,
            image2,
            points1,
            guess,
            search,
        )
        # The way back starts as far off as the way forth: the guess must not be the answer.
        offset = there.points - guess

        def returned(which: Flags, back: Search) -> Flags:
            start = points1[which] + offset[which]
            flow = follow(
                image2,
                image1,
                there.points[which],
                start,
                back,
            )
            error = np.linalg.norm(flow.points - points1[which], axis=1)
            return flow.found & (error <= self._config.forward_backward_threshold)

        good = there.found.copy()
        good[good] = returned(there.found, search._replace(levels=1))
        # Without a pyramid near points are tracked back, and some of the far ones.
        far = there.found & ~good & (np.linalg.norm(offset, axis=1) > _NEAR)
        if levels > 1 and far.any():
            good[far] = returned(far, search)
        return there.points, good


def _usable(guess: Array, otherwise: Array, shape: tuple[int, ...]) -> Array:
    """`guess` (N, 2) [px], or `otherwise` for those not finite or far outside of the image.

    A gyro in a wrong unit predicts points anywhere, which overflow as pixels.
    """
    size = np.array(shape[1::-1])
    near = np.abs(guess - 0.5 * size) <= 1.5 * size  # False for NaN
    return np.where(near.all(axis=1, keepdims=True), guess, otherwise)
