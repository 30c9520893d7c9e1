"""The estimator against the oracle: many random problems in each cell of the experiment."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
import time

import numpy as np

from rs_relpose_lab.experiments.oracle import oracle_estimate
from rs_relpose_lab.experiments.oracle_cache import OracleCache
from rs_relpose_lab.experiments.problems import (
    Cell,
    CELLS,
    CENTRE_U,
    CENTRE_V,
    FOCAL,
    HEIGHT,
    LINE_DELAY,
    make_problem,
    Noise,
    TwoViewProblem,
    WIDTH,
)
from rs_relpose_lab.experiments.scoring import NO_POSE, pose_error, PoseError
from rs_relpose_ros import (
    estimate_relative_pose,
    EstimatorConfig,
    FrameMotion,
    RelativePose,
    RollingShutterCamera,
    warm_up,
)

CAMERA = RollingShutterCamera(width=WIDTH, height=HEIGHT, fx=FOCAL, fy=FOCAL, cx=CENTRE_U,
                              cy=CENTRE_V, readout_time=HEIGHT * LINE_DELAY)

_CHUNK = 10  # trials a task of a process


@dataclass(frozen=True, slots=True)
class Trial:
    """One problem, estimated.

    Attributes
    ----------
    cell, noise : str
    sigma_factor : float
        Told sigmas are so many times the true ones.
    seed : int
    status : str
    error, oracle : PoseError
        Of the estimator and of the oracle.
    duration : float
        Of the whole estimate [s].
    """

    cell: str
    noise: Noise
    sigma_factor: float
    seed: int
    status: str
    error: PoseError
    oracle: PoseError
    duration: float


@dataclass(frozen=True, slots=True)
class Experiment:
    """What is run: every cell with every kind of noise and every factor of the told sigmas."""

    cells: tuple[str, ...]
    noises: tuple[Noise, ...] = ('paper', 'gaussian')
    sigma_factors: tuple[float, ...] = (1.0,)
    trials: int = 200
    first_seed: int = 0
    solver: str = 'auto'


@dataclass(frozen=True, slots=True)
class _Task:
    cell: str
    noise: Noise
    seeds: tuple[int, ...]
    sigma_factors: tuple[float, ...]
    solver: str
    known: dict[int, PoseError]


def told_config(cell: Cell, sigma_factor: float, solver: str) -> EstimatorConfig:
    """The default configuration with the cell's own sigmas, times a factor."""
    return EstimatorConfig(
        solver=solver, pixel_sigma=cell.pixel_noise * sigma_factor,
        gravity_sigma=float(np.radians(cell.gravity_noise)) * sigma_factor,
        gyro_sigma=float(np.radians(cell.gyro_noise)) * sigma_factor)


def estimate(problem: TwoViewProblem, config: EstimatorConfig, seed: int) -> RelativePose:
    """The library's estimate of a problem."""
    return estimate_relative_pose(
        problem.points1, problem.points2, CAMERA,
        FrameMotion(problem.measured_rate1, problem.measured_gravity1),
        FrameMotion(problem.measured_rate2, problem.measured_gravity2), config=config, rng=seed)


def run_experiment(experiment: Experiment, cache: OracleCache, jobs: int = 1,
                   on_trials: Callable[[int], object] = lambda count: None) -> list[Trial]:
    """Run all trials.

    Parameters
    ----------
    experiment : Experiment
    cache : OracleCache
    jobs : int
        Processes; durations are comparable only where each has a core of its own.
    on_trials : callable
        Called with the number of estimates that have been added.
    """
    seeds = range(experiment.first_seed, experiment.first_seed + experiment.trials)
    tasks = [_Task(cell, noise, tuple(seeds[first:first + _CHUNK]), experiment.sigma_factors,
                   experiment.solver, cache.load(CELLS[cell], noise))
             for cell in experiment.cells for noise in experiment.noises
             for first in range(0, experiment.trials, _CHUNK)]
    trials: list[Trial] = []
    for task, done in zip(tasks, _run_all(tasks, jobs), strict=True):
        trials += done
        cache.add(CELLS[task.cell], task.noise,
                  {trial.seed: trial.oracle for trial in done if trial.seed not in task.known})
        on_trials(len(done))
    return trials


def _run_all(tasks: Sequence[_Task], jobs: int) -> Iterator[list[Trial]]:
    if jobs == 1:
        warm_up()
        yield from map(_run, tasks)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context('spawn'), initializer=warm_up) as pool:
        yield from pool.map(_run, tasks)


def _run(task: _Task) -> list[Trial]:
    cell = CELLS[task.cell]
    trials = []
    for seed in task.seeds:
        problem = make_problem(cell, seed, task.noise)
        oracle = task.known.get(seed) or _oracle_error(cell, problem)
        for factor in task.sigma_factors:
            started = time.perf_counter()
            pose = estimate(problem, told_config(cell, factor, task.solver), seed)
            duration = time.perf_counter() - started
            error = NO_POSE
            if pose:
                error = pose_error(pose.R, pose.t, problem.R, problem.t, pose.covariance)
            trials.append(Trial(task.cell, task.noise, factor, seed, pose.status.value, error,
                                oracle, duration))
    return trials


def _oracle_error(cell: Cell, problem: TwoViewProblem) -> PoseError:
    best = oracle_estimate(problem, cell.pixel_noise, float(np.radians(cell.gravity_noise)),
                           float(np.radians(cell.gyro_noise)))
    return pose_error(best.R, best.t, problem.R, problem.t, best.covariance)


def by_setting(trials: Iterable[Trial]) -> dict[tuple[Noise, float, str], list[Trial]]:
    """Trials of each (noise, sigma factor, cell), in the order in which these first occur."""
    groups: dict[tuple[Noise, float, str], list[Trial]] = {}
    for trial in trials:
        groups.setdefault((trial.noise, trial.sigma_factor, trial.cell), []).append(trial)
    return groups
