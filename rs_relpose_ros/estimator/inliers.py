"""Which matches a state explains: by their residuals, and by the depths that follow from it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel, linked_kernel
from rs_relpose_ros.estimator import sampson
from rs_relpose_ros.estimator.state import TwoViewState
from rs_relpose_ros.geometry.order import smallest

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# A depth is judged only where the parallax is this many times its noise.
SIGNIFICANT_PARALLAX = 4.0
# A match is taken for an outlier where the logarithm of its depth is so many times as far from the
# median as the quantile of one sigma on that side.
DEPTH_GATE = 4.0
DEPTH_QUANTILES = (0.16, 0.5, 0.84)
# Scenes are never flatter than this (log units): keeps the gate open on planar scenes.
MIN_DEPTH_SPREAD = 0.25


class Matches(NamedTuple):
    """All matches of a pair.

    `observations` (N, 20): rows of `sampson`. `valid` (N,): those with finite rays.
    `angle_sigma`: noise of a ray [rad].
    """

    observations: Array
    valid: Flags
    angle_sigma: float


@kernel
def cheirality_sign(observations: Array, use: Flags, state: TwoViewState) -> float:
    """+1 or -1: the sign of (t, d_1, d_2) that puts more of the matches in front, weighted.

    Matches vote with their parallax: the sign of a depth without parallax is noise.
    """
    vote = 0.0
    for i in range(observations.shape[0]):
        if use[i]:
            depth1, depth2, _, _ = sampson.triangulated(observations, i, state)
            if not math.isnan(depth1):
                # Bounded: a match on the baseline has an arbitrarily large inverse depth.
                vote += max(-1.0, min(1.0, 0.5 / depth1)) + max(-1.0, min(1.0, 0.5 / depth2))
    return 1.0 if vote >= 0.0 else -1.0


@linked_kernel
def gate_depths(matches: Matches, use: Flags, state: TwoViewState) -> None:
    """Remove from `use` what lies behind a camera or far from the others' depths.

    A random match that survives the epipolar band is invisible to the epipolar residual, but not
    to geometry.
    """
    n = len(use)
    # Depths in units of what the camera moved between the two rows; NaN for no opinion.
    depths = np.full(n, np.nan)
    count = 0
    for i in range(n):
        if not use[i]:
            continue
        depth1, depth2, parallax, baseline = sampson.triangulated(
            matches.observations, i, state)
        if not parallax >= SIGNIFICANT_PARALLAX * matches.angle_sigma:
            continue
        if depth1 <= 0.0 or depth2 <= 0.0:
            use[i] = False
            continue
        depths[i] = min(depth1, depth2) / baseline
        count += 1
    if count < 8:
        return
    known = np.empty(count)
    k = 0
    for i in range(n):
        if not math.isnan(depths[i]):
            known[k] = depths[i]
            k += 1
    # Near and far side apart: a scene is denser far away, and its few near points, which look like
    # outliers beside the rest, know most of the translation.
    last = count - 1
    near, centre, far = (math.log(smallest(known, int(DEPTH_QUANTILES[0] * last))),
                         math.log(smallest(known, int(DEPTH_QUANTILES[1] * last))),
                         math.log(smallest(known, int(DEPTH_QUANTILES[2] * last))))
    lowest = math.exp(centre - DEPTH_GATE * max(centre - near, MIN_DEPTH_SPREAD))
    highest = math.exp(centre + DEPTH_GATE * max(far - centre, MIN_DEPTH_SPREAD))
    for i in range(n):
        if depths[i] < lowest or depths[i] > highest:
            use[i] = False


@kernel
def count_behind(matches: Matches, use: Flags, state: TwoViewState) -> int:
    """How many of the matches in `use` lie behind a camera, with a parallax that can tell."""
    count = 0
    for i in range(len(use)):
        if use[i]:
            depth1, depth2, parallax, _ = sampson.triangulated(matches.observations, i, state)
            if (parallax >= SIGNIFICANT_PARALLAX * matches.angle_sigma
                    and min(depth1, depth2) <= 0.0):
                count += 1
    return count


@linked_kernel
def within(r: Array, matches: Matches, state: TwoViewState, threshold: float) -> Flags:
    """Matches whose residuals `r` (N,) at `state` are below `threshold`, of plausible depths."""
    use = np.empty(len(r), dtype=np.bool_)
    for i in range(len(r)):
        use[i] = matches.valid[i] and abs(r[i]) < threshold
    gate_depths(matches, use, state)
    return use


@kernel
def select_inliers(matches: Matches, state: TwoViewState, threshold: float) -> Flags:
    """Matches within `threshold` [px] whose depths are plausible."""
    return within(sampson.residuals(matches.observations, state), matches, state, threshold)
