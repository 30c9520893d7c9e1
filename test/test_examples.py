"""The examples of the documentation do what they say."""

from collections.abc import Iterator
import importlib.util
from operator import itemgetter
from pathlib import Path
import signal
from types import SimpleNamespace
from typing import Any

from conftest import BUNDLED_PARAMETERS, ROOT
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.live.graph import Graph
from rs_relpose_lab.live.processes import Process, wait_until
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.messages.incoming import stamp_ns
from rs_relpose_ros.messages.outgoing import pair_messages, PAIR_TOPICS
from rs_relpose_ros.nodes.inputs import message_class
from rs_relpose_ros.offline.replay import Replay

# The replay may have to compile the kernels.
pytestmark = [pytest.mark.live, pytest.mark.timeout(600)]

# A pair before the bag's standstill.
LOST = 4
EXAMPLE = ROOT / 'docs' / 'examples' / 'chain_poses.py'
PX4 = ROOT / 'docs' / 'examples' / 'px4_odometry.py'


@pytest.fixture(scope='module')
def recorded(bundled_bag: Path) -> list[dict[str, Any]]:
    """What the node publishes of the bundled bag, one pair lost on the way."""
    with open_bag(bundled_bag) as bag:
        replay = Replay(bag, bag.find_topics(), read_parameters(BUNDLED_PARAMETERS))
        pairs = [pair_messages(pair, message_class) for pair in replay.pairs()]
        return [*pairs[:LOST], *pairs[LOST + 1:]]


@pytest.fixture(scope='module')
def run(module_ros_domain_id: int,
        recorded: list[dict[str, Any]]) -> Iterator[SimpleNamespace]:
    """Paths that the example published, each with its last stamp, and its output."""
    with Graph() as graph, Process(
            str(EXAMPLE), '--ros-args', '-r', '__ns:=/relpose_node') as example:
        paths = graph.listen(PathMessage, '/relpose_node/pose_chain/path')
        publishers = {name: graph.publisher(message_class(kind), f'/relpose_node/{name}')
                      for name, kind in PAIR_TOPICS.items()}
        graph.wait_for_publisher('/relpose_node/pose_chain/path')
        for count, pair in enumerate(recorded):
            # In any order: what belongs together has one stamp.
            for name, message in sorted(pair.items(), key=itemgetter(0), reverse=count % 2 == 1):
                publishers[name].publish(message)
            wait_until(lambda n=count: len(paths) > n, 'a path', example)
        code, _ = example.signal(signal.SIGINT)
        yield SimpleNamespace(pairs=recorded, paths=paths, output=example.output, exit_code=code)


def test_each_pair_extends_a_path(run):
    assert len(run.paths) == len(run.pairs) > 20
    for path, pair in zip(run.paths, run.pairs, strict=True):
        assert path.header.stamp == pair['pairs'].header.stamp
    assert run.exit_code == 0
    assert 'Traceback' not in run.output


def test_a_restart_of_the_path_is_reported(run):
    """Where a pair is missing; but not at the bag's standstill and pure rotation."""
    paths = [path for path, later in zip(run.paths, [*run.paths[1:], None], strict=True)
             if later is None or len(later.poses) <= len(path.poses)]
    assert [len(path.poses) for path in paths] == [LOST + 1, len(run.pairs) - LOST + 1]
    assert run.output.count('a pair is missing: the path restarts, at another scale') == 1
    assert stamp_ns(paths[1].poses[0].header) > stamp_ns(paths[0].poses[-1].header)
    assert sum('relative_pose' not in pair for pair in run.pairs) >= 2


def test_odometry_in_the_axes_of_px4():
    """What is ahead, left and above is ahead, right and below."""
    spec = importlib.util.spec_from_file_location('px4_odometry', PX4)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    rng, message = np.random.default_rng(0), Odometry()
    root = rng.normal(size=(6, 6))
    message.header.stamp.sec, message.header.stamp.nanosec = 12, 345_678_901
    pose, twist = message.pose.pose, message.twist.twist
    message.pose.covariance = (root @ root.T).ravel()
    R, (p, v, w) = Rotation.random(random_state=1), rng.normal(size=(3, 3))
    for vector, values in ((pose.position, p), (pose.orientation, R.as_quat()), (twist.linear, v),
                           (twist.angular, w)):
        for axis, value in zip('xyzw', values, strict=False):
            setattr(vector, axis, float(value))
    found = module.px4_fields(message)
    assert found['timestamp_sample'] == 12_345_678
    right_down = np.diag([1.0, -1.0, -1.0])
    q = found['q']
    px4_R = Rotation.from_quat([q[1], q[2], q[3], q[0]])
    # A point of the body, in the world of PX4, by PX4's pose and by that of the message.
    point = rng.normal(size=3)
    np.testing.assert_allclose(px4_R.apply(right_down @ point) + found['position'],
                               right_down @ (R.apply(point) + p), atol=1e-6)
    np.testing.assert_allclose(found['velocity'], right_down @ v, atol=1e-6)
    np.testing.assert_allclose(found['angular_velocity'], right_down @ w, atol=1e-6)
    # Variances of errors that are drawn from the covariance, in the body's axes of PX4.
    errors = rng.multivariate_normal(np.zeros(6), root @ root.T, 20_000)
    np.testing.assert_allclose(found['position_variance'],
                               (errors[:, :3] @ right_down).var(axis=0), rtol=0.05)
    np.testing.assert_allclose(found['orientation_variance'], px4_R.apply(
        errors[:, 3:] @ right_down, inverse=True).var(axis=0), rtol=0.05)
