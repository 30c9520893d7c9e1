"""What the data allow somebody who does not know which matches are true.

As the oracle of `oracle`, but for the labels: it knows the share e of false matches, and how
Sampson errors r and depths z of true and of false matches are distributed at the truth. A match is
likely by::

    p = (1 - e) N(r; 0, sigma) q_true(z) + e p_false(r) q_false(z)

The estimate is that of expectation and maximisation from the truth: each match weighs with the
probability that it is true, until the pose stays. p_false is constant over the errors that true
matches have. The distributions are counted on many more matches of the same two cameras.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.experiments.oracle import (
    estimate_at,
    minimum,
    Objective,
    OracleEstimate,
    start_at,
)
from rs_relpose_lab.experiments.problems import Cell, make_problem, TwoViewProblem

Array = NDArray[np.float64]

# Matches of the same cameras on which the distributions are counted.
_COUNTED = 4000
# A false match of a smaller error [px] than this tells how they are distributed near zero.
_NEAR = 20.0
# Borders of the logarithms of depths [baselines]; beyond them, and behind a camera, is one class
# each.
_DEPTHS = np.arange(-1.0, 5.01, 0.25)
_ROUNDS = 30
# A step of all unknowns (rad, tangent, baselines per second) below which the pose stays.
_STAYS = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class Mixture:
    """How matches are distributed at the truth.

    `false_share`: e. `false_density` [1/px]: of the errors of false matches, near zero.
    `true_depths`, `false_depths` (B,): probabilities of the classes of `depth_classes`.
    """

    false_share: float
    false_density: float
    true_depths: Array
    false_depths: Array

    def is_true(self, errors: Array, depths: Array, sigma: float) -> Array:
        """Probability (N,) that matches of these errors (N,) [px] and depths (N, 2) are true."""
        z = depth_classes(depths)
        normal = np.exp(-0.5 * (errors / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
        of_true = (1.0 - self.false_share) * normal * self.true_depths[z]
        of_false = self.false_share * self.false_density * self.false_depths[z]
        return np.asarray(of_true / (of_true + of_false))


def depth_classes(depths: Array) -> NDArray[np.int64]:
    """Class (N,) of matches with depths (N, 2): 0 behind a camera, then by the logarithm."""
    nearest = depths.min(axis=1)
    return np.where(nearest > 0.0, 1 + np.searchsorted(
        _DEPTHS, np.log(np.maximum(nearest, 1e-12))), 0)


def mixture_of(cell: Cell, seed: int, pixel_sigma: float) -> Mixture:
    """Counted on other matches of the cameras of ``make_problem(cell, seed)``."""
    counted = make_problem(replace(cell, matches=_COUNTED, outliers=0.5), seed)
    objective = _objective(counted, pixel_sigma, 1.0, 1.0)
    x = objective.truth()
    errors = objective.errors(x[:, None], np.ones(_COUNTED, dtype=bool))[:, 0]
    z = depth_classes(objective.depths(x))
    false, near = counted.is_outlier, np.abs(errors) < _NEAR
    return Mixture(cell.outliers, float(np.mean(near[false])) / (2.0 * _NEAR),
                   _shares(z[~false]), _shares(z[false & near]))


def mixture_estimate(problem: TwoViewProblem, mixture: Mixture, pixel_sigma: float,
                     gravity_sigma: float, gyro_sigma: float) -> OracleEstimate:
    """The estimate of a problem by its mixture, not by its labels; sigmas as in `Objective`."""
    objective = _objective(problem, pixel_sigma, gravity_sigma, gyro_sigma)
    x, every = objective.truth(), np.ones(len(problem.points1), dtype=bool)
    for _ in range(_ROUNDS):
        weights = mixture.is_true(objective.errors(x[:, None], every)[:, 0], objective.depths(x),
                                  pixel_sigma)
        # Hopeless ones cost time only.
        objective = replace(objective, weights=np.where(weights > 1e-6, weights, 0.0))
        before, x = x, minimum(objective, x)
        if np.abs(x - before).max() < _STAYS:
            break
    return estimate_at(objective, x)


def _objective(problem: TwoViewProblem, pixel_sigma: float, gravity_sigma: float,
               gyro_sigma: float) -> Objective:
    """About the true pose, all matches alike."""
    return Objective(problem, pixel_sigma, gravity_sigma, gyro_sigma,
                     start_at(problem.R, problem.t, problem.gravity1),
                     np.ones(len(problem.points1)))


def _shares(classes: NDArray[np.int64]) -> Array:
    """Share of each class, as if each had been seen once more often."""
    counts = np.bincount(classes, minlength=len(_DEPTHS) + 2) + 1.0
    return np.asarray(counts / counts.sum())
