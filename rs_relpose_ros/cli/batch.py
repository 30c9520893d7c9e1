"""``rs_relpose batch``: check, calibrate or replay over many bags, on a Dask cluster."""

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack, redirect_stderr, suppress
import csv
import glob
import hashlib
import io
import json
import logging
import math
import os
from pathlib import Path
import shlex
import shutil
import sys
from tempfile import TemporaryDirectory
import time
from typing import Any, NamedTuple

import cv2
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rs_relpose_ros.bags.files import SUFFIXES
from rs_relpose_ros.calibrate.result import as_mapping
from rs_relpose_ros.cli.main import FAILED as EXIT_FAILED
from rs_relpose_ros.cli.main import make_parser, package_version
from rs_relpose_ros.cli.options import adding, PARAMETERS, progress_bar
from rs_relpose_ros.cli.poses import replay_bag
from rs_relpose_ros.cli.recordings import calibrate_bag, inspect_bag
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.errors import InputError, library, MissingInputError, RsRelposeError
from rs_relpose_ros.output_files import (
    BLUE,
    ORANGE,
    RED,
    refuse_unwritable,
    save_picture,
    SUMMARY_FILE,
    written,
)

# Help of the command, with what it writes. [derived: interface]
HELP = (
    'Run check, calibrate or replay over many bags: on processes of this machine, one thread '
    'each, or on a running Dask cluster (pip install "dask[distributed]"). Writes results.csv '
    '(a row for each bag: state, metrics, errors, times), summary.json, overview.png and a '
    'folder with the results of each bag, as of a single run. A bag with a result is not '
    'processed again unless it, its parameters, the options or the version changed. For '
    'calibrate, all bags must be of one camera: the summary has weighted means, chi2 and '
    'outliers. Exit code 1: some bags were refused, failed, or are not as they should be.'
)

# The table of all bags. [derived: interface]
RESULTS_FILE = 'results.csv'
# The picture of all bags. [derived: interface]
PICTURE_FILE = 'overview.png'
# File of one bag that says how its work ended and on what that depends. [derived: interface]
_JOB_FILE = 'job.json'

# State of a bag whose work ended with exit code 0. [derived: interface]
DONE = 'done'
# It ended with exit code 1. [derived: interface]
FINDINGS = 'findings'
# It ended with bad input. [derived: interface]
REFUSED = 'refused'
# It ended with an error of the system, such as a full disk. [derived: interface]
FAILED = 'failed'
# It did not end: the workers died. [derived: interface]
LOST = 'lost'
# All states in the order of the summary. [derived: interface]
STATES = (DONE, FINDINGS, REFUSED, FAILED, LOST)
# States that another run would not change. [derived: system and workers may be better then]
_LASTING = (DONE, FINDINGS, REFUSED)

# Commands, and their results as in their JSON files. That of `check` is written here. [derived:
# interface]
_WORK: Mapping[str, Callable[[argparse.Namespace], Mapping[str, Any]]] = {
    'check': lambda args: inspect_bag(args).to_mapping(),
    'calibrate': lambda args: as_mapping(*calibrate_bag(args)),
    'replay': lambda args: replay_bag(args)[1].metrics,
}

# Bags that the report lists by name; the table has the others. [chosen: a screen of lines]
_MOST_LINES = 20
# A bag is given up when one more worker than this has died over it: a second death is no accident.
# [chosen: each more costs the time of a run and a worker]
_ALLOWED_DEATHS = 1
# Text of the error without Dask. [derived: text for people]
_ABSENT = "many bags need Dask, which is not installed: pip install 'dask[distributed]'"
# Longest time to find a scheduler and its workers [s]. A cluster takes seconds to start; a wrong
# address is reported after this time. [chosen: any value in 10..60 would do]
_TIMEOUT = 20.0

# A row of the table by column: state, metrics of a completed command. Files of results by name.
Row = dict[str, Any]
Files = dict[str, bytes]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        'batch_command', metavar='COMMAND', choices=tuple(_WORK), help='check, calibrate or replay'
    )
    parser.add_argument(
        'bags', metavar='BAGS', nargs='+', help='bags, or globs in quotes, as the workers see them'
    )
    parser.add_argument(
        '--out',
        metavar='DIR',
        type=Path,
        required=True,
        help='directory of the results; those of an earlier run are reused',
    )
    parser.add_argument(
        '--scheduler',
        metavar='ADDRESS',
        help='a running Dask cluster, such as tcp://host:8786; its workers need '
        'this package (the same version), and one thread each',
    )
    parser.add_argument(
        '--workers',
        metavar='N',
        type=int,
        help='processes of this machine (default: one for each processor)',
    )
    adding(PARAMETERS)(parser)
    parser.add_argument(
        '--options',
        metavar='TEXT',
        default='',
        help='further options of COMMAND, in quotes: --options="--no-pictures"',
    )


def run(args: argparse.Namespace) -> int:
    """Run the command over all bags; 1 unless all of them are done."""
    command = args.batch_command
    version = package_version()
    if args.workers is not None and args.workers < 1:
        raise InputError(f'--workers must be at least 1, got {args.workers}')
    options, parameters = _options(args)
    refuse_unwritable(args.out)
    with (
        open_cluster(args.scheduler, args.workers) as client,
        progress_bar(0, 'bag', command) as bar,
    ):
        theirs = client.submit(package_version, pure=False).result()
        if theirs != version:
            raise InputError(
                f'the workers have version {theirs} of this package, but here is '
                f'{version}: their results would not be comparable'
            )
        jobs = make_jobs(client, command, args.bags, parameters, options, version)
        bar.reset(len(jobs))
        rows, reused = run_jobs(client, jobs, args.out, run_job, bar.update)
    for line in write_summary(jobs[0], rows, reused, args.out):
        print(line)
    return 0 if all(row['state'] == DONE for row in rows) else EXIT_FAILED


def _options(args: argparse.Namespace) -> tuple[tuple[str, ...], str | None]:
    """Checked options of the command, and text of a parameter file, None for the bags' own."""
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
        text = None if args.params is None else args.params.read_text(encoding='utf-8')
    for word in options:
        if word.split('=')[0] in ('--out', '--params', '--json'):
            raise InputError(f'--options must not have {word}: batch itself sets it')
    try:
        make_parser(command).parse_args([command, 'BAG', *options])
    except SystemExit as end:  # argparse has printed the reason
        raise InputError(f'--options: {shlex.join(options)} are no options of {command}') from end
    return tuple(options), text


# -- Jobs: the bags, on the workers ---------------------------------------------------------------


class BagFiles(NamedTuple):
    """A bag in the file system of the workers."""

    path: str
    size: int  # of all its files [bytes]; -1 if there is none
    changed_ns: int  # last change of its files
    parameters: str  # text of the parameter file to use, that next to it; '' for none


class Job(NamedTuple):
    """A command of `rs_relpose`, one bag, and its options."""

    command: str
    bag: BagFiles
    name: str  # of the folder of its results
    options: tuple[str, ...]
    version: str  # of this package

    @property
    def fingerprint(self) -> str:
        """Hash of what the results depend on."""
        values = [self.command, self.bag, self.options, self.version]
        return hashlib.sha256(json.dumps(values).encode()).hexdigest()

    def row(
        self,
        state: str,
        message: str = '',
        seconds: float = 0.0,
        metrics: Mapping[str, Any] | None = None,
    ) -> Row:
        """What came of it: why it is not done, wall time, values by column."""
        return {
            'bag': self.bag.path,
            'name': self.name,
            'state': state,
            'message': ' '.join(message.split()),
            'seconds': round(seconds, 3),
            **(metrics or {}),
        }


def find_bags(paths: Sequence[str]) -> list[BagFiles]:
    """Bags at paths and globs, in the order of the paths; a path without a bag has size -1."""
    found: dict[str, BagFiles] = {}
    for pattern in paths:
        # A glob also matches parameter files and other folders.
        matching = sorted(
            path
            for path in map(Path, glob.glob(pattern))  # noqa: PTH207 any root
            if (path / 'metadata.yaml').is_file() or path.suffix in SUFFIXES
        )
        for path in matching or [Path(pattern)]:
            found.setdefault(str(path), _bag_at(path))
    return list(found.values())


def _bag_at(path: Path) -> BagFiles:
    is_folder = path.is_dir()
    files = path.iterdir() if is_folder else [path]
    states = [file.stat() for file in files if file.is_file()]
    size = sum(state.st_size for state in states) if states else -1
    changed_ns = max((state.st_mtime_ns for state in states), default=0)
    name = path.name if is_folder else path.stem
    beside = path.with_name(f'{name}.yaml')
    parameters = ''
    if beside.is_file():
        parameters = beside.read_text(encoding='utf-8', errors='replace')
    return BagFiles(str(path), size, changed_ns, parameters)


def unique_names(paths: Sequence[str]) -> list[str]:
    """Names for the results of bags: their own, with the folders below the one of all."""
    bags = [Path(path).absolute() for path in paths]
    folders = [bag.parent for bag in bags]
    common = os.path.commonpath(folders)
    long = [bag.relative_to(common) for bag in bags]
    short = [name.with_suffix('') if name.suffix in SUFFIXES else name for name in long]
    are_unique = len({*short}) == len(short)
    names = short if are_unique else long
    return ['__'.join(name.parts) for name in names]


def make_jobs(
    client: Any,
    command: str,
    paths: Sequence[str],
    parameters: str | None,
    options: tuple[str, ...],
    version: str,
) -> list[Job]:
    """Jobs for bags, or globs of them; `parameters`: None for the file next to each bag."""
    bags: list[BagFiles] = client.submit(find_bags, paths, pure=False).result()
    if all(bag.size < 0 for bag in bags):
        raise MissingInputError(f'the workers find no bag at {", ".join(paths)}')
    names = unique_names([bag.path for bag in bags])
    if parameters is not None:
        bags = [bag._replace(parameters=parameters) for bag in bags]
    return [
        Job(command, bag, name, options, version) for bag, name in zip(bags, names, strict=True)
    ]


def run_job(job: Job) -> tuple[Row, Files]:
    """Do on a worker the work of `rs_relpose COMMAND`."""
    cv2.setNumThreads(1)
    started = time.perf_counter()
    state = REFUSED
    message = ''
    metrics = {}
    with TemporaryDirectory() as scratch:
        out = Path(scratch, 'out')
        words = [job.command, job.bag.path]
        files = {}
        if job.bag.parameters:
            parameters = Path(scratch, 'parameters.yaml')
            parameters.write_text(job.bag.parameters, encoding='utf-8')
            words += ['--params', str(parameters)]
        if job.command != 'check':
            words += ['--out', str(out)]
        words += job.options
        arguments = sys.argv
        sys.argv = ['rs_relpose', *words]  # for summary.json
        try:
            with redirect_stderr(io.StringIO()):
                results = _WORK[job.command](make_parser(job.command).parse_args(words))
            metrics = metrics_of(job.command, results)
            message = _problems(job.command, results)
            state = FINDINGS if message else DONE
            if job.command == 'check':
                text = json.dumps(results, indent=2, allow_nan=False) + '\n'
                files['check.json'] = text.encode()
        except RsRelposeError as error:
            message = str(error)
        except OSError as error:
            state = FAILED
            message = str(error)
        finally:
            sys.argv = arguments
        written_files = [file for file in sorted(out.rglob('*')) if file.is_file()]
        files |= {str(file.relative_to(out)): file.read_bytes() for file in written_files}
    return job.row(state, message, time.perf_counter() - started, metrics), files


# -- Columns of the table, and messages, from the results of one bag ------------------------------

# Parameters of a calibration that are one number, with value, sigma, observable and remark.
# [derived: calibration.json]
_CALIBRATED = (
    'readout_time_s',
    'time_offset_s',
    'focal_px',
    'gyro_bias_rad_per_s.0',
    'gyro_bias_rad_per_s.1',
    'gyro_bias_rad_per_s.2',
)
# The parameter that is a rotation vector. [derived: calibration.json]
_ROTATION = 'rotation_from_axis_map_rad'

# Columns of each command, with their places in its results. [derived: interface]
_COLUMNS: Mapping[str, Mapping[str, str]] = {
    'calibrate': {
        'shutter': 'shutter',
        **{
            name.replace('.', '_') + suffix: f'{name}.{part}'
            for name in _CALIBRATED
            for suffix, part in (('', 'value'), ('_sigma', 'sigma'), ('_observable', 'observable'))
        },
        **{f'quat_{axis}': f'quat_cam_imu_xyzw.{i}' for i, axis in enumerate('xyzw')},
        **{
            f'rotation_{axis}_sigma_rad': f'rotation_sigma_rad.{i}' for i, axis in enumerate('xyz')
        },
        'rotation_observable': f'{_ROTATION}.observable',
        'frames': 'frames',
        'pixel_sigma': 'pixel_sigma',
    },
    'replay': {
        'pairs': 'pairs.total',
        'answered': 'pairs.answered',
        'health': 'health.state',
        **{
            name: f'errors_against_truth.{name}'
            for name in (
                'rotation_median_deg',
                'rotation_p90_deg',
                'translation_median_deg',
                'translation_p90_deg',
            )
        },
        'pairs_with_truth': 'errors_against_truth.pairs',
        **{
            f'{name}_median': f'medians.{name}'
            for name in ('inliers', 'residual_rms_px', 'rotation_difference_to_gyro_deg')
        },
        'frames': 'frames.in_bag',
        'frames_processed': 'frames.processed',
        'bag_s': 'timing.bag_s',
        'processing_per_frame_ms': 'timing.processing_per_frame_ms',
    },
}


def metrics_of(command: str, results: Mapping[str, Any]) -> dict[str, Any]:
    """The values by column of one bag; None if a value is unknown."""
    if command == 'check':
        verdicts = Counter(finding['verdict'] for finding in results['findings'])
        return {verdict: verdicts[verdict] for verdict in ('ok', 'unknown', 'warning', 'failure')}
    return {column: _at(results, place) for column, place in _COLUMNS[command].items()}


def _at(results: Any, place: str) -> Any:
    """The value at a place such as 'health.state' or 'gyro_bias.0.sigma'; None if it is absent."""
    for key in place.split('.'):
        if results is None:
            return None
        results = results[int(key)] if isinstance(results, Sequence) else results.get(key)
    return results


def _problems(command: str, results: Mapping[str, Any]) -> str:
    """What a completed command found, in words; empty if its exit code is 0."""
    if command == 'check':
        problems = [
            f'{finding["name"]}: {finding["text"]}'
            for finding in results['findings']
            if finding['verdict'] == 'failure'
        ]
    elif command == 'calibrate':
        parts = {name: _at(results, name) for name in _CALIBRATED}
        parts['rotation'] = results[_ROTATION]
        problems = [
            f'{name} is not observable: {part["remark"]}'
            for name, part in parts.items()
            if part is not None and not part['determined']
        ]
    else:
        problems = [
            finding['sentence']
            for finding in results['health']['findings']
            if finding['state'] == 'wrong'
        ]
        if not results['pairs']['answered']:
            by_status = results['pairs']['by_status']
            counts = [f'{count} {status}' for status, count in by_status.items() if count]
            problems.append(f'no pair has a pose: {", ".join(counts) or "there was none"}')
    return '; '.join(problems)


# -- The cluster ----------------------------------------------------------------------------------


@contextmanager
def open_cluster(scheduler: str | None, workers: int | None) -> Iterator[Any]:
    """A client of a running scheduler, or of `workers` local processes of one thread each."""
    dask = library('dask', _ABSENT)
    distributed = library('distributed', _ABSENT)
    # It logs starts and ends of processes; errors of the work are in the rows.
    logging.getLogger('distributed').setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        if scheduler is None:
            stack.enter_context(
                dask.config.set({'distributed.scheduler.allowed-failures': _ALLOWED_DEATHS})
            )
            # Loopback only; no dashboard, whose port others may use.
            scheduler = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=workers or len(os.sched_getaffinity(0)),
                    threads_per_worker=1,
                    processes=True,
                    host='127.0.0.1',
                    dashboard_address=None,
                    scheduler_kwargs={'dashboard_address': '127.0.0.1:0'},
                    silence_logs=logging.CRITICAL,
                )
            )
        elif workers is not None:
            raise InputError('--workers is for local processes: a running cluster has its own')
        try:
            client = stack.enter_context(distributed.Client(scheduler, timeout=_TIMEOUT))
        except (OSError, ValueError) as error:
            raise InputError(f'no Dask scheduler answers at {scheduler}: {error}') from error
        try:
            client.wait_for_workers(1, timeout=_TIMEOUT)
        except TimeoutError as error:
            raise MissingInputError(f'the cluster at {scheduler} has no workers') from error
        yield client


def run_jobs(
    client: Any,
    jobs: Sequence[Job],
    folder: Path,
    work: Callable[[Job], tuple[Row, Files]],
    on_bag: Callable[[], object] = lambda: None,
) -> tuple[list[Row], int]:
    """Rows of the jobs, written with their files into a folder; how many an earlier run had.

    `work` runs on the workers. A worker that dies is replaced, and its job repeated.
    """
    distributed = library('distributed', _ABSENT)
    folder.mkdir(parents=True, exist_ok=True)
    rows = {job: row for job in jobs if (row := earlier(job, folder)) is not None}
    reused = len(rows)
    for _ in rows:
        on_bag()
    waiting = [job for job in reversed(jobs) if job not in rows]
    running: dict[Any, Job] = {}
    finished = distributed.as_completed()

    def fill() -> None:
        # A job that is queued at a worker would die with the one that is running there.
        while waiting and len(running) < max(1, sum(client.nthreads().values())):
            future = client.submit(work, waiting[-1], pure=False)
            running[future] = waiting.pop()
            finished.add(future)

    fill()
    for future in finished:
        job = running.pop(future)
        files = Files()
        try:
            rows[job], files = future.result()
        except distributed.scheduler.KilledWorker:
            rows[job] = job.row(
                LOST,
                f'each of {_ALLOWED_DEATHS + 1} workers died over this bag: '
                'out of memory, or a fault of a library',
            )
        except Exception as error:  # noqa: BLE001 any error of a worker is the row of its bag
            rows[job] = job.row(FAILED, f'{type(error).__name__}: {error}')
        store(job, rows[job], files, folder)
        # After each: the table can be read while the other bags are processed.
        write_table([rows[job] for job in jobs if job in rows], folder)
        on_bag()
        fill()
    write_table([rows[job] for job in jobs], folder)
    return [rows[job] for job in jobs], reused


# -- The folder of the results --------------------------------------------------------------------


def earlier(job: Job, folder: Path) -> Row | None:
    """The row of an earlier run of the same job, if another run would not change it."""
    own = folder / job.name
    with suppress(OSError, ValueError, KeyError, TypeError):
        entry = json.loads((own / _JOB_FILE).read_text(encoding='utf-8'))
        row = dict(entry['row'])
        is_same = entry['fingerprint'] == job.fingerprint
        has_files = all((own / name).is_file() for name in entry['files'])
        if is_same and has_files and row['state'] in _LASTING:
            return row
    return None


def store(job: Job, row: Row, files: Files, folder: Path) -> None:
    """Replace the results of a bag; the entry is written last, so that it implies all."""
    own = folder / job.name
    if (own / _JOB_FILE).is_file():
        shutil.rmtree(own)
    own.mkdir(exist_ok=True)
    entry = {'fingerprint': job.fingerprint, 'row': row, 'files': sorted(files)}
    text = json.dumps(entry, indent=1) + '\n'
    for name, data in (*files.items(), (_JOB_FILE, text.encode())):
        path = own / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with written(path, 'wb') as file:
            file.write(data)


def write_table(rows: Sequence[Row], folder: Path) -> None:
    """One row for each bag; metrics that a bag does not have are empty."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with written(folder / RESULTS_FILE) as file:
        table = csv.DictWriter(file, columns, lineterminator='\n')
        table.writeheader()
        table.writerows(rows)


def write_summary(job: Job, rows: Sequence[Row], reused: int, folder: Path) -> list[str]:
    """Write summary.json and the picture of a run with jobs such as this; lines to print."""
    calibrated = [
        row for row in rows if job.command == 'calibrate' and row['state'] in (DONE, FINDINGS)
    ]
    combined = combine(calibrated)
    counts = Counter(row['state'] for row in rows)
    states = {state: counts[state] for state in STATES}
    summary = {
        'command': job.command,
        'options': job.options,
        'version': job.version,
        'bags': len(rows),
        'states': states,
        'combined': combined,
    }
    with written(folder / SUMMARY_FILE) as file:
        file.write(json.dumps(summary, indent=1) + '\n')
    draw(job.command, rows, combined['figures'], folder / PICTURE_FILE)
    found = ', '.join(f'{count} {state}' for state, count in states.items() if count)
    again = f'; {reused} of them from an earlier run' if reused else ''
    lines = [f'{len(rows)} bags: {found}{again}']
    unfinished = [row for row in rows if row['state'] != DONE]
    lines += ['{state}: {bag}: {message}'.format(**row) for row in unfinished[:_MOST_LINES]]
    if len(unfinished) > _MOST_LINES:
        lines.append(f'... and {len(unfinished) - _MOST_LINES} more in {RESULTS_FILE}')
    lines += [_line_of_mean(one) for one in combined['figures'] if one['degrees_of_freedom']]
    if combined['quat_cam_imu_xyzw'] is not None:
        numbers = ', '.join(f'{value:.6f}' for value in combined['quat_cam_imu_xyzw'])
        lines.append(f'quat_cam_imu_xyzw: [{numbers}]')
    lines.append(
        f'in {folder}: {RESULTS_FILE}, {SUMMARY_FILE}, {PICTURE_FILE}, and a folder for each bag'
    )
    return lines


def _line_of_mean(one: Mapping[str, Any]) -> str:
    """A result of `weighted_mean` of several bags, as a line to print."""
    degrees = one['degrees_of_freedom']
    scale = math.sqrt(max(one['chi2'] / degrees, 1.0))
    scaled = f' (sigma times {scale:.2g})' if scale > 1.0 else ''
    outliers = f'; outliers: {", ".join(one["outliers"])}' if one['outliers'] else ''
    return (
        f'{one["figure"]}: {one["mean"]:.6g} +- {one["sigma"]:.2g}, of {degrees + 1} '
        f'bags, chi2 {one["chi2"]:.3g} of {degrees} degrees of freedom{scaled}{outliers}'
    )


# -- Calibrations of one camera from many bags: weighted means and outliers -----------------------

# Distance from the mean of the others beyond which a bag is an outlier [sigma]. [chosen: by chance
# one bag of 370 is beyond 3]
_OUTLIER = 3.0


def weighted_mean(
    metric: str, bags: Sequence[str], values: ArrayLike, sigmas: ArrayLike
) -> dict[str, Any]:
    """Combine independent measurements (N,) with their sigmas (N,), as in summary.json.

    The worst one is an outlier, as long as it is more than 3 sigma from the weighted mean of the
    others, its own sigma included, and two others remain. `sigma`: by the measurements' own ones,
    times sqrt(chi2/dof) if that is above 1; `chi2`: without the outliers.
    """
    x = np.asarray(values, dtype=np.float64)
    s = np.asarray(sigmas, dtype=np.float64)
    kept = list(range(len(x)))

    def mean_of(some: list[int]) -> tuple[float, float]:
        weights = s[some] ** -2.0
        whole = weights.sum()
        return float((weights * x[some]).sum() / whole), float(whole**-0.5)

    def distance(one: int) -> float:
        mean, sigma = mean_of([i for i in kept if i != one])
        return float(abs(x[one] - mean) / np.hypot(s[one], sigma))

    while len(kept) > 2:
        worst = max(kept, key=distance)
        if distance(worst) <= _OUTLIER:
            break
        kept.remove(worst)
    mean, sigma = mean_of(kept)
    residuals = (x[kept] - mean) / s[kept]
    chi2 = float((residuals**2).sum())
    degrees = len(kept) - 1
    if degrees:
        sigma *= math.sqrt(max(1.0, chi2 / degrees))
    return {
        'figure': metric,
        'mean': mean,
        'sigma': sigma,
        'chi2': chi2,
        'degrees_of_freedom': degrees,
        'bags': list(bags),
        'outliers': [bag for i, bag in enumerate(bags) if i not in kept],
    }


def combine(rows: Sequence[Row]) -> dict[str, Any]:
    """Combined calibration, as in summary.json: each metric from the rows that observe it.

    The metrics ``rotation_x_rad``, y and z are rotation vectors from the combined rotation
    ``v_cam = R(q) v_imu``, about the camera's axes.
    """
    combined = []
    quaternion = None
    for metric in (*_CALIBRATED, 'rotation'):
        column = metric.replace('.', '_')
        good = [row for row in rows if row[f'{column}_observable']]
        names = [row['name'] for row in good]
        if good and metric != 'rotation':
            values = [row[column] for row in good]
            sigmas = [row[f'{column}_sigma'] for row in good]
            combined.append(weighted_mean(metric, names, values, sigmas))
        elif good:
            quaternions = [[row[f'quat_{axis}'] for axis in 'xyzw'] for row in good]
            rotations = Rotation.from_quat(quaternions)
            near = rotations.mean()
            vectors = (rotations * near.inv()).as_rotvec()
            of_axes = [
                weighted_mean(
                    f'rotation_{axis}_rad',
                    names,
                    vectors[:, i],
                    [row[f'rotation_{axis}_sigma_rad'] for row in good],
                )
                for i, axis in enumerate('xyz')
            ]
            mean = Rotation.from_rotvec([one['mean'] for one in of_axes]) * near
            quaternion = mean.as_quat(canonical=True).tolist()
            combined += [{**one, 'mean': 0.0} for one in of_axes]
    return {'figures': combined, 'quat_cam_imu_xyzw': quaternion}


# The two columns of each command that are drawn, their factors and labels. [chosen: what a person
# looks for first]
_DRAWN = {
    'check': (('failure', 1.0, 'failures'), ('warning', 1.0, 'warnings')),
    'calibrate': (
        ('readout_time_s', 1e3, 'readout time [ms], 1 sigma'),
        ('time_offset_s', 1e3, 'time offset of row 0 [ms], 1 sigma'),
    ),
    'replay': (
        ('answered', 1.0, 'pairs with a pose'),
        ('rotation_median_deg', 1.0, 'median error of the rotation [deg]'),
    ),
}


def draw(
    command: str, rows: Sequence[Row], combined: Sequence[Mapping[str, Any]], path: Path
) -> None:
    """Draw rows in their order; red: outliers of the mean, orange: unobservable values."""
    picture = Figure(figsize=(10.0, 1.2 + 0.3 * len(rows)), dpi=110, layout='constrained')
    both = picture.subplots(1, 2, sharey=True)
    means = {one['figure']: one for one in combined}
    for axes, (column, factor, label) in zip(both, _DRAWN[command], strict=True):
        outliers: Sequence[str] = ()
        if column in means:
            mean = means[column]
            outliers = mean['outliers']
            middle = factor * mean['mean']
            half = factor * mean['sigma']
            axes.axvline(middle, color=BLUE, linewidth=1.0)
            axes.axvspan(middle - half, middle + half, color=BLUE, alpha=0.2)
        for y, row in enumerate(rows):
            if row.get(column) is None:
                continue
            colour = RED if row['name'] in outliers else BLUE
            if not row.get(f'{column}_observable', True):
                colour = ORANGE
            value = factor * row[column]
            sigma = factor * row.get(f'{column}_sigma', 0.0)
            axes.errorbar(value, y, fmt='o', color=colour, xerr=sigma)
        axes.set_xlabel(label)
        axes.grid(axis='x', color='0.9')
    labels = []
    for row in rows:
        has_results = row['state'] in (DONE, FINDINGS)
        state = '' if has_results else f' ({row["state"]})'
        labels.append(row['name'][-40:] + state)
    first, _ = both
    first.set_yticks(range(len(rows)), labels)
    first.set_ylim(len(rows) - 0.4, -0.6)
    save_picture(picture, path)
