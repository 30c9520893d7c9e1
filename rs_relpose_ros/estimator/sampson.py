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
from rs_relpose_ros.core.losses import Flags
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
from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.jit import inlined_kernel, kernel, small_kernel

# Matches of a block. Fewer leave a part of the vector registers unused; more do not fit into the
# nearest cache with their rows. [chosen: any multiple of 8 in 32..128 would do]
BLOCK = 64
# First numbers of an observation: the vectors of both views, and the two row times. A block has
# the root of the weight behind them.
_PARTS = first_indices(view_1=9, view_2=9, times=2)
VIEW_1 = _PARTS['view_1']
VIEW_2 = _PARTS['view_2']
TIMES = _PARTS['times']
OBSERVATION = _PARTS['end']
ROOT = OBSERVATION


class Motion(NamedTuple):
    """A two-view state, and the rotations of its rays as polynomials in the row times."""

    state: TwoViewState
    rotation_1: Array  # (3, 3, 3) coefficients of ``Exp(tau_1 dw_1)`` in 1, tau_1, tau_1^2
    rotation_2: Array  # (3, 3, 3) coefficients of ``Exp(tau_2 dw_2) R`` in 1, tau_2, tau_2^2


@inlined_kernel
def _motion(state: TwoViewState) -> Motion:
    return Motion(
        state, _rotation_series(state.dw1, np.eye(3)), _rotation_series(state.dw2, state.R)
    )


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
    for k in (1, 2):
        for j in range(3):
            column = so3.cross(rate, series[k - 1, :, j])
            for i in range(3):
                series[k, i, j] = column[i] / k
    return series


@inlined_kernel
def _row_at(series, i, tau):  # type: ignore[no-untyped-def]
    """Row i of the rotation of `_rotation_series` at tau."""
    return (
        series[0, i, 0] + tau * (series[1, i, 0] + tau * series[2, i, 0]),
        series[0, i, 1] + tau * (series[1, i, 1] + tau * series[2, i, 1]),
        series[0, i, 2] + tau * (series[1, i, 2] + tau * series[2, i, 2]),
    )


@inlined_kernel
def _times(rows, v):  # type: ignore[no-untyped-def]
    """Product of a matrix, given by its three rows, and a vector."""
    return so3.dot(rows[0], v), so3.dot(rows[1], v), so3.dot(rows[2], v)


@inlined_kernel
def _view_at(block, i, first, series, tau):  # type: ignore[no-untyped-def]
    """Rotated ray of match i and its derivatives; its values begin in row `first` of the block."""
    rotation = (_row_at(series, 0, tau), _row_at(series, 1, tau), _row_at(series, 2, tau))
    return View(
        _times(rotation, so3.column(block, first, i)),
        _times(rotation, so3.column(block, first + 3, i)),
        _times(rotation, so3.column(block, first + 6, i)),
    )


@inlined_kernel
def _match(block, i, motion):  # type: ignore[no-untyped-def]
    """Both views of match i of a block, and the baseline between its rows."""
    tau1, tau2 = block[TIMES, i], block[TIMES + 1, i]
    first = _view_at(block, i, VIEW_1, motion.rotation_1, tau1)
    second = _view_at(block, i, VIEW_2, motion.rotation_2, tau2)
    return first, second, _baseline(motion.state, tau1, tau2)


@kernel
def _gather(observations: Array, weights: Array, first: int, block: Array) -> tuple[int, int]:
    """Fill `block` (21, BLOCK) with the matches that have a weight, from number `first` on.

    The last row holds the roots of their weights. Returns the next number, and how many matches
    there are. The rest of the block is zero, with zero residuals and derivatives.
    """
    count = 0
    while first < observations.shape[0] and count < BLOCK:
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
def _linearise(block, motion, basis, rows):  # type: ignore[no-untyped-def]
    """Derivatives of a block in `rows` (18, BLOCK), residuals last, times the weights' roots."""
    for i in range(BLOCK):
        first, second, baseline = _match(block, i, motion)
        at = residual(first, second, baseline)
        by_baseline, by_rotation_1, by_rotation_2 = by_motion(first, second, baseline, at)
        root, tau1, tau2 = block[ROOT, i], block[TIMES, i], block[TIMES + 1, i]
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
    n = observations.shape[0]
    motion = _motion(state)
    block, errors = np.empty((OBSERVATION + 1, BLOCK)), np.empty(BLOCK)
    everything = np.ones(n)
    out = np.empty(n)
    first = 0
    while first < n:
        following, count = _gather(observations, everything, first, block)
        for i in range(BLOCK):
            first_view, second_view, baseline = _match(block, i, motion)
            errors[i] = residual(first_view, second_view, baseline).value
        so3.copy_vector(errors[:count], out[first:])
        first = following
    return out


@kernel
def jacobian(observations: Array, state: TwoViewState) -> Array:
    """Derivatives (N, 17) of the Sampson errors by the local parameters."""
    n = observations.shape[0]
    motion = _motion(state)
    basis = so3.tangent_basis(state.t)
    block, rows = np.empty((OBSERVATION + 1, BLOCK)), np.empty((PARAMETERS + 1, BLOCK))
    everything = np.ones(n)
    out = np.empty((n, PARAMETERS))
    first = 0
    while first < n:
        following, count = _gather(observations, everything, first, block)
        _linearise(block, motion, basis, rows)
        for i in range(count):
            for j in range(PARAMETERS):
                out[first + i, j] = rows[j, i]
        first = following
    return out


@kernel
def normal_equations(
    observations: Array, weights: Array, state: TwoViewState
) -> tuple[Array, Array, float]:
    """``J^T W J`` (17, 17), ``J^T W r`` (17,) and ``r^T W r`` with the weights (N,) of matches."""
    motion = _motion(state)
    basis = so3.tangent_basis(state.t)
    block, rows = np.empty((OBSERVATION + 1, BLOCK)), np.empty((PARAMETERS + 1, BLOCK))
    # The residual as the last column of J: one product contains all three results. By BLAS, with
    # a fixed order of its sums: a block is too small for threads.
    gram = np.zeros((PARAMETERS + 1, PARAMETERS + 1))
    product = np.empty((PARAMETERS + 1, PARAMETERS + 1))
    first = 0
    while first < observations.shape[0]:
        first, _ = _gather(observations, weights, first, block)
        _linearise(block, motion, basis, rows)
        np.dot(rows, rows.T, product)
        gram += product
    hessian = gram[:PARAMETERS, :PARAMETERS].copy()
    return hessian, gram[PARAMETERS, :PARAMETERS].copy(), gram[PARAMETERS, PARAMETERS]


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


class RayMatches(NamedTuple):
    """All matches of a pair."""

    observations: Array  # (N, 20) rows as above
    valid: Flags  # (N,) those with finite rays
    angle_sigma: float  # noise of a ray [rad]


@kernel
def cheirality_sign(observations: Array, use: Flags, state: TwoViewState) -> float:
    """+1 or -1: the sign of (t, d_1, d_2) with more of the matches in front of the cameras.

    Matches are weighted with their parallax: the sign of a depth without parallax is noise.
    """
    vote = 0.0
    for i in range(observations.shape[0]):
        if use[i]:
            depth1, depth2, _, _ = triangulated(observations, i, state)
            if not math.isnan(depth1):
                # Bounded: a match on the baseline has an arbitrarily large inverse depth.
                vote += max(-1.0, min(1.0, 0.5 / depth1)) + max(-1.0, min(1.0, 0.5 / depth2))
    return 1.0 if vote >= 0.0 else -1.0


@small_kernel
def count_behind(matches: RayMatches, use: Flags, state: TwoViewState) -> int:
    """How many of the matches in `use` lie behind a camera, with a significant parallax."""
    count = 0
    for i in range(len(use)):
        if use[i]:
            depth1, depth2, parallax, _ = triangulated(matches.observations, i, state)
            significant = parallax >= SIGNIFICANT_PARALLAX * matches.angle_sigma
            if significant and min(depth1, depth2) <= 0.0:
                count += 1
    return count


@kernel
def within(r: Array, matches: RayMatches, state: TwoViewState, threshold: float) -> Flags:
    """Matches whose residuals `r` (N,) at `state` are below `threshold`, of plausible depths.

    A random match within the epipolar band has a small residual, but lies behind a camera or far
    from the others' depths.
    """
    n = len(r)
    use = np.empty(n, dtype=np.bool_)
    # Depths in units of the distance between the camera's places at the two rows; NaN: untested.
    relative = np.full(n, np.nan)
    known = np.empty(n)
    count = 0
    for i in range(n):
        use[i] = matches.valid[i] and abs(r[i]) < threshold
        if not use[i]:
            continue
        depth1, depth2, parallax, baseline = triangulated(matches.observations, i, state)
        if not parallax >= SIGNIFICANT_PARALLAX * matches.angle_sigma:
            continue
        if depth1 <= 0.0 or depth2 <= 0.0:
            use[i] = False
            continue
        relative[i] = known[count] = min(depth1, depth2) / baseline
        count += 1
    if count < _FEWEST_DEPTHS:
        return use
    # Near and far side separately: a scene is denser far away, and its few near points, which
    # resemble outliers, determine most of the translation.
    known, last = known[:count], count - 1
    near = math.log(so3.smallest(known, int(DEPTH_QUANTILES[0] * last)))
    centre = math.log(so3.smallest(known, int(DEPTH_QUANTILES[1] * last)))
    far = math.log(so3.smallest(known, int(DEPTH_QUANTILES[2] * last)))
    lowest = math.exp(centre - DEPTH_GATE * max(centre - near, MIN_DEPTH_SPREAD))
    highest = math.exp(centre + DEPTH_GATE * max(far - centre, MIN_DEPTH_SPREAD))
    for i in range(n):
        if relative[i] < lowest or relative[i] > highest:
            use[i] = False
    return use


@kernel
def select_inliers(matches: RayMatches, state: TwoViewState, threshold: float) -> Flags:
    """Matches within `threshold` [px] whose depths are plausible."""
    return within(residuals(matches.observations, state), matches, state, threshold)
