"""The node and a player as two processes, watched: what came out and when, and what it cost.

This process only listens: to the poses, to the diagnostics, and once a second to /proc.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
import os
from pathlib import Path
import threading
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
from numpy.typing import NDArray
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import TimeReference

from rs_relpose_lab.live.process_figures import process_figures, ProcessFigures
from rs_relpose_lab.live.processes import LiveRunError, private_graph, Process
from rs_relpose_ros.messages.incoming import stamp_ns, time_ns

# Compiling all kernels takes minutes, where nobody has done it ahead.
_START_TIMEOUT = 600.0
# The node is done when no pose has come for so long, and has reported its counters [s].
_QUIET = 2.5
_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=100,
                  reliability=ReliabilityPolicy.RELIABLE)


@dataclass(frozen=True, slots=True)
class Play:
    """What is played to the node, and how.

    Attributes
    ----------
    bag : Path
    parameters : Path
        Parameter file of the node.
    remap : dict
        The node's topics `image`, `camera_info` and `imu` by their names in the bag.
    transport : {'raw', 'compressed'}
        What the node subscribes to.
    player : tuple of str
        Options of the player.
    profile : Path or None
        Fast DDS profile of all processes.
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

    Attributes
    ----------
    poses : list of ReceivedPose
    diagnostics : list of (int, dict)
        Time on the monotonic clock, and the figures of a report.
    figures, player_figures : list of ProcessFigures
        Of node and player, once a second while messages are played.
    started_ns, ready_ns : int
        When the node was started, and when it subscribed.
    timings : Path
        Table of the node's parameter `timings_file`.
    log : Path
        The player's log.
    """

    poses: list[ReceivedPose]
    diagnostics: list[tuple[int, dict[str, str]]]
    figures: list[ProcessFigures]
    player_figures: list[ProcessFigures]
    started_ns: int
    ready_ns: int
    timings: Path
    log: Path


class _Listener:
    """A node of this process, spun by a thread of its own."""

    def __init__(self) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node('live_benchmark', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.poses: dict[int, tuple[int, PoseWithCovarianceStamped]] = {}
        self.references: dict[int, int] = {}
        self.diagnostics: list[tuple[int, dict[str, str]]] = []
        self.heard = threading.Event()
        for msgtype, topic, receive in (
                (PoseWithCovarianceStamped, '/relpose_node/relative_pose', self._on_pose),
                (TimeReference, '/relpose_node/reference', self._on_reference),
                (DiagnosticArray, '/diagnostics', self._on_diagnostics)):
            self.node.create_subscription(msgtype, topic, receive, _QOS)
        self._stopping = False
        self._thread = threading.Thread(target=self._spin)

    def __enter__(self) -> _Listener:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping = True
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def received(self) -> list[ReceivedPose]:
        """Poses whose reference came as well, in the order of their stamps."""
        return [_received(self.references[stamp], stamp, *self.poses[stamp])
                for stamp in sorted(self.poses.keys() & self.references.keys())]

    def _spin(self) -> None:
        while not self._stopping:
            self._executor.spin_once(timeout_sec=0.1)

    def _on_pose(self, msg: Any) -> None:
        self.poses[stamp_ns(msg.header)] = time.monotonic_ns(), msg
        self.heard.set()

    def _on_reference(self, msg: Any) -> None:
        self.references[stamp_ns(msg.header)] = time_ns(msg.time_ref)

    def _on_diagnostics(self, msg: Any) -> None:
        self.diagnostics.append((time.monotonic_ns(), {
            item.key: item.value for item in msg.status[0].values}))


def _received(reference: int, stamp: int, received_ns: int, msg: Any) -> ReceivedPose:
    t, q = msg.pose.pose.position, msg.pose.pose.orientation
    return ReceivedPose(reference, stamp, received_ns, np.array([t.x, t.y, t.z]),
                        np.array([q.x, q.y, q.z, q.w]))


def measure(play: Play, folder: Path,
            on_second: Callable[[], object] = lambda: None) -> MeasuredRun:
    """Play a bag to a node of its own and watch.

    Parameters
    ----------
    play : Play
    folder : Path
        Directory of logs and tables; must exist.
    on_second : callable
        Called once a second while messages are played.

    Raises
    ------
    LiveRunError
        A process failed.
    """
    # For the listener in this process; the other two get the same.
    os.environ.update(private_graph())
    if play.profile is not None:
        os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(play.profile)
    else:
        os.environ.pop('FASTRTPS_DEFAULT_PROFILES_FILE', None)
    timings, log = folder / 'frames.csv', folder / 'player.npy'
    log.unlink(missing_ok=True)
    with ExitStack() as stack:
        listener = stack.enter_context(_Listener())
        started_ns = time.monotonic_ns()
        node = stack.enter_context(Process(
            folder, 'relpose_node', 'rs_relpose_ros.node.node', '--ros-args', '--params-file',
            str(play.parameters), '-p', f'timings_file:={timings}',
            '-p', f'image_transport:={play.transport}',
            *(word for name, topic in play.remap.items() for word in ('-r', f'{name}:={topic}'))))
        _wait_for(lambda: listener.node.count_subscribers(play.remap['imu']) > 0, node)
        ready_ns = time.monotonic_ns()
        player = stack.enter_context(Process(
            folder, 'player', 'rs_relpose_lab.live.player', str(play.bag),
            '--wait-for-subscribers', str(_START_TIMEOUT), '--log', str(log), *play.player))
        figures, player_figures = _watch(node, player, listener, on_second)
        _wait_until_quiet(listener, node)
        node.stop()
        return MeasuredRun(listener.received(), listener.diagnostics, figures, player_figures,
                           started_ns, ready_ns, timings, log)


def _watch(node: Process, player: Process, listener: _Listener,
           on_second: Callable[[], object]) -> tuple[list[ProcessFigures], list[ProcessFigures]]:
    """Figures of node and player from the first pose to the end of the player."""
    figures, player_figures = [], []
    while not listener.heard.wait(0.05):
        node.check()
        if player.ended():
            raise LiveRunError(f'the node published no pose; see {node.log}')
    while not player.ended():
        node.check()
        try:
            figures.append(process_figures(node.pid))
            player_figures.append(process_figures(player.pid))
        except (OSError, KeyError):   # it has just ended
            break
        on_second()
        time.sleep(1.0)
    player.wait(30.0)
    return figures, player_figures[:len(figures)]


def _wait_for(condition: Callable[[], bool], *processes: Process) -> None:
    deadline = time.monotonic() + _START_TIMEOUT
    while not condition():
        for process in processes:
            process.check()
        if time.monotonic() > deadline:
            raise LiveRunError(f'the node was not ready within {_START_TIMEOUT:g} s')
        time.sleep(0.01)


def _wait_until_quiet(listener: _Listener, node: Process) -> None:
    count, since = -1, time.monotonic()
    while time.monotonic() - since < _QUIET:
        node.check()
        if len(listener.poses) != count:
            count, since = len(listener.poses), time.monotonic()
        time.sleep(0.1)
