"""What the comparison says: tables and a plot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
import platform

import cv2
import numpy as np

from rs_relpose_lab.experiments.peers import LIBRARY, POSELIB_DEROTATED, THRESHOLD
from rs_relpose_lab.experiments.speed import exponent, FirstEstimate, medians, Run, Soak
from rs_relpose_lab.experiments.tables import markdown_table, write_csv
from rs_relpose_ros.picture_files import save_picture

RUNS_FILE, METHODS_FILE, SCALING_FILE = 'runs.csv', 'methods.csv', 'scaling.csv'
REPORT_FILE, PLOT_FILE = 'speed.md', 'speed.png'


@dataclass(frozen=True, slots=True)
class MethodStatistics:
    """Of one method in one cell: times [ms], errors [deg], a lost pose is infinite.

    `time_ratio` is the median over problems of its time by that of PoseLib on derotated points;
    NaN where PoseLib is not installed.
    """

    cell: str
    matches: int
    method: str
    trials: int
    lost: int
    time_median: float
    time_p90: float
    time_ratio: float
    rotation_median: float
    rotation_p90: float
    translation_median: float
    translation_p90: float


def method_statistics(runs: Sequence[Run]) -> list[MethodStatistics]:
    """Statistics of each method in each cell and number of matches."""
    groups: dict[tuple[str, int, str], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.cell, run.matches, run.method), []).append(run)
    result = []
    for (cell, matches, method), group in groups.items():
        reference = {run.seed: run.duration
                     for run in groups.get((cell, matches, POSELIB_DEROTATED), [])}
        ratios = [run.duration / reference.get(run.seed, np.nan) for run in group]
        result.append(MethodStatistics(
            cell, matches, method, len(group), sum(bool(np.isinf(run.rotation)) for run in group),
            *_quantiles([run.duration for run in group]), float(np.median(ratios)),
            *_quantiles([run.rotation for run in group]),
            *_quantiles([run.translation for run in group])))
    return result


def _quantiles(values: Sequence[float]) -> tuple[float, float]:
    median, p90 = np.quantile(values, [0.5, 0.9], method='higher')
    return float(median), float(p90)


def write_report(folder: Path, comparison: Sequence[Run], scaling: Sequence[Run],
                 first: Sequence[FirstEstimate], soak: Soak | None) -> str:
    """Write runs, tables, report and plot into a folder, which is made where it is missing.

    Returns
    -------
    str
        The report (Markdown).
    """
    folder.mkdir(parents=True, exist_ok=True)
    compared, scaled = method_statistics(comparison), method_statistics(scaling)
    write_csv(folder / RUNS_FILE, [*comparison, *scaling])
    write_csv(folder / METHODS_FILE, compared)
    write_csv(folder / SCALING_FILE, scaled)
    report = _report(compared, scaling, first, soak)
    (folder / REPORT_FILE).write_text(report)
    _plot(folder / PLOT_FILE, compared, scaling)
    return report


def _report(compared: Sequence[MethodStatistics], scaling: Sequence[Run],
            first: Sequence[FirstEstimate], soak: Soak | None) -> str:
    parts = [
        '# Speed, side by side\n',
        (f'One thread of {_processor()}; {_versions()}. OpenCV and PoseLib with a threshold of '
         f'{THRESHOLD:g} px and default options; derotating their points is not counted. This '
         'library in its default configuration, covariance included. Median / 90th percentile.\n')]
    for cell in dict.fromkeys(entry.cell for entry in compared):
        rows = [entry for entry in compared if entry.cell == cell]
        parts.append(f'## {cell}, {rows[0].matches} matches, {rows[0].trials} problems\n')
        parts.append(markdown_table(
            ('method', 'time [ms]', 'by PoseLib, derotated', 'R [deg]', 't [deg]', 'lost'),
            [(entry.method, f'{entry.time_median:.2f} / {entry.time_p90:.2f}',
              f'{entry.time_ratio:.2f}', f'{entry.rotation_median:.3f} / {entry.rotation_p90:.3f}',
              f'{entry.translation_median:.3f} / {entry.translation_p90:.3f}', f'{entry.lost}')
             for entry in rows]))
    if scaling:
        parts.append(_scaling_table(scaling))
    if first:
        firsts, seconds = zip(*((entry.first, entry.second) for entry in first), strict=True)
        parts.append('## A new process, kernels cached\n')
        parts.append(f'First estimate {np.median(firsts):.0f} ms (largest of {len(first)} '
                     f'processes: {max(firsts):.0f} ms), second {np.median(seconds):.1f} ms; '
                     'imports not counted.\n')
    if soak is not None:
        parts.append('## Memory\n')
        parts.append(f'Resident {soak.before:.1f} MB before and {soak.after:.1f} MB after '
                     f'{soak.estimates} estimates.\n')
    return '\n'.join(parts)


def _scaling_table(scaling: Sequence[Run]) -> str:
    methods = list(dict.fromkeys(run.method for run in scaling))
    sizes = sorted({run.matches for run in scaling})
    rows = []
    for method in methods:
        times = medians(scaling, method)
        rows.append((method, *(f'{times[size]:.2f}' for size in sizes), f'{exponent(times):.2f}'))
    return '\n'.join([
        f'## Median time [ms] by the number of matches ({scaling[0].cell})\n',
        markdown_table(('method', *map(str, sizes), 'exponent'), rows),
        'An exponent of 1 is linear growth.\n'])


def _processor() -> str:
    """Name of the processor, where Linux tells it."""
    try:
        lines = Path('/proc/cpuinfo').read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(':')[2].strip() for line in lines if line.startswith('model name')]
    return names[0] if names else platform.machine()


def _versions() -> str:
    try:
        poselib = f'PoseLib {version("poselib")}'
    except PackageNotFoundError:
        poselib = 'PoseLib is not installed'
    return (f'Python {platform.python_version()}, NumPy {np.__version__}, '
            f'Numba {version("numba")}, OpenCV {cv2.__version__}, {poselib}')


def _plot(path: Path, compared: Sequence[MethodStatistics], scaling: Sequence[Run]) -> None:
    """Error over time of every method, and time over matches."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 4.5), dpi=110, layout='constrained')
    left, right = figure.subplots(1, 2)
    markers = dict(zip(dict.fromkeys(entry.cell for entry in compared), 'osD^v<>Pp*h' * 5,
                       strict=False))
    colours = {method: f'C{k}' for k, method in enumerate(
        dict.fromkeys(entry.method for entry in compared))}
    for entry in compared:
        first = entry.cell == compared[0].cell
        left.loglog(entry.time_median, entry.rotation_median, markers[entry.cell],
                    color=colours[entry.method], label=entry.method if first else None)
    left.set_title(', '.join(f'{marker}: {cell}' for cell, marker in markers.items()), fontsize=9)
    left.set_xlabel('median time [ms]')
    left.set_ylabel('median rotation error [deg]')
    left.legend(fontsize='small')
    for method in dict.fromkeys(run.method for run in scaling):
        times = medians(scaling, method)
        right.loglog(list(times), list(times.values()), 'o-', color=colours[method],
                     linewidth=2.5 if method == LIBRARY else 1.2)
    right.set_xlabel('matches')
    right.set_ylabel('median time [ms]')
    for axis in (left, right):
        axis.grid(visible=True, which='both', alpha=0.3)
    save_picture(figure, path)
