"""Covariance of a calibration: noise, and errors that a fit to one recording cannot average out.

Steps 2 to 4 of docs/calibration.md, "Method": noise of matches by a jackknife over stretches of
time; errors that regions of the image share (two-way clustering: A. C. Cameron, J. B. Gelbach,
D. L. Miller, J. Bus. Econ. Stat. 29, 2011); errors that both halves of the recording do not share
(R. T. Birge, Phys. Rev. 40, 1932); errors of the priors, and of p1 and p2.
"""

from dataclasses import replace
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special  # scipy.stats takes seconds to import, at the start of a node

from rs_relpose_ros.calibration.fit import (
    evaluate,
    evaluation,
    Fit,
    Flags,
    minimised,
    MOST_ROUNDS,
    normal_equations,
    sums_of,
    TOLERANCE,
)
from rs_relpose_ros.calibration.knowledge import TANGENTIAL_SIGMA
from rs_relpose_ros.calibration.model import GLOBAL, Problem, ROTATION, Unknowns
from rs_relpose_ros.core.least_squares import (
    adjusted_scores,
    grouped_covariance,
    inverse,
    JACKKNIFE,
)
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import log_so3

# -- Noise of the matches -------------------------------------------------------------------------

# Length of a stretch [s]. Errors may be correlated within one: tracks live for about a second.
# [chosen: shorter stretches would share tracks, longer ones leave few groups]
_STRETCH = 1.0
# Least number of stretches. The scatter of fewer groups is hardly known.
# [chosen: Student's t of 9 degrees of freedom widens by 6 %]
_LEAST_STRETCHES = 10
# Largest number of stretches. More cost time and change nothing.
# [chosen: the scatter of 30 groups is known to 13 %]
_MOST_STRETCHES = 30
# Least duration [s] that times are divided by, of pairs at one time.
# [chosen: any value below the interval of frames would do]
_LEAST_DURATION = 1e-9
# Multiple of the Newton step that is left, which the sigmas of a fit that has not converged
# contain. [chosen: that by which steps are extended at most]
_OF_LEFT = 8.0


def fit(
    problem: Problem,
    unknowns: Unknowns,
    free: Flags,
    *,
    rounds: int = MOST_ROUNDS,
    tolerance: float = TOLERANCE,
) -> Fit:
    """`minimised`, with the covariance by the noise of the matches.

    After `rounds` the sigmas contain what may be left to the optimum.
    """
    found = minimised(problem, unknowns, free, rounds=rounds, tolerance=tolerance)
    at, prior = found.evaluation, problem.prior[found.block]
    curvatures = bent(found.weights) * at.reduced
    of_free = jackknife(at.score, curvatures, stretches(problem.middles), prior)
    # Few stretches may scatter less than independent matches would: the larger one counts.
    inverse_curvature = inverse(curvatures.sum(axis=0) + prior)
    of_prior = inverse_curvature @ prior @ inverse_curvature
    of_noise = of_free - of_prior
    # A weight counts once in the information, and twice in the variance of a score.
    scatter = np.einsum('p,pij->ij', problem.weight, at.reduced)
    formal = inverse_curvature @ scatter @ inverse_curvature
    scattered = np.maximum(np.diag(of_noise), np.finfo(float).tiny)
    wider = np.sqrt(np.maximum(np.diag(formal) / scattered, 1.0))
    of_free = of_noise * np.outer(wider, wider) + of_prior
    if not found.converged:
        of_free += _OF_LEFT**2 * np.outer(found.left, found.left)
    covariance = np.zeros((GLOBAL, GLOBAL))
    covariance[found.block] = of_free
    return replace(found, covariance=covariance)


def stretches(times: Array) -> NDArray[np.int64]:
    """Stretch (P,) of the recording that each time (P,) [s] belongs to."""
    begin, duration = times.min(), max(float(np.ptp(times)), _LEAST_DURATION)
    count = int(np.clip(duration / _STRETCH, _LEAST_STRETCHES, _MOST_STRETCHES))
    numbers = ((times - begin) / duration * count).astype(np.int64)
    return np.minimum(numbers, count - 1)


# Multiple of the median misfit of the stretches from which one has less weight. A smaller one
# discards data of stretches that scatter by chance, a larger one lets a stretch with a fault of
# its own decide. [measured: the largest misfit over the median is 1.9, 2.6 and 3.3 in recordings
# without such a stretch, 7.2 in one with blur, whose focal length is 1.2 of its sigmas off with a
# limit of 1, and 1.7 with 2]
_TYPICAL_MISFIT = 1.5
# Share of the largest eigenvalue of a stretch's information, in sigmas of the whole, below which
# the stretch says nothing in that direction. [chosen: 1e-4 to 1e-2 would do]
_SAYS_NOTHING = 1e-3


# Relative change of the weights of pairs below which they stay. A smaller one costs fits, each of
# which changes less than a fifth of a sigma. [chosen: 0.1 to 0.3 would do]
_STAYS = 0.2
# Largest number of fits with weights. [chosen: two or three are usual]
_MOST_WEIGHINGS = 4


def weighted(found: Fit) -> Fit:
    """The fit with the weights of its stretches of time: both in turn until these stay."""
    for _ in range(_MOST_WEIGHINGS):
        before = found.problem.weight
        weight = weights_of_stretches(found)
        if (np.abs(weight - before) <= _STAYS * weight).all():
            break
        found = fit(found.problem._replace(weight=weight), found.unknowns, found.free)
    return found


def weights_of_stretches(found: Fit) -> Array:
    """Weight (P,) of each pair by how well its stretch of time agrees with all others.

    Pairs that overlap, and the errors of a tracker, scatter more than independent matches: by the
    median misfit of the stretches. Divided by it, the matches count against priors as much as
    they repeat. A stretch that contradicts the others by more, as with blur or an object that
    moves, has less weight, as of a normal deviate with an unknown variance.
    """
    stretch = stretches(found.problem.middles)
    names = np.unique(stretch)
    if len(names) < _LEAST_STRETCHES - 1:
        return found.problem.weight
    misfits = np.array([_misfit_of(found, stretch == name) for name in names])
    typical = max(float(np.median(misfits)), 1.0)
    weights = np.minimum(_TYPICAL_MISFIT * typical / np.maximum(misfits, typical), 1.0) / typical
    return np.asarray(weights[np.searchsorted(names, stretch)])


def _misfit_of(found: Fit, part: NDArray[np.bool_]) -> float:
    """Chi-square over its degrees of freedom of some pairs, at the optimum of all others."""
    at, curve = found.evaluation, bent(found.weights)
    own = curve * at.reduced[part].sum(axis=0)
    rest = curve * at.reduced.sum(axis=0) + found.problem.prior[found.block] - own
    # The score and its covariance at the optimum of the rest, which these pairs have moved.
    own_score = at.score[part].sum(axis=0)
    score = own_score + own @ np.linalg.solve(rest, own_score)
    covariance = own + own @ np.linalg.solve(rest, own)
    # Scaled: the parameters have different units.
    scale = 1.0 / np.sqrt(np.diag(rest + own))
    scaled = covariance * np.outer(scale, scale)
    variances, directions = np.linalg.eigh(0.5 * (scaled + scaled.T))
    along = directions.T @ (scale * score)
    says = variances > _SAYS_NOTHING * variances[-1]
    squares = along[says] ** 2 / variances[says]
    weight = float(found.problem.weight[part].mean())
    return float(squares.mean()) / weight


def jackknife(scores: Array, curvatures: Array, groups: NDArray[np.int64], prior: Array) -> Array:
    """Covariance (k, k) by deleting a group each: one Newton step from the optimum.

    Unlike the sandwich estimate, it is not biased by the parameters having been fitted to the few
    groups (B. Efron, R. Tibshirani, An Introduction to the Bootstrap, 1993, chapter 11). `scores`
    (P, k): gradients of the cost by pair; `curvatures` (P, k, k): their derivatives; `prior`
    (k, k): information that counts as known.
    """
    names = np.unique(groups)
    sums = np.stack([scores[groups == name].sum(axis=0) for name in names])
    of_groups = np.stack([curvatures[groups == name].sum(axis=0) for name in names])
    # Scores add up to the pull of the prior, which is no scatter.
    scatter = math.sqrt(of_few_groups(len(names))) * (sums - sums.mean(axis=0))
    return np.asarray(grouped_covariance(scatter, of_groups, prior, JACKKNIFE))


def of_few_groups(count: int) -> float:
    """Factor of the variance of a jackknife over a number of groups.

    The scatter of few groups is uncertain, so that errors in sigmas follow Student's t: widened,
    one sigma has the coverage of a normal deviate.
    """
    wider = special.stdtrit(count - 1, special.ndtr(1.0)) ** 2
    return float(wider * (count - 1) / count)


def bent(weights: Array) -> float:
    """Curvature of the loss, all (N,) matches, over the weight of Gauss-Newton."""
    return float((weights * (4.0 * np.sqrt(weights) - 3.0)).sum() / weights.sum())


# -- Errors beyond the noise of the matches -------------------------------------------------------

# Columns of regions of the image, with equally many points each. More have too few points to
# scatter by more than noise, fewer hide a local error. [chosen: as the regions of a pair]
_COLUMNS = 4
# Rows of these regions. [chosen: as the regions of a pair, by the shape of an image]
_ROWS = 3
# Mean squared difference, in sigmas, of the parameters of two halves that is chance.
# [derived: the 95 % quantile of chi-square over its degrees of freedom, for the ten to twelve
# parameters of a fit, is 1.75 to 1.83]
_CHANCE = 1.75
# Squared difference of one parameter that is no chance. [chosen: 3 sigmas]
_GROSS = 9.0
# Rounds of the fit of each half, from the optimum of the whole.
# [chosen: a fit of a half takes five to ten]
_HALF_ROUNDS = 15


# Share of the sigma of a single pair that all pairs from images have in common, and that is not
# reduced by averaging: a tracker's errors follow the texture and the motion. Less makes sigmas of
# many pairs too small, more hides what a long recording determines. [measured: a rendered lens of
# 320x240 pixels, whose focal length and k3 are 3 sigma off without it; the monitor has 0.15]
_SHARED = 0.06


def widened(final: Fit, *, in_images: bool = False) -> Fit:
    """The fit with a covariance of all errors, not only the noise of the matches.

    The errors of the priors, which recordings of one camera share, are no scatter: regions and
    halves do not widen them. `in_images` is whether a tracker followed the points: its own errors,
    and p1 and p2 of the lens, which no fit estimates, are added.
    """
    by_prior = _by_prior(final)
    of_noise = final.covariance - by_prior @ by_prior.T
    of_halves, apart = _disagreement(final, of_noise)
    of_regions = _between_regions(final, of_noise)
    wider = np.sqrt(of_regions * of_halves)
    by_tangential = np.zeros((GLOBAL, 2))
    shared = 1.0
    if in_images:
        by_tangential[final.free] = _by_tangential(final, TANGENTIAL_SIGMA)
        shared += _SHARED**2 * final.problem.pairs
    by_doubt = np.hstack([by_prior, by_tangential])
    covariance = shared * of_noise * np.outer(wider, wider) + by_doubt @ by_doubt.T
    return replace(
        final, covariance=covariance, by_doubt=by_doubt, halves_apart=apart, regions=of_regions
    )


def _by_prior(final: Fit) -> Array:
    """Moves (GLOBAL, GLOBAL) of the optimum by one sigma of each independent part of the prior."""
    prior = final.problem.prior[final.block]
    scale = np.sqrt(np.diag(prior))
    known = scale > 0.0
    units = np.where(known, scale, 1.0)
    shape = prior / np.outer(units, units) + np.diag(np.where(known, 0.0, 1.0))
    root = scale[:, None] * np.linalg.cholesky(shape)
    moves = np.zeros((GLOBAL, GLOBAL))
    moves[final.block] = inverse(_curvature(final) + prior) @ root
    return moves


def _curvature(final: Fit) -> Array:
    """Hessian (k, k) of the free parameters by the matches, with the curvature of the loss."""
    return np.asarray(bent(final.weights) * final.information)


def shaped(final: Fit, covariance: Array) -> Array:
    """The variances of `covariance` (GLOBAL, GLOBAL) with the correlations of the Hessian."""
    block = final.block
    formal = np.asarray(inverse(_curvature(final) + final.problem.prior[block]))
    wider = np.sqrt(np.diag(covariance[block]) / np.diag(formal))
    shape = np.zeros_like(covariance)
    shape[block] = formal * np.outer(wider, wider)
    return shape


def _of_noise(final: Fit) -> Array:
    """Variances (GLOBAL,) without the errors of the priors."""
    by_prior = _by_prior(final)
    return np.asarray(np.diag(final.covariance) - (by_prior**2).sum(axis=1))


# Share of a doubt for which derivatives are differences. [chosen: residuals change by less than
# their noise, and more than by rounding; any value in 1e-4..0.1 would do]
_SMALL = 0.01


def _by_tangential(final: Fit, sigma: float) -> Array:
    """Moves (k, 2) of the free parameters by one sigma of p1 and of p2."""
    problem, unknowns, free = final.problem, final.unknowns, final.free
    H, _ = normal_equations(problem, final.evaluation, unknowns, free)
    x = problem.points[..., 0]
    y = problem.points[..., 1]
    mixed = 2.0 * x * y
    squares = x * x + y * y
    by_p1 = np.stack([mixed, squares + 2.0 * y * y], axis=-1)
    by_p2 = np.stack([squares + 2.0 * x * x, mixed], axis=-1)
    here = final.evaluation.score.sum(axis=0)
    gradients = np.empty((len(here), 2))
    step = _SMALL * sigma
    for k, displacement in enumerate((by_p1, by_p2)):
        moved = problem._replace(points=problem.points - step * displacement)
        there = evaluate(moved, unknowns, free)
        gradients[:, k] = (there.score.sum(axis=0) - here) / _SMALL
    return np.asarray(np.linalg.solve(H, gradients))


def _between_regions(final: Fit, of_noise: Array) -> Array:
    """Factors (GLOBAL,) of the variances by the scatter of regions beyond that of cells.

    `of_noise` (GLOBAL, GLOBAL) is the covariance without the errors of the priors. Cells are
    regions of the image times stretches of time: if the regions scatter no more than these, the
    scatter of the stretches is complete.
    """
    problem, unknowns, free = final.problem, final.unknowns, final.free
    region, stretch = _regions(problem.points[0]), stretches(problem.middles)
    sums = sums_of(problem, unknowns, free)
    whole, curve = evaluation(problem, unknowns, sums), bent(final.weights)
    scores, curvatures, cells = [], [], []
    for name in np.unique(region):
        of_region = sums_of(problem.matches(region == name), unknowns, free)
        others = sums._replace(
            gradient=sums.gradient - of_region.gradient,
            hessian=sums.hessian - of_region.hessian,
        )
        rest = evaluation(problem, unknowns, others)
        own = whole.score - rest.score
        scores.append(own.sum(axis=0))
        curvatures.append(curve * (whole.reduced - rest.reduced).sum(axis=0))
        cells += [own[stretch == k].sum(axis=0) for k in np.unique(stretch)]
    H = curve * whole.reduced.sum(axis=0) + problem.prior[final.block]
    adjusted = adjusted_scores(np.array(scores), np.array(curvatures), H, JACKKNIFE)
    of_regions = adjusted.T @ adjusted * of_few_groups(len(adjusted))
    of_cells = np.transpose(cells) @ np.array(cells)
    covariance = inverse(H)
    beyond = np.diag(covariance @ (of_regions - of_cells) @ covariance)
    factors = np.ones(GLOBAL)
    factors[free] += np.maximum(beyond, 0.0) / np.diag(of_noise)[free]
    return factors


def _regions(points: Array) -> NDArray[np.int64]:
    """Region (N,) of the image of each point (N, 2): columns and rows of equally many points."""

    def band(values: Array, count: int) -> NDArray[np.int64]:
        borders = np.quantile(values, np.arange(1, count) / count)
        return np.searchsorted(borders, values)

    return band(points[:, 0], _COLUMNS) + _COLUMNS * band(points[:, 1], _ROWS)


def _disagreement(final: Fit, of_noise: Array) -> tuple[Array, float]:
    """Factors (GLOBAL,) of the variances by the difference of both halves; 1 if it is chance.

    Also its mean square over the parameters, in sigmas.

    `of_noise` (GLOBAL, GLOBAL) is the covariance without the errors of the priors, which both
    halves share.
    """
    middles, free = final.problem.middles, final.free
    first = middles < np.median(middles)
    one, other = (
        fit(
            final.problem.pairs_of(part),
            final.unknowns.pairs_of(part),
            free,
            rounds=_HALF_ROUNDS,
        )
        for part in (first, ~first)
    )
    difference = one.unknowns.parameters - other.unknowns.parameters
    turn = one.unknowns.R_cam_imu @ other.unknowns.R_cam_imu.T
    difference[ROTATION] = log_so3(np.ascontiguousarray(turn))
    # The whole lets expect four times its own; less than half of that is chance, of few stretches.
    expected = _of_noise(one) + _of_noise(other)
    variances = np.maximum(expected, 2.0 * np.diag(of_noise))
    squares = difference[free] ** 2 / variances[free]
    mean = float(np.minimum(squares, _GROSS).mean())
    of_all = mean if mean > _CHANCE else 1.0
    factors = np.ones(GLOBAL)
    factors[free] = np.maximum(of_all, np.where(squares > _GROSS, squares, 1.0))
    return factors, mean


# -- Use of a calibration -------------------------------------------------------------------------

# Largest sigma of the direction of motion of a pair by the noise of its matches [rad]: beyond it a
# pair nearly without motion would hide any doubt. [chosen: 6 deg]
_KNOWN_DIRECTION = 0.1


def move_of_poses(final: Fit, covariance: Array) -> float:
    """Move of the direction of the median pair by the doubt of the parameters, over its sigma."""
    at = final.evaluation
    lower = at.own.transpose(2, 0, 1)
    upper = np.tril(lower, -1).transpose(0, 2, 1)
    of_noise = np.linalg.inv(lower + upper)
    back = at.back[:-1, :2].transpose(2, 1, 0)
    of_doubt = back @ covariance[final.block] @ back.transpose(0, 2, 1)
    noise = min(_median_size(of_noise[:, :2, :2]), _KNOWN_DIRECTION)
    return _median_size(of_doubt) / noise


def _median_size(of_pairs: NDArray[Any]) -> float:
    """Sigma of the median pair, from the covariances (P, 2, 2) of the pairs' directions."""
    variances = np.trace(of_pairs, axis1=1, axis2=2)
    return float(np.sqrt(np.median(variances)))
