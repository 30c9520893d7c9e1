"""The examples of the documentation do what they say."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
import signal

from conftest import BUNDLED_PARAMETERS, ROOT
from nav_msgs.msg import Path as PathMessage
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.live.graph import Graph
from rs_relpose_lab.live.processes import Process, wait_until
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.messages.incoming import stamp_ns
from rs_relpose_ros.messages.outgoing import pair_messages, PAIR_TOPICS, PairMessages
from rs_relpose_ros.node.message_types import message_class
from rs_relpose_ros.replay.run import read_truth, Replay
from rs_relpose_ros.replay.truth import TrueTrajectory

# The replay may have to compile the kernels.
pytestmark = [pytest.mark.live, pytest.mark.timeout(600)]

# A pair before the bag's standstill.
LOST = 4
EXAMPLE = ROOT / 'docs' / 'examples' / 'chain_poses.py'


@dataclass(frozen=True)
class Chained:
    """Paths that the example published, each with its last stamp, and what it said."""

    pairs: list[PairMessages]
    paths: list[PathMessage]
    truth: TrueTrajectory
    output: str
    exit_code: int


@pytest.fixture(scope='module')
def recorded(bundled_bag: Path) -> tuple[list[PairMessages], TrueTrajectory]:
    """What the node publishes of the bundled bag, one pair lost on the way."""
    with open_bag(bundled_bag) as bag:
        topics = bag.find_topics()
        truth = read_truth(bag, topics)
        assert truth is not None
        replay = Replay(bag, topics, read_parameters(BUNDLED_PARAMETERS))
        pairs = [pair_messages(pair.result, message_class) for pair in replay.pairs()]
        return [*pairs[:LOST], *pairs[LOST + 1:]], truth


@pytest.fixture(scope='module')
def run(module_ros_domain_id: int,
        recorded: tuple[list[PairMessages], TrueTrajectory]) -> Iterator[Chained]:
    pairs, truth = recorded
    with Graph() as graph, Process(
            str(EXAMPLE), '--ros-args', '-r', '__ns:=/relpose_node') as example:
        paths = graph.listen(PathMessage, '/relpose_node/pose_chain/path')
        publishers = {name: graph.publisher(message_class(kind), f'/relpose_node/{name}')
                      for name, kind in PAIR_TOPICS.items()}
        graph.wait_for_publisher('/relpose_node/pose_chain/path')
        for count, pair in enumerate(pairs):
            # In any order: their stamps say what belongs together.
            for name, message in sorted(pair.by_topic(), key=itemgetter(0),
                                        reverse=count % 2 == 1):
                publishers[name].publish(message)
            wait_until(lambda n=count: len(paths) > n, 'a path', example)
        code, _ = example.signal(signal.SIGINT)
        yield Chained(pairs, paths, truth, example.output, code)


def whole_paths(run: Chained) -> list[PathMessage]:
    """The longest of each that was begun."""
    return [path for path, later in zip(run.paths, [*run.paths[1:], None], strict=True)
            if later is None or len(later.poses) <= len(path.poses)]


def test_each_pair_extends_a_path(run):
    assert len(run.paths) == len(run.pairs) > 20
    for path, pair in zip(run.paths, run.pairs, strict=True):
        assert path.header.stamp == pair.pairs.header.stamp
    assert run.exit_code == 0
    assert 'Traceback' not in run.output


def test_it_says_where_it_cannot_go_on(run):
    """Where a pair is missing; but not at the bag's standstill and pure rotation."""
    paths = whole_paths(run)
    assert [len(path.poses) for path in paths] == [LOST + 1, len(run.pairs) - LOST + 1]
    assert run.output.count('a pair is missing: the path starts anew, at another scale') == 1
    assert stamp_ns(paths[1].poses[0].header) > stamp_ns(paths[0].poses[-1].header)
    assert sum(pair.relative_pose is None for pair in run.pairs) >= 2


def test_shape_of_the_paths(run):
    """After one similarity each: scale is carried from pair to pair."""
    for path in whole_paths(run):
        stamps = [stamp_ns(pose.header) for pose in path.poses]
        found = np.array([[p.x, p.y, p.z] for p in (pose.pose.position for pose in path.poses)])
        true = true_positions(run.truth, stamps)
        aligned, scale = after_similarity(found, true)
        length = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
        error = np.sqrt(np.mean(np.sum((aligned - true)**2, axis=1)))
        true_steps = np.linalg.norm(np.diff(true, axis=0), axis=1)
        moves = true_steps > 0.01   # [m]
        steps = np.linalg.norm(np.diff(aligned, axis=0), axis=1)
        assert (steps[~moves] < 1e-9).all()
        steps = steps[moves] / true_steps[moves]
        print(f'{len(stamps)} poses over {length:.2f} m: {1e3 * error:.1f} mm, '
              f'{100 * error / length:.2f} % of the length; steps {steps.min():.3f} to '
              f'{steps.max():.3f} of the true ones, scale {scale:.3f}')
        assert error <= 0.02 * length
        assert 0.8 < steps.min()
        # A pair of 4 px of parallax, after the standstill, tells depths badly.
        assert steps.max() < 1.25


def true_positions(truth: TrueTrajectory, stamps: list[int]) -> np.ndarray:
    """Of the camera at the first of the stamps, in its axes there."""
    positions = [np.zeros(3)]
    for stamp in stamps[1:]:
        pose = truth.relative_pose(stamps[0], stamp)
        assert pose is not None
        positions.append(pose[1])
    return np.array(positions)


def after_similarity(points: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, float]:
    """`points` (N, 3) moved, turned and scaled onto `target` in the sense of least squares."""
    centred, aim = points - points.mean(axis=0), target - target.mean(axis=0)
    rotation, _ = Rotation.align_vectors(aim, centred)
    turned = rotation.apply(centred)
    scale = float(np.sum(turned * aim) / np.sum(turned**2))
    return scale * turned + target.mean(axis=0), scale
