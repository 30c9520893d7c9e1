"""What the comparison says: tables and a plot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
import math
from operator import attrgetter
from pathlib import Path
import platform

import cv2
from matplotlib.figure import Figure
import numpy as np

from rs_relpose_lab.experiments.scoring import Quantiles
from rs_relpose_lab.experiments.speed import (
    exponent,
    LIBRARY,
    medians,
    REFERENCE,
    Soak,
    THRESHOLD,
    Timing,
)
from rs_relpose_lab.experiments.tables import grouped, markdown_table, write_csv
from rs_relpose_ros.picture_files import save_picture


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
    time: Quantiles
    time_ratio: float
    rotation: Quantiles
    translation: Quantiles


def method_statistics(timings: Sequence[Timing]) -> list[MethodStatistics]:
    """Statistics of each method in each cell and number of matches."""
    groups = grouped(timings, attrgetter('cell', 'matches', 'method'))
    result = []
    for (cell, matches, method), group in groups.items():
        reference = {timing.seed: timing.duration
                     for timing in groups.get((cell, matches, REFERENCE), [])}
        result.append(MethodStatistics(
            cell, matches, method, trials=len(group),
            lost=sum(math.isinf(timing.rotation) for timing in group),
            time=Quantiles.of(timing.duration for timing in group),
            time_ratio=float(np.median([timing.duration / reference.get(timing.seed, math.nan)
                                        for timing in group])),
            rotation=Quantiles.of(timing.rotation for timing in group),
            translation=Quantiles.of(timing.translation for timing in group)))
    return result


def write_report(folder: Path, comparison: Sequence[Timing], scaling: Sequence[Timing],
                 first: Sequence[tuple[float, float]], soak: Soak | None) -> str:
    """Write runs, tables, plot and report into a folder; the report."""
    folder.mkdir(parents=True, exist_ok=True)
    compared, scaled = method_statistics(comparison), method_statistics(scaling)
    write_csv(folder / 'runs.csv', [*comparison, *scaling])
    write_csv(folder / 'methods.csv', compared)
    write_csv(folder / 'scaling.csv', scaled)
    report = _report(compared, scaling, first, soak)
    (folder / 'speed.md').write_text(report)
    draw(folder / 'speed.png', compared, scaling)
    return report


def _report(compared: Sequence[MethodStatistics], scaling: Sequence[Timing],
            first: Sequence[tuple[float, float]], soak: Soak | None) -> str:
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
            [(entry.method, entry.time.text(2), f'{entry.time_ratio:.2f}', entry.rotation.text(3),
              entry.translation.text(3), f'{entry.lost}') for entry in rows]))
    if scaling:
        parts.append(_scaling_table(scaling))
    if first:
        firsts, seconds = zip(*first, strict=True)
        parts.append('## A new process, kernels cached\n')
        parts.append(f'First estimate {np.median(firsts):.0f} ms (largest of {len(first)} '
                     f'processes: {max(firsts):.0f} ms), second {np.median(seconds):.1f} ms; '
                     'imports not counted.\n')
    if soak is not None:
        parts.append('## Memory\n')
        parts.append(f'Resident {soak.before:.1f} MB before and {soak.after:.1f} MB after '
                     f'{soak.estimates} estimates.\n')
    return '\n'.join(parts)


def _scaling_table(scaling: Sequence[Timing]) -> str:
    methods = list(dict.fromkeys(timing.method for timing in scaling))
    sizes = sorted({timing.matches for timing in scaling})
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
    path = Path('/proc/cpuinfo')
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.partition(':')[2].strip() for line in lines if line.startswith('model name')]
    return names[0] if names else platform.machine()


def _versions() -> str:
    try:
        poselib = f'PoseLib {version("poselib")}'
    except PackageNotFoundError:
        poselib = 'PoseLib is not installed'
    return (f'Python {platform.python_version()}, NumPy {np.__version__}, '
            f'Numba {version("numba")}, OpenCV {cv2.__version__}, {poselib}')


def draw(path: Path, compared: Sequence[MethodStatistics],
         scaling: Sequence[Timing]) -> Figure:
    """Error over time of every method, and time over matches."""
    figure = Figure(figsize=(12.0, 4.5), dpi=110, layout='constrained')
    left, right = figure.subplots(1, 2)
    markers = dict(zip(dict.fromkeys(entry.cell for entry in compared), 'osD^v<>Pp*h' * 5,
                       strict=False))
    colours = {method: f'C{k}' for k, method in enumerate(
        dict.fromkeys(entry.method for entry in compared))}
    for entry in compared:
        first = entry.cell == compared[0].cell
        left.loglog(entry.time.median, entry.rotation.median, markers[entry.cell],
                    color=colours[entry.method], label=entry.method if first else None)
    left.set_title(', '.join(f'{marker}: {cell}' for cell, marker in markers.items()), fontsize=9)
    left.set_xlabel('median time [ms]')
    left.set_ylabel('median rotation error [deg]')
    left.legend(fontsize='small')
    for method in dict.fromkeys(timing.method for timing in scaling):
        times = medians(scaling, method)
        right.loglog(list(times), list(times.values()), 'o-', color=colours[method],
                     linewidth=2.5 if method == LIBRARY else 1.2)
    right.set_xlabel('matches')
    right.set_ylabel('median time [ms]')
    for axis in (left, right):
        axis.grid(visible=True, which='both', alpha=0.3)
    save_picture(figure, path)
    return figure
