"""Residuals of a two-view state with their exact Jacobian, depths of its matches, and inliers.

The residual of a match is that of `core.epipolar`, with ``b = t - tau_1 d_1 + tau_2 d_2`` and
``h = R f_2`` (docs/conventions.md).

A row of `observations` has 20 numbers for one match: the vectors f_1, df_1/du, df_1/dv, f_2,
df_2/du and df_2/dv, each derotated to the middle row of its frame, and the row times tau_1 and
tau_2.

Matches are evaluated in blocks with the values of one quantity contiguous in memory, which the
compiler vectorises. For that it must know the strides, hence the arrays of fixed shape and the
forced inlining.
"""

import math
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.core.epipolar import by_motion, residual, View
from rs_relpose_ros.core.least_squares import first_indices
from rs_relpose_ros.core.triangulate import depths
from rs_relpose_ros.estimator.priors import (
    D1,
    D2,
    DW1,
    DW2,
    PARAMETERS,
    TANGENT,
    THETA,
    TwoViewState,
)
from rs_relpose_ros.geometry import Array, Flags, so3
from rs_relpose_ros.jit import inlined_kernel, kernel, small_kernel

# Matches of a block. Fewer leave a part of the vector registers unused; more do not fit into the
# nearest cache with their rows. [chosen: any multiple of 8 in 32..128 would do]
BLOCK = 64
# First numbers of an observation: the vectors of both views, and the two row times. A block has
# the root of the weight behind them. [derived: three vectors in each view]
_PARTS = first_indices(view_1=9, view_2=9, times=2)
# First number of the view in image 1. [derived: the order of the parts]
VIEW_1 = _PARTS['view_1']
# First number of the view in image 2. [derived: the order of the parts]
VIEW_2 = _PARTS['view_2']
# Number of tau_1, which tau_2 follows. [derived: the order of the parts]
TIMES = _PARTS['times']
# Count of the numbers. [derived: the sizes of the parts]
OBSERVATION = _PARTS['end']
# Row of a block that holds the roots of the weights. [derived: the first row after the numbers]
ROOT = OBSERVATION


class FitMatches(NamedTuple):
    """The matches of a pair as rows of numbers, and how much each of them counts."""

    observations: Array  # (N, 20) rows as above
    weights: Array  # (N,) 0 to 1; 0 for a match that is not used
    sigma: float  # noise of a match of weight 1 [px]
    # Mean focal length [px per radian], which makes the noise an angle where depths are tested.
    # They are not tested if it is NaN.
    focal: float = math.nan


@inlined_kernel
def _rotations(state: TwoViewState) -> tuple[Array, Array]:
    """Coefficients of ``Exp(tau_1 dw_1)`` and ``Exp(tau_2 dw_2) R`` by `_rotation_series`."""
    return _rotation_series(state.dw1, np.eye(3)), _rotation_series(state.dw2, state.R)


@inlined_kernel
def _baseline(state, tau1, tau2):  # type: ignore[no-untyped-def]
    """``t - tau_1 d_1 + tau_2 d_2``."""
    moved = so3.add(so3.scale(-tau1, state.d1), so3.scale(tau2, state.d2))
    return so3.add(state.t, moved)


@inlined_kernel
def _rotation_series(rate: Array, R: Array) -> Array:
    """Coefficients (3, 3, 3) of ``Exp(tau w) R`` in 1, tau, tau^2.

    The rate w is a correction of the gyro, so small that the next coefficient is below rounding.
    """
    series = np.empty((3, 3, 3))
    so3.copy_matrix(R, series[0])
    for power in (1, 2):
        lower = series[power - 1]
        for j in range(3):
            column = so3.cross(rate, lower[:, j])
            for i in range(3):
                series[power, i, j] = column[i] / power
    return series


@inlined_kernel
def _row_at(series, i, tau):  # type: ignore[no-untyped-def]
    """Row i of the rotation of `_rotation_series` at tau, by Horner's scheme."""
    by_tau = so3.add(series[1, i], so3.scale(tau, series[2, i]))
    return so3.add(series[0, i], so3.scale(tau, by_tau))


@inlined_kernel
def _times(rows, v):  # type: ignore[no-untyped-def]
    """Product of a matrix, given by its three rows, and a vector."""
    return so3.dot(rows[0], v), so3.dot(rows[1], v), so3.dot(rows[2], v)


@inlined_kernel
def _view_at(block, i, first, series, tau):  # type: ignore[no-untyped-def]
    """Rotated ray of match i and its derivatives; its values begin in row `first` of the block."""
    rotation = (_row_at(series, 0, tau), _row_at(series, 1, tau), _row_at(series, 2, tau))
    ray = so3.column(block, first, i)
    by_u = so3.column(block, first + 3, i)
    by_v = so3.column(block, first + 6, i)
    return View(_times(rotation, ray), _times(rotation, by_u), _times(rotation, by_v))


@inlined_kernel
def _match(block, i, state, rotations):  # type: ignore[no-untyped-def]
    """Both views of match i of a block, and the baseline between its rows."""
    tau1 = block[TIMES, i]
    tau2 = block[TIMES + 1, i]
    first = _view_at(block, i, VIEW_1, rotations[0], tau1)
    second = _view_at(block, i, VIEW_2, rotations[1], tau2)
    return first, second, _baseline(state, tau1, tau2)


@kernel
def _gather(observations: Array, weights: Array, first: int, block: Array) -> tuple[int, int]:
    """Fill `block` (21, BLOCK) with the matches that have a weight, from number `first` on.

    The last row holds the roots of their weights. Returns the next number, and how many matches
    there are. The rest of the block is zero, with zero residuals and derivatives.
    """
    count = 0
    while first < len(observations) and count < BLOCK:
        if weights[first] > 0.0:
            for k in range(OBSERVATION):
                block[k, count] = observations[first, k]
            block[ROOT, count] = math.sqrt(weights[first])
            count += 1
        first += 1
    for i in range(count, BLOCK):
        for k in range(OBSERVATION + 1):
            block[k, i] = 0.0
    return first, count


@inlined_kernel
def _linearise(block, state, rotations, basis, rows):  # type: ignore[no-untyped-def]
    """Derivatives of a block in `rows` (18, BLOCK), residuals last, times the weights' roots."""
    for i in range(BLOCK):
        first, second, baseline = _match(block, i, state, rotations)
        at = residual(first, second, baseline)
        by_baseline, by_rotation_1, by_rotation_2 = by_motion(first, second, baseline, at)
        root = block[ROOT, i]
        tau1 = block[TIMES, i]
        tau2 = block[TIMES + 1, i]
        by_baseline = so3.scale(root, by_baseline)
        by_rotation_1 = so3.scale(root, by_rotation_1)
        by_rotation_2 = so3.scale(root, by_rotation_2)
        so3.write_column(by_rotation_2, rows, THETA, i)
        rows[TANGENT, i] = so3.dot(by_baseline, so3.column(basis, 0, 0))
        rows[TANGENT + 1, i] = so3.dot(by_baseline, so3.column(basis, 0, 1))
        so3.write_column(so3.scale(-tau1, by_baseline), rows, D1, i)
        so3.write_column(so3.scale(tau2, by_baseline), rows, D2, i)
        so3.write_column(so3.scale(tau1, by_rotation_1), rows, DW1, i)
        so3.write_column(so3.scale(tau2, by_rotation_2), rows, DW2, i)
        rows[PARAMETERS, i] = root * at.value


@kernel
def residuals(observations: Array, state: TwoViewState) -> Array:
    """Signed Sampson errors (N,) [px] of observation rows (N, 20)."""
    n = len(observations)
    rotations = _rotations(state)
    block = np.empty((OBSERVATION + 1, BLOCK))
    errors = np.empty(BLOCK)
    everything = np.ones(n)
    out = np.empty(n)
    first = 0
    while first < n:
        following, count = _gather(observations, everything, first, block)
        for i in range(BLOCK):
            view_1, view_2, baseline = _match(block, i, state, rotations)
            errors[i] = residual(view_1, view_2, baseline).value
        so3.copy_vector(errors[:count], out[first:])
        first = following
    return out


@kernel
def jacobian(observations: Array, state: TwoViewState) -> Array:
    """Derivatives (N, 17) of the Sampson errors by the local parameters."""
    n = len(observations)
    rotations = _rotations(state)
    basis = so3.tangent_basis(state.t)
    block = np.empty((OBSERVATION + 1, BLOCK))
    rows = np.empty((PARAMETERS + 1, BLOCK))
    everything = np.ones(n)
    out = np.empty((n, PARAMETERS))
    first = 0
    while first < n:
        following, count = _gather(observations, everything, first, block)
        _linearise(block, state, rotations, basis, rows)
        for i in range(count):
            so3.copy_vector(rows[:PARAMETERS, i], out[first + i])
        first = following
    return out


@kernel
def normal_equations(
    observations: Array, weights: Array, state: TwoViewState
) -> tuple[Array, Array, float]:
    """``J^T W J`` (17, 17), ``J^T W r`` (17,) and ``r^T W r`` with the weights (N,) of matches."""
    rotations = _rotations(state)
    basis = so3.tangent_basis(state.t)
    block = np.empty((OBSERVATION + 1, BLOCK))
    rows = np.empty((PARAMETERS + 1, BLOCK))
    # The residual is the last column of J, so that one product contains all three results. BLAS
    # adds in a fixed order, because a block is too small for threads.
    gram = np.zeros((PARAMETERS + 1, PARAMETERS + 1))
    product = np.empty((PARAMETERS + 1, PARAMETERS + 1))
    first = 0
    while first < len(observations):
        first, _ = _gather(observations, weights, first, block)
        _linearise(block, state, rotations, basis, rows)
        np.dot(rows, rows.T, product)
        gram += product
    hessian = gram[:PARAMETERS, :PARAMETERS].copy()
    gradient = gram[PARAMETERS, :PARAMETERS].copy()
    return hessian, gradient, gram[PARAMETERS, PARAMETERS]


@kernel
def triangulated(
    observations: Array, i: int, state: TwoViewState
) -> tuple[float, float, float, float]:
    """Depths of match i along both rays [baselines], its parallax [rad] and length of baseline.

    The baseline lies between the places of the camera at the two rows of the match. Depths are
    NaN if the rays are parallel.
    """
    o = observations[i]
    b = _baseline(state, o[TIMES], o[TIMES + 1])
    h = so3.rotated(state.R, o[VIEW_2 : VIEW_2 + 3])
    depth1, depth2, parallax = depths(o[VIEW_1 : VIEW_1 + 3], h, b)
    return depth1, depth2, parallax, so3.norm(b)


# -- Inliers of a state: by residuals and by depths -----------------------------------------------

# Parallax, in units of its noise, from which on a depth is tested. With less, the sign of a depth
# is noise, and good matches far away would be lost. [derived: one depth in 30 000 has the wrong
# sign at 4 sigmas]
SIGNIFICANT_PARALLAX = 4.0
# Largest distance of the logarithm of a depth from the median, in units of the distance of the
# quantile on that side. A smaller gate removes near points, which determine most of the
# translation; a larger one keeps random matches. [derived: 4 sigmas of a log-normal depth]
DEPTH_GATE = 4.0
# Quantiles of the depths: one sigma below the median, the median, and one sigma above.
# [derived: of the normal distribution]
DEPTH_QUANTILES = (0.16, 0.5, 0.84)
# Least spread of the depths of a scene (log units). It keeps the gate open on planar scenes.
# [chosen: e^(4 * 0.25), a factor of e in depth, any value in 0.15..0.5 would do]
MIN_DEPTH_SPREAD = 0.25
# Number of tested depths below which their quantiles say nothing.
# [chosen: any value in 6..20 would do]
_FEWEST_DEPTHS = 8


@kernel
def cheirality_sign(observations: Array, use: Flags, state: TwoViewState) -> float:
    """+1 or -1: the sign of (t, d_1, d_2) with more of the matches in front of the cameras.

    Matches are weighted with their parallax: the sign of a depth without parallax is noise.
    """
    vote = 0.0
    for i in range(len(use)):
        if use[i]:
            depth1, depth2, _, _ = triangulated(observations, i, state)
            if not math.isnan(depth1):
                # A match on the baseline has an arbitrarily large inverse depth, hence the bounds.
                vote_1 = max(-1.0, min(1.0, 0.5 / depth1))
                vote_2 = max(-1.0, min(1.0, 0.5 / depth2))
                vote += vote_1 + vote_2
    return 1.0 if vote >= 0.0 else -1.0


@small_kernel
def count_behind(matches: FitMatches, use: Flags, state: TwoViewState) -> int:
    """How many of the matches in `use` lie behind a camera, with a significant parallax."""
    least_parallax = SIGNIFICANT_PARALLAX * (matches.sigma / matches.focal)
    count = 0
    for i in range(len(use)):
        if use[i]:
            depth1, depth2, parallax, _ = triangulated(matches.observations, i, state)
            if parallax >= least_parallax and min(depth1, depth2) <= 0.0:
                count += 1
    return count


@kernel
def within(r: Array, matches: FitMatches, state: TwoViewState, threshold: float) -> Flags:
    """Matches whose residuals `r` (N,) at `state` are below `threshold`, of plausible depths.

    A random match within the epipolar band has a small residual, but lies behind a camera or far
    from the depths of the others.
    """
    n = len(r)
    use = np.empty(n, dtype=np.bool_)
    # Depths in units of the distance between the places of the camera at the two rows; NaN for a
    # match whose depth is not tested.
    relative = np.full(n, np.nan)
    tested = np.empty(n)
    count = 0
    least_parallax = SIGNIFICANT_PARALLAX * (matches.sigma / matches.focal)
    for i in range(n):
        use[i] = matches.weights[i] > 0.0 and abs(r[i]) < threshold
        if not use[i]:
            continue
        depth1, depth2, parallax, baseline = triangulated(matches.observations, i, state)
        nearest = min(depth1, depth2)
        if not parallax >= least_parallax:
            continue
        if nearest <= 0.0:
            use[i] = False
            continue
        relative[i] = nearest / baseline
        tested[count] = relative[i]
        count += 1
    if count < _FEWEST_DEPTHS:
        return use
    lowest, highest = _plausible_depths(tested[:count])
    for i in range(n):
        if relative[i] < lowest or relative[i] > highest:
            use[i] = False
    return use


@kernel
def _plausible_depths(depths: Array) -> tuple[float, float]:
    """Least and largest plausible depth, from all tested ones (K,), which are reordered.

    The near and the far side have a spread of their own: a scene is denser far away, and its few
    near points, which resemble outliers, determine most of the translation.
    """
    logarithms = np.empty(3)
    for k in range(3):
        place = int(DEPTH_QUANTILES[k] * (len(depths) - 1))
        logarithms[k] = math.log(so3.smallest(depths, place))
    centre = logarithms[1]
    nearer = DEPTH_GATE * max(centre - logarithms[0], MIN_DEPTH_SPREAD)
    farther = DEPTH_GATE * max(logarithms[2] - centre, MIN_DEPTH_SPREAD)
    return math.exp(centre - nearer), math.exp(centre + farther)


@kernel
def select_inliers(matches: FitMatches, state: TwoViewState, threshold: float) -> Flags:
    """Matches within `threshold` [px] whose depths are plausible."""
    return within(residuals(matches.observations, state), matches, state, threshold)
