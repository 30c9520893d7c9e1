"""Changes of a parameter within a recording, by blocks of time of the final linearisation.

A fit estimates one value for all of a recording. Each block of time has its own part of the score
and of the Hessian. A change at a border, or with time, is one more unknown, whose value follows
from these parts without another fit. Its sigma is by the scatter of the blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibration.changes import Kind
from rs_relpose_ros.calibration.errors import bent, of_few_groups
from rs_relpose_ros.calibration.fit import Fit
from rs_relpose_ros.core.least_squares import inverse
from rs_relpose_ros.geometry import Array

# Length of a block [s]. Longer ones blur the place of a step, shorter ones share tracks.
# [chosen: a quarter to a second would do]
_BLOCK = 0.5
# Blocks on either side of a border. Fewer would follow a single block. [chosen: two seconds]
_BESIDE = 4
# Blocks below which nothing changes for certain. [chosen: 5 s]
_FEWEST = 10


class Trend(NamedTuple):
    """A change of a parameter that gains most of its kind."""

    place: int  # of the parameter
    kind: Kind
    value: float  # of a step, or per second
    sigma: float
    begin: float  # times [s] between which a step is, or over which it drifts
    end: float

    @property
    def square(self) -> float:
        """Its gain in chi-square."""
        return (self.value / self.sigma) ** 2


class Blocks(NamedTuple):
    """Sums of a fit over B blocks of time, by its k free parameters."""

    borders: Array  # (B + 1,) [s]
    scores: Array  # (B, k)
    curvatures: Array  # (B, k, k)
    covariance: Array  # (k, k) inverse of the whole, with the prior
    places: NDArray[np.int64]  # (k,) of the parameters

    @classmethod
    def of(cls, final: Fit) -> Blocks:
        """The blocks of a fit that have pairs."""
        middles = final.problem.middles
        begin = float(middles.min())
        end = float(middles.max())
        count = max(round((end - begin) / _BLOCK), 1)
        borders = np.linspace(begin, end, count + 1)
        after = np.searchsorted(borders, middles, side='right')
        numbers = np.clip(after - 1, 0, count - 1)
        score = final.evaluation.score
        curvature = bent(final.weights) * final.evaluation.reduced
        size = score.shape[1]
        scores = np.zeros((count, size))
        curvatures = np.zeros((count, size, size))
        np.add.at(scores, numbers, score)
        np.add.at(curvatures, numbers, curvature)
        whole = curvatures.sum(axis=0) + final.problem.prior[final.block]
        places = np.flatnonzero(final.free)
        return cls(borders, scores, curvatures, inverse(whole), places)

    @property
    def middles(self) -> Array:
        """Times (B,) [s]."""
        return np.asarray(0.5 * (self.borders[1:] + self.borders[:-1]))


def trends(final: Fit, drifts: Sequence[int], steps: Sequence[int]) -> list[Trend]:
    """The best change of each kind of the free parameters at places `drifts` and `steps`.

    The most certain one is the first.
    """
    blocks = Blocks.of(final)
    count = len(blocks.scores)
    if count < _FEWEST:
        return []
    found = [_drift(blocks, place) for place in drifts if place in blocks.places]
    found += [_step(blocks, place) for place in steps if place in blocks.places]
    return sorted(found, key=lambda one: -one.square)


def change_at(final: Fit, place: int, border: float) -> tuple[float, float]:
    """Value and sigma of a step of a free parameter at a time [s] of the pairs."""
    blocks = Blocks.of(final)
    after = (blocks.middles >= border).astype(float)
    values, sigmas = _changes(blocks, place, after[None])
    return float(values[0]), float(sigmas[0])


# Share of the information of a change that is its own. Less is that of other parameters, as of
# one that the fit estimates already. [chosen: any value in 1e-6..1e-2 would do]
_LEAST_SHARE = 1e-4
# Loss of chi-square within which the place of a step is not known. [derived: 3 sigmas]
_NOT_KNOWN = 9.0


def _drift(blocks: Blocks, place: int) -> Trend:
    """The drift of a free parameter over all blocks."""
    since = blocks.middles - blocks.middles.mean()
    values, sigmas = _changes(blocks, place, since[None])
    begin = float(blocks.borders[0])
    end = float(blocks.borders[-1])
    return Trend(place, Kind.DRIFT, float(values[0]), float(sigmas[0]), begin, end)


def _step(blocks: Blocks, place: int) -> Trend:
    """The step of a free parameter that gains most, with the span [s] where it may be."""
    count = len(blocks.scores)
    inner = np.arange(_BESIDE, count - _BESIDE + 1)
    after = (np.arange(count) >= inner[:, None]).astype(float)
    values, sigmas = _changes(blocks, place, after)
    squares = (values / sigmas) ** 2
    best = int(np.argmax(squares))
    likely = inner[squares >= squares[best] - _NOT_KNOWN]
    begin = float(blocks.borders[likely[0]]) - _BLOCK
    end = float(blocks.borders[likely[-1]]) + _BLOCK
    return Trend(place, Kind.STEP, float(values[best]), float(sigmas[best]), begin, end)


def _changes(blocks: Blocks, place: int, weights: Array) -> tuple[Array, Array]:
    """Values (M,) and sigmas (M,) of a change of one parameter by weights (M, B) of blocks."""
    own = int(np.flatnonzero(blocks.places == place)[0])
    columns = blocks.curvatures[:, :, own]
    own_scores = blocks.scores[:, own]
    mixed = weights @ columns
    moved = mixed @ blocks.covariance
    of_all = weights**2 @ columns[:, own]
    information = of_all - (moved * mixed).sum(axis=1)
    is_own = information > _LEAST_SHARE * of_all
    positive = np.maximum(of_all, np.finfo(float).tiny)
    information = np.where(is_own, information, positive)
    optimum = -(weights @ own_scores) / information
    values = np.where(is_own, optimum, 0.0)
    parts = _parts(blocks, own, weights, moved, values)
    squares = (parts**2).sum(axis=1)
    scatter = of_few_groups(len(blocks.scores)) * squares
    sigmas = np.sqrt(np.maximum(scatter, information)) / information
    return values, np.where(is_own, sigmas, np.inf)


def _parts(blocks: Blocks, own: int, weights: Array, moved: Array, values: Array) -> Array:
    """Parts (M, B) of the blocks in the gradient of each change, after it is applied."""
    parts = np.empty_like(weights)
    columns = blocks.curvatures[:, :, own]
    for part, weight, along, value in zip(parts, weights, moved, values, strict=True):
        explained = weight[:, None] * columns - blocks.curvatures @ along
        left = blocks.scores + value * explained
        part[:] = weight * left[:, own] - left @ along
    return parts
