"""From a hypothesis to the uniform model: inlier selection and fits on a shrinking threshold."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel, linked_kernel
from rs_relpose_ros.estimator import sampson
from rs_relpose_ros.estimator.map_fit import prior_cost, Priors, State, stepped

Array = NDArray[np.float64]

# Multiples of the inlier threshold: the angular model leaves up to 20 px at true inliers.
SHRINKING = np.array([6.0, 3.0, 1.5, 1.0])
STEPS = 2

# A depth is judged only where the parallax is this many times its noise.
SIGNIFICANT_PARALLAX = 4.0
# A match is taken for an outlier where the logarithm of its depth is so many times as far from the
# median as the quantile of one sigma on that side.
DEPTH_GATE = 4.0
DEPTH_QUANTILES = (0.16, 0.5, 0.84)
# Scenes are never flatter than this (log units): keeps the gate open on planar scenes.
MIN_DEPTH_SPREAD = 0.25


@kernel
def cheirality_sign(observations: Array, use: NDArray[np.bool_], state: State) -> float:
    """+1 or -1: the sign of (t, d_1, d_2) that puts more of the matches in front, weighted.

    Matches vote with their parallax: the sign of a depth without parallax is noise.
    """
    vote = 0.0
    for i in range(observations.shape[0]):
        if use[i]:
            depth1, depth2, _, _ = sampson.triangulated(
                observations, i, state.R, state.t, state.d1, state.d2)
            if not math.isnan(depth1):
                # Bounded: a match on the baseline has an arbitrarily large inverse depth.
                vote += max(-1.0, min(1.0, 0.5 / depth1)) + max(-1.0, min(1.0, 0.5 / depth2))
    return 1.0 if vote >= 0.0 else -1.0


@kernel
def signed(state: State, sign: float) -> State:
    """The state with its translation and velocities multiplied by `sign`."""
    return State(state.R, sign * state.t, sign * state.d1, sign * state.d2, state.dw1, state.dw2)


@linked_kernel
def gate_depths(observations: Array, use: NDArray[np.bool_], state: State,
                angle_sigma: float) -> None:
    """Remove from `use` what lies behind a camera or far from the others' depths.

    A random match that survives the epipolar band is invisible to the epipolar residual, but not
    to geometry. `angle_sigma` is the noise of a match [rad].
    """
    n = observations.shape[0]
    # Depths in units of what the camera moved between the two rows; NaN for no opinion.
    depths = np.full(n, np.nan)
    count = 0
    for i in range(n):
        if not use[i]:
            continue
        depth1, depth2, parallax, baseline = sampson.triangulated(
            observations, i, state.R, state.t, state.d1, state.d2)
        if not parallax >= SIGNIFICANT_PARALLAX * angle_sigma:
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
    known.sort()
    # Near and far side apart: a scene is denser far away, and its few near points, which look like
    # outliers beside the rest, know most of the translation.
    last = count - 1
    near, centre, far = (math.log(known[int(DEPTH_QUANTILES[0] * last)]),
                         math.log(known[int(DEPTH_QUANTILES[1] * last)]),
                         math.log(known[int(DEPTH_QUANTILES[2] * last)]))
    lowest = math.exp(centre - DEPTH_GATE * max(centre - near, MIN_DEPTH_SPREAD))
    highest = math.exp(centre + DEPTH_GATE * max(far - centre, MIN_DEPTH_SPREAD))
    for i in range(n):
        if depths[i] < lowest or depths[i] > highest:
            use[i] = False


@kernel
def count_behind(observations: Array, use: NDArray[np.bool_], state: State,
                 angle_sigma: float) -> int:
    """How many of the matches in `use` lie behind a camera, with a parallax that can tell."""
    count = 0
    for i in range(observations.shape[0]):
        if use[i]:
            depth1, depth2, parallax, _ = sampson.triangulated(
                observations, i, state.R, state.t, state.d1, state.d2)
            if parallax >= SIGNIFICANT_PARALLAX * angle_sigma and min(depth1, depth2) <= 0.0:
                count += 1
    return count


@linked_kernel
def within(r: Array, observations: Array, valid: NDArray[np.bool_], state: State,
           threshold: float, angle_sigma: float) -> NDArray[np.bool_]:
    """Matches whose residuals `r` (N,) at `state` are below `threshold`, of plausible depths."""
    use = valid & (np.abs(r) < threshold)
    gate_depths(observations, use, state, angle_sigma)
    return use


@kernel
def select_inliers(observations: Array, valid: NDArray[np.bool_], state: State, threshold: float,
                   angle_sigma: float) -> NDArray[np.bool_]:
    """Matches within `threshold` [px] whose depths are plausible."""
    r = sampson.residuals(observations, state.R, state.t, state.d1, state.d2, state.dw1, state.dw2)
    return within(r, observations, valid, state, threshold, angle_sigma)


@kernel
def _truncated_cost(r: Array, valid: NDArray[np.bool_], threshold: float, sigma: float) -> float:
    """MSAC cost of residuals (N,) in units of sigma."""
    cost = 0.0
    for i in range(r.shape[0]):
        if valid[i]:
            cost += min(r[i] * r[i], threshold * threshold)
    return cost / (sigma * sigma)


@kernel
def optimise(observations: Array, valid: NDArray[np.bool_], R: Array, x: Array, priors: Priors,
             sigma: float, threshold: float, angle_sigma: float) -> tuple[State, bool]:
    """Fit the uniform model to each hypothesis; the one of the least MSAC cost, priors included.

    The threshold shrinks from round to round, and the better half goes on: later fits are spent
    where they may matter.

    Parameters
    ----------
    R, x : (K, 3, 3), (K, 9) ndarray
        Hypotheses: rotation, and ``t, d_1, d_2`` up to a common sign.
    sigma, threshold : float
        Noise of a match and inlier threshold [px].
    angle_sigma : float
        Noise of a match [rad].

    Returns
    -------
    state : State
    found : bool
        False where no hypothesis explains enough matches; then the state means nothing.
    """
    # What goes on, with its residuals.
    states, r = [], []
    for k in range(R.shape[0]):
        state = State(R[k].copy(), x[k, 0:3].copy(), x[k, 3:6].copy(), x[k, 6:9].copy(),
                      np.zeros(3), np.zeros(3))
        r.append(sampson.residuals(observations, state.R, state.t, state.d1, state.d2, state.dw1,
                                   state.dw2))
        # The sign that puts its matches in front of the cameras; residuals change theirs with it.
        near = within(r[k], observations, valid, state, SHRINKING[0] * threshold, 1e9)
        states.append(signed(state, cheirality_sign(observations, near, state)))
    for scale in SHRINKING:
        costs = np.full(len(states), math.inf)
        # Wide selections hold outliers: their residuals are not pixel noise.
        noise, bound = scale * sigma, scale * threshold
        for k in range(len(states)):
            use = within(r[k], observations, valid, states[k], bound, angle_sigma)
            if use.sum() < 6:
                continue
            costs[k] = _truncated_cost(r[k], valid, bound, noise) + prior_cost(states[k], priors)
            state = stepped(observations, use, states[k], priors, noise, STEPS)
            residuals = sampson.residuals(observations, state.R, state.t, state.d1, state.d2,
                                          state.dw1, state.dw2)
            cost = _truncated_cost(residuals, valid, bound, noise) + prior_cost(state, priors)
            if cost < costs[k]:
                states[k], r[k], costs[k] = state, residuals, cost
        order = np.argsort(costs, kind='mergesort')
        good = int((costs < math.inf).sum())
        if good == 0:
            return states[0], False
        states = [states[order[k]] for k in range((good + 1) // 2)]
        r = [r[order[k]] for k in range((good + 1) // 2)]
    return states[0], True
