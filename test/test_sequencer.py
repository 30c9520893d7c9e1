"""The sequencer: which frames are released when, and that each one is released or counted."""

import time

from conftest import Clock
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import MissingInputError
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.pipeline import sequencer as module
from rs_relpose_ros.pipeline.monitor import Applied
from rs_relpose_ros.pipeline.pair import Frame
from rs_relpose_ros.pipeline.sequencer import FrameRefused, MAILBOX_FRAMES, Refusal, Sequencer
from rs_relpose_ros.tracking.images import CompressedImage, RawImage

MS = 1_000_000
SECOND = 1000 * MS
READOUT_NS = 20 * MS
START = 1_700_000_000 * SECOND
INTRINSICS = Intrinsics(
    width=32, height=20, fx=30.0, fy=30.0, cx=16.0, cy=10.0, image_width=32, image_height=20
)
IMAGE = np.zeros((20, 32), dtype=np.uint8)


def parameters(**values):
    return Parameters.from_mapping(
        {'readout_time': READOUT_NS / SECOND, 'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0], **values}
    )


def replaying(**values):
    return Sequencer(parameters(**values), offline=True)


def add_frames(sequencer, *times_ms):
    for ms in times_ms:
        sequencer.add_frame(RawImage.of_gray(IMAGE, START + round(ms * MS), 'camera'), INTRINSICS)


def sample(ms, gyro=(0.0, 0.5, 0.0), force=(0.0, -9.81, 0.0)):
    return ImuSample(START + round(ms * MS), gyro, force)


def add_imu(sequencer, first_ms, last_ms, step_ms=5, **values):
    for ms in range(first_ms, last_ms + 1, step_ms):
        sequencer.add_imu(sample(ms, **values))


def drain(sequencer):
    return list(iter(sequencer.take, None))


def since_start(*times_ns):
    return [(ns - START) / MS for ns in times_ns]


def stamps(items):
    return since_start(*(item.stamp_ns for item in items if isinstance(item, Frame)))


def refusals(items):
    return [item.refusal for item in items if isinstance(item, FrameRefused)]


@pytest.fixture
def live(clock):
    return Sequencer(parameters(), clock=clock)


@pytest.mark.parametrize(
    ('values', 'last_row_ms'),
    [
        ({}, 109.0),  # the last row is read at 90 + 20 * 19/20 ms
        ({'time_offset': 0.03}, 139.0),
        ({'time_offset': -0.03}, 79.0),
        ({'stamp_row': 'last'}, 90.0),
        ({'readout_direction': 'up', 'stamp_row': 'last'}, 109.0),
        ({'stamp_exposure': 'start', 'exposure_time': 0.01}, 119.0),
        ({'exposure_time': 0.01}, 114.0),
        ({'readout_time': 0.0}, 90.0),
    ],
)
def test_a_frame_waits_for_the_end_of_its_exposure(clock, values, last_row_ms):
    sequencer = Sequencer(parameters(**values), clock=clock)
    add_imu(sequencer, 0, 50)
    add_frames(sequencer, 90)
    for ms in (*np.arange(55, last_row_ms - 0.5, 5), last_row_ms - 0.1):
        sequencer.add_imu(sample(ms))
        assert sequencer.take() is None
    sequencer.add_imu(sample(last_row_ms + 0.1))
    assert stamps(drain(sequencer)) == [90.0]


def test_the_segment_spans_to_the_last_processed_frame(live):
    """A refused frame must not interrupt the chain of gyro segments."""
    add_imu(live, 0, 400)
    add_frames(live, 100)
    live.add_frame(
        CompressedImage(np.zeros(50, dtype=np.uint8), 'jpeg', START + 150 * MS), INTRINSICS
    )
    add_frames(live, 200)
    first, refused, second = drain(live)
    assert (refused.refusal, refused.reason) == (
        Refusal.BAD_IMAGE,
        'compressed image of 50 bytes is neither JPEG nor PNG',
    )
    assert second.imu.since_previous.stamps_ns[0] == first.imu.reference_ns


def test_separate_topics_wait_for_both(live):
    """The order of gyro and accelerometer must not change gravity."""
    add_imu(live, 0, 100, force=None)
    add_imu(live, 0, 80, gyro=None)
    add_frames(live, 75)
    assert live.take() is None
    live.add_imu(sample(94, gyro=None))
    assert stamps(drain(live)) == [75.0]
    # An accelerometer that stopped is not waited for.
    add_imu(live, 105, 300, force=None)
    add_frames(live, 150)
    assert stamps(drain(live)) == [150.0]
    assert live.counts().imu_late == 0


def test_latency_counts_from_the_later_of_image_and_imu(live, clock):
    clock.now = 5
    add_imu(live, 0, 200)
    clock.now = 7
    add_frames(live, 100, 190)
    for ms, clock.now in ((205, 11), (210, 13)):
        live.add_imu(sample(ms))
    clock.now = 15
    assert [frame.ready_ns for frame in drain(live)] == [7, 13]


@pytest.mark.parametrize(
    ('imu_until', 'times_ms', 'refusal', 'released'),
    [
        # Too slow a worker: the oldest are dropped.
        (1000, range(0, 800, 100), Refusal.OVERLOAD, MAILBOX_FRAMES),
        # Frames that wait for the IMU are not overload.
        (
            5,
            range(100, 120 + 10 * module.WAITING_FRAMES, 10),
            Refusal.NO_IMU,
            module.WAITING_FRAMES,
        ),
    ],
)
def test_the_queue_is_bounded_and_the_oldest_are_counted(
    live, imu_until, times_ms, refusal, released
):
    add_imu(live, 0, imu_until)
    add_frames(live, *times_ms)
    add_imu(live, imu_until, 400)
    dropped = len(times_ms) - released
    counts = live.counts()
    assert counts.refused[refusal] == dropped
    items = drain(live)
    assert since_start(*(item.stamp_ns for item in items[:dropped])) == list(times_ms[:dropped])
    assert set(refusals(items[:dropped])) == {refusal}
    counts = live.counts()
    assert counts.frames == len(times_ms) == counts.frames_taken + sum(counts.refused.values())


def test_offline_drops_nothing_and_needs_no_clock():
    offline = replaying()
    items = []
    times_ms = [33 * k for k in range(100)]
    add_frames(offline, *times_ms)
    for ms in range(0, 33 * 99 + 10, 10):
        offline.add_imu(sample(ms))
        items += drain(offline)
    assert stamps(items) == times_ms[:-1]
    started = time.monotonic()
    assert offline.take(timeout=60.0) is None
    assert time.monotonic() - started < 10.0
    assert not offline.counts().refused
    offline.close()
    assert refusals(drain(offline)) == [Refusal.NO_IMU]


@pytest.mark.parametrize('accelerometer', [False, True])
def test_no_gyro_is_reported_after_a_while(live, clock, accelerometer):
    add_frames(live, 0)
    if accelerometer:
        add_imu(live, -50, 200, gyro=None)
    for wait_ms, refused in ((0, []), (999, []), (2, [Refusal.NO_IMU])):
        clock.now += wait_ms * MS
        assert refusals(drain(live)) == refused


def test_sensor_parameters_are_required():
    with pytest.raises(MissingInputError, match='quat_cam_imu_xyzw'):
        Sequencer(Parameters.from_mapping({'readout_time': 0.03}))


def imu(first_ms, last_ms, step_ms=5):
    return range(first_ms, last_ms + 1, step_ms)


# Frames by their times, and the times of IMU samples; of the frames that are released those that
# restart the tracking, and those without the gyro since the frame before.
@pytest.mark.parametrize(
    ('events', 'released', 'restarted', 'alone', 'refused', 'gaps', 'jumps'),
    [
        (
            (imu(0, 1000), 100, 200, 200, 150, 300),
            [100, 200, 300],
            [],
            [100],
            [Refusal.DUPLICATE, Refusal.OUT_OF_ORDER],
            0,
            0,
        ),
        # More frames in the gap than may wait for the worker: it is no overload.
        (
            (-5, imu(0, 100), 50, *range(90, 210, 15), imu(200, 400), 250),
            [50, 250],
            [],
            [50, 250],
            [Refusal.IMU_GAP] * 9,
            1,
            0,
        ),
        # A bag that loops, while a frame waits for its IMU.
        (
            (imu(0, 5000, 10), 4900, 4990, imu(0, 200), 100, imu(205, 300), 200),
            [4900, 100, 200],
            [100],
            [4900, 100],
            [Refusal.CLOCK_JUMP],
            0,
            1,
        ),
        (
            (imu(0, 5000, 10), 4900, 4990, 100, imu(0, 200), imu(205, 300), 200),
            [4900, 100, 200],
            [100],
            [4900, 100],
            [Refusal.CLOCK_JUMP],
            0,
            1,
        ),
        # Single stamps far ahead, of a frame, then of the IMU; a frame of stamp zero.
        (
            (
                imu(20_000, 20_200),
                20_050,
                100_000,
                20_100,
                [100_000],
                imu(20_205, 20_400),
                0,
                20_300,
            ),
            [20_050, 20_100, 20_300],
            [],
            [20_050],
            [Refusal.OUT_OF_ORDER] * 2,
            0,
            0,
        ),
        # Clocks that jump ahead: of two stamps the first is not used.
        (
            (imu(0, 200), 100, imu(100_000, 100_400), 100_100, 100_200),
            [100, 100_200],
            [],
            [100, 100_200],
            [Refusal.OUT_OF_ORDER],
            1,
            0,
        ),
    ],
)
def test_frames_are_released_restarted_or_refused_at_gaps_and_jumps(
    live, events, released, restarted, alone, refused, gaps, jumps
):
    items = []
    for event in events:
        if isinstance(event, int):
            add_frames(live, event)
        else:
            for ms in event:
                live.add_imu(sample(ms))
        items += drain(live)
    assert stamps(items) == released
    assert refusals(items) == refused
    frames = [item for item in items if isinstance(item, Frame)]
    assert stamps(item for item in frames if item.restart) == restarted
    assert stamps(item for item in frames if item.imu.since_previous is None) == alone
    assert (live.counts().imu_gaps, live.counts().clock_jumps) == (gaps, jumps)


def test_a_clock_that_is_set_back_by_less_than_a_second(live):
    """Neither late messages nor a jump by their size; two times must not mix."""
    add_imu(live, 0, 1000)
    add_frames(live, *range(100, 1000, 100))
    drain(live)
    items = []
    for ms in range(600, 960, 5):
        live.add_imu(sample(ms))
        if ms % 30 == 0:
            add_frames(live, ms)
        items += drain(live)
    assert refusals(items).count(Refusal.OUT_OF_ORDER) == 2
    first, *others = (item for item in items if isinstance(item, Frame))
    assert first.restart
    assert not any(item.restart for item in others)
    # The third frame decides, and requires the IMU from then on.
    assert stamps(items) == [690.0 + 30.0 * k for k in range(9)]
    assert live.counts().clock_jumps == 1


STEADY = tuple(range(0, 300, 5))


@pytest.mark.parametrize(
    'order, repeated, late, gaps',
    [
        (STEADY, 0, 0, 0),
        ([ms for ms in STEADY for _ in range(2)], 60, 0, 0),
        ([*STEADY[:20], STEADY[21], STEADY[20], *STEADY[22:]], 0, 1, 0),
        ([STEADY[k ^ 1] for k in range(60)], 0, 30, 0),
        ([*STEADY[:40], *STEADY[55:]], 0, 0, 1),
    ],
    ids=['steady', 'repeated', 'late', 'each second one late', 'gap'],
)
def test_imu_stamps_are_counted_and_change_no_frame_elsewhere(order, repeated, late, gaps):
    knots = []
    for stamps_ms in (STEADY, order):
        sequencer = replaying()
        for ms in stamps_ms:
            sequencer.add_imu(sample(ms, gyro=(0.1, 0.5, 0.01 * ms)))
        add_frames(sequencer, 100)
        knots.append(sequencer.take().imu.motion.path.rotations)
    counts = sequencer.counts()
    assert (counts.imu_repeated, counts.imu_late, counts.imu_gaps, counts.clock_jumps) == (
        repeated,
        late,
        gaps,
        0,
    )
    np.testing.assert_array_equal(*knots)


@settings(max_examples=30)
@given(
    early=st.lists(st.integers(0, 30), min_size=14, max_size=14),
    takes=st.sets(st.integers(0, 199)),
)
def test_interleaving_does_not_change_the_result(early, takes):
    """However early images come, and whenever frames are taken: IMU data are equal bit by bit."""
    rng = np.random.default_rng(1)
    samples = [
        sample(5 * k, tuple(rng.normal(size=3)), tuple(rng.normal(size=3) - [0, 9.8, 0]))
        for k in range(200)
    ]
    times_ms = list(range(33, 957, 66))
    patient = replaying()
    eager = replaying()
    items = []
    for one in samples:
        patient.add_imu(one)
    add_frames(patient, *times_ms)
    due = np.maximum.accumulate([ms // 5 - k for ms, k in zip(times_ms, early, strict=True)])
    for k, one in enumerate(samples):
        add_frames(
            eager,
            *(ms for ms, at in zip(times_ms, due, strict=True) if at == k or (k == 0 and at < 0)),
        )
        eager.add_imu(one)
        items += drain(eager) if k in takes else []
    items += drain(eager)
    expected = drain(patient)
    assert len(items) == len(expected) == 14
    for a, b in zip(items, expected, strict=True):
        assert a.stamp_ns == b.stamp_ns
        np.testing.assert_array_equal(a.imu.motion.gravity, b.imu.motion.gravity)
        np.testing.assert_array_equal(a.imu.motion.path.rotations, b.imu.motion.path.rotations)
        if a.imu.since_previous is not None:
            np.testing.assert_array_equal(
                a.imu.since_previous.angular_velocities, b.imu.since_previous.angular_velocities
            )


BY_INTERVAL = {'time_offset_per_interval': -0.5, 'time_offset_reference_interval': 0.04}


def offsets(sequencer):
    """Times of the first rows of released frames, after their stamps [ms]."""
    return [
        (item.imu.reference_ns - item.stamp_ns) / MS
        for item in drain(sequencer)
        if isinstance(item, Frame)
    ]


def test_the_offset_follows_the_interval_to_the_frame_before():
    sequencer = replaying(**BY_INTERVAL)
    add_imu(sequencer, 0, 500)
    add_frames(sequencer, 50, 90, 140, 190, 300, 350)
    # The first frame has no interval; 110 ms after 50 ms are frames lost.
    assert offsets(sequencer) == [0.0, 0.0, -5.0, -5.0, -5.0, -5.0]


def test_the_offset_by_interval_is_that_of_the_live_node_if_frames_are_dropped(clock):
    times_ms = [50, 90, 130, 170, 220, 270, 320, 370, 430, 490]
    live = Sequencer(parameters(**BY_INTERVAL), clock=clock)
    replay = replaying(**BY_INTERVAL)
    for sequencer in (live, replay):
        add_imu(sequencer, 0, 600)
    add_frames(live, *times_ms)
    # Replayed with the stamps that the node processed, the others are passed over.
    for ms in times_ms[:-MAILBOX_FRAMES]:
        replay.pass_over(START + ms * MS)
    add_frames(replay, *times_ms[-MAILBOX_FRAMES:])
    found = offsets(live)
    assert len(found) == MAILBOX_FRAMES
    assert offsets(replay) == found


def test_a_frame_of_a_longer_interval_waits_for_its_own_last_row():
    sequencer = replaying(time_offset_per_interval=1.0, time_offset_reference_interval=0.04)
    add_imu(sequencer, 0, 160)
    add_frames(sequencer, 50, 90, 140)
    assert stamps(drain(sequencer)) == [50.0, 90.0]
    for ms, released in ((165, []), (170, [140.0])):  # 140 + 10 + 19 = 169 ms
        sequencer.add_imu(sample(ms))
        assert stamps(drain(sequencer)) == released


@pytest.mark.parametrize('offline', [False, True])
def test_a_shifted_frame_waits_for_its_shifted_rows(offline):
    sequencer = Sequencer(parameters(), offline=offline, clock=Clock())
    add_frames(sequencer, 50, 100)
    # Both are ready at 119 ms; then the second one is moved by 20 ms.
    add_imu(sequencer, 0, 120)
    first = sequencer.take()
    sequencer.apply(Applied(0.02))
    assert sequencer.take() is None
    add_imu(sequencer, 125, 135)
    assert sequencer.take() is None
    add_imu(sequencer, 140, 190)
    add_frames(sequencer, 150)
    frames = [first, *drain(sequencer)]
    assert since_start(*(frame.imu.reference_ns for frame in frames)) == [50, 120, 170]
    assert [frame.applied_offset_ns for frame in frames] == [0, 20 * MS, 20 * MS]
    assert [since_start(*frame.imu.since_previous.stamps_ns[[0, -1]]) for frame in frames[1:]] == [
        [50, 120],
        [120, 170],
    ]
    # Backwards by more than the gyro covers: a gap, as for any frame.
    sequencer.apply(Applied(-0.3))
    add_frames(sequencer, 200)
    assert refusals(drain(sequencer)) == [Refusal.IMU_GAP]


def test_a_frame_of_a_longer_readout_waits_for_its_rows(live):
    add_frames(live, 50)
    add_imu(live, 0, 70)
    live.apply(Applied(readout_time=0.004, margin=0.0045))
    assert live.take() is None
    add_imu(live, 75, 75)
    ready = live.take()
    # The rows end at 69 ms as configured; the stamped one stays.
    assert since_start(ready.imu.reference_ns) == [50]
    assert ready.imu.motion.path.times[[0, -1]] == pytest.approx([-0.0045, 0.0235])


EVEN = START + 33_366_700 * np.arange(60)


def jittering(rng, frames):
    """Stamps with errors of 2 ms."""
    return EVEN[:frames] + np.round(2e6 * rng.normal(size=frames)).astype(np.int64)


def test_an_exposure_longer_than_the_interval_is_refused():
    sequencer = replaying(exposure_time=0.06)
    add_imu(sequencer, 0, 400)
    add_frames(sequencer, 100, 150, 190)  # an interval of 50 ms may be jitter
    assert refusals(drain(sequencer)) == [Refusal.BAD_IMAGE]


@pytest.mark.parametrize(('frames', 'lost'), [(5, 0), (32, 0), (60, 12)])
def test_the_scatter_is_that_of_the_stamps_whether_or_not_frames_are_lost(frames, lost):
    rng = np.random.default_rng(0)
    found = []
    for _ in range(300):
        kept = np.delete(jittering(rng, frames), rng.choice(frames, lost, replace=False))
        found.append(module.stamp_scatter(kept[-module.SCATTER_FRAMES :]).sigma)
    assert np.mean(found) == pytest.approx(2.0e-3, rel=0.15)


@pytest.mark.parametrize(
    ('stamps_ns', 'most'),
    [
        (EVEN, 0.0),
        (np.delete(EVEN, [3, 4, 11, 30, 31, 32, 50]), 1e-6),  # lost frames
        # An exposure that becomes longer.
        (START + np.cumsum(np.repeat([33_173_000, 40_050_000], [20, 12])), 2e-4),
        # A camera without a rhythm is bounded.
        (START + np.cumsum(np.random.default_rng(2).integers(20_000_000, 200_000_000, 32)), 0.01),
        *((jittering(np.random.default_rng(3), frames), 0.0) for frames in range(3)),
    ],
)
def test_the_scatter_is_small_without_errors_and_bounded(stamps_ns, most):
    scatter = module.stamp_scatter(stamps_ns)
    assert scatter.sigma <= most and not scatter.is_jitter


def delays(kind, mean, rng, count=32):
    """One-sided delays [s] with a mean, as of a busy computer."""
    if kind == 'exponential':
        return rng.exponential(mean, count)
    if kind == 'mixture':  # mostly short, sometimes long
        is_long = rng.random(count) < 0.2
        return rng.exponential(np.where(is_long, 4.0 * mean, 0.25 * mean))
    return rng.uniform(0.0, 2.0 * mean, count)


@pytest.mark.parametrize(
    ('kind', 'mean', 'least'),
    [
        *(('exponential', mean, 0.75) for mean in (0.002, 0.005, 0.009)),
        *(('uniform', mean, 0.85) for mean in (0.003, 0.007, 0.015)),
        # Delays of most of an interval are partly taken for lost frames, or come in another order.
        ('exponential', 0.015, 0.6),
        ('mixture', 0.001, 0.6),
        ('mixture', 0.003, 0.4),
    ],
)
def test_one_sided_delays_are_jitter_of_their_size(kind, mean, least):
    rng = np.random.default_rng(round(1e6 * mean))
    sigmas = []
    found = []
    for _ in range(200):
        late = delays(kind, mean, rng)
        stamps_ns = np.sort(EVEN[:32] + np.round(1e9 * late).astype(np.int64))
        found.append(module.stamp_scatter(stamps_ns))
        sigmas.append(late.std())
    ratio = np.mean([one.sigma for one in found]) / np.mean(sigmas)
    assert least < ratio < 1.25
    share = np.mean([one.is_jitter for one in found])
    assert share > 0.5 if np.mean(sigmas) > 0.0035 else share < 0.7


def test_a_camera_that_is_triggered_irregularly_has_no_jitter():
    rng = np.random.default_rng(6)
    irregular = [np.cumsum(rng.integers(25_000_000, 41_000_000, 32)) for _ in range(200)]
    assert np.mean([module.stamp_scatter(one).is_jitter for one in irregular]) < 0.06
