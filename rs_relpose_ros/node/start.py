"""Entry of the console scripts: a signal ends the node quietly even while it still imports.

Imports nothing heavy itself. Before rclpy runs, SIGINT would end the process with a traceback and
SIGTERM with a signal's exit code.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
from types import FrameType
from typing import NoReturn

from rs_relpose_ros.blas_threads import use_one_blas_thread

# Time [s] for rclpy to end its contexts.
_GRACE = 0.3

_started = False


def main() -> NoReturn:
    """Run relpose_node, and end the process with its exit code."""
    start('rs_relpose_ros.node.node')


def start(module: str) -> NoReturn:
    """Run the node whose `main` is in `module`, and end the process with its exit code."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _on_signal)
    use_one_blas_thread()
    from rs_relpose_ros.node.run import leave
    run = importlib.import_module(module).main
    leave(run(on_started=_on_started))


def _on_started() -> None:
    """From here on rclpy's own handlers end the node; they call this one too."""
    global _started
    _started = True


def _on_signal(number: int, frame: FrameType | None) -> None:
    if not _started:
        # Nothing was begun that would need an end.
        os._exit(0)
    # A thread of rclpy's own ends its contexts, but for one that is made at this very moment. Not
    # at once: two threads that end one context can crash the process. In a thread, since this one
    # may hold a lock that it needs.
    late = threading.Timer(_GRACE, sys.modules['rclpy'].try_shutdown)
    late.daemon = True
    late.start()


if __name__ == '__main__':
    main()
