"""The node and a player as processes over DDS, on the bundled bag."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
import signal
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
import numpy as np
import pytest
import ros_graph
from scipy.spatial.transform import Rotation, Slerp
from sensor_msgs.msg import PointCloud2, TimeReference

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.estimator.estimate import warm_up
from rs_relpose_ros.messages.outgoing import MATCH_DTYPE, quat_xyzw
from rs_relpose_ros.replay.run import Replay

# Whoever comes first compiles the kernels.
pytestmark = pytest.mark.timeout(600)

REMAP = ros_graph.BAG_TOPICS
PARAMETER_FILE = ros_graph.ROOT / 'bags' / 'hand_held.yaml'


@pytest.fixture(scope='module', autouse=True)
def kernels() -> None:
    warm_up()


@dataclass(frozen=True)
class LiveRun:
    """What the node published while the bag was played, and what it wrote."""

    poses: list[PoseWithCovarianceStamped]
    references: list[TimeReference]
    velocities: list[TwistWithCovarianceStamped]
    matches: list[PointCloud2]
    diagnostics: list[DiagnosticArray]
    stamps: list[int]
    output: str
    exit_code: int


def play(bag: Path) -> None:
    with ros_graph.Process('rs_relpose_lab.live.player', str(bag),
                           '--wait-for-subscribers', '30') as player:
        assert player.wait() == 0, player.output


def ros_stamp(stamp: Any) -> int:
    return stamp.sec * 10**9 + stamp.nanosec


@pytest.fixture(scope='module')
def run(module_ros_domain_id: int, bundled_bag: Path,
        tmp_path_factory: pytest.TempPathFactory) -> LiveRun:
    stamps_file = tmp_path_factory.mktemp('live') / 'stamps.txt'
    own = '/relpose_node'
    with ros_graph.Graph() as graph, ros_graph.node_process(
            PARAMETER_FILE, remap=REMAP, parameters={'stamps_file': stamps_file}) as node:
        poses = graph.listen(PoseWithCovarianceStamped, f'{own}/relative_pose')
        references = graph.listen(TimeReference, f'{own}/reference')
        velocities = graph.listen(TwistWithCovarianceStamped, f'{own}/velocity')
        matches = graph.listen(PointCloud2, f'{own}/matches')
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        node.wait_for('ready')
        ros_graph.wait_until(
            lambda: graph.node.count_publishers(f'{own}/matches') > 0, 'discovery')
        play(bundled_bag)
        count = len(diagnostics)
        # The report after the last frame.
        ros_graph.wait_until(lambda: len(diagnostics) >= count + 2, 'diagnostics')
        code, _ = node.signal(signal.SIGTERM)
        return LiveRun(poses, references, velocities, matches, diagnostics,
                       [int(line) for line in stamps_file.read_text().split()], node.output, code)


def test_poses_arrive(run):
    assert len(run.poses) >= 10
    stamps = [ros_stamp(message.header.stamp) for message in run.poses]
    assert stamps == sorted(set(stamps))
    assert set(stamps) <= set(run.stamps)
    for message in run.poses:
        assert message.header.frame_id == 'camera_optical_frame_reference'
        position, orientation = message.pose.pose.position, message.pose.pose.orientation
        assert np.linalg.norm([position.x, position.y, position.z]) == pytest.approx(1.0, abs=1e-9)
        assert orientation.w >= 0.0
        covariance = np.reshape(message.pose.covariance, (6, 6))
        np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9)
        assert (np.linalg.eigvalsh(covariance) > -1e-12).all()
        assert (np.diag(covariance)[3:] > 0.0).all()


def test_messages_of_a_pair_belong_together(run):
    stamps = [ros_stamp(message.header.stamp) for message in run.poses]
    for others in (run.references, run.velocities, run.matches):
        assert [ros_stamp(message.header.stamp) for message in others] == stamps
    for reference, stamp in zip(run.references, stamps, strict=True):
        assert ros_stamp(reference.time_ref) in run.stamps
        assert ros_stamp(reference.time_ref) < stamp
    for cloud in run.matches:
        records = np.frombuffer(cloud.data, dtype=MATCH_DTYPE)
        assert len(records) == cloud.width >= 15
        assert len(set(records['id'].tolist())) == len(records)
        assert (records['tau1'] >= 0.0).all()
        assert (records['tau2'] <= 0.03).all()


def test_poses_are_those_of_the_truth(run, bundled_bag):
    with open_bag(bundled_bag) as bag:
        truth = [item.message for item in bag.messages(
            [topic for topic in bag.topics if topic.name == '/ground_truth/pose'])]
    times = np.array([ros_stamp(message.header.stamp) for message in truth])
    positions = np.array([[p.x, p.y, p.z] for p in (m.pose.position for m in truth)])
    rotations = Slerp((times - times[0]) * 1e-9, Rotation.from_quat(
        [[q.x, q.y, q.z, q.w] for q in (m.pose.orientation for m in truth)]))

    def true_pose(stamp: int) -> tuple[Rotation, np.ndarray]:
        seconds = (stamp - times[0]) * 1e-9
        return rotations(seconds), np.array([np.interp(
            seconds, (times - times[0]) * 1e-9, positions[:, axis]) for axis in range(3)])

    rotation_errors, translation_errors = [], []
    for message, reference in zip(run.poses, run.references, strict=True):
        R1, p1 = true_pose(ros_stamp(reference.time_ref))
        R2, p2 = true_pose(ros_stamp(message.header.stamp))
        position, q = message.pose.pose.position, message.pose.pose.orientation
        R = Rotation.from_quat([q.x, q.y, q.z, q.w])
        rotation_errors.append(np.degrees(((R1.inv() * R2).inv() * R).magnitude()))
        t = R1.inv().apply(p2 - p1)
        cosine = t @ [position.x, position.y, position.z] / np.linalg.norm(t)
        translation_errors.append(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    # The project's own aim on this bag.
    assert np.median(rotation_errors) <= 0.15
    assert np.median(translation_errors) <= 3.0


def test_replay_of_the_same_frames_is_bit_equal(run, bundled_bag):
    with open_bag(bundled_bag) as bag:
        replay = Replay(bag, bag.find_topics(), read_parameters(PARAMETER_FILE),
                        stamps=frozenset(run.stamps))
        replayed = {pair.result.stamp_ns: pair.result for pair in replay.pairs()
                    if pair.result.pose}
    live = {ros_stamp(message.header.stamp): message for message in run.poses}
    assert list(live) == list(replayed)
    for stamp, message in live.items():
        pose = replayed[stamp].pose
        position, q = message.pose.pose.position, message.pose.pose.orientation
        assert [position.x, position.y, position.z] == pose.t.tolist()
        assert [q.x, q.y, q.z, q.w] == quat_xyzw(pose.R).tolist()
        assert list(message.pose.covariance) == pose.covariance.ravel().tolist()


def test_diagnostics_tell_what_happened(run):
    values = ros_graph.diagnostic_values(run.diagnostics[-1])
    assert run.diagnostics[-1].status[0].name == '/relpose_node: relative pose'
    refused = sum(int(value) for key, value in values.items() if key.startswith('frames_refused_'))
    assert int(values['frames_received']) == 180 == int(values['frames_processed']) + refused
    assert int(values['frames_processed']) == len(run.stamps)
    # A camera that outruns a busy machine is the only reason to leave a frame out.
    assert refused == int(values['frames_refused_overload'])
    assert int(values['poses']) == len(run.poses) <= int(values['pairs'])
    assert int(values['imu_samples']) == 1246
    assert (values['imu_gaps'], values['messages_invalid'], values['frames_failed']) == (
        '0', '0', '0')
    assert values['model'] == 'uniform'
    assert 0.0 < float(values['inlier_ratio']) <= 1.0
    assert 0.0 < float(values['latency_p50_ms']) <= float(values['latency_p99_ms'])
    # The bag holds a standstill and a pure rotation.
    assert values['last_reason_no_pose'].split(':')[0] in ('PURE_ROTATION', 'LOW_PARALLAX')
    rates = [{key: float(value) for key, value in ros_graph.diagnostic_values(item).items()
              if key.endswith('_rate_hz')} for item in run.diagnostics]
    assert max(rate['image_rate_hz'] for rate in rates) == pytest.approx(30.0, abs=6.0)
    assert max(rate['imu_rate_hz'] for rate in rates) == pytest.approx(200.0, abs=40.0)
    times = [ros_stamp(item.header.stamp) for item in run.diagnostics]
    assert np.median(np.diff(times)) == pytest.approx(1e9, rel=0.2)


def test_a_good_run_ends_well_and_says_little(run):
    assert run.exit_code == 0
    assert run.output.count('ready') == 1
    assert 'ERROR' not in run.output
    assert 'Traceback' not in run.output
    # At most that the machine was busy.
    assert run.output.count('[WARN]') == run.output.count('(overload)') <= 1


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM] * 2)
def test_signals_end_a_working_node(module_ros_domain_id, bundled_bag, number):
    with ros_graph.Graph() as graph, ros_graph.node_process(PARAMETER_FILE, remap=REMAP) as node:
        poses = graph.listen(PoseWithCovarianceStamped, '/relpose_node/relative_pose')
        with ros_graph.Process('rs_relpose_lab.live.player', str(bundled_bag),
                               '--wait-for-subscribers', '300'):
            ros_graph.wait_until(lambda: poses, 'a pose')
            code, seconds = node.signal(number)
        assert code == 0, node.output
        assert seconds <= 1.0
        assert 'Traceback' not in node.output


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signals_that_come_again_and_again(module_ros_domain_id, number):
    """Ctrl-C under ros2 launch: the terminal signals the whole group, and so does launch."""
    for every in (0.002, 0.02, 0.1):
        with ros_graph.node_process(PARAMETER_FILE, remap=REMAP) as node:
            node.wait_for('ready')
            code, _ = node.signal(number, every=every)
            assert code == 0, node.output
            assert 'Traceback' not in node.output


def test_a_signal_ends_a_node_that_compiles(module_ros_domain_id, tmp_path, monkeypatch):
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path))
    with ros_graph.node_process(PARAMETER_FILE, remap=REMAP) as node:
        node.wait_for('compiling kernels')
        code, seconds = node.signal(signal.SIGTERM)
        assert code == 0, node.output
        # The compiler lets go of the interpreter only now and then.
        assert seconds <= 5.0
        assert 'Traceback' not in node.output


@pytest.fixture
def no_bag(tmp_path: Path) -> Path:
    path = tmp_path / 'no_bag.mcap'
    path.write_bytes(b'this is no bag')
    return path


@pytest.mark.parametrize(('arguments', 'sentence'), [
    (['{no_bag}'], 'is no MCAP file'),
    (['{bag}', '--topics', '/nothing'], 'has no topic /nothing; it has /camera/camera_info'),
    (['{bag}', '--wait-for-subscribers', '0.2'], 'nobody subscribed to'),
])
def test_the_player_says_what_is_wrong(module_ros_domain_id, bundled_bag, no_bag, arguments,
                                       sentence):
    arguments = [item.format(no_bag=no_bag, bag=bundled_bag) for item in arguments]
    with ros_graph.Process('rs_relpose_lab.live.player', *arguments) as player:
        assert player.wait() == 2
        assert sentence in player.output
        assert 'Traceback' not in player.output
