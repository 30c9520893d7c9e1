"""The sequencer: what is released when, and that nothing is lost unseen."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.front_end.frame import EncodedFrame, Frame
from rs_relpose_ros.front_end.sequencer import (
    FrameRefused,
    MAILBOX_FRAMES,
    ReadyFrame,
    Refusal,
    Sequencer,
    WAITING_FRAMES,
)
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.health.tracked import Applied
from rs_relpose_ros.images.encoded import CompressedImage
from rs_relpose_ros.imu.samples import ImuSample

MS = 1_000_000
SECOND = 1000 * MS
READOUT_NS = 20 * MS
START = 1_700_000_000 * SECOND
INTRINSICS = Intrinsics(width=32, height=20, fx=30.0, fy=30.0, cx=16.0, cy=10.0,
                        image_width=32, image_height=20)
IMAGE = np.zeros((20, 32), dtype=np.uint8)


class Clock:
    """A monotonic clock that stands still until it is moved."""

    def __init__(self) -> None:
        self.now_ns = 0

    def __call__(self) -> int:
        return self.now_ns


def parameters(**values: object) -> Parameters:
    return Parameters.from_mapping({
        'readout_time': READOUT_NS / SECOND, 'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0], **values})


def frame(ms: float, **changes: object) -> Frame:
    return Frame(START + round(ms * MS), IMAGE, 'camera', INTRINSICS)


def sample(ms: float, gyro: tuple[float, float, float] | None = (0.0, 0.5, 0.0),
           force: tuple[float, float, float] | None = (0.0, -9.81, 0.0)) -> ImuSample:
    return ImuSample(START + round(ms * MS), gyro, force)


def add_imu(sequencer: Sequencer, first_ms: int, last_ms: int, step_ms: int = 5) -> None:
    for ms in range(first_ms, last_ms + 1, step_ms):
        sequencer.add_imu(sample(ms))


def stamps(items: list[ReadyFrame | FrameRefused]) -> list[float]:
    return [(item.frame.stamp_ns - START) / MS for item in items if isinstance(item, ReadyFrame)]


def drain(sequencer: Sequencer) -> list[ReadyFrame | FrameRefused]:
    items = []
    while (item := sequencer.take()) is not None:
        items.append(item)
        assert len(items) < 10_000
    return items


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def live(clock: Clock) -> Sequencer:
    return Sequencer(parameters(), clock=clock)


@pytest.fixture
def offline() -> Sequencer:
    return Sequencer(parameters(), offline=True)


def test_a_frame_waits_for_its_last_row(live):
    add_imu(live, 0, 100)
    live.add_frame(frame(90))
    # The last row is read at 90 + 20 * 19/20 = 109 ms.
    live.add_imu(sample(105))
    assert live.take() is None
    live.add_imu(sample(108.9))
    assert live.take() is None
    live.add_imu(sample(109))
    ready = live.take()
    assert isinstance(ready, ReadyFrame)
    assert ready.frame.stamp_ns == START + 90 * MS
    assert live.take() is None


@pytest.mark.parametrize(('values', 'last_row_ms'), [
    ({'time_offset': 0.03}, 139.0),
    ({'time_offset': -0.03}, 79.0),
    ({'stamp_row': 'last'}, 90.0),
    ({'readout_direction': 'up', 'stamp_row': 'last'}, 109.0),
    ({'stamp_exposure': 'start', 'exposure_time': 0.01}, 114.0),
    ({'readout_time': 0.0}, 90.0),
])
def test_the_last_row_follows_the_time_model(clock, values, last_row_ms):
    sequencer = Sequencer(parameters(**values), clock=clock)
    add_imu(sequencer, 0, 50)
    sequencer.add_frame(frame(90))
    for ms in np.arange(55, last_row_ms - 0.5, 5):
        sequencer.add_imu(sample(float(ms)))
    sequencer.add_imu(sample(last_row_ms - 0.1))
    assert sequencer.take() is None
    sequencer.add_imu(sample(last_row_ms + 0.1))
    assert isinstance(sequencer.take(), ReadyFrame)


def test_the_imu_of_a_frame_is_in_the_camera_frame(clock):
    R = Rotation.from_euler('xyz', [0.3, -0.4, 1.0])
    sequencer = Sequencer(parameters(quat_cam_imu_xyzw=list(R.as_quat())), clock=clock)
    for ms in range(0, 200, 5):
        sequencer.add_imu(sample(ms, gyro=(0.0, 0.0, 0.0)))
    sequencer.add_frame(frame(50))
    sequencer.add_frame(frame(100))
    first, second = drain(sequencer)
    assert first.imu.since_previous is None
    # At rest the specific force points up, gravity down.
    gravity = second.imu.motion.gravity
    np.testing.assert_allclose(
        gravity / np.linalg.norm(gravity), R.apply([0.0, 1.0, 0.0]), atol=1e-9)
    segment = second.imu.since_previous
    assert segment.stamps_ns[0] == START + 50 * MS
    assert segment.stamps_ns[-1] == START + 100 * MS


def test_the_segment_spans_to_the_last_processed_frame(live):
    """A frame that was refused must not tear the chain of gyro segments."""
    add_imu(live, 0, 400)

    live.add_frame(frame(100))
    corrupt = CompressedImage(np.zeros(50, dtype=np.uint8), 'jpeg')
    live.add_frame(EncodedFrame(START + 150 * MS, corrupt, 'camera', INTRINSICS))
    live.add_frame(frame(200))
    first, refused, second = drain(live)
    assert isinstance(first, ReadyFrame)
    assert (refused.cause, refused.reason) == (
        Refusal.BAD_IMAGE, 'compressed image of 50 bytes is neither JPEG nor PNG')
    assert second.imu.since_previous.stamps_ns[0] == first.imu.reference_ns


def test_overload_drops_the_oldest_and_counts_it(live):
    add_imu(live, 0, 1000)
    for k in range(8):
        live.add_frame(frame(100 * k))
    items = drain(live)
    assert stamps(items) == [100.0 * k for k in range(8 - MAILBOX_FRAMES, 8)]
    refused = [item for item in items if isinstance(item, FrameRefused)]
    assert [item.stamp_ns - START for item in refused] == [
        100 * k * MS for k in range(8 - MAILBOX_FRAMES)]
    assert {item.cause for item in refused} == {Refusal.OVERLOAD}
    counts = live.counts()
    assert counts.refused == {Refusal.OVERLOAD: 8 - MAILBOX_FRAMES}
    assert counts.frames == 8 == counts.frames_taken + sum(counts.refused.values())


def test_frames_that_wait_for_the_imu_are_not_overload(live):
    add_imu(live, 0, 5)
    for k in range(WAITING_FRAMES + 2):
        live.add_frame(frame(100 + 10 * k))
    assert live.counts().refused == {Refusal.NO_IMU: 2}


def test_offline_drops_nothing(offline):
    for k in range(500):
        offline.add_frame(frame(33 * k))
    assert drain(offline) == []
    items = []
    for ms in range(0, 33 * 500, 10):
        offline.add_imu(sample(ms))
        items += drain(offline)
    assert stamps(items) == [33.0 * k for k in range(500)]
    assert offline.counts().refused == {}


def test_offline_needs_no_clock_and_ends(offline):
    add_imu(offline, 0, 100)
    offline.add_frame(frame(50))
    offline.add_frame(frame(90))
    started = time.monotonic()
    assert isinstance(offline.take(timeout=60.0), ReadyFrame)
    assert offline.take(timeout=60.0) is None
    assert time.monotonic() - started < 10.0
    offline.close()
    refused = offline.take()
    assert refused.cause is Refusal.NO_IMU
    assert offline.take() is None


def test_a_gap_in_the_gyro_refuses_the_frame(live):
    add_imu(live, 0, 100)
    add_imu(live, 200, 400)
    for ms in (50, 90, 110, 250):
        live.add_frame(frame(ms))
    *refused, first, second = drain(live)
    assert stamps([first, second]) == [50.0, 250.0]
    assert [item.cause for item in refused] == [Refusal.IMU_GAP] * 2
    assert live.counts().imu_gaps == 1
    # Over the gap there is no turn.
    assert second.imu.since_previous is None


def test_frames_before_the_first_sample_are_refused(live):
    live.add_frame(frame(0))
    assert live.take() is None
    add_imu(live, 10, 100)
    assert live.take().cause is Refusal.IMU_GAP


@pytest.mark.parametrize('accelerometer', [False, True])
def test_no_gyro_is_told_after_a_while(live, clock, accelerometer):
    live.add_frame(frame(0))
    for ms in range(-50, 200, 5) if accelerometer else ():
        live.add_imu(sample(ms, gyro=None))
    assert live.take() is None
    clock.now_ns += 999 * MS
    assert live.take() is None
    clock.now_ns += 2 * MS
    refused = live.take()
    assert refused.cause is Refusal.NO_IMU
    assert 'no gyro sample' in refused.reason


def test_duplicates_and_stragglers_are_refused(live):
    add_imu(live, 0, 1000)
    for ms in (100, 200, 200, 150, 300):
        live.add_frame(frame(ms))
    items = drain(live)
    assert stamps(items) == [100.0, 200.0, 300.0]
    assert [item.cause for item in items if isinstance(item, FrameRefused)] == [
        Refusal.DUPLICATE, Refusal.OUT_OF_ORDER]


def test_an_unusable_sample_changes_nothing(live):
    add_imu(live, 0, 50)
    with pytest.raises(InputError, match='finite'):
        live.add_imu(sample(55, gyro=(float('nan'), 0.0, 0.0)))
    add_imu(live, 55, 100)
    live.add_frame(frame(40))
    assert isinstance(live.take(), ReadyFrame)
    assert live.counts().imu_samples == 21


@pytest.mark.parametrize('imu_first', [True, False])
def test_a_bag_that_loops_starts_anew(live, imu_first):
    add_imu(live, 0, 5000, 10)
    live.add_frame(frame(4900))
    live.add_frame(frame(4990))   # waits for the IMU
    assert not drain(live)[0].restart
    if imu_first:
        add_imu(live, 0, 200)
        live.add_frame(frame(100))
    else:
        live.add_frame(frame(100))
        add_imu(live, 0, 200)
    items = drain(live)
    assert [item.cause for item in items[:-1]] == [Refusal.CLOCK_JUMP]
    ready = items[-1]
    assert isinstance(ready, ReadyFrame)
    assert ready.restart
    assert ready.imu.since_previous is None
    add_imu(live, 205, 300)
    live.add_frame(frame(200))
    assert not live.take().restart
    assert live.counts().clock_jumps in (1, 2)


def test_a_stamp_far_ahead_does_not_stop_the_node(live, clock):
    add_imu(live, 0, 200)
    live.add_frame(frame(100_000))
    live.add_frame(frame(100))
    items = drain(live)
    assert [item.cause for item in items[:-1]] == [Refusal.CLOCK_JUMP]
    assert stamps(items) == [100.0]


def test_an_imu_stamp_far_ahead_does_not_stop_the_node(live):
    add_imu(live, 0, 200)
    live.add_imu(sample(100_000))
    add_imu(live, 205, 400)
    live.add_frame(frame(300))
    assert stamps(drain(live)) == [300.0]


def test_separate_topics_wait_for_both(live):
    """Whether gyro or accelerometer comes first must not change gravity."""
    for ms in range(0, 101, 5):
        live.add_imu(sample(ms, force=None))
        if ms <= 80:
            live.add_imu(sample(ms, gyro=None))
    live.add_frame(frame(75))
    assert live.take() is None
    live.add_imu(sample(94, gyro=None))
    assert isinstance(live.take(), ReadyFrame)


def test_an_accelerometer_that_stopped_is_not_waited_for(live):
    add_imu(live, 0, 100)
    for ms in range(105, 300, 5):
        live.add_imu(sample(ms, force=None))
    live.add_frame(frame(150))
    assert isinstance(live.take(), ReadyFrame)


def test_latency_counts_from_the_later_of_image_and_imu(live, clock):
    clock.now_ns = 5
    add_imu(live, 0, 200)
    clock.now_ns = 7
    live.add_frame(frame(100))
    clock.now_ns = 9
    live.add_frame(frame(190))
    clock.now_ns = 11
    live.add_imu(sample(205))
    clock.now_ns = 13
    live.add_imu(sample(210))
    clock.now_ns = 15
    first, second = drain(live)
    assert (first.ready_ns, second.ready_ns) == (7, 13)


def test_interleaving_does_not_change_the_answer():
    """Live asks early, late, or skips frames: what it gets is what a replay gets, bit by bit."""
    rng = np.random.default_rng(1)
    up = np.array([0.0, -9.8, 0.0])
    samples = [sample(5 * k, tuple(rng.normal(size=3)), tuple(rng.normal(size=3) + up))
               for k in range(400)]
    patient, eager = (Sequencer(parameters(), offline=True) for _ in range(2))
    for item in samples:
        patient.add_imu(item)
    for ms in range(33, 1900, 66):
        patient.add_frame(frame(ms))
    late = drain(patient)
    early = []
    waiting = [frame(ms) for ms in range(33, 1900, 66)]
    for item in samples:
        if waiting and item.stamp_ns > waiting[0].stamp_ns:
            eager.add_frame(waiting.pop(0))
        eager.add_imu(item)
        early += drain(eager)
    assert len(early) == len(late) == 29
    for a, b in zip(early, late, strict=True):
        np.testing.assert_array_equal(a.imu.motion.gravity, b.imu.motion.gravity)
        np.testing.assert_array_equal(a.imu.motion.knot_rotations, b.imu.motion.knot_rotations)
        if a.imu.since_previous is not None:
            np.testing.assert_array_equal(a.imu.since_previous.angular_velocities,
                                          b.imu.since_previous.angular_velocities)


def test_threads():
    """One thread feeds, another takes: every frame comes out once, in order, or is counted."""
    sequencer = Sequencer(parameters())
    items: list[ReadyFrame | FrameRefused] = []

    def work() -> None:
        while (item := sequencer.take(timeout=5.0)) is not None:
            items.append(item)

    worker = threading.Thread(target=work)
    worker.start()
    for ms in range(0, 4000, 5):
        sequencer.add_imu(sample(ms))
        if ms % 20 == 0:
            sequencer.add_frame(frame(ms))
    sequencer.close()
    worker.join(timeout=20.0)
    assert not worker.is_alive()
    processed = stamps(items)
    assert processed == sorted(set(processed))
    assert len(processed) > 0
    assert len(items) == 200
    counts = sequencer.counts()
    assert counts.frames == 200 == counts.frames_taken + sum(counts.refused.values())


def test_sensor_settings_are_needed():
    with pytest.raises(MissingInputError, match='quat_cam_imu_xyzw'):
        Sequencer(Parameters.from_mapping({'readout_time': 0.03}))


def test_a_clock_that_is_set_back_by_less_than_a_second(live):
    """Neither late messages nor a jump by their size; two times must not mix."""
    add_imu(live, 0, 1000)
    for ms in range(100, 1000, 100):
        live.add_frame(frame(ms))
    drain(live)
    items = []
    for ms in range(600, 960, 5):
        live.add_imu(sample(ms))
        if ms % 30 == 0:
            live.add_frame(frame(ms))
        items += drain(live)
    refused = [item.cause for item in items if isinstance(item, FrameRefused)]
    assert refused.count(Refusal.OUT_OF_ORDER) == 2
    first, *others = (item for item in items if isinstance(item, ReadyFrame))
    assert first.restart
    assert not any(item.restart for item in others)
    # The third frame tells, and IMU from then on is needed.
    assert stamps(items) == [690.0 + 30.0 * k for k in range(9)]
    assert live.counts().clock_jumps == 1


def test_stragglers_are_no_clock_set_back(live):
    for k in range(0, 100, 2):
        live.add_imu(sample(5 * k + 5))
        live.add_imu(sample(5 * k))
    assert live.counts().clock_jumps == 0


def test_a_gap_does_not_count_as_waiting_for_the_worker(live):
    """All frames of a gap are known for lost at once, when the gyro comes back."""
    add_imu(live, 0, 100)
    for k in range(10):
        live.add_frame(frame(110 + 30 * k))
    add_imu(live, 500, 600)
    assert live.counts().refused == {Refusal.IMU_GAP: 10}


STEADY = tuple(range(0, 300, 5))


@pytest.mark.parametrize('order, repeated, late, gaps', [
    (STEADY, 0, 0, 0),
    ([ms for ms in STEADY for _ in range(2)], 60, 0, 0),
    ([*STEADY[:20], STEADY[21], STEADY[20], *STEADY[22:]], 0, 1, 0),
    ([*STEADY[:40], *STEADY[55:]], 0, 0, 1),
], ids=['steady', 'repeated', 'late', 'gap'])
def test_imu_stamps_are_counted_and_change_no_frame_elsewhere(order, repeated, late, gaps):
    knots = []
    for stamps_ms in (STEADY, order):
        sequencer = Sequencer(parameters(), offline=True)
        for ms in stamps_ms:
            sequencer.add_imu(sample(ms, gyro=(0.1, 0.5, 0.01 * ms)))
        sequencer.add_frame(frame(100))
        knots.append(sequencer.take().imu.motion.knot_rotations)
    counts = sequencer.counts()
    assert (counts.imu_repeated, counts.imu_late, counts.imu_gaps) == (repeated, late, gaps)
    np.testing.assert_array_equal(*knots)


def test_two_topics_are_not_late_to_each_other(live):
    for ms in STEADY:
        live.add_imu(sample(ms, force=None))
        live.add_imu(sample(ms - 2, gyro=None))
    assert live.counts().imu_late == 0


# -- offset by the interval --------------------------------------------------------------------

BY_INTERVAL = {'time_offset_per_interval': -0.5, 'time_offset_reference_interval': 0.04}


def first_rows(sequencer: Sequencer) -> list[float]:
    """Instants of the first rows of what is ready, after their stamps [ms]."""
    return [(ready.imu.reference_ns - ready.frame.stamp_ns) / MS
            for ready in drain(sequencer) if isinstance(ready, ReadyFrame)]


def test_offset_follows_the_interval_to_the_frame_before():
    sequencer = Sequencer(parameters(**BY_INTERVAL), offline=True)
    add_imu(sequencer, 0, 500)
    for ms in (50, 90, 140, 190, 300, 350):
        sequencer.add_frame(frame(ms))
    # The first frame has no interval; 110 ms after 50 ms are frames lost.
    assert first_rows(sequencer) == [0.0, 0.0, -5.0, -5.0, -5.0, -5.0]


def test_offset_by_interval_is_that_of_the_live_node_where_frames_are_dropped(clock):
    stamps_ms = [50, 90, 130, 170, 220, 270, 320, 370, 430, 490]
    live = Sequencer(parameters(**BY_INTERVAL), clock=clock)
    add_imu(live, 0, 600)
    for ms in stamps_ms:
        live.add_frame(frame(ms))
    ready = [item for item in drain(live) if isinstance(item, ReadyFrame)]
    assert len(ready) == MAILBOX_FRAMES < len(stamps_ms)
    # Replayed with the stamps that the node processed, the others are passed over.
    kept = {item.frame.stamp_ns for item in ready}
    replay = Sequencer(parameters(**BY_INTERVAL), offline=True)
    add_imu(replay, 0, 600)
    for ms in stamps_ms:
        if frame(ms).stamp_ns in kept:
            replay.add_frame(frame(ms))
        else:
            replay.pass_over(frame(ms).stamp_ns)
    assert first_rows(replay) == [(item.imu.reference_ns - item.frame.stamp_ns) / MS
                                  for item in ready]


def test_a_frame_of_a_longer_interval_waits_for_its_own_last_row():
    sequencer = Sequencer(parameters(time_offset_per_interval=1.0,
                                     time_offset_reference_interval=0.04), offline=True)
    add_imu(sequencer, 0, 160)
    for ms in (50, 90, 140):
        sequencer.add_frame(frame(ms))
    # 140 + 10 + 19 = 169 ms.
    assert stamps(drain(sequencer)) == [50.0, 90.0]
    sequencer.add_imu(sample(165))
    assert sequencer.take() is None
    sequencer.add_imu(sample(170))
    assert stamps(drain(sequencer)) == [140.0]


# -- figures that are tracked ------------------------------------------------------------------


def since_start_ms(*instants_ns: int) -> list[float]:
    return [(ns - START) / MS for ns in instants_ns]


@pytest.mark.parametrize('offline', [False, True])
def test_a_shifted_frame_waits_for_its_shifted_rows(offline):
    sequencer = Sequencer(parameters(), offline=offline, clock=Clock())
    for ms in (50, 100):
        sequencer.add_frame(frame(ms))
    # Both are ready at 119 ms; then the second one is moved by 20 ms.
    add_imu(sequencer, 0, 120)
    first = sequencer.take()
    assert since_start_ms(first.imu.reference_ns) == [50]
    assert first.imu.applied_offset_ns == 0
    sequencer.apply(Applied(0.02))
    assert sequencer.take() is None
    add_imu(sequencer, 125, 135)
    assert sequencer.take() is None
    add_imu(sequencer, 140, 140)
    second = sequencer.take()
    assert since_start_ms(second.imu.reference_ns) == [120]
    assert second.imu.applied_offset_ns == 20 * MS
    turned = second.imu.since_previous.stamps_ns
    assert since_start_ms(turned[0], turned[-1]) == [50, 120]
    # Backwards by more than the gyro knows: a gap, as for any frame.
    sequencer.apply(Applied(-0.2))
    sequencer.add_frame(frame(150))
    assert sequencer.take().cause is Refusal.IMU_GAP


def test_a_frame_of_a_longer_readout_waits_for_its_rows(live):
    live.add_frame(frame(50))
    add_imu(live, 0, 70)
    live.apply(Applied(readout_time=0.004, margin=0.0045))
    assert live.take() is None
    add_imu(live, 75, 75)
    ready = live.take()
    # The rows end at 69 ms as told; the stamped one stays.
    assert since_start_ms(ready.imu.reference_ns) == [50]
    times = ready.imu.motion.knot_times
    assert (times[0], times[-1]) == (pytest.approx(-0.0045), pytest.approx(0.0235))
