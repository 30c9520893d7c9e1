"""The node and a player as processes over DDS; signals; examples; the live benchmark."""

from collections.abc import Iterator
from dataclasses import replace
import importlib.util
from operator import itemgetter
import os
from pathlib import Path
import signal
import time
from types import SimpleNamespace
from typing import Any

from conftest import BUNDLED_PARAMETERS, ROOT
from diagnostic_msgs.msg import DiagnosticArray
import fault_stream as faults
from fault_stream import BAG_TOPICS
import message_builders as build
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments import live, live_clip
from rs_relpose_lab.live.graph import diagnostic_values, Graph
from rs_relpose_lab.live.processes import node_process, player_process, Process, wait_until
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.bags.sensor_topics import COMPRESSED_TOPIC, IMU_TOPIC
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.messages.incoming import stamp_ns, time_ns
from rs_relpose_ros.messages.outgoing import PAIR_TOPICS
from rs_relpose_ros.nodes.diagnostics import FrameTimings
from rs_relpose_ros.nodes.inputs import message_class
from rs_relpose_ros.offline.replay import read_truth, Replay

# The node may have to compile the kernels.
pytestmark = [pytest.mark.live, pytest.mark.timeout(600)]


@pytest.fixture(scope='module', params=['', '1'], ids=['own executor', 'executor of rclpy'])
def run(
    request: pytest.FixtureRequest,
    module_ros_domain_id: int,
    bundled_bag: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> SimpleNamespace:
    """What the node published while the bag was played, and what it wrote."""
    stamps_file = tmp_path_factory.mktemp('live') / 'stamps.txt'
    with (
        pytest.MonkeyPatch.context() as environment,
        Graph() as graph,
    ):
        environment.setenv('RS_RELPOSE_PUBLIC_RCLPY', request.param)
        with node_process(
            BUNDLED_PARAMETERS,
            remap=BAG_TOPICS,
            parameters={
                'stamps_file': stamps_file,
                **faults.reliable(COMPRESSED_TOPIC, IMU_TOPIC),
            },
        ) as node:
            messages, diagnostics = listen_to_a_run(graph, node, bundled_bag)
            code, seconds = node.signal(signal.SIGTERM)
            output = node.output
        return SimpleNamespace(
            messages=messages,
            diagnostics=diagnostics,
            output=output,
            exit_code=code,
            seconds_to_end=seconds,
            stamps=[int(line) for line in stamps_file.read_text().split()],
            fallbacks=int(bool(request.param)),
        )


def listen_to_a_run(graph: Graph, node: Process, bag: Path) -> tuple[dict[str, Any], list[Any]]:
    """Play a bag to a node. Returns its messages by topic, and its reports."""
    messages = {
        topic: graph.listen(message_class(kind), f'/relpose_node/{topic}')
        for topic, kind in PAIR_TOPICS.items()
    }
    diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
    node.wait_for('ready')
    for topic in PAIR_TOPICS:
        graph.wait_for_publisher(f'/relpose_node/{topic}')
    with player_process(bag) as playing:
        assert playing.wait() == 0
    count = len(diagnostics)
    # The report after the last frame.
    wait_until(lambda: len(diagnostics) >= count + 2, 'diagnostics', node)
    return messages, diagnostics


def test_poses_are_those_of_the_truth(run, bundled_bag):
    with open_bag(bundled_bag) as bag:
        truth = read_truth(bag, bag.find_topics())
    errors = []
    for message, reference in zip(
        run.messages['relative_pose'], run.messages['reference'], strict=True
    ):
        position = message.pose.pose.position
        q = message.pose.pose.orientation
        errors.append(
            truth.errors(
                Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(),
                np.array([position.x, position.y, position.z]),
                time_ns(reference.time_ref),
                stamp_ns(message.header),
            )
        )
    assert len(errors) >= 10
    # The project's own aim on this bag.
    assert np.median([error.rotation_error for error in errors]) <= 0.15
    assert np.median([error.translation_error for error in errors]) <= 3.0


def test_replay_of_the_same_frames_is_bit_equal(run, bundled_bag):
    """All messages of all pairs, in the order of their stamps."""
    with open_bag(bundled_bag) as bag:
        replay = Replay(
            bag,
            bag.find_topics(),
            read_parameters(BUNDLED_PARAMETERS),
            stamps=frozenset(run.stamps),
        )
        replayed = [build.pair_messages(pair, message_class) for pair in replay.pairs()]
    for topic, published in run.messages.items():
        assert published == [messages[topic] for messages in replayed if topic in messages]
    stamps = [stamp_ns(message.header) for message in run.messages['pairs']]
    assert stamps == sorted(set(stamps))
    assert set(stamps) <= set(run.stamps)
    # The bag has pairs without a pose.
    assert 10 <= len(run.messages['relative_pose']) < len(stamps)


def test_diagnostics_count_all_frames(run):
    values = diagnostic_values(run.diagnostics[-1])
    assert run.diagnostics[-1].status[0].name == '/relpose_node: relative pose'
    assert run.diagnostics[-1].status[0].hardware_id == '/camera/image_raw/compressed'
    refused = sum(int(value) for key, value in values.items() if key.startswith('frames_refused_'))
    assert int(values['frames_received']) == 180 == int(values['frames_processed']) + refused
    assert int(values['frames_processed']) == len(run.stamps)
    # A camera that outruns a busy machine is the only reason to leave a frame out.
    assert refused == int(values['frames_refused_overload'])
    assert int(values['poses']) == len(run.messages['relative_pose']) <= int(values['pairs'])
    assert int(values['imu_samples']) == 1246
    assert (values['imu_gaps'], values['messages_invalid'], values['frames_failed']) == (
        '0',
        '0',
        '0',
    )
    assert values['model'] == 'uniform'
    assert 0.0 < float(values['inlier_ratio']) <= 1.0
    assert 0.0 < float(values['latency_p50_ms']) <= float(values['latency_p99_ms'])
    # The bag has a standstill and a pure rotation.
    assert values['last_reason_no_pose'].split(':')[0] in ('PURE_ROTATION', 'LOW_PARALLAX')
    rates = [
        {
            key: float(value)
            for key, value in diagnostic_values(item).items()
            if key.endswith('_rate_hz')
        }
        for item in run.diagnostics
    ]
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
    assert run.output.count('executor of rclpy') == run.fallbacks
    assert run.output.count('[WARN]') == (
        run.output.count('(overload)') + run.output.count('no image on') + run.fallbacks
    )


# -- a signal ends the node at once and quietly, at any time ----------------------------


def blocks(pid: int, number: int) -> bool:
    """Whether the main thread of a process blocks a signal."""
    for line in Path(f'/proc/{pid}/status').read_text().splitlines():
        if line.startswith('SigBlk:'):
            return bool(int(line.split()[1], 16) >> (number - 1) & 1)
    return False


def end(node: Process, number: signal.Signals, every: float = 30.0) -> float:
    """End a node by a signal, without a complaint; seconds until then."""
    code, seconds = node.signal(number, every=every)
    assert code == 0
    assert 'Traceback' not in node.output
    return seconds


@pytest.mark.parametrize(('delay', 'number'), [(0.0, signal.SIGINT), (0.6, signal.SIGTERM)])
def test_a_signal_ends_a_node_that_imports(ros_domain_id, delay, number):
    with node_process(BUNDLED_PARAMETERS) as node:
        wait_until(lambda: blocks(node.pid, signal.SIGTERM), 'a blocked signal', node)
        time.sleep(delay)
        end(node, number)


def test_signals_that_come_again_and_again(ros_domain_id):
    """Ctrl-C under ros2 launch: the terminal signals the whole group, and so does launch."""
    with node_process(BUNDLED_PARAMETERS) as node:
        node.wait_for('ready')
        end(node, signal.SIGINT, 0.002)


def test_a_signal_ends_a_node_that_compiles(ros_domain_id, tmp_path, monkeypatch):
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path))
    with node_process(BUNDLED_PARAMETERS) as node:
        node.wait_for('compiling kernels')
        # The compiler lets go of the interpreter only now and then.
        assert end(node, signal.SIGTERM) <= 5.0


# -- examples of the documentation --------------------------------------------------------------

# A pair before the bag's standstill.
LOST = 4
EXAMPLE = ROOT / 'docs' / 'examples' / 'chain_poses.py'
PX4 = ROOT / 'docs' / 'examples' / 'px4_odometry.py'


@pytest.fixture(scope='module')
def recorded(bundled_bag: Path) -> list[dict[str, Any]]:
    """What the node publishes of the bundled bag, one pair lost on the way."""
    with open_bag(bundled_bag) as bag:
        replay = Replay(bag, bag.find_topics(), read_parameters(BUNDLED_PARAMETERS))
        pairs = [build.pair_messages(pair, message_class) for pair in replay.pairs()]
        return [*pairs[:LOST], *pairs[LOST + 1 :]]


@pytest.fixture(scope='module')
def chain(module_ros_domain_id: int, recorded: list[dict[str, Any]]) -> Iterator[SimpleNamespace]:
    """Paths that the example published, each with its last stamp, and its output."""
    with (
        Graph() as graph,
        Process(str(EXAMPLE), '--ros-args', '-r', '__ns:=/relpose_node') as example,
    ):
        paths = graph.listen(PathMessage, '/relpose_node/pose_chain/path')
        publishers = {
            name: graph.publisher(message_class(kind), f'/relpose_node/{name}')
            for name, kind in PAIR_TOPICS.items()
        }
        graph.wait_for_publisher('/relpose_node/pose_chain/path')
        for count, pair in enumerate(recorded):
            # In any order: what belongs together has one stamp.
            for name, message in sorted(pair.items(), key=itemgetter(0), reverse=count % 2 == 1):
                publishers[name].publish(message)
            wait_until(lambda n=count: len(paths) > n, 'a path', example)
        code, _ = example.signal(signal.SIGINT)
        yield SimpleNamespace(pairs=recorded, paths=paths, output=example.output, exit_code=code)


def test_each_pair_extends_a_path(chain):
    assert len(chain.paths) == len(chain.pairs) > 20
    for path, pair in zip(chain.paths, chain.pairs, strict=True):
        assert path.header.stamp == pair['pairs'].header.stamp
    assert chain.exit_code == 0
    assert 'Traceback' not in chain.output


def test_a_restart_of_the_path_is_reported(chain):
    """Where a pair is missing; but not at the bag's standstill and pure rotation."""
    paths = [
        path
        for path, later in zip(chain.paths, [*chain.paths[1:], None], strict=True)
        if later is None or len(later.poses) <= len(path.poses)
    ]
    assert [len(path.poses) for path in paths] == [LOST + 1, len(chain.pairs) - LOST + 1]
    assert chain.output.count('a pair is missing: the path restarts, at another scale') == 1
    assert stamp_ns(paths[1].poses[0].header) > stamp_ns(paths[0].poses[-1].header)
    assert sum('relative_pose' not in pair for pair in chain.pairs) >= 2


def test_odometry_in_the_axes_of_px4():
    """What is ahead, left and above is ahead, right and below."""
    spec = importlib.util.spec_from_file_location('px4_odometry', PX4)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    rng = np.random.default_rng(0)
    message = Odometry()
    root = rng.normal(size=(6, 6))
    message.header.stamp.sec = 12
    message.header.stamp.nanosec = 345_678_901
    pose = message.pose.pose
    twist = message.twist.twist
    message.pose.covariance = (root @ root.T).ravel()
    R = Rotation.random(random_state=1)
    (p, v, w) = rng.normal(size=(3, 3))
    for vector, values in (
        (pose.position, p),
        (pose.orientation, R.as_quat()),
        (twist.linear, v),
        (twist.angular, w),
    ):
        for axis, value in zip('xyzw', values, strict=False):
            setattr(vector, axis, float(value))
    found = module.px4_fields(message)
    assert found['timestamp_sample'] == 12_345_678
    right_down = np.diag([1.0, -1.0, -1.0])
    q = found['q']
    px4_R = Rotation.from_quat([q[1], q[2], q[3], q[0]])
    # A point of the body, in the world of PX4, by PX4's pose and by that of the message.
    point = rng.normal(size=3)
    np.testing.assert_allclose(
        px4_R.apply(right_down @ point) + found['position'],
        right_down @ (R.apply(point) + p),
        atol=1e-6,
    )
    np.testing.assert_allclose(found['velocity'], right_down @ v, atol=1e-6)
    np.testing.assert_allclose(found['angular_velocity'], right_down @ w, atol=1e-6)
    # Variances of errors that are drawn from the covariance, in the body's axes of PX4.
    errors = rng.multivariate_normal(np.zeros(6), root @ root.T, 20_000)
    np.testing.assert_allclose(
        found['position_variance'], (errors[:, :3] @ right_down).var(axis=0), rtol=0.05
    )
    np.testing.assert_allclose(
        found['orientation_variance'],
        px4_R.apply(errors[:, 3:] @ right_down, inverse=True).var(axis=0),
        rtol=0.05,
    )


# -- the live benchmark -------------------------------------------------------------------------


def test_frame_timings_name_what_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match=r'timings_file .* cannot be written'):
        FrameTimings(str(tmp_path / 'nowhere' / 'frames.csv'))


def test_a_run_and_its_report(tmp_path, ros_domain_id, monkeypatch):
    """Three seconds of small images, as any cell is run."""
    monkeypatch.setattr(live_clip, 'PERIOD', 2.0)
    cell = live.LiveCell(320, 240, 'bgr8', 200)
    seconds = []
    clip = live_clip.prepare_clip(tmp_path, cell.width, cell.height)
    found, over_time = live.run_cell(
        cell,
        clip,
        live.Load(3.0),
        tmp_path / cell.name,
        ROOT / 'config' / 'fastdds.xml',
        lambda: seconds.append(1),
    )
    # The last two images would have no IMU.
    assert (found.frames_sent, found.imu_sent) == (90 - 2, 600)
    assert found.frames_received <= found.frames_sent
    refused = found.dropped_overload + found.dropped_other
    assert found.frames_used + refused == found.frames_received
    assert 5 < found.poses <= found.pairs < found.frames_used
    assert found.wrong == 0 and found.rotation_error.p50 < 0.2
    assert len(seconds) >= 2
    for times in (found.latency, found.end_to_end, found.frame_time, found.frame_cpu):
        assert 0.0 < times.p50 <= times.p99 <= times.largest
    # From outside it cannot be faster than from inside, except for the rest of the distribution.
    assert found.end_to_end.largest > found.latency.p50
    assert 0.0 < found.cpu_callbacks < found.cpu
    assert len(over_time.latencies) == found.poses
    assert 0.0 < found.private_end < found.memory_end
    # The clip is not rendered again.
    assert live_clip.prepare_clip(tmp_path, cell.width, cell.height, pytest.fail) == clip
    other = replace(found, cell='another', latency=live.Percentiles(np.nan, np.nan, np.nan))
    report = live.write_report(tmp_path, [found, other])
    assert report.count(f'| {cell.name}') == report.count('| another ') == 3
    assert f'{found.poses} of {found.pairs}' in report
    header, first, _ = (tmp_path / 'live.csv').read_text().splitlines()
    assert header.startswith('cell,duration,frames_sent') and 'latency_p99' in header
    assert first.startswith(f'{cell.name},3.0,88')
    assert 'MB/h' in live.write_soak_report(tmp_path / 'soak', found, over_time)


def test_a_node_shares_its_core_with_busy_neighbours(tmp_path, ros_domain_id, monkeypatch):
    """At half the rate, on a core of its own with two other processes."""
    if len(os.sched_getaffinity(0)) < 2:
        pytest.skip('needs two cores')
    monkeypatch.setattr(live_clip, 'PERIOD', 2.0)
    before = os.sched_getaffinity(0)
    cell = live.LiveCell(320, 240, 'mono8', 200)
    found, _ = live.run_cell(
        cell,
        live_clip.prepare_clip(tmp_path, cell.width, cell.height),
        live.Load(3.0, every=2, neighbours=2),
        tmp_path / cell.name,
        ROOT / 'config' / 'fastdds.xml',
    )
    assert found.frames_sent == 45 - 1
    assert found.poses > 0 and found.wrong == 0  # how many depends on the other load
    assert os.sched_getaffinity(0) == before


def test_soak_compares_the_first_with_the_last_quarter():
    seconds = np.arange(0.0, 100.0)
    course = live.Course(seconds, 10.0 + seconds, seconds, 50.0 + 0.1 * seconds)
    (first, early, low), (last, late, high) = live.outer_quarters(course)
    assert (first, last) == ('first', 'last')
    assert late.p50 - early.p50 == pytest.approx(75.0, abs=1.0)
    assert high - low == pytest.approx(7.5, abs=0.1)
