"""A second motion among the matches of a pair: an object that moves through the view.

A camera that moves in a scene at rest gives all matches one motion, whatever is configured wrong.
Where an object fills much of the view, the matches are of two kinds: those of the scene, which fit
the rotation of the gyro, and those of a rigid body that hardly turns, which a similarity of the
image moves alike. If both explain nearly all matches, and images contradict the gyro in several
pairs, poses may be those of the object, or of both at once.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibration.clock_steps import CONTRADICTS_GYRO
from rs_relpose_ros.calibration.findings import Code, Evidence, Finding, FindingState, Why
from rs_relpose_ros.calibration.posterior import PairData, problem_of
from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.geometry import Array, Flags

# Least share of the matches that have the second motion. Less would take mismatches for one, more
# would follow an object that covers little of what has texture. [measured: at most 0.02 of the
# matches of simulated walks fit no pose, 0.15 to 0.56 with an object of 0.4 or 0.8 of the view]
_LEAST_SHARE = 0.12
# Least number of these matches. [chosen: 8 to 20 would do; a similarity fits two by chance]
_FEWEST = 12
# Distance [px] within which a match has a motion. Less would lose matches to noise, more would
# take the mismatches of a blurred image for a motion. [chosen: three sigmas of a poor match]
_WITHIN = 1.5
# Pairs of matches from which a motion is made. Fewer may miss it, more cost time.
# [derived: with a third of the matches right, 48 miss it in 4 of 1000 pairs]
_TRIED = 48
# Axes of epipolar planes that are refined by all matches that have them; one may be chance.
# [chosen: 3 to 10 would do]
_REFINED = 6
# Rounds of the refinement, the first one included. [chosen: 3 to 5 would do]
_ROUNDS = 4
# Steps of the two numbers of such a pair, as shares of the matches: pairs are spread evenly.
# [derived: Roberts' sequence in two dimensions, 1 / p and 1 / p^2 with p^3 = p + 1]
_STEPS = (0.7548776662466927, 0.5698402909980532)
# Least distance [px] of two matches that make a similarity: noise turns a shorter one.
# [chosen: 10 to 40 would do]
_APART = 20.0
# Share of the matches that scene and object explain together at least. Less would take for an
# object what a wrong clock makes of the scene, more would miss objects among poor matches.
# [measured: in half of the pairs with an object, in 3 % of those with a clock that is off by half
# a second, in none where images are right or stabilised]
_EXPLAINED = 0.9
# Last pairs in which an object has to show. [chosen: 1 to 2 s of keyframes]
_RECENT = 12
# Number of these pairs that have two motions, and of those that contradict the gyro, from which an
# object is in view. Fewer would follow single pairs of poor matches. [measured: none with images
# that are right or stabilised, 4 at most with a clock that is off by half a second, 12 with an
# object]
_IN_VIEW = 5
# Last pairs of which none has two motions once an object has stopped or left. Fewer would publish
# poses while it turns back, more would withhold correct ones after it. [measured: up to 20 pairs
# in a row have one motion at the turns of an object; 30 to 60 would do]
_GONE = 40


Numbers = NDArray[np.int64]


class SecondMotions:
    """Follows the pairs in the order of time."""

    def __init__(self) -> None:
        self._shares: deque[float] = deque(maxlen=_GONE)  # of the object; 0 without one
        self._contradict: deque[bool] = deque(maxlen=_RECENT)  # whether images and gyro do
        self.in_view = False  # whether an object is
        self.has_come = False  # whether it is since the last pair

    def add(self, data: PairData, pose: RelativePose) -> bool:
        """Add a pair with its best pose; whether the pose may be that of an object."""
        contradicts = not pose.diagnostics.gyro_square <= CONTRADICTS_GYRO  # NaN: another rotation
        share = second_share(data, pose.inliers)
        self._shares.append(share)
        self._contradict.append(contradicts)
        self.has_come = False
        if self.in_view:
            self.in_view = any(self._shares)
        else:
            recent = list(self._shares)[-_RECENT:]
            split = sum(share > 0.0 for share in recent)
            self.in_view = self.has_come = bool(min(split, sum(self._contradict)) >= _IN_VIEW)
        return self.in_view or (contradicts and share > 0.0)

    def finding(self) -> Finding:
        """On the object in view, with the mean share of the matches of the second motion."""
        shares = [share for share in self._shares if share]
        return Finding(
            Code.MOVING_OBJECT,
            FindingState.WRONG,
            Why.TWO_MOTIONS,
            evidence=Evidence(
                pairs=len(shares), measured={'share_of_matches': float(np.mean(shares))}
            ),
        )


def second_share(data: PairData, inliers: Flags) -> float:
    """Share of the matches (N,) that are of an object; 0 without one.

    `inliers` (N,): those that fit the pose of the pair. With nearly all of them there is none.
    """
    least = max(_FEWEST, _LEAST_SHARE * len(inliers))
    if np.count_nonzero(~inliers) < least:
        return 0.0
    problem = problem_of(data)
    assert problem.rotation is not None
    rays = problem.observations[problem.valid]
    if len(rays) < _FEWEST:
        return 0.0
    turned = rays[:, 9:12] @ problem.rotation.T
    within = _WITHIN / data.camera.fx
    points1 = data.points1[problem.valid]
    points2 = data.points2[problem.valid]
    # The larger of the two motions is found first.
    scene = _in_planes(rays[:, :3], turned, within)
    behind = np.zeros(len(rays), dtype=bool)
    behind[~scene] = _similar(points1[~scene], points2[~scene])
    moved = _similar(points1, points2)
    rest = ~moved
    beside = np.count_nonzero(_in_planes(rays[rest, :3], turned[rest], within))
    if np.count_nonzero(scene | behind) >= np.count_nonzero(moved) + beside:
        explained = np.count_nonzero(scene | behind)
        of_object = np.count_nonzero(behind)
    else:
        explained = np.count_nonzero(moved) + beside
        of_object = np.count_nonzero(moved)
    if of_object < least or explained < _EXPLAINED * len(inliers):
        return 0.0
    return of_object / len(inliers)


def _tried(count: int) -> tuple[Numbers, Numbers]:
    """Pairs of numbers below `count`, from which motions are made."""
    steps = np.arange(1, _TRIED + 1)
    first, second = ((steps * step % 1.0 * count).astype(np.int64) for step in _STEPS)
    return first, second


def _similar(points1: Array, points2: Array) -> Flags:
    """Which matches (N,) the best similarity of the image moves alike."""
    if not len(points1):
        return np.zeros(0, dtype=bool)
    first, second = _tried(len(points1))
    # As complex numbers: a similarity is ``after = turn before + shift``.
    before, after = (points[:, 0] + 1j * points[:, 1] for points in (points1, points2))
    apart = before[first] - before[second]
    usable = np.abs(apart) > _APART
    if not usable.any():
        return np.zeros(len(points1), dtype=bool)
    first = first[usable]
    second = second[usable]
    turn = (after[first] - after[second]) / apart[usable]
    shift = after[first] - turn * before[first]
    errors = after - turn[:, None] * before - shift[:, None]
    fit = np.abs(errors) < _WITHIN
    best = np.argmax(fit.sum(axis=1))
    return np.asarray(fit[best])


def _in_planes(rays1: Array, rays2: Array, within: float) -> Flags:
    """Which matches (N,) have epipolar planes that share the best of the tried axes.

    `rays2` are turned into the axes of the first image; `within` [rad] of the plane.
    """
    if not len(rays1):
        return np.zeros(0, dtype=bool)
    first, second = _tried(len(rays1))
    normals = np.cross(rays1, rays2)
    squares1 = (rays1**2).sum(axis=1)
    squares2 = (rays2**2).sum(axis=1)
    axes = np.cross(normals[first], normals[second])
    for _ in range(_ROUNDS):
        lengths = np.linalg.norm(axes, axis=1)
        axes /= np.maximum(lengths, np.finfo(float).tiny)[:, None]
        # Of each ray, the part across an axis: how far a normal moves with a change of the ray.
        across1 = squares1 - (axes @ rays1.T) ** 2
        across2 = squares2 - (axes @ rays2.T) ** 2
        largest = within * np.sqrt(across1 + across2)
        fit = np.abs(axes @ normals.T) < largest
        best = np.argsort(-fit.sum(axis=1))[:_REFINED]
        weights = fit[best].astype(float)
        moments = np.einsum('an,ni,nj->aij', weights, normals, normals)
        _, directions = np.linalg.eigh(moments)
        axes = directions[:, :, 0]
    return np.asarray(fit[best[0]])
