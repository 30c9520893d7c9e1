"""The estimator against the oracle: many random problems in each cell of the experiment."""

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
import hashlib
import json
from operator import attrgetter
from pathlib import Path
import time

import numpy as np
from scipy.stats import chi2, trim_mean

from rs_relpose_lab.experiments import oracle, problems
from rs_relpose_lab.experiments.harness import grouped, in_processes, markdown_table, write_csv
from rs_relpose_lab.experiments.methods import as_pair, METHODS, prepared
from rs_relpose_lab.experiments.oracle import oracle_estimate
from rs_relpose_lab.experiments.problems import Cell, CELLS, make_problem, Noise, TwoViewProblem
from rs_relpose_lab.experiments.scoring import pose_error, POSE_FREEDOM, PoseError, Quantiles
from rs_relpose_lab.simulation import rows
from rs_relpose_ros import RelativePose, warm_up
from rs_relpose_ros.geometry import Array


@dataclass(frozen=True, slots=True)
class Trial:
    """One problem, estimated."""

    cell: str
    noise: Noise
    sigma_factor: float  # configured sigmas by the true ones
    seed: int
    status: str
    error: PoseError
    oracle: PoseError
    duration: float  # of the whole estimate [s]


@dataclass(frozen=True, slots=True)
class AccuracyRun:
    """Every cell with every kind of noise and every factor of the configured sigmas."""

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


def run_accuracy(
    run: AccuracyRun,
    kept: Path,
    jobs: int = 1,
    on_trials: Callable[[int], object] = lambda count: None,
) -> list[Trial]:
    """Run all trials.

    `kept`: folder of the oracle's errors. It need not run again while the estimator is developed.
    `jobs`: processes; durations are comparable only where each has a core of its own.
    `on_trials`: called with the number of estimates that have been added.
    """
    # One file for each state of what decides its content.
    source = b''.join(
        Path(str(module.__file__)).read_bytes() for module in (rows, problems, oracle)
    )
    path = kept / f'{hashlib.sha256(source).hexdigest()[:24]}.json'
    known = json.loads(path.read_text()) if path.is_file() else {}
    kept.mkdir(parents=True, exist_ok=True)
    seeds = range(run.first_seed, run.first_seed + run.trials)
    chunk = 10
    tasks = [
        (
            run,
            cell,
            noise,
            [(seed, known.get(f'{cell} {noise} {seed}')) for seed in seeds[first : first + chunk]],
        )
        for cell in run.cells
        for noise in run.noises
        for first in range(0, run.trials, chunk)
    ]
    trials: list[Trial] = []
    for done in in_processes(_run, tasks, jobs, warm_up):
        trials += done
        known |= {
            f'{trial.cell} {trial.noise} {trial.seed}': astuple(trial.oracle) for trial in done
        }
        # Replaced as a whole, so that an interrupted run leaves no partial file.
        path.with_suffix('.new').write_text(json.dumps(known))
        path.with_suffix('.new').replace(path)
        on_trials(len(done))
    return trials


def _run(
    task: tuple[AccuracyRun, str, Noise, list[tuple[int, list[float] | None]]],
) -> list[Trial]:
    """Some seeds of a cell, with the oracle's errors where they are known."""
    run, name, noise, seeds = task
    cell = CELLS[name]
    method = replace(METHODS['auto'], solver=run.solver)
    trials = []
    for seed, known in seeds:
        problem = make_problem(cell, seed, noise)
        best = PoseError(*known) if known else _oracle_error(cell, problem)
        for factor in run.sigma_factors:
            pair = as_pair(problem, cell, factor)
            call = prepared(method, pair, seed)
            started = time.perf_counter()
            pose = call()
            duration = time.perf_counter() - started
            assert isinstance(pose, RelativePose)
            trials.append(
                Trial(
                    name, noise, factor, seed, pose.status.value, pair.error(pose), best, duration
                )
            )
    return trials


def _oracle_error(cell: Cell, problem: TwoViewProblem) -> PoseError:
    best = oracle_estimate(
        problem,
        cell.pixel_noise,
        float(np.radians(cell.gravity_noise)),
        float(np.radians(cell.gyro_noise)),
    )
    return pose_error(best.R, best.t, problem.R, problem.t, best.covariance)


# -- report: statistics of each cell, against the project's limits ----------------------------

# A rotation this wrong [deg] is no noise in any of the cells.
GROSS_ERROR = 2.0


@dataclass(frozen=True, slots=True)
class Consistency:
    """Errors in units of the covariance."""

    mean: float  # of the inner 98 % of NEES / 5: 1 is right, more is overconfident
    above: float  # share above the 95 % quantile of chi-square: 0.05 is right


@dataclass(frozen=True, slots=True)
class CellStatistics:
    """Of one cell with one kind of noise and one factor of the configured sigmas.

    Errors are in degrees; a lost pose counts as infinite.
    """

    noise: str
    sigma_factor: float
    cell: str
    trials: int
    lost: int  # trials without a pose
    gross: int  # trials with a rotation more than `GROSS_ERROR` wrong
    rotation: Quantiles
    translation: Quantiles
    oracle_rotation: Quantiles
    oracle_translation: Quantiles
    rotation_ratio: Quantiles  # estimator by oracle
    translation_ratio: Quantiles  # likewise
    nees: Consistency
    oracle_nees: Consistency
    duration: float  # median [ms]


def cell_statistics(trials: Sequence[Trial]) -> CellStatistics:
    """Statistics of trials of one setting."""
    rotation = Quantiles.of(trial.error.rotation for trial in trials)
    translation = Quantiles.of(trial.error.translation for trial in trials)
    best_rotation = Quantiles.of(trial.oracle.rotation for trial in trials)
    best_translation = Quantiles.of(trial.oracle.translation for trial in trials)
    return CellStatistics(
        noise=trials[0].noise,
        sigma_factor=trials[0].sigma_factor,
        cell=trials[0].cell,
        trials=len(trials),
        lost=sum(bool(np.isinf(trial.error.rotation)) for trial in trials),
        gross=sum(GROSS_ERROR < trial.error.rotation < np.inf for trial in trials),
        rotation=rotation,
        translation=translation,
        oracle_rotation=best_rotation,
        oracle_translation=best_translation,
        rotation_ratio=_ratio(rotation, best_rotation),
        translation_ratio=_ratio(translation, best_translation),
        nees=consistency([trial.error.nees for trial in trials]),
        oracle_nees=consistency([trial.oracle.nees for trial in trials]),
        duration=float(np.median([trial.duration for trial in trials])) * 1e3,
    )


def consistency(nees: Sequence[float]) -> Consistency:
    """Statistics of normalised errors; NaN, of a pose that is lost, is left out."""
    known = np.array([value for value in nees if not np.isnan(value)])
    if len(known) == 0:
        return Consistency(float('nan'), float('nan'))
    return Consistency(
        float(trim_mean(known, 0.01)) / POSE_FREEDOM,
        float((known > chi2.ppf(0.95, POSE_FREEDOM)).mean()),
    )


def _ratio(error: Quantiles, reference: Quantiles) -> Quantiles:
    return Quantiles(error.median / reference.median, error.p90 / reference.p90)


def summary(cells: Sequence[CellStatistics]) -> list[tuple[str, float, str]]:
    """Name, value and limit of the project's criteria, over cells of one noise and factor."""

    def column(name: str) -> Array:
        return np.array([attrgetter(name)(cell) for cell in cells])

    rotation = column('rotation_ratio.median')
    translation = column('translation_ratio.median')
    mean = column('nees.mean')
    above = 100.0 * column('nees.above')
    return [
        ('ratio of median rotation errors, median over cells', _median(rotation), '<= 1.10'),
        ('ratio of median translation errors, median over cells', _median(translation), '<= 1.20'),
        (
            'ratio of median errors, largest of a cell',
            float(np.maximum(rotation, translation).max()),
            '<= 1.6',
        ),
        (
            'ratio of 90th percentiles of rotation, median over cells',
            _median(column('rotation_ratio.p90')),
            '<= 1.5',
        ),
        (
            'ratio of 90th percentiles of translation, median over cells',
            _median(column('translation_ratio.p90')),
            '<= 1.5',
        ),
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
    cells = [
        cell_statistics(group)
        for group in grouped(trials, attrgetter('noise', 'sigma_factor', 'cell')).values()
    ]
    write_csv(folder / 'trials.csv', trials)
    write_csv(folder / 'cells.csv', cells)
    report = _report(run, cells)
    (folder / 'accuracy.md').write_text(report)
    return report


def _report(run: AccuracyRun, cells: Sequence[CellStatistics]) -> str:
    parts = [
        '# Accuracy against the oracle\n',
        (
            f'{run.trials} trials a cell, solver `{run.solver}`, errors in degrees '
            '(median / 90th percentile); a ratio is estimator by oracle. NEES / 5 is the mean of '
            'the '
            'inner 98 %; "above" is the share above the 95 % quantile of chi-square(5).\n'
        ),
    ]
    settings = grouped(cells, attrgetter('noise', 'sigma_factor'))
    for (noise, factor), group in settings.items():
        parts.append(f'## Noise of gravity: {noise}; sigmas {factor:g} times the true ones\n')
        parts.append(
            markdown_table(
                (
                    'cell',
                    'R',
                    'oracle',
                    'ratio',
                    't',
                    'oracle',
                    'ratio',
                    'lost',
                    'gross',
                    'NEES / 5',
                    'oracle',
                    'above [%]',
                    'oracle',
                    'ms',
                ),
                [_row(cell) for cell in group],
            )
        )
        parts.append(
            markdown_table(
                ('over all cells', 'value', 'wanted'),
                [(name, f'{value:.3g}', limit) for name, value, limit in summary(group)],
            )
        )
        reference = settings.get((noise, 1.0))
        if factor != 1.0 and reference:
            parts.append(_against_true_sigmas(group, reference))
    return '\n'.join(parts)


def _row(cell: CellStatistics) -> tuple[str, ...]:
    return (
        cell.cell,
        cell.rotation.text(3),
        cell.oracle_rotation.text(3),
        cell.rotation_ratio.text(2),
        cell.translation.text(3),
        cell.oracle_translation.text(3),
        cell.translation_ratio.text(2),
        f'{cell.lost}',
        f'{cell.gross}',
        f'{cell.nees.mean:.2f}',
        f'{cell.oracle_nees.mean:.2f}',
        f'{100 * cell.nees.above:.1f}',
        f'{100 * cell.oracle_nees.above:.1f}',
        f'{cell.duration:.1f}',
    )


def _against_true_sigmas(
    group: Sequence[CellStatistics],
    reference: Sequence[CellStatistics],
) -> str:
    """Table of errors by those with the true sigmas."""
    configured = {cell.cell: cell for cell in reference}
    rows = []
    for name in ('rotation', 'translation'):
        for statistic in ('median', 'p90'):
            value = attrgetter(f'{name}.{statistic}')
            ratios = np.array([value(cell) / value(configured[cell.cell]) for cell in group])
            rows.append(
                (
                    f'{statistic} {name} error by that with the true sigmas',
                    f'{_median(ratios):.3g}',
                    f'{ratios.max():.3g}',
                    '<= 1.3',
                )
            )
    return markdown_table(('over all cells', 'median', 'largest', 'wanted'), rows)
