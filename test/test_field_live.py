"""Situations that users report, played to a running node: what it says and what it withholds."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import fault_stream as faults
from fault_stream import BAG_TOPICS
import pytest

from rs_relpose_lab.field import defects
from rs_relpose_lab.field.cases import BY_NAME
from rs_relpose_lab.field.live import play
from rs_relpose_lab.field.recording import base_recording, FieldRecording, write_recording
from rs_relpose_lab.field.verdict import judge
from rs_relpose_lab.live.graph import Graph
from rs_relpose_lab.live.processes import node_process, player_process
from rs_relpose_lab.simulation import SimulationConfig
from rs_relpose_ros.bags.sensor_topics import COMPRESSED_TOPIC, IMU_TOPIC
from rs_relpose_ros.messages.incoming import stamp_ns
from rs_relpose_ros.messages.outgoing import PAIR_TOPICS
from rs_relpose_ros.nodes.inputs import message_class

# The node may have to compile the kernels.
pytestmark = [pytest.mark.live, pytest.mark.timeout(600)]


@pytest.fixture(scope='module')
def walk(tmp_path_factory: pytest.TempPathFactory) -> FieldRecording:
    """A walk of a small camera."""
    config = SimulationConfig(
        seed=83, duration=4.0, width=320, height=240, fx=225.0, plan='walk:4', pixel_noise=0.5
    )
    return base_recording(config, tmp_path_factory.mktemp('live') / 'walk')


@pytest.fixture
def played(ros_domain_id: int, tmp_path: Path) -> Callable[[FieldRecording], SimpleNamespace]:
    """Plays a recording to a node: stamps of its poses and pairs, and its output."""

    def play(recording: FieldRecording) -> SimpleNamespace:
        parameters = write_recording(recording, tmp_path / 'bag')
        reliable = faults.reliable(COMPRESSED_TOPIC, IMU_TOPIC)
        with (
            Graph() as graph,
            node_process(parameters, remap=BAG_TOPICS, parameters=reliable) as node,
        ):
            poses, pairs = (
                graph.listen(message_class(PAIR_TOPICS[topic]), f'/relpose_node/{topic}')
                for topic in ('relative_pose', 'pairs')
            )
            node.wait_for('ready')
            for topic in ('relative_pose', 'pairs'):
                graph.wait_for_publisher(f'/relpose_node/{topic}')
            with player_process(tmp_path / 'bag') as playing:
                assert playing.wait() == 0
            node.stop()
            return SimpleNamespace(
                poses=[stamp_ns(message.header) for message in poses],
                pairs=[stamp_ns(message.header) for message in pairs],
                output=node.output,
            )

    return play


def test_what_nodes_publish_is_compared_with_the_truth(ros_domain_id, tmp_path, walk):
    """The evidence of a live run holds poses, states and causes of an intact recording."""
    pytest.importorskip('gtsam', reason='needs the extra odometry')
    parameters = write_recording(walk, tmp_path / 'bag')
    evidence = play(walk, tmp_path / 'bag', parameters, tmp_path)
    verdict = judge(BY_NAME['right'], evidence, evidence.pairs, 1.0)
    assert (verdict.verdict, verdict.reason) == ('good', '')
    assert verdict.poses >= 8
    assert verdict.worst < 5.0
    assert verdict.states >= 10
    assert {'axes', 'time_offset'} <= {one.code for one in evidence.causes}


def test_two_imus_on_a_topic_are_named_and_give_no_pose(played, walk):
    run = played(defects.two_imus(walk))
    assert not run.poses
    assert 'imu_link' in run.output
    assert 'base_imu_link' in run.output


def test_an_imu_in_bursts_is_named_and_gets_even_times(played, walk):
    run = played(defects.bursts(walk, 20, 'arrival'))
    assert 'bursts of 20' in run.output
    assert 'even times' in run.output
    assert len(run.poses) >= 3


def test_repeated_images_are_named_and_not_used(played, walk):
    run = played(defects.repeated_images(walk, 3, 0.8))
    repeated = {shot.stamp_ns for shot in walk.shots[2::3]}
    assert len(run.poses) >= 5
    assert sum(stamp in repeated for stamp in run.pairs) <= 1  # where the camera hardly turned
    assert 'repeat the one before' in run.output
