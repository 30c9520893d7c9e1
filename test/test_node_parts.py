"""Parts of the node that need no graph."""

from __future__ import annotations

from dataclasses import replace
import itertools
import re

from conftest import ROOT
import numpy as np
import pytest

from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.front_end.sequencer import Refusal, SequencerCounts
from rs_relpose_ros.health.findings import Finding, Health, HealthState
from rs_relpose_ros.health.tracked import Applied, Tracked
from rs_relpose_ros.node.cause_log import CauseLog
from rs_relpose_ros.node.diagnostics import Statistics
from rs_relpose_ros.node.frame_statistics import ERROR, Inputs, OK, WARN
from rs_relpose_ros.node.health_log import HealthLog
from rs_relpose_ros.node.silence import LostImages, Silence, why_no_image, why_nothing
from rs_relpose_ros.tracking.matches import Matches

SECOND = 10**9


class Clock:
    def __init__(self) -> None:
        self.now = 0

    def __call__(self) -> int:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


# Of `test_every_counter_has_its_own_figure`, besides the refusals.
EXPECTED = {
    'state': 'degraded', 'missing': 'imu', 'image_rate_hz': '30.0', 'camera_info_rate_hz': '31.0',
    'imu_rate_hz': '200.0', 'accel_rate_hz': '100.0', 'frames_received': '2000',
    'frames_processed': '1064', 'frames_failed': '3', 'messages_invalid': '15',
    'imu_samples': '9000', 'imu_gaps': '11', 'imu_repeated': '13', 'imu_late': '14',
    'clock_jumps': '12', 'pairs': '3', 'poses': '2', 'matches': '20', 'inliers': '15',
    'inlier_ratio': '0.750', 'parallax_px': '3.2', 'residual_rms_px': '',
    'interval_s': '0.100', 'rotation_difference_to_gyro_deg': '', 'model': 'uniform',
    'tracked_gyro_bias_rad_s': '0.01000 -0.02000 0.03000',
    'tracked_gyro_bias_sigma_rad_s': '0.00100 0.00200 0.00300', 'tracked_time_offset_ms': '4.00',
    'tracked_time_offset_sigma_ms': '0.50', 'applied_time_offset_ms': '-1.50',
    'tracked_readout_time_ms': '31.00', 'tracked_readout_time_sigma_ms': '0.70',
    'applied_readout_time_ms': '0.80',
    'health': 'ok', 'health_findings': 'time_offset ok: 4 ms',
    'latency_p50_ms': '15.0', 'latency_p99_ms': '15.0',
    'frame_time_p50_ms': '30.0', 'frame_time_p99_ms': '30.0', 'worker_busy_percent': '2',
    'last_reason_no_pose': 'LOW_PARALLAX: it stands'}


# -- log lines -------------------------------------------------------------------------------


def test_a_cause_is_told_once_and_later_with_its_number(clock):
    lines: list[str] = []
    log = CauseLog(lines.append, period=30.0, clock=clock)
    for k in range(5):
        log(f'image has {k} bytes')
    log('something else')
    assert lines == ['image has 0 bytes', 'something else']
    clock.now = 31
    log('image has 7 bytes')
    assert lines[2] == 'image has 7 bytes (4 more since the last such line)'
    clock.now = 62
    log('image has 8 bytes')
    assert lines[3] == 'image has 8 bytes'


def test_made_up_causes_do_not_fill_log_or_memory(clock):
    lines: list[str] = []
    log = CauseLog(lines.append, clock=clock)
    for a, b, c in itertools.product('abcdefghij', repeat=3):
        log(f'unknown encoding {a}{b}{c}')
    assert len(lines) <= 65
    assert lines[-1] == 'further problems of other kinds (see /diagnostics)'


def finding(state: HealthState, ms: float, figure: str = 'time_offset') -> Finding:
    return Finding(figure, 0.03, 1e-3 * ms, 0.0005, 's', True, state,
                   f'{ms} ms is seen, 30.0 ms in force: set {figure}: {1e-3 * ms}')


def test_health_is_told_once_a_figure_and_when_it_is_well_again(clock):
    lines: list[tuple[str, str]] = []
    log = HealthLog(*(CauseLog(lambda text, level=level: lines.append((level, text)), clock=clock)
                      for level in ('info', 'warn', 'error')))
    ok, unknown, suspect, wrong = (Health((finding(state, 0.2),)) for state in HealthState)
    for health in (unknown, ok, suspect, Health((finding(HealthState.SUSPECT, 1.5),)), wrong,
                   wrong):
        log(health, withhold=True)
    sentence = '0.2 ms is seen, 30.0 ms in force: set time_offset: 0.0002'
    first, second = lines
    assert first == ('warn', f'time_offset is suspect: {sentence}')
    assert second[0] == 'error'
    assert second[1] == (f'time_offset is wrong: {sentence}; poses are withheld: '
                         'withhold_when_wrong: false publishes them all the same')
    # The worst figure first; it is the line's cause.
    log(Health((finding(HealthState.SUSPECT, 0.2), finding(HealthState.WRONG, 9.0, 'axes'))),
        withhold=False)
    assert lines[2][1].startswith('axes is wrong: 9.0 ms is seen')
    assert lines[2][1].endswith(f'; time_offset is suspect: {sentence}; poses are published all '
                                'the same, as withhold_when_wrong is false')
    for health in (unknown, ok):
        log(health, withhold=True)
    [back] = lines[3:]
    assert back == (
        'info', 'health is unknown: no figure that was told is suspect or wrong any more')
    clock.now = 31
    log(wrong, withhold=True)
    assert lines[4][1].endswith('(1 more since the last such line)')


def test_a_gross_error_is_told_at_once_after_small_steps_of_the_same_figure(clock):
    lines: list[str] = []
    log = HealthLog(*(CauseLog(lines.append, clock=clock) for _ in range(3)))
    small = finding(HealthState.WRONG, 9.0, 'axes')
    gross = replace(small, sigma=None, sentence='images turn about axes that are 122 deg off')
    for fault in (small, gross, small, gross):
        log(Health((fault,)), withhold=True)
    assert [line.partition(';')[0] for line in lines] == [small.text, gross.text]


# -- silence ---------------------------------------------------------------------------------


@pytest.mark.parametrize(('published', 'remedy'), [
    (['/camera/image/compressed', '/b'],
     'only /camera/image/compressed is published: set image_transport:=compressed'),
    (['/b', '/a'], 'these topics with images have publishers: /a, /b; remap image'),
    ([], 'no topic with images has a publisher'),
    (['/camera/image'], 'it has a publisher: does its quality of service match'),
])
def test_why_no_image_comes(published, remedy):
    reason = why_no_image('/camera/image', published)
    assert reason.text.startswith('no image on /camera/image for 5 s; ')
    assert remedy in reason.text


def test_the_other_transport_is_told_in_both_directions():
    assert 'image_transport:=raw' in why_no_image('/image/compressed', ['/image']).text


def test_why_nothing_comes_out():
    refused = {Refusal.IMU_GAP: 100, Refusal.NO_IMU: 30}
    reason = why_nothing(Silence(5.0, 150, refused, 'PURE_ROTATION: it stands'))
    assert '130 of 150 images were refused, 100 of them as imu_gap' in reason.text
    # Most images are used, and their pairs have no pose.
    standing = why_nothing(Silence(5.0, 150, {Refusal.IMU_GAP: 20}, 'PURE_ROTATION: 0.1 px'))
    assert 'PURE_ROTATION: 0.1 px' in standing.text
    # The numbers of a reason change, its kind does not.
    assert standing.kind == why_nothing(Silence(6.0, 180, {}, 'PURE_ROTATION: 0.2 px')).kind
    assert standing.kind != reason.kind
    assert 'nothing came of 150 images' in why_nothing(Silence(5.0, 150, {}, '')).text


def test_silence_is_counted_from_the_last_result(clock):
    def silence(images: int, **refused: int) -> Silence:
        return statistics.report(inputs(images), counts(**refused), problem='',
                                 missing=()).silence

    statistics = Statistics(clock)
    clock.now = 60 * SECOND   # kernels were compiled
    statistics.start()
    clock.now = 63 * SECOND
    assert silence(90, no_imu=10) == Silence(3.0, 90, {Refusal.NO_IMU: 10})
    statistics.add_pair(pair(), clock.now)
    assert silence(90, no_imu=10).seconds == 0.0
    statistics.add_pair(pair(Status.LOW_PARALLAX, 'it stands'), clock.now)
    clock.now = 65 * SECOND
    assert silence(150, no_imu=12) == Silence(2.0, 60, {Refusal.NO_IMU: 2},
                                              'LOW_PARALLAX: it stands')


def test_before_the_first_image_nothing_could_come_of_any(clock):
    statistics = Statistics(clock)
    for second in range(8):
        clock.now = second * SECOND
        assert statistics.report(inputs(0), counts(), problem='', missing=()).silence.seconds == 0
    clock.now = 9 * SECOND
    assert statistics.report(
        inputs(30), counts(), problem='', missing=()).silence == Silence(2.0, 30, {}, '')


@pytest.mark.parametrize(('rate', 'size', 'told'), [
    (9, 921_600, True), (29, 921_600, False), (9, 300_000, False), (0, 921_600, False)])
def test_images_that_are_lost_on_the_way_are_told(rate, size, told):
    lost = LostImages()
    for second in range(5):
        assert lost.add(rate * second, 30 * second, size) == ''
    text = lost.add(rate * 5, 150, size)
    assert bool(text) == told
    if told:
        assert text.startswith('9 images a second of 0.9 MB come, and 30 CameraInfo')
        assert 'config/fastdds.xml' in text and 'ros2 launch' in text


# -- diagnostics -----------------------------------------------------------------------------


def pair(status: Status = Status.OK, reason: str = '') -> PairResult:
    count = 20
    inliers = np.zeros(count, dtype=bool)
    inliers[:15] = True
    zeros2, zeros3 = np.zeros((count, 2)), np.zeros((count, 3))
    return PairResult(
        reference_stamp_ns=0, stamp_ns=1, reference_ns1=0, reference_ns2=1, frame_id='',
        interval=0.1,
        pose=RelativePose(status=status, reason=reason, inliers=inliers, model='uniform'),
        matches=Matches(np.arange(count, dtype=np.uint32), zeros2, zeros2, np.ones(count)),
        row_times1=np.zeros(count), row_times2=np.zeros(count), rays1=zeros3, rays2=zeros3,
        parallax=3.25)


def counts(frames: int = 0, taken: int = 0, **refused: int) -> SequencerCounts:
    return SequencerCounts(frames=frames, frames_taken=taken,
                           refused={Refusal(name): n for name, n in refused.items()},
                           imu_samples=0, imu_gaps=0, clock_jumps=0)


def inputs(images: int = 0, imu: int = 0) -> Inputs:
    return Inputs(images, images, imu, 0, 0)


def test_rates_are_those_since_the_last_report(clock):
    statistics = Statistics(clock)
    clock.now = 2 * SECOND
    first = dict(statistics.report(inputs(60, 400), counts(), problem='', missing=()).values)
    assert (first['image_rate_hz'], first['imu_rate_hz']) == ('30.0', '200.0')
    clock.now = 3 * SECOND
    second = dict(statistics.report(inputs(75, 400), counts(), problem='', missing=()).values)
    assert (second['image_rate_hz'], second['imu_rate_hz']) == ('15.0', '0.0')


def test_latency_is_from_ready_to_publication(clock):
    statistics = Statistics(clock)
    for milliseconds in range(1, 101):
        clock.now = SECOND
        statistics.add_pair(pair(), SECOND - milliseconds * 10**6)
    values = dict(statistics.report(inputs(), counts(), problem='', missing=()).values)
    assert float(values['latency_p50_ms']) == pytest.approx(50.5, abs=0.1)
    assert float(values['latency_p99_ms']) == pytest.approx(99.0, abs=0.1)
    assert (values['pairs'], values['poses']) == ('100', '100')
    assert (values['inlier_ratio'], values['inliers'], values['matches']) == ('0.750', '15', '20')


def test_the_worker_s_share_is_that_since_the_last_report(clock):
    statistics = Statistics(clock)
    for k in range(30):
        clock.now = (k + 1) * SECOND // 30
        statistics.add_frame(clock.now - 20 * 10**6)
    clock.now = SECOND
    values = dict(statistics.report(inputs(), counts(), problem='', missing=()).values)
    assert (values['frame_time_p50_ms'], values['frame_time_p99_ms']) == ('20.0', '20.0')
    assert values['worker_busy_percent'] == '60'
    clock.now = 2 * SECOND
    values = dict(statistics.report(inputs(), counts(), problem='', missing=()).values)
    assert values['worker_busy_percent'] == '0'
    assert values['frame_time_p50_ms'] == '20.0'


def test_overload_is_told_as_such(clock):
    statistics = Statistics(clock)
    report = statistics.report(inputs(), counts(frames=9, taken=4, overload=3, no_imu=2),
                               problem='', missing=())
    assert report.level == WARN
    assert report.text.startswith('5 frames were not used')
    assert report.text.endswith('(3 overload, 2 no_imu): the worker is too slow for the camera')
    later = counts(frames=10, taken=4, overload=3, no_imu=3)
    report = statistics.report(inputs(), later, problem='', missing=())
    assert report.text == '1 frames were not used since the last report (1 no_imu)'
    # Told once: those of the last second.
    assert statistics.report(inputs(), later, problem='', missing=()).level == OK


def test_every_counter_has_its_own_figure(clock):
    """All different, so that none can stand for another."""
    statistics = Statistics(clock)
    refused = {cause: 100 + k for k, cause in enumerate(Refusal)}
    for _ in range(3):
        statistics.add_failure('a frame failed')
    told = Finding('time_offset', 0.0, 0.004, 0.0005, 's', True, HealthState.OK, '4 ms')
    last = replace(
        pair(Status.LOW_PARALLAX, 'it stands'), health=Health((told,)), tracked=Tracked(
            gyro_bias=np.array([0.01, -0.02, 0.03]), gyro_bias_sigma=np.array([1e-3, 2e-3, 3e-3]),
            time_offset=0.004, time_offset_sigma=0.0005, readout_time=0.031,
            readout_time_sigma=0.0007, pairs=7), applied=Applied(-0.0015, 0.0008))
    clock.now = SECOND
    for result in (pair(), pair(), last):
        statistics.add_pair(result, clock.now - 15 * 10**6)
    statistics.add_frame(clock.now - 30 * 10**6)
    counted = SequencerCounts(frames=2000, frames_taken=1064, refused=refused, imu_samples=9000,
                              imu_gaps=11, clock_jumps=12, imu_repeated=13, imu_late=14)
    clock.now = 2 * SECOND
    report = statistics.report(Inputs(images=60, camera_infos=62, imu=400, accelerometer=200,
                                      invalid=15), counted, problem='', missing=('imu',))
    values = dict(report.values)
    assert len(values) == len(report.values)
    assert {name: values[name] for name in EXPECTED} == EXPECTED
    refusals = {f'frames_refused_{cause.value}': str(n) for cause, n in refused.items()}
    assert values == {**values, **refusals}
    assert set(values) == {*EXPECTED, *refusals}


def test_every_figure_is_documented(clock):
    report = Statistics(clock).report(inputs(), counts(), problem='', missing=())
    text = (ROOT / 'docs' / 'operation.md').read_text(encoding='utf-8')
    documented = set(re.findall(r'`(\w+)`', text[text.index('## Diagnostics'):]
                                .partition('\n## ')[0]))
    names = {name for name, _ in report.values}
    causes = {f'frames_refused_{cause.value}' for cause in Refusal}
    assert names - causes <= documented
    assert {cause.value for cause in Refusal} <= documented


def test_level_and_text(clock):
    statistics = Statistics(clock)
    report = statistics.report(inputs(), None, problem='not estimating: why', missing=('a', 'b'))
    assert (report.level, report.text) == (ERROR, 'not estimating: why')
    values = dict(report.values)
    assert (values['missing'], values['tracked_time_offset_ms']) == ('a, b', '')
    assert statistics.report(inputs(), counts(), problem='', missing=()).level == OK
    statistics.add_pair(pair(Status.LOW_PARALLAX, 'it stands'), 0)
    report = statistics.report(inputs(), counts(), problem='', missing=())
    assert report.level == WARN
    assert 'LOW_PARALLAX: it stands' in report.text
    statistics.add_pair(pair(), 0)
    assert statistics.report(inputs(), counts(), problem='', missing=()).level == OK


@pytest.mark.parametrize(('state', 'level', 'shown'), [
    (HealthState.OK, OK, 'ok'), (HealthState.UNKNOWN, OK, 'ok'),
    (HealthState.SUSPECT, WARN, 'degraded'), (HealthState.WRONG, ERROR, 'told wrong')])
def test_level_and_text_of_the_health(clock, state, level, shown):
    statistics = Statistics(clock)
    told = finding(state, 0.2)
    statistics.add_pair(replace(pair(), health=Health((told,))), 0)
    report = statistics.report(inputs(), counts(), problem='', missing=())
    values = dict(report.values)
    assert (report.level, values['state'], values['health']) == (level, shown, state.value)
    assert (report.text == told.text) is bool(level)
    assert told.sentence in values['health_findings']
    # Frames that are left out do not hide that poses are wrong, nor do they where none comes.
    dropping = statistics.report(inputs(), counts(9, 4, overload=5), problem='', missing=())
    assert (dropping.text == told.text) is (state is HealthState.WRONG)
    cannot = statistics.report(inputs(), counts(), problem='no image', missing=('image',))
    assert (cannot.level, cannot.text) == (ERROR, 'no image')
    assert dict(cannot.values)['state'] == 'not estimating'
