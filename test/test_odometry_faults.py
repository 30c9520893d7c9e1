"""odometry_node as a process: the bundled bag; a walk with one fault after the other.

Pairs of the walk are the truth plus noise, put into messages by the package. They are played
faster than in real time, as the node goes by stamps, and with fewer samples instead.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
import math
import os
import re
import signal
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

from conftest import BUNDLED_PARAMETERS, ROOT
from diagnostic_msgs.msg import DiagnosticArray
from fault_stream import BAG_TOPICS, publish_in_time, SECOND, stamp_of
from geometry_msgs.msg import TransformStamped
import message_builders as build
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
import numpy as np
import pytest
import rclpy
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger
from test_node_settings import FAKE_TF2_ROS
from test_odometry import (
    BASE,
    BASE_TO_CAMERA,
    LEVER,
    PARAMETERS,
    QUAT,
    START_NS,
    Walk,
    walk,
)
import yaml

from rs_relpose_lab.live import processes
from rs_relpose_lab.live.graph import diagnostic_values, Graph
from rs_relpose_lab.live.processes import node_process, wait_until, wait_until_quiet
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.calibration.findings import (
    Assessment,
    Code,
    Evidence,
    Finding,
    FindingState,
    Why,
)
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.result import Landmarks, RelativePose, Status
from rs_relpose_ros.geometry.matches import Matches
from rs_relpose_ros.geometry.so3 import exp_so3, log_so3, skew
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.messages.incoming import PARTS, Role
from rs_relpose_ros.messages.published_pair import PublishedPair
from rs_relpose_ros.nodes.odometry_node import OdometryNode
from rs_relpose_ros.odometry.estimator import OdometryEstimator
from rs_relpose_ros.odometry.offline import aligned
from rs_relpose_ros.odometry.pair import contradiction
from rs_relpose_ros.odometry.states import Base
from rs_relpose_ros.offline.replay import read_truth
from rs_relpose_ros.offline.truth import TrueTrajectory
from rs_relpose_ros.pipeline.pair import PairResult

# The node may have to compile the kernels.
pytestmark = [pytest.mark.live, pytest.mark.timeout(600)]

OWN = '/odometry_node'
FASTER = 2.0
IMU_RATE = 100.0
# Events, in seconds of the walk; those of a gap of the IMU, a clock that is set back and late
# messages are in test_odometry.
CAMERA_STOPS = (2.6, 5.2)
WRONG = (7.6, 8.2)
RESET = 10.6
END = 13.0
# Delay of a pair after its image, and of a sample after its time.
PAIR_DELAY = 0.06
IMU_DELAY = 0.002
# Longest start in motion, and the delay of a message, on a busy machine too.
START = 1.6
# Where all is good again, by the fault before; up to the next one.
GOOD = {
    'none': (START, CAMERA_STOPS[0]),
    'camera stops': (CAMERA_STOPS[1] + START, WRONG[0]),
    'told wrong': (WRONG[1] + START, RESET),
    'reset': (RESET + START, END),
}
# Without publication: after `max_coast`, and while a parameter is known to be wrong.
QUIET = {
    'camera stops': (CAMERA_STOPS[0] + 2.0 + 0.2, CAMERA_STOPS[1]),
    'told wrong': (WRONG[0] + 0.3, WRONG[1]),
}
WRONG_HEALTH = Assessment((Finding(Code.TIME_OFFSET, FindingState.WRONG, Why.INDEPENDENT),))


def within(seconds: float, span: tuple[float, float]) -> bool:
    return span[0] <= seconds < span[1]


def imu_message(sample: ImuSample) -> Imu:
    return build.imu(
        build.rclpy_types, sample.stamp_ns, sample.angular_velocity, sample.linear_acceleration
    )


def pairs_message(pair: PublishedPair, health: Assessment) -> Any:
    """Message on ``~/pairs``, as of relpose_node."""
    return build.pair_messages(pair_result(pair, health), build.rclpy_types)['pairs']


def pair_result(pair: PublishedPair, health: Assessment) -> PairResult:
    pose = RelativePose(Status(pair.status))
    if pair.images is not None:
        zero = np.zeros(3)
        eye = np.eye(6)
        pose = replace(
            pose,
            R=pair.images.R,
            t=pair.images.t,
            images=pair.images,
            linear_velocity1=zero,
            linear_velocity2=zero,
            angular_velocity1=zero,
            angular_velocity2=zero,
            covariance=1e-6 * eye,
            velocity_covariance=eye,
            baseline=pair.baseline,
            baseline_log_sigma=pair.baseline_log_sigma,
        )
    none = np.zeros((0, 3))
    return PairResult(
        pair.reference_imu_ns,
        pair.stamp_ns,
        pair.reference_imu_ns,
        pair.current_imu_ns,
        pair.frame_id,
        0.15,
        pose,
        replace(Matches.none(), rays=np.zeros((2, 0, 3)), row_times=np.zeros((2, 0))),
        10.0,
        lambda: Landmarks(none[:, :2], none[:, :2], none),
        gyro_bias=pair.gyro_bias,
        health=health,
    )


@pytest.mark.parametrize(
    'code, state, why, stops',
    [
        (Code.ACCEL_AXES, FindingState.SUSPECT, Why.OPPOSITE, True),
        (Code.ACCEL_AXES, FindingState.OK, Why.CONSISTENT, False),
        (Code.TIME_OFFSET, FindingState.SUSPECT, Why.OFF, False),
        (Code.TIME_OFFSET, FindingState.WRONG, Why.OFF, True),
    ],
)
def test_a_contradicted_accelerometer_stops_the_path(code, state, why, stops):
    finding = Finding(
        code,
        state,
        why,
        (0.0,),
        (0.01,),
        1e-3,
        's',
        evidence=Evidence(shift=2.0, log_likelihood=-20.0),
        settings={'time_offset': 0.01},
    )
    unknown = Finding(Code.AXES, FindingState.UNKNOWN, Why.NOT_OBSERVABLE)
    health = Assessment((unknown, finding))
    pair = walk('walk:2', 1.0).pairs[0]
    expected = finding if stops else None
    assert contradiction(PublishedPair.of_result(pair_result(pair, health))) == expected
    assert contradiction(PublishedPair.of_status(pairs_message(pair, health))) == expected


def test_a_path_ends_with_the_whole_text_of_a_finding():
    """Of wrong axes it holds ';' and quotes, and all of it comes over ~/pairs."""
    given = walk('walk:2', 8.0)
    estimator = OdometryEstimator(PARAMETERS)
    for sample in given.samples:
        estimator.add_imu(sample)
    for pair in given.pairs[:-1]:
        estimator.add_pair(PublishedPair.of_status(pairs_message(pair, Assessment(()))))
    estimator.take(end=True)
    estimator.warnings()
    wrong = pairs_message(given.pairs[-1], Assessment((build.WRONG_AXES,)))
    received = deserialize_message(serialize_message(wrong), DiagnosticArray)
    estimator.add_pair(PublishedPair.of_status(received))
    estimator.take(end=True)
    assert estimator.warnings()[-1].text == f'lost: axes wrong: {build.WRONG_AXES_TEXT}'


# Values of a message on ~/pairs that no relpose_node publishes, and what is said of them.
BAD_PAIRS = {
    'covariance zero': ('image_information', ' '.join(['1e30'] * 66), 'positive semidefinite'),
    'no information': ('image_information', ' '.join(['0'] * 66), 'positive semidefinite'),
    'negative covariance': ('image_information', ' '.join(['-1'] * 66), 'positive semidefinite'),
    'NaN': ('image_information', ' '.join(['nan'] * 66), 'must be finite'),
    'NaN of the rotation': ('image_rotation_xyzw', 'nan 0 0 1', 'image_rotation_xyzw of ~/pairs'),
    'no rotation': ('image_rotation_xyzw', '0 0 0 0', 'image_information of ~/pairs'),
    'infinite baseline': ('baseline_m', 'inf', 'baseline_m of ~/pairs must be finite'),
    'backwards in time': ('current_imu_ns', str(START_NS - SECOND), 'must be later than'),
    'no float32': ('image_by_deviation', 'AAAA', 'finite float32 in base64'),
    'other unknowns': ('image_by_deviation', 'AAAAAA==', '11 x 9 numbers, got 1'),
    'no findings': ('findings', '', 'findings of a message'),
    'another cause': ('findings', '[{"code": "the moon"}]', 'findings of a message'),
    'nested findings': ('findings', '[' * 90_000, 'findings of a message'),
    'another state': ('health', 'wrong', 'health of ~/pairs must be unknown'),
    'far in the future': ('current_imu_ns', str(START_NS + 1000 * SECOND), 'less than 100 s'),
}


@pytest.mark.parametrize('case', BAD_PAIRS)
def test_an_impossible_pair_is_refused_with_the_reason(case):
    key, text, said = BAD_PAIRS[case]
    message = pairs_message(walk('walk:2', 1.0).pairs[0], Assessment(()))
    PublishedPair.of_status(message)
    [value] = [item for item in message.status[0].values if item.key == key]
    value.value = text
    with pytest.raises(InputError, match=re.escape(said)):
        PublishedPair.of_status(message)


def stream(given: Walk) -> Iterator[tuple[float, Any]]:
    """Messages and their times [s] of arrival."""
    for sample in given.samples:
        yield (sample.stamp_ns - START_NS) / SECOND + IMU_DELAY, imu_message(sample)
    for pair in given.pairs:
        begin, end = (
            (ns - START_NS) / SECOND for ns in (pair.reference_imu_ns, pair.current_imu_ns)
        )
        if any(begin < time <= end for time in CAMERA_STOPS) or within(end, CAMERA_STOPS):
            continue
        wrong = within(end, WRONG)
        if wrong:
            pair = replace(pair, status='WITHHELD', images=None)
        yield end + PAIR_DELAY, pairs_message(pair, WRONG_HEALTH if wrong else Assessment(()))


def vector_of(value: Any) -> np.ndarray:
    return np.array([getattr(value, axis) for axis in 'xyzw' if hasattr(value, axis)])


def positions_of(published: list[Odometry], base: Base | None = None) -> np.ndarray:
    """Positions, with a `base` those of the camera on it."""
    on_base = np.zeros(3) if base is None else base.position
    return np.array(
        [
            vector_of(pose.position) + rotation_of(pose) @ on_base
            for pose in (one.pose.pose for one in published)
        ]
    )


def rotation_of(pose: Any) -> np.ndarray:
    return Rotation.from_quat(vector_of(pose.orientation)).as_matrix()


def assert_metric(
    published: list[Odometry],
    truth: TrueTrajectory,
    ate: float,
    scale_error: float,
    base: Base | None = None,
) -> None:
    """RMS error [m] and scale after alignment."""
    known = [message for message in published if truth.covers(stamp_of(message))]
    true = np.array([truth.position(stamp_of(message)) for message in known])
    R, t, scale = aligned(positions := positions_of(known, base), true)
    assert np.sqrt(((positions @ R.T + t - true) ** 2).sum(axis=1).mean()) < ate
    assert scale == pytest.approx(1.0, abs=scale_error)


def largest_tilt(published: list[Odometry], truth: TrueTrajectory, base: Base) -> float:
    """Largest error [deg] of the vertical in the axes of the camera."""
    up = np.array([0.0, 0.0, 1.0])
    cosines = [
        (rotation_of(message.pose.pose) @ base.R).T @ up @ (truth.rotation(stamp).T @ up)
        for message in published
        if truth.covers(stamp := stamp_of(message))
    ]
    return float(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).max())


@pytest.fixture(scope='module')
def session(module_ros_domain_id: int) -> Iterator[SimpleNamespace]:
    """What the node published during the walk; `published` of a span of it."""
    given = walk(f'walk:{END + 1:g}', END, imu_rate=IMU_RATE)
    events = sorted(stream(given), key=lambda event: event[0])
    parameters = {
        'quat_cam_imu_xyzw': list(QUAT),
        'imu_position': list(LEVER),
        'gyro_bias': list(PARAMETERS.imu.gyro_bias),
        'max_coast': 2.0,
        # A busy machine must not lose samples: that is not what is tested.
        f'qos_overrides.{BAG_TOPICS["imu"]}.subscription.reliability': 'reliable',
    }
    with (
        Graph() as graph,
        node_process(
            BUNDLED_PARAMETERS,
            remap={'imu': BAG_TOPICS['imu']},
            parameters=parameters,
            node='odometry_node',
        ) as node,
    ):
        received = graph.listen(Odometry, f'{OWN}/odometry')
        paths = graph.listen(PathMessage, f'{OWN}/path')
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        node.wait_for('ready')
        graph.wait_for_publisher(f'{OWN}/odometry')
        publishers = {
            DiagnosticArray: graph.publisher(DiagnosticArray, '/relpose_node/pairs'),
            Imu: graph.publisher(Imu, BAG_TOPICS['imu']),
        }

        def play(begin: float, end: float) -> None:
            publish_in_time(
                (publishers[type(message)], round(at * SECOND / FASTER), message)
                for at, message in events
                if begin <= at < end
            )

        play(-math.inf, RESET)
        wait_until_quiet(lambda: len(received), 1.0, node)
        reset = graph.call(Trigger, f'{OWN}/reset', Trigger.Request())
        play(RESET, math.inf)
        count = len(paths)
        wait_until(lambda: len(paths) > count + 1, 'a path', node)
        silent = len(diagnostics)
        wait_until(lambda: len(diagnostics) > silent + 2, 'diagnostics', node)
        assert node.signal(signal.SIGINT)[0] == 0
        print(node.output)
        yield SimpleNamespace(
            walk=given,
            diagnostics=diagnostics,
            output=node.output,
            reset=reset,
            path_after_reset=paths[-1],
            published=lambda span: [
                message
                for message in received
                if within((stamp_of(message) - START_NS) / SECOND, span)
            ],
        )


@pytest.mark.parametrize('fault', GOOD)
def test_the_path_continues_and_is_metric(session, fault):
    published = session.published(GOOD[fault])
    # At 30 Hz of a walk that is played faster, less what a busy machine loses.
    assert len(published) > 5 * (GOOD[fault][1] - GOOD[fault][0])
    assert_metric(published, session.walk.truth, 0.05, 0.1)


@pytest.mark.parametrize('fault', QUIET)
def test_nothing_is_published_without_a_pose(session, fault):
    assert session.published(QUIET[fault]) == []


def test_faults_are_reported(session):
    lines = session.output.splitlines()
    for expected in (
        'uncertain: no usable pair for 0.',
        'lost: no usable pair for 2 s',
        'lost: time_offset wrong: images and gyro rotate independently of each other',
    ):
        [line] = [line for line in lines if expected in line]
        assert line.startswith('[ERROR]') == expected.startswith('lost')
    assert 'Traceback' not in session.output
    [status] = session.diagnostics[-1].status
    assert re.fullmatch(
        r'no message on /relpose_node/pairs for \d+ s and '
        rf'{BAG_TOPICS["imu"]} for \d+ s: start or remap what publishes it .*',
        status.message,
    )
    values = diagnostic_values(session.diagnostics[-1])
    assert values['lost'] == '2'
    assert int(values['calibration_contradicted']) >= 3
    assert values['state'] == 'lost'  # the IMU is silent


def test_the_imu_propagates_the_path_while_the_camera_stops(session):
    ends = [
        session.published((0.0, CAMERA_STOPS[0]))[-1],
        session.published((CAMERA_STOPS[1], WRONG[0]))[0],
    ]
    true = [session.walk.truth.position(stamp_of(message)) for message in ends]
    sigmas = [math.sqrt(sum(message.pose.covariance[k] for k in (0, 7, 14))) for message in ends]
    error = np.linalg.norm(np.diff(positions_of(ends), axis=0)) - np.linalg.norm(
        np.diff(true, axis=0)
    )
    assert abs(error) < 3.0 * sigmas[1] < 4.5
    # The path continues from its propagated state: pairs after the gap correct the way over it.
    assert sigmas[1] > 1.5 * sigmas[0]


def test_reset_restarts_at_the_origin(session):
    assert session.reset.success
    first = session.published((RESET, END))[0]
    before = session.published((RESET - 0.5, RESET))[-1]
    assert np.linalg.norm(positions_of([first])) < 2.0 * START
    assert first.pose.covariance[0] < before.pose.covariance[0]
    stamps = [stamp_of(pose) for pose in session.path_after_reset.poses]
    assert min(stamps) > START_NS + (RESET - 0.2) * SECOND


@pytest.fixture
def own_node(ros_domain_id: int, request: pytest.FixtureRequest) -> Iterator[OdometryNode]:
    """A node in this process, which is not spun; parameter: its rate of publication."""
    rclpy.init(
        args=[
            '--ros-args',
            '--params-file',
            str(BUNDLED_PARAMETERS),
            '-p',
            f'odometry_rate:={getattr(request, "param", 30.0)}',
        ]
    )
    node = OdometryNode()
    yield node
    node.destroy_node()
    rclpy.shutdown()


@pytest.mark.parametrize('own_node', [0.1], indirect=True)
def test_the_imu_is_read_at_a_low_rate_of_publication(own_node):
    assert min(timer.timer_period_ns for timer in own_node.timers) <= SECOND // 10
    assert own_node._read in [timer.callback for timer in own_node.timers]


def test_the_newest_state_is_published_before_pairs_are_used(own_node, monkeypatch):
    """A pair takes the graph some 8 ms, which no state waits for."""
    calls: list[str] = []
    monkeypatch.setattr(own_node._estimator, 'take', lambda most: calls.append('pair') or [])
    monkeypatch.setattr(own_node._continuous, 'at', lambda imu_ns: calls.append('state'))
    own_node._on_pair(pairs_message(walk('walk:2', 1.0).pairs[0], Assessment(())))
    assert own_node._estimator.waiting
    assert calls == []
    own_node._read(publish=True)
    assert calls == ['state', 'pair']


def test_samples_of_another_frame_are_refused_until_reset(own_node, monkeypatch):
    warnings: list[str] = []
    monkeypatch.setattr(own_node, '_warn', warnings.append)
    # The first samples wait until their times are known not to be those of bursts.
    *first, other, again, later = map(imu_message, walk('walk:2', 1.0).samples[:12])
    other.header.frame_id = 'gimbal_imu'
    for message in (*first, other):
        own_node._on_sample(Role.IMU, message)
    assert own_node._estimator.newest_ns == stamp_of(first[-1])
    [warning] = warnings
    assert warning.startswith('a message of gimbal_imu on /imu is not used')
    assert 'remap imu to one IMU' in warning
    own_node._on_sample(Role.IMU, again)
    assert own_node._estimator.newest_ns == stamp_of(again)
    own_node._reset(Trigger.Request(), Trigger.Response())
    other.header.stamp = later.header.stamp
    own_node._on_sample(Role.IMU, other)
    assert own_node._estimator.newest_ns == stamp_of(other)


def fused(messages: list[Odometry], used: list[bool]) -> tuple[np.ndarray, float]:
    """Positions by a Kalman filter of a constant twist, and its innovations squared.

    As ekf_node of robot_localization, which is in no wheel: of position and rotation in odom, and
    the twist in the base; `used` of these 12 are measured. The innovations are the mean per degree
    of freedom.
    """

    def measured(message):
        twist = message.twist.twist
        return (
            vector_of(message.pose.pose.position),
            rotation_of(message.pose.pose),
            np.concatenate([vector_of(twist.linear), vector_of(twist.angular)]),
        )

    (p, R, w), P, nis, path = measured(messages[0]), 1e-2 * np.eye(12), [], []
    for before, message in pairwise(messages):
        dt = (stamp_of(message) - stamp_of(before)) / SECOND
        F = np.eye(12)
        N = np.zeros((12, 12))
        H = np.eye(12)[used]
        F[:3, 3:6], F[:3, 6:9], F[3:6, 9:] = -skew(R @ w[:3]) * dt, R * dt, R * dt
        p = p + R @ w[:3] * dt
        R = R @ exp_so3(w[3:] * dt)
        # Accelerations of 3 m/s^2 and 3 rad/s^2.
        P = F @ P @ F.T + np.diag([1e-8] * 6 + [9.0 * dt**2] * 6)
        z = measured(message)
        e = H @ np.concatenate([z[0] - p, log_so3(z[1] @ R.T), z[2] - w])
        N[:6, :6], N[6:, 6:] = (
            np.reshape(part.covariance, (6, 6)) for part in (message.pose, message.twist)
        )
        S = H @ (P + N) @ H.T
        K = P @ H.T @ np.linalg.inv(S)
        x = K @ e
        P = P - K @ S @ K.T
        p = p + x[:3]
        R = exp_so3(x[3:6]) @ R
        w = w + x[6:]
        nis.append(e @ np.linalg.solve(S, e) / len(e))
        path.append(p)
    return np.array(path), float(np.mean(nis))


# -- next to relpose_node and a player, on the bundled bag ---------------------------------------


def test_path_is_metric_and_that_of_the_replay(ros_domain_id, bundled_bag, tmp_path, monkeypatch):
    """Of a robot with the camera on it, at a place that tf knows."""
    (tmp_path / 'tf2_ros.py').write_text(FAKE_TF2_ROS)
    monkeypatch.setenv(
        'PYTHONPATH',
        os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get('PYTHONPATH')])]),
    )
    monkeypatch.setenv(
        'TF', ' '.join(map(str, ('base_link', 'camera_optical_frame', *BASE_TO_CAMERA)))
    )
    imu = {'imu': BAG_TOPICS['imu']}
    of_base = {'base_frame': 'base_link', 'publish_odometry_tf': True}
    with (
        Graph() as graph,
        node_process(BUNDLED_PARAMETERS, remap=BAG_TOPICS) as relpose,
        node_process(
            BUNDLED_PARAMETERS, remap=imu, parameters=of_base, node='odometry_node'
        ) as node,
    ):
        transforms = graph.listen(TransformStamped, '/sent_transform')
        received = graph.listen(Odometry, '/odometry_node/keyframes')
        propagated = graph.listen(Odometry, '/odometry_node/odometry')
        paths = graph.listen(PathMessage, '/odometry_node/path')
        pairs = graph.listen(DiagnosticArray, '/relpose_node/pairs')
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        relpose.wait_for('ready')
        node.wait_for('ready')
        graph.wait_for_publisher('/odometry_node/odometry')
        # The one of this test, and the node's, which must not miss the first pair.
        wait_until(
            lambda: graph.node.count_subscribers('/relpose_node/pairs') == 2,
            'the subscriptions',
            node,
        )
        # Three topics of relpose_node, the IMU of odometry_node.
        with processes.player_process(bundled_bag, '--subscriptions', '4') as playing:
            assert playing.wait() == 0
        # The last keyframe waits for samples; on a busy machine the last pairs are late.
        wait_until_quiet(lambda: len(received), 2.0, node)
        count = len(paths)
        wait_until(lambda: len(paths) > count, 'a path', node)
        assert len(paths[-1].poses) >= 10
        node.stop()
        relpose.stop()
        assert 'started' in node.output
        # The player ends before the node.
        assert 'lost' not in node.output.replace('lost: no message of the IMU', '')
    values = [
        diagnostic_values(message)
        for message in diagnostics
        if 'odometry_node' in message.status[0].name
    ]
    assert 'tracking' in [value['state'] for value in values]
    keyframes, truth = replayed(bundled_bag, pairs)
    of_keyframes = assert_those_of_the_replay(received, keyframes)
    # By the IMU, at increasing times; the camera's clock is that of the IMU here.
    assert (np.diff([stamp_of(message) for message in propagated]) > 0).all()
    # Twelve frames in all to a keyframe, less what a busy machine loses.
    assert len(propagated) > 2 * len(of_keyframes)
    for messages in (of_keyframes, propagated):
        assert_metric(messages, truth, 0.08, 0.03, BASE)
        # z is up in both: gravity is found. The path of 6 m itself is aligned to 2 deg only.
        assert largest_tilt(messages, truth, BASE) < 2.0
    assert_sent_as_transforms(propagated, transforms)
    assert_fused_by_the_shipped_filter(propagated)


def replayed(bag_path, pairs):
    """Keyframes by their stamps, and the truth: all samples come before the pairs."""
    parameters = read_parameters(BUNDLED_PARAMETERS).updated(
        {'base_frame': 'base_link', 'base_to_camera': BASE_TO_CAMERA}
    )
    estimator = OdometryEstimator(parameters)
    with open_bag(bag_path) as bag:
        topics = bag.find_topics()
        truth = read_truth(bag, topics)
        for message in bag.messages([topics.imu]):
            estimator.add_imu(PARTS[Role.IMU].read(message.message))
    keyframes = {}
    for message in sorted(pairs, key=stamp_of):
        estimator.add_pair(PublishedPair.of_status(message))
        keyframes |= {keyframe.stamp_ns: keyframe for keyframe in estimator.take()}
    return keyframes, truth


def assert_those_of_the_replay(received, keyframes):
    """At least ten messages are of keyframes of the replay, with their poses; these messages."""

    def nearest(message):
        """Stamp of the keyframe next to a message: the order changes the learned offset."""
        return min(keyframes, key=lambda stamp: abs(stamp - stamp_of(message)))

    of_keyframes = [
        message
        for message in received
        if abs(nearest(message) - stamp_of(message)) < SECOND // 2000
    ]
    assert len(of_keyframes) >= 10
    for message, place in zip(of_keyframes, positions_of(of_keyframes), strict=True):
        keyframe = keyframes[nearest(message)]
        q = message.pose.pose.orientation
        # Half a millisecond apart at 1.2 m/s and 60 deg/s.
        np.testing.assert_allclose(place, keyframe.position, atol=2e-3)
        turn = Rotation.from_quat([q.x, q.y, q.z, q.w]).inv() * Rotation.from_matrix(keyframe.R)
        assert np.degrees(turn.magnitude()) < 0.04
        assert message.header.frame_id == 'odom'
        assert message.child_frame_id == 'base_link'
    return of_keyframes


def assert_sent_as_transforms(propagated, transforms):
    """Nearly all poses are sent as transforms, too."""
    by_stamp = {stamp_of(message): message.pose.pose for message in propagated}
    assert len(transforms) > 0.9 * len(propagated)
    for sent in transforms:
        assert (sent.header.frame_id, sent.child_frame_id) == ('odom', 'base_link')
        if pose := by_stamp.get(stamp_of(sent)):
            np.testing.assert_equal(
                vector_of(sent.transform.translation), vector_of(pose.position)
            )


def assert_fused_by_the_shipped_filter(propagated):
    """Pose and twist agree in a filter, and the twist alone leads along the poses.

    Found on a replay: 2.7, and 2400 with the twist in the axes of the camera; live on a busy
    machine, where corrections are late and larger, 5.1. A twist without the lever arm (7.2) shows
    in its path: 0.22 m.
    """
    text = (ROOT / 'config' / 'robot_localization.yaml').read_text()
    ekf = yaml.safe_load(text)['ekf_filter_node']['ros__parameters']
    assert ekf['odom0'] == '/odometry_node/odometry'
    assert ekf['publish_tf']
    assert not read_parameters(BUNDLED_PARAMETERS).odometry.publish_odometry_tf
    assert (ekf['odom_frame'], ekf['base_link_frame']) == ('odom', 'base_link')
    # A busy machine leaves gaps, in which no twist is constant.
    gaps = np.flatnonzero(np.diff([stamp_of(message) for message in propagated]) > SECOND // 10)
    parts = [
        propagated[begin:end]
        for begin, end in pairwise([0, *(gaps + 1), len(propagated)])
        if end - begin > 10
    ]
    assert sum(map(len, parts)) > 30
    for part in parts:
        poses = positions_of(part)[1:]
        path, nis = fused(part, ekf['odom0_config'][:12])
        assert np.linalg.norm(path - poses, axis=1).max() < 0.1
        assert nis < 20.0
        path, _ = fused(part, [False] * 6 + [True] * 6)
        assert np.linalg.norm(path - poses, axis=1).max() < 0.15


def test_the_position_of_the_imu_is_that_of_tf_before_the_path_begins():
    def placed(starts: list[Any], camera: str = 'camera') -> Any:
        node = MagicMock(_imu_lookup=lambda parent, child: (0.1, 0.2, 0.3, *QUAT))
        node._settings.current = PARAMETERS.updated(
            {'imu_position': (0.0, 0.0, 0.0), 'quat_cam_imu_xyzw': tuple(QUAT)}
        )
        node._estimator.starts = starts
        OdometryNode._place_imu(node, camera, 'imu')
        return node._settings.adopt

    placed([]).assert_called_once_with(
        {'imu_position': (0.1, 0.2, 0.3), 'imu_position_sigma': 0.02}
    )
    assert not placed([object()]).called and not placed([], 'imu').called
