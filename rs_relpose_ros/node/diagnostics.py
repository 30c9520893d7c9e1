"""What the node tells of itself: figures collected as they come, and a report once a second."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
import threading
import time

import numpy as np

from rs_relpose_ros.front_end.pair import PAIR_FIGURES, PairResult
from rs_relpose_ros.front_end.sequencer import Refusal, SequencerCounts
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.health.findings import HealthState, NOT_JUDGED

OK, WARN, ERROR = 0, 1, 2

# Numbers of the latest pairs and frames over which latency and time per frame are taken.
_RECENT_PAIRS = 300
_RECENT_FRAMES = 900
# Time without a message [s] after which an input counts as missing.
SILENCE = 2.0


@dataclass(frozen=True, slots=True)
class Report:
    """A diagnostic status: level, one sentence, and the figures in the order to show them."""

    level: int
    text: str
    values: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class Inputs:
    """What has come so far; of each topic the number of messages."""

    images: int = 0
    camera_infos: int = 0
    imu: int = 0
    accelerometer: int = 0
    invalid: int = 0


class Statistics:
    """Figures of the node; thread-safe. Tests give a `clock` of their own, monotonic [ns]."""

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._latencies: deque[float] = deque(maxlen=_RECENT_PAIRS)
        self._pairs = self._poses = self._failures = 0
        self._last_pair: PairResult | None = None
        self._last_pose: PairResult | None = None
        self._last_no_pose = ''
        self._since_ns = clock()
        self._counted = Inputs()
        self._refused: Counter[Refusal] = Counter()
        self._frame_times: deque[float] = deque(maxlen=_RECENT_FRAMES)
        self._busy_ns = 0
        self._last_input_ns: dict[str, int] = {}

    def add_frame(self, taken_ns: int) -> None:
        """Count a frame that was `taken_ns` (monotonic clock); call it when all is done for it."""
        spent_ns = self._clock() - taken_ns
        with self._lock:
            self._frame_times.append(spent_ns / NANOSECONDS)
            self._busy_ns += spent_ns

    def add_pair(self, result: PairResult, ready_ns: int) -> None:
        """Count a pair right after its publication; all for it had come by `ready_ns`."""
        now_ns = self._clock()
        with self._lock:
            self._pairs += 1
            self._last_pair = result
            if result.pose:
                self._poses += 1
                self._last_pose = result
                self._latencies.append((now_ns - ready_ns) / NANOSECONDS)
            else:
                self._last_no_pose = f'{result.pose.status.value}: {result.pose.reason}'

    def add_failure(self, reason: str) -> None:
        """Count a frame whose processing failed."""
        with self._lock:
            self._failures += 1
            self._last_no_pose = reason

    def report(self, inputs: Inputs, counts: SequencerCounts | None, *, problem: str,
               missing: tuple[str, ...]) -> Report:
        """The state since the last report.

        `counts` is None while nothing is estimated; `problem` says why nothing can be, or is
        empty; `missing` names parameters and inputs that are missing.
        """
        now_ns = self._clock()
        with self._lock:
            elapsed = max((now_ns - self._since_ns) / NANOSECONDS, 1e-3)
            rates = {name: (getattr(inputs, field) - getattr(self._counted, field)) / elapsed
                     for name, field in (('image', 'images'), ('camera_info', 'camera_infos'),
                                         ('imu', 'imu'), ('accel', 'accelerometer'))}
            self._since_ns, self._counted = now_ns, inputs
            refused = Counter({} if counts is None else counts.refused)
            dropped, self._refused = refused - self._refused, refused
            busy, self._busy_ns = self._busy_ns / NANOSECONDS / elapsed, 0
            level, text = self._judge(problem, dropped.total(), dropped[Refusal.OVERLOAD])
            state = 'not estimating' if problem else {
                OK: 'ok', WARN: 'degraded', ERROR: 'told wrong'}[level]
            last, pose = self._last_pair, self._last_pose
            latency, frame_time = _milliseconds(self._latencies), _milliseconds(self._frame_times)
            values = [
                ('state', state),
                ('missing', ', '.join(missing)),
                *((f'{name}_rate_hz', f'{rate:.1f}') for name, rate in rates.items()),
                ('frames_received', str(counts.frames if counts else inputs.images)),
                ('frames_processed', str(counts.frames_taken if counts else 0)),
                *((f'frames_refused_{cause.value}', str(refused[cause])) for cause in Refusal),
                ('frames_failed', str(self._failures)),
                ('messages_invalid', str(inputs.invalid)),
                *((name, str(getattr(counts, name, 0))) for name in (
                    'imu_samples', 'imu_gaps', 'imu_repeated', 'imu_late', 'clock_jumps')),
                ('pairs', str(self._pairs)),
                ('poses', str(self._poses)),
                *((figure.name, figure.text(last)) for figure in PAIR_FIGURES),
                ('model', pose.pose.model if pose else ''),
                *_tracked_values(last),
                *_health_values(last),
                ('latency_p50_ms', latency[0]),
                ('latency_p99_ms', latency[1]),
                ('frame_time_p50_ms', frame_time[0]),
                ('frame_time_p99_ms', frame_time[1]),
                ('worker_busy_percent', f'{100.0 * busy:.0f}'),
                ('last_reason_no_pose', self._last_no_pose),
            ]
        return Report(level, text, tuple(values))

    def _judge(self, problem: str, dropped: int, overload: int) -> tuple[int, str]:
        if problem:
            return ERROR, problem
        last = self._last_pair
        faults = () if last is None else last.health.faults
        if faults and faults[0].state is HealthState.WRONG:
            return ERROR, faults[0].text
        if overload > 0:
            return WARN, (f'{dropped} frames were not used since the last report, {overload} of '
                          'them because the worker is too slow for the camera')
        if dropped > 0:
            return WARN, f'{dropped} frames were not used since the last report'
        if last is None:
            return OK, 'no keyframe pair yet'
        if faults:
            return WARN, faults[0].text
        if not last.pose:
            return WARN, f'no pose of the last pair: {self._last_no_pose}'
        return OK, f'estimating: {self._poses} poses of {self._pairs} pairs'


def _milliseconds(seconds: Collection[float]) -> tuple[str, str]:
    """Median and 99th percentile; empty where there is none."""
    if not seconds:
        return '', ''
    median, p99 = 1e3 * np.percentile(list(seconds), (50, 99))
    return f'{median:.1f}', f'{p99:.1f}'


def _tracked_values(last: PairResult | None) -> tuple[tuple[str, str], ...]:
    """Bias, time offset and read-out as tracked; to be compared with the parameters."""
    names = ('tracked_gyro_bias_rad_s', 'tracked_gyro_bias_sigma_rad_s', 'tracked_time_offset_ms',
             'tracked_time_offset_sigma_ms', 'applied_time_offset_ms', 'tracked_readout_time_ms',
             'tracked_readout_time_sigma_ms', 'applied_readout_time_ms')
    if last is None or last.tracked is None or not last.tracked.pairs:
        return tuple((name, '') for name in names)
    seen = last.tracked
    texts = (' '.join(f'{value:.5f}' for value in seen.gyro_bias),
             ' '.join(f'{value:.5f}' for value in seen.gyro_bias_sigma),
             *(f'{1e3 * seconds:.2f}' for seconds in (
                 seen.time_offset, seen.time_offset_sigma, last.applied.time_offset,
                 seen.readout_time, seen.readout_time_sigma, last.applied.readout_time)))
    return tuple(zip(names, texts, strict=True))


def _health_values(last: PairResult | None) -> tuple[tuple[str, str], ...]:
    """State of what was told, and a sentence for each figure."""
    health = NOT_JUDGED if last is None else last.health
    return ('health', health.state.value), ('health_findings', health.text)
