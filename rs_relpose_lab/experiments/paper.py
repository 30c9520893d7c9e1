"""The paper's synthetic experiments: what each varies, and its run over all trials."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
import math
import multiprocessing
from typing import Any

from rs_relpose_lab.experiments.paper_methods import PairProblem, run_method
from rs_relpose_lab.experiments.paper_results import Cell, Record
from rs_relpose_lab.experiments.paper_scenes import (
    CENTRE,
    FOCAL,
    HEIGHT,
    LINE_DELAY,
    make_scene,
    SceneSettings,
    WIDTH,
)
from rs_relpose_ros.config.estimator import EstimatorConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.motion import FrameMotion

CAMERA = RollingShutterCamera(width=WIDTH, height=HEIGHT, fx=FOCAL, fy=FOCAL, cx=CENTRE[0],
                              cy=CENTRE[1], readout_time=HEIGHT * LINE_DELAY)

# What the estimator is told where there is no noise at all: sigmas must be positive.
_LEAST_PIXEL_SIGMA, _LEAST_GRAVITY_SIGMA, _LEAST_GYRO_SIGMA = 0.01, 1e-5, 1e-6


@dataclass(frozen=True, slots=True)
class Experiment:
    """One figure.

    Attributes
    ----------
    name, title : str
    axis, column : str
        What is varied, with its unit; the same in short.
    varied : str
        The field of `SceneSettings`.
    levels : tuple of float
        In the unit of the axis; `unit` of them make one of the field's.
    unit : float
    fixed : tuple of (str, float)
        Fields of `SceneSettings` that are not at their defaults.
    in_paper : bool
    """

    name: str
    title: str
    axis: str
    column: str
    varied: str
    levels: tuple[float, ...]
    unit: float = 1.0
    fixed: tuple[tuple[str, float], ...] = ()
    in_paper: bool = True

    def settings(self, level: float, base: SceneSettings) -> SceneSettings:
        """The cell at `level`; noises and outliers that it does not vary are those of `base`."""
        changes: dict[str, Any] = {**dict(self.fixed), self.varied: level * self.unit}
        return replace(base, **changes)


_DEGREE = math.pi / 180.0
# In the paper's order, then others. It gives the ends of each range, its figures are not at
# hand: the steps are ours.
EXPERIMENTS = {experiment.name: experiment for experiment in (
    Experiment('linear_velocity', 'linear velocity, no angular velocity',
               'linear velocity of each axis [m/s]', 'm/s', 'linear_velocity',
               (0.0, 2.0, 4.0, 6.0, 8.0, 10.0), fixed=(('angular_velocity', 0.0),)),
    Experiment('angular_velocity', 'angular velocity, no linear velocity',
               'angular velocity of each axis [rad/s]', 'rad/s', 'angular_velocity',
               (0.0, 0.6, 1.2, 1.8, 2.4, 3.0), fixed=(('linear_velocity', 0.0),)),
    Experiment('pixel_noise', 'noise of the points, 1 m/s and 1 rad/s',
               'noise of the points, 1 sigma [px]', 'px', 'pixel_noise',
               (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)),
    Experiment('gravity_noise', 'error of gravity, 1 m/s and 1 rad/s',
               'error of gravity about each axis [deg]', 'deg', 'gravity_noise',
               (0.0, 0.2, 0.4, 0.6, 0.8, 1.0), _DEGREE),
    Experiment('gyro_noise', 'noise of the gyro, 1 m/s and 1 rad/s',
               'noise of the gyro, 1 sigma [deg/s]', 'deg/s', 'gyro_noise',
               (0.0, 0.6, 1.2, 1.8, 2.4, 3.0), _DEGREE),
    # The usual motion of a vehicle, in which the linear velocities cannot be observed.
    Experiment('constant_velocity', 'constant linear velocity along the baseline, 1 rad/s',
               'linear velocity of each axis [m/s]', 'm/s', 'linear_velocity',
               (0.0, 2.0, 4.0, 6.0, 8.0, 10.0), fixed=(('constant_velocity', True),),
               in_paper=False),
)}
PAPER_EXPERIMENTS = tuple(name for name, experiment in EXPERIMENTS.items() if experiment.in_paper)


@dataclass(frozen=True, slots=True)
class PaperRun:
    """Which experiments are run, and how.

    Attributes
    ----------
    experiments, motions, methods : sequence of str
        Names of `EXPERIMENTS`, `scenes.MOTIONS` and `methods.METHODS`.
    trials : int
        Of each level of each motion.
    seed : int
    base : SceneSettings
        Noises and outliers where an experiment does not vary them.
    """

    experiments: tuple[str, ...]
    motions: tuple[str, ...]
    methods: tuple[str, ...]
    trials: int
    seed: int
    base: SceneSettings

    def __post_init__(self) -> None:
        for name, least in (('trials', 1), ('seed', 0)):
            if getattr(self, name) < least:
                raise InputError(f'{name} must be at least {least}, got {getattr(self, name)}')
        for field, high in (('pixel_noise', 20.0), ('gravity_noise', 0.5), ('gyro_noise', 1.0),
                            ('outliers', 0.95)):
            if not 0.0 <= getattr(self.base, field) <= high:
                raise InputError(f'{field} must be in [0, {high:g}], '
                                 f'got {getattr(self.base, field):g}')

    def tasks(self) -> list[Task]:
        """Every scene, in the order of the tables."""
        return [Task(EXPERIMENTS[name], motion, level, trial, self)
                for name in self.experiments for motion in self.motions
                for level in EXPERIMENTS[name].levels for trial in range(self.trials)]


@dataclass(frozen=True, slots=True)
class Task:
    """One scene, for all methods."""

    experiment: Experiment
    motion: str
    level: float
    trial: int
    run: PaperRun


def run_paper(run: PaperRun, jobs: int = 1,
              on_scene: Callable[[], object] = lambda: None) -> list[Record]:
    """Run the experiments; the result does not depend on `jobs`.

    Parameters
    ----------
    run : PaperRun
    jobs : int
        Processes.
    on_scene : callable
        Called after each scene of `run.tasks()`.
    """
    records = []
    for found in _outcomes(run.tasks(), jobs):
        records += found
        on_scene()
    return records


def _outcomes(tasks: Sequence[Task], jobs: int) -> Iterator[list[Record]]:
    if jobs < 1:
        raise InputError(f'jobs must be at least 1, got {jobs}')
    if jobs == 1:
        yield from map(run_task, tasks)
        return
    # Not forked: OpenCV's and Numba's threads do not survive that.
    with ProcessPoolExecutor(jobs, multiprocessing.get_context('spawn')) as pool:
        try:
            yield from pool.map(run_task, tasks, chunksize=8)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def run_task(task: Task) -> list[Record]:
    """Draw a scene and estimate it by every method."""
    settings = task.experiment.settings(task.level, task.run.base)
    problem = pair_problem(settings, task.motion, task.run.seed, task.trial)
    cell = Cell(task.experiment.name, task.motion, f'{task.level:g}')
    return [Record(cell, name, task.trial, run_method(name, problem, task.trial))
            for name in task.run.methods]


def pair_problem(settings: SceneSettings, motion: str, seed: int, trial: int) -> PairProblem:
    """A scene as the methods get it; they are told the true noise figures."""
    scene = make_scene(settings, motion, seed, trial)
    told = EstimatorConfig(
        pixel_sigma=max(settings.pixel_noise, _LEAST_PIXEL_SIGMA),
        gravity_sigma=max(settings.gravity_noise, _LEAST_GRAVITY_SIGMA),
        gyro_sigma=max(settings.gyro_noise, _LEAST_GYRO_SIGMA))
    return PairProblem(scene.points1, scene.points2, CAMERA,
                       FrameMotion(scene.rate1, scene.gravity1),
                       FrameMotion(scene.rate2, scene.gravity2), scene.R, scene.t, told)


