"""Statistics of the nodes: the fields of /diagnostics, log lines, files with a line per frame."""

from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
import math
from pathlib import Path
import threading
import time
from typing import NamedTuple, TextIO

import numpy as np

from rs_relpose_ros.calibrate.stored import Progress
from rs_relpose_ros.calibration import findings_text
from rs_relpose_ros.calibration.findings import Assessment, FindingState, NOT_EVALUATED
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.timing import correlation_of_steps, MISSING, NANOSECONDS
from rs_relpose_ros.messages.incoming import MOST_REASONS, reason_key, Role
from rs_relpose_ros.messages.outgoing import LARGE_MESSAGE
from rs_relpose_ros.pipeline.monitor import Applied, Tracked
from rs_relpose_ros.pipeline.pair import Frame, PAIR_METRICS, PairResult
from rs_relpose_ros.pipeline.sequencer import Refusal, SequencerCounts

# -- Reasons for no results or few images ---------------------------------------------------------

# Time without a result [s] after which the reason is logged. Less would log each short rest of the
# camera, more would leave a user waiting. [chosen: 2 to 10 s would do]
PATIENCE = 5.0
# Share of the images whose refusal is the reason for no result. A smaller one would name refusals
# beside which pairs without a pose are the true reason. [chosen: 0.6 to 0.95 would do]
_MOST = 0.8
# Share of the images of an even rhythm below which images are lost. A larger one would warn of a
# camera that pauses. [chosen: transport that works loses a few per cent, Fast DDS with large
# messages most]
_LOST = 0.7
# Fewest images of which lost ones and jitter are reported. Fewer show no rhythm. [chosen: 5 to 30
# would do]
_FEWEST = 10
# Ending of the topics of compressed images. [derived: image_transport]
_COMPRESSED = '/compressed'
# Jitter of stamps that is reported [s]. At 1 rad/s and f = 500 px it displaces points by 0.25 px,
# half the noise of a match. [derived: from that; half and double of it would do]
_JITTER = 5e-4
# Correlation of successive intervals below which they vary by jitter, not by an exposure that
# changes. [derived: independent errors of stamps have -0.5, a slow change has above 0]
_ALTERNATING = -0.15


class Reason(NamedTuple):
    """A reason that is logged once while its kind stays."""

    kind: str
    text: str  # with the details, which may change


@dataclass(frozen=True, slots=True)
class Silence:
    """Inputs since the last result, or since the start."""

    seconds: float = 0.0
    images: int = 0
    refused: Mapping[Refusal, int] = field(default_factory=dict)
    failure: Reason | None = None  # of the last pair or frame without a result


def why_no_image(image: str, published: Collection[str]) -> Reason:
    """Reason for no image on a topic; `published`: image topics that have a publisher."""
    kind = f'no image on {image}'
    twin = image.removesuffix(_COMPRESSED) if image.endswith(_COMPRESSED) else image + _COMPRESSED
    if image in published:
        fix = 'it has a publisher: does its quality of service match, and does the driver run?'
    elif twin in published:
        transport = 'compressed' if twin.endswith(_COMPRESSED) else 'raw'
        fix = f'only {twin} is published: set image_transport:={transport}'
    elif published:
        fix = (
            f'these topics with images have publishers: {", ".join(sorted(published))}; '
            'remap image'
        )
    else:
        fix = 'no topic with images has a publisher: is the camera driver running?'
    return Reason(kind, f'{kind} for {PATIENCE:g} s; {fix}')


def why_nothing(silence: Silence) -> Reason:
    """Reason for no result although images come."""
    refused = sum(silence.refused.values())
    if refused >= _MOST * silence.images:
        refusal = max(silence.refused, key=lambda kind: silence.refused[kind])
        return Reason(
            f'refused: {refusal.value}',
            (
                f'nothing for {PATIENCE:g} s: {refused} of {silence.images} images were refused, '
                f'{silence.refused[refusal]} of them as {refusal.value}'
            ),
        )
    if silence.failure:
        return Reason(
            silence.failure.kind,
            f'nothing for {PATIENCE:g} s; the last reason: {silence.failure.text}',
        )
    return Reason('nothing', f'nothing came of {silence.images} images in {PATIENCE:g} s')


def stamps_warning(stamps_ns: Sequence[int], size: int) -> str:
    """A warning if large images are lost, or stamps jitter, by the rhythm of the stamps; else ''.

    `stamps_ns`: of the recent images; `size`: of an image [bytes].
    """
    recent = np.array(stamps_ns, dtype=np.int64)
    recent = recent[recent > recent[-1:] - PATIENCE * NANOSECONDS]
    if len(recent) < _FEWEST:
        return ''
    steps = np.diff(recent) / NANOSECONDS
    # A quarter of the intervals has no lost image between, unless most images are lost.
    period = max(float(np.quantile(steps, 0.25, method='lower')), 1e-9)
    duration = 1e-9 * (recent[-1] - recent[0])
    sent = duration / period + 1.0
    arrived = len(recent) / sent
    if size >= LARGE_MESSAGE and arrived < _LOST:
        return (
            f'about {100.0 * (1.0 - arrived):.0f} % of the images, of '
            f'{size / 1e6:.1f} MB, are lost, by their stamps: Fast DDS loses big messages. '
            'Give the driver and this node the shipped profile, FASTRTPS_DEFAULT_PROFILES_FILE'
            '=$(ros2 pkg prefix --share rs_relpose_ros)/config/fastdds.xml; ros2 launch '
            'rs_relpose_ros relpose.launch.py does it for the node'
        )
    shares = steps / max(float(np.median(steps)), 1e-9)
    whole = steps[(shares > 0.0) & (shares < MISSING)]
    spread = 0.0
    if len(whole):
        # Of a normal distribution, 80 % of the differences of two stamps are within 2.56 sigma.
        longest, shortest = np.quantile(whole, (0.9, 0.1))
        spread = float(longest - shortest)
    jitter = spread / 2.56 / math.sqrt(2.0)
    if jitter < _JITTER or correlation_of_steps(shares) > _ALTERNATING:
        return ''
    return (
        f'the stamps of the images jitter by {1e3 * jitter:.1f} ms rms, as times of arrival '
        'do: a pose is wrong by the rotation within that time. Let the driver stamp by the '
        'clock of the sensor'
    )


# -- Fields of /diagnostics -----------------------------------------------------------------------

# Level of a status without a fault. [derived: diagnostic_msgs/DiagnosticStatus]
OK = 0
# Level of a warning. [derived: the same]
WARN = 1
# Level of an error. [derived: the same]
ERROR = 2
# Text while the worker compiles. [derived: interface]
STARTING = 'starting: kernels are compiled or loaded'
# Task in the name of the status of relpose_node. [derived: interface]
RELATIVE_POSE = 'relative pose'

# Number of the latest results over which the latency is taken: half a minute. Fewer leave the 99th
# percentile to three values, more hide a change. [chosen: half to four times would do]
_RECENT_RESULTS = 300
# Number of the latest frames over which the time per frame is taken, for the same reasons.
# [chosen: half to four times would do]
_RECENT_FRAMES = 900
# Time without a message [s] after which an input counts as missing. Less would report slow
# cameras. [chosen: 1 to 5 s would do]
SILENCE = 2.0
# Topics of the nodes in the order of /diagnostics. [derived: interface]
TOPICS = (Role.IMAGE, Role.CAMERA_INFO, Role.IMU, Role.ACCEL)
# Key of the number of unusable messages. [derived: no role has it]
INVALID = 'invalid'


@dataclass(frozen=True, slots=True)
class Report:
    """A diagnostic status: level, text, and the fields in their order."""

    level: int
    text: str
    values: tuple[tuple[str, str], ...]
    silence: Silence  # ends with a result


# Counters of `SequencerCounts` on /diagnostics. [derived: interface]
_COUNTERS = ('imu_samples', 'imu_gaps', 'imu_repeated', 'imu_late', 'imu_wild', 'clock_jumps')


def _ms(seconds: float) -> str:
    return f'{1e3 * seconds:.2f}'


def _vector(values: Array) -> str:
    return ' '.join(f'{value:.5f}' for value in values)


# Tracked calibration and applied corrections, to be compared with the parameters. [derived:
# interface]
_TRACKED: dict[str, Callable[[Tracked, Applied], str]] = {
    'tracked_gyro_bias_rad_s': lambda tracked, _: _vector(tracked.gyro_bias),
    'tracked_gyro_bias_sigma_rad_s': lambda tracked, _: _vector(tracked.gyro_bias_sigma),
    'tracked_time_offset_ms': lambda tracked, _: _ms(tracked.time_offset),
    'tracked_time_offset_sigma_ms': lambda tracked, _: _ms(tracked.time_offset_sigma),
    'applied_time_offset_ms': lambda _, applied: _ms(applied.offset),
    'tracked_readout_time_ms': lambda tracked, _: _ms(tracked.readout_time),
    'tracked_readout_time_sigma_ms': lambda tracked, _: _ms(tracked.readout_time_sigma),
    'applied_readout_time_ms': lambda _, applied: _ms(applied.readout_time),
}


class FrameStatistics(ABC):
    """Fields that every node has, thread-safe; a subclass adds the fields of its results.

    `clock`: monotonic [ns]; set by tests.
    """

    # States without results, and with a configured parameter that is wrong.
    idle = 'not working'
    wrong = 'told wrong'
    last = 'last_failure'  # key of the last failure

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._latencies: deque[float] = deque(maxlen=_RECENT_RESULTS)
        self._failures = 0
        self._last_failure: Reason | None = None
        self._last_refusal = ''
        self._since_ns = clock()
        self._taken = 0  # frames, until the last report
        self._counted: Counter[str] = Counter()
        self._refused: Counter[Refusal] = Counter()
        self._frame_times: deque[float] = deque(maxlen=_RECENT_FRAMES)
        self._busy_ns = 0
        self._results = self._results_reported = 0
        self.start()

    def start(self) -> None:
        """The subscriptions are made: silence is measured from here."""
        with self._lock:
            self._silent_since = (self._clock(), self._counted[Role.IMAGE], self._refused)

    def add_frame(self, taken_ns: int) -> None:
        """Count a frame that was `taken_ns` (monotonic clock), after its publication."""
        spent_ns = self._clock() - taken_ns
        with self._lock:
            self._frame_times.append(spent_ns / NANOSECONDS)
            self._busy_ns += spent_ns

    def add_failure(self, reason: Reason) -> None:
        """Count a frame whose processing failed."""
        with self._lock:
            self._failures += 1
            self._last_failure = reason

    def add_refusal(self, reason: str) -> None:
        """Keep the reason why a frame was not used."""
        with self._lock:
            self._last_refusal = reason

    def report(
        self,
        inputs: Counter[str],
        counts: SequencerCounts | None,
        *,
        problem: str,
        missing: tuple[str, ...],
        progress: Progress | None = None,
        warning: str = '',
    ) -> Report:
        """The state since the last report.

        `inputs` are the numbers of messages so far, by role, and of the invalid ones. `counts` is
        None while no frame is processed; `problem` is the reason for that, or empty; `missing` are
        names of missing parameters and inputs; `progress` is that of a calibration, `warning` is
        one of the images' stamps.
        """
        now_ns = self._clock()
        with self._lock:
            elapsed = max((now_ns - self._since_ns) / NANOSECONDS, 1e-3)
            before = self._counted
            self._since_ns = now_ns
            self._counted = inputs
            refused = Counter({} if counts is None else counts.refused)
            dropped = refused - self._refused
            self._refused = refused
            taken = 0 if counts is None else counts.frames_taken
            used = taken - self._taken
            self._taken = taken
            busy = self._busy_ns / NANOSECONDS / elapsed
            self._busy_ns = 0
            if not problem and dropped and used <= 0:
                problem = f'{self.idle}: no frame can be used: {self._last_refusal}'
            level, text = self._evaluate(problem, dropped)
            if progress is not None:
                level = OK
                text = progress.text
            if warning and level == OK:
                level = WARN
                text = warning
            state = 'calibrating' if progress is not None else self._state(level, problem)
            values: dict[str, object] = {'state': state, 'missing': ', '.join(missing)}
            if progress is not None:
                values['progress'] = f'{100.0 * progress.share:.0f}'
                values |= progress.values
            for role in TOPICS:
                arrived = inputs[role] - before[role]
                values[f'{role.value}_rate_hz'] = f'{arrived / elapsed:.1f}'
            values['frames_received'] = counts.frames if counts else inputs[Role.IMAGE]
            values['frames_processed'] = taken
            values |= self._counters(counts, refused, inputs[INVALID])
            values |= self._values()
            values |= self._times()
            values['worker_busy_percent'] = f'{100.0 * busy:.0f}'
            values[self.last] = self._last_failure.text if self._last_failure else ''
            silence = self._silence(now_ns, inputs[Role.IMAGE], refused)
        texts = tuple((name, str(value)) for name, value in values.items())
        return Report(level, text, texts, silence)

    def _state(self, level: int, problem: str) -> str:
        """What the node does, in a word."""
        if problem:
            return self.idle
        return {OK: 'ok', WARN: 'degraded', ERROR: self.wrong}[level]

    def _counters(
        self, counts: SequencerCounts | None, refused: Counter[Refusal], invalid: int
    ) -> dict[str, object]:
        """Numbers of frames and samples that were not used, and why."""
        values: dict[str, object] = {
            f'frames_refused_{kind.value}': refused[kind] for kind in Refusal
        }
        values['frames_failed'] = self._failures
        values['messages_invalid'] = invalid
        return values | {name: getattr(counts, name, 0) for name in _COUNTERS}

    def _times(self) -> dict[str, object]:
        """Latency of the latest results, and processing time of the latest frames."""
        values: dict[str, object] = {}
        for name, seconds in (('latency', self._latencies), ('frame_time', self._frame_times)):
            values[f'{name}_p50_ms'], values[f'{name}_p99_ms'] = _milliseconds(seconds)
        return values

    def _silence(self, now_ns: int, images: int, refused: Counter[Refusal]) -> Silence:
        # Without an image there can be no result.
        if self._results > self._results_reported or images == self._silent_since[1]:
            self._results_reported = self._results
            self._silent_since = (now_ns, images, refused)
        since_ns, images_before, refused_before = self._silent_since
        return Silence(
            (now_ns - since_ns) / NANOSECONDS,
            images - images_before,
            refused - refused_before,
            self._last_failure,
        )

    def _evaluate(self, problem: str, dropped: Counter[Refusal]) -> tuple[int, str]:
        if problem:
            return OK if problem == STARTING else ERROR, problem
        level, text = self._evaluate_results()
        if level == ERROR or not dropped:
            return level, text
        kinds = ', '.join(f'{count} {kind.value}' for kind, count in dropped.most_common())
        text = f'{dropped.total()} frames were not used since the last report ({kinds})'
        if dropped[Refusal.OVERLOAD]:
            text += ': the worker is too slow for the camera'
        return WARN, text

    def _published(self, ready_ns: int) -> None:
        """Add the latency of a result with all data at `ready_ns`; call it under the lock."""
        self._results += 1
        self._latencies.append((self._clock() - ready_ns) / NANOSECONDS)

    # -- results of a node (called under the lock) ---------------------------------------------

    @abstractmethod
    def _evaluate_results(self) -> tuple[int, str]:
        """Level and text while frames are processed; ERROR if a parameter is wrong."""

    @abstractmethod
    def _values(self) -> dict[str, object]:
        """Fields of the results."""


def _milliseconds(seconds: Collection[float]) -> tuple[str, str]:
    """Median and 99th percentile; empty without values."""
    if not seconds:
        return '', ''
    median, p99 = 1e3 * np.percentile(list(seconds), (50, 99))
    return f'{median:.1f}', f'{p99:.1f}'


def evaluate_faults(health: Assessment) -> tuple[int, str]:
    """Level and text of a calibration with faults, by the worst of them."""
    worst = health.faults[0]
    level = ERROR if worst.state is FindingState.WRONG else WARN
    return level, findings_text.line(worst)


class Statistics(FrameStatistics):
    """Fields of relpose_node; thread-safe."""

    idle = 'not estimating'
    last = 'last_reason_no_pose'

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        super().__init__(clock)
        self._pairs = self._poses = 0
        self._last_pair: PairResult | None = None
        self._last_pose: PairResult | None = None

    def add_pair(self, result: PairResult, ready_ns: int) -> None:
        """Count a pair right after its publication; its data were complete at `ready_ns`."""
        with self._lock:
            self._pairs += 1
            self._last_pair = result
            if result.pose:
                self._poses += 1
                self._last_pose = result
                self._published(ready_ns)
            else:
                status = result.pose.status.value
                self._last_failure = Reason(status, f'{status}: {result.pose.reason}')

    def _evaluate_results(self) -> tuple[int, str]:
        last = self._last_pair
        if last is None:
            return OK, 'no keyframe pair yet'
        if last.health.faults:
            return evaluate_faults(last.health)
        if not last.pose:
            return WARN, f'no pose of the last pair: {last.pose.status.value}: {last.pose.reason}'
        return OK, f'estimating: {self._poses} poses of {self._pairs} pairs'

    def _values(self) -> dict[str, object]:
        last = self._last_pair
        pose = self._last_pose
        health = NOT_EVALUATED if last is None else last.health
        tracked = dict.fromkeys(_TRACKED, '')
        if last is not None and last.tracked is not None and last.tracked.pairs:
            tracked = {name: text(last.tracked, last.applied) for name, text in _TRACKED.items()}
        return {
            'pairs': self._pairs,
            'poses': self._poses,
            **{metric.name: metric.text(last) for metric in PAIR_METRICS},
            'model': pose.pose.diagnostics.model if pose else '',
            **tracked,
            'health': health.state.value,
            'health_findings': findings_text.one_line(health),
            'findings': findings_text.message_json(health),
        }


# -- Files with a line per frame ------------------------------------------------------------------

# Columns of the file of `FrameTimings`. [derived: interface]
COLUMNS = ('stamp_ns', 'ready_ns', 'taken_ns', 'done_ns', 'cpu_ns', 'outcome')


class LineFile:
    """File of the parameter of this name, written line by line; InputError if it cannot be opened.

    It ends with an error, as of a full disk, which `report` gets; the node continues.
    """

    def __init__(
        self, parameter: str, path: str, report: Callable[[str], object] = lambda text: None
    ) -> None:
        self._name = f'{parameter} {path}'
        self._report = report
        try:
            self._file: TextIO | None = Path(path).open(  # noqa: SIM115 closed by close
                'w', buffering=1, encoding='ascii'
            )
        except OSError as error:
            raise InputError(f'{self._name} cannot be written: {error.strerror}') from error

    def write(self, line: str) -> None:
        """Write a line without its end."""
        file = self._file
        if file is None:
            return
        try:
            file.write(f'{line}\n')
        except OSError as error:
            self._file = None
            with suppress(OSError):  # of what is left to be written
                file.close()
            self._report(f'{self._name} ends here: {error.strerror}')

    def close(self) -> None:
        """No more lines."""
        if self._file is not None:
            self._file.close()


class FrameTimings:
    """Writes the file of the parameter `timings_file`; to be used by the worker thread.

    For each frame: its stamp; on the monotonic clock the times `ready` and `taken` (as in `Frame`)
    and `done` (after publication); processor time of the thread since the frame before; the status
    of its keyframe pair, or ``none``.
    """

    def __init__(self, path: str, report: Callable[[str], object] = lambda text: None) -> None:
        self._file = LineFile('timings_file', path, report)
        self.close = self._file.close
        self._file.write(','.join(COLUMNS))
        self._spent_ns = 0

    def start(self) -> None:
        """The processor time until now belongs to no frame."""
        self._spent_ns = time.thread_time_ns()

    def add(self, frame: Frame[PairResult]) -> None:
        """Write a frame; call it right after its result was published."""
        done_ns = time.monotonic_ns()
        spent_ns = time.thread_time_ns()
        outcome = 'none' if frame.result is None else frame.result.pose.status.value
        self._file.write(
            f'{frame.stamp_ns},{frame.ready_ns},{frame.taken_ns},{done_ns},'
            f'{spent_ns - self._spent_ns},{outcome}'
        )
        self._spent_ns = spent_ns


# -- Log lines once per reason, repetitions now and then with their number ------------------------


class ReasonLog:
    """Passes a text to `write` unless one of its kind came in the last `period` [s]; thread-safe.

    `clock`: monotonic [s]; set by tests.
    """

    def __init__(
        self,
        write: Callable[[str], object],
        period: float = 30.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._write = write
        self._period = period
        self._clock = clock
        self._lock = threading.Lock()
        self._last: dict[str, tuple[float, int]] = {}

    def __call__(self, text: str, kind: str = '') -> None:
        """Log `text`, or count it; without a `kind`, texts that differ in numbers share one."""
        kind = kind or reason_key(text)
        now = self._clock()
        with self._lock:
            if kind not in self._last and len(self._last) >= MOST_REASONS:
                kind = ''
                text = 'further problems of other kinds (see /diagnostics)'
            last = self._last.get(kind)
            if last is not None and now - last[0] < self._period:
                self._last[kind] = (last[0], last[1] + 1)
                return
            self._last[kind] = (now, 0)
        repeated = f' ({last[1]} more since the last such line)' if last and last[1] else ''
        self._write(text + repeated)


# -- Log of the calibration consistency -----------------------------------------------------------


class HealthLog:
    """Logs findings after each result; at most a line per parameter and period of the logs."""

    def __init__(
        self, info: ReasonLog, warn: ReasonLog, error: ReasonLog, results: str = 'poses'
    ) -> None:
        self._info = info
        self._warn = warn
        self._error = error
        self._results = results
        self._reported_faults = False

    def __call__(self, health: Assessment, *, withhold: bool) -> None:
        """Log the findings; `withhold`: whether inconsistent results are suppressed."""
        faults = health.faults
        if faults:
            # Numbers and lesser faults change from pair to pair, the worst parameter hardly.
            text = '; '.join(map(findings_text.line, faults))
            kind = faults[0].code.value
            if health.is_gross:
                # A gross error has a fix of its own, unlike the first small steps.
                kind += ', gross'
            if health.state is FindingState.WRONG:
                effect = 'are published all the same, as withhold_when_wrong is false'
                if withhold:
                    effect = (
                        'are suppressed: withhold_when_wrong: false publishes them all the same'
                    )
                self._error(f'{text}; {self._results} {effect}', kind)
            else:
                self._warn(text, kind)
        elif self._reported_faults:
            self._info(
                f'health is {health.state.value}: no configured parameter is suspect or '
                'wrong any more'
            )
        self._reported_faults = bool(faults)
