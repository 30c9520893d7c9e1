"""The paper's synthetic experiments: what each varies, and its run over all trials."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from rs_relpose_lab.experiments.boxes import Record
from rs_relpose_lab.experiments.methods import as_pair, PairProblem, run_method
from rs_relpose_lab.experiments.problems import BASELINES, Cell, make_problem
from rs_relpose_lab.experiments.workers import in_processes
from rs_relpose_ros.errors import InputError

# What the experiments vary is set apart from; the paper names no noise.
EXACT = Cell(pixel_noise=0.0, gravity_noise=0.0, gyro_noise=0.0, outliers=0.0, placing='image')
METHODS_OF_THE_PAPER = ('global_5pt', 'uniform_9pt', 'uniform_11pt', 'auto')


@dataclass(frozen=True, slots=True)
class Sweep:
    """One figure of the paper.

    `axis`, `unit`: what is varied, with its unit; the unit.
    `varied`, `levels`: the field of `Cell` and its values; `fixed`: others not at their defaults.
    """

    name: str
    title: str
    axis: str
    unit: str
    varied: str
    levels: tuple[float, ...]
    fixed: tuple[tuple[str, float], ...] = ()
    in_paper: bool = True

    def cell(self, level: float, base: Cell) -> Cell:
        """The cell at `level`; noises and outliers that it does not vary are those of `base`."""
        changes: dict[str, Any] = {**dict(self.fixed), self.varied: level}
        return replace(base, **changes)


# In the paper's order, then others. It gives the ends of each range, its figures are not at
# hand: the steps are ours.
SWEEPS = {sweep.name: sweep for sweep in (
    Sweep('linear_velocity', 'linear velocity, no angular velocity',
          'linear velocity of each axis [m/s]', 'm/s', 'speed',
          (0.0, 2.0, 4.0, 6.0, 8.0, 10.0), fixed=(('rate', 0.0),)),
    Sweep('angular_velocity', 'angular velocity, no linear velocity',
          'angular velocity of each axis [rad/s]', 'rad/s', 'rate',
          (0.0, 0.6, 1.2, 1.8, 2.4, 3.0), fixed=(('speed', 0.0),)),
    Sweep('pixel_noise', 'noise of the points, 1 m/s and 1 rad/s',
          'noise of the points, 1 sigma [px]', 'px', 'pixel_noise',
          (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)),
    Sweep('gravity_noise', 'error of gravity, 1 m/s and 1 rad/s',
          'error of gravity about each axis [deg]', 'deg', 'gravity_noise',
          (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)),
    Sweep('gyro_noise', 'noise of the gyro, 1 m/s and 1 rad/s',
          'noise of the gyro, 1 sigma [deg/s]', 'deg/s', 'gyro_noise',
          (0.0, 0.6, 1.2, 1.8, 2.4, 3.0)),
    # The usual motion of a vehicle, in which the linear velocities cannot be observed.
    Sweep('constant_velocity', 'constant linear velocity along the baseline, 1 rad/s',
          'linear velocity of each axis [m/s]', 'm/s', 'speed',
          (0.0, 2.0, 4.0, 6.0, 8.0, 10.0), fixed=(('constant_velocity', True),), in_paper=False),
)}


@dataclass(frozen=True, slots=True)
class PaperRun:
    """Which experiments are run, and how.

    `sweeps`, `directions`, `methods`: names of `SWEEPS`, `BASELINES` and `METHODS`.
    `trials`: of each level of each direction; `base`: what an experiment does not vary.
    """

    sweeps: tuple[str, ...]
    directions: tuple[str, ...]
    methods: tuple[str, ...]
    trials: int
    seed: int
    base: Cell = EXACT

    def __post_init__(self) -> None:
        for name, least in (('trials', 1), ('seed', 0)):
            if getattr(self, name) < least:
                raise InputError(f'{name} must be at least {least}, got {getattr(self, name)}')
        for field, high in (('pixel_noise', 20.0), ('gravity_noise', 28.0), ('gyro_noise', 57.0),
                            ('outliers', 0.95)):
            if not 0.0 <= getattr(self.base, field) <= high:
                raise InputError(f'{field} must be in [0, {high:g}], '
                                 f'got {getattr(self.base, field):g}')

    def tasks(self) -> list[Task]:
        """Every problem, in the order of the tables."""
        return [Task(SWEEPS[name], direction, level, trial, self)
                for name in self.sweeps for direction in self.directions
                for level in SWEEPS[name].levels for trial in range(self.trials)]


@dataclass(frozen=True, slots=True)
class Task:
    """One problem, for all methods."""

    sweep: Sweep
    direction: str
    level: float
    trial: int
    run: PaperRun


def run_paper(run: PaperRun, jobs: int = 1,
              on_problem: Callable[[], object] = lambda: None) -> list[Record]:
    """Run the experiments in `jobs` processes; `on_problem` is called after each task."""
    if jobs < 1:
        raise InputError(f'jobs must be at least 1, got {jobs}')
    records = []
    for found in in_processes(run_task, run.tasks(), jobs):
        records += found
        on_problem()
    return records


def run_task(task: Task) -> list[Record]:
    """Draw a problem and estimate it by every method."""
    problem = paper_problem(task.sweep.cell(task.level, task.run.base), task.direction,
                            task.run.seed, task.trial)
    return [Record(task.sweep.name, task.direction, f'{task.level:g}', name, task.trial,
                   *run_method(name, problem, task.trial)) for name in task.run.methods]


def paper_problem(cell: Cell, direction: str, seed: int, trial: int) -> PairProblem:
    """A problem as the methods get it; the same trial of other cells has the same cameras."""
    cell = replace(cell, direction=direction)
    return as_pair(make_problem(cell, [seed, list(BASELINES).index(direction), trial]), cell)
