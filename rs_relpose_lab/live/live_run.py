"""The real node on a bag in real time: node, recorder and player as three processes over Fast DDS.

For the demo and for measurements: what they say of the node is what a user's graph would give.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
import time

from rs_relpose_lab.live.processes import LiveRunError, Process
from rs_relpose_ros.bags.reader import open_bag

# Compiling all kernels takes minutes, where nobody has done it ahead.
_START_TIMEOUT = 600.0
# The node is done when it has taken no frame for so long.
_QUIET = 1.0


@dataclass(frozen=True, slots=True)
class LiveRun:
    """Files of a live run.

    Attributes
    ----------
    table : Path
        The relative poses that the node published.
    stamps : Path
        Stamps of the frames that it processed, for `rs_relpose replay --stamps`.
    """

    table: Path
    stamps: Path


def run_live(bag: Path, parameters: Path, folder: Path) -> LiveRun:
    """Play `bag` to a relpose_node of its own.

    Parameters
    ----------
    bag : Path
    parameters : Path
        Parameter file of the node.
    folder : Path
        Directory for tables and logs; must exist.

    Raises
    ------
    LiveRunError
    InputError, MissingInputError
        The bag cannot be read or lacks a topic.
    """
    with open_bag(bag) as opened:
        topics, duration = opened.find_topics(), opened.duration
    run = LiveRun(folder / 'live.csv', folder / 'live_stamps.txt')
    remap = {'image': topics.image.name.removesuffix('/compressed'),
             'camera_info': topics.camera_info.name, 'imu': topics.imu.name}
    if topics.accel is not None:
        remap['accel'] = topics.accel.name
    with ExitStack() as stack:
        node = stack.enter_context(Process(
            folder, 'relpose_node', 'rs_relpose_ros.node.node', '--ros-args', '--params-file',
            str(parameters), '-p', f'stamps_file:={run.stamps}',
            *(word for name, topic in remap.items() for word in ('-r', f'{name}:={topic}'))))
        recorder = stack.enter_context(Process(
            folder, 'recorder', 'rs_relpose_lab.live.recorder', str(run.table)))
        _wait_for(lambda: 'ready' in recorder.text, 'the recorder found no node', node, recorder)
        # The player waits until the node subscribes, which it does once its kernels are compiled.
        player = stack.enter_context(Process(
            folder, 'player', 'rs_relpose_lab.live.player', str(bag), '--wait-for-subscribers',
            str(_START_TIMEOUT)))
        player.wait(2.0 * _START_TIMEOUT + duration)
        _wait_until_quiet(run.stamps)
        recorder.stop()
        node.stop()
    return run


def _wait_for(condition: Callable[[], bool], complaint: str, *processes: Process) -> None:
    """Wait until `condition()` holds."""
    deadline = time.monotonic() + _START_TIMEOUT
    while not condition():
        for process in processes:
            process.check()
        if time.monotonic() > deadline:
            raise LiveRunError(f'{complaint} within {_START_TIMEOUT:g} s')
        time.sleep(0.05)


def _wait_until_quiet(path: Path) -> None:
    """Wait until a file has not grown for some time."""
    size, since = -1, time.monotonic()
    while time.monotonic() - since < _QUIET:
        now = path.stat().st_size
        if now != size:
            size, since = now, time.monotonic()
        time.sleep(0.05)
