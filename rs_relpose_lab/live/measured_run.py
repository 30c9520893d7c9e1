"""The node and a player as two processes, watched: what came out and when, and what it cost.

This process only listens: to the poses, to the diagnostics, and once a second to /proc.
"""

from __future__ import annotations

from collections.abc import Callable
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

from rs_relpose_lab.live.graph import diagnostic_values, Graph, private_domain
from rs_relpose_lab.live.processes import (
    LiveRunError,
    node_process,
    player_process,
    Process,
    process_figures,
    ProcessFigures,
    wait_until,
    wait_until_quiet,
)
from rs_relpose_ros.messages.incoming import stamp_ns, time_ns

# The node is done when no pose has come for so long, and has reported its counters [s].
_QUIET = 2.5


@dataclass(frozen=True, slots=True)
class Play:
    """What is played to the node, and how.

    `parameters`: file of the node; `transport`: its `image_transport`.
    `remap`: the node's topics `image`, `camera_info` and `imu` by their names in the bag.
    `player`: options of the player; `profile`: of Fast DDS, for all processes.
    """

    bag: Path
    parameters: Path
    remap: dict[str, str]
    transport: str
    player: tuple[str, ...]
    profile: Path | None


@dataclass(frozen=True, slots=True)
class ReceivedPose:
    """A relative pose, and when it came on the monotonic clock."""

    reference_stamp_ns: int
    stamp_ns: int
    received_ns: int
    t: NDArray[np.float64]
    quat_xyzw: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredRun:
    """What was seen.

    `counters`: last figures of the node's diagnostics.
    `figures`, `player_figures`: of node and player, once a second while messages are played.
    `started_ns`, `ready_ns`: when the node was started, and when it subscribed.
    `timings`: table of the node's parameter `timings_file`.
    `log`: the player's log.
    """

    poses: list[ReceivedPose]
    counters: dict[str, str]
    figures: list[ProcessFigures]
    player_figures: list[ProcessFigures]
    started_ns: int
    ready_ns: int
    timings: Path
    log: Path


class _Listener:
    """What the node publishes, with the instants of receipt."""

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
            t, q = msg.pose.pose.position, msg.pose.pose.orientation
            received.append(ReceivedPose(references[stamp], stamp, received_ns,
                                         np.array([t.x, t.y, t.z]),
                                         np.array([q.x, q.y, q.z, q.w])))
        return received


def measure(play: Play, folder: Path,
            on_second: Callable[[], object] = lambda: None) -> MeasuredRun:
    """Play a bag to a node of its own and watch; logs and tables into `folder`, which exists.

    `on_second`: called once a second while messages are played.
    """
    timings, log = folder / 'frames.csv', folder / 'player.npy'
    log.unlink(missing_ok=True)
    with private_domain():
        if play.profile is not None:
            os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(play.profile)
        else:
            os.environ.pop('FASTRTPS_DEFAULT_PROFILES_FILE', None)
        with Graph() as graph:
            listener = _Listener(graph)
            started_ns = time.monotonic_ns()
            with node_process(play.parameters, remap=play.remap, log=folder / 'relpose_node.log',
                              parameters={'timings_file': timings,
                                          'image_transport': play.transport}) as node:
                wait_until(lambda: graph.node.count_subscribers(play.remap['imu']),
                           'a subscription of the node', node)
                ready_ns = time.monotonic_ns()
                with player_process(play.bag, '--log', str(log), *play.player,
                                    log=folder / 'player.log') as player:
                    figures = _watch(node, player, listener, on_second)
                wait_until_quiet(lambda: len(listener.poses), _QUIET, node)
                node.stop()
        return MeasuredRun(listener.received(), diagnostic_values(listener.diagnostics[-1]),
                           *figures, started_ns, ready_ns, timings, log)


def _watch(node: Process, player: Process, listener: _Listener,
           on_second: Callable[[], object]) -> tuple[list[ProcessFigures], list[ProcessFigures]]:
    """Figures of node and player from the first pose to the end of the player."""
    figures: list[tuple[ProcessFigures, ProcessFigures]] = []
    wait_until(lambda: listener.poses or player.ended(), 'a pose', node)
    while not (player.ended() or node.ended()):
        try:
            figures.append((process_figures(node.pid), process_figures(player.pid)))
        except (OSError, KeyError):   # it has just ended
            break
        on_second()
        time.sleep(1.0)
    if not figures:
        raise LiveRunError(f'the node published no pose:\n{node.output}')
    wait_until(player.ended, 'the end of the player')
    of_node, of_player = zip(*figures, strict=True)
    return list(of_node), list(of_player)
