"""odometry_node as a process: one walk over Fast DDS, one fault after the other, and the way back.

Pairs are the truth plus noise, put into messages by the package. They are played faster than in
real time, as the node goes by stamps, and with fewer samples instead.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
import math
import re
import signal
from typing import Any

from conftest import BUNDLED_PARAMETERS
from diagnostic_msgs.msg import DiagnosticArray
from fault_stream import BAG_TOPICS, publish_in_time, SECOND, stamp_of
import message_builders as build
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
import numpy as np
import pytest
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger
from test_odometry import LEVER, PARAMETERS, QUAT, START_NS, Walk, walk

from rs_relpose_lab.live.graph import diagnostic_values, Graph
from rs_relpose_lab.live.processes import node_process, wait_until, wait_until_quiet
from rs_relpose_ros.estimator.landmarks import Landmarks
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.health.findings import Finding, Health, HealthState
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.messages.outgoing import pair_messages
from rs_relpose_ros.odometry.measurement import PairMeasurement
from rs_relpose_ros.odometry.trajectory import aligned
from rs_relpose_ros.tracking.matches import Matches

# The node may have to compile the kernels.
pytestmark = [pytest.mark.live, pytest.mark.timeout(600)]

OWN = '/odometry_node'
FASTER, IMU_RATE = 1.5, 100.0
# What happens, in seconds of the walk.
CAMERA_STOPS, IMU_GAP = (3.4, 6.6), (8.8, 9.1)
CLOCKS_BACK, BACK = 11.3, 100.0
LATE_IMU = (13.5, 13.9)   # its samples come at its end
TOLD_WRONG, RESET, END = (14.5, 15.2), 17.4, 19.8
# A pair comes so much after its image, a sample after its instant.
PAIR_DELAY, IMU_DELAY = 0.06, 0.002
# Longest start in motion, and the delay of a message, on a busy machine too.
START = 1.6
# Where all is good again, by the fault before; up to the next one.
GOOD = {'none': (START, CAMERA_STOPS[0]),
        'camera stops': (CAMERA_STOPS[1] + START, IMU_GAP[0]),
        'IMU gap': (IMU_GAP[1] + START, CLOCKS_BACK),
        'clocks back': (CLOCKS_BACK + START, LATE_IMU[0]),
        'late IMU': (LATE_IMU[0], TOLD_WRONG[0]),
        'told wrong': (TOLD_WRONG[1] + START, RESET), 'reset': (RESET + START, END)}
# Where nothing may be told: after `max_coast`, and once the pairs are known to be wrong.
QUIET = {'camera stops': (CAMERA_STOPS[0] + 2.0 + 0.2, CAMERA_STOPS[1]),
         'told wrong': (TOLD_WRONG[0] + 0.3, TOLD_WRONG[1])}
WRONG = Health((Finding('time_offset', 0.03, 0.0, 1e-3, 's', True, HealthState.WRONG, 'off'),))


def within(seconds: float, span: tuple[float, float]) -> bool:
    return span[0] <= seconds < span[1]


def shifted(ns: int) -> int:
    """As a clock shows it that was set back."""
    return ns - (round(BACK * SECOND) if ns >= START_NS + CLOCKS_BACK * SECOND else 0)


def imu_message(sample: ImuSample) -> Imu:
    message = Imu(header=build.header(build.rclpy_types, shifted(sample.stamp_ns), 'imu'))
    for vector, values in ((message.angular_velocity, sample.angular_velocity),
                           (message.linear_acceleration, sample.linear_acceleration)):
        vector.x, vector.y, vector.z = map(float, values)
    return message


def pairs_message(pair: PairMeasurement, health: Health) -> Any:
    """On ``~/pairs``, as relpose_node tells it."""
    return pair_messages(pair_result(pair, health), build.rclpy_types).pairs


def pair_result(pair: PairMeasurement, health: Health) -> PairResult:
    pose = RelativePose(Status(pair.status))
    if pair.images is not None:
        zero, eye = np.zeros(3), np.eye(6)
        pose = replace(pose, R=pair.images.R, t=pair.images.t, images=pair.images,
                       linear_velocity1=zero, linear_velocity2=zero, angular_velocity1=zero,
                       angular_velocity2=zero, covariance=1e-6 * eye, velocity_covariance=eye,
                       baseline=pair.baseline, baseline_log_sigma=pair.baseline_log_sigma)
    none = np.zeros((0, 3))
    return PairResult(
        shifted(pair.reference_ns), shifted(pair.stamp_ns), shifted(pair.reference_ns),
        shifted(pair.current_ns), pair.frame_id, 0.15, pose, Matches.none(), none[:, 0],
        none[:, 0], none, none, 10.0, Landmarks(none[:, :2], none[:, :2], none),
        gyro_bias=pair.gyro_bias, health=health)


@pytest.mark.parametrize('figure, state, stops', [
    ('accel_axes', HealthState.SUSPECT, True), ('accel_axes', HealthState.OK, False),
    ('time_offset', HealthState.SUSPECT, False), ('time_offset', HealthState.WRONG, True)])
def test_a_path_stops_where_its_accelerometer_is_contradicted(figure, state, stops):
    health = Health((Finding(figure, None, None, None, '', True, state, 'because'),))
    pair = walk('walk:2', 1.0).pairs[0]
    assert PairMeasurement.of_result(pair_result(pair, health)).told_wrong is stops
    assert PairMeasurement.of_message(pairs_message(pair, health)).told_wrong is stops


def stream(given: Walk) -> Iterator[tuple[float, Any]]:
    """Messages and their times [s] of arrival."""
    for sample in given.samples:
        at = (sample.stamp_ns - START_NS) / SECOND
        if not within(at, IMU_GAP):
            late = LATE_IMU[1] if within(at, LATE_IMU) else at
            yield late + IMU_DELAY, imu_message(sample)
    for pair in given.pairs:
        begin, end = ((ns - START_NS) / SECOND for ns in (pair.reference_ns, pair.current_ns))
        lost = any(begin < instant <= end for instant in (*CAMERA_STOPS, CLOCKS_BACK))
        if not lost and not within(end, CAMERA_STOPS):
            wrong = within(end, TOLD_WRONG)
            if wrong:
                pair = replace(pair, status='WITHHELD', images=None)
            yield end + PAIR_DELAY, pairs_message(pair, WRONG if wrong else Health(()))


@dataclass(frozen=True)
class Session:
    walk: Walk
    received: list[Odometry]
    diagnostics: list[DiagnosticArray]
    output: str
    reset: Any
    path_after_reset: PathMessage

    def told(self, span: tuple[float, float]) -> list[tuple[int, Odometry]]:
        """Instants on the walk's clock and messages of a span of the walk."""
        out = []
        for message in self.received:
            stamp = stamp_of(message)
            # What was sent before the clock was set back is later than anything after it.
            stamp += round(BACK * SECOND) if stamp < START_NS - 10 * SECOND else 0
            if within((stamp - START_NS) / SECOND, span):
                out.append((stamp, message))
        return out


@pytest.fixture(scope='module')
def session(module_ros_domain_id: int) -> Iterator[Session]:
    given = walk(f'walk:{END + 1:g}', END, imu_rate=IMU_RATE)
    events = sorted(stream(given), key=lambda event: event[0])
    parameters = {'quat_cam_imu_xyzw': list(QUAT), 'imu_position': list(LEVER),
                  'gyro_bias': list(PARAMETERS.imu.gyro_bias),
                  # A busy machine must not lose samples: that is not what is tested.
                  f'qos_overrides.{BAG_TOPICS["imu"]}.subscription.reliability': 'reliable'}
    with Graph() as graph, node_process(
            BUNDLED_PARAMETERS, remap={'imu': BAG_TOPICS['imu']}, parameters=parameters,
            folder='odometry') as node:
        received = graph.listen(Odometry, f'{OWN}/odometry')
        paths = graph.listen(PathMessage, f'{OWN}/path')
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        node.wait_for('ready')
        graph.wait_for_publisher(f'{OWN}/odometry')
        publishers = {DiagnosticArray: graph.publisher(DiagnosticArray, '/relpose_node/pairs'),
                      Imu: graph.publisher(Imu, BAG_TOPICS['imu'])}

        def play(begin: float, end: float) -> None:
            publish_in_time((publishers[type(message)], round(at * SECOND / FASTER), message)
                            for at, message in events if begin <= at < end)

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
        yield Session(given, received, diagnostics, node.output, reset, paths[-1])


@pytest.mark.parametrize('fault', list(GOOD))
def test_the_path_goes_on_and_is_metric(session, fault):
    told = session.told(GOOD[fault])
    places = np.array([[message.pose.pose.position.x, message.pose.pose.position.y,
                        message.pose.pose.position.z] for _, message in told])
    true = np.array([session.walk.truth.position(at) for at, _ in told])
    # At 30 Hz, less what a busy machine loses.
    assert len(told) > 10 * (GOOD[fault][1] - GOOD[fault][0])
    R, t, scale = aligned(places, true)
    assert np.sqrt(((places @ R.T + t - true) ** 2).sum(axis=1).mean()) < 0.05
    assert scale == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize('fault', list(QUIET))
def test_nothing_is_told_of_what_is_not_known(session, fault):
    assert session.told(QUIET[fault]) == []


def test_it_says_what_happened(session):
    for sentence in ('lost: the IMU has a gap', 'lost: no pair for 2 s',
                     'lost: the clock of the IMU was set back',
                     'stopped: what was told of camera or IMU is wrong'):
        assert session.output.count(sentence) == 1, sentence
    assert 'Traceback' not in session.output
    values = diagnostic_values(session.diagnostics[-1])
    assert values['lost'] == '4'
    assert int(values['told_wrong']) >= 4
    assert values['state'] == 'tracking'


def test_the_imu_carries_the_path_over_a_stop_of_the_camera(session):
    before, after = session.told((0.0, CAMERA_STOPS[0]))[-1], session.told(
        (CAMERA_STOPS[1], IMU_GAP[0]))[0]
    known, sigmas = session.walk.truth, [math.sqrt(sum(
        message.pose.covariance[k] for k in (0, 7, 14))) for _, message in (before, after)]
    error = np.linalg.norm(place_of(after) - place_of(before)) - np.linalg.norm(
        known.position(after[0]) - known.position(before[0]))
    assert abs(error) < 3.0 * sigmas[1] < 4.5
    assert sigmas[1] > 3.0 * sigmas[0]
    # Without IMU, place and heading are lost, and nothing after it knows them again.
    for later in ((IMU_GAP[1], CLOCKS_BACK), (CLOCKS_BACK, TOLD_WRONG[0]), (TOLD_WRONG[1], RESET)):
        assert session.told(later)[-1][1].pose.covariance[0] > 1.0


def place_of(told: tuple[int, Odometry]) -> np.ndarray:
    p = told[1].pose.pose.position
    return np.array([p.x, p.y, p.z])


def test_reset_starts_anew_at_the_origin(session):
    assert session.reset.success
    first, sigma = session.told((RESET, END))[0], session.told((RESET - 0.5, RESET))[-1]
    assert np.linalg.norm(place_of(first)) < 2.0 * START
    assert first[1].pose.covariance[0] < sigma[1].pose.covariance[0]
    stamps = [stamp_of(pose) for pose in session.path_after_reset.poses]
    assert min(stamps) > shifted(round(START_NS + RESET * SECOND)) - 0.2 * SECOND


def test_the_imu_is_read_though_little_is_published(ros_domain_id):
    with Graph() as graph, node_process(
            BUNDLED_PARAMETERS, remap={'imu': BAG_TOPICS['imu']},
            parameters={'odometry_rate': 0.1}, folder='odometry') as node:
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        node.wait_for('ready')
        imu = graph.publisher(Imu, BAG_TOPICS['imu'])
        samples = walk('walk:7', 6.0, imu_rate=IMU_RATE).samples
        publish_in_time((imu, sample.stamp_ns - START_NS, imu_message(sample))
                        for sample in samples)
        [status] = diagnostics[-1].status
        assert re.fullmatch(r'no message on /relpose_node/pairs for \d+ s', status.message)


def test_silence_is_told(session):
    [status] = session.diagnostics[-1].status
    assert re.fullmatch(r'no message on /relpose_node/pairs for \d+ s and '
                        rf'{BAG_TOPICS["imu"]} for \d+ s', status.message)
