"""Hypotheses of a frame pair: which solvers a mode samples, and what they are given."""

from __future__ import annotations

from dataclasses import dataclass
import math
import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.estimator import EstimatorConfig
from rs_relpose_ros.estimator.consensus import SCALES
from rs_relpose_ros.estimator.problem import TwoViewProblem
from rs_relpose_ros.estimator.sampling import empty_pool, Matches, sample_hypotheses, Stop
from rs_relpose_ros.solvers.gravity import gravity_alignment
from rs_relpose_ros.solvers.solver import (
    empty_solutions,
    Knowledge,
    Model,
    no_knowledge,
    Solutions,
    Solver,
)
from rs_relpose_ros.solvers.table import GYRO_2PT, SOLVERS, UNIFORM

# Hypotheses that are optimised further.
POOL_SIZE = 6
# Samples between two looks at the clock, where there is a time limit: some 0.2 ms.
_TIMED_BLOCK = 20


@dataclass(frozen=True, slots=True)
class SolverMode:
    """What is estimated, and the solvers that are sampled for it, those that know most first."""

    model: Model
    solvers: tuple[Solver, ...]

    @property
    def needs_gravity(self) -> bool:
        """Whether no solver can be asked without gravity."""
        return all(solver.needs_gravity for solver in self.solvers)

    @property
    def fitted_points(self) -> int:
        """Matches that a hypothesis and its fit explain whatever they are: their unknowns.

        A sample agrees with itself: 9 or 11 points, and the fit of 11 unknowns with some more.
        """
        return 14 if max(solver.sample_size for solver in self.solvers) >= 9 else 6


MODES = {
    'auto': SolverMode(UNIFORM, (GYRO_2PT, SOLVERS['angular_3pt'], SOLVERS['angular_5pt'])),
    **{name: SolverMode(solver.model, (solver,)) for name, solver in SOLVERS.items()},
}


class DrawnHypotheses(NamedTuple):
    """The best distinct hypotheses, best first.

    `samples`: how many were drawn. `some_unasked`: solvers were spared, since one before them
    explained enough.
    """

    hypotheses: Solutions
    samples: int
    some_unasked: bool


def draw_hypotheses(problem: TwoViewProblem, mode: SolverMode, config: EstimatorConfig,
                    order: NDArray[np.int64], seed: NDArray[np.uint64],
                    enough: float, deadline: float = math.inf) -> DrawnHypotheses:
    """Ask the solvers of a mode until one explains a share `enough` of the matches.

    Parameters
    ----------
    order : (M,) ndarray of int64
        Usable matches, best first.
    seed : (1,) ndarray of uint64
        State of the random numbers, moved on.
    deadline : float
        Instant of `time.perf_counter` [s] at which sampling ends.
    """
    known = _knowledge(problem)
    matches = Matches(problem.points, order, (config.threshold * SCALES / problem.focal)**2)
    stop = Stop(config.confidence, config.max_iterations)
    has_gravity = problem.motion1.gravity is not None and problem.motion2.gravity is not None
    # All addresses first: what a later pair asks is compiled with the first pair.
    able = [(solver, solver.address) for solver in mode.solvers
            if (known.predicted or not solver.needs_rotation)
            and (has_gravity or not solver.needs_gravity)]
    pool = empty_pool(POOL_SIZE)
    block = config.max_iterations if math.isinf(deadline) else _TIMED_BLOCK
    samples = inliers = 0
    some_unasked = False
    for solver, address in able:
        some_unasked = (inliers > enough * len(order)
                        or (samples > 0 and time.perf_counter() >= deadline))
        if some_unasked:
            break
        out = empty_solutions(solver.most_solutions)
        drawn, new = 0, block
        while new == block:
            before = drawn
            drawn, inliers = sample_hypotheses(
                address, solver.sample_size, matches, known, stop, drawn, block, inliers, out,
                pool, seed)
            new = drawn - before if time.perf_counter() < deadline else 0
        samples += drawn
    found = np.argsort(pool.cost)[:np.isfinite(pool.cost).sum()]
    return DrawnHypotheses(Solutions(pool.R[found], pool.x[found]), samples, some_unasked)


def _knowledge(problem: TwoViewProblem) -> Knowledge:
    known = no_knowledge()
    gravity1, gravity2 = problem.motion1.gravity, problem.motion2.gravity
    if gravity1 is not None and gravity2 is not None:
        known = known._replace(align1=gravity_alignment(gravity1),
                               align2=gravity_alignment(gravity2))
    if problem.rotation is not None:
        known = known._replace(rotation=np.ascontiguousarray(problem.rotation), predicted=True)
    return known
