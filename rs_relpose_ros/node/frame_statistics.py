"""What a node tells of the frames that it works on: figures as they come, a report a second."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
import threading
import time

import numpy as np

from rs_relpose_ros.front_end.sequencer import Refusal, SequencerCounts
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.node.silence import Silence

OK, WARN, ERROR = 0, 1, 2

# Numbers of the latest results and frames over which latency and time per frame are taken.
_RECENT_RESULTS = 300
_RECENT_FRAMES = 900
# Time without a message [s] after which an input counts as missing.
SILENCE = 2.0


@dataclass(frozen=True, slots=True)
class Report:
    """A diagnostic status: level, one sentence, and the figures in the order to show them."""

    level: int
    text: str
    values: tuple[tuple[str, str], ...]
    silence: Silence   # ends with a result


@dataclass(frozen=True, slots=True)
class Inputs:
    """What has come so far; of each topic the number of messages."""

    images: int = 0
    camera_infos: int = 0
    imu: int = 0
    accelerometer: int = 0
    invalid: int = 0


class FrameStatistics(ABC):
    """Figures that every node has, thread-safe; a node adds those of its results.

    Tests give a `clock` of their own, monotonic [ns].
    """

    # State where nothing comes out, and where a figure that was told is wrong.
    idle, wrong = 'not working', 'told wrong'

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._latencies: deque[float] = deque(maxlen=_RECENT_RESULTS)
        self._failures = 0
        self._last_failure = ''
        self._since_ns = clock()
        self._counted = Inputs()
        self._refused: Counter[Refusal] = Counter()
        self._frame_times: deque[float] = deque(maxlen=_RECENT_FRAMES)
        self._busy_ns = 0
        self._results = self._results_told = 0
        self.start()

    def start(self) -> None:
        """Sensors can be heard from now on: what is silent is so from here."""
        with self._lock:
            self._silent_since = (self._clock(), self._counted.images, self._refused)

    def add_frame(self, taken_ns: int) -> None:
        """Count a frame that was `taken_ns` (monotonic clock); call it when all is done for it."""
        spent_ns = self._clock() - taken_ns
        with self._lock:
            self._frame_times.append(spent_ns / NANOSECONDS)
            self._busy_ns += spent_ns

    def add_failure(self, reason: str) -> None:
        """Count a frame whose processing failed."""
        with self._lock:
            self._failures += 1
            self._last_failure = reason

    def report(self, inputs: Inputs, counts: SequencerCounts | None, *, problem: str,
               missing: tuple[str, ...]) -> Report:
        """The state since the last report.

        `counts` is None while nothing is processed; `problem` says why nothing can be, or is
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
            level, text = self._judge(problem, dropped)
            state = self.idle if problem else {
                OK: 'ok', WARN: 'degraded', ERROR: self.wrong}[level]
            silence = self._silence(now_ns, inputs.images, refused)
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
                *self._values(),
                ('latency_p50_ms', latency[0]),
                ('latency_p99_ms', latency[1]),
                ('frame_time_p50_ms', frame_time[0]),
                ('frame_time_p99_ms', frame_time[1]),
                ('worker_busy_percent', f'{100.0 * busy:.0f}'),
                *self._last_values(),
            ]
        return Report(level, text, tuple(values), silence)

    def _silence(self, now_ns: int, images: int, refused: Counter[Refusal]) -> Silence:
        # Without an image there is nothing that something could come of.
        if self._results > self._results_told or images == self._silent_since[1]:
            self._results_told = self._results
            self._silent_since = (now_ns, images, refused)
        since_ns, images_before, refused_before = self._silent_since
        return Silence((now_ns - since_ns) / NANOSECONDS, images - images_before,
                       refused - refused_before, self._last_failure)

    def _judge(self, problem: str, dropped: Counter[Refusal]) -> tuple[int, str]:
        if problem:
            return ERROR, problem
        wrong = self._told_wrong()
        if wrong:
            return ERROR, wrong
        if dropped:
            causes = ', '.join(f'{count} {cause.value}' for cause, count in dropped.most_common())
            why = ': the worker is too slow for the camera' if dropped[Refusal.OVERLOAD] else ''
            return WARN, (f'{dropped.total()} frames were not used since the last report '
                          f'({causes}){why}')
        return self._judge_results()

    def _published(self, ready_ns: int) -> None:
        """Take the latency of a result, all for which had come by `ready_ns`; under the lock."""
        self._results += 1
        self._latencies.append((self._clock() - ready_ns) / NANOSECONDS)

    # -- of a node's results (called under the lock) -------------------------------------------

    def _told_wrong(self) -> str:
        """A sentence about a figure that was told and is wrong; empty for none."""
        return ''

    @abstractmethod
    def _judge_results(self) -> tuple[int, str]:
        """Level and sentence where frames come and are used."""

    @abstractmethod
    def _values(self) -> tuple[tuple[str, str], ...]:
        """Figures of the results."""

    def _last_values(self) -> tuple[tuple[str, str], ...]:
        """Figures that are shown last."""
        return (('last_failure', self._last_failure),)


def _milliseconds(seconds: Collection[float]) -> tuple[str, str]:
    """Median and 99th percentile; empty where there is none."""
    if not seconds:
        return '', ''
    median, p99 = 1e3 * np.percentile(list(seconds), (50, 99))
    return f'{median:.1f}', f'{p99:.1f}'
