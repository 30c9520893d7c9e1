"""``rs_relpose <command>``: everything that runs offline."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
import importlib
import importlib.util
import logging
import os
import sys
from types import ModuleType
from typing import Any

from rs_relpose_ros.blas_threads import use_one_blas_thread
from rs_relpose_ros.errors import MissingInputError, RsRelposeError

PROGRAM = 'rs_relpose'

# Name -> module, one line of help. The module is imported only when its command is asked for: the
# overview does not wait for OpenCV and Numba. Those of the laboratory, another package, are found
# by name, so that the product does not depend on it.
COMMANDS: Mapping[str, tuple[str, str]] = {
    'batch': ('rs_relpose_ros.cli.batch',
              'check, calibrate or replay over many bags, on Dask'),
    'benchmark': ('rs_relpose_lab.cli.benchmark',
                  'measure accuracy and speed of the estimator: tables and plots'),
    'check': ('rs_relpose_ros.cli.check',
              'look through a bag for what would spoil the poses, with remedies'),
    'calibrate': ('rs_relpose_ros.cli.calibrate',
                  'read-out time, time offset, axes and gyro bias from a bag, without a target'),
    'convert': ('rs_relpose_ros.cli.convert',
                'turn a recording of a camera or phone into a bag and its parameter file'),
    'evaluate': ('rs_relpose_lab.cli.evaluate',
                 'run the experiments of the paper: tables and box plots'),
    'odometry': ('rs_relpose_ros.cli.odometry',
                 'a metric path from a bag: relative poses and IMU in one graph'),
    'pairs': ('rs_relpose_ros.cli.pairs',
              'relative poses of chosen pairs of images, such as loop closures'),
    'replay': ('rs_relpose_ros.cli.replay',
               'estimate relative poses from a bag: CSV, summary and pictures'),
    'unroll': ('rs_relpose_ros.cli.unroll',
               'turn the images of a bag as if they came from a global shutter'),
    'simulate': ('rs_relpose_lab.cli.simulate',
                 'render rolling-shutter images and IMU of a known motion into a bag'),
}

DONE, FAILED, BAD_INPUT = 0, 1, 2
INTERRUPTED = 130  # 128 + SIGINT, as shells report it
PIPE_CLOSED = 141  # 128 + SIGPIPE

_logger = logging.getLogger(__name__)


class _Version(argparse.Action):
    """``--version``; looks the version up only when asked."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        from importlib.metadata import version
        print(f'{PROGRAM} {version("rs_relpose_ros")}')
        parser.exit()


def load_command(name: str) -> ModuleType:
    """Import the module of command `name`: its HELP, `add_arguments(parser)` and `run(args)`.

    `run` returns 0 when done, 1 when it ran and failed. MissingInputError where the command
    belongs to the laboratory, which is not installed.
    """
    module, _ = COMMANDS[name]
    package = module.partition('.')[0]
    if importlib.util.find_spec(package) is None:
        raise MissingInputError(f'the command {name} needs the package {package}, which is not '
                                'installed')
    return importlib.import_module(module)


def make_parser(selected: str | None) -> argparse.ArgumentParser:
    """Return the parser of all commands, with the arguments of the `selected` one only."""
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description='Relative poses of rolling-shutter images, aided by an IMU: offline tools.',
        epilog=f'"{PROGRAM} COMMAND --help" describes a command. Exit codes: 0 done, 1 the work '
               'ran and failed, 2 bad usage or bad input.')
    parser.add_argument('--version', action=_Version, nargs=0, help='print the version and exit')
    _add_verbose(parser, default=0)
    commands = parser.add_subparsers(dest='command', metavar='COMMAND', required=True)
    for name, (_, one_line) in COMMANDS.items():
        command = commands.add_parser(name, help=one_line)
        if name == selected:
            module = load_command(name)
            command.description = module.HELP
            module.add_arguments(command)
            # Without a default of its own, so that an -v before the command is kept.
            _add_verbose(command, default=argparse.SUPPRESS)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv` (default: that of the process) and return its exit code."""
    use_one_blas_thread()
    try:
        code = _run(sys.argv[1:] if argv is None else list(argv))
        # A closed pipe shows here, and not as a complaint while the interpreter shuts down.
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PIPE_CLOSED
    except KeyboardInterrupt:
        return _complain('interrupted', INTERRUPTED)
    return code


def _run(arguments: list[str]) -> int:
    """Parse and run; errors in the input become one line and exit code 2."""
    # No option of the top parser takes a value, so the first plain word is the command.
    selected = next((word for word in arguments if not word.startswith('-')), None)
    try:
        args = make_parser(selected).parse_args(arguments)
    except MissingInputError as error:
        return _complain(f'error: {error}', BAD_INPUT)
    except SystemExit as end:  # argparse has said why, or has printed the help
        return end.code if isinstance(end.code, int) else BAD_INPUT
    _set_up_logging(args.verbose)
    try:
        return int(load_command(args.command).run(args))
    except RsRelposeError as error:
        _logger.debug('refused here', exc_info=True)
        return _complain(f'error: {error}', BAD_INPUT)
    except BrokenPipeError:
        raise
    except (FileNotFoundError, FileExistsError, PermissionError, IsADirectoryError,
            NotADirectoryError) as error:  # a path of the user's that cannot be used
        _logger.debug('refused here', exc_info=True)
        return _complain(f'error: {error.filename}: {error.strerror}', BAD_INPUT)
    except OSError as error:  # such as a full disk: the input was fine
        _logger.debug('failed here', exc_info=True)
        return _complain(f'error: {error}', FAILED)


def _add_verbose(parser: argparse.ArgumentParser, default: Any) -> None:
    parser.add_argument('-v', '--verbose', action='count', default=default,
                        help='log what is done; twice for details')


def _set_up_logging(verbosity: int) -> None:
    level = {0: logging.WARNING, 1: logging.INFO}.get(verbosity, logging.DEBUG)
    logging.basicConfig(level=logging.WARNING, format='%(levelname)s %(name)s: %(message)s')
    # Numba and Matplotlib would fill pages at level DEBUG.
    for package in ('rs_relpose_ros', 'rs_relpose_lab'):
        logging.getLogger(package).setLevel(level)


def _complain(message: str, code: int) -> int:
    """Print one line to stderr and return `code`."""
    print(f'{PROGRAM}: {" ".join(message.split())}', file=sys.stderr)
    return code


if __name__ == '__main__':
    sys.exit(main())
