"""Brings frames and IMU together: a frame goes on once the IMU covers its last row.

The live node and the replay use the same object. Live, a mailbox keeps the latest frames and the
oldest goes when the worker is too slow; offline nothing is dropped and no clock is read. Whatever
does not go on is counted by its cause.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
import threading
import time

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.front_end.frame import EncodedFrame, Frame
from rs_relpose_ros.front_end.pipeline import sensor_camera
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.timing import ImageClock, NANOSECONDS, seconds_between, to_nanoseconds
from rs_relpose_ros.imu.buffer import AddResult, Coverage, ImuBuffer
from rs_relpose_ros.imu.frame_imu import frame_imu, FrameImu
from rs_relpose_ros.imu.samples import ImuSample

# A stamp that lies further back than this is a bag that starts anew, not a late message.
CLOCK_JUMP_NS = NANOSECONDS
# So many in a row that lie behind the newest, each newer than the one before, are a clock that
# was set back by less; messages that overtake each other come alone.
_BACK_FRAMES = 3
_BACK_SAMPLES = 20
# Frames that wait for the worker; bounds the latency of an overloaded node.
MAILBOX_FRAMES = 5
# Frames that wait for the IMU; bounds the memory.
WAITING_FRAMES = 16
# How long a frame waits for the IMU.
MAX_IMU_WAIT_NS = NANOSECONDS
# An accelerometer this far behind the gyro has stopped; frames no longer wait for it.
_ACCELEROMETER_STALE_NS = NANOSECONDS // 10
_IMU_GAP = ('the gyro does not cover the read-out of the frame: it has a gap there, or begins '
            'later')
# Refusals that nobody has taken yet; the counters lose none.
_REFUSALS_KEPT = 256


class Refusal(str, Enum):
    """Why a frame was not processed."""

    OVERLOAD = 'overload'
    NO_IMU = 'no_imu'
    IMU_GAP = 'imu_gap'
    DUPLICATE = 'duplicate'
    OUT_OF_ORDER = 'out_of_order'
    CLOCK_JUMP = 'clock_jump'
    RESET = 'reset'
    BAD_IMAGE = 'bad_image'
    NO_CALIBRATION = 'no_calibration'


@dataclass(frozen=True, slots=True, eq=False)
class ReadyFrame:
    """A decoded frame with its IMU.

    Attributes
    ----------
    frame : Frame
    imu : FrameImu
    restart : bool
        Time jumped since the frame before: what was tracked belongs to another time.
    ready_ns : int
        When the later of the image and the IMU sample that covers its last row came, on the
        monotonic clock; 0 offline.
    taken_ns : int
        When its turn came, on the same clock: it was decoded after that.
    """

    frame: Frame
    imu: FrameImu
    restart: bool
    ready_ns: int
    taken_ns: int


@dataclass(frozen=True, slots=True)
class FrameRefused:
    """A frame that was not processed, and one sentence why."""

    stamp_ns: int
    cause: Refusal
    reason: str

    @property
    def status(self) -> Status:
        """The outcome as a pair's status."""
        no_imu = self.cause in (Refusal.NO_IMU, Refusal.IMU_GAP)
        return Status.NO_IMU if no_imu else Status.BAD_INPUT


@dataclass(frozen=True, slots=True)
class SequencerCounts:
    """What came and what became of it, since the start.

    `imu_repeated` counts samples of a stamp that had come before and were dropped, `imu_late`
    those that came after a younger one and were sorted in.
    """

    frames: int
    frames_taken: int
    refused: Mapping[Refusal, int]
    imu_samples: int
    imu_gaps: int
    clock_jumps: int
    imu_repeated: int = 0
    imu_late: int = 0


@dataclass(slots=True, eq=False)
class _Waiting:
    """A frame with its instants on the IMU clock and the monotonic clock [ns]."""

    frame: Frame | EncodedFrame
    start_ns: int
    end_ns: int
    reference_ns: int
    received_ns: int
    generation: int
    ready_ns: int | None = None


class _StepsBack:
    """Tells stamps of a clock that was set back from those of late messages."""

    def __init__(self, patience: int) -> None:
        self._patience = patience
        self._last_ns, self._count = 0, 0

    def add(self, stamp_ns: int, newest_ns: int | None) -> bool:
        """Whether this stamp ends a run of stamps that only a clock set back can give."""
        if newest_ns is None or stamp_ns >= newest_ns:
            self._count = 0
            return False
        self._count = self._count + 1 if self._count and stamp_ns > self._last_ns else 1
        self._last_ns = stamp_ns
        if self._count < self._patience:
            return False
        self._count = 0
        return True


class Sequencer:
    """Thread-safe meeting point of frames and IMU samples.

    Parameters
    ----------
    parameters : Parameters
        Sensor and IMU settings; those that have no default must be given.
    offline : bool
        Every frame is kept until the IMU covers it or the input is closed. Take what is ready
        after each message: the IMU history is only `imu_buffer_seconds` long.
    clock : callable
        Monotonic time [ns]; for tests.
    """

    def __init__(self, parameters: Parameters, *, offline: bool = False,
                 clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._parameters = parameters
        self._R_cam_imu = parameters.sensor.R_cam_imu
        self._offline = offline
        self._now: Callable[[], int] = (lambda: 0) if offline else clock
        self._max_gap_ns = to_nanoseconds(parameters.imu.max_imu_gap)
        # How much of the history is left depends on when it is asked for; half of it always is,
        # so that live and replay agree.
        self._longest_turn_ns = to_nanoseconds(0.5 * parameters.imu.imu_buffer_seconds)
        self._changed = threading.Condition()
        self._buffer = ImuBuffer(parameters.imu)
        self._waiting: deque[_Waiting] = deque()
        self._refusals: deque[FrameRefused] = deque(maxlen=None if offline else _REFUSALS_KEPT)
        self._calibration: Intrinsics | None = None
        self._image_clock: ImageClock | None = None
        self._last_stamp_ns: int | None = None
        self._previous_reference_ns: int | None = None
        self._frames_back = _StepsBack(_BACK_FRAMES)
        self._samples_back = _StepsBack(_BACK_SAMPLES)
        self._newest_imu_ns: int | None = None
        self._newest_gyro_ns: int | None = None
        self._newest_accelerometer_ns: int | None = None
        self._offset_ns = 0
        self._generation = 0
        self._taken_generation = 0
        self._closed = False
        self._frames = self._frames_taken = self._imu_samples = 0
        self._imu_gaps = self._clock_jumps = self._imu_repeated = self._imu_late = 0
        self._refused: Counter[Refusal] = Counter()

    # -- input -------------------------------------------------------------------------------

    def add_imu(self, sample: ImuSample) -> None:
        """Store an IMU sample.

        Raises
        ------
        InputError
            It cannot be used; nothing is stored.
        """
        with self._changed:
            newest = self._newest_imu_ns
            set_back = sample.angular_velocity is not None and self._samples_back.add(
                sample.stamp_ns, self._newest_gyro_ns)
            if newest is not None and (set_back or sample.stamp_ns < newest - CLOCK_JUMP_NS):
                self._jump(f'IMU stamps jumped back by '
                           f'{seconds_between(sample.stamp_ns, newest):.3f} s')
                self._clear_imu()
            added = self._buffer.add(sample)
            self._imu_samples += 1
            self._imu_repeated += added is AddResult.DUPLICATE
            # Of two topics one is always behind; a gyro sample behind the gyro is late.
            self._imu_late += (added is AddResult.LATE and sample.angular_velocity is not None
                               and self._newest_gyro_ns is not None
                               and sample.stamp_ns < self._newest_gyro_ns)
            self._newest_imu_ns = _later(self._newest_imu_ns, sample.stamp_ns)
            if sample.linear_acceleration is not None:
                self._newest_accelerometer_ns = _later(
                    self._newest_accelerometer_ns, sample.stamp_ns)
            if sample.angular_velocity is not None:
                if (self._newest_gyro_ns is not None
                        and sample.stamp_ns - self._newest_gyro_ns > self._max_gap_ns):
                    self._imu_gaps += 1
                self._newest_gyro_ns = _later(self._newest_gyro_ns, sample.stamp_ns)
            self._sort_out()

    def add_frame(self, frame: Frame | EncodedFrame) -> None:
        """Take a frame into the mailbox, or refuse it for its stamp."""
        with self._changed:
            self._frames += 1
            image_clock = self._clock_of(frame.intrinsics)
            start_ns, end_ns = image_clock.row_span_ns(frame.stamp_ns)
            set_back = self._frames_back.add(frame.stamp_ns, self._last_stamp_ns)
            if self._last_stamp_ns is not None and frame.stamp_ns <= self._last_stamp_ns:
                back = seconds_between(frame.stamp_ns, self._last_stamp_ns)
                if frame.stamp_ns == self._last_stamp_ns:
                    self._refuse(frame.stamp_ns, Refusal.DUPLICATE,
                                 'a frame of this stamp came before')
                    return
                if not set_back and self._last_stamp_ns - frame.stamp_ns <= CLOCK_JUMP_NS:
                    self._refuse(frame.stamp_ns, Refusal.OUT_OF_ORDER,
                                 f'the frame is {back:.3f} s older than the one before')
                    return
                self._jump(f'image stamps jumped back by {back:.3f} s')
                # The IMU may have jumped already, and then holds what this frame needs; set back
                # by little, it may hold two times at once.
                if set_back or (self._newest_imu_ns is not None
                                and self._newest_imu_ns > end_ns + CLOCK_JUMP_NS):
                    self._clear_imu()
            self._last_stamp_ns = frame.stamp_ns
            self._waiting.append(_Waiting(
                frame, start_ns, end_ns, image_clock.reference_ns(frame.stamp_ns),
                received_ns=self._now(), generation=self._generation))
            self._sort_out()

    def refuse(self, stamp_ns: int, cause: Refusal, reason: str) -> None:
        """Count a frame that could not even be added."""
        with self._changed:
            self._frames += 1
            self._refuse(stamp_ns, cause, reason)

    def waits_for_imu(self) -> bool:
        """Whether the newest frame still needs IMU samples."""
        with self._changed:
            return bool(self._waiting) and self._waiting[-1].ready_ns is None

    def reset(self) -> None:
        """Forget all frames and the IMU; the next frame starts anew."""
        with self._changed:
            self._start_anew(Refusal.RESET, 'a reset was asked for')
            self._clear_imu()

    def close(self) -> None:
        """End of the input: `take` gives what is there, then None."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    # -- output ------------------------------------------------------------------------------

    def apply_time_offset(self, offset_ns: int) -> None:
        """Shift the frames that are taken from now on by a tracked time offset.

        Call it between `take` and `take`, from the thread that calls these: then the shift of a
        frame depends on the frames before it alone, live as well as offline.
        """
        with self._changed:
            self._offset_ns = offset_ns

    def take(self, timeout: float = 0.0) -> ReadyFrame | FrameRefused | None:
        """The next frame in the order of stamps, or a refusal, or None after `timeout` seconds.

        The image is decoded outside of the lock.
        """
        taken = self._take_waiting(timeout)
        if not isinstance(taken, _Waiting):
            return taken
        taken_ns = self._now()
        try:
            frame = taken.frame.decoded()
        except InputError as error:
            with self._changed:
                return self._counted(taken.frame.stamp_ns, Refusal.BAD_IMAGE, str(error))
        with self._changed:
            start_ns, end_ns = self._span(taken)
            reference_ns = taken.reference_ns + self._offset_ns
            # While it was decoded time may have jumped, and the buffer belongs to another time.
            if (taken.generation != self._generation
                    or self._buffer.coverage(start_ns, end_ns) is not Coverage.AVAILABLE):
                return self._counted(
                    frame.stamp_ns, Refusal.CLOCK_JUMP,
                    'the gyro samples of the frame went while it was decoded: stamps jumped')
            previous_ns = self._previous_reference_ns
            if (previous_ns is not None
                    and reference_ns - previous_ns > self._longest_turn_ns):
                previous_ns = None
            imu = replace(frame_imu(self._buffer, (start_ns, end_ns), reference_ns,
                                    self._R_cam_imu, previous_ns),
                          applied_offset_ns=self._offset_ns)
            self._previous_reference_ns = reference_ns
            self._frames_taken += 1
            restart = self._taken_generation != self._generation
            self._taken_generation = self._generation
            return ReadyFrame(frame, imu, restart, taken.ready_ns or 0, taken_ns)

    def counts(self) -> SequencerCounts:
        """A snapshot of the counters."""
        with self._changed:
            return SequencerCounts(
                frames=self._frames, frames_taken=self._frames_taken,
                refused=dict(self._refused), imu_samples=self._imu_samples,
                imu_gaps=self._imu_gaps, clock_jumps=self._clock_jumps,
                imu_repeated=self._imu_repeated, imu_late=self._imu_late)

    # -- under the lock ----------------------------------------------------------------------

    def _take_waiting(self, timeout: float) -> _Waiting | FrameRefused | None:
        with self._changed:
            # Offline, what is not there yet does not come by waiting.
            wait_ns = 0 if self._offline else round(timeout * NANOSECONDS)
            deadline_ns = self._now() + wait_ns
            while True:
                if self._refusals:
                    return self._refusals.popleft()
                if self._waiting:
                    head = self._waiting[0]
                    # A tracked offset may have moved a frame that was ready.
                    start_ns, end_ns = self._span(head)
                    if head.ready_ns is not None and self._covers(end_ns):
                        coverage = self._buffer.coverage(start_ns, end_ns)
                        if coverage is Coverage.AVAILABLE:
                            return self._waiting.popleft()
                        if coverage is Coverage.NEVER:
                            self._waiting.popleft()
                            return self._counted(head.frame.stamp_ns, Refusal.IMU_GAP, _IMU_GAP)
                    if self._closed:
                        self._waiting.popleft()
                        return self._counted(head.frame.stamp_ns, Refusal.NO_IMU,
                                             'the gyro ends before the last row of the frame')
                elif self._closed:
                    return None
                now_ns = self._now()
                wait_until_ns = deadline_ns
                if self._waiting and not self._offline:
                    overdue_ns = self._waiting[0].received_ns + MAX_IMU_WAIT_NS
                    if now_ns >= overdue_ns:
                        stamp_ns = self._waiting.popleft().frame.stamp_ns
                        return self._counted(
                            stamp_ns, Refusal.NO_IMU,
                            'no gyro sample that covers the last row of the frame came within '
                            f'{MAX_IMU_WAIT_NS / NANOSECONDS:g} s')
                    wait_until_ns = min(wait_until_ns, overdue_ns)
                if now_ns >= deadline_ns:
                    return None
                self._changed.wait((wait_until_ns - now_ns) / NANOSECONDS)

    def _sort_out(self) -> None:
        """Mark the frames that the IMU covers by now, and keep the mailbox within its bounds."""
        now_ns = self._now()
        ready = 0
        for waiting in tuple(self._waiting):
            if waiting.ready_ns is None:
                if not self._covers(self._span(waiting)[1]):
                    break
                if self._buffer.coverage(waiting.start_ns, waiting.end_ns) is Coverage.NEVER:
                    # Here, not when its turn comes: it must not count as waiting for the worker.
                    self._waiting.remove(waiting)
                    self._refuse(waiting.frame.stamp_ns, Refusal.IMU_GAP, _IMU_GAP)
                    continue
                waiting.ready_ns = now_ns
            ready += 1
        if not self._offline:
            for _ in range(ready - MAILBOX_FRAMES):
                self._refuse(self._waiting.popleft().frame.stamp_ns, Refusal.OVERLOAD,
                             'the worker was too slow, newer frames wait')
            while len(self._waiting) > WAITING_FRAMES:
                self._refuse(self._waiting.popleft().frame.stamp_ns, Refusal.NO_IMU,
                             f'{WAITING_FRAMES} newer frames wait for the gyro')
        if ready:
            self._changed.notify()

    def _span(self, waiting: _Waiting) -> tuple[int, int]:
        """Instants of its first and last row, with the offset tracked by now."""
        return waiting.start_ns + self._offset_ns, waiting.end_ns + self._offset_ns

    def _covers(self, end_ns: int) -> bool:
        """Whether the IMU has come as far as `end_ns`, an accelerometer on its own topic too."""
        gyro_ns, accelerometer_ns = self._newest_gyro_ns, self._newest_accelerometer_ns
        if gyro_ns is None or gyro_ns < end_ns:
            return False
        # Gravity must not depend on which of two topics came first.
        return (accelerometer_ns is None or accelerometer_ns >= end_ns
                or gyro_ns - accelerometer_ns > _ACCELEROMETER_STALE_NS)

    def _clock_of(self, calibration: Intrinsics) -> ImageClock:
        if self._image_clock is None or calibration != self._calibration:
            sensor = self._parameters.sensor
            self._image_clock = ImageClock(
                sensor_camera(calibration, self._parameters), sensor.time_offset,
                sensor.stamp_exposure, sensor.exposure_time)
            self._calibration = calibration
        return self._image_clock

    def _counted(self, stamp_ns: int, cause: Refusal, reason: str) -> FrameRefused:
        self._refused[cause] += 1
        return FrameRefused(stamp_ns, cause, reason)

    def _refuse(self, stamp_ns: int, cause: Refusal, reason: str) -> None:
        self._refusals.append(self._counted(stamp_ns, cause, reason))
        self._changed.notify()

    def _jump(self, reason: str) -> None:
        self._clock_jumps += 1
        self._start_anew(Refusal.CLOCK_JUMP, reason)

    def _start_anew(self, cause: Refusal, reason: str) -> None:
        """What waits belongs to the time before."""
        self._generation += 1
        while self._waiting:
            self._refuse(self._waiting.popleft().frame.stamp_ns, cause, reason)
        self._last_stamp_ns = self._previous_reference_ns = None

    def _clear_imu(self) -> None:
        self._buffer.clear()
        self._newest_imu_ns = self._newest_gyro_ns = self._newest_accelerometer_ns = None


def _later(known_ns: int | None, stamp_ns: int) -> int:
    return stamp_ns if known_ns is None else max(known_ns, stamp_ns)
