"""Records what a running relpose_node publishes, as the table that a replay writes.

    python -m rs_relpose_lab.live.recorder live.csv

Says "ready" on standard output once the node's publishers are matched. Writes the table and ends
on SIGINT or SIGTERM.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
import sys
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.utilities import remove_ros_args

from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.messages.incoming import stamp_ns, time_ns
from rs_relpose_ros.messages.outgoing import PAIR_TOPICS
from rs_relpose_ros.node.message_types import message_class
from rs_relpose_ros.replay.record import rotation_sigmas, translation_sigmas
from rs_relpose_ros.replay.tables import number, RELATIVE_POSE_COLUMNS, TableWriter

_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=1000,
                  reliability=ReliabilityPolicy.RELIABLE)


class Recorder(Node):
    """Collects the four topics of a node by their common stamp.

    Parameters
    ----------
    target : str
        Name of the node.
    """

    def __init__(self, target: str) -> None:
        super().__init__('relpose_recorder')
        self._received: dict[str, dict[int, Any]] = {}
        self._topics = {}
        for name, msgtype in PAIR_TOPICS.items():
            self._received[name] = {}
            subscription = self.create_subscription(
                message_class(msgtype), f'{target}/{name}', self._receiver(name), _QOS)
            self._topics[name] = subscription.topic_name

    def matched(self) -> bool:
        """Whether every topic has a publisher."""
        return all(self.count_publishers(topic) for topic in self._topics.values())

    def write(self, path: Path) -> int:
        """Write the pairs whose messages came, and return their number.

        The live topics carry neither pairs without a pose nor the number of matches and the model:
        these cells stay empty.
        """
        poses = self._received['relative_pose']
        with TableWriter(path, RELATIVE_POSE_COLUMNS) as table:
            for stamp in sorted(poses):
                table.write(self._cells(stamp, poses[stamp]))
        return len(poses)

    def _receiver(self, name: str) -> Any:
        def receive(msg: Any) -> None:
            self._received[name][stamp_ns(msg.header)] = msg
        return receive

    def _cells(self, stamp: int, msg: Any) -> list[str]:
        pose, covariance = msg.pose.pose, np.array(msg.pose.covariance).reshape(6, 6)
        figures = [pose.position.x, pose.position.y, pose.position.z, pose.orientation.x,
                   pose.orientation.y, pose.orientation.z, pose.orientation.w,
                   *translation_sigmas(covariance), *rotation_sigmas(covariance)]
        reference = self._received['reference'].get(stamp)
        matches = self._received['matches'].get(stamp)
        reference_stamp = ''
        if reference is not None:
            reference_stamp = str(time_ns(reference.time_ref))
        return [reference_stamp, str(stamp), *map(number, figures),
                '' if matches is None else str(matches.width), '', '', Status.OK.value]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; its exit code: 1 when nothing was received."""
    given = sys.argv if arguments is None else ['recorder', *arguments]
    parser = argparse.ArgumentParser(
        prog='recorder', description='Record the relative poses of a running relpose_node.')
    parser.add_argument('table', type=Path, help='CSV file to write')
    parser.add_argument('--node', default='/relpose_node', help='name of the node')
    options = parser.parse_args(remove_ros_args(given)[1:])
    rclpy.init(args=list(given))
    recorder = Recorder(options.node)
    try:
        ready = False
        while True:
            rclpy.spin_once(recorder, timeout_sec=0.05)
            if not ready and recorder.matched():
                ready = True
                sys.stdout.write('ready\n')
                sys.stdout.flush()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        count = recorder.write(options.table)
        recorder.destroy_node()
        rclpy.try_shutdown()
    return 0 if count else 1


if __name__ == '__main__':
    sys.exit(main())
