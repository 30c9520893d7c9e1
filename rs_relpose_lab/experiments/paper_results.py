"""What the experiments found: every estimate, and the figures of each cell; CSV and tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.experiments.paper_methods import METHODS, Outcome
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.replay.tables import number, TableWriter

TRIAL_COLUMNS = ('experiment', 'case', 'level', 'method', 'trial', 'status', 'rotation_error_deg',
                 'translation_error_deg')
CELL_COLUMNS = ('experiment', 'case', 'level', 'method', 'trials', 'poses', *(
    f'{error}_{figure}_deg' for error in ('rotation', 'translation')
    for figure in ('median', 'p25', 'p75', 'p90', 'max')))

ALL_LEVELS = 'all'
_PERCENTILES = (50, 25, 75, 90, 100)


@dataclass(frozen=True, slots=True)
class Cell:
    """What one box of a plot stands for, but for the method.

    Attributes
    ----------
    experiment, case : str
        Such as 'pixel_noise' and 'sideways'.
    level : str
        Along the axis of the plot.
    """

    experiment: str
    case: str
    level: str


@dataclass(frozen=True, slots=True)
class Record:
    """One estimate."""

    cell: Cell
    method: str
    trial: int
    outcome: Outcome


@dataclass(frozen=True, slots=True, eq=False)
class CellErrors:
    """Errors of a method in a cell, of the trials with a pose.

    Attributes
    ----------
    trials : int
    rotation, translation : (K,) ndarray
        [deg].
    """

    trials: int
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]


def by_cell(records: Iterable[Record]) -> dict[Cell, dict[str, CellErrors]]:
    """Errors of each cell by method, in the order of the records."""
    grouped: dict[Cell, dict[str, list[Outcome]]] = {}
    for record in records:
        grouped.setdefault(record.cell, {}).setdefault(record.method, []).append(record.outcome)
    return {cell: {method: _cell_errors(outcomes) for method, outcomes in methods.items()}
            for cell, methods in grouped.items()}


def _cell_errors(outcomes: Sequence[Outcome]) -> CellErrors:
    posed = [outcome for outcome in outcomes if outcome.status is Status.OK]
    return CellErrors(len(outcomes), np.array([o.rotation_error for o in posed]),
                      np.array([o.translation_error for o in posed]))


def with_totals(cells: Mapping[Cell, Mapping[str, CellErrors]],
                ) -> dict[Cell, Mapping[str, CellErrors]]:
    """The cells, and after those of each case one of all its levels together."""
    found: dict[Cell, Mapping[str, CellErrors]] = {}
    for key in dict.fromkeys((cell.experiment, cell.case) for cell in cells):
        rows = {cell: methods for cell, methods in cells.items()
                if (cell.experiment, cell.case) == key}
        found |= rows
        found[Cell(*key, ALL_LEVELS)] = {
            method: CellErrors(sum(row[method].trials for row in rows.values()),
                               np.concatenate([row[method].rotation for row in rows.values()]),
                               np.concatenate([row[method].translation for row in rows.values()]))
            for method in next(iter(rows.values()))}
    return found


def write_trials(records: Iterable[Record], path: Path) -> None:
    """Write every estimate as a row of `TRIAL_COLUMNS`."""
    with TableWriter(path, TRIAL_COLUMNS) as table:
        for r in records:
            table.write([r.cell.experiment, r.cell.case, r.cell.level, r.method, str(r.trial),
                         r.outcome.status.value, number(r.outcome.rotation_error),
                         number(r.outcome.translation_error)])


def write_cells(cells: Mapping[Cell, Mapping[str, CellErrors]], path: Path) -> None:
    """Write every box as a row of `CELL_COLUMNS`."""
    with TableWriter(path, CELL_COLUMNS) as table:
        for cell, methods in cells.items():
            for method, errors in methods.items():
                figures = [*_figures(errors.rotation), *_figures(errors.translation)]
                table.write([cell.experiment, cell.case, cell.level, method, str(errors.trials),
                             str(len(errors.rotation)), *map(number, figures)])


def _figures(values: NDArray[np.float64]) -> list[float]:
    if not len(values):
        return [math.nan] * len(_PERCENTILES)
    return [float(value) for value in np.percentile(values, _PERCENTILES)]


def table_lines(cells: Mapping[Cell, Mapping[str, CellErrors]],
                titles: Mapping[tuple[str, str], str], axis: str) -> list[str]:
    """Tables to read: medians and 90th percentiles, one table for each experiment and case.

    Parameters
    ----------
    cells : mapping
        As `by_cell` gives it.
    titles : mapping
        Headings, by experiment and case.
    axis : str
        Heading of the column of levels.
    """
    lines: list[str] = []
    for key in dict.fromkeys((cell.experiment, cell.case) for cell in cells):
        rows = {cell.level: methods for cell, methods in cells.items()
                if (cell.experiment, cell.case) == key}
        methods = list(next(iter(rows.values())))
        width = max(len(axis), *(len(level) for level in rows))
        lines.append(titles[key])
        for side, heading in (('rotation', 'rotation error [deg]'),
                              ('translation', 'translation direction error [deg]')):
            lines += [f'{"":{width}}  {heading}: median (90 %)',
                      f'{axis:>{width}}'
                      + ''.join(f'  {METHODS[method].label:>15}' for method in methods)]
            lines += [f'{level:>{width}}' + ''.join(
                f'  {_summary(getattr(row[method], side)):>15}' for method in methods)
                for level, row in rows.items()]
        parts = {level: row for level, row in rows.items() if level != ALL_LEVELS}
        lines += [*_lost_lines(parts), '']
    return lines


def _lost_lines(rows: Mapping[str, Mapping[str, CellErrors]]) -> list[str]:
    """Which methods gave no pose, and how often."""
    lost: dict[str, int] = {}
    trials: dict[str, int] = {}
    for row in rows.values():
        for method, errors in row.items():
            trials[method] = trials.get(method, 0) + errors.trials
            lost[method] = lost.get(method, 0) + errors.trials - len(errors.rotation)
    return [f'no pose: {METHODS[method].label}, {count} of {trials[method]}'
            for method, count in lost.items() if count]


def _summary(values: NDArray[np.float64]) -> str:
    if not len(values):
        return '-'
    median, p90 = np.percentile(values, [50, 90])
    return f'{_short(median)} ({_short(p90)})'


def _short(value: float) -> str:
    if value < 5e-4:
        return '<.0005'
    return f'{value:.3f}' if value < 1.0 else f'{value:.2f}' if value < 10.0 else f'{value:.1f}'
