"""The real node on a bag in real time: node, recorder and player as three processes over Fast DDS.

For the demo and for measurements: what they say of the node is what a user's graph would give.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.errors import RsRelposeError

# Compiling all kernels takes minutes, where nobody has done it ahead.
_START_TIMEOUT = 600.0
# The node is done when it has taken no frame for so long.
_QUIET = 1.0


class LiveRunError(RsRelposeError):
    """A process failed or did not become ready; the text says which, with the end of its log."""


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


class _Process:
    """A Python process of the project with its log file."""

    def __init__(self, folder: Path, name: str, module: str, *arguments: str) -> None:
        self.name, self.log = name, folder / f'{name}.log'
        # Nothing leaves this machine, and nobody else's nodes take part: an id of this process,
        # below 102, as the DDS ports of higher ones run into those of other programs.
        environment = {**os.environ, 'PYTHONUNBUFFERED': '1',
                       'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
                       'ROS_DOMAIN_ID': str(1 + os.getpid() % 100),
                       'AMENT_PREFIX_PATH': os.environ.get('AMENT_PREFIX_PATH', sys.prefix)}
        with self.log.open('wb') as log:
            self._process = subprocess.Popen(
                [sys.executable, '-m', module, *arguments], env=environment, stdout=log,
                stderr=subprocess.STDOUT)

    def __enter__(self) -> _Process:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()

    @property
    def text(self) -> str:
        """What it has said so far."""
        return self.log.read_text(encoding='utf-8', errors='replace')

    def check(self) -> None:
        """Raise if it has ended with an error."""
        if self._process.poll() not in (None, 0):
            raise self._failure(f'ended with code {self._process.returncode}')

    def wait(self, timeout: float) -> None:
        """Wait for its end."""
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            raise self._failure(f'did not end within {timeout:g} s') from None
        self.check()

    def stop(self) -> None:
        """Ask it to end, as Ctrl-C does."""
        self._process.send_signal(signal.SIGINT)
        self.wait(15.0)

    def _failure(self, what: str) -> LiveRunError:
        tail = '\n'.join(self.text.splitlines()[-15:])
        return LiveRunError(f'{self.name} {what}; the end of {self.log}:\n{tail}')


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
        node = stack.enter_context(_Process(
            folder, 'relpose_node', 'rs_relpose_ros.ros.node', '--ros-args', '--params-file',
            str(parameters), '-p', f'stamps_file:={run.stamps}',
            *(word for name, topic in remap.items() for word in ('-r', f'{name}:={topic}'))))
        recorder = stack.enter_context(_Process(
            folder, 'recorder', 'rs_relpose_ros.ros.recorder', str(run.table)))
        _wait_for(lambda: 'ready' in recorder.text, 'the recorder found no node', node, recorder)
        # The player waits until the node subscribes, which it does once its kernels are compiled.
        player = stack.enter_context(_Process(
            folder, 'player', 'rs_relpose_ros.ros.player', str(bag), '--wait-for-subscribers',
            str(_START_TIMEOUT)))
        player.wait(2.0 * _START_TIMEOUT + duration)
        _wait_until_quiet(run.stamps)
        recorder.stop()
        node.stop()
    return run


def _wait_for(condition: Callable[[], bool], complaint: str, *processes: _Process) -> None:
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
