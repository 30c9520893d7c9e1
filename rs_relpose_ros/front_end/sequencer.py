"""Brings frames and IMU together: a frame goes on once the IMU covers its last row.

The live node and the replay use the same object. Live, a mailbox keeps the latest frames and the
oldest goes when the worker is too slow; offline nothing is dropped and no clock is read. Whatever
does not go on is counted by its cause.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from enum import Enum
import threading
import time
from typing import Generic

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.front_end.frame import Decodable, Decoded, image_clock, sensor_camera
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.timing import (
    FrameIntervals,
    ImageClock,
    NANOSECONDS,
    seconds_between,
    to_nanoseconds,
)
from rs_relpose_ros.health.tracked import Applied
from rs_relpose_ros.imu.buffer import AddResult, Coverage, ImuBuffer
from rs_relpose_ros.imu.frame_imu import frame_imu, FrameImu
from rs_relpose_ros.imu.samples import ImuSample

# Stamps that lie further back than this [ns] are a bag that starts anew, not late messages.
CLOCK_JUMP_NS = NANOSECONDS
# Successive stamps behind the newest, each newer than the one before, that mean that the clock was
# set back by less than that: messages that overtake each other come alone.
_BACK_FRAMES = 3
_BACK_SAMPLES = 20
# Most frames that wait for the worker: bounds the latency of an overloaded node.
MAILBOX_FRAMES = 5
# Most frames that wait for the IMU: bounds the memory.
WAITING_FRAMES = 16
# Longest time [ns] that a frame waits for the IMU.
MAX_IMU_WAIT_NS = NANOSECONDS
# Delay [ns] behind the gyro from which on an accelerometer on its own topic counts as stopped:
# frames no longer wait for it.
_ACCELEROMETER_STALE_NS = NANOSECONDS // 10
# Most refusals that are kept until they are taken; the counters lose none.
_REFUSALS_KEPT = 256
_IMU_GAP = ('the gyro does not cover the read-out of the frame: it has a gap there, or begins '
            'later')


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
class ReadyFrame(Generic[Decoded]):
    """A decoded frame with its IMU; both instants are on the monotonic clock, 0 offline."""

    frame: Decoded
    imu: FrameImu
    restart: bool   # time jumped since the frame before: tracks belong to another time
    ready_ns: int   # arrival of the image or of the IMU sample behind its last row: the later
    taken_ns: int   # when its turn came; it was decoded after that


@dataclass(frozen=True, slots=True)
class FrameRefused:
    """A frame that was not processed, and one sentence why."""

    stamp_ns: int
    cause: Refusal
    reason: str


@dataclass(frozen=True, slots=True)
class SequencerCounts:
    """What came and what became of it, since the start."""

    frames: int
    frames_taken: int
    refused: Mapping[Refusal, int]
    imu_samples: int
    imu_gaps: int
    clock_jumps: int
    imu_repeated: int = 0   # samples of a stamp that had come before, dropped
    imu_late: int = 0   # samples that came after a younger one, sorted in


@dataclass(slots=True, eq=False)
class _Waiting(Generic[Decoded]):
    """A frame that waits for the IMU or for the worker."""

    frame: Decodable[Decoded]
    start_ns: int   # first, last and stamped row on the IMU clock, without a tracked offset
    end_ns: int
    reference_ns: int
    received_ns: int   # on the monotonic clock
    generation: int
    ready_ns: int | None = None   # None until the IMU covers its last row


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


class Sequencer(Generic[Decoded]):
    """Thread-safe meeting point of frames and IMU samples; its states: ``docs/architecture.md``.

    Offline every frame is kept until the IMU covers it or the input is closed. Take what is ready
    after each message: the IMU history is only `imu_buffer_seconds` long. Tests give a `clock` of
    their own, monotonic [ns].
    """

    def __init__(self, parameters: Parameters, *, offline: bool = False,
                 clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._parameters = parameters
        self._R_cam_imu = parameters.sensor.R_cam_imu
        self._offline = offline
        self._now: Callable[[], int] = (lambda: 0) if offline else clock
        self._max_gap_ns = to_nanoseconds(parameters.imu.max_imu_gap)
        # Longest turn between two frames. How much of the history is left depends on when a frame
        # is taken; half of it is left in any case, so that live and replay agree.
        self._longest_turn_ns = to_nanoseconds(0.5 * parameters.imu.imu_buffer_seconds)
        self._changed = threading.Condition()
        self._closed = False
        self._buffer = ImuBuffer(parameters.imu)
        self._samples_back = _StepsBack(_BACK_SAMPLES)
        self._waiting: deque[_Waiting[Decoded]] = deque()
        self._refusals: deque[FrameRefused] = deque(maxlen=None if offline else _REFUSALS_KEPT)
        self._frames_back = _StepsBack(_BACK_FRAMES)
        self._intrinsics: Intrinsics | None = None
        self._image_clock: ImageClock | None = None
        self._last_stamp_ns: int | None = None
        self._intervals = FrameIntervals()
        self._previous_reference_ns: int | None = None
        # Tracked figures, and how often time jumped: when frames came, and as they are taken.
        self._offset_ns = self._margin_ns = 0
        self._generation = 0
        self._taken_generation = 0
        self._count: Counter[str] = Counter()
        self._refused: Counter[Refusal] = Counter()

    # -- input -------------------------------------------------------------------------------

    def add_imu(self, sample: ImuSample) -> None:
        """Store an IMU sample; InputError where it cannot be used, and nothing is stored."""
        has_gyro, stamp_ns = sample.angular_velocity is not None, sample.stamp_ns
        with self._changed:
            buffer = self._buffer
            set_back = has_gyro and self._samples_back.add(stamp_ns, buffer.newest_gyro_ns)
            newest_ns = buffer.newest_ns
            if newest_ns is not None and (set_back or stamp_ns < newest_ns - CLOCK_JUMP_NS):
                self._jump('IMU stamps jumped back by '
                           f'{seconds_between(stamp_ns, newest_ns):.3f} s')
                buffer.clear()
            before_ns = buffer.newest_gyro_ns
            added = buffer.add(sample)
            self._count['imu_samples'] += 1
            self._count['imu_repeated'] += added is AddResult.DUPLICATE
            if has_gyro and before_ns is not None:
                # Of two topics one is always behind; late is a gyro sample behind another one.
                self._count['imu_late'] += added is AddResult.LATE and stamp_ns < before_ns
                self._count['imu_gaps'] += stamp_ns - before_ns > self._max_gap_ns
            self._sort_out()

    def add_frame(self, frame: Decodable[Decoded]) -> None:
        """Take a frame into the mailbox, or refuse it for its stamp."""
        with self._changed:
            self._count['frames'] += 1
            clock = self._clock_of(frame.intrinsics)
            if not self._goes_on(frame.stamp_ns, clock.row_span_ns(frame.stamp_ns)[1]):
                return
            self._last_stamp_ns = frame.stamp_ns
            # Of all frames that come, whatever becomes of them: live as in replay.
            interval_ns = self._intervals.add(frame.stamp_ns)
            self._waiting.append(_Waiting(
                frame, *clock.row_span_ns(frame.stamp_ns, interval_ns),
                clock.reference_ns(frame.stamp_ns, interval_ns),
                received_ns=self._now(), generation=self._generation))
            self._sort_out()

    def pass_over(self, stamp_ns: int) -> None:
        """Learn of a frame that is left out on purpose: it tells the interval of the next one."""
        with self._changed:
            self._intervals.add(stamp_ns)

    def refuse(self, stamp_ns: int, cause: Refusal, reason: str) -> None:
        """Count a frame that could not even be added."""
        with self._changed:
            self._count['frames'] += 1
            self._refuse(stamp_ns, cause, reason)

    def waits_for_imu(self) -> bool:
        """Whether the newest frame still needs IMU samples."""
        with self._changed:
            return bool(self._waiting) and self._waiting[-1].ready_ns is None

    def reset(self) -> None:
        """Forget all frames and the IMU; the next frame starts anew."""
        with self._changed:
            self._start_anew(Refusal.RESET, 'a reset was asked for')
            self._buffer.clear()

    def close(self) -> None:
        """End of the input: `take` gives what is there, then None."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    # -- output ------------------------------------------------------------------------------

    def apply(self, applied: Applied) -> None:
        """Give the frames that are taken from now on tracked figures: shift and rows to cover.

        Call it between `take` and `take`, from the thread that calls these: then the IMU of a
        frame depends on the frames before it alone, live as well as offline.
        """
        with self._changed:
            self._offset_ns, self._margin_ns = applied.time_offset_ns, applied.margin_ns

    def take(self, timeout: float = 0.0) -> ReadyFrame[Decoded] | FrameRefused | None:
        """The next frame in the order of stamps, or a refusal, or None after `timeout` seconds.

        The image is decoded outside of the lock.
        """
        head = self._await_head(timeout)
        if not isinstance(head, _Waiting):
            return head
        taken_ns = self._now()
        try:
            frame = head.frame.decoded()
        except InputError as error:
            with self._changed:
                return self._counted(head.frame.stamp_ns, Refusal.BAD_IMAGE, str(error))
        with self._changed:
            # Meanwhile stamps may have jumped, and the buffer then belongs to another time.
            if (head.generation != self._generation
                    or self._coverage(head) is not Coverage.AVAILABLE):
                return self._counted(
                    frame.stamp_ns, Refusal.CLOCK_JUMP,
                    'the gyro samples of the frame went while it was decoded: stamps jumped')
            imu = self._imu_of(head)
            self._count['frames_taken'] += 1
            restart = self._taken_generation != self._generation
            self._taken_generation = self._generation
            return ReadyFrame(frame, imu, restart, head.ready_ns or 0, taken_ns)

    def counts(self) -> SequencerCounts:
        """A snapshot of the counters."""
        with self._changed:
            return SequencerCounts(refused=dict(self._refused), **{
                field.name: self._count[field.name] for field in fields(SequencerCounts)
                if field.name != 'refused'})

    # -- waiting (all below are called under the lock, but for `_await_head`) ------------------

    def _await_head(self, timeout: float) -> _Waiting[Decoded] | FrameRefused | None:
        """The oldest frame as soon as it is ready or refused; None after `timeout` seconds."""
        with self._changed:
            # Offline nothing comes while one waits.
            deadline_ns = self._now() + (0 if self._offline else round(timeout * NANOSECONDS))
            while True:
                head = self._decided_head()
                now_ns = self._now()
                if head is not None or self._closed or now_ns >= deadline_ns:
                    return head
                until_ns = min(deadline_ns, self._overdue_ns()) if self._waiting else deadline_ns
                self._changed.wait(max(until_ns - now_ns, 0) / NANOSECONDS)

    def _decided_head(self) -> _Waiting[Decoded] | FrameRefused | None:
        """The oldest refusal, or the oldest frame if it is ready or must be refused."""
        if self._refusals:
            return self._refusals.popleft()
        if not self._waiting:
            return None
        head = self._waiting[0]
        # A tracked offset may have moved a frame that was ready.
        covered = head.ready_ns is not None and self._imu_reaches(self._span(head)[1])
        coverage = self._coverage(head) if covered else Coverage.NOT_YET
        if coverage is Coverage.AVAILABLE:
            return self._waiting.popleft()
        if coverage is Coverage.NEVER:
            cause, reason = Refusal.IMU_GAP, _IMU_GAP
        elif self._closed:
            cause, reason = Refusal.NO_IMU, 'the gyro ends before the last row of the frame'
        elif not self._offline and self._now() >= self._overdue_ns():
            cause, reason = Refusal.NO_IMU, (
                'no gyro sample that covers the last row of the frame came within '
                f'{MAX_IMU_WAIT_NS / NANOSECONDS:g} s')
        else:
            return None
        self._waiting.popleft()
        return self._counted(head.frame.stamp_ns, cause, reason)

    def _overdue_ns(self) -> int:
        """When the oldest frame has waited for the IMU long enough, on the monotonic clock."""
        return self._waiting[0].received_ns + MAX_IMU_WAIT_NS

    def _sort_out(self) -> None:
        """Mark the frames that the IMU covers by now, and keep the mailbox within its bounds."""
        now_ns = self._now()
        ready = 0
        for waiting in tuple(self._waiting):
            if waiting.ready_ns is None:
                if not self._imu_reaches(self._span(waiting)[1]):
                    break
                if self._buffer.coverage(waiting.start_ns, waiting.end_ns) is Coverage.NEVER:
                    # Refused at once: it must not count as a frame that waits for the worker.
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

    # -- instants and IMU of a frame ---------------------------------------------------------

    def _clock_of(self, intrinsics: Intrinsics) -> ImageClock:
        if self._image_clock is None or intrinsics != self._intrinsics:
            self._image_clock = image_clock(
                sensor_camera(intrinsics, self._parameters), self._parameters.sensor)
            self._intrinsics = intrinsics
        return self._image_clock

    def _span(self, waiting: _Waiting[Decoded]) -> tuple[int, int]:
        """Instants of its first and last row, with offset and read-out tracked by now."""
        return (waiting.start_ns + self._offset_ns - self._margin_ns,
                waiting.end_ns + self._offset_ns + self._margin_ns)

    def _imu_reaches(self, end_ns: int) -> bool:
        """Whether gyro and accelerometer, which may have a topic each, have come to an instant."""
        gyro_ns, force_ns = self._buffer.newest_gyro_ns, self._buffer.newest_force_ns
        if gyro_ns is None or gyro_ns < end_ns:
            return False
        # Gravity must not depend on which of two topics came first.
        return (force_ns is None or force_ns >= end_ns
                or gyro_ns - force_ns > _ACCELEROMETER_STALE_NS)

    def _coverage(self, waiting: _Waiting[Decoded]) -> Coverage:
        return self._buffer.coverage(*self._span(waiting))

    def _imu_of(self, taken: _Waiting[Decoded]) -> FrameImu:
        """The IMU's share of a frame, with the turn since the frame that was taken before."""
        reference_ns = taken.reference_ns + self._offset_ns
        previous_ns = self._previous_reference_ns
        if previous_ns is not None and reference_ns - previous_ns > self._longest_turn_ns:
            previous_ns = None
        imu = frame_imu(self._buffer, self._span(taken), reference_ns, self._R_cam_imu,
                        previous_ns)
        self._previous_reference_ns = reference_ns
        return replace(imu, applied_offset_ns=self._offset_ns)

    # -- refusals and jumps of a clock -------------------------------------------------------

    def _goes_on(self, stamp_ns: int, end_ns: int) -> bool:
        """Whether a frame of this stamp is taken; where it is not, it has been refused.

        A stamp that only a clock set back can give is taken: time starts anew with it.
        """
        last_ns = self._last_stamp_ns
        set_back = self._frames_back.add(stamp_ns, last_ns)
        if last_ns is None or stamp_ns > last_ns:
            return True
        if stamp_ns == last_ns:
            self._refuse(stamp_ns, Refusal.DUPLICATE, 'a frame of this stamp came before')
            return False
        back = seconds_between(stamp_ns, last_ns)
        if not set_back and last_ns - stamp_ns <= CLOCK_JUMP_NS:
            self._refuse(stamp_ns, Refusal.OUT_OF_ORDER,
                         f'the frame is {back:.3f} s older than the one before')
            return False
        self._jump(f'image stamps jumped back by {back:.3f} s')
        # The IMU may have jumped already, and then holds what this frame needs; set back by
        # little, it may hold two times at once.
        newest_ns = self._buffer.newest_ns
        if set_back or (newest_ns is not None and newest_ns > end_ns + CLOCK_JUMP_NS):
            self._buffer.clear()
        return True

    def _counted(self, stamp_ns: int, cause: Refusal, reason: str) -> FrameRefused:
        self._refused[cause] += 1
        return FrameRefused(stamp_ns, cause, reason)

    def _refuse(self, stamp_ns: int, cause: Refusal, reason: str) -> None:
        self._refusals.append(self._counted(stamp_ns, cause, reason))
        self._changed.notify()

    def _jump(self, reason: str) -> None:
        self._count['clock_jumps'] += 1
        self._start_anew(Refusal.CLOCK_JUMP, reason)

    def _start_anew(self, cause: Refusal, reason: str) -> None:
        """Refuse all frames that wait: they belong to the time before."""
        self._generation += 1
        while self._waiting:
            self._refuse(self._waiting.popleft().frame.stamp_ns, cause, reason)
        self._last_stamp_ns = self._previous_reference_ns = None
        self._intervals = FrameIntervals()
