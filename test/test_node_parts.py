"""Parts of the node: log lines, silence, diagnostics, parameters, and its worker."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
import itertools
from pathlib import Path
import re
import threading
import time
from typing import Any

from conftest import Clock, ROOT
import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.task import Task
from std_msgs.msg import String

from rs_relpose_lab.live.processes import wait_until
from rs_relpose_ros.calibration.findings import (
    Assessment,
    Code,
    Evidence,
    Finding,
    FindingState,
    Why,
)
from rs_relpose_ros.calibration.findings_text import line, message_json, text_of
from rs_relpose_ros.config.settings import Declared, Parameters
from rs_relpose_ros.estimator.result import Diagnostics, RelativePose, Status
from rs_relpose_ros.geometry.matches import Matches
from rs_relpose_ros.nodes import diagnostics, executor
from rs_relpose_ros.nodes.diagnostics import ERROR, OK, Reason, Silence, Statistics, WARN
from rs_relpose_ros.nodes.executor import KeptWaitSet
from rs_relpose_ros.nodes.parameters import NodeParameters
from rs_relpose_ros.pipeline.monitor import Applied, Tracked
from rs_relpose_ros.pipeline.pair import Learned, PairResult
from rs_relpose_ros.pipeline.sequencer import Refusal, SequencerCounts

SECOND = 10**9


@pytest.fixture
def statistics(clock: Clock) -> Statistics:
    return Statistics(clock)


def test_a_reason_is_logged_once_and_later_with_its_number(clock):
    lines: list[str] = []
    log = diagnostics.ReasonLog(lines.append, period=30.0, clock=clock)
    for k in range(5):
        log(f'image has {k} bytes')
    log('something else')
    assert lines == ['image has 0 bytes', 'something else']
    for now, number in ((31, 7), (62, 8)):
        clock.now = now
        log(f'image has {number} bytes')
    assert lines[2:] == [
        'image has 7 bytes (4 more since the last such line)',
        'image has 8 bytes',
    ]


def test_ever_new_reasons_do_not_fill_log_or_memory(clock):
    lines: list[str] = []
    log = diagnostics.ReasonLog(lines.append, clock=clock)
    for letters in itertools.product('abcdefghij', repeat=3):
        log(f'unknown encoding {"".join(letters)}')
    assert len(lines) <= 65
    assert lines[-1].startswith('further problems')


class Lines(list[tuple[str, str]]):
    """Level and text of the lines of a `HealthLog`."""

    def __init__(self, clock: Clock) -> None:
        self.log = diagnostics.HealthLog(
            *(
                diagnostics.ReasonLog(
                    lambda text, level=level: self.append((level, text)), clock=clock
                )
                for level in ('info', 'warn', 'error')
            )
        )


def finding(
    state: FindingState, ms: float, code: Code = Code.TIME_OFFSET, why: Why = Why.OFF
) -> Finding:
    return Finding(
        code,
        state,
        why,
        (0.03,),
        (1e-3 * ms,),
        0.0005,
        's',
        evidence=Evidence(shift=2.0),
        settings={'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0]}
        if code is Code.AXES
        else {'time_offset': 1e-3 * ms},
    )


def test_health_is_logged_once_a_quantity_and_when_it_is_ok_again(clock):
    lines = Lines(clock)
    ok, unknown, suspect, wrong = (Assessment((finding(state, 0.2),)) for state in FindingState)
    for health in (
        unknown,
        ok,
        suspect,
        Assessment((finding(FindingState.SUSPECT, 1.5),)),
        wrong,
        wrong,
    ):
        lines.log(health, withhold=True)
    levels, texts = zip(*lines, strict=True)
    assert levels == ('warn', 'error')
    assert texts[0] == line(suspect.faults[0])
    assert texts[1].startswith(f'{line(wrong.faults[0])}; ')
    # The worst parameter first; the repetitions of a line are those of its first parameter.
    small = finding(FindingState.WRONG, 9.0, Code.AXES)
    lines.log(Assessment((suspect.faults[0], small)), withhold=False)
    assert lines[2][1].startswith(f'{line(small)}; {line(suspect.faults[0])}; ')
    assert ['suppressed' in text for text in (texts[1], lines[2][1])] == [True, False]
    # A gross error of the same quantity has a line of its own.
    gross = replace(small, why=Why.GROSS)
    for fault in (small, gross, gross):
        lines.log(Assessment((fault,)), withhold=True)
    for health in (unknown, ok):
        lines.log(health, withhold=True)
    assert [level for level, _ in lines[3:]] == ['error', 'info']
    clock.now = 31
    lines.log(wrong, withhold=True)
    assert lines[5][1].endswith('(1 more since the last such line)')


@pytest.mark.parametrize(
    ('image', 'published', 'fix'),
    [
        ('/camera/image', ['/camera/image/compressed', '/b'], 'image_transport:=compressed'),
        ('/camera/image', ['/b', '/a'], '/a, /b; remap image'),
        ('/camera/image', [], 'no topic with images has a publisher'),
        ('/camera/image', ['/camera/image'], 'quality of service'),
        ('/image/compressed', ['/image'], 'image_transport:=raw'),
    ],
)
def test_why_no_image_comes(image, published, fix):
    assert fix in diagnostics.why_no_image(image, published).text


def test_why_there_is_no_result():
    refused = {Refusal.IMU_GAP: 100, Refusal.NO_IMU: 30}
    why = diagnostics.why_nothing
    reason = why(Silence(5.0, 150, refused, Reason('PURE_ROTATION', 'PURE_ROTATION: at rest')))
    assert '130 of 150 ' in reason.text and '100 of them as imu_gap' in reason.text
    # Most images are used, and their pairs have no pose.
    standing = why(
        Silence(5.0, 150, {Refusal.IMU_GAP: 20}, Reason('PURE_ROTATION', 'PURE_ROTATION: 0.1 px'))
    )
    assert 'PURE_ROTATION: 0.1 px' in standing.text
    # The numbers of a reason change, its kind does not.
    assert (
        standing.kind
        == why(Silence(6.0, 180, {}, Reason('PURE_ROTATION', 'PURE_ROTATION: 0.2 px'))).kind
    )
    assert len({reason.kind, standing.kind, why(Silence(5.0, 150, {})).kind}) == 3


def test_silence_is_counted_from_the_last_result(clock, statistics):
    def silence(images: int, **refused: int) -> Silence:
        return report(statistics, images, counts(**refused)).silence

    clock.now = 60 * SECOND  # kernels were compiled
    statistics.start()
    clock.now = 63 * SECOND
    assert silence(90, no_imu=10) == Silence(3.0, 90, {Refusal.NO_IMU: 10})
    statistics.add_pair(pair(), clock.now)
    assert silence(90, no_imu=10).seconds == 0.0
    statistics.add_pair(pair(Status.LOW_PARALLAX, 'at rest'), clock.now)
    # Without an image there is no result to wait for.
    clock.now = 64 * SECOND
    assert silence(90, no_imu=10).seconds == 0.0
    clock.now = 66 * SECOND
    assert silence(150, no_imu=12) == Silence(
        2.0, 60, {Refusal.NO_IMU: 2}, Reason('LOW_PARALLAX', 'LOW_PARALLAX: at rest')
    )


@pytest.mark.parametrize(
    ('share', 'size', 'jitter', 'expected'),
    [
        (0.5, 921_600, 0, 'config/fastdds.xml'),
        (0.95, 921_600, 0, ''),
        (0.5, 300_000, 0, ''),
        # Of a rhythm with jitter; of a slow start, before the last seconds.
        (0.5, 921_600, 2_000_000, 'config/fastdds.xml'),
        (1.0, 921_600, 200_000, ''),
        (1.0, 921_600, 2_000_000, 'jitter by 1.9'),
        (0.9, 300_000, 2_000_000, 'jitter by '),
    ],
)
def test_lost_images_and_jitter_are_reported(share, size, jitter, expected):
    rng = np.random.default_rng(0)
    stamps = [
        k * SECOND // 30 + int(jitter * rng.normal())
        for k in range(300)
        if k < 100 or rng.random() < share
    ]
    text = diagnostics.stamps_warning(stamps, size)
    assert expected in text
    assert bool(text) == bool(expected)


@pytest.mark.parametrize(
    'change',
    [
        lambda k: 0 if k % 6 == 0 else k * SECOND // 30,  # no stamp
        lambda k: (k % 100) * SECOND // 30,  # a bag that is looped
        lambda k: k * SECOND // 30 + k // 12 * 15_000_000,  # a driver that pauses
        lambda k: k * SECOND // 30 + k // 40 % 2 * (k % 40) * 4_000_000,
    ],
)  # exposure that changes
def test_other_changes_of_stamps_are_no_jitter(change):
    assert not diagnostics.stamps_warning([change(k) for k in range(300)], 300_000)


def pair(status: Status = Status.OK, reason: str = '') -> PairResult:
    count = 20
    inliers = np.arange(count) < 15
    return PairResult(
        reference_stamp_ns=0,
        stamp_ns=1,
        reference_ns1=0,
        reference_ns2=1,
        frame_id='',
        interval=0.1,
        pose=RelativePose(
            status=status,
            reason=reason,
            inliers=inliers,
            diagnostics=Diagnostics(model='uniform'),
        ),
        matches=Matches(
            np.arange(count, dtype=np.uint32),
            np.zeros((2, count, 2)),
            np.ones(count),
            np.zeros((2, count, 3)),
            np.zeros((2, count)),
        ),
        parallax=3.25,
    )


def counts(frames: int = 0, taken: int = 0, **refused: int) -> SequencerCounts:
    return SequencerCounts(
        frames=frames,
        frames_taken=taken,
        refused={Refusal(name): n for name, n in refused.items()},
        imu_samples=0,
        imu_gaps=0,
        clock_jumps=0,
    )


def report(
    statistics: Statistics,
    images: int = 0,
    counted: SequencerCounts | None = None,
    *,
    problem: str = '',
    missing: tuple[str, ...] = (),
    **inputs: int,
) -> diagnostics.Report:
    return statistics.report(
        Counter(image=images, **inputs), counted or counts(), problem=problem, missing=missing
    )


def values(statistics: Statistics, **options: Any) -> dict[str, str]:
    return dict(report(statistics, **options).values)


def test_rates_and_load_are_those_since_the_last_report(clock, statistics):
    for k in range(30):
        clock.now = (k + 1) * SECOND // 30
        statistics.add_frame(clock.now - 20 * 10**6)
    clock.now = SECOND
    names = (
        'image_rate_hz',
        'imu_rate_hz',
        'worker_busy_percent',
        'frame_time_p50_ms',
        'frame_time_p99_ms',
    )
    for images, expected in (
        (60, ('60.0', '400.0', '60', '20.0', '20.0')),
        (75, ('15.0', '0.0', '0', '20.0', '20.0')),
    ):
        found = values(statistics, images=images, imu=400)
        assert tuple(found[name] for name in names) == expected
        clock.now += SECOND


def test_latency_is_from_ready_to_publication(clock, statistics):
    clock.now = SECOND
    for milliseconds in range(1, 101):
        statistics.add_pair(pair(), SECOND - milliseconds * 10**6)
    found = values(statistics)
    assert float(found['latency_p50_ms']) == pytest.approx(50.5, abs=0.1)
    assert float(found['latency_p99_ms']) == pytest.approx(99.0, abs=0.1)
    assert (found['pairs'], found['poses']) == ('100', '100')


def test_refused_frames_are_reported_once(statistics):
    later = counts(frames=11, taken=5, overload=3, no_imu=3)
    for counted, parts in (
        (counts(9, 4, overload=3, no_imu=2), ('5 frames', '3 overload, 2 no_')),
        (later, ('1 frames', '(1 no_imu)')),
    ):
        found = report(statistics, counted=counted)
        assert found.level == WARN
        assert all(part in found.text for part in parts)
    assert report(statistics, counted=later).level == OK
    # No frame at all was used since then.
    statistics.add_refusal('the image is 320x240, but its CameraInfo is for 640x480')
    unused = counts(frames=15, taken=5, overload=3, no_imu=3, bad_image=4)
    third = report(statistics, counted=unused)
    assert (third.level, dict(third.values)['state']) == (ERROR, 'not estimating')
    assert third.text.endswith('CameraInfo is for 640x480')


CONSISTENT = Finding(
    Code.TIME_OFFSET, FindingState.OK, Why.CONSISTENT, (0.0,), (0.004,), 0.0005, 's'
)
# Besides the refusals.
EXPECTED = {
    'state': 'degraded',
    'missing': 'imu',
    'image_rate_hz': '30.0',
    'camera_info_rate_hz': '31.0',
    'imu_rate_hz': '200.0',
    'accel_rate_hz': '100.0',
    'frames_received': '2000',
    'frames_processed': '1064',
    'frames_failed': '3',
    'messages_invalid': '15',
    'imu_samples': '9000',
    'imu_gaps': '11',
    'imu_repeated': '13',
    'imu_late': '14',
    'imu_wild': '16',
    'clock_jumps': '12',
    'pairs': '3',
    'poses': '2',
    'matches': '20',
    'inliers': '15',
    'inlier_ratio': '0.750',
    'parallax_px': '3.2',
    'residual_rms_px': '',
    'pixel_sigma_px': '',
    'interval_s': '0.100',
    'rotation_difference_to_gyro_deg': '',
    'model': 'uniform',
    'tracked_gyro_bias_rad_s': '0.01000 -0.02000 0.03000',
    'tracked_gyro_bias_sigma_rad_s': '0.00100 0.00200 0.00300',
    'tracked_time_offset_ms': '4.00',
    'tracked_time_offset_sigma_ms': '0.50',
    'applied_time_offset_ms': '-1.50',
    'tracked_readout_time_ms': '31.00',
    'tracked_readout_time_sigma_ms': '0.70',
    'applied_readout_time_ms': '0.80',
    'health': 'ok',
    'health_findings': 'time_offset ok: estimated 4.00 +- 0.50 ms, active 0.00 ms',
    'findings': message_json(Assessment((CONSISTENT,))),
    'latency_p50_ms': '15.0',
    'latency_p99_ms': '15.0',
    'frame_time_p50_ms': '30.0',
    'frame_time_p99_ms': '30.0',
    'worker_busy_percent': '2',
    'last_reason_no_pose': 'LOW_PARALLAX: at rest',
}


def test_every_counter_has_its_own_field(clock, statistics):
    """All different, so that none can stand for another."""
    refused = {reason: 100 + k for k, reason in enumerate(Refusal)}
    for _ in range(3):
        statistics.add_failure(Reason('a frame failed', 'a frame failed: it has no rows'))
    last = replace(
        pair(Status.LOW_PARALLAX, 'at rest'),
        health=Assessment((CONSISTENT,)),
        lesson=lambda: Learned(
            tracked=Tracked(
                gyro_bias=np.array([0.01, -0.02, 0.03]),
                gyro_bias_sigma=np.array([1e-3, 2e-3, 3e-3]),
                time_offset=0.004,
                time_offset_sigma=0.0005,
                readout_time=0.031,
                readout_time_sigma=0.0007,
                pairs=7,
            ),
            applied=Applied(-0.0015, 0.0008),
        ),
    )
    clock.now = SECOND
    for result in (pair(), pair(), last):
        statistics.add_pair(result, clock.now - 15 * 10**6)
    statistics.add_frame(clock.now - 30 * 10**6)
    counted = SequencerCounts(
        frames=2000,
        frames_taken=1064,
        refused=refused,
        imu_samples=9000,
        imu_gaps=11,
        clock_jumps=12,
        imu_repeated=13,
        imu_late=14,
        imu_wild=16,
    )
    clock.now = 2 * SECOND
    found = report(
        statistics, 60, counted, missing=('imu',), camera_info=62, imu=400, accel=200, invalid=15
    ).values
    expected = EXPECTED | {
        f'frames_refused_{reason.value}': str(n) for reason, n in refused.items()
    }
    assert (dict(found), len(found)) == (expected, len(expected))


def test_every_field_is_documented(statistics):
    text = (ROOT / 'docs' / 'operation.md').read_text(encoding='utf-8')
    documented = set(
        re.findall(r'`(\w+)`', text[text.index('## Diagnostics') :].partition('\n## ')[0])
    )
    refusals = {f'frames_refused_{reason.value}' for reason in Refusal}
    assert values(statistics).keys() - refusals <= documented
    assert {reason.value for reason in Refusal} <= documented


def test_the_report_has_the_level_and_text_of_its_problem(statistics):
    found = statistics.report(Counter(), None, problem='why', missing=('a', 'b'))
    assert (found.level, found.text) == (ERROR, 'why')
    fields = dict(found.values)
    assert (fields['state'], fields['missing'], fields['tracked_time_offset_ms']) == (
        'not estimating',
        'a, b',
        '',
    )
    assert report(statistics).level == OK
    statistics.add_pair(pair(Status.LOW_PARALLAX, 'at rest'), 0)
    found = report(statistics)
    assert found.level == WARN
    assert 'LOW_PARALLAX: at rest' in found.text
    statistics.add_pair(pair(), 0)
    assert report(statistics).level == OK


def test_a_start_is_no_error_and_lost_images_are_a_warning(statistics):
    starting = statistics.report(Counter(), None, problem=diagnostics.STARTING, missing=())
    assert (starting.level, dict(starting.values)['state']) == (OK, 'not estimating')
    statistics.add_pair(pair(), 0)
    lost = statistics.report(
        Counter(image=9), counts(9, 9), problem='', missing=(), warning='lost'
    )
    assert (lost.level, lost.text, dict(lost.values)['state']) == (WARN, 'lost', 'degraded')
    worse = statistics.report(Counter(), None, problem='no image', missing=(), warning='lost')
    assert worse.text == 'no image'


@pytest.mark.parametrize(
    ('state', 'level', 'shown'),
    [
        (FindingState.OK, OK, 'ok'),
        (FindingState.UNKNOWN, OK, 'ok'),
        (FindingState.SUSPECT, WARN, 'degraded'),
        (FindingState.WRONG, ERROR, 'told wrong'),
    ],
)
def test_level_and_text_of_the_health(statistics, state, level, shown):
    fault = finding(state, 0.2)
    statistics.add_pair(replace(pair(), health=Assessment((fault,))), 0)
    found = report(statistics)
    fields = dict(found.values)
    assert (found.level, fields['state'], fields['health']) == (level, shown, state.value)
    assert (found.text == line(fault)) is bool(level)
    assert text_of(fault).description in fields['health_findings']
    # Refused frames do not hide that poses are wrong, nor that nothing is published.
    dropping = report(statistics, counted=counts(9, 4, overload=5))
    assert (dropping.text == line(fault)) is (state is FindingState.WRONG)
    assert report(statistics, problem='no image').text == 'no image'


DECLARATIONS = {name: declared for name, _, declared in Parameters.declarations()}
DEFAULTS = {name: default for name, default, _ in Parameters.declarations()}
# Distortion needs a camera matrix.
LIVE = [
    name
    for name, declared in DECLARATIONS.items()
    if declared.live and name != 'distortion_coefficients'
]


@pytest.fixture(scope='module')
def node(module_ros_domain_id: int) -> Iterator[Node]:
    context = Context()
    rclpy.init(context=context)
    node = rclpy.create_node('parameters', context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


def test_a_task_that_nothing_announces_is_run(node):
    """Its guard was read while rclpy looked for other work: a node would not end."""
    kept = KeptWaitSet(context=node.context)
    done = threading.Event()
    kept.add_node(node)

    def add() -> None:
        timer.cancel()
        kept._tasks.append((Task(done.set, executor=kept), None, None))

    def spin() -> None:
        while not done.is_set():
            kept.spin_once()

    timer = node.create_timer(0.01, add)
    thread = threading.Thread(target=spin)
    thread.start()
    try:
        assert done.wait(20.0)
    finally:
        kept.create_task(done.set)
        thread.join()
        kept.release()
        kept.remove_node(node)
        node.destroy_timer(timer)


def executor_without(monkeypatch: pytest.MonkeyPatch, problem: str) -> None:
    """Make rclpy one in which the executor of the nodes cannot work."""
    if problem == 'take_message':
        monkeypatch.setattr(executor.rclpy_implementation, 'Subscription', object)
    elif problem == 'WaitSet':
        monkeypatch.delattr(executor.rclpy_implementation, 'WaitSet')
    else:  # an executor that calls nothing, as the EventsExecutor of some wheels
        monkeypatch.setattr(executor, '_TEST_TIME', 0.2)
        monkeypatch.setattr(KeptWaitSet, 'spin_once', lambda self, timeout: time.sleep(0.05))


@pytest.mark.parametrize('problem', ['', 'take_message', 'WaitSet', 'calls no task'])
def test_polled_messages_come_with_either_executor(node, monkeypatch, problem):
    if problem:
        executor_without(monkeypatch, problem)
    used, reported = executor.make_executor(node)
    monkeypatch.undo()
    assert isinstance(used, KeptWaitSet) is (not problem)
    assert problem in reported and bool(reported) is bool(problem)
    received: list[str] = []
    subscription = executor.PolledSubscription(
        node, String, 'polled', QoSProfile(depth=50), received.extend, lambda: False
    )
    timer = node.create_timer(0.02, subscription.drain)
    publisher = node.create_publisher(String, 'polled', QoSProfile(depth=50))
    try:
        wait_until(lambda: publisher.get_subscription_count() == 1, 'the subscription')
        for text in 'abc':
            publisher.publish(String(data=text))
        end = time.monotonic() + 10.0
        while len(received) < 3 and time.monotonic() < end:
            used.spin_once()
    finally:
        if isinstance(used, KeptWaitSet):
            used.release()
        used.remove_node(node)
        node.destroy_timer(timer)
        node.destroy_publisher(publisher)
        node.destroy_subscription(subscription._subscription)
    assert [message.data for message in received] == ['a', 'b', 'c']


CHANGES: list[Parameters] = []


@pytest.fixture(scope='module')
def parameters(node: Node) -> NodeParameters:
    return NodeParameters(node, CHANGES.append)


def illegal_values(declared: Declared) -> Iterator[Any]:
    """Of another type, and beyond each bound."""
    yield 5 if declared.kind is str else 'five'
    if declared.choices:
        yield 'none of them'
    if declared.kind is float:
        yield float('nan')
        yield from (
            bound + step
            for bound, step in ((declared.low, -1.0), (declared.high, 1.0))
            if abs(bound) < 1e12
        )
    if declared.kind is int:
        yield int(declared.low) - 1
        yield int(declared.high) + 1


def other_value(name: str, declared: Declared) -> Any:
    """A legal one that is not the default."""
    if declared.kind is bool:
        return not DEFAULTS[name]
    if declared.kind is str:
        return (
            declared.choices[-1]
            if declared.choices[-1] != DEFAULTS[name]
            else (declared.choices[0])
        )
    if declared.kind is tuple:
        return {
            'quat_cam_imu_xyzw': (0.0, 0.0, 0.0, 1.0),
            'camera_matrix': (5.0, 0.0, 2.0, 0.0, 5.0, 2.0, 0.0, 0.0, 1.0),
        }.get(name, (0.1,) * (declared.length or 4))
    assert declared.kind in (float, int), name
    return declared.kind(0.3 * declared.low + 0.7 * declared.high)


def assert_refused(node: Node, reason: str, *parameters: Parameter) -> None:
    """Set all of them or none."""
    result = node.set_parameters_atomically(list(parameters))
    assert not result.successful, parameters
    assert reason in result.reason
    assert '\n' not in result.reason


@pytest.mark.parametrize('name', DECLARATIONS)
def test_an_illegal_value_is_refused_with_its_reason(node, parameters, name):
    before = len(CHANGES)
    legal = Parameter('threshold', value=1.5)
    for value in illegal_values(DECLARATIONS[name]):
        assert_refused(node, name, legal, Parameter(name, value=value))
    if DEFAULTS[name] is not None:
        assert_refused(node, name, Parameter(name, Parameter.Type.NOT_SET))
    assert (parameters.current, len(CHANGES)) == (Parameters(), before)


@pytest.mark.parametrize(
    'name', [name for name, declared in DECLARATIONS.items() if not declared.live]
)
def test_the_parameters_of_the_construction_are_read_only(node, parameters, name):
    value = DEFAULTS[name]
    value = list(value) if isinstance(value, tuple) else value
    assert_refused(node, 'read-only', Parameter(name, value=value))


@pytest.mark.parametrize('name', LIVE)
def test_a_live_parameter_is_passed_on(node, parameters, name):
    value = other_value(name, DECLARATIONS[name])
    before = len(CHANGES)
    assert value != DEFAULTS[name]
    [result] = node.set_parameters(
        [Parameter(name, value=list(value) if isinstance(value, tuple) else value)]
    )
    assert result.successful, result.reason
    assert len(CHANGES) == before + 1
    assert CHANGES[-1] is parameters.current
    assert parameters.current.to_mapping() == {**Parameters().to_mapping(), name: value}
    found = node.get_parameter(name).value
    assert (tuple(found) if isinstance(value, tuple) else found) == value
    [result] = node.set_parameters([Parameter(name, value=DEFAULTS[name])])
    assert result.successful
    assert parameters.current == Parameters()


@pytest.mark.skipif(not Path('/dev/full').exists(), reason='Linux has a device that is full')
def test_a_file_ends_with_an_error_that_names_it():
    errors = []
    file = diagnostics.LineFile('stamps_file', '/dev/full', errors.append)
    for _ in range(3):
        file.write('1')
    file.close()
    assert errors == ['stamps_file /dev/full ends here: No space left on device']
