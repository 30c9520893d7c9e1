"""What the accuracy experiment says: statistics of each cell, against the limits of the project."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import csv
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, trim_mean

from rs_relpose_ros.benchmark.accuracy import by_setting, Experiment, Trial
from rs_relpose_ros.benchmark.scoring import POSE_FREEDOM
from rs_relpose_ros.benchmark.tables import markdown_table

Array = NDArray[np.float64]

TRIALS_FILE, CELLS_FILE = 'trials.csv', 'cells.csv'
REPORT_FILE, PLOT_FILE = 'accuracy.md', 'accuracy.png'

# A rotation this wrong [deg] is no noise in any of the cells.
GROSS_ERROR = 2.0


@dataclass(frozen=True, slots=True)
class CellStatistics:
    """Of one cell with one kind of noise and one factor of the told sigmas.

    Attributes
    ----------
    noise, sigma_factor, cell, trials
        What was run.
    lost, gross : int
        Trials without a pose, and with a rotation more than `GROSS_ERROR` wrong.
    rotation_median, rotation_p90, translation_median, translation_p90 : float
        Errors [deg]; a lost pose counts as infinite.
    oracle_rotation_median, ... : float
        Of the oracle on the same problems [deg].
    rotation_ratio, rotation_p90_ratio, translation_ratio, translation_p90_ratio : float
        Estimator by oracle.
    nees_mean, oracle_nees_mean : float
        Mean of the inner 98 %, by the degrees of freedom: 1 is right, above 1 overconfident.
    nees_above, oracle_nees_above : float
        Share above the 95 % quantile of chi-square: 0.05 is right.
    duration_median : float
        [ms]
    """

    noise: str
    sigma_factor: float
    cell: str
    trials: int
    lost: int
    gross: int
    rotation_median: float
    rotation_p90: float
    translation_median: float
    translation_p90: float
    oracle_rotation_median: float
    oracle_rotation_p90: float
    oracle_translation_median: float
    oracle_translation_p90: float
    rotation_ratio: float
    rotation_p90_ratio: float
    translation_ratio: float
    translation_p90_ratio: float
    nees_mean: float
    nees_above: float
    oracle_nees_mean: float
    oracle_nees_above: float
    duration_median: float


def cell_statistics(trials: Sequence[Trial]) -> CellStatistics:
    """Statistics of trials of one setting."""
    first = trials[0]
    rotation = _quantiles(trial.error.rotation for trial in trials)
    translation = _quantiles(trial.error.translation for trial in trials)
    best_rotation = _quantiles(trial.oracle.rotation for trial in trials)
    best_translation = _quantiles(trial.oracle.translation for trial in trials)
    return CellStatistics(
        first.noise, first.sigma_factor, first.cell, len(trials),
        sum(np.isinf(trial.error.rotation) for trial in trials),
        sum(GROSS_ERROR < trial.error.rotation < np.inf for trial in trials),
        *rotation, *translation, *best_rotation, *best_translation,
        *(rotation / best_rotation), *(translation / best_translation),
        *nees_statistics([trial.error.nees for trial in trials]),
        *nees_statistics([trial.oracle.nees for trial in trials]),
        float(np.median([trial.duration for trial in trials])) * 1e3)


def nees_statistics(nees: Sequence[float]) -> tuple[float, float]:
    """Mean of the inner 98 % by the degrees of freedom, and share above the 95 % quantile."""
    known = np.array([value for value in nees if not np.isnan(value)])
    if len(known) == 0:
        return float('nan'), float('nan')
    return (float(trim_mean(known, 0.01)) / POSE_FREEDOM,
            float((known > chi2.ppf(0.95, POSE_FREEDOM)).mean()))


def _quantiles(errors: Iterable[float]) -> Array:
    """Median and 90th percentile, also of errors of which some are infinite."""
    # Not interpolated: between a number and infinity there is nothing.
    return np.quantile(list(errors), [0.5, 0.9], method='higher')


def summary(cells: Sequence[CellStatistics]) -> list[tuple[str, float, str]]:
    """What the project asks for, over cells of one noise and factor: name, figure, limit."""
    def column(name: str) -> Array:
        return np.array([getattr(cell, name) for cell in cells], dtype=np.float64)

    rotation, translation = column('rotation_ratio'), column('translation_ratio')
    above = 100.0 * column('nees_above')
    return [
        ('ratio of median rotation errors, median over cells', _median(rotation), '<= 1.10'),
        ('ratio of median translation errors, median over cells', _median(translation), '<= 1.20'),
        ('ratio of median errors, largest of a cell',
         float(np.maximum(rotation, translation).max()), '<= 1.6'),
        ('ratio of 90th percentiles of rotation, median over cells',
         _median(column('rotation_p90_ratio')), '<= 1.5'),
        ('ratio of 90th percentiles of translation, median over cells',
         _median(column('translation_p90_ratio')), '<= 1.5'),
        ('lost poses', float(column('lost').sum()), '0'),
        (f'rotations wrong by more than {GROSS_ERROR:g} deg', float(column('gross').sum()), '0'),
        ('NEES / 5, smallest of a cell', float(column('nees_mean').min()), '>= 0.8'),
        ('NEES / 5, largest of a cell', float(column('nees_mean').max()), '<= 1.25'),
        ('above the 95 % quantile, smallest of a cell [%]', float(above.min()), '>= 2'),
        ('above the 95 % quantile, largest of a cell [%]', float(above.max()), '<= 10'),
        ('median time of an estimate, median over cells [ms]',
         _median(column('duration_median')), ''),
    ]


def _median(values: Array) -> float:
    return float(np.median(values))


def write_report(folder: Path, experiment: Experiment, trials: Sequence[Trial]) -> str:
    """Write every trial, the statistics of every cell, the report and the plot.

    Parameters
    ----------
    folder : pathlib.Path
        Made where it is missing.
    experiment : Experiment
    trials : sequence of Trial

    Returns
    -------
    str
        The report (Markdown).
    """
    folder.mkdir(parents=True, exist_ok=True)
    cells = [cell_statistics(group) for group in by_setting(trials).values()]
    _write_trials(folder / TRIALS_FILE, trials)
    with (folder / CELLS_FILE).open('w', newline='') as file:
        writer = csv.writer(file)
        names = [field.name for field in fields(CellStatistics)]
        writer.writerow(names)
        writer.writerows([getattr(cell, name) for name in names] for cell in cells)
    report = _report(experiment, cells)
    (folder / REPORT_FILE).write_text(report)
    _plot(folder / PLOT_FILE, cells)
    return report


def _write_trials(path: Path, trials: Sequence[Trial]) -> None:
    rows = []
    for trial in trials:
        row = asdict(trial)
        for name in ('error', 'oracle'):
            row.update({f'{name}_{key}': value for key, value in row.pop(name).items()})
        rows.append(row)
    with path.open('w', newline='') as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _settings(cells: Sequence[CellStatistics]) -> dict[tuple[str, float], list[CellStatistics]]:
    groups: dict[tuple[str, float], list[CellStatistics]] = {}
    for cell in cells:
        groups.setdefault((cell.noise, cell.sigma_factor), []).append(cell)
    return groups


def _report(experiment: Experiment, cells: Sequence[CellStatistics]) -> str:
    parts = ['# Accuracy against the oracle\n',
             f'{experiment.trials} trials a cell, solver `{experiment.solver}`, errors in degrees '
             '(median / 90th percentile); a ratio is estimator by oracle. NEES is the mean of the '
             'inner 98 % by 5, and the share above the 95 % quantile of chi-square(5).\n']
    settings = _settings(cells)
    for (noise, factor), group in settings.items():
        parts.append(f'## Noise of gravity: {noise}; told sigmas {factor:g} times the true ones\n')
        parts.append(markdown_table(
            ('cell', 'R', 'oracle', 'ratio', 't', 'oracle', 'ratio', 'lost', 'gross', 'NEES / 5',
             'oracle', 'above [%]', 'oracle', 'ms'), [_row(cell) for cell in group]))
        parts.append(markdown_table(
            ('over all cells', 'figure', 'wanted'),
            [(name, f'{value:.3g}', limit) for name, value, limit in summary(group)]))
        reference = settings.get((noise, 1.0))
        if factor != 1.0 and reference:
            parts.append(_against_true_sigmas(group, reference))
    return '\n'.join(parts)


def _row(cell: CellStatistics) -> tuple[str, ...]:
    return (
        cell.cell,
        f'{cell.rotation_median:.3f} / {cell.rotation_p90:.3f}',
        f'{cell.oracle_rotation_median:.3f} / {cell.oracle_rotation_p90:.3f}',
        f'{cell.rotation_ratio:.2f} / {cell.rotation_p90_ratio:.2f}',
        f'{cell.translation_median:.3f} / {cell.translation_p90:.3f}',
        f'{cell.oracle_translation_median:.3f} / {cell.oracle_translation_p90:.3f}',
        f'{cell.translation_ratio:.2f} / {cell.translation_p90_ratio:.2f}',
        f'{cell.lost}', f'{cell.gross}', f'{cell.nees_mean:.2f}', f'{cell.oracle_nees_mean:.2f}',
        f'{100 * cell.nees_above:.1f}', f'{100 * cell.oracle_nees_above:.1f}',
        f'{cell.duration_median:.1f}')


def _against_true_sigmas(group: Sequence[CellStatistics], reference: Sequence[CellStatistics],
                         ) -> str:
    """Table of errors by those with the true sigmas."""
    told = {cell.cell: cell for cell in reference}
    rows = [(f'{name}, {statistic} error by that with the true sigmas',
             f'{_median(ratios):.3g}', f'{ratios.max():.3g}', '<= 1.3')
            for name in ('rotation', 'translation') for statistic in ('median', 'p90')
            for ratios in [np.array([
                getattr(cell, f'{name}_{statistic}')
                / getattr(told[cell.cell], f'{name}_{statistic}') for cell in group])]]
    return markdown_table(('over all cells', 'median', 'largest', 'wanted'), rows)


def _plot(path: Path, cells: Sequence[CellStatistics]) -> None:
    """Ratios to the oracle and NEES of every cell."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = (('rotation_ratio', 'median rotation error / oracle', 1.6),
              ('translation_ratio', 'median translation error / oracle', 1.6),
              ('nees_mean', 'NEES / 5', 1.25))
    names = list(dict.fromkeys(cell.cell for cell in cells))
    figure = Figure(figsize=(12.0, 1.6 + 0.22 * len(names)), layout='constrained')
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(panels), sharey=True)
    for axis, (field, label, limit) in zip(axes, panels, strict=True):
        for (noise, factor), group in _settings(cells).items():
            axis.plot([getattr(cell, field) for cell in group],
                      [names.index(cell.cell) for cell in group], 'o', markersize=4, alpha=0.8,
                      label=f'{noise}, told sigmas x {factor:g}')
        axis.axvline(1.0, color='0.6', linewidth=1.0)
        axis.axvline(limit, color='0.6', linewidth=1.0, linestyle=':')
        axis.set_xlabel(label)
        axis.grid(visible=True, axis='y', alpha=0.3)
    axes[0].set_yticks(range(len(names)), names)
    axes[0].invert_yaxis()
    axes[-1].legend(fontsize='small')
    figure.savefig(path, dpi=110)
