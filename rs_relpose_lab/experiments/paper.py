"""The paper's synthetic experiments: their variations, runs, tables and box plots."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
import math
from operator import attrgetter
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
import numpy as np

from rs_relpose_lab.experiments.harness import grouped, in_processes, markdown_table, write_csv
from rs_relpose_lab.experiments.methods import as_pair, METHODS, PairProblem, run_method
from rs_relpose_lab.experiments.problems import BASELINES, Cell, make_problem
from rs_relpose_lab.experiments.scoring import PoseError
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.output_files import save_picture

# -- Errors of the paper's experiments by the boxes of its plots: CSV, tables and pictures --------

# Level of a box that holds all levels of a case.
ALL_LEVELS = 'all'
# Attribute of the errors -> what tables and plots call it.
SIDES = {'rotation': 'rotation error [deg]', 'translation': 'translation direction error [deg]'}


@dataclass(frozen=True, slots=True)
class Record:
    """One estimate, in the box of a plot: `level` along the axis of an `experiment` and `case`."""

    experiment: str
    case: str
    level: str
    method: str
    trial: int
    status: Status
    error: PoseError


@dataclass(frozen=True, slots=True, eq=False)
class BoxErrors:
    """Errors of a method in a box: `rotation`, `translation` (K,) [deg] of the K poses."""

    trials: int
    rotation: Array
    translation: Array

    @property
    def lost(self) -> int:
        """Trials without a pose."""
        return self.trials - len(self.rotation)


Levels = Mapping[str, Mapping[str, BoxErrors]]
# By experiment and case, then by level, then by method.
Cases = Mapping[tuple[str, str], Levels]


def by_case(records: Sequence[Record], *, totals: bool = False) -> Cases:
    """Errors in every box, in the order of the records; `totals`: a box of all levels, too."""
    if totals:
        records = [*records, *(replace(record, level=ALL_LEVELS) for record in records)]
    return {
        case: {
            level: {
                method: _errors(found)
                for method, found in grouped(of_level, attrgetter('method')).items()
            }
            for level, of_level in grouped(of_case, attrgetter('level')).items()
        }
        for case, of_case in grouped(records, attrgetter('experiment', 'case')).items()
    }


def _errors(records: Sequence[Record]) -> BoxErrors:
    posed = [record.error for record in records if record.status is Status.OK]
    return BoxErrors(
        len(records),
        np.array([error.rotation for error in posed]),
        np.array([error.translation for error in posed]),
    )


def write_trials(records: Iterable[Record], path: Path) -> None:
    """Write every estimate (CSV)."""
    write_csv(
        path,
        (
            {
                'experiment': r.experiment,
                'case': r.case,
                'level': r.level,
                'method': r.method,
                'trial': r.trial,
                'status': r.status.value,
            }
            | {
                f'{side}_error_deg': getattr(r.error, side) if r.status is Status.OK else math.nan
                for side in SIDES
            }
            for r in records
        ),
    )


def write_boxes(cases: Cases, path: Path) -> None:
    """Write the statistics of every box (CSV)."""
    percentiles = {'median': 50, 'p25': 25, 'p75': 75, 'p90': 90, 'max': 100}

    def statistics(errors: BoxErrors) -> dict[str, float]:
        return {
            f'{side}_{name}_deg': float(np.percentile(values, at)) if len(values) else math.nan
            for side in SIDES
            for values in [getattr(errors, side)]
            for name, at in percentiles.items()
        }

    write_csv(
        path,
        (
            {
                'experiment': experiment,
                'case': case,
                'level': level,
                'method': method,
                'trials': errors.trials,
                'poses': len(errors.rotation),
            }
            | statistics(errors)
            for (experiment, case), levels in cases.items()
            for level, methods in levels.items()
            for method, errors in methods.items()
        ),
    )


def tables(cases: Cases, titles: Mapping[tuple[str, str], str], axis: str) -> str:
    """Tables to read: medians and 90th percentiles of each case, each below its title.

    `axis`: heading of the column of levels.
    """
    parts = []
    for case, levels in cases.items():
        parts.append(f'## {titles[case]}\n')
        methods = list(next(iter(levels.values())))
        for side, heading in SIDES.items():
            parts.append(f'{heading}: median (90 %)\n')
            parts.append(
                markdown_table(
                    [axis, *(METHODS[method].label for method in methods)],
                    [
                        [level, *(_summary(getattr(row[method], side)) for method in methods)]
                        for level, row in levels.items()
                    ],
                )
            )
        for method in methods:
            found = [row[method] for level, row in levels.items() if level != ALL_LEVELS]
            if lost := sum(errors.lost for errors in found):
                parts.append(
                    f'no pose: {METHODS[method].label}, {lost} of '
                    f'{sum(errors.trials for errors in found)}\n'
                )
    return '\n'.join(parts)


def _summary(values: Array) -> str:
    def short(value: float) -> str:
        if value < 5e-4:
            return '<.0005'
        return f'{value:.{3 if value < 1.0 else 2 if value < 10.0 else 1}f}'

    if not len(values):
        return '-'
    median, p90 = np.percentile(values, [50, 90])
    return f'{short(median)} ({short(p90)})'


# Colours that can be distinguished in every kind of colour vision (Okabe and Ito).
_COLORS = (
    '#999999',
    '#E69F00',
    '#56B4E9',
    '#009E73',
    '#D55E00',
    '#0072B2',
    '#CC79A7',
    '#F0E442',
    '#000000',
)
# Colour of the share of lost trials. [chosen: differs from those of the methods]
_LOST_COLOR = '#B00000'
# Errors below this [deg] are rounding; a logarithmic axis must end somewhere.
FLOOR = 1e-5


def draw_boxes(cases: Cases, title: str, axis: str, path: Path) -> Figure:
    """Draw one experiment: a row of plots for each case, rotation left and translation right.

    Boxes hold the quartiles, whiskers reach to the 5th and 95th percentiles, dots are beyond. Red
    numbers above the boxes are the shares of estimates without a pose.
    """
    figure = Figure(figsize=(13.0, 1.1 + 3.5 * len(cases)), dpi=110, layout='constrained')
    axes = figure.subplots(len(cases), 2, squeeze=False)
    for column, (side, label) in enumerate(SIDES.items()):
        limits = _limits(
            [
                getattr(errors, side)
                for levels in cases.values()
                for methods in levels.values()
                for errors in methods.values()
            ]
        )
        for row, ((_, case), levels) in zip(axes, cases.items(), strict=True):
            _draw_levels(row[column], levels, side, limits)
            row[column].set_title(case, fontsize=11)
            row[column].set_ylabel(label)
            row[column].set_xlabel(axis)
    methods = next(iter(next(iter(cases.values())).values()))
    axes[0, 1].legend(
        handles=[
            Patch(facecolor=color, edgecolor='black', linewidth=0.6, label=METHODS[method].label)
            for method, color in zip(methods, _COLORS, strict=False)
        ],
        loc='upper left',
        bbox_to_anchor=(1.0, 1.0),
        fontsize=9,
    )
    figure.suptitle(title, fontsize=13)
    save_picture(figure, path)
    return figure


def _limits(errors: Sequence[Array]) -> tuple[float, float]:
    """Decades that hold all errors [deg], at most 180."""
    values = np.concatenate(errors)
    if not len(values):
        return FLOOR, 1.0
    least, most = np.log10(np.maximum([values.min(), values.max()], FLOOR))
    low = 10.0 ** np.floor(least)
    return low, max(min(10.0 ** np.ceil(most), 180.0), 10.0 * low)


def _draw_boxes(plot: Axes, values: Mapping[float, Array], width: float, color: str) -> None:
    """Draw a box of values at each position, with whiskers to the 5th and 95th percentile."""
    plot.boxplot(
        list(values.values()),
        positions=list(values),
        widths=width,
        whis=(5.0, 95.0),
        patch_artist=True,
        manage_ticks=False,
        boxprops={'facecolor': color, 'linewidth': 0.6},
        medianprops={'color': 'black', 'linewidth': 1.4},
        whiskerprops={'linewidth': 0.7},
        capprops={'linewidth': 0.7},
        flierprops={
            'marker': '.',
            'markersize': 3.5,
            'markerfacecolor': color,
            'markeredgecolor': color,
        },
    )


def _draw_levels(plot: Axes, levels: Levels, side: str, limits: tuple[float, float]) -> None:
    methods = list(next(iter(levels.values())))
    step = 0.86 / len(methods)
    low, high = limits
    # A strip of a seventh of the height, above all boxes, is for estimates without a pose.
    top = high * (high / low) ** (1.0 / 6.0)
    strip = high * (high / low) ** (1.0 / 12.0)
    for k, (method, color) in enumerate(zip(methods, _COLORS, strict=False)):
        shown: dict[float, Array] = {}
        for place, row in enumerate(levels.values()):
            errors = row[method]
            position = place + (k + 0.5) * step - 0.43
            if errors.lost:
                plot.text(
                    position,
                    strip,
                    f'{100.0 * errors.lost / errors.trials:.0f} %',
                    rotation=90,
                    fontsize=7,
                    ha='center',
                    va='center',
                    color=_LOST_COLOR,
                )
            if len(errors.rotation):
                shown[position] = np.maximum(getattr(errors, side), FLOOR)
        if shown:
            _draw_boxes(plot, shown, 0.8 * step, color)
    if any(errors.lost for row in levels.values() for errors in row.values()):
        plot.text(-0.49, strip, 'no pose:', fontsize=7, va='center', color=_LOST_COLOR)
    plot.set_yscale('log')
    plot.set_ylim(0.7 * low, top)
    decades = range(round(np.log10(low)), int(np.floor(np.log10(1.01 * high))) + 1)
    # What is drawn at the floor is that or less.
    plot.set_yticks(
        [10.0**k for k in decades],
        [('≤ ' if 10.0**k <= 1.01 * FLOOR else '') + f'{10.0**k:.{max(0, -k)}f}' for k in decades],
    )
    plot.set_xticks(range(len(levels)), list(levels))
    plot.set_xlim(-0.5, len(levels) - 0.5)
    plot.axhline(high, color='0.7', linewidth=0.8)
    for border in np.arange(len(levels) - 1) + 0.5:
        plot.axvline(border, color='0.85', linewidth=0.8)
    plot.grid(True, axis='y', color='0.88')
    plot.set_axisbelow(True)


# Base of the experiments; the paper names no noise.
EXACT = Cell(pixel_noise=0.0, gravity_noise=0.0, gyro_noise=0.0, outliers=0.0, placing='image')
# Methods of the experiments, as in `methods.METHODS`. [derived: the paper, and the node]
METHODS_OF_THE_PAPER = ('global_5pt', 'uniform_9pt', 'uniform_11pt', 'auto')


@dataclass(frozen=True, slots=True)
class Sweep:
    """One experiment (figure) of the paper."""

    name: str
    title: str
    axis: str  # what is varied, with its unit
    unit: str
    varied: str  # field of `Cell`
    levels: tuple[float, ...]  # its values
    fixed: tuple[tuple[str, float], ...] = ()  # other fields that are not at their defaults
    in_paper: bool = True

    def cell(self, level: float, base: Cell) -> Cell:
        """The cell at `level`; noises and outliers that it does not vary are those of `base`."""
        changes: dict[str, Any] = {**dict(self.fixed), self.varied: level}
        return replace(base, **changes)


# In the paper's order, then others. The ends of each range are the paper's, the steps are not.
SWEEPS = {
    sweep.name: sweep
    for sweep in (
        Sweep(
            'linear_velocity',
            'linear velocity, no angular velocity',
            'linear velocity of each axis [m/s]',
            'm/s',
            'speed',
            (0.0, 2.0, 4.0, 6.0, 8.0, 10.0),
            fixed=(('rate', 0.0),),
        ),
        Sweep(
            'angular_velocity',
            'angular velocity, no linear velocity',
            'angular velocity of each axis [rad/s]',
            'rad/s',
            'rate',
            (0.0, 0.6, 1.2, 1.8, 2.4, 3.0),
            fixed=(('speed', 0.0),),
        ),
        Sweep(
            'pixel_noise',
            'noise of the points, 1 m/s and 1 rad/s',
            'noise of the points, 1 sigma [px]',
            'px',
            'pixel_noise',
            (0.0, 0.2, 0.4, 0.6, 0.8, 1.0),
        ),
        Sweep(
            'gravity_noise',
            'error of gravity, 1 m/s and 1 rad/s',
            'error of gravity about each axis [deg]',
            'deg',
            'gravity_noise',
            (0.0, 0.2, 0.4, 0.6, 0.8, 1.0),
        ),
        Sweep(
            'gyro_noise',
            'noise of the gyro, 1 m/s and 1 rad/s',
            'noise of the gyro, 1 sigma [deg/s]',
            'deg/s',
            'gyro_noise',
            (0.0, 0.6, 1.2, 1.8, 2.4, 3.0),
        ),
        # The usual motion of a vehicle, in which the linear velocities cannot be observed.
        Sweep(
            'constant_velocity',
            'constant linear velocity along the baseline, 1 rad/s',
            'linear velocity of each axis [m/s]',
            'm/s',
            'speed',
            (0.0, 2.0, 4.0, 6.0, 8.0, 10.0),
            fixed=(('constant_velocity', True),),
            in_paper=False,
        ),
    )
}


@dataclass(frozen=True, slots=True)
class PaperRun:
    """Experiments, and their parameters."""

    sweeps: tuple[str, ...]  # of `SWEEPS`
    directions: tuple[str, ...]  # of `BASELINES`
    methods: tuple[str, ...]  # of `METHODS`
    trials: int  # of each level of each direction
    seed: int
    base: Cell = EXACT  # what an experiment does not vary

    def __post_init__(self) -> None:
        for name, least in (('trials', 1), ('seed', 0)):
            if getattr(self, name) < least:
                raise InputError(f'{name} must be at least {least}, got {getattr(self, name)}')
        for field, high in (
            ('pixel_noise', 20.0),
            ('gravity_noise', 28.0),
            ('gyro_noise', 57.0),
            ('outliers', 0.95),
        ):
            if not 0.0 <= getattr(self.base, field) <= high:
                raise InputError(
                    f'{field} must be in [0, {high:g}], got {getattr(self.base, field):g}'
                )

    def tasks(self) -> list[tuple[str, str, float, int]]:
        """Sweep, direction, level and trial of every problem, in the order of the tables."""
        return [
            (name, direction, level, trial)
            for name in self.sweeps
            for direction in self.directions
            for level in SWEEPS[name].levels
            for trial in range(self.trials)
        ]


def run_paper(
    run: PaperRun, jobs: int = 1, on_problem: Callable[[], object] = lambda: None
) -> list[Record]:
    """Run the experiments in `jobs` processes; `on_problem` is called after each task."""
    if jobs < 1:
        raise InputError(f'jobs must be at least 1, got {jobs}')
    records = []
    for found in in_processes(partial(_run_task, run), run.tasks(), jobs):
        records += found
        on_problem()
    return records


def _run_task(run: PaperRun, task: tuple[str, str, float, int]) -> list[Record]:
    """Draw a problem and estimate it by every method."""
    sweep, direction, level, trial = task
    problem = paper_problem(SWEEPS[sweep].cell(level, run.base), direction, run.seed, trial)
    return [
        Record(sweep, direction, f'{level:g}', name, trial, *run_method(name, problem, trial))
        for name in run.methods
    ]


def paper_problem(cell: Cell, direction: str, seed: int, trial: int) -> PairProblem:
    """A problem as the methods get it; the same trial of other cells has the same cameras."""
    cell = replace(cell, direction=direction)
    return as_pair(make_problem(cell, [seed, list(BASELINES).index(direction), trial]), cell)
