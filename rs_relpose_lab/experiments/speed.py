"""Time and accuracy of this library, OpenCV and PoseLib on the same problems."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
import math
from operator import attrgetter
from pathlib import Path
import platform
import timeit

import cv2
import numpy as np

from rs_relpose_lab.experiments.harness import grouped, markdown_table, write_csv
from rs_relpose_lab.experiments.methods import as_pair, METHODS, prepared
from rs_relpose_lab.experiments.problems import CELLS, make_problem
from rs_relpose_lab.experiments.scoring import Quantiles
from rs_relpose_ros import warm_up

# Threshold of OpenCV and PoseLib [px]. [chosen: three times the noise of the problems]
THRESHOLD = 1.5
# Estimates of a problem, of which the fastest counts. [chosen: leaves interruptions out]
REPEATS = 3
# Name of this package in the report.
LIBRARY = 'rs_relpose_ros'
# Method that times are compared with.
REFERENCE = 'PoseLib, derotated points'
# In the report; PoseLib's only where it is installed.
COMPARED = {LIBRARY: METHODS['auto']} | {
    name: replace(METHODS[key], threshold=THRESHOLD)
    for name, key in (
        ('OpenCV USAC_MAGSAC, raw points', 'opencv'),
        ('OpenCV USAC_MAGSAC, derotated points', 'opencv_derotated'),
        ('PoseLib, raw points', 'poselib'),
        (REFERENCE, 'poselib_derotated'),
    )
    if key in METHODS
}


@dataclass(frozen=True, slots=True)
class Timing:
    """One method on one problem: shortest time [ms], errors [deg], infinite without a pose."""

    cell: str
    matches: int
    method: str
    seed: int
    duration: float
    rotation: float
    translation: float


def compare(
    cell_name: str,
    matches: int,
    trials: int,
    first_seed: int = 0,
    on_problem: Callable[[], object] = lambda: None,
) -> list[Timing]:
    """Run every method on the same problems of a cell.

    The methods alternate on each problem, and the shortest of three repeats counts, so that other
    load of the machine affects all methods alike.
    """
    cell = replace(CELLS[cell_name], matches=matches)
    # OpenCV would use all cores.
    cv2.setNumThreads(1)
    warm_up()
    timings = []
    for seed in range(first_seed, first_seed + trials):
        pair = as_pair(make_problem(cell, seed), cell)
        for name, method in COMPARED.items():
            call = prepared(method, pair, seed)
            duration = 1e3 * min(timeit.repeat(call, number=1, repeat=REPEATS))
            error = pair.error(call())
            timings.append(
                Timing(cell_name, matches, name, seed, duration, error.rotation, error.translation)
            )
        on_problem()
    return timings


# -- report -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class MethodStatistics:
    """Of one method in one cell: times [ms], errors [deg], a lost pose is infinite."""

    cell: str
    matches: int
    method: str
    trials: int
    lost: int
    time: Quantiles
    time_ratio: float  # median of its time by that of PoseLib on derotated points, if installed
    rotation: Quantiles
    translation: Quantiles


def method_statistics(timings: Sequence[Timing]) -> list[MethodStatistics]:
    """Statistics of each method in each cell and number of matches."""
    groups = grouped(timings, attrgetter('cell', 'matches', 'method'))
    result = []
    for (cell, matches, method), group in groups.items():
        reference = {
            timing.seed: timing.duration for timing in groups.get((cell, matches, REFERENCE), [])
        }
        result.append(
            MethodStatistics(
                cell,
                matches,
                method,
                trials=len(group),
                lost=sum(math.isinf(timing.rotation) for timing in group),
                time=Quantiles.of(timing.duration for timing in group),
                time_ratio=float(
                    np.median(
                        [
                            timing.duration / reference.get(timing.seed, math.nan)
                            for timing in group
                        ]
                    )
                ),
                rotation=Quantiles.of(timing.rotation for timing in group),
                translation=Quantiles.of(timing.translation for timing in group),
            )
        )
    return result


def write_report(folder: Path, comparison: Sequence[Timing], scaling: Sequence[Timing]) -> str:
    """Write runs, tables, plot and report into a folder; the report."""
    compared = method_statistics(comparison)
    scaled = method_statistics(scaling)
    write_csv(folder / 'runs.csv', [*comparison, *scaling])
    write_csv(folder / 'methods.csv', compared)
    write_csv(folder / 'scaling.csv', scaled)
    report = _report(compared, scaling)
    (folder / 'speed.md').write_text(report)
    return report


def _report(compared: Sequence[MethodStatistics], scaling: Sequence[Timing]) -> str:
    parts = [
        '# Speed\n',
        (
            f'One thread of {_processor()}; {_versions()}. OpenCV and PoseLib with a threshold of '
            f'{THRESHOLD:g} px and default options; derotating their points is not counted. This '
            'library in its default configuration, covariance included. Median / 90th '
            'percentile.\n'
        ),
    ]
    for cell in dict.fromkeys(entry.cell for entry in compared):
        rows = [entry for entry in compared if entry.cell == cell]
        parts.append(f'## {cell}, {rows[0].matches} matches, {rows[0].trials} problems\n')
        parts.append(
            markdown_table(
                ('method', 'time [ms]', 'by PoseLib, derotated', 'R [deg]', 't [deg]', 'lost'),
                [
                    (
                        entry.method,
                        entry.time.text(2),
                        f'{entry.time_ratio:.2f}',
                        entry.rotation.text(3),
                        entry.translation.text(3),
                        f'{entry.lost}',
                    )
                    for entry in rows
                ],
            )
        )
    if scaling:
        parts.append(_scaling_table(scaling))
    return '\n'.join(parts)


def _scaling_table(scaling: Sequence[Timing]) -> str:
    """Median times, and the slope of log time over log matches: 1 is linear."""
    sizes = sorted({timing.matches for timing in scaling})
    rows = []
    for method, timings in grouped(scaling, attrgetter('method')).items():
        times = [
            float(np.median([one.duration for one in timings if one.matches == size]))
            for size in sizes
        ]
        slope = np.polyfit(np.log(sizes), np.log(times), 1)[0] if len(sizes) > 1 else math.nan
        rows.append((method, *(f'{time:.2f}' for time in times), f'{slope:.2f}'))
    return '\n'.join(
        [
            f'## Median time [ms] by the number of matches ({scaling[0].cell})\n',
            markdown_table(('method', *map(str, sizes), 'exponent'), rows),
            'An exponent of 1 is linear growth.\n',
        ]
    )


def _processor() -> str:
    """Name of the processor on Linux, else of the architecture."""
    path = Path('/proc/cpuinfo')
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.partition(':')[2].strip() for line in lines if line.startswith('model name')]
    return names[0] if names else platform.machine()


def _versions() -> str:
    try:
        poselib = f'PoseLib {version("poselib")}'
    except PackageNotFoundError:
        poselib = 'PoseLib is not installed'
    return (
        f'Python {platform.python_version()}, NumPy {np.__version__}, '
        f'Numba {version("numba")}, OpenCV {cv2.__version__}, {poselib}'
    )
