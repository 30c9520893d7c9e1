"""What the accuracy experiment says: statistics of each cell, against the project's limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from operator import attrgetter
from pathlib import Path

from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, trim_mean

from rs_relpose_lab.experiments.accuracy import AccuracyRun, Trial
from rs_relpose_lab.experiments.scoring import POSE_FREEDOM, Quantiles
from rs_relpose_lab.experiments.tables import grouped, markdown_table, write_csv
from rs_relpose_ros.picture_files import save_picture

Array = NDArray[np.float64]

# A rotation this wrong [deg] is no noise in any of the cells.
GROSS_ERROR = 2.0


@dataclass(frozen=True, slots=True)
class Consistency:
    """How the errors compare with the covariance.

    `mean`: of the inner 98 % of NEES / 5: 1 is right, more is overconfident.
    `above`: share above the 95 % quantile of chi-square: 0.05 is right.
    """

    mean: float
    above: float


@dataclass(frozen=True, slots=True)
class CellStatistics:
    """Of one cell with one kind of noise and one factor of the told sigmas.

    `lost`, `gross`: trials without a pose, and with a rotation more than `GROSS_ERROR` wrong.
    `rotation` ... `oracle_translation`: errors [deg]; a lost pose counts as infinite.
    `rotation_ratio`, `translation_ratio`: estimator by oracle. `mixture_translation`,
    `mixture_ratio`: of the oracle without labels, and estimator by it; infinite and 0 where it was
    not asked.
    `duration`: median [ms].
    """

    noise: str
    sigma_factor: float
    cell: str
    trials: int
    lost: int
    gross: int
    rotation: Quantiles
    translation: Quantiles
    oracle_rotation: Quantiles
    oracle_translation: Quantiles
    rotation_ratio: Quantiles
    translation_ratio: Quantiles
    mixture_translation: Quantiles
    mixture_ratio: Quantiles
    nees: Consistency
    oracle_nees: Consistency
    duration: float


def cell_statistics(trials: Sequence[Trial]) -> CellStatistics:
    """Statistics of trials of one setting."""
    rotation = Quantiles.of(trial.error.rotation for trial in trials)
    translation = Quantiles.of(trial.error.translation for trial in trials)
    best_rotation = Quantiles.of(trial.oracle.rotation for trial in trials)
    best_translation = Quantiles.of(trial.oracle.translation for trial in trials)
    mixture = Quantiles.of(trial.mixture.translation for trial in trials)
    return CellStatistics(
        noise=trials[0].noise, sigma_factor=trials[0].sigma_factor, cell=trials[0].cell,
        trials=len(trials),
        lost=sum(bool(np.isinf(trial.error.rotation)) for trial in trials),
        gross=sum(GROSS_ERROR < trial.error.rotation < np.inf for trial in trials),
        rotation=rotation, translation=translation, oracle_rotation=best_rotation,
        oracle_translation=best_translation, rotation_ratio=_ratio(rotation, best_rotation),
        translation_ratio=_ratio(translation, best_translation), mixture_translation=mixture,
        mixture_ratio=(_ratio(translation, mixture) if math.isfinite(mixture.median)
                       else Quantiles(0.0, 0.0)),
        nees=consistency([trial.error.nees for trial in trials]),
        oracle_nees=consistency([trial.oracle.nees for trial in trials]),
        duration=float(np.median([trial.duration for trial in trials])) * 1e3)


def consistency(nees: Sequence[float]) -> Consistency:
    """Statistics of normalised errors; NaN, of a pose that is lost, is left out."""
    known = np.array([value for value in nees if not np.isnan(value)])
    if len(known) == 0:
        return Consistency(float('nan'), float('nan'))
    return Consistency(float(trim_mean(known, 0.01)) / POSE_FREEDOM,
                       float((known > chi2.ppf(0.95, POSE_FREEDOM)).mean()))


def _ratio(error: Quantiles, reference: Quantiles) -> Quantiles:
    return Quantiles(error.median / reference.median, error.p90 / reference.p90)


def summary(cells: Sequence[CellStatistics]) -> list[tuple[str, float, str]]:
    """What the project asks for, over cells of one noise and factor: name, figure, limit."""
    def column(name: str) -> Array:
        return np.array([attrgetter(name)(cell) for cell in cells])

    rotation, translation = column('rotation_ratio.median'), column('translation_ratio.median')
    mean, above = column('nees.mean'), 100.0 * column('nees.above')
    return [
        ('ratio of median rotation errors, median over cells', _median(rotation), '<= 1.10'),
        ('ratio of median translation errors, median over cells', _median(translation), '<= 1.20'),
        ('ratio of median errors, largest of a cell',
         float(np.maximum(rotation, translation).max()), '<= 1.6'),
        ('ratio of 90th percentiles of rotation, median over cells',
         _median(column('rotation_ratio.p90')), '<= 1.5'),
        ('ratio of 90th percentiles of translation, median over cells',
         _median(column('translation_ratio.p90')), '<= 1.5'),
        ("ratio of 90th percentiles of translation to the mixture oracle's, largest of a cell",
         float(column('mixture_ratio.p90').max()), '<= 1.5'),
        ('lost poses', float(column('lost').sum()), '0'),
        (f'rotations wrong by more than {GROSS_ERROR:g} deg', float(column('gross').sum()), '0'),
        ('NEES / 5, smallest of a cell', float(mean.min()), '>= 0.8'),
        ('NEES / 5, largest of a cell', float(mean.max()), '<= 1.25'),
        ('above the 95 % quantile, smallest of a cell [%]', float(above.min()), '>= 2'),
        ('above the 95 % quantile, largest of a cell [%]', float(above.max()), '<= 10'),
        ('median time of an estimate, median over cells [ms]', _median(column('duration')), ''),
    ]


def _median(values: Array) -> float:
    return float(np.median(values))


def write_report(folder: Path, run: AccuracyRun, trials: Sequence[Trial]) -> str:
    """Write every trial, the statistics of every cell, the plot and the report; the report."""
    folder.mkdir(parents=True, exist_ok=True)
    cells = [cell_statistics(group) for group in grouped(
        trials, attrgetter('noise', 'sigma_factor', 'cell')).values()]
    write_csv(folder / 'trials.csv', trials)
    write_csv(folder / 'cells.csv', cells)
    report = _report(run, cells)
    (folder / 'accuracy.md').write_text(report)
    draw(folder / 'accuracy.png', cells)
    return report


def _report(run: AccuracyRun, cells: Sequence[CellStatistics]) -> str:
    parts = [
        '# Accuracy against the oracle\n',
        (f'{run.trials} trials a cell, solver `{run.solver}`, errors in degrees '
         '(median / 90th percentile); a ratio is estimator by oracle. NEES / 5 is the mean of the '
         'inner 98 %; "above" is the share above the 95 % quantile of chi-square(5). The mixture '
         'oracle, asked where there are many outliers, does not know which matches are true.\n')]
    settings = grouped(cells, attrgetter('noise', 'sigma_factor'))
    for (noise, factor), group in settings.items():
        parts.append(f'## Noise of gravity: {noise}; told sigmas {factor:g} times the true ones\n')
        parts.append(markdown_table(
            ('cell', 'R', 'oracle', 'ratio', 't', 'oracle', 'ratio', 'mixture oracle',
             'ratio', 'lost', 'gross', 'NEES / 5',
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
        cell.cell, cell.rotation.text(3), cell.oracle_rotation.text(3),
        cell.rotation_ratio.text(2), cell.translation.text(3), cell.oracle_translation.text(3),
        cell.translation_ratio.text(2), *_against_mixture(cell), f'{cell.lost}',
        f'{cell.gross}', f'{cell.nees.mean:.2f}', f'{cell.oracle_nees.mean:.2f}',
        f'{100 * cell.nees.above:.1f}', f'{100 * cell.oracle_nees.above:.1f}',
        f'{cell.duration:.1f}')


def _against_mixture(cell: CellStatistics) -> tuple[str, str]:
    if math.isinf(cell.mixture_translation.median):
        return '', ''
    return cell.mixture_translation.text(3), cell.mixture_ratio.text(2)


def _against_true_sigmas(group: Sequence[CellStatistics], reference: Sequence[CellStatistics],
                         ) -> str:
    """Table of errors by those with the true sigmas."""
    told = {cell.cell: cell for cell in reference}
    rows = []
    for name in ('rotation', 'translation'):
        for statistic in ('median', 'p90'):
            value = attrgetter(f'{name}.{statistic}')
            ratios = np.array([value(cell) / value(told[cell.cell]) for cell in group])
            rows.append((f'{statistic} {name} error by that with the true sigmas',
                         f'{_median(ratios):.3g}', f'{ratios.max():.3g}', '<= 1.3'))
    return markdown_table(('over all cells', 'median', 'largest', 'wanted'), rows)


def draw(path: Path, cells: Sequence[CellStatistics]) -> Figure:
    """Ratios to the oracle and NEES of every cell."""
    panels = (('rotation_ratio.median', 'median rotation error / oracle', 1.6),
              ('translation_ratio.median', 'median translation error / oracle', 1.6),
              ('nees.mean', 'NEES / 5', 1.25))
    names = list(dict.fromkeys(cell.cell for cell in cells))
    figure = Figure(figsize=(12.0, 1.6 + 0.22 * len(names)), dpi=110, layout='constrained')
    axes = figure.subplots(1, len(panels), sharey=True)
    for axis, (field, label, limit) in zip(axes, panels, strict=True):
        for (noise, factor), group in grouped(cells, attrgetter('noise', 'sigma_factor')).items():
            axis.plot(list(map(attrgetter(field), group)),
                      [names.index(cell.cell) for cell in group], 'o', markersize=4, alpha=0.8,
                      label=f'{noise}, told sigmas x {factor:g}')
        axis.axvline(1.0, color='0.6', linewidth=1.0)
        axis.axvline(limit, color='0.6', linewidth=1.0, linestyle=':')
        axis.set_xlabel(label)
        axis.grid(visible=True, axis='y', alpha=0.3)
    axes[0].set_yticks(range(len(names)), names)
    axes[0].invert_yaxis()
    axes[-1].legend(fontsize='small')
    save_picture(figure, path)
    return figure
