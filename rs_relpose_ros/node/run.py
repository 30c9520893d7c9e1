"""A node as a process: its help, its signals, its end."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
import logging
import os
import signal
import sys
from typing import NoReturn

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.utilities import remove_ros_args

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.node.stoppable import StoppableNode


def run_node(make: Callable[[], StoppableNode], name: str, description: str,
             arguments: Sequence[str] | None = None,
             on_started: Callable[[], object] = lambda: None) -> int:
    """Run a node; its exit code: 0 after SIGINT or SIGTERM, 2 for an illegal parameter.

    `description` is that of its ``--help``; `on_started` is called once rclpy handles the signals.
    """
    given = sys.argv if arguments is None else [name, *arguments]
    logger = rclpy.logging.get_logger(name)
    try:
        own = remove_ros_args(given)
    except rclpy_implementation.RCLInvalidROSArgsError as error:
        # rcl names its source files behind the sentence.
        logger.fatal(str(error).split(', at /')[0].strip())
        return 2
    _help(name, description).parse_args(own[1:])
    rclpy.init(args=list(given))
    on_started()
    node: StoppableNode | None = None
    try:
        node = make()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except rclpy_implementation.RCLError:
        # A signal may end the context amid a call.
        if rclpy.ok():
            raise
    except RsRelposeError as error:
        logger.fatal(str(error))
        return 2
    finally:
        _finish(node)
    return 0


def _help(name: str, description: str) -> argparse.ArgumentParser:
    lines = ['parameters (set them with --ros-args -p NAME:=VALUE or --params-file FILE):']
    for parameter, default, declared in Parameters.declarations():
        shown = 'no default' if default is None else f'default {default!r}'
        lines.append(f'  {parameter}: {declared.description}. {declared.legal}; {shown}'
                     f'{"; live" if declared.live else ""}')
    return argparse.ArgumentParser(
        prog=name, formatter_class=argparse.RawDescriptionHelpFormatter, description=description,
        epilog='\n'.join(lines))


def _finish(node: StoppableNode | None) -> None:
    """End the node; signals are ignored from here on, as Ctrl-C comes twice under ros2 launch."""
    _ignore_signals()
    if node is not None:
        if not node.stop():
            # The thread compiles or loads kernels, which cannot be interrupted.
            leave(0)
        node.destroy_node()
    rclpy.try_shutdown()
    # rclpy has restored the handlers that were there before it.
    _ignore_signals()


def leave(code: int) -> NoReturn:
    """End the process at once, all of its output written.

    Threads of ours, of OpenCV or of the middleware that still run while the interpreter and the
    libraries go down can abort it.
    """
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _ignore_signals() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
