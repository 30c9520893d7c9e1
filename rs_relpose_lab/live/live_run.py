"""The real node on a bag in real time: node and player as processes over Fast DDS.

For the demo and for measurements: what they say of the node is what a user's graph would give.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rs_relpose_lab.live.graph import Graph, private_domain
from rs_relpose_lab.live.processes import (
    LiveRunError,
    node_process,
    PATIENCE,
    player_process,
    wait_until,
    wait_until_quiet,
)
from rs_relpose_lab.live.recorder import Recorder
from rs_relpose_ros.bags.reader import open_bag

# The node is done when it has taken no frame for so long [s].
_QUIET = 1.0


@dataclass(frozen=True, slots=True)
class LiveRun:
    """Files of a live run.

    `table`: the relative poses that the node published.
    `stamps`: stamps of the frames that it processed, for `rs_relpose replay --stamps`.
    """

    table: Path
    stamps: Path


def run_live(bag: Path, parameters: Path, folder: Path) -> LiveRun:
    """Play `bag` to a relpose_node of its own.

    `parameters`: parameter file of the node.
    `folder`: directory for tables and logs; must exist.
    Raises LiveRunError.
    Raises InputError, MissingInputError: the bag cannot be read or lacks a topic.
    """
    with open_bag(bag) as opened:
        topics, duration = opened.find_topics(), opened.duration
    run = LiveRun(folder / 'live.csv', folder / 'live_stamps.txt')
    remap = {'image': topics.image.name.removesuffix('/compressed'),
             'camera_info': topics.camera_info.name, 'imu': topics.imu.name}
    if topics.accel is not None:
        remap['accel'] = topics.accel.name
    with private_domain(), Graph() as graph, node_process(
            parameters, remap=remap, parameters={'stamps_file': run.stamps},
            log=folder / 'relpose_node.log') as node:
        recorder = Recorder(graph, node)
        with player_process(bag, log=folder / 'player.log') as player:
            wait_until(player.ended, 'the end of the player', node,
                       timeout=2.0 * PATIENCE + duration)
        wait_until_quiet(lambda: run.stamps.stat().st_size, _QUIET, node)
        node.stop()
        if not recorder.write(run.table):
            raise LiveRunError(f'the node published no pose:\n{node.output}')
    return run
