"""The node and a player as processes over DDS, on the bundled bag."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
import signal

from conftest import BUNDLED_PARAMETERS
from diagnostic_msgs.msg import DiagnosticArray
from fault_stream import BAG_TOPICS
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu, PointCloud2, TimeReference

from rs_relpose_lab.live import player
from rs_relpose_lab.live.graph import diagnostic_values, Graph
from rs_relpose_lab.live.processes import node_process, player_process, wait_until
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.messages.incoming import stamp_ns, time_ns
from rs_relpose_ros.messages.outgoing import (
    MATCH_DTYPE,
    pair_messages,
    published_covariance,
    quat_xyzw,
)
from rs_relpose_ros.node.message_types import message_class
from rs_relpose_ros.replay.run import read_truth, Replay

# The node may have to compile the kernels.
pytestmark = [pytest.mark.live, pytest.mark.timeout(600)]


@dataclass(frozen=True)
class Published:
    """What the node published while the bag was played, and what it wrote."""

    poses: list[PoseWithCovarianceStamped]
    rotations: list[Imu]
    pairs: list[DiagnosticArray]
    references: list[TimeReference]
    velocities: list[TwistWithCovarianceStamped]
    matches: list[PointCloud2]
    diagnostics: list[DiagnosticArray]
    stamps: list[int]
    output: str
    exit_code: int
    seconds_to_end: float


@pytest.fixture(scope='module')
def run(module_ros_domain_id: int, bundled_bag: Path,
        tmp_path_factory: pytest.TempPathFactory) -> Published:
    stamps_file = tmp_path_factory.mktemp('live') / 'stamps.txt'
    own = '/relpose_node'
    # All messages are counted: a busy machine loses best effort.
    reliable = {f'qos_overrides.{topic}.subscription.reliability': 'reliable'
                for topic in (f'{BAG_TOPICS["image"]}/compressed', BAG_TOPICS['imu'])}
    with Graph() as graph, node_process(
            BUNDLED_PARAMETERS, remap=BAG_TOPICS,
            parameters={'stamps_file': stamps_file, **reliable}) as node:
        poses = graph.listen(PoseWithCovarianceStamped, f'{own}/relative_pose')
        rotations = graph.listen(Imu, f'{own}/relative_rotation')
        pairs = graph.listen(DiagnosticArray, f'{own}/pairs')
        references = graph.listen(TimeReference, f'{own}/reference')
        velocities = graph.listen(TwistWithCovarianceStamped, f'{own}/velocity')
        matches = graph.listen(PointCloud2, f'{own}/matches')
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        node.wait_for('ready')
        graph.wait_for_publisher(f'{own}/matches')
        graph.wait_for_publisher(f'{own}/pairs')
        with player_process(bundled_bag) as playing:
            assert playing.wait() == 0
        count = len(diagnostics)
        # The report after the last frame.
        wait_until(lambda: len(diagnostics) >= count + 2, 'diagnostics', node)
        code, seconds = node.signal(signal.SIGTERM)
        return Published(
            poses, rotations, pairs, references, velocities, matches, diagnostics,
            [int(line) for line in stamps_file.read_text().split()], node.output, code, seconds)


def test_poses_arrive(run):
    assert len(run.poses) >= 10
    stamps = [stamp_ns(message.header) for message in run.poses]
    assert stamps == sorted(set(stamps))
    assert set(stamps) <= set(run.stamps)
    for message in run.poses:
        assert message.header.frame_id == 'camera_optical_frame_reference'
        position, orientation = message.pose.pose.position, message.pose.pose.orientation
        assert np.linalg.norm([position.x, position.y, position.z]) == pytest.approx(1.0, abs=1e-9)
        assert orientation.w >= 0.0
        covariance = np.reshape(message.pose.covariance, (6, 6))
        np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9)
        assert (np.linalg.eigvalsh(covariance) >= 0.0).all()
        assert (np.diag(covariance)[3:] > 0.0).all()


def test_messages_of_a_pair_belong_together(run):
    stamps = [stamp_ns(message.header) for message in run.poses]
    for others in (run.references, run.velocities, run.matches):
        assert [stamp_ns(message.header) for message in others] == stamps
    for reference, stamp in zip(run.references, stamps, strict=True):
        assert time_ns(reference.time_ref) in run.stamps
        assert time_ns(reference.time_ref) < stamp
    for cloud in run.matches:
        records = np.frombuffer(cloud.data, dtype=MATCH_DTYPE)
        assert len(records) == cloud.width >= 15
        assert len(set(records['id'].tolist())) == len(records)
        assert (records['tau1'] >= 0.0).all()
        assert (records['tau2'] <= 0.03).all()


def test_poses_are_those_of_the_truth(run, bundled_bag):
    with open_bag(bundled_bag) as bag:
        truth = read_truth(bag, bag.find_topics())
    rotation_errors, translation_errors = [], []
    for message, reference in zip(run.poses, run.references, strict=True):
        position, q = message.pose.pose.position, message.pose.pose.orientation
        errors = truth.errors(
            Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(),
            np.array([position.x, position.y, position.z]), time_ns(reference.time_ref),
            stamp_ns(message.header))
        rotation_errors.append(errors.rotation_error)
        translation_errors.append(errors.translation_error)
    # The project's own aim on this bag.
    assert np.median(rotation_errors) <= 0.15
    assert np.median(translation_errors) <= 3.0


def test_replay_of_the_same_frames_is_bit_equal(run, bundled_bag):
    with open_bag(bundled_bag) as bag:
        replay = Replay(bag, bag.find_topics(), read_parameters(BUNDLED_PARAMETERS),
                        stamps=frozenset(run.stamps))
        results = {pair.result.stamp_ns: pair.result for pair in replay.pairs()}
    # Every pair is told, with the same figures.
    assert [told(message) for message in run.pairs] == [
        told(pair_messages(result, message_class).pairs) for result in results.values()]
    assert len(run.rotations) == sum(result.pose.rotation_known for result in results.values())
    for message in run.rotations:
        result = results[stamp_ns(message.header)]
        assert message == pair_messages(result, message_class).relative_rotation
        assert message.header.frame_id == 'camera_optical_frame_reference'
    replayed = {stamp: result for stamp, result in results.items() if result.pose}
    live = {stamp_ns(message.header): message for message in run.poses}
    assert list(live) == list(replayed)
    assert len(replayed) < len(results)
    for stamp, message in live.items():
        pose = replayed[stamp].pose
        position, q = message.pose.pose.position, message.pose.pose.orientation
        assert [position.x, position.y, position.z] == pose.t.tolist()
        assert [q.x, q.y, q.z, q.w] == quat_xyzw(pose.R).tolist()
        assert list(message.pose.covariance) == published_covariance(pose.covariance).tolist()


def told(message: DiagnosticArray) -> tuple[int, dict[str, str]]:
    """Stamp and values of what ~/pairs says."""
    [status] = message.status
    return stamp_ns(message.header), {item.key: item.value for item in status.values}


def test_diagnostics_tell_what_happened(run):
    values = diagnostic_values(run.diagnostics[-1])
    assert run.diagnostics[-1].status[0].name == '/relpose_node: relative pose'
    assert run.diagnostics[-1].status[0].hardware_id == '/camera/image_raw/compressed'
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
    rates = [{key: float(value) for key, value in diagnostic_values(item).items()
              if key.endswith('_rate_hz')} for item in run.diagnostics]
    assert max(rate['image_rate_hz'] for rate in rates) == pytest.approx(30.0, abs=6.0)
    assert max(rate['imu_rate_hz'] for rate in rates) == pytest.approx(200.0, abs=40.0)
    times = [stamp_ns(item.header) for item in run.diagnostics]
    assert np.median(np.diff(times)) == pytest.approx(1e9, rel=0.2)


def test_a_good_run_ends_well_and_says_little(run):
    assert run.exit_code == 0
    assert run.seconds_to_end <= 1.0
    assert run.output.count('ready') == 1
    assert 'ERROR' not in run.output
    assert 'Traceback' not in run.output
    # At most that the machine was busy, and that the player came late.
    assert run.output.count('(overload)') <= 1
    assert run.output.count('[WARN]') == (run.output.count('(overload)')
                                          + run.output.count('no image on'))


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
def test_the_player_says_what_is_wrong(ros_domain_id, bundled_bag, no_bag, arguments, sentence,
                                       capfd):
    arguments = [item.format(no_bag=no_bag, bag=bundled_bag) for item in arguments]
    assert player.main(arguments) == 2
    said = capfd.readouterr().err
    assert sentence in said
    assert 'Traceback' not in said
