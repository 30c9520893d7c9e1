"""Records the pairs of a running relpose_node, as the table that a replay writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rs_relpose_lab.live.graph import Graph
from rs_relpose_lab.live.processes import Process
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.messages.incoming import stamp_ns, time_ns
from rs_relpose_ros.messages.outgoing import PAIR_TOPICS
from rs_relpose_ros.node.message_types import message_class
from rs_relpose_ros.replay.tables import (
    number,
    RELATIVE_POSE_COLUMNS,
    rotation_sigmas,
    table_writer,
    translation_sigmas,
)


class Recorder:
    """Collects the topics of the pairs that a node publishes.

    Parameters
    ----------
    graph : Graph
    node : Process
        Must not end before it publishes.
    """

    def __init__(self, graph: Graph, node: Process) -> None:
        self._received = {name: graph.listen(message_class(msgtype), f'/relpose_node/{name}')
                          for name, msgtype in PAIR_TOPICS.items()}
        for name in PAIR_TOPICS:
            graph.wait_for_publisher(f'/relpose_node/{name}', node)

    def write(self, path: Path) -> int:
        """Write the pairs that came, and return their number.

        The live topics carry neither pairs without a pose nor the number of matches and the model:
        these cells stay empty.
        """
        poses, references, matches = (
            {stamp_ns(msg.header): msg for msg in self._received[name]}
            for name in ('relative_pose', 'reference', 'matches'))
        with table_writer(path, RELATIVE_POSE_COLUMNS) as write:
            for stamp, pose in sorted(poses.items()):
                reference = references.get(stamp)
                cloud = matches.get(stamp)
                write([
                    '' if reference is None else str(time_ns(reference.time_ref)), str(stamp),
                    *map(number, _pose_figures(pose)), '' if cloud is None else str(cloud.width),
                    '', '', Status.OK.value])
        return len(poses)


def _pose_figures(msg: Any) -> list[float]:
    t, q = msg.pose.pose.position, msg.pose.pose.orientation
    covariance = np.array(msg.pose.covariance).reshape(6, 6)
    return [t.x, t.y, t.z, q.x, q.y, q.z, q.w, *translation_sigmas(covariance),
            *rotation_sigmas(covariance)]
