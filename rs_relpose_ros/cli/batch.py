"""``rs_relpose batch``: check, calibrate or replay over many bags, on Dask."""

import argparse
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr
import io
import json
import math
from pathlib import Path
import shlex
import sys
from tempfile import TemporaryDirectory
import time
from typing import Any

import cv2

from rs_relpose_ros.calibrate.result import as_mapping
from rs_relpose_ros.cli.main import FAILED, make_parser
from rs_relpose_ros.cli.options import add_parameter_arguments, package_version, progress_bar
from rs_relpose_ros.cli.poses import replay_bag
from rs_relpose_ros.cli.recordings import calibrate_bag, inspect_bag
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.errors import InputError, RsRelposeError
from rs_relpose_ros.offline import batch as runs
from rs_relpose_ros.offline.batch import Job, open_cluster, Outcome, Request, run_on_worker, State
from rs_relpose_ros.output_files import refuse_unwritable, SUMMARY_FILE

HELP = ('Run check, calibrate or replay over many bags: on processes of this machine, one thread '
        'each, or on a running Dask cluster (pip install "dask[distributed]"). Writes results.csv '
        '(a row for each bag: state, metrics, errors, times), summary.json, overview.png and a '
        'folder with the results of each bag, as of a single run. A bag with a result is not '
        'processed again unless it, its parameters, the options or the version changed. For '
        'calibrate, all bags must be of one camera: the summary has weighted means, chi2 and '
        'outliers. Exit code 1: some bags were refused, failed, or are not as they should be.')

_MOST_LINES = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument('batch_command', metavar='COMMAND', choices=tuple(runs.RESULT_FILES),
                        help='check, calibrate or replay')
    parser.add_argument('bags', metavar='BAGS', nargs='+',
                        help='bags, or globs in quotes, as the workers see them')
    parser.add_argument('--out', metavar='DIR', type=Path, required=True,
                        help='directory of the results; those of an earlier run are reused')
    parser.add_argument('--scheduler', metavar='ADDRESS',
                        help='a running Dask cluster, such as tcp://host:8786; its workers need '
                        'this package (the same version), and one thread each')
    parser.add_argument('--workers', metavar='N', type=int,
                        help='processes of this machine (default: one for each processor)')
    add_parameter_arguments(parser)
    parser.add_argument('--options', metavar='TEXT', default='',
                        help='further options of COMMAND, in quotes: --options="--no-pictures"')


def run(args: argparse.Namespace) -> int:
    """Run the command over all bags; 1 unless all of them are done."""
    if args.workers is not None and args.workers < 1:
        raise InputError(f'--workers must be at least 1, got {args.workers}')
    request = _request(args)
    refuse_unwritable(args.out)
    with open_cluster(args.scheduler, args.workers) as client, \
            progress_bar(0, 'bag', args.batch_command) as bar:
        version = run_on_worker(client, package_version)
        if version != request.version:
            raise InputError(f'the workers have version {version} of this package, but here is '
                             f'{request.version}: their results would not be comparable')
        result = runs.run_batch(client, request, args.out, run_job,
                                on_start=bar.reset, on_bag=bar.update)
    for line in report(result, args.out):
        print(line)
    return 0 if set(result.states) == {State.DONE} else FAILED


# Command -> its results as in `RESULT_FILES`.
_WORK: Mapping[str, Callable[[argparse.Namespace], Mapping[str, Any]]] = {
    'check': lambda args: inspect_bag(args).to_mapping(),
    'calibrate': lambda args: as_mapping(*calibrate_bag(args)),
    'replay': lambda args: replay_bag(args)[1].metrics}


def run_job(job: Job) -> Outcome:
    """Do on a worker the work of `rs_relpose COMMAND`; the outcome has its files."""
    cv2.setNumThreads(1)
    started = time.perf_counter()
    state, message, metrics = State.REFUSED, '', {}
    with TemporaryDirectory() as scratch:
        out = Path(scratch, 'out')
        words, files = [job.command, job.bag.path], {}
        if job.parameters:
            parameters = Path(scratch, 'parameters.yaml')
            parameters.write_text(job.parameters, encoding='utf-8')
            words += ['--params', str(parameters)]
        words += [*(['--out', str(out)] if job.command != 'check' else []), *job.options]
        arguments, sys.argv = sys.argv, ['rs_relpose', *words]   # for summary.json
        try:
            with redirect_stderr(io.StringIO()):
                results = _WORK[job.command](make_parser(job.command).parse_args(words))
            metrics = runs.metrics_of(job.command, results)
            message = runs.message_of(job.command, results)
            state = State.FINDINGS if message else State.DONE
            if job.command == 'check':
                text = json.dumps(results, indent=2, allow_nan=False) + '\n'
                files[runs.RESULT_FILES['check']] = text.encode()
        except RsRelposeError as error:
            message = str(error)
        except OSError as error:
            state, message = State.FAILED, str(error)
        finally:
            sys.argv = arguments
        files |= {str(file.relative_to(out)): file.read_bytes()
                  for file in sorted(out.rglob('*')) if file.is_file()}
    return Outcome(job, state, message, time.perf_counter() - started, metrics, files)


def report(result: runs.BatchOutcome, folder: Path) -> list[str]:
    """Lines that summarise a run."""
    counts = ', '.join(f'{result.states[state]} {state.value}' for state in State
                       if result.states[state])
    lines = [f'{len(result.rows)} bags: {counts}'
             + (f'; {result.reused} of them from an earlier run' if result.reused else '')]
    unfinished = [row for row in result.rows if row.state is not State.DONE]
    lines += [f'{row.state.value}: {row.job.bag.path}: {" ".join(row.message.split())}'
              for row in unfinished[:_MOST_LINES]]
    if len(unfinished) > _MOST_LINES:
        lines.append(f'... and {len(unfinished) - _MOST_LINES} more in {runs.RESULTS_FILE}')
    for one in result.combined.metrics:
        if degrees := len(one.bags) > 1 and one.degrees_of_freedom:
            scale = math.sqrt(max(one.chi2 / degrees, 1.0))
            lines.append(
                f'{one.metric}: {one.mean:.6g} +- {one.sigma:.2g}, of {degrees + 1} bags, chi2 '
                f'{one.chi2:.3g} of {degrees} degrees of freedom'
                + (f' (sigma times {scale:.2g})' if scale > 1.0 else '')
                + (f'; outliers: {", ".join(one.outliers)}' if one.outliers else ''))
    if result.combined.quat_cam_imu_xyzw is not None:
        numbers = ', '.join(f'{value:.6f}' for value in result.combined.quat_cam_imu_xyzw)
        lines.append(f'quat_cam_imu_xyzw: [{numbers}]')
    lines.append(f'in {folder}: {runs.RESULTS_FILE}, {SUMMARY_FILE}, '
                 f'{runs.PICTURE_FILE}, and a folder for each bag')
    return lines


def _request(args: argparse.Namespace) -> Request:
    """The request; wrong options and parameters are refused before any work."""
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
            raise InputError(f'--options must not have {word}: batch itself sets it')
    try:
        make_parser(command).parse_args([command, 'BAG', *options])
    except SystemExit as end:   # argparse has printed the reason
        raise InputError(f'--options: {shlex.join(options)} are no options of {command}') from end
    return Request(command, tuple(args.bags), text, tuple(options), package_version())
