"""Pairs frames with their IMU data: a frame is released once the IMU covers its last row.

The live node and the replay use the same object. Live, the queue is bounded and the oldest frame
is dropped if the worker is too slow; offline no frame is dropped and no clock is read. Every frame
that is not released is counted by its `Refusal`.
"""

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
import math
import threading
import time
from typing import Any, NamedTuple

import numpy as np

from rs_relpose_ros.config.settings import Parameters, sensor_model
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array, timing
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.geometry.timing import NANOSECONDS, seconds_between, to_nanoseconds
from rs_relpose_ros.imu.buffer import (
    Coverage,
    EXACT,
    frame_imu,
    ImuBuffer,
    ImuSample,
    StampDoubt,
)
from rs_relpose_ros.pipeline.monitor import Applied
from rs_relpose_ros.pipeline.pair import Frame
from rs_relpose_ros.tracking.images import EncodedImage, GrayLevels

# A stamp further behind the newest one [ns] is a bag that restarts, not a late message. With less,
# messages out of order restart the tracking; with more, a looped short bag is refused.
# [chosen: no driver delays a message by a second]
CLOCK_JUMP_NS = NANOSECONDS
# A single stamp further from the one before [ns] is no time of this stream.
# [chosen: no camera pauses for so long between two images of one run]
_FAR_NS = 10 * NANOSECONDS
# Number of consecutive frames behind the newest stamp, each newer than the one before, that
# indicate a clock that was set back by less than that: messages out of order come alone.
# [chosen: a tenth of a second at 30 Hz]
_BACK_FRAMES = 3
# Number of consecutive samples of the IMU that indicate the same. [chosen: a tenth of a second at
# 200 Hz]
_BACK_SAMPLES = 20
# Most frames that wait for the worker: they bound the latency of a worker that is too slow. With
# less, a single slow pair loses frames. [chosen: a sixth of a second at 30 Hz]
MAILBOX_FRAMES = 5
# Most frames that wait for the IMU: they bound the memory. [chosen: half a second at 30 Hz]
WAITING_FRAMES = 16
# Longest time [ns] that a frame waits for the IMU. [chosen: no driver is late by a second]
MAX_IMU_WAIT_NS = NANOSECONDS
# Delay [ns] behind the gyro above which frames do not wait for an accelerometer of its own topic:
# one that has ended must not stop the frames. [chosen: ten periods of a slow accelerometer]
_ACCELEROMETER_STALE_NS = NANOSECONDS // 10
# Change of the time offset from one frame to the next [ns] that is a step of a clock, after which
# tracking restarts; a smaller one turns the gyro of one interval by less than its noise.
# [chosen: half of the largest step of a tracked offset]
_STEP_NS = NANOSECONDS // 2000
# Most refusals that are kept until they are taken; the counters lose none.
# [chosen: some seconds of frames]
_REFUSALS_KEPT = 256
# Reason of a refusal where the gyro has a gap. [derived: text for people]
_IMU_GAP = 'the gyro does not cover the readout of the frame: it has a gap there, or begins later'
# An exposure is longer than the interval between frames beyond this ratio of the two: stamps
# jitter. [chosen: a quarter of the interval for both stamps of a phone]
_LONGEST_EXPOSURE = 1.25


class Refusal(str, Enum):
    """Kind of reason for which a frame was not processed."""

    OVERLOAD = 'overload'
    NO_IMU = 'no_imu'
    IMU_GAP = 'imu_gap'
    DUPLICATE = 'duplicate'
    OUT_OF_ORDER = 'out_of_order'
    CLOCK_JUMP = 'clock_jump'
    RESET = 'reset'
    BAD_IMAGE = 'bad_image'
    NO_CALIBRATION = 'no_calibration'


@dataclass(frozen=True, slots=True)
class FrameRefused:
    """A frame that was not processed."""

    stamp_ns: int
    refusal: Refusal
    reason: str


@dataclass(slots=True)
class SequencerCounts:
    """Numbers of frames and IMU samples since the start."""

    frames: int = 0
    frames_taken: int = 0
    refused: Counter[Refusal] = field(default_factory=Counter)
    imu_samples: int = 0
    imu_gaps: int = 0
    clock_jumps: int = 0
    imu_repeated: int = 0  # samples with the stamp of an earlier one, dropped
    imu_late: int = 0  # samples that came after a younger one, sorted in
    imu_wild: int = 0  # samples with a stamp far from those before and after, dropped


@dataclass(slots=True, eq=False)
class QueuedFrame:
    """An image that waits for the IMU or for the worker, not decoded."""

    image: EncodedImage
    intrinsics: Intrinsics
    span_ns: tuple[int, int]  # of the exposure on the IMU clock, without a tracked offset
    reference_ns: int  # of the stamped row
    exposure: float  # of a row [s]
    received_ns: int  # on the monotonic clock
    generation: int
    ahead: float  # [s] newest stamp of the gyro as it came, less `reference_ns`
    ready_ns: int | None = None  # None until the IMU covers its last row
    imu_doubt: StampDoubt = EXACT  # of the stamps of its gyro samples


class _StampOrder:
    """Recognises wild stamps, which come alone, and a clock that was set back.

    A clock that was set back produces at least `patience` stamps behind the newest one.
    """

    def __init__(self, patience: float) -> None:
        self._patience = patience
        self._back_ns = 0
        self._count = 0
        self._wild_ns: int | None = None  # the last one, unless the clock jumped to it

    def is_wild(self, stamp_ns: int, last_ns: int | None) -> bool:
        """Whether a stamp is far from the last one, and the stamp before it was not there, too.

        Drivers send a stamp of zero, for example.
        """
        if last_ns is None or abs(stamp_ns - last_ns) <= _FAR_NS:
            self._wild_ns = None
            return False
        confirmed = self._wild_ns is not None and 0 < stamp_ns - self._wild_ns <= _FAR_NS
        self._wild_ns = None if confirmed else stamp_ns
        return not confirmed

    def is_set_back(self, stamp_ns: int, newest_ns: int | None) -> bool:
        """Whether this stamp completes a run of stamps behind the newest one.

        Each stamp of a run is newer than the one before it.
        """
        if newest_ns is None or stamp_ns >= newest_ns:
            self._count = 0
            return False
        continued = 0 < self._count < self._patience and stamp_ns > self._back_ns
        self._back_ns = stamp_ns
        self._count = self._count + 1 if continued else 1
        return self._count >= self._patience


class Sequencer:
    """Thread-safe queue of frames and IMU samples; its states: ``docs/architecture.md``.

    Offline every frame is kept until the IMU covers it or the input is closed. Take the frames
    that are ready after each message: the IMU history is only `imu_buffer_seconds` long. With
    `colors` images are decoded in their own encoding. `clock`: monotonic [ns]; set by tests.
    """

    def __init__(
        self,
        parameters: Parameters,
        *,
        offline: bool = False,
        colors: bool = False,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._parameters = parameters
        self._offline = offline
        self._R_cam_imu = parameters.sensor.R_cam_imu
        self._colors = colors
        self._levels = GrayLevels()
        self.gyro_only = False  # whether frames are without gravity and specific force
        self._now: Callable[[], int] = (lambda: 0) if offline else clock
        self._max_gap_ns = to_nanoseconds(parameters.imu.max_imu_gap)
        # Longest interval of frames that the gyro is integrated over: half of the history is left
        # independently of when a frame is taken, so that live and replay agree.
        self._longest_interval_ns = to_nanoseconds(0.5 * parameters.imu.imu_buffer_seconds)
        self._changed = threading.Condition()
        self._closed = False
        self._buffer = ImuBuffer(parameters.imu)
        # The first is for samples without a gyro, the second for those with one.
        self._sample_orders = _StampOrder(math.inf), _StampOrder(_BACK_SAMPLES)
        self._frame_order = _StampOrder(_BACK_FRAMES)
        self._queue: deque[QueuedFrame] = deque()
        self._refusals: deque[FrameRefused] = deque(maxlen=None if offline else _REFUSALS_KEPT)
        self._last_stamp_ns: int | None = None
        self._intervals = timing.FrameIntervals()
        self._previous_ns: int | None = None  # reference time of the frame taken before
        # Tracked corrections: of the time offset, and a margin around a frame [ns].
        self._offset_ns = self._margin_ns = self._stepped_ns = 0
        self._imu_doubt = EXACT  # of the last gyro sample
        # Number of jumps in time: when frames came, and as they are taken.
        self._generation = 0
        self._taken_generation = 0
        self._counts = SequencerCounts()

    # -- input -------------------------------------------------------------------------------

    def add_imu(self, sample: ImuSample) -> None:
        """Store an IMU sample; InputError if it is unusable, and nothing is stored."""
        has_gyro = sample.angular_velocity is not None
        stamp_ns = sample.stamp_ns
        with self._changed:
            buffer = self._buffer
            counts = self._counts
            order = self._sample_orders[has_gyro]
            last_ns = (buffer.gyro if has_gyro else buffer.force).newest_ns
            if order.is_wild(stamp_ns, last_ns):
                counts.imu_wild += 1
                return
            newest_ns = buffer.newest_ns
            set_back = order.is_set_back(stamp_ns, last_ns)
            if newest_ns is not None and (set_back or stamp_ns < newest_ns - CLOCK_JUMP_NS):
                self._restart(
                    Refusal.CLOCK_JUMP,
                    f'IMU stamps jumped back by {seconds_between(stamp_ns, newest_ns):.3f} s',
                )
                buffer.clear()
                last_ns = None
            added = buffer.add(sample)
            if has_gyro:
                self._imu_doubt = sample.doubt
            counts.imu_samples += 1
            counts.imu_repeated += not added
            if has_gyro and last_ns is not None:
                # Of two topics one is always behind: only gyro samples are compared.
                counts.imu_late += added and stamp_ns < last_ns
                counts.imu_gaps += stamp_ns - last_ns > self._max_gap_ns
            if self._queue:
                self._update_queue()

    def add_frame(self, image: EncodedImage, intrinsics: Intrinsics) -> None:
        """Add an image to the queue, or refuse it for its stamp."""
        stamp_ns = image.stamp_ns
        with self._changed:
            self._counts.frames += 1
            clock = sensor_model(intrinsics, self._parameters.sensor).clock
            if not self._accepts(stamp_ns, clock.exposed_span_ns(stamp_ns)[1]):
                return
            self._last_stamp_ns = stamp_ns
            # Frames that are refused later count, too, so that live and replay agree.
            interval_ns = self._intervals.add(stamp_ns)
            exposure_ns = clock.exposure_time * NANOSECONDS
            if interval_ns and exposure_ns > _LONGEST_EXPOSURE * interval_ns:
                self._refuse(
                    stamp_ns,
                    Refusal.BAD_IMAGE,
                    'exposure_time is longer than the '
                    f'interval between frames, {interval_ns / NANOSECONDS:.4f} s',
                )
                return
            reference_ns = clock.reference_ns(stamp_ns, interval_ns)
            newest_ns = self._buffer.gyro.newest_ns
            self._queue.append(
                QueuedFrame(
                    image,
                    intrinsics,
                    clock.exposed_span_ns(stamp_ns, interval_ns),
                    reference_ns,
                    clock.exposure(interval_ns),
                    received_ns=self._now(),
                    generation=self._generation,
                    ahead=0.0 if newest_ns is None else seconds_between(reference_ns, newest_ns),
                )
            )
            self._update_queue()

    def pass_over(self, stamp_ns: int) -> None:
        """Register a frame that is left out on purpose: it determines the next one's interval."""
        with self._changed:
            self._intervals.add(stamp_ns)

    def refuse(self, stamp_ns: int, refusal: Refusal, reason: str) -> None:
        """Count a frame that could not even be added."""
        with self._changed:
            self._counts.frames += 1
            self._refuse(stamp_ns, refusal, reason)

    def waits_for_imu(self) -> bool:
        """Whether the newest frame still needs IMU samples."""
        with self._changed:
            return bool(self._queue) and self._queue[-1].ready_ns is None

    def has_next(self) -> bool:
        """Whether `take` may return something, before the end of the input."""
        with self._changed:
            return bool(self._refusals or (self._queue and self._queue[0].ready_ns is not None))

    def reset(self, reason: str = 'a reset was requested') -> None:
        """Drop all frames and the IMU history; tracking restarts with the next frame."""
        with self._changed:
            self._restart(Refusal.RESET, reason)
            self._buffer.clear()

    def close(self) -> None:
        """End of the input: `take` returns the frames that are left, then None."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    # -- output ------------------------------------------------------------------------------

    def apply(self, applied: Applied) -> None:
        """Set the tracked corrections of the frames taken from now on; only between two `take`.

        The IMU data of a frame then depend only on the frames before it.
        """
        with self._changed:
            stepped_ns = to_nanoseconds(applied.stepped)
            if abs(stepped_ns - self._stepped_ns) > _STEP_NS:
                # The gyro since the frame before would be that of another time.
                self._previous_ns = None
            self._stepped_ns = stepped_ns
            self._offset_ns = stepped_ns + to_nanoseconds(applied.time_offset)
            self._margin_ns = to_nanoseconds(applied.margin)

    def take(self, timeout: float = 0.0) -> Frame[Any] | FrameRefused | None:
        """The next frame in the order of stamps, or a refusal, or None after `timeout` seconds."""
        with self._changed:
            # Offline nothing comes while one waits.
            deadline_ns = self._now() + (0 if self._offline else round(timeout * NANOSECONDS))
            while (head := self._decided_head()) is None:
                if not self._waits(deadline_ns):
                    return None
        if isinstance(head, FrameRefused):
            return head
        image = head.image
        taken_ns = self._now()
        try:
            if self._colors:
                values, encoding = image.pixels(self._levels)
            else:
                values, encoding = image.decoded(self._levels), 'mono8'
            frame: Frame[Any] = Frame(
                image.stamp_ns,
                values,
                image.frame_id,
                head.intrinsics,
                encoding=encoding,
                encoded=image if self._colors else None,
                exposure=head.exposure,
                ahead=head.ahead,
                imu_doubt=head.imu_doubt,
                ready_ns=head.ready_ns or 0,
                taken_ns=taken_ns,
            )
        except InputError as error:
            return self._refused(image.stamp_ns, Refusal.BAD_IMAGE, str(error))
        with self._changed:
            # Stamps may have jumped meanwhile, and the buffer then belongs to another time.
            span_ns = self._corrected(head.span_ns)
            coverage = self._buffer.gyro.coverage(*span_ns)
            if head.generation != self._generation or coverage is not Coverage.AVAILABLE:
                return self._refused(
                    frame.stamp_ns,
                    Refusal.CLOCK_JUMP,
                    'stamps jumped while the frame was decoded: its gyro samples are lost',
                )
            reference_ns = head.reference_ns + self._offset_ns
            frame.applied_offset_ns = self._offset_ns - self._stepped_ns
            frame.imu_data = frame_imu(
                self._buffer,
                span_ns,
                reference_ns,
                self._R_cam_imu,
                self._previous_before(reference_ns),
                head.exposure,
                gyro_only=self.gyro_only,
            )
            frame.restart = self._taken_generation != self._generation
            self._previous_ns = reference_ns
            self._taken_generation = self._generation
            self._counts.frames_taken += 1
            return frame

    def _previous_before(self, reference_ns: int) -> int | None:
        """Reference time of the frame before, if it is near enough for a rotation between both."""
        previous_ns = self._previous_ns
        if previous_ns is None or reference_ns - previous_ns > self._longest_interval_ns:
            return None
        return previous_ns

    def _waits(self, deadline_ns: int) -> bool:
        """Wait for a change of the queue, or until its head is too old; False at the deadline."""
        now_ns = self._now()
        if self._closed or now_ns >= deadline_ns:
            return False
        if self._queue:
            deadline_ns = min(deadline_ns, self._queue[0].received_ns + MAX_IMU_WAIT_NS)
        self._changed.wait(max(deadline_ns - now_ns, 0) / NANOSECONDS)
        return True

    def _refused(self, stamp_ns: int, refusal: Refusal, reason: str) -> FrameRefused:
        """Refuse a frame that was taken; the oldest refusal."""
        with self._changed:  # a lock that its owner may take again
            self._refuse(stamp_ns, refusal, reason)
            return self._refusals.popleft()

    def counts(self) -> SequencerCounts:
        """A snapshot of the counters."""
        with self._changed:
            return replace(self._counts, refused=self._counts.refused.copy())

    # -- queue (all below are called under the lock) --------------------------------------------

    def _decided_head(self) -> QueuedFrame | FrameRefused | None:
        """The oldest refusal, or the oldest frame if it is ready or must be refused."""
        if self._queue and not self._refusals:
            head = self._queue[0]
            start_ns, end_ns = self._corrected(head.span_ns)
            # A tracked offset may have moved a frame that was ready.
            coverage = (
                self._buffer.gyro.coverage(start_ns, end_ns)
                if head.ready_ns is not None and self._imu_reaches(end_ns)
                else Coverage.NOT_YET
            )
            if coverage is Coverage.AVAILABLE:
                return self._queue.popleft()
            if coverage is Coverage.NEVER:
                self._drop(head, Refusal.IMU_GAP, _IMU_GAP)
            elif self._closed:
                self._drop(head, Refusal.NO_IMU, 'the gyro ends before the last row of the frame')
            elif not self._offline and self._now() >= head.received_ns + MAX_IMU_WAIT_NS:
                self._drop(
                    head,
                    Refusal.NO_IMU,
                    'no gyro sample that covers the last row of the '
                    f'frame came within {MAX_IMU_WAIT_NS / NANOSECONDS:g} s',
                )
        return self._refusals.popleft() if self._refusals else None

    def _update_queue(self) -> None:
        """Mark the frames that the IMU covers by now, and keep the queue within its bounds."""
        now_ns = self._now()
        ready = 0
        for queued in tuple(self._queue):
            if queued.ready_ns is None:
                if not self._imu_reaches(self._corrected(queued.span_ns)[1]):
                    break
                if self._buffer.gyro.coverage(*queued.span_ns) is Coverage.NEVER:
                    # Refused at once: it must not count as a frame that waits for the worker.
                    self._drop(queued, Refusal.IMU_GAP, _IMU_GAP)
                    continue
                queued.ready_ns = now_ns
                queued.imu_doubt = self._imu_doubt
            ready += 1
        if not self._offline:
            for _ in range(ready - MAILBOX_FRAMES):
                self._drop(
                    self._queue[0], Refusal.OVERLOAD, 'the worker was too slow, newer frames wait'
                )
            while len(self._queue) > WAITING_FRAMES:
                self._drop(
                    self._queue[0],
                    Refusal.NO_IMU,
                    f'{WAITING_FRAMES} newer frames wait for the gyro',
                )
        if ready:
            self._changed.notify()

    def _corrected(self, span_ns: tuple[int, int]) -> tuple[int, int]:
        """Times of a frame's first and last row, with the corrections tracked by now."""
        return (
            span_ns[0] + self._offset_ns - self._margin_ns,
            span_ns[1] + self._offset_ns + self._margin_ns,
        )

    def _imu_reaches(self, end_ns: int) -> bool:
        """Whether gyro and accelerometer, which may have a topic each, have come to a time."""
        gyro_ns = self._buffer.gyro.newest_ns
        force_ns = self._buffer.force.newest_ns
        if gyro_ns is None or gyro_ns < end_ns:
            return False
        # Gravity must not depend on which of two topics came first.
        return (
            force_ns is None or force_ns >= end_ns or gyro_ns - force_ns > _ACCELEROMETER_STALE_NS
        )

    # -- refusals and jumps of a clock -------------------------------------------------------

    def _accepts(self, stamp_ns: int, end_ns: int) -> bool:
        """Whether a frame of this stamp may be added; if not, it is refused here.

        `end_ns` is the time of its last row. Time restarts with a frame whose clock jumped.
        """
        last_ns = self._last_stamp_ns
        if last_ns is not None and self._frame_order.is_wild(stamp_ns, last_ns):
            self._refuse(
                stamp_ns,
                Refusal.OUT_OF_ORDER,
                'the stamp of the frame is '
                f'{seconds_between(last_ns, stamp_ns):.0f} s from the one before, and '
                'no other is near it',
            )
            return False
        set_back = self._frame_order.is_set_back(stamp_ns, last_ns)
        if last_ns is None or stamp_ns > last_ns:
            return True
        if stamp_ns == last_ns:
            self._refuse(stamp_ns, Refusal.DUPLICATE, 'a frame of this stamp came before')
            return False
        back = seconds_between(stamp_ns, last_ns)
        if not set_back and last_ns - stamp_ns <= CLOCK_JUMP_NS:
            self._refuse(
                stamp_ns,
                Refusal.OUT_OF_ORDER,
                f'the frame is {back:.3f} s older than the one before',
            )
            return False
        self._restart(Refusal.CLOCK_JUMP, f'image stamps jumped back by {back:.3f} s')
        # The IMU may have jumped already, and then has the samples of this frame. After a small
        # step back it may hold samples of two times at once.
        newest_ns = self._buffer.newest_ns
        if set_back or (newest_ns is not None and newest_ns > end_ns + CLOCK_JUMP_NS):
            self._buffer.clear()
        return True

    def _refuse(self, stamp_ns: int, refusal: Refusal, reason: str) -> None:
        self._counts.refused[refusal] += 1
        self._refusals.append(FrameRefused(stamp_ns, refusal, reason))
        self._changed.notify()

    def _drop(self, queued: QueuedFrame, refusal: Refusal, reason: str) -> None:
        """Refuse a queued frame. If it has no IMU data, check whether the two clocks differ."""
        self._queue.remove(queued)
        # Offline, samples come in the order of their stamps, which shows nothing of the clocks.
        apart = '' if self._offline else timing.clocks_apart(queued.ahead)
        if apart and refusal in (Refusal.NO_IMU, Refusal.IMU_GAP):
            reason = f'{reason}: {apart}'
        self._refuse(queued.image.stamp_ns, refusal, reason)

    def _restart(self, refusal: Refusal, reason: str) -> None:
        """Refuse all frames in the queue: they belong to the time before."""
        self._generation += 1
        self._counts.clock_jumps += refusal is Refusal.CLOCK_JUMP
        while self._queue:
            self._drop(self._queue[0], refusal, reason)
        self._last_stamp_ns = self._previous_ns = None
        self._intervals = timing.FrameIntervals()


# -- Scatter of image stamps about an even rhythm: phones stamp some ms early or late -------------

# Frames over which the scatter is estimated: less is noise, more follows a change too late.
# [chosen: a second at 30 Hz]
SCATTER_FRAMES = 32
# The interval at this quantile of all contains no lost frame.
# [derived: less than three of four intervals are lost or doubled]
_WHOLE = 0.25
# A larger scatter, as a share of the interval, is a camera without a rhythm, or one whose images
# are stamped on arrival. [chosen: phones scatter by some ms of 33]
_LARGEST_SHARE = 0.1
# Correlation of consecutive intervals below which stamps are late: an interval that is too long
# makes the next one too short. A lower one would miss jitter, a higher one would take a camera
# that is triggered irregularly for one. [derived: -0.5 for errors of the stamps, 0 for a camera
# without a rhythm, both within 0.18 of 31 intervals]
_ALTERNATING = -0.3
# Fewest intervals that show it. [chosen: 8 to 15 would do]
_FEWEST_INTERVALS = 8
# Part of the usual interval by which an interval is long or short. Less would take the scatter of
# a phone for frames that are late, more would take late frames for lost ones.
# [chosen: 0.15 to 0.3 would do: 8 ms of 33]
_CLEARLY = 0.25
# Such frames among the last ones that show jitter. [chosen: one may be a moment of load]
_FEWEST_LATE = 2
# Mean magnitude of a normal variable by its sigma. [derived: sqrt(2 / pi)]
_MEAN_BY_SIGMA = math.sqrt(2.0 / math.pi)
# Sigma of the change from one interval to the next by that of a stamp. [derived: 1 + 4 + 1]
_CHANGE_BY_STAMP = math.sqrt(6.0)


class StampScatter(NamedTuple):
    """Scatter of the stamps of images about an even rhythm."""

    sigma: float  # [s] of a stamp
    is_jitter: bool  # whether stamps are late by much of an interval, as times of arrival are


def stamp_scatter(stamps_ns: Sequence[int]) -> StampScatter:
    """1 sigma of a stamp [s]; 0 for fewer than three stamps.

    Intervals d_i of stamps, corrected for lost frames, change by
    ``d_i+1 - d_i = e_i+2 - 2 e_i+1 + e_i`` for errors e of the stamps: six times their variance.
    A change of the rhythm, as by auto exposure, affects one of these differences only: the
    largest is left out of their mean square, which delays of single stamps make larger than their
    mean magnitude. Where stamps are late, intervals are not corrected: a late frame is not lost.
    """
    intervals = np.diff(np.array(stamps_ns)) / NANOSECONDS
    count = len(intervals)
    if count < 2:
        return StampScatter(0.0, is_jitter=False)
    period = float(np.sort(intervals)[int(_WHOLE * (count - 1))])
    if not period > 0.0:
        return StampScatter(0.0, is_jitter=False)
    sigma = _sigma_of_changes(intervals - np.round(intervals / period) * period)
    if _alternates(intervals) and (sigma > _LARGEST_SHARE * period or _comes_late(intervals)):
        return StampScatter(_sigma_of_changes(intervals), is_jitter=True)
    return StampScatter(min(sigma, _LARGEST_SHARE * period), is_jitter=False)


def _alternates(intervals: Array) -> bool:
    """Whether long and short intervals (N,) follow each other."""
    if len(intervals) < _FEWEST_INTERVALS:
        return False
    off = np.clip(intervals / np.median(intervals) - 1.0, -1.0, 1.0)
    return bool(np.mean(off[1:] * off[:-1]) < _ALTERNATING * np.mean(off**2))


def _comes_late(intervals: Array) -> bool:
    """Whether some intervals (N,) are as short as the one before is long: no frame is lost."""
    off = intervals / np.median(intervals) - 1.0
    late = (off[1:] < -_CLEARLY) & (off[:-1] > _CLEARLY)
    return bool(np.count_nonzero(late) >= _FEWEST_LATE)


def _sigma_of_changes(intervals: Array) -> float:
    """1 sigma of a stamp [s] by the changes of intervals (N,)."""
    changes = np.sort(np.abs(np.diff(intervals)))
    of_mean = float(changes.mean()) / _MEAN_BY_SIGMA
    of_squares = math.sqrt(float(np.mean(changes[:-1] ** 2))) if len(changes) > 1 else 0.0
    return max(of_mean, of_squares) / _CHANGE_BY_STAMP
