"""Entry of the console scripts: a signal ends the node quietly, also while it still imports.

Imports nothing heavy itself. SIGINT and SIGTERM are blocked in all threads, and one thread waits
for them. rclpy's own handlers are not used: they end the context in a thread of their own while
the main thread destroys the node, which has crashed the process.
"""

from collections.abc import Callable
from functools import partial
import importlib
import importlib.util
import os
import signal
import sys
import threading
from typing import NoReturn

from rs_relpose_ros.blas_threads import use_one_blas_thread
from rs_relpose_ros.garbage import collect_seldom

# Signals that end a node. [derived: ros2 launch sends the first, systems the second]
_SIGNALS = (signal.SIGINT, signal.SIGTERM)

# What to do where the interpreter finds no ROS. [derived: README and docs/installation.md]
_NO_ROS = (
    'this Python finds no ROS 2 (rclpy): source its setup, such as /opt/ros/jazzy/setup.bash, or '
    'use "make" in the checkout, which installs it; the command rs_relpose works without'
)

_stop: Callable[[], object] | None = None  # ends the spinning of the node


def start(node: str) -> NoReturn:
    """Run the `main` of a node's module, and end the process with its exit code."""
    if importlib.util.find_spec('rclpy') is None:
        sys.stderr.write(f'{node}: error: {_NO_ROS}\n')
        sys.exit(2)
    # Before any thread is made: threads inherit it.
    signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    threading.Thread(target=_wait_for_signal, name='signals', daemon=True).start()
    use_one_blas_thread()
    collect_seldom()
    from rs_relpose_ros.nodes.sensor_node import leave

    run = importlib.import_module(f'rs_relpose_ros.nodes.{node}').main
    leave(run(on_started=_on_started))


def _on_started(stop: Callable[[], object]) -> None:
    global _stop
    _stop = stop


def _wait_for_signal() -> None:
    """Wait for the first signal; later ones stay blocked, as ros2 launch sends Ctrl-C twice."""
    signal.sigwait(_SIGNALS)
    if _stop is None:
        # Nothing was begun that would need an end.
        os._exit(0)
    _stop()


# Entries of the console scripts.
relpose_node = partial(start, 'relpose_node')
global_shutter_node = partial(start, 'global_shutter_node')
odometry_node = partial(start, 'odometry_node')

if __name__ == '__main__':
    start(sys.argv.pop(1))
