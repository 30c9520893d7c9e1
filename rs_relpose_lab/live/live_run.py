"""The real nodes on a bag in real time: nodes and player as processes over Fast DDS.

For the demo and for measurements. This process only subscribes, and reads /proc once a second.
"""

from collections.abc import Callable, Sequence
import csv
from dataclasses import dataclass
import os
from pathlib import Path
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import TimeReference

from rs_relpose_lab.live import processes
from rs_relpose_lab.live.graph import diagnostic_values, Graph, private_domain
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.messages.incoming import stamp_ns, time_ns
from rs_relpose_ros.messages.outgoing import number_text, PAIR_TOPICS
from rs_relpose_ros.nodes.inputs import message_class
from rs_relpose_ros.offline.tables import POSES, rotation_sigmas, translation_sigmas


def run_live(bag: Path, parameters: Path, folder: Path) -> tuple[Path, Path]:
    """Play `bag` to a new relpose_node; tables and logs into `folder`, which exists.

    Returns the tables of the published poses and of the stamps of the processed frames.
    """
    remap, duration = remap_and_duration(bag)
    table = folder / 'live.csv'
    stamps = folder / 'live_stamps.txt'
    with (
        private_domain(),
        Graph() as graph,
        processes.node_process(
            parameters,
            remap=remap,
            parameters={'stamps_file': stamps},
            log=folder / 'relpose_node.log',
        ) as node,
    ):
        recorder = Recorder(graph, node)
        with processes.player_process(bag, log=folder / 'player.log') as player:
            processes.wait_until(
                player.ended,
                'the end of the player',
                node,
                timeout=2.0 * processes.PATIENCE + duration,
            )
        # The node is done when it has processed no frame for a second.
        processes.wait_until_quiet(lambda: stamps.stat().st_size, 1.0, node)
        node.stop()
        if not recorder.write(table):
            raise processes.LiveRunError(f'the node published no pose:\n{node.output}')
    return table, stamps


def remap_and_duration(bag: Path) -> tuple[dict[str, str], float]:
    """Names of a node's topics in a bag, and the length of the bag [s]."""
    with open_bag(bag) as opened:
        topics = opened.find_topics()
        duration = opened.duration
    remap = {'image': topics.image.name.removesuffix('/compressed'), 'imu': topics.imu.name}
    for name, topic in (('camera_info', topics.camera_info), ('accel', topics.accel)):
        if topic is not None:
            remap[name] = topic.name
    return remap, duration


class Recorder:
    """Records the pair topics of a node.

    `node`: must not end before it publishes.
    """

    def __init__(self, graph: Graph, node: processes.Process) -> None:
        self._received = {
            name: graph.listen(message_class(msgtype), f'/relpose_node/{name}')
            for name, msgtype in PAIR_TOPICS.items()
        }
        for name in PAIR_TOPICS:
            graph.wait_for_publisher(f'/relpose_node/{name}', node)

    def write(self, path: Path) -> int:
        """Write the received pairs, and return their number.

        Pairs without a pose are left out; the cells of number of matches and model are empty.
        """
        poses, references, matches, pairs = (
            {stamp_ns(msg.header): msg for msg in self._received[name]}
            for name in ('relative_pose', 'reference', 'matches', 'pairs')
        )
        with path.open('w', newline='', encoding='ascii') as file:
            writer = csv.writer(file, lineterminator='\n')
            writer.writerow(POSES.columns)
            for stamp, pose in sorted(poses.items()):
                reference = references.get(stamp)
                cloud = matches.get(stamp)
                values = diagnostic_values(pairs[stamp]) if stamp in pairs else {}
                covariance = np.array(pose.pose.covariance).reshape(6, 6)
                t, quat_xyzw = pose_of(pose)
                writer.writerow(
                    [
                        '' if reference is None else str(time_ns(reference.time_ref)),
                        str(stamp),
                        *map(
                            number_text,
                            (
                                *t,
                                *quat_xyzw,
                                *translation_sigmas(covariance),
                                *rotation_sigmas(covariance),
                            ),
                        ),
                        '' if cloud is None else str(cloud.width),
                        '',
                        '',
                        Status.OK.value,
                        *(values.get(name, '') for name in ('baseline_m', 'baseline_log_sigma')),
                    ]
                )
        return len(poses)


def pose_of(msg: Any) -> tuple[list[float], list[float]]:
    """Position and quaternion x y z w of a pose message."""
    t = msg.pose.pose.position
    q = msg.pose.pose.orientation
    return [t.x, t.y, t.z], [q.x, q.y, q.z, q.w]


# -- measured: times of receipt, processor time, memory ---------------------------------------

# The node is done when no pose has come for so long, and has reported its counters [s].
_QUIET = 2.0


@dataclass(frozen=True, slots=True)
class ReceivedPose:
    """A relative pose, and its time of receipt on the monotonic clock."""

    reference_stamp_ns: int
    stamp_ns: int
    received_ns: int
    t: NDArray[np.float64]
    quat_xyzw: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredRun:
    """Results of `measure`."""

    poses: list[ReceivedPose]
    counters: dict[str, str]  # last values of the node's diagnostics
    # Of the node, once a second while messages are played.
    metrics: list[processes.ProcessMetrics]
    player_metrics: list[processes.ProcessMetrics]
    started_ns: int  # when the node was started
    ready_ns: int  # when it had subscribed
    timings: Path  # table of the node's parameter `timings_file`
    log: Path  # table of the player


class _Listener:
    """Publications of the node, with the times of receipt."""

    def __init__(self, graph: Graph) -> None:
        self.poses: dict[int, tuple[int, PoseWithCovarianceStamped]] = {}
        self.references = graph.listen(TimeReference, '/relpose_node/reference')
        graph.subscribe(PoseWithCovarianceStamped, '/relpose_node/relative_pose', self._on_pose)
        self.diagnostics = graph.listen(DiagnosticArray, '/diagnostics')

    def _on_pose(self, msg: Any) -> None:
        self.poses[stamp_ns(msg.header)] = time.monotonic_ns(), msg

    def received(self) -> list[ReceivedPose]:
        """Poses whose reference came as well, in the order of their stamps."""
        references = {stamp_ns(msg.header): time_ns(msg.time_ref) for msg in self.references}
        received = []
        for stamp in sorted(self.poses.keys() & references.keys()):
            received_ns, msg = self.poses[stamp]
            received.append(
                ReceivedPose(references[stamp], stamp, received_ns, *map(np.array, pose_of(msg)))
            )
        return received


@dataclass(frozen=True, slots=True)
class NodeSetup:
    """How a node is started."""

    parameters: Path  # file
    remap: dict[str, str]  # its topics image, camera_info and imu by their names in the bag
    transport: str  # its parameter `image_transport`
    profile: Path | None  # of Fast DDS, for all processes
    # Busy processes of the same priority on the one core that the node then has; None: the node
    # may use all cores.
    neighbours: int | None = None


def measure(
    bag: Path,
    setup: NodeSetup,
    player_options: Sequence[str],
    folder: Path,
    on_second: Callable[[], object],
) -> MeasuredRun:
    """Play a bag to a new node and measure; logs and tables into `folder`, which exists.

    `on_second`: called once a second while messages are played.
    """
    timings = folder / 'frames.csv'
    log = folder / 'player.npy'
    remap = setup.remap
    log.unlink(missing_ok=True)
    with private_domain(), processes.core_for(setup.neighbours) as pin:
        if setup.profile is not None:
            os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(setup.profile)
        else:
            os.environ.pop('FASTRTPS_DEFAULT_PROFILES_FILE', None)
        with Graph() as graph:
            listener = _Listener(graph)
            started_ns = time.monotonic_ns()
            with processes.node_process(
                setup.parameters,
                remap=remap,
                log=folder / 'relpose_node.log',
                parameters={'timings_file': timings, 'image_transport': setup.transport},
            ) as node:
                pin(node)
                processes.wait_until(
                    lambda: graph.node.count_subscribers(remap['imu']),
                    'a subscription of the node',
                    node,
                )
                ready_ns = time.monotonic_ns()
                with processes.player_process(
                    bag, '--log', str(log), *player_options, log=folder / 'player.log'
                ) as player:
                    metrics = _watch(node, player, listener, on_second)
                processes.wait_until_quiet(lambda: len(listener.poses), _QUIET, node)
                node.stop()
        return MeasuredRun(
            listener.received(),
            diagnostic_values(listener.diagnostics[-1]),
            metrics[0],
            metrics[1],
            started_ns,
            ready_ns,
            timings,
            log,
        )


def _watch(
    node: processes.Process,
    player: processes.Process,
    listener: _Listener,
    on_second: Callable[[], object],
) -> list[list[processes.ProcessMetrics]]:
    """Metrics of node and player from the first pose to the end of the player."""
    of_node: list[processes.ProcessMetrics] = []
    of_player: list[processes.ProcessMetrics] = []
    processes.wait_until(lambda: listener.poses or player.ended(), 'a pose', node)
    while not (player.ended() or node.ended()):
        try:
            of_node.append(processes.process_metrics(node.pid))
            of_player.append(processes.process_metrics(player.pid))
        except (OSError, KeyError):  # a process has just ended
            break
        on_second()
        time.sleep(1.0)
    if not of_player:
        raise processes.LiveRunError(f'the node published no pose:\n{node.output}')
    processes.wait_until(player.ended, 'the end of the player')
    return [of_node, of_player]
