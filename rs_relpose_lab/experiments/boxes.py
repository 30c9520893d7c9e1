"""Errors of the paper's experiments by the boxes of its plots: CSV, tables and pictures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
import math
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.experiments.methods import METHODS
from rs_relpose_lab.experiments.scoring import PoseError
from rs_relpose_lab.experiments.tables import markdown_table, write_csv
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.picture_files import save_picture

Array = NDArray[np.float64]

# Level of a box that holds all levels of a case.
ALL_LEVELS = 'all'
# Attribute of the errors -> what tables and plots call it.
SIDES = {'rotation': 'rotation error [deg]', 'translation': 'translation direction error [deg]'}


@dataclass(frozen=True, slots=True)
class Box:
    """What one box of a plot stands for, but for the method.

    `experiment`, `case`: such as 'pixel_noise' and 'sideways'.
    `level`: along the axis of the plot.
    """

    experiment: str
    case: str
    level: str


@dataclass(frozen=True, slots=True)
class Record:
    """One estimate."""

    box: Box
    method: str
    trial: int
    status: Status
    error: PoseError


@dataclass(frozen=True, slots=True, eq=False)
class BoxErrors:
    """Errors of a method in a box, of the trials with a pose.

    `rotation`, `translation` (K,): [deg].
    """

    trials: int
    rotation: Array
    translation: Array

    @property
    def lost(self) -> int:
        """Trials without a pose."""
        return self.trials - len(self.rotation)

    @classmethod
    def together(cls, parts: Sequence[BoxErrors]) -> BoxErrors:
        """All trials of several boxes."""
        return cls(sum(part.trials for part in parts),
                   np.concatenate([part.rotation for part in parts]),
                   np.concatenate([part.translation for part in parts]))


Boxes = Mapping[Box, Mapping[str, BoxErrors]]


def by_box(records: Iterable[Record]) -> dict[Box, dict[str, BoxErrors]]:
    """Errors of each box by method, in the order of the records."""
    grouped: dict[Box, dict[str, list[Record]]] = {}
    for record in records:
        grouped.setdefault(record.box, {}).setdefault(record.method, []).append(record)
    return {box: {method: _errors(found) for method, found in methods.items()}
            for box, methods in grouped.items()}


def _errors(records: Sequence[Record]) -> BoxErrors:
    posed = [record.error for record in records if record.status is Status.OK]
    return BoxErrors(len(records), np.array([error.rotation for error in posed]),
                     np.array([error.translation for error in posed]))


def by_case(boxes: Boxes) -> dict[tuple[str, str], dict[str, Mapping[str, BoxErrors]]]:
    """The boxes of each experiment and case, by level."""
    cases: dict[tuple[str, str], dict[str, Mapping[str, BoxErrors]]] = {}
    for box, methods in boxes.items():
        cases.setdefault((box.experiment, box.case), {})[box.level] = methods
    return cases


def with_totals(boxes: Boxes) -> dict[Box, Mapping[str, BoxErrors]]:
    """The boxes, and after those of each case one of all its levels together."""
    found: dict[Box, Mapping[str, BoxErrors]] = {}
    for case, levels in by_case(boxes).items():
        found |= {Box(*case, level): methods for level, methods in levels.items()}
        found[Box(*case, ALL_LEVELS)] = {
            method: BoxErrors.together([methods[method] for methods in levels.values()])
            for method in next(iter(levels.values()))}
    return found


def write_trials(records: Iterable[Record], path: Path) -> None:
    """Write every estimate (CSV)."""
    write_csv(path, (
        {'experiment': r.box.experiment, 'case': r.box.case, 'level': r.box.level,
         'method': r.method, 'trial': r.trial, 'status': r.status.value}
        | {f'{side}_error_deg': getattr(r.error, side) if r.status is Status.OK else math.nan
           for side in SIDES} for r in records))


def write_boxes(boxes: Boxes, path: Path) -> None:
    """Write the figures of every box (CSV)."""
    percentiles = {'median': 50, 'p25': 25, 'p75': 75, 'p90': 90, 'max': 100}

    def figures(errors: BoxErrors) -> dict[str, float]:
        found: dict[str, float] = {}
        for side in SIDES:
            values = getattr(errors, side)
            at = np.percentile(values, list(percentiles.values())).tolist() if len(values) \
                else [math.nan] * len(percentiles)
            found |= {f'{side}_{name}_deg': value
                      for name, value in zip(percentiles, at, strict=True)}
        return found

    write_csv(path, (
        {'experiment': box.experiment, 'case': box.case, 'level': box.level, 'method': method,
         'trials': errors.trials, 'poses': len(errors.rotation)} | figures(errors)
        for box, methods in boxes.items() for method, errors in methods.items()))


def tables(boxes: Boxes, titles: Mapping[tuple[str, str], str], axis: str) -> str:
    """Tables to read: medians and 90th percentiles of each experiment and case.

    `titles`: headings, by experiment and case.
    `axis`: heading of the column of levels.
    """
    parts = []
    for case, levels in by_case(boxes).items():
        parts.append(f'## {titles[case]}\n')
        methods = list(next(iter(levels.values())))
        for side, heading in SIDES.items():
            parts.append(f'{heading}: median (90 %)\n')
            parts.append(markdown_table(
                [axis, *(METHODS[method].label for method in methods)],
                [[level, *(_summary(getattr(row[method], side)) for method in methods)]
                 for level, row in levels.items()]))
        for method in methods:
            errors = BoxErrors.together([row[method] for level, row in levels.items()
                                         if level != ALL_LEVELS])
            if errors.lost:
                parts.append(f'no pose: {METHODS[method].label}, {errors.lost} of '
                             f'{errors.trials}\n')
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


# Colours that are told apart in every kind of colour vision (Okabe and Ito).
_COLORS = ('#999999', '#E69F00', '#56B4E9', '#009E73', '#D55E00', '#0072B2', '#CC79A7', '#F0E442',
           '#000000')
_LOST_COLOR = '#B00000'
# Errors below this [deg] are rounding; a logarithmic axis must end somewhere.
FLOOR = 1e-5


def draw_boxes(boxes: Boxes, title: str, axis: str, path: Path) -> Figure:
    """Draw one experiment: a row of plots for each case, rotation left and translation right.

    Boxes hold the quartiles, whiskers reach to the 5th and 95th percentiles, dots are beyond. Red
    figures above the boxes say how many estimates are in none, for want of a pose.

    `boxes`: of this experiment.
    `title`, `axis`: of the figure; of the levels.
    `path`: PNG file.
    """
    cases = by_case(boxes)
    figure = Figure(figsize=(13.0, 1.1 + 3.5 * len(cases)), dpi=110, layout='constrained')
    axes = figure.subplots(len(cases), 2, squeeze=False)
    for column, (side, label) in enumerate(SIDES.items()):
        limits = _limits([getattr(errors, side) for methods in boxes.values()
                          for errors in methods.values()])
        for row, ((_, case), levels) in zip(axes, cases.items(), strict=True):
            _draw_levels(row[column], levels, side, limits)
            row[column].set_title(case, fontsize=11)
            row[column].set_ylabel(label)
            row[column].set_xlabel(axis)
    axes[0, 1].legend(handles=[
        Patch(facecolor=color, edgecolor='black', linewidth=0.6, label=METHODS[method].label)
        for method, color in zip(next(iter(boxes.values())), _COLORS, strict=False)],
        loc='upper left', bbox_to_anchor=(1.0, 1.0), fontsize=9)
    figure.suptitle(title, fontsize=13)
    save_picture(figure, path)
    return figure


def _limits(errors: Sequence[Array]) -> tuple[float, float]:
    """Decades that hold all errors [deg], at most 180."""
    values = np.concatenate(errors)
    if not len(values):
        return FLOOR, 1.0
    least, most = np.log10(np.maximum([values.min(), values.max()], FLOOR))
    low = 10.0**np.floor(least)
    return low, max(min(10.0**np.ceil(most), 180.0), 10.0 * low)


def _draw_levels(plot: Axes, levels: Mapping[str, Mapping[str, BoxErrors]], side: str,
                 limits: tuple[float, float]) -> None:
    methods = list(next(iter(levels.values())))
    step = 0.86 / len(methods)
    low, high = limits
    # A strip of a seventh of the height, above all boxes, is for what has no pose.
    top = high * (high / low)**(1.0 / 6.0)
    strip = high * (high / low)**(1.0 / 12.0)
    for k, (method, color) in enumerate(zip(methods, _COLORS, strict=False)):
        shown: dict[float, Array] = {}
        for place, row in enumerate(levels.values()):
            errors = row[method]
            position = place + (k + 0.5) * step - 0.43
            if errors.lost:
                plot.text(position, strip, f'{100.0 * errors.lost / errors.trials:.0f} %',
                          rotation=90, fontsize=7, ha='center', va='center', color=_LOST_COLOR)
            if len(errors.rotation):
                shown[position] = np.maximum(getattr(errors, side), FLOOR)
        if shown:
            plot.boxplot(
                list(shown.values()), positions=list(shown), widths=0.8 * step, whis=(5.0, 95.0),
                patch_artist=True, manage_ticks=False,
                boxprops={'facecolor': color, 'linewidth': 0.6},
                medianprops={'color': 'black', 'linewidth': 1.4},
                whiskerprops={'linewidth': 0.7}, capprops={'linewidth': 0.7},
                flierprops={'marker': '.', 'markersize': 3.5, 'markerfacecolor': color,
                            'markeredgecolor': color})
    if any(errors.lost for row in levels.values() for errors in row.values()):
        plot.text(-0.49, strip, 'no pose:', fontsize=7, va='center', color=_LOST_COLOR)
    plot.set_yscale('log')
    plot.set_ylim(0.7 * low, top)
    decades = range(round(np.log10(low)), int(np.floor(np.log10(1.01 * high))) + 1)
    # What is drawn at the floor is that or less.
    plot.set_yticks([10.0**k for k in decades], [
        ('≤ ' if 10.0**k <= 1.01 * FLOOR else '') + f'{10.0**k:.{max(0, -k)}f}' for k in decades])
    plot.set_xticks(range(len(levels)), list(levels))
    plot.set_xlim(-0.5, len(levels) - 0.5)
    plot.axhline(high, color='0.7', linewidth=0.8)
    for border in np.arange(len(levels) - 1) + 0.5:
        plot.axvline(border, color='0.85', linewidth=0.8)
    plot.grid(True, axis='y', color='0.88')
    plot.set_axisbelow(True)
