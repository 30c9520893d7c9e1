"""Tables and pictures of the live benchmark."""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path
import platform

from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.experiments.live import Course, LiveStatistics, Percentiles
from rs_relpose_lab.experiments.tables import markdown_table, write_csv
from rs_relpose_ros.picture_files import save_picture


def write_report(folder: Path, cells: Sequence[LiveStatistics]) -> str:
    """Write table, plot and report into a folder; the report."""
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / 'live.csv', cells)
    report = '\n'.join([
        '# The live node\n',
        (f'Node and player on {os.cpu_count()} cores of {platform.machine()}, Python '
         f'{platform.python_version()}; images at 30 Hz from best-effort publishers. Times in ms: '
         'median / 99th percentile. CPU in percent of one core.\n'),
        markdown_table(
            ('cell', 'sent', 'lost before the node', 'used', 'dropped (overload)',
             'dropped (other)', 'IMU lost', 'poses', 'wrong'),
            [(c.cell, f'{c.frames_sent}', f'{c.frames_sent - c.frames_received}',
              f'{c.frames_used}', f'{c.dropped_overload}', f'{c.dropped_other}',
              f'{c.imu_sent - c.imu_received}', f'{c.poses} of {c.pairs}', f'{c.wrong}')
             for c in cells]),
        markdown_table(
            ('cell', 'latency', 'end to end', 'time of a frame', 'CPU time of a frame',
             'CPU of the node', 'of its callbacks', 'of the player', 'memory [MB]'),
            [(c.cell, _two(c.latency), _two(c.end_to_end), _two(c.frame_time), _two(c.frame_cpu),
              f'{c.cpu:.0f}', f'{c.cpu_callbacks:.0f}', f'{c.cpu_player:.0f}',
              f'{c.memory_start:.0f} -> {c.memory_end:.0f}') for c in cells]),
        markdown_table(
            ('cell', 'process to ready [s]', 'first frame to first pose [s]', 'R [deg]',
             't [deg]', 'player late [ms]'),
            [(c.cell, f'{c.seconds_to_ready:.2f}', f'{c.seconds_to_pose:.2f}',
              _two(c.rotation_error, 3), _two(c.translation_error, 2), _two(c.player_late, 2))
             for c in cells]),
        ('Latency is that of published pairs: from the later of image and first IMU sample that '
         'covers its last row, both as the callbacks of the node got them, to publication. End to '
         'end is the same from outside: from the publication of the later of the two by the '
         'player to the receipt of the pose by a third process. A frame that closes no pair '
         'publishes nothing and counts in the time of a frame, which is that of all frames, from '
         'its turn to its end.\n')])
    (folder / 'live.md').write_text(report)
    draw(folder / 'live.png', cells)
    return report


def write_soak_report(folder: Path, cell: LiveStatistics, course: Course) -> str:
    """Write how memory and latency went over time; the summary (Markdown)."""
    folder.mkdir(parents=True, exist_ok=True)
    windows = latency_over_time(course)
    report = '\n'.join([
        f'## {cell.cell}: {cell.duration / 60.0:.0f} minutes\n',
        (f'{cell.frames_sent} frames sent, {cell.frames_used} used, {cell.dropped_overload} '
         f'dropped for overload, {cell.dropped_other} for other causes; '
         f'{cell.imu_sent - cell.imu_received} of {cell.imu_sent} IMU samples lost; {cell.poses} '
         f'poses, {cell.wrong} of them wrong; the node took {cell.cpu:.0f} % of a core. Private '
         f'memory {cell.private_start:.1f} MB after the first pose, {cell.private_end:.1f} MB at '
         f'the end, {memory_drift(course):+.1f} MB/h after the first tenth.\n'),
        markdown_table(
            ('from [min]', 'latency p50 [ms]', 'p99 [ms]'),
            [(f'{start / 60.0:.1f}', f'{latency.p50:.1f}', f'{latency.p99:.1f}')
             for start, latency in windows])])
    (folder / 'live.md').write_text(report)
    write_csv(folder / 'live.csv', [cell])
    draw_soak(folder / 'soak.png', cell, course)
    return report


def latency_over_time(course: Course) -> list[tuple[float, Percentiles]]:
    """Start [s] and latency of successive minutes; a run below 5 min is cut into ten windows."""
    end = float(course.latency_seconds[-1])
    length = 60.0 if end >= 300.0 else max(end / 10.0, 1e-3)
    starts = np.arange(0.0, end, length)
    return [(float(start), Percentiles.of(course.latencies[
        (course.latency_seconds >= start) & (course.latency_seconds < start + length)]))
        for start in starts]


def memory_drift(course: Course) -> float:
    """Slope of the private memory [MB/h] after a settling time; NaN for too few samples."""
    # In the first tenth caches and pools fill, which says nothing of leaks.
    settled = course.memory_seconds >= 0.1 * course.memory_seconds[-1]
    if np.count_nonzero(settled) < 3:
        return float('nan')
    slope, _ = np.polyfit(course.memory_seconds[settled], course.private[settled], 1)
    return float(slope * 3600.0)


def _two(values: Percentiles, digits: int = 1) -> str:
    return f'{values.p50:.{digits}f} / {values.p99:.{digits}f}'


def draw(path: Path, cells: Sequence[LiveStatistics]) -> Figure:
    """Latency and processor time of every cell."""
    figure = Figure(figsize=(10.0, 1.9 + 0.36 * len(cells)), dpi=110, layout='constrained')
    left, right = figure.subplots(1, 2, sharey=True)
    at: NDArray[np.float64] = np.arange(len(cells), dtype=np.float64)
    for offset, colour, label, values in (
            (-0.18, 'C0', 'latency', [c.latency for c in cells]),
            (0.18, 'C1', 'end to end', [c.end_to_end for c in cells])):
        left.hlines(at + offset, [v.p50 for v in values], [v.p99 for v in values], colour,
                    linewidth=2.0)
        left.plot([v.p50 for v in values], at + offset, 'o', color=colour, label=f'{label}, p50')
        left.plot([v.p99 for v in values], at + offset, '|', color=colour, markersize=9.0,
                  label=f'{label}, p99')
    left.set_xlabel('[ms]')
    left.set_xlim(left=0.0)
    left.set_yticks(at, [c.cell for c in cells])
    left.invert_yaxis()
    worker = [c.cpu - c.cpu_callbacks for c in cells]
    right.barh(at, worker, color='C0', label='node: worker and middleware')
    right.barh(at, [c.cpu_callbacks for c in cells], left=worker, color='C2',
               label='node: callbacks')
    right.plot([c.cpu_player for c in cells], at, 'k|', markersize=9.0, label='player')
    right.set_xlabel('processor time [percent of one core]')
    for axis in (left, right):
        axis.grid(visible=True, axis='x', alpha=0.3)
    for axis, place in ((left, 'outside lower left'), (right, 'outside lower right')):
        handles, labels = axis.get_legend_handles_labels()
        figure.legend(handles=handles, labels=labels, loc=place,  # type: ignore[call-overload]
                      fontsize='small', ncols=2)
    save_picture(figure, path)
    return figure


def draw_soak(path: Path, cell: LiveStatistics, course: Course) -> Figure:
    """Latency of every pair, and memory, over time."""
    figure = Figure(figsize=(10.0, 6.0), dpi=110, layout='constrained')
    top, bottom = figure.subplots(2, 1, sharex=True)
    top.plot(course.latency_seconds / 60.0, course.latencies, '.', color='0.75', markersize=2.0,
             label='a pair')
    windows = latency_over_time(course)
    middle = [(start + 0.5 * windows[-1][0] / max(len(windows) - 1, 1)) / 60.0
              for start, _ in windows]
    top.plot(middle, [latency.p50 for _, latency in windows], 'o-', color='C0', label='p50')
    top.plot(middle, [latency.p99 for _, latency in windows], 's-', color='C3', label='p99')
    top.set_ylabel('latency [ms]')
    top.set_ylim(bottom=0.0)
    top.set_title(f'{cell.cell}: {cell.frames_used} of {cell.frames_sent} frames used, '
                  f'{cell.poses} poses', fontsize=10)
    bottom.plot(course.memory_seconds / 60.0, course.resident, color='C1', label='resident')
    bottom.plot(course.memory_seconds / 60.0, course.private, color='C2',
                label='private (not shared with other processes)')
    bottom.set_ylabel('memory of the node [MB]')
    bottom.set_ylim(bottom=0.0)
    bottom.set_xlabel('time [min]')
    for axis in (top, bottom):
        axis.grid(visible=True, alpha=0.3)
        axis.legend(fontsize='small')
    save_picture(figure, path)
    return figure
