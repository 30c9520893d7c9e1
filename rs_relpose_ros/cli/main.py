"""``rs_relpose <command>``: everything that runs offline."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
import logging
import os
import platform
import shlex
import sys
import tempfile
import traceback
from types import MappingProxyType
from typing import Any, NamedTuple

from rs_relpose_ros.blas_threads import use_one_blas_thread
from rs_relpose_ros.errors import library, MissingInputError, RsRelposeError
from rs_relpose_ros.garbage import collect_seldom

# Name of the command line. [derived: console script of setup.py]
PROGRAM = 'rs_relpose'

# Each command's module (and its `Command` there), and one line of help. A module is imported only
# for its command, so that the overview needs neither OpenCV nor Numba. Commands of the laboratory,
# which is another package, are found by name, so that the product does not depend on it.
COMMANDS: Mapping[str, tuple[str, str]] = {
    'batch': ('rs_relpose_ros.cli.batch', 'check, calibrate or replay over many bags, on Dask'),
    'benchmark': (
        'rs_relpose_lab.cli.benchmark',
        'measure accuracy and speed of the estimator: tables and plots',
    ),
    'check': (
        'rs_relpose_ros.cli.recordings:CHECK',
        'check a bag for defects that degrade the poses, with suggested fixes',
    ),
    'calibrate': (
        'rs_relpose_ros.cli.recordings:CALIBRATE',
        'readout time, time offset, axes and gyro bias from a bag, without a target',
    ),
    'convert': (
        'rs_relpose_ros.cli.recordings:CONVERT',
        'convert a recording of a camera or phone to a bag and its parameter file',
    ),
    'evaluate': (
        'rs_relpose_lab.cli.evaluate',
        'run the experiments of the paper: tables and box plots',
    ),
    'export': (
        'rs_relpose_ros.cli.poses:EXPORT',
        'images, poses of rows and points for COLMAP, nerfstudio, gsplat and others',
    ),
    'odometry': (
        'rs_relpose_ros.cli.poses:ODOMETRY',
        'a metric path from a bag: relative poses and IMU in one graph',
    ),
    'pairs': (
        'rs_relpose_ros.cli.poses:PAIRS',
        'relative poses of chosen pairs of images, such as loop closures',
    ),
    'replay': (
        'rs_relpose_ros.cli.poses:REPLAY',
        'estimate relative poses from a bag: CSV, summary and pictures',
    ),
    'report': (
        'rs_relpose_ros.cli.report',
        'one HTML page about a bag: can it be used, what is wrong, what comes out',
    ),
    'unroll': (
        'rs_relpose_ros.cli.recordings:UNROLL',
        'derotate the images of a bag to the time of their middle row',
    ),
    'simulate': (
        'rs_relpose_lab.cli.simulate',
        'render rolling-shutter images and IMU of a known motion into a bag',
    ),
}

# What a command of the laboratory lacks where only this package is installed.
LABORATORY = (
    'the package rs_relpose_lab, which is not installed: in the checkout of this version, '
    '"pip install ./rs_relpose_lab"'
)
# Exit codes besides 0, which scripts of users rely on. [derived: interface of the commands]
FAILED = 1  # the work ran, and failed
BAD_INPUT = 2  # bad usage or bad input: nothing ran
INTERRUPTED = 130  # 128 + SIGINT, as shells report it
PIPE_CLOSED = 141  # 128 + SIGPIPE

# Errors that mean an unusable path of the user. Another OSError, as of a full disk, is a failure.
# [chosen: these errors name a file]
_BAD_PATHS = (
    FileNotFoundError,
    FileExistsError,
    PermissionError,
    IsADirectoryError,
    NotADirectoryError,
)

_logger = logging.getLogger(__name__)


class Command(NamedTuple):
    """A command; `run` returns the exit code. A module of one command has the same names."""

    HELP: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]
    # Options whose value may be left out: the values that each of them has, and the usual one.
    optional_values: Mapping[str, tuple[Sequence[str], str]] = MappingProxyType({})


def package_version() -> str:
    """Version of the installed package."""
    with suppress(PackageNotFoundError):  # run from a source tree
        return version('rs_relpose_ros')
    return 'not installed'


def load_command(name: str) -> Command:
    """Import the command `name`; MissingInputError if its package is not installed."""
    module, _, attribute = COMMANDS[name][0].partition(':')
    command: Any = library(module, f'the command {name} needs {LABORATORY}')
    if attribute:
        command = getattr(command, attribute)
    optional_values = getattr(command, 'optional_values', {})
    return Command(command.HELP, command.add_arguments, command.run, optional_values)


def with_optional_values(arguments: Sequence[str], command: Command) -> list[str]:
    """Return arguments in which each option with an optional value has one.

    argparse would take the word after such an option for its value, even if it is a bag.
    """
    words: list[str] = []
    following = [*arguments[1:], '']
    for word, after in zip(arguments, following, strict=True):
        words.append(word)
        if word in command.optional_values:
            known, usual = command.optional_values[word]
            words += [] if after in known else [usual]
    return words


def make_parser(selected: str | None) -> argparse.ArgumentParser:
    """Return the parser of all commands, with the arguments of the `selected` command only."""
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description='Relative poses of rolling-shutter images, aided by an IMU: offline tools.',
        epilog=f'"{PROGRAM} COMMAND --help" describes a command. Exit codes: 0 done, 1 the work '
        'ran and failed, 2 bad usage or bad input. An internal error (code 1) names the file of '
        'a report.',
    )
    parser.add_argument(
        '--version',
        action='version',
        version=f'{PROGRAM} {package_version()}',
        help='print the version and exit',
    )
    _add_verbose(parser, default=0)
    commands = parser.add_subparsers(dest='command', metavar='COMMAND', required=True)
    for name, (_, one_line) in COMMANDS.items():
        command = commands.add_parser(name, help=one_line)
        if name == selected:
            loaded = load_command(name)
            command.description = loaded.HELP
            loaded.add_arguments(command)
            # This -v has no default, so that an -v before the command is kept.
            _add_verbose(command, default=argparse.SUPPRESS)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line, by default the one of the process, and return its exit code."""
    use_one_blas_thread()
    if argv is None:  # else the process is that of the caller
        collect_seldom()
    try:
        code = _run(sys.argv[1:] if argv is None else list(argv))
        # If the pipe is closed, this raises here and not while the interpreter shuts down.
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PIPE_CLOSED
    except KeyboardInterrupt:
        return _report_error('interrupted', INTERRUPTED)
    return code


def _run(arguments: list[str]) -> int:
    """Parse and run; errors in the input become one line and exit code 2."""
    # The options before the command have no values, so the first plain word is the command.
    selected = next((word for word in arguments if not word.startswith('-')), None)
    try:
        parser = make_parser(selected)
        if not arguments:
            parser.print_help(sys.stderr)
            return _report_error('error: give one of these commands', BAD_INPUT)
        if selected is not None and selected in COMMANDS:
            arguments = with_optional_values(arguments, load_command(selected))
        args = parser.parse_args(arguments)
    except MissingInputError as error:
        return _report_error(f'error: {error}', BAD_INPUT)
    except SystemExit as end:  # argparse has printed the error or the help
        return end.code if isinstance(end.code, int) else BAD_INPUT
    logging.basicConfig(level=logging.WARNING, format='%(levelname)s %(name)s: %(message)s')
    # At level DEBUG, Numba and Matplotlib would fill pages: only our packages get the level.
    for package in ('rs_relpose_ros', 'rs_relpose_lab'):
        logging.getLogger(package).setLevel(
            {0: logging.WARNING, 1: logging.INFO}.get(args.verbose, logging.DEBUG)
        )
    try:
        return int(load_command(args.command).run(args))
    except BrokenPipeError:
        raise
    except (RsRelposeError, OSError) as error:
        _logger.debug('raised here', exc_info=True)
        if isinstance(error, _BAD_PATHS):
            return _report_error(f'error: {error.filename}: {error.strerror}', BAD_INPUT)
        if isinstance(error, OSError) and error.filename is not None:
            # Another one, such as a full disk: the input was fine.
            return _report_error(f'error: {error.filename}: {error.strerror}', FAILED)
        return _report_error(
            f'error: {error}', FAILED if isinstance(error, OSError) else BAD_INPUT
        )
    except Exception as error:
        _logger.debug('raised here', exc_info=True)
        report = _write_report(arguments, error)
        return _report_error(
            f'internal error ({type(error).__name__}), which is a fault of this program: please '
            f'report it with the file {report}',
            FAILED,
        )


# Packages whose versions a report of an internal error has.
_REPORTED = (
    'rs_relpose_ros',
    'numpy',
    'scipy',
    'numba',
    'opencv-python-headless',
    'rosbags',
    'av',
)


def _write_report(arguments: Sequence[str], error: Exception) -> str:
    """Write what a developer needs to know of an internal error into a file; its path.

    It has the arguments, versions and the traceback, and nothing of the user's recordings.
    """
    lines = [f'{PROGRAM} {shlex.join(arguments)}', '', f'python {platform.python_version()}']
    lines.append(f'system {platform.platform()}')
    for name in _REPORTED:
        with suppress(PackageNotFoundError):
            lines.append(f'{name} {version(name)}')
    lines += ['', *traceback.format_exception(error)]
    try:
        with tempfile.NamedTemporaryFile(
            'w', prefix=f'{PROGRAM}_error_', suffix='.txt', delete=False, encoding='utf-8'
        ) as file:
            file.write('\n'.join(lines))
    except OSError:
        return 'that cannot be written: run the command again with -vv'
    return file.name


def _add_verbose(parser: argparse.ArgumentParser, default: Any) -> None:
    parser.add_argument(
        '-v',
        '--verbose',
        action='count',
        default=default,
        help='log the progress; twice for details',
    )


def _report_error(message: str, code: int) -> int:
    """Print one line to stderr and return `code`."""
    print(f'{PROGRAM}: {" ".join(message.split())}', file=sys.stderr)
    return code


if __name__ == '__main__':
    sys.exit(main())
