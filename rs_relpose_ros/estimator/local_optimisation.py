"""From a hypothesis to the uniform model: inlier selection and fits on a shrinking threshold."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.estimator.inliers import cheirality_sign, Matches, within
from rs_relpose_ros.estimator.map_fit import FitMatches, stepped
from rs_relpose_ros.estimator.priors import prior_cost, Priors
from rs_relpose_ros.estimator.sampson import residuals
from rs_relpose_ros.estimator.state import hypothesis_state, signed, TwoViewState
from rs_relpose_ros.solvers.solver import Solutions

Array = NDArray[np.float64]

# Multiples of the inlier threshold: the angular model leaves up to 20 px at true inliers.
SHRINKING = np.array([6.0, 3.0, 1.5, 1.0])
# Gauss-Newton steps of a hypothesis at each of them.
STEPS = 2


@kernel
def _truncated_cost(r: Array, valid: NDArray[np.bool_], threshold: float, sigma: float) -> float:
    """MSAC cost of residuals (N,) in units of sigma."""
    cost = 0.0
    for i in range(r.shape[0]):
        if valid[i]:
            cost += min(r[i] * r[i], threshold * threshold)
    return cost / (sigma * sigma)


@kernel
def _take_least(costs: Array) -> int:
    """Number of the least of the costs, the first of equal ones, which becomes infinite."""
    least = 0
    for k in range(1, len(costs)):
        if costs[k] < costs[least] or not costs[least] < math.inf:
            least = k
    costs[least] = math.inf
    return least


@kernel
def optimise(matches: Matches, hypotheses: Solutions, priors: Priors, sigma: float,
             threshold: float) -> tuple[TwoViewState, bool]:
    """Fit the uniform model to each hypothesis; the one of the least MSAC cost, priors included.

    The threshold shrinks from round to round, and the better half goes on: later fits are spent
    where they may matter.

    Parameters
    ----------
    hypotheses : Solutions
        ``(t, d_1, d_2)`` up to a common sign.
    sigma, threshold : float
        Noise of a match and inlier threshold [px].

    Returns
    -------
    state : TwoViewState
    found : bool
        False where no hypothesis explains enough matches; then the state means nothing.
    """
    # Before the sign is known, no depth is judged: no parallax is above this noise.
    unsure = Matches(matches.observations, matches.valid, 1e9)
    # What goes on, with its residuals.
    states, r = [], []
    for k in range(len(hypotheses.R)):
        state = hypothesis_state(hypotheses.R[k], hypotheses.x[k])
        r.append(residuals(matches.observations, state))
        # The sign that puts its matches in front of the cameras; residuals change theirs with it.
        near = within(r[k], unsure, state, SHRINKING[0] * threshold)
        states.append(signed(state, cheirality_sign(matches.observations, near, state)))
    for scale in SHRINKING:
        costs = np.full(len(states), math.inf)
        # Wide selections hold outliers: their residuals are not pixel noise.
        noise, bound = scale * sigma, scale * threshold
        for k in range(len(states)):
            use = within(r[k], matches, states[k], bound)
            if use.sum() < 6:
                continue
            costs[k] = (_truncated_cost(r[k], matches.valid, bound, noise)
                        + prior_cost(states[k], priors))
            state = stepped(FitMatches(matches.observations, use.astype(np.float64), noise),
                            states[k], priors, STEPS)
            errors = residuals(matches.observations, state)
            cost = (_truncated_cost(errors, matches.valid, bound, noise)
                    + prior_cost(state, priors))
            if cost < costs[k]:
                states[k], r[k], costs[k] = state, errors, cost
        good = 0
        for cost in costs:
            good += 1 if cost < math.inf else 0
        if good == 0:
            return states[0], False
        better = [_take_least(costs) for _ in range((good + 1) // 2)]
        states, r = [states[k] for k in better], [r[k] for k in better]
    return states[0], True
