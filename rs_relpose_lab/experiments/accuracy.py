"""The estimator against the oracle: many random problems in each cell of the experiment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
import functools
import hashlib
import json
from pathlib import Path
import time
from typing import NamedTuple

import numpy as np

from rs_relpose_lab.experiments import mixture_oracle, oracle, problems
from rs_relpose_lab.experiments.methods import as_pair, METHODS, prepared
from rs_relpose_lab.experiments.mixture_oracle import mixture_estimate, mixture_of
from rs_relpose_lab.experiments.oracle import oracle_estimate, OracleEstimate
from rs_relpose_lab.experiments.problems import Cell, CELLS, make_problem, Noise, TwoViewProblem
from rs_relpose_lab.experiments.scoring import NO_POSE, pose_error, PoseError
from rs_relpose_lab.experiments.workers import in_processes
from rs_relpose_lab.simulation import rows
from rs_relpose_ros import RelativePose, warm_up

# Share of false matches from which on who knows the labels knows much more than anybody can.
MANY_OUTLIERS = 0.5


@dataclass(frozen=True, slots=True)
class Trial:
    """One problem, estimated.

    `sigma_factor`: told sigmas by the true ones; `error`, `oracle`: of estimator and oracle;
    `mixture`: of the oracle without labels, where there are many outliers; `duration`: of the
    whole estimate [s].
    """

    cell: str
    noise: Noise
    sigma_factor: float
    seed: int
    status: str
    error: PoseError
    oracle: PoseError
    mixture: PoseError
    duration: float


class Best(NamedTuple):
    """Errors of the oracle, and of the one without labels (infinite where it was not asked)."""

    oracle: PoseError
    mixture: PoseError


@dataclass(frozen=True, slots=True)
class AccuracyRun:
    """What is run: every cell with every kind of noise and every factor of the told sigmas."""

    cells: tuple[str, ...]
    noises: tuple[Noise, ...] = ('paper', 'gaussian')
    sigma_factors: tuple[float, ...] = (1.0,)
    trials: int = 200
    first_seed: int = 0
    solver: str = 'auto'

    @property
    def estimates(self) -> int:
        """Number of estimates."""
        return len(self.cells) * len(self.noises) * len(self.sigma_factors) * self.trials


@dataclass(frozen=True, slots=True)
class _Task:
    run: AccuracyRun
    cell: str
    noise: Noise
    seeds: tuple[int, ...]
    known: dict[int, Best]


def run_accuracy(run: AccuracyRun, cache: OracleCache, jobs: int = 1,
                 on_trials: Callable[[int], object] = lambda count: None) -> list[Trial]:
    """Run all trials.

    `jobs`: processes; durations are comparable only where each has a core of its own.
    `on_trials`: called with the number of estimates that have been added.
    """
    seeds, chunk = range(run.first_seed, run.first_seed + run.trials), 10
    tasks = [_Task(run, cell, noise, tuple(seeds[first:first + chunk]),
                   cache.load(CELLS[cell], noise))
             for cell in run.cells for noise in run.noises
             for first in range(0, run.trials, chunk)]
    trials: list[Trial] = []
    for task, done in zip(tasks, in_processes(_run, tasks, jobs, warm_up), strict=True):
        trials += done
        cache.add(CELLS[task.cell], task.noise,
                  {trial.seed: Best(trial.oracle, trial.mixture) for trial in done
                   if trial.seed not in task.known})
        on_trials(len(done))
    return trials


def _run(task: _Task) -> list[Trial]:
    cell = CELLS[task.cell]
    method = replace(METHODS['auto'], solver=task.run.solver)
    trials = []
    for seed in task.seeds:
        problem = make_problem(cell, seed, task.noise)
        best = task.known.get(seed) or _best(cell, problem, seed)
        for factor in task.run.sigma_factors:
            pair = as_pair(problem, cell, factor)
            call = prepared(method, pair, seed)
            started = time.perf_counter()
            pose = call()
            duration = time.perf_counter() - started
            assert isinstance(pose, RelativePose)
            trials.append(Trial(task.cell, task.noise, factor, seed, pose.status.value,
                                pair.error(pose), *best, duration))
    return trials


def _best(cell: Cell, problem: TwoViewProblem, seed: int) -> Best:
    def error(best: OracleEstimate) -> PoseError:
        return pose_error(best.R, best.t, problem.R, problem.t, best.covariance)

    sigmas = (cell.pixel_noise, float(np.radians(cell.gravity_noise)),
              float(np.radians(cell.gyro_noise)))
    mixture = NO_POSE
    if cell.outliers >= MANY_OUTLIERS:
        mixture = error(mixture_estimate(
            problem, mixture_of(cell, seed, cell.pixel_noise), *sigmas))
    return Best(error(oracle_estimate(problem, *sigmas)), mixture)


@dataclass(frozen=True, slots=True)
class OracleCache:
    """The oracle's errors on disk: it need not run again while the estimator is worked on.

    A folder with one file per cell and kind of noise. A file's name holds the digest of
    all that decides its content: the cell, the noise, and the source of generator and oracle.
    """

    folder: Path

    def load(self, cell: Cell, noise: Noise) -> dict[int, Best]:
        """Errors of the oracles by seed."""
        path = self._path(cell, noise)
        if not path.is_file():
            return {}
        stored = json.loads(path.read_text())
        return {int(seed): Best(*(PoseError(*error) for error in errors))
                for seed, errors in stored.items()}

    def add(self, cell: Cell, noise: Noise, errors: dict[int, Best]) -> None:
        """Keep errors by seed, beside those that are kept already."""
        path = self._path(cell, noise)
        if not errors:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        merged = {**self.load(cell, noise), **errors}
        # Replaced as a whole, so that a run that is stopped leaves no half of a file.
        new = path.with_suffix('.new')
        new.write_text(json.dumps({
            seed: [(error.rotation, error.translation, error.nees) for error in best]
            for seed, best in sorted(merged.items())}))
        new.replace(path)

    def _path(self, cell: Cell, noise: Noise) -> Path:
        digest = hashlib.sha256(json.dumps([asdict(cell), noise]).encode() + _source())
        return self.folder / f'{digest.hexdigest()[:24]}.json'


@functools.cache
def _source() -> bytes:
    """Of generator and oracles, as they were when first asked for."""
    return b''.join(Path(str(module.__file__)).read_bytes()
                    for module in (rows, problems, oracle, mixture_oracle))
