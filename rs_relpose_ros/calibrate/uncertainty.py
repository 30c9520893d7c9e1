"""Covariance of a calibration: what differs within the recording, and what its model leaves out.

Three things make a calibration worse than the noise of its matches says:

- errors that a part of the image shares all the time: tracks of a blurred edge, a moving object,
  the lens. Scatter between stretches of time does not see them; that between regions of the image
  does (two-way clustering: A. C. Cameron, J. B. Gelbach, D. L. Miller, Robust inference with
  multiway clustering, J. Bus. Econ. Stat. 29, 2011);
- errors that last longer than a stretch: exposure that follows the light, a second optimum. Both
  halves of the recording are fitted by themselves; where they disagree by more than their sigmas
  say, all sigmas are widened by as much (R. T. Birge, The calculation of errors by the method of
  least squares, Phys. Rev. 40, 1932);
- errors that are the same all the time, in all of the image: lens and gyro are not quite as the
  model says (`ModelErrors`). How far each moves the calibration follows from one evaluation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibrate.coplanarity import GLOBAL, Problem, ROTATION, View
from rs_relpose_ros.calibrate.covariance import jackknife_of, stretches
from rs_relpose_ros.calibrate.fit import bent, evaluate, Fit, fit
from rs_relpose_ros.geometry.so3 import log_so3

Array = NDArray[np.float64]

# Regions of the image: columns and rows of equally many points.
_COLUMNS, _ROWS = 4, 3
# Square, in sigmas, by which the figures of two halves differ by chance, at most: in the mean
# over all of them, and each.
_CHANCE, _GROSS = 1.75, 9.0


class ModelErrors(NamedTuple):
    """What lens and gyro may differ by from what the model takes them for, 1 sigma each."""

    focal: float = 0.005        # focal length, relative
    aspect: float = 0.002       # ratio of the two focal lengths
    center: float = 0.005       # principal point, share of the image's width
    radial: float = 0.02        # first radial coefficient of the distortion
    gyro_scale: float = 0.005   # of each axis, relative
    gyro_skew: float = 0.005    # between each two axes [rad]


# Of a camera whose CameraInfo has no intrinsics.
UNCALIBRATED = ModelErrors(focal=0.0, aspect=0.005, center=0.01, radial=0.05)


def widened(final: Fit, free: NDArray[np.bool_], errors: ModelErrors | None) -> Fit:
    """The fit with a covariance that holds for more than the noise of the matches."""
    wider = np.sqrt(_between_regions(final, free) * _disagreement(final, free))
    scatter = final.covariance * np.outer(wider, wider)
    if errors is not None:
        moves = np.array([_move(final, free, problem) for problem in _perturbed(final, errors)])
        scatter = scatter + moves.T @ moves
    return replace(final, covariance=scatter)


def _between_regions(final: Fit, free: NDArray[np.bool_]) -> Array:
    """Factors (G,) of the variances by what regions of the image scatter more than cells do.

    Cells are regions times stretches of time: where the regions scatter no more than these, the
    stretches have it all.
    """
    problem, curve = final.problem, bent(final.weights)
    index = np.ix_(free, free)
    region, stretch = _regions(problem.view1.points), stretches(problem.middles)
    whole = evaluate(problem, final.unknowns)
    prior = np.diag(problem.prior)
    inverse = np.linalg.inv((curve * whole.reduced.sum(axis=0) + prior)[index])
    moves, cells = [], np.zeros_like(inverse)
    for name in np.unique(region):
        rest = evaluate(problem.matches(region != name), final.unknowns)
        own = (whole.score - rest.score)[:, free]
        rest_curvature = (curve * rest.reduced.sum(axis=0) + prior)[index]
        moves.append(np.linalg.pinv(rest_curvature, hermitian=True) @ own.sum(axis=0))
        of_cells = np.stack([own[stretch == k].sum(axis=0) for k in np.unique(stretch)]) @ inverse
        cells += of_cells.T @ of_cells
    beyond = np.diag(jackknife_of(np.array(moves)) - cells)
    factors = np.ones(GLOBAL)
    factors[free] += np.maximum(beyond, 0.0) / np.diag(final.covariance)[free]
    return factors


def _regions(points: Array) -> NDArray[np.int64]:
    """Region (N,) of the image of each point (N, 2): columns and rows of equally many points."""
    def band(values: Array, count: int) -> NDArray[np.int64]:
        borders = np.quantile(values, np.arange(1, count) / count)
        return np.searchsorted(borders, values)
    return band(points[:, 0], _COLUMNS) + _COLUMNS * band(points[:, 1], _ROWS)


def _disagreement(final: Fit, free: NDArray[np.bool_]) -> Array:
    """Factors (G,) of the variances by the difference of both halves; 1 where chance explains it.

    They share the mean square of the differences in sigmas, in which a figure counts up to
    `_GROSS`; a figure with a larger one has that.
    """
    middles = final.problem.middles
    first = middles < np.median(middles)
    halves = [fit(final.problem.pairs_of(part), final.unknowns.pairs_of(part), free, rounds=15)
              for part in (first, ~first)]
    one, other = halves
    difference = one.unknowns.parameters - other.unknowns.parameters
    difference[ROTATION:ROTATION + 3] = log_so3(
        one.unknowns.R_imu_cam @ other.unknowns.R_imu_cam.T)
    variances = np.diag(one.covariance + other.covariance)
    squares = difference[free]**2 / variances[free]
    mean = float(np.minimum(squares, _GROSS).mean())
    factors = np.ones(GLOBAL)
    factors[free] = np.maximum(mean if mean > _CHANCE else 1.0,
                               np.where(squares > _GROSS, squares, 1.0))
    return factors


def _move(final: Fit, free: NDArray[np.bool_], problem: Problem) -> Array:
    """Move (G,) of the optimum, by one Newton step, where the data are those of `problem`."""
    index = np.ix_(free, free)
    there, here = evaluate(problem, final.unknowns), evaluate(final.problem, final.unknowns)
    H = here.reduced.sum(axis=0) + np.diag(problem.prior)
    move = np.zeros(GLOBAL)
    move[free] = -np.linalg.solve(H[index], (there.score - here.score).sum(axis=0)[free])
    return move


def _perturbed(final: Fit, errors: ModelErrors) -> Iterator[Problem]:
    """The data with each of the errors of the model in turn, one sigma of it."""
    problem = final.problem
    for change in _lens_changes(problem, errors):
        yield problem.seen_as(partial(_through, change))
    for i in range(3):
        for j in range(i + 1):
            mixing = np.zeros((3, 3))
            mixing[i, j] = mixing[j, i] = errors.gyro_scale if i == j else errors.gyro_skew
            yield problem._replace(gyro_rates=problem.gyro_rates @ (np.eye(3) + mixing))


def _through(change: Callable[[Array], Array], view: View) -> View:
    return view._replace(points=np.ascontiguousarray(change(view.points)))


def _lens_changes(problem: Problem, errors: ModelErrors) -> list[Callable[[Array], Array]]:
    """Normalised points (N, 2) as another lens would have them."""
    width = float(np.ptp(problem.view1.points[:, 0]))
    return [lambda points: points / (1.0 + errors.focal),
            lambda points: points / [1.0, 1.0 + errors.aspect],
            lambda points: points - [errors.center * width, 0.0],
            lambda points: points - [0.0, errors.center * width],
            lambda points: points * (1.0 - errors.radial * (points**2).sum(axis=1,
                                                                          keepdims=True))]
