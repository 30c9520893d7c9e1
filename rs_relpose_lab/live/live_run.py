"""The real node on a bag in real time: node and player as processes over Fast DDS.

For the demo and for measurements: what they say of the node is what a user's graph would give.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rs_relpose_lab.live.graph import diagnostic_values, Graph, private_domain
from rs_relpose_lab.live.processes import (
    LiveRunError,
    node_process,
    PATIENCE,
    player_process,
    Process,
    wait_until,
    wait_until_quiet,
)
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.messages.incoming import stamp_ns, time_ns
from rs_relpose_ros.messages.outgoing import PAIR_TOPICS
from rs_relpose_ros.messages.pair_status import number
from rs_relpose_ros.node.message_types import message_class
from rs_relpose_ros.replay.tables import (
    RELATIVE_POSE_COLUMNS,
    rotation_sigmas,
    table_writer,
    translation_sigmas,
)


@dataclass(frozen=True, slots=True)
class LiveRun:
    """Files of a live run: poses that the node published, stamps of the frames it processed."""

    table: Path
    stamps: Path


def run_live(bag: Path, parameters: Path, folder: Path) -> LiveRun:
    """Play `bag` to a relpose_node of its own; tables and logs into `folder`, which exists."""
    with open_bag(bag) as opened:
        topics, duration = opened.find_topics(), opened.duration
    run = LiveRun(folder / 'live.csv', folder / 'live_stamps.txt')
    remap = {'image': topics.image.name.removesuffix('/compressed'), 'imu': topics.imu.name}
    for name, topic in (('camera_info', topics.camera_info), ('accel', topics.accel)):
        if topic is not None:
            remap[name] = topic.name
    with private_domain(), Graph() as graph, node_process(
            parameters, remap=remap, parameters={'stamps_file': run.stamps},
            log=folder / 'relpose_node.log') as node:
        recorder = Recorder(graph, node)
        with player_process(bag, log=folder / 'player.log') as player:
            wait_until(player.ended, 'the end of the player', node,
                       timeout=2.0 * PATIENCE + duration)
        # It is done when it has taken no frame for a second.
        wait_until_quiet(lambda: run.stamps.stat().st_size, 1.0, node)
        node.stop()
        if not recorder.write(run.table):
            raise LiveRunError(f'the node published no pose:\n{node.output}')
    return run


class Recorder:
    """Collects the topics of the pairs that a node publishes.

    `node`: must not end before it publishes.
    """

    def __init__(self, graph: Graph, node: Process) -> None:
        self._received = {name: graph.listen(message_class(msgtype), f'/relpose_node/{name}')
                          for name, msgtype in PAIR_TOPICS.items()}
        for name in PAIR_TOPICS:
            graph.wait_for_publisher(f'/relpose_node/{name}', node)

    def write(self, path: Path) -> int:
        """Write the pairs that came, and return their number.

        Pairs without a pose are left out, and the cells of the number of matches and the model
        stay empty.
        """
        poses, references, matches, pairs = (
            {stamp_ns(msg.header): msg for msg in self._received[name]}
            for name in ('relative_pose', 'reference', 'matches', 'pairs'))
        with table_writer(path, RELATIVE_POSE_COLUMNS) as write:
            for stamp, pose in sorted(poses.items()):
                reference = references.get(stamp)
                cloud = matches.get(stamp)
                told = diagnostic_values(pairs[stamp]) if stamp in pairs else {}
                write([
                    '' if reference is None else str(time_ns(reference.time_ref)), str(stamp),
                    *map(number, _pose_figures(pose)), '' if cloud is None else str(cloud.width),
                    '', '', Status.OK.value,
                    *(told.get(name, '') for name in ('baseline_m', 'baseline_log_sigma'))])
        return len(poses)


def _pose_figures(msg: Any) -> list[float]:
    t, q = msg.pose.pose.position, msg.pose.pose.orientation
    covariance = np.array(msg.pose.covariance).reshape(6, 6)
    return [t.x, t.y, t.z, q.x, q.y, q.z, q.w, *translation_sigmas(covariance),
            *rotation_sigmas(covariance)]
