"""``rs_relpose batch``: check, calibrate or replay over many bags, on Dask."""

from __future__ import annotations

import argparse
from contextlib import redirect_stderr, redirect_stdout
import io
import math
from pathlib import Path
import shlex
import sys
from tempfile import TemporaryDirectory
import time

import cv2

from rs_relpose_ros.batch.cluster import ask_a_worker, open_cluster
from rs_relpose_ros.batch.combine import Combined
from rs_relpose_ros.batch.figures import RESULT_FILES
from rs_relpose_ros.batch.job import Job, Outcome, State
from rs_relpose_ros.batch.picture import PICTURE_FILE
from rs_relpose_ros.batch.run import BatchOutcome, Request, run_batch
from rs_relpose_ros.batch.store import RESULTS_FILE
from rs_relpose_ros.cli.main import load_command, make_parser
from rs_relpose_ros.cli.options import add_parameter_arguments, package_version, progress_bar
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.errors import InputError, RsRelposeError
from rs_relpose_ros.result_files import refuse_unwritable, SUMMARY_FILE

HELP = ('Run check, calibrate or replay over many bags: on processes of this machine, one thread '
        'each, or on a running Dask cluster (pip install "dask[distributed]"). Writes results.csv '
        '(a row for each bag: state, figures, errors, times), summary.json, overview.png and a '
        'folder with the results of each bag, as a single run writes them. A bag with its result '
        'is not run again unless it, its parameters, the options or the version changed. For '
        'calibrate, all bags must be of one camera: the summary has weighted means, chi2 and '
        'outliers. Exit code 1: some bags were refused, failed, or are not as they should be.')

_SOME_NOT_DONE = 1
_MOST_LINES = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument('batch_command', metavar='COMMAND', choices=tuple(RESULT_FILES),
                        help='check, calibrate or replay')
    parser.add_argument('bags', metavar='BAGS', nargs='+',
                        help='bags, or globs in quotes, as the workers see them')
    parser.add_argument('--out', metavar='DIR', type=Path, required=True,
                        help='directory of the results; those of an earlier run are taken over')
    parser.add_argument('--scheduler', metavar='ADDRESS',
                        help='a running Dask cluster, such as tcp://host:8786; its workers need '
                        'this package (the same version), and one thread each')
    parser.add_argument('--workers', metavar='N', type=int,
                        help='processes of this machine (default: one for each processor)')
    add_parameter_arguments(parser)
    parser.add_argument('--options', metavar='TEXT', default='',
                        help='further options of COMMAND, in quotes: --options="--no-pictures"')


def run(args: argparse.Namespace) -> int:
    """Run the command over all bags; 1 where not all of them are done."""
    if args.workers is not None and args.workers < 1:
        raise InputError(f'--workers must be at least 1, got {args.workers}')
    request = _request(args)
    refuse_unwritable(args.out)
    with open_cluster(args.scheduler, args.workers) as client, \
            progress_bar(0, 'bag', args.batch_command) as bar:
        version = ask_a_worker(client, package_version)
        if version != request.version:
            raise InputError(f'the workers have version {version} of this package, but here it is '
                             f'{request.version}: their results would not be comparable')
        result = run_batch(client, request, args.out, run_job,
                           on_start=bar.reset, on_bag=bar.update)
    for line in report(result, args.out):
        print(line)
    return 0 if set(result.states) == {State.DONE} else _SOME_NOT_DONE


def run_job(job: Job) -> Outcome:
    """Do on a worker what `rs_relpose COMMAND` does, and give its files back."""
    cv2.setNumThreads(1)
    started = time.perf_counter()
    with TemporaryDirectory() as scratch:
        out, printed = Path(scratch, 'out'), io.StringIO()
        words = _words(job, Path(scratch), out)
        state, message = State.REFUSED, ''
        arguments, sys.argv = sys.argv, ['rs_relpose', *words]   # summary.json has them
        try:
            with redirect_stdout(printed), redirect_stderr(io.StringIO()):
                code = load_command(job.command).run(make_parser(job.command).parse_args(words))
            state = State.FINDINGS if code else State.DONE
        except RsRelposeError as error:
            message = str(error)
        except OSError as error:
            state, message = State.FAILED, str(error)
        finally:
            sys.argv = arguments
        files = {str(file.relative_to(out)): file.read_bytes()
                 for file in sorted(out.rglob('*')) if file.is_file()}
        if job.command == 'check' and printed.getvalue():
            files[RESULT_FILES['check']] = printed.getvalue().encode()
    return Outcome(state, message, time.perf_counter() - started, files)


def report(result: BatchOutcome, folder: Path) -> list[str]:
    """The outcome in some lines."""
    counts = ', '.join(f'{result.states[state]} {state.value}' for state in State
                       if result.states[state])
    lines = [f'{len(result.rows)} bags: {counts}'
             + (f'; {result.taken_over} of them from an earlier run' if result.taken_over else '')]
    told = [row for row in result.rows if row.state is not State.DONE]
    lines += [f'{row.state.value}: {row.bag}: {" ".join(row.message.split())}'
              for row in told[:_MOST_LINES]]
    if len(told) > _MOST_LINES:
        lines.append(f'... and {len(told) - _MOST_LINES} more in {RESULTS_FILE}')
    lines += [_combined_line(one) for one in result.combined.figures if len(one.bags) > 1]
    if result.combined.quat_cam_imu_xyzw is not None:
        numbers = ', '.join(f'{value:.6f}' for value in result.combined.quat_cam_imu_xyzw)
        lines.append(f'quat_cam_imu_xyzw: [{numbers}]')
    lines.append(f'in {folder}: {RESULTS_FILE}, {SUMMARY_FILE}, {PICTURE_FILE}, and a folder for '
                 'each bag')
    return lines


def _combined_line(one: Combined) -> str:
    """A figure of one camera from several bags."""
    reduced = one.chi2 / max(one.degrees_of_freedom, 1)
    return (f'{one.figure}: {one.mean:.6g} +- {one.sigma:.2g}, of {one.degrees_of_freedom + 1} '
            f'bags, chi2 {one.chi2:.3g} of {one.degrees_of_freedom} degrees of freedom'
            + (f' (sigma times {math.sqrt(reduced):.2g})' if reduced > 1.0 else '')
            + (f'; outliers: {", ".join(one.outliers)}' if one.outliers else ''))


def _request(args: argparse.Namespace) -> Request:
    """What is asked for; wrong options and parameters are told before any work."""
    command: str = args.batch_command
    options = [word for value in args.set for word in ('--set', value)]
    options += shlex.split(args.options)
    text = None
    if command == 'calibrate':
        if args.params is not None or args.set:
            raise InputError('calibrate takes no parameters: leave --params and --set out')
        text = ''
    elif args.params is not None or args.set:
        read_parameters(args.params, args.set)
        if args.params is not None:
            text = args.params.read_text(encoding='utf-8')
    for word in options:
        if word.split('=')[0] in ('--out', '--params', '--json'):
            raise InputError(f'--options must not have {word}: batch itself gives it')
    try:
        make_parser(command).parse_args([command, 'BAG', *options])
    except SystemExit as end:   # argparse has said why
        raise InputError(f'--options: {shlex.join(options)} are no options of {command}') from end
    return Request(command, tuple(args.bags), text, tuple(options), package_version())


def _words(job: Job, scratch: Path, out: Path) -> list[str]:
    words = [job.command, job.bag.path]
    if job.parameters:
        parameters = scratch / 'parameters.yaml'
        parameters.write_text(job.parameters, encoding='utf-8')
        words += ['--params', str(parameters)]
    words += ['--json'] if job.command == 'check' else ['--out', str(out)]
    return [*words, *job.options]
