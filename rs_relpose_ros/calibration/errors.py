"""Covariance of a calibration: noise, and errors that a fit to one recording cannot average out.

Step 3 of docs/calibration.md, "Method": noise of the matches by the model, by a jackknife over
blocks of time and by one over regions of the image, the largest of which counts; errors of the
priors, and of p1 and p2.
"""

from dataclasses import replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy import special  # scipy.stats takes seconds to import, at the start of a node

from rs_relpose_ros.calibration.fit import (
    evaluation,
    Fit,
    Flags,
    minimised,
    MOST_ROUNDS,
    sums_of,
    TOLERANCE,
)
from rs_relpose_ros.calibration.model import GLOBAL, Problem, Unknowns
from rs_relpose_ros.core.least_squares import adjusted_scores, inverse, JACKKNIFE
from rs_relpose_ros.geometry import Array

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
# Blocks of time of the jackknife. Errors that last for seconds, as of a scene or a motion, are in
# one block; more blocks would share them, fewer leave a scatter that is hardly known.
# [chosen: Student's t of 9 degrees of freedom widens by 6 %; 8 to 15 would do]
_BLOCKS = 10
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
    by_prior = _by_prior(found)[free]
    of_model = _of_model(found)
    of_time = Groups.of_time(found).jackknife()
    of_free = _widened_to(of_model, of_time) + by_prior @ by_prior.T
    if not found.converged:
        of_free += _OF_LEFT**2 * np.outer(found.left, found.left)
    covariance = np.zeros((GLOBAL, GLOBAL))
    covariance[found.block] = of_free
    return replace(found, covariance=covariance)


def _hessian(final: Fit) -> Array:
    """Hessian (k, k) of the free parameters, with the curvature of the loss and the prior."""
    return np.asarray(bent(final.weights) * final.information + final.problem.prior[final.block])


def _of_model(final: Fit) -> Array:
    """Covariance (k, k) of the optimum if matches are as independent as their weights say."""
    # A weight counts once in the information, and twice in the variance of a score.
    scatter = np.einsum('p,pij->ij', final.problem.weight, final.evaluation.reduced)
    covariance = inverse(_hessian(final))
    return np.asarray(covariance @ scatter @ covariance)


def _widened_to(covariance: Array, variances: Array) -> Array:
    """The covariance (k, k) with at least these variances (k,) and the same correlations."""
    own = np.maximum(np.diag(covariance), np.finfo(float).tiny)
    wider = np.sqrt(np.maximum(variances / own, 1.0))
    return np.asarray(covariance * np.outer(wider, wider))


class Groups(NamedTuple):
    """Sums of a fit over G groups of its matches, by its k free parameters.

    Without one of them the optimum is a Newton step away: no fit is made.
    """

    scores: Array  # (G, k)
    curvatures: Array  # (G, k, k), with the curvature of the loss
    hessian: Array  # (k, k) of all, with the prior

    @classmethod
    def of(cls, final: Fit, scores: Array, curvatures: Array) -> Self:
        """Groups whose curvatures are those of Gauss-Newton."""
        return cls(scores, bent(final.weights) * curvatures, _hessian(final))

    @classmethod
    def of_time(cls, final: Fit) -> Self:
        """The blocks of time."""
        at = final.evaluation
        block = blocks_of_time(final.problem.middles)
        names = np.unique(block)
        scores = np.stack([at.score[block == name].sum(axis=0) for name in names])
        reduced = np.stack([at.reduced[block == name].sum(axis=0) for name in names])
        return cls.of(final, scores, reduced)

    @classmethod
    def of_image(cls, final: Fit) -> Self:
        """The regions of the image: what the sums of the pairs lack without the matches there."""
        problem = final.problem
        unknowns = final.unknowns
        free = final.free
        region = _regions(problem.points[0])
        sums = sums_of(problem, unknowns, free)
        whole = evaluation(problem, unknowns, sums)
        scores = []
        curvatures = []
        for name in np.unique(region):
            of_region = sums_of(problem.matches(region == name), unknowns, free)
            others = sums._replace(
                gradient=sums.gradient - of_region.gradient,
                hessian=sums.hessian - of_region.hessian,
            )
            rest = evaluation(problem, unknowns, others)
            scores.append((whole.score - rest.score).sum(axis=0))
            curvatures.append((whole.reduced - rest.reduced).sum(axis=0))
        return cls.of(final, np.array(scores), np.array(curvatures))

    def jackknife(self) -> Array:
        """Variances (k,) by leaving out one group each, without the errors of the prior.

        Unlike the sandwich estimate, it is not biased by the parameters having been fitted to the
        few groups (B. Efron, R. Tibshirani, An Introduction to the Bootstrap, 1993, chapter 11).
        """
        # Scores add up to the pull of the prior, which is no scatter.
        scatter = self.scores - self.scores.mean(axis=0)
        adjusted = adjusted_scores(scatter, self.curvatures, self.hessian, JACKKNIFE)
        moves = adjusted @ inverse(self.hessian)
        return np.asarray(of_few_groups(len(moves)) * (moves**2).sum(axis=0))

    def halves_apart(self, variance: float) -> float:
        """How far the first and the last groups are apart, each fitted without the others.

        Mean over the parameters of the squared difference, in sigmas: those of the model, whose
        scores have `variance` times their curvature, or by the scatter of the groups within their
        halves. A difference of 3 sigmas and more counts as 3. Errors of the prior count as far as
        they move the halves apart.
        """
        count = len(self.scores)
        middle = (count + 1) // 2
        first = slice(0, middle)
        last = slice(middle, count)
        inverses = []
        optima = []
        variances = np.zeros(self.scores.shape[1])
        for half, other in ((first, last), (last, first)):
            own = inverse(self.hessian - self.curvatures[other].sum(axis=0))
            curvature = self.curvatures[half].sum(axis=0)
            of_model = own @ (variance * curvature) @ own
            scores = self.scores[half]
            within = (scores - scores.mean(axis=0)) @ own
            groups = len(within)
            scatter = (within**2).sum(axis=0) * groups / max(groups - 1, 1)
            variances += np.maximum(np.diag(of_model), scatter)
            inverses.append(own)
            optima.append(own @ self.scores[other].sum(axis=0))
        apart = inverses[0] - inverses[1]
        prior = self.hessian - self.curvatures.sum(axis=0)
        variances += np.diag(apart @ prior @ apart)
        squares = (optima[0] - optima[1]) ** 2 / variances
        return float(np.minimum(squares, _GROSS).mean())


def blocks_of_time(times: Array) -> NDArray[np.int64]:
    """Block (P,) of the recording that each time (P,) [s] belongs to."""
    return _parts(times, _BLOCKS)


def _parts(times: Array, count: int) -> NDArray[np.int64]:
    """Which of equally long parts of the recording each time (P,) [s] belongs to."""
    begin = times.min()
    duration = max(float(np.ptp(times)), _LEAST_DURATION)
    numbers = ((times - begin) / duration * count).astype(np.int64)
    return np.minimum(numbers, count - 1)


def stretches(times: Array) -> NDArray[np.int64]:
    """Stretch (P,) of the recording that each time (P,) [s] belongs to."""
    duration = float(np.ptp(times))
    return _parts(times, int(np.clip(duration / _STRETCH, _LEAST_STRETCHES, _MOST_STRETCHES)))


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
    at = found.evaluation
    curve = bent(found.weights)
    own = curve * at.reduced[part].sum(axis=0)
    prior = found.problem.prior[found.block]
    rest = curve * at.reduced.sum(axis=0) + prior - own
    # The score and its covariance at the optimum of the rest, which these pairs have moved.
    own_score = at.score[part].sum(axis=0)
    score = own_score + own @ np.linalg.solve(rest, own_score)
    covariance = own + own @ np.linalg.solve(rest, own)
    weight = float(found.problem.weight[part].mean())
    return _mean_square(score, covariance, np.diag(rest + own)) / weight


def _mean_square(score: Array, covariance: Array, information: Array) -> float:
    """Mean squared score (k,) in its sigmas, over the directions in which it says something.

    The parameters have different units: they are scaled to the same `information` (k,).
    """
    scale = 1.0 / np.sqrt(information)
    scaled = covariance * np.outer(scale, scale)
    symmetric = 0.5 * (scaled + scaled.T)
    variances, directions = np.linalg.eigh(symmetric)
    along = directions.T @ (scale * score)
    says = variances > _SAYS_NOTHING * variances[-1]
    squares = along[says] ** 2 / variances[says]
    return float(squares.mean())


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
# Squared difference of a parameter between two halves, in sigmas, beyond which it counts no more:
# a single one would decide. [chosen: 3 sigmas]
_GROSS = 9.0


# Share of the sigma of a single pair that all pairs from images have in common, and that is not
# reduced by averaging: a tracker's errors follow the texture and the motion. Less makes sigmas of
# many pairs too small, more hides what a long recording determines. [measured: a rendered lens of
# 320x240 pixels, whose focal length and k3 are 3 sigma off without it; the monitor has 0.15]
_SHARED = 0.06


def widened(final: Fit, *, in_images: bool = False) -> Fit:
    """The fit with a covariance of all errors, not only the noise of the matches.

    The variance by the matches is the largest of three: that of the model, of the jackknife over
    blocks of time (both are in the covariance of `fit`), and of that over regions of the image.
    The errors of the priors, which recordings of one camera share, are no scatter.
    `in_images` is whether a tracker followed the points: its own errors are added.
    """
    free = final.free
    block = final.block
    by_prior = _by_prior(final)
    covariance = final.covariance - by_prior @ by_prior.T
    of_image = Groups.of_image(final).jackknife()
    regions = np.ones(GLOBAL)
    regions[free] = of_image / np.diag(covariance)[free]
    covariance[block] = _widened_to(covariance[block], of_image)
    if in_images:
        covariance *= 1.0 + _SHARED**2 * final.problem.pairs
    variance = float(final.problem.weight.mean()) / bent(final.weights)
    return replace(
        final,
        covariance=covariance + by_prior @ by_prior.T,
        by_doubt=by_prior,
        halves_apart=Groups.of_time(final).halves_apart(variance),
        regions=regions,
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
    moves[final.block] = inverse(_hessian(final)) @ root
    return moves


def _regions(points: Array) -> NDArray[np.int64]:
    """Region (N,) of the image of each point (N, 2): columns and rows of equally many points."""

    def band(values: Array, count: int) -> NDArray[np.int64]:
        borders = np.quantile(values, np.arange(1, count) / count)
        return np.searchsorted(borders, values)

    return band(points[:, 0], _COLUMNS) + _COLUMNS * band(points[:, 1], _ROWS)


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
