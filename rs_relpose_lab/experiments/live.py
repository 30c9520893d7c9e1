"""The live node at camera rate: what it does with the frames, how late, and what it costs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import csv
from dataclasses import dataclass
import os
from pathlib import Path
import platform
import subprocess
import sys
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments import live_clip
from rs_relpose_lab.experiments.harness import markdown_table, write_csv, write_table
from rs_relpose_lab.experiments.scoring import pose_error
from rs_relpose_lab.live.processes import ProcessMetrics
from rs_relpose_ros.bags.sensor_topics import CAMERA_INFO_TOPIC, COMPRESSED_TOPIC, RAW_TOPIC
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds
from rs_relpose_ros.pipeline.sequencer import Refusal

if TYPE_CHECKING:  # the rest of this module needs no ROS
    from rs_relpose_lab.live.live_run import MeasuredRun, ReceivedPose


# Sizes of the images of the live node [px]. [chosen: VGA, HD and full HD]
SIZES = ((640, 480), (1280, 720), (1920, 1080))
# Formats of these images: encodings of sensor_msgs/Image, and compressed ones.
FORMATS = ('mono8', 'bgr8', 'jpeg')


@dataclass(frozen=True, slots=True)
class LiveCell:
    """One camera, with one of `FORMATS` (JPEG is in colour), and the rate of an IMU [Hz]."""

    width: int
    height: int
    image_format: str
    imu_rate: int

    @property
    def name(self) -> str:
        """Such as ``640x480-mono8-imu200``."""
        return f'{self.width}x{self.height}-{self.image_format}-imu{self.imu_rate}'

    @property
    def is_big(self) -> bool:
        """Whether the images need the Fast DDS profile: its default transports lose them."""
        # JPEG as the clips have it, which are rich in texture.
        bytes_per_pixel = {'mono8': 1.0, 'bgr8': 3.0, 'jpeg': 0.3}[self.image_format]
        return self.width * self.height * bytes_per_pixel > 512 * 1024


# Cells by name: each size, format and rate of the IMU that is measured.
CELLS = {
    cell.name: cell
    for cell in (
        LiveCell(width, height, image_format, imu_rate)
        for width, height in SIZES
        for image_format in FORMATS
        for imu_rate in live_clip.IMU_RATES
    )
}


@dataclass(frozen=True, slots=True)
class Load:
    """How the cells are played."""

    duration: float  # [s]
    every: int = 1  # each so many images of the clip are sent: 2 is 15 Hz
    # Busy processes on the one core of the node; None: the node may use all cores.
    neighbours: int | None = None


@dataclass(frozen=True, slots=True)
class Percentiles:
    """Percentiles of values; NaN without values."""

    p50: float
    p99: float
    largest: float

    @classmethod
    def of(cls, values: Array) -> Percentiles:
        """Percentiles of values (N,)."""
        if len(values) == 0:
            return cls(np.nan, np.nan, np.nan)
        return cls(*(float(v) for v in np.percentile(values, [50.0, 99.0, 100.0])))


@dataclass(frozen=True, slots=True)
class LiveStatistics:
    """Statistics of one cell; times in ms, memory in MB, errors in degrees."""

    cell: str
    duration: float
    frames_sent: int
    frames_received: int  # by the node's callback
    frames_used: int  # through the whole pipeline
    dropped_overload: int  # refused by the node because newer frames waited
    dropped_other: int
    imu_sent: int
    imu_received: int
    pairs: int
    poses: int
    # From the callbacks of image and first IMU sample that covers its last row to publication.
    latency: Percentiles
    end_to_end: Percentiles  # the same by the player and a third process that receives the pose
    frame_time: Percentiles  # wall time of every frame, pair or not
    frame_cpu: Percentiles  # processor time of the worker
    cpu: float  # of the node, percent of one core
    cpu_callbacks: float  # of its first thread
    cpu_player: float
    memory_start: float  # resident, after the first pose
    memory_end: float
    private_start: float  # without what is shared with other processes
    private_end: float
    seconds_to_ready: float  # from the start of the node's process to its subscriptions
    seconds_to_pose: float  # from the first frame to the first pose
    rotation_error: Percentiles
    translation_error: Percentiles
    wrong: int  # poses that are off by more than 1 deg, or 15 deg in the direction of translation
    player_late: Percentiles  # how late the player published


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """Latency and memory over time."""

    latency_seconds: Array  # (N,) since the first pair
    latencies: Array  # (N,) [ms]
    memory_seconds: Array  # (M,) since the first pair
    private: Array  # (M,) [MB] that are not shared


def run_cell(
    cell: LiveCell,
    clip: tuple[Path, Path],
    load: Load,
    folder: Path,
    profile: Path,
    on_second: Callable[[], object] = lambda: None,
) -> tuple[LiveStatistics, Course]:
    """Play a clip of the cell's size to a new node; logs and tables into `folder`.

    `profile`: of Fast DDS, for big images; `on_second`: called once a second.
    """
    # Here, so that the names of cells are known without ROS.
    from rs_relpose_lab.live.live_run import measure, NodeSetup

    folder.mkdir(parents=True, exist_ok=True)
    compressed = cell.image_format == 'jpeg'
    topics = (COMPRESSED_TOPIC, CAMERA_INFO_TOPIC, live_clip.imu_topic(cell.imu_rate))
    player = [
        '--best-effort',
        '--loop',
        str(live_clip.PERIOD),
        '--duration',
        str(load.duration),
        '--every',
        str(load.every),
        '--topics',
        *topics,
        *([] if compressed else ['--decode', cell.image_format]),
    ]
    bag, parameters = clip
    setup = NodeSetup(
        parameters,
        {'image': RAW_TOPIC, 'camera_info': CAMERA_INFO_TOPIC, 'imu': topics[2]},
        'compressed' if compressed else 'raw',
        profile if cell.is_big else None,
        load.neighbours,
    )
    run = measure(bag, setup, player, folder, on_second)
    # Processor time and memory of the node, a line per second.
    write_csv(folder / 'node.csv', run.metrics)
    return statistics_of(cell, load.duration, run), course_of(run)


def statistics_of(cell: LiveCell, duration: float, run: MeasuredRun) -> LiveStatistics:
    """Statistics of a run."""
    frames = _read_frames(run.timings)
    paired = frames['outcome'] != 'none'
    posed = frames['outcome'] == Status.OK.value
    latency = (frames['done_ns'] - frames['ready_ns']) / 1e6
    log = np.load(run.log)
    images = log[log['is_image']]
    imu = log[~log['is_image']]
    refused = {reason: int(run.counters[f'frames_refused_{reason.value}']) for reason in Refusal}
    rotation, translation = errors(run.poses)
    first = run.metrics[0]
    end = run.metrics[-1]
    return LiveStatistics(
        cell=cell.name,
        duration=duration,
        frames_sent=len(images),
        frames_received=int(run.counters['frames_received']),
        frames_used=len(frames),
        dropped_overload=refused.pop(Refusal.OVERLOAD),
        dropped_other=sum(refused.values()),
        imu_sent=len(imu),
        imu_received=int(run.counters['imu_samples']),
        pairs=int(np.count_nonzero(paired)),
        poses=len(run.poses),
        latency=Percentiles.of(latency[posed]),
        end_to_end=Percentiles.of(_end_to_end(run.poses, images, imu)),
        frame_time=Percentiles.of((frames['done_ns'] - frames['taken_ns']) / 1e6),
        frame_cpu=Percentiles.of(frames['cpu_ns'] / 1e6),
        cpu=_percent(first, end, 'cpu'),
        cpu_callbacks=_percent(first, end, 'cpu_main'),
        cpu_player=_percent(run.player_metrics[0], run.player_metrics[-1], 'cpu'),
        memory_start=first.resident,
        memory_end=end.resident,
        private_start=first.private,
        private_end=end.private,
        seconds_to_ready=(run.ready_ns - run.started_ns) / NANOSECONDS,
        seconds_to_pose=(run.poses[0].received_ns - images['published_ns'][0]) / NANOSECONDS,
        rotation_error=Percentiles.of(rotation),
        translation_error=Percentiles.of(translation),
        wrong=int(np.count_nonzero((rotation > 1.0) | (translation > 15.0))),
        player_late=Percentiles.of((log['published_ns'] - log['due_ns']) / 1e6),
    )


def course_of(run: MeasuredRun) -> Course:
    """Latency and memory of a run over time."""
    frames = _read_frames(run.timings)
    posed = frames[frames['outcome'] == Status.OK.value]
    start_ns = posed['ready_ns'][0]
    return Course(
        (posed['ready_ns'] - start_ns) / NANOSECONDS,
        (posed['done_ns'] - posed['ready_ns']) / 1e6,
        np.array([(f.time_ns - start_ns) / NANOSECONDS for f in run.metrics]),
        np.array([f.private for f in run.metrics]),
    )


def errors(poses: Sequence[ReceivedPose]) -> tuple[Array, Array]:
    """Errors [deg] of rotation and direction of translation (N,) against the clip's motion."""
    motion = live_clip.closed_loop(live_clip.PERIOD)
    found = []
    for pose in poses:
        (p1, p2), (R1, R2) = motion.poses(
            [
                live_clip.seconds_into_loop(stamp)
                for stamp in (pose.reference_stamp_ns, pose.stamp_ns)
            ]
        )
        found.append(
            pose_error(
                Rotation.from_quat(pose.quat_xyzw).as_matrix(),
                np.array(pose.t),
                R1.T @ R2,
                R1.T @ (p2 - p1),
            )
        )
    return (
        np.array([error.rotation for error in found]),
        np.array([error.translation for error in found]),
    )


def _end_to_end(
    poses: Sequence[ReceivedPose], images: NDArray[np.void], imu: NDArray[np.void]
) -> Array:
    # A row earlier does not matter: samples are further apart.
    readout_ns = to_nanoseconds(live_clip.configuration(*SIZES[0]).readout_time)
    image_sent = dict(
        zip(images['stamp_ns'].tolist(), images['published_ns'].tolist(), strict=True)
    )
    covering = np.searchsorted(imu['stamp_ns'], [p.stamp_ns + readout_ns for p in poses])
    return np.array(
        [
            (pose.received_ns - max(image_sent[pose.stamp_ns], int(imu['published_ns'][k]))) / 1e6
            for pose, k in zip(poses, covering, strict=True)
            if k < len(imu)
        ]
    )


def _read_frames(path: Path) -> NDArray[np.void]:
    return np.atleast_1d(
        np.genfromtxt(path, delimiter=',', names=True, dtype=None, encoding='ascii')
    )


def _percent(first: ProcessMetrics, last: ProcessMetrics, name: str) -> float:
    """Processor time between two measurements, in percent of one core."""
    elapsed = (last.time_ns - first.time_ns) / NANOSECONDS
    spent = getattr(last, name) - getattr(first, name)
    return float(100.0 * spent / elapsed) if elapsed > 0.0 else float('nan')


# -- tables of the live benchmark -----------------------------------------------------------------


_Column = Callable[[LiveStatistics], str]

# Columns of the tables by their headings: messages and results of a cell.
_COUNTS: Mapping[str, _Column] = {
    'cell': lambda c: c.cell,
    'sent': lambda c: f'{c.frames_sent}',
    'lost before the node': lambda c: f'{c.frames_sent - c.frames_received}',
    'used': lambda c: f'{c.frames_used}',
    'dropped (overload)': lambda c: f'{c.dropped_overload}',
    'dropped (other)': lambda c: f'{c.dropped_other}',
    'IMU lost': lambda c: f'{c.imu_sent - c.imu_received}',
    'poses': lambda c: f'{c.poses} of {c.pairs}',
    'wrong': lambda c: f'{c.wrong}',
}
# What a cell takes of the machine.
_LOAD: Mapping[str, _Column] = {
    'cell': lambda c: c.cell,
    'latency': lambda c: _two(c.latency),
    'end to end': lambda c: _two(c.end_to_end),
    'time of a frame': lambda c: _two(c.frame_time),
    'CPU time of a frame': lambda c: _two(c.frame_cpu),
    'CPU of the node': lambda c: f'{c.cpu:.0f}',
    'of its callbacks': lambda c: f'{c.cpu_callbacks:.0f}',
    'of the player': lambda c: f'{c.cpu_player:.0f}',
    'memory [MB]': lambda c: f'{c.memory_start:.0f} -> {c.memory_end:.0f}',
}
# The start of a node, its errors, and the player's.
_START: Mapping[str, _Column] = {
    'cell': lambda c: c.cell,
    'process to ready [s]': lambda c: f'{c.seconds_to_ready:.2f}',
    'first frame to first pose [s]': lambda c: f'{c.seconds_to_pose:.2f}',
    'R [deg]': lambda c: _two(c.rotation_error, 3),
    't [deg]': lambda c: _two(c.translation_error, 2),
    'player late [ms]': lambda c: _two(c.player_late, 2),
}
# What the words of the tables mean.
_EXPLANATION = (
    'Latency is that of published pairs: from the later of image and first IMU sample that covers '
    'its last row, at the callbacks of the node, to publication. End to end is the same from '
    'outside: from the publication of the later of the two by the player to the receipt of the '
    'pose by a third process. A frame without keyframe pair publishes nothing and counts in the '
    'time of a frame, which is that of all frames, from its start to its end.\n'
)


def _table(columns: Mapping[str, _Column], cells: Sequence[LiveStatistics]) -> str:
    """A row of texts for each cell, below the headings."""
    rows = [tuple(text(cell) for text in columns.values()) for cell in cells]
    return markdown_table(tuple(columns), rows)


def write_report(folder: Path, cells: Sequence[LiveStatistics]) -> str:
    """Write table, plot and report into a folder; the report."""
    setting = (
        f'Node and player on {os.cpu_count()} cores of {platform.machine()}, Python '
        f'{platform.python_version()}; images at 30 Hz from best-effort publishers. Times in ms: '
        'median / 99th percentile. CPU in percent of one core.\n'
    )
    tables = [_table(columns, cells) for columns in (_COUNTS, _LOAD, _START)]
    report = '\n'.join(['# The live node\n', setting, *tables, _EXPLANATION])
    write_table(folder, 'live', cells, report)
    return report


def write_soak_report(folder: Path, cell: LiveStatistics, course: Course) -> str:
    """Write memory and latency over time; the summary (Markdown)."""
    windows = latency_over_time(course)
    report = '\n'.join(
        [
            f'## {cell.cell}: {cell.duration / 60.0:.0f} minutes\n',
            (
                f'{cell.frames_sent} frames sent, {cell.frames_used} used, '
                f'{cell.dropped_overload} '
                f'dropped for overload, {cell.dropped_other} for other reasons; '
                f'{cell.imu_sent - cell.imu_received} of {cell.imu_sent} IMU samples lost; '
                f'{cell.poses} '
                f'poses, {cell.wrong} of them wrong; the node took {cell.cpu:.0f} % of a core. '
                f'Private '
                f'memory {cell.private_start:.1f} MB after the first pose, '
                f'{cell.private_end:.1f} MB at '
                f'the end, {memory_drift(course):+.1f} MB/h after the first tenth.\n'
            ),
            markdown_table(
                ('quarter', 'latency p50 [ms]', 'p99 [ms]', 'private memory [MB]'),
                [
                    (name, f'{latency.p50:.1f}', f'{latency.p99:.1f}', f'{memory:.1f}')
                    for name, latency, memory in outer_quarters(course)
                ],
            ),
            markdown_table(
                ('from [min]', 'latency p50 [ms]', 'p99 [ms]'),
                [
                    (f'{start / 60.0:.1f}', f'{latency.p50:.1f}', f'{latency.p99:.1f}')
                    for start, latency in windows
                ],
            ),
        ]
    )
    write_table(folder, 'live', [cell], report)
    return report


def latency_over_time(course: Course) -> list[tuple[float, Percentiles]]:
    """Start [s] and latency of successive minutes; a run below 5 min is cut into ten windows."""
    end = float(course.latency_seconds[-1])
    length = 60.0 if end >= 300.0 else max(end / 10.0, 1e-3)
    starts = np.arange(0.0, end, length)
    return [
        (
            float(start),
            Percentiles.of(
                course.latencies[
                    (course.latency_seconds >= start) & (course.latency_seconds < start + length)
                ]
            ),
        )
        for start in starts
    ]


def outer_quarters(course: Course) -> list[tuple[str, Percentiles, float]]:
    """Latency and mean private memory [MB] of the first and of the last quarter of a run."""
    end = float(course.latency_seconds[-1])
    found = []
    for name, begin in (('first', 0.0), ('last', 0.75 * end)):
        last = begin + 0.25 * end
        of_pairs = (course.latency_seconds >= begin) & (course.latency_seconds <= last)
        of_memory = (course.memory_seconds >= begin) & (course.memory_seconds <= last)
        memory = course.private[of_memory]
        found.append(
            (
                name,
                Percentiles.of(course.latencies[of_pairs]),
                float(memory.mean()) if len(memory) else float('nan'),
            )
        )
    return found


def memory_drift(course: Course) -> float:
    """Slope of the private memory [MB/h] after a settling time; NaN for too few samples."""
    # In the first tenth caches and pools fill, which is no leak.
    settled = course.memory_seconds >= 0.1 * course.memory_seconds[-1]
    if np.count_nonzero(settled) < 3:
        return float('nan')
    slope, _ = np.polyfit(course.memory_seconds[settled], course.private[settled], 1)
    return float(slope * 3600.0)


# -- two checkouts by turns: times of one run compare, those of two hours do not ------------------

# Number of turns of two checkouts. [chosen: the median of three leaves one bad turn out]
TURNS = 3
# Columns of live.csv, the same in all releases.
COMPARED = (
    'latency_p50',
    'latency_p99',
    'end_to_end_p50',
    'end_to_end_p99',
    'cpu',
    'memory_end',
    'rotation_error_p50',
    'translation_error_p50',
)


def compare_checkouts(
    this: Path,
    other: Path,
    cells: Sequence[str],
    duration: float,
    folder: Path,
    on_run: Callable[[], object] = lambda: None,
) -> str:
    """Run the live benchmark of two checkouts by turns; the report of the ratios this / other.

    Each checkout runs its own command, with this interpreter, and has its tables in a folder of
    its own.
    """
    ratios = []
    for turn in range(TURNS):
        for cell in cells:
            measured = []
            for name, checkout in (('this', this), ('other', other)):
                measured.append(_measured_by(checkout, cell, duration, folder / name))
                on_run()
            ratios.append(
                {
                    'cell': cell,
                    'turn': turn,
                    **{column: a / b for column, a, b in zip(COMPARED, *measured, strict=True)},
                }
            )
    rows = []
    for cell in cells:
        of_cell = [
            [turn[column] for column in COMPARED] for turn in ratios if turn['cell'] == cell
        ]
        rows.append(
            (
                cell,
                *(
                    f'{median:.2f} ({low:.2f} to {high:.2f})'
                    for low, median, high in np.percentile(of_cell, (0.0, 50.0, 100.0), axis=0).T
                ),
            )
        )
    return write_table(
        folder,
        'against',
        ratios,
        '\n'.join(
            [
                f'# This checkout / {other}\n',
                f'Median ratio of {TURNS} turns, least and largest.\n',
                markdown_table(('cell', *COMPARED), rows),
            ]
        ),
    )


def _measured_by(checkout: Path, cell: str, duration: float, folder: Path) -> list[float]:
    """The `COMPARED` columns of a cell."""
    done = subprocess.run(
        [
            sys.executable,
            '-m',
            'rs_relpose_ros.cli.main',
            'benchmark',
            'live',
            '--cells',
            cell,
            '--output',
            str(folder.resolve()),
            '--duration',
            str(duration),
        ],
        cwd=checkout,
        check=False,
        text=True,
        env={**os.environ, 'PYTHONPATH': str(checkout.resolve())},
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
    )
    if done.returncode:
        raise InputError(
            f'{checkout}: benchmark live ended with code {done.returncode}: '
            + done.stderr.strip().rpartition('\n')[2]
        )
    with (folder / 'live.csv').open(newline='', encoding='utf-8') as file:
        row = next(csv.DictReader(file))
    return [float(row[column] or 'nan') for column in COMPARED]


def _two(values: Percentiles, digits: int = 1) -> str:
    return f'{values.p50:.{digits}f} / {values.p99:.{digits}f}'
