"""A command over many bags on a Dask cluster: a folder for each, one table, picture, calibration.

Bags with a result of an earlier run are skipped.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack
import csv
from dataclasses import asdict, dataclass, field, replace
from enum import Enum
import hashlib
import json
import logging
import os
from pathlib import Path
import shutil
from typing import Any

from matplotlib.figure import Figure
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rs_relpose_ros.errors import InputError, library, MissingInputError
from rs_relpose_ros.output_files import BLUE, ORANGE, RED, save_picture, SUMMARY_FILE, written

RESULT_FILES = {'check': 'check.json', 'calibrate': 'calibration.json', 'replay': SUMMARY_FILE}
RESULTS_FILE = 'results.csv'
PICTURE_FILE = 'overview.png'
_JOB_FILE = 'job.json'

_BAG_SUFFIXES = ('.mcap', '.db3', '.bag')

# Results of one bag as in its JSON file, and the values by column that the table has of them.
Results = Mapping[str, Any]
Metrics = Mapping[str, Any]


class State(Enum):
    """How the work on a bag ended."""

    DONE = 'done'
    FINDINGS = 'findings'   # completed with a failure or an unobservable parameter: exit code 1
    REFUSED = 'refused'     # bad input, with the reason: exit code 2
    FAILED = 'failed'       # an unexpected error
    LOST = 'lost'           # its worker died repeatedly


# States that another run would not change.
_LASTING = frozenset({State.DONE, State.FINDINGS, State.REFUSED})


@dataclass(frozen=True, slots=True)
class Bag:
    """A bag in the file system of the workers."""

    path: str
    size: int   # of all its files [bytes]; -1 if there is none
    changed_ns: int   # last change of its files
    parameters: str   # text of the parameter file next to it, '' without one


@dataclass(frozen=True, slots=True)
class Job:
    """A command of `rs_relpose`, one bag, and its options."""

    command: str
    bag: Bag
    name: str   # of the folder of its results
    parameters: str   # text of the parameter file that is used, '' for none
    options: tuple[str, ...]
    version: str   # of this package

    @property
    def fingerprint(self) -> str:
        """Hash of bag, parameters, options and version."""
        values = [self.command, self.bag.path, self.bag.size, self.bag.changed_ns,
                  self.parameters, *self.options, self.version]
        return hashlib.sha256(json.dumps(values).encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a job: a row of the table."""

    job: Job
    state: State
    message: str = ''   # why it is not done
    seconds: float = 0.0   # wall time
    metrics: Metrics = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)   # results; empty once stored


def find_bags(paths: list[str]) -> list[Bag]:
    """Bags at paths and globs, in the order of the paths; a path without a bag has size -1."""
    found: dict[str, Bag] = {}
    for pattern in paths:
        path = Path(pattern)
        matching = [path]
        if any(sign in pattern for sign in '*?['):
            # A glob also matches parameter files and other folders.
            relative = str(path.relative_to(path.anchor)) if path.anchor else pattern
            matching = sorted(
                match for match in Path(path.anchor or '.').glob(relative)
                if (match / 'metadata.yaml').is_file() or match.suffix in _BAG_SUFFIXES)
        for match in matching or [path]:
            found.setdefault(str(match), _bag(match))
    return list(found.values())


def _bag(path: Path) -> Bag:
    files = [file for file in (path.iterdir() if path.is_dir() else [path]) if file.is_file()]
    if not files:
        return Bag(str(path), -1, 0, '')
    states = [file.stat() for file in files]
    parameters = path.with_name(f'{path.name if path.is_dir() else path.stem}.yaml')
    return Bag(str(path), sum(state.st_size for state in states),
               max(state.st_mtime_ns for state in states),
               parameters.read_text(encoding='utf-8', errors='replace')
               if parameters.is_file() else '')


def unique_names(paths: list[str]) -> list[str]:
    """Names for the results of bags: their own, with as many folders as make them unique."""
    parts = []
    for path in map(Path, paths):
        stem = path.with_suffix('') if path.suffix in _BAG_SUFFIXES else path
        parts.append([part for part in stem.parts if part not in ('/', '.', '..')])
    names = []
    for own in parts:
        depth = next((depth for depth in range(1, len(own))
                      if sum(other[-depth:] == own[-depth:] for other in parts) == 1), len(own))
        names.append('__'.join(own[-depth:]))
    if len(set(names)) < len(names):   # the same path in two spellings
        names = [f'{name}_{number}' for number, name in enumerate(names)]
    return names


class Store:
    """The folder of the results; those of an earlier run are used again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def done(self, job: Job) -> Outcome | None:
        """The outcome of an earlier run of the same job, if it has a lasting one."""
        folder = self.folder / job.name
        try:
            entry = json.loads((folder / _JOB_FILE).read_text(encoding='utf-8'))
            outcome = Outcome(job, State(entry['state']), entry['message'], entry['seconds'],
                              entry['metrics'])
            if (entry['fingerprint'] == job.fingerprint and outcome.state in _LASTING
                    and all((folder / name).is_file() for name in entry['files'])):
                return outcome
        except (OSError, ValueError, KeyError, TypeError):
            pass
        return None

    def add(self, outcome: Outcome) -> None:
        """Replace the results of a bag; the entry is written last, so that it implies all."""
        folder = self.folder / outcome.job.name
        if (folder / _JOB_FILE).is_file():
            shutil.rmtree(folder)
        folder.mkdir(exist_ok=True)
        for name, data in outcome.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            with written(folder / name, 'wb') as file:
                file.write(data)
        entry = {'bag': outcome.job.bag.path, 'fingerprint': outcome.job.fingerprint,
                 'state': outcome.state.value, 'message': outcome.message,
                 'seconds': outcome.seconds, 'metrics': outcome.metrics,
                 'files': sorted(outcome.files)}
        with written(folder / _JOB_FILE) as file:
            file.write(json.dumps(entry, indent=1) + '\n')

    def write_table(self, outcomes: Sequence[Outcome]) -> None:
        """One row for each bag; metrics that a bag does not have are empty."""
        columns = list(dict.fromkeys(name for outcome in outcomes for name in outcome.metrics))
        with written(self.folder / RESULTS_FILE) as file:
            writer = csv.writer(file, lineterminator='\n')
            writer.writerow(['bag', 'name', 'state', 'message', 'seconds', *columns])
            for row in outcomes:
                writer.writerow([row.job.bag.path, row.job.name, row.state.value,
                                 ' '.join(row.message.split()), f'{row.seconds:.3f}',
                                 *map(row.metrics.get, columns)])


# -- Columns of the table, and messages, from the results of one bag ------------------------------

_VERDICTS = ('ok', 'unknown', 'warning', 'failure')

# Parameters of a calibration that are one number: value, sigma, observable, remark.
_CALIBRATED = ('readout_time_s', 'time_offset_s', 'focal_px', 'gyro_bias_rad_per_s.0',
               'gyro_bias_rad_per_s.1', 'gyro_bias_rad_per_s.2')
_ROTATION = 'rotation_from_axis_map_rad'

# Column -> place in the results of `calibrate` and `replay`.
_CALIBRATE_COLUMNS = {
    'shutter': 'shutter',
    **{name.replace('.', '_') + suffix: f'{name}.{part}' for name in _CALIBRATED
       for suffix, part in (('', 'value'), ('_sigma', 'sigma'), ('_observable', 'observable'))},
    **{f'quat_{axis}': f'quat_cam_imu_xyzw.{i}' for i, axis in enumerate('xyzw')},
    **{f'rotation_{axis}_sigma_rad': f'rotation_sigma_rad.{i}' for i, axis in enumerate('xyz')},
    'rotation_observable': f'{_ROTATION}.observable',
    'frames': 'frames', 'pixel_sigma': 'pixel_sigma'}
_REPLAY_COLUMNS = {
    'pairs': 'pairs.total', 'answered': 'pairs.answered', 'health': 'health.state',
    **{name: f'errors_against_truth.{name}' for name in (
        'rotation_median_deg', 'rotation_p90_deg', 'translation_median_deg',
        'translation_p90_deg')},
    'pairs_with_truth': 'errors_against_truth.pairs',
    **{f'{name}_median': f'medians.{name}' for name in (
        'inliers', 'residual_rms_px', 'rotation_difference_to_gyro_deg')},
    'frames': 'frames.in_bag', 'frames_processed': 'frames.processed',
    'bag_s': 'timing.bag_s', 'processing_per_frame_ms': 'timing.processing_per_frame_ms'}


def metrics_of(command: str, results: Results) -> dict[str, Any]:
    """The values by column of one bag; None if a value is unknown."""
    if command == 'check':
        verdicts = [finding['verdict'] for finding in results['findings']]
        return {verdict: verdicts.count(verdict) for verdict in _VERDICTS}
    columns = _CALIBRATE_COLUMNS if command == 'calibrate' else _REPLAY_COLUMNS
    return {column: _at(results, place) for column, place in columns.items()}


def message_of(command: str, results: Results) -> str:
    """The problems that a completed command found; empty if its exit code is 0."""
    if command == 'check':
        problems = [f'{finding["name"]}: {finding["text"]}' for finding in results['findings']
                    if finding['verdict'] == 'failure']
    elif command == 'calibrate':
        parts = {**{name: _at(results, name) for name in _CALIBRATED},
                 'rotation': results[_ROTATION]}
        problems = [f'{name} is not observable: {part["remark"]}' for name, part in parts.items()
                    if part is not None and not part['determined']]
    else:
        problems = [finding['sentence'] for finding in results['health']['findings']
                    if finding['state'] == 'wrong']
        if not results['pairs']['answered']:
            counts = [f'{count} {status}' for status, count in
                      results['pairs']['by_status'].items() if count]
            problems.append(f'no pair has a pose: {", ".join(counts) or "there was none"}')
    return '; '.join(problems)


def _at(results: Any, place: str) -> Any:
    """The value at a place such as 'health.state' or 'gyro_bias.0.sigma'; None if it is absent."""
    for key in place.split('.'):
        if results is None:
            return None
        results = results[int(key)] if isinstance(results, Sequence) else results.get(key)
    return results


# -- Calibrations of one camera from many bags: weighted means and outliers -----------------------

# Distance from the mean of the others beyond which a bag is an outlier [sigma].
_OUTLIER = 3.0


@dataclass(frozen=True, slots=True)
class Combined:
    """Weighted mean of independent measurements without the outliers."""

    metric: str
    mean: float
    sigma: float   # by the measurements' own sigmas, times sqrt(chi2/dof) if that is above 1
    chi2: float   # without the outliers
    degrees_of_freedom: int
    bags: tuple[str, ...]   # all with this metric
    outliers: tuple[str, ...]


def weighted_mean(metric: str, bags: Sequence[str], values: ArrayLike,
                  sigmas: ArrayLike) -> Combined:
    """Combine measurements (N,) with their sigmas (N,).

    The worst one is an outlier, as long as it is more than 3 sigma from the weighted mean of the
    others, its own sigma included, and two others remain.
    """
    x, s = np.asarray(values, dtype=np.float64), np.asarray(sigmas, dtype=np.float64)
    kept = list(range(len(x)))
    while len(kept) > 2:
        distances = []
        for one in kept:
            others = [i for i in kept if i != one]
            mean, sigma = _mean(x[others], s[others])
            distances.append(float(abs(x[one] - mean) / np.hypot(s[one], sigma)))
        worst = int(np.argmax(distances))
        if distances[worst] <= _OUTLIER:
            break
        del kept[worst]
    mean, sigma = _mean(x[kept], s[kept])
    chi2 = float((((x[kept] - mean) / s[kept]) ** 2).sum())
    degrees = len(kept) - 1
    scale = max(1.0, np.sqrt(chi2 / degrees)) if degrees else 1.0
    return Combined(metric, mean, float(sigma * scale), chi2, degrees, tuple(bags),
                    tuple(bag for i, bag in enumerate(bags) if i not in kept))


def _mean(x: np.ndarray, s: np.ndarray) -> tuple[float, float]:
    weights = s ** -2.0
    return float((weights * x).sum() / weights.sum()), float(weights.sum() ** -0.5)


@dataclass(frozen=True, slots=True)
class CombinedCalibration:
    """The metrics that are observable in at least one bag, and the rotation v_cam = R(q) v_imu.

    The metrics ``rotation_x_rad``, y and z are rotation vectors from it, about the camera's axes.
    """

    metrics: tuple[Combined, ...] = ()
    quat_cam_imu_xyzw: tuple[float, ...] | None = None

    def as_json(self) -> dict[str, Any]:
        """For summary.json of `batch`."""
        metrics = [{('figure' if name == 'metric' else name): value
                    for name, value in asdict(one).items()} for one in self.metrics]
        return {'figures': metrics, 'quat_cam_imu_xyzw': self.quat_cam_imu_xyzw}


def combine(calibrations: Mapping[str, Metrics]) -> CombinedCalibration:
    """Combine calibrations, by the names of their bags; each metric from those that observe it."""
    combined = []
    for metric in _CALIBRATED:
        column = metric.replace('.', '_')
        good = {bag: metrics for bag, metrics in calibrations.items()
                if metrics[f'{column}_observable']}
        if good:
            combined.append(weighted_mean(
                metric, list(good), [metrics[column] for metrics in good.values()],
                [metrics[f'{column}_sigma'] for metrics in good.values()]))
    good = {bag: metrics for bag, metrics in calibrations.items()
            if metrics['rotation_observable']}
    if not good:
        return CombinedCalibration(tuple(combined))
    rotations = Rotation.from_quat([[metrics[f'quat_{axis}'] for axis in 'xyzw']
                                    for metrics in good.values()])
    near = rotations.mean()
    vectors = (rotations * near.inv()).as_rotvec()
    of_axes = [weighted_mean(
        f'rotation_{axis}_rad', list(good), vectors[:, i],
        [metrics[f'rotation_{axis}_sigma_rad'] for metrics in good.values()])
        for i, axis in enumerate('xyz')]
    mean = Rotation.from_rotvec([one.mean for one in of_axes]) * near
    return CombinedCalibration(
        (*combined, *(replace(one, mean=0.0) for one in of_axes)),
        tuple(float(value) for value in mean.as_quat(canonical=True)))


# The two columns of each command that are drawn, their factors and labels.
_DRAWN = {
    'check': (('failure', 1.0, 'failures'), ('warning', 1.0, 'warnings')),
    'calibrate': (('readout_time_s', 1e3, 'readout time [ms], 1 sigma'),
                  ('time_offset_s', 1e3, 'time offset of row 0 [ms], 1 sigma')),
    'replay': (('answered', 1.0, 'pairs with a pose'),
               ('rotation_median_deg', 1.0, 'median error of the rotation [deg]'))}
_NAME_LENGTH = 40
_ROW_HEIGHT = 0.3   # [inch]


def draw(command: str, rows: Sequence[Outcome], combined: Sequence[Combined], path: Path) -> None:
    """Draw the outcomes, from top to bottom in their order, and weighted means with their sigma.

    Outliers of a mean are red, unobservable values orange.
    """
    picture = Figure(figsize=(10.0, 1.2 + _ROW_HEIGHT * len(rows)), dpi=110, layout='constrained')
    both, means = picture.subplots(1, 2, sharey=True), {one.metric: one for one in combined}
    for axes, (column, factor, label) in zip(both, _DRAWN[command], strict=True):
        mean = means.get(column)
        if mean is not None:
            axes.axvline(factor * mean.mean, color=BLUE, linewidth=1.0)
            axes.axvspan(factor * (mean.mean - mean.sigma), factor * (mean.mean + mean.sigma),
                         color=BLUE, alpha=0.2)
        for y, row in enumerate(rows):
            if row.metrics.get(column) is None:
                continue
            colour = (ORANGE if not row.metrics.get(f'{column}_observable', True) else
                      RED if mean is not None and row.job.name in mean.outliers else BLUE)
            axes.errorbar(factor * row.metrics[column], y, fmt='o', color=colour,
                          xerr=factor * row.metrics.get(f'{column}_sigma', 0.0))
        axes.set_xlabel(label)
        axes.grid(axis='x', color='0.9')
    both[0].set_yticks(range(len(rows)), [
        row.job.name[-_NAME_LENGTH:] + ('' if row.metrics else f' ({row.state.value})')
        for row in rows])
    both[0].set_ylim(len(rows) - 0.4, -0.6)
    save_picture(picture, path)


# How many workers may die over one bag before it is given up, less one.
_ALLOWED_DEATHS = 1
_ABSENT = "many bags need Dask, which is not installed: pip install 'dask[distributed]'"
_TIMEOUT = 20.0   # to find a scheduler and its workers [s]


@dataclass(frozen=True, slots=True)
class Request:
    """A command for each of many bags."""

    command: str
    paths: tuple[str, ...]   # bags, or globs of them, in the file system of the workers
    parameters: str | None   # text of a parameter file for all; None: the one next to each bag
    options: tuple[str, ...]
    version: str   # of this package


@dataclass(frozen=True, slots=True)
class BatchOutcome:
    """All bags, in their order, and their combined calibration."""

    rows: tuple[Outcome, ...]
    states: Counter[State]   # number of bags of each state
    combined: CombinedCalibration
    reused: int   # bags with results of an earlier run


def run_batch(client: Any, request: Request, folder: Path, work: Callable[[Job], Outcome],
              on_start: Callable[[int], object] = lambda count: None,
              on_bag: Callable[[], object] = lambda: None) -> BatchOutcome:
    """Do the work and write ``results.csv``, ``summary.json`` and a picture into `folder`.

    `work` runs on the workers, which must be able to import it. `on_start` gets the number of
    bags, `on_bag` is called after each. MissingInputError if there is no bag.
    """
    bags: list[Bag] = run_on_worker(client, find_bags, list(request.paths))
    if all(bag.size < 0 for bag in bags):
        raise MissingInputError(f'the workers find no bag at {", ".join(request.paths)}')
    names = unique_names([bag.path for bag in bags])
    jobs = [Job(request.command, bag, name, bag.parameters if request.parameters is None
                else request.parameters, request.options, request.version)
            for bag, name in zip(bags, names, strict=True)]
    on_start(len(jobs))
    store = Store(folder)
    outcomes = {job: earlier for job in jobs if (earlier := store.done(job)) is not None}
    reused = len(outcomes)
    for _ in outcomes:
        on_bag()
    for outcome in _run_jobs(client, [job for job in jobs if job not in outcomes], work):
        store.add(outcome)
        outcomes[outcome.job] = outcome
        # After each: the table can be read while the other bags are processed.
        store.write_table([outcomes[job] for job in jobs if job in outcomes])
        on_bag()
    rows = tuple(outcomes[job] for job in jobs)
    store.write_table(rows)
    combined = combine({row.job.name: row.metrics for row in rows if (
        row.metrics and request.command == 'calibrate')})
    result = BatchOutcome(rows, Counter(row.state for row in rows), combined, reused)
    summary = {
        'command': request.command, 'options': list(request.options),
        'version': request.version, 'bags': len(rows),
        'states': {state.value: result.states[state] for state in State},
        'combined': combined.as_json()}
    with written(folder / SUMMARY_FILE) as file:
        file.write(json.dumps(summary, indent=1) + '\n')
    draw(request.command, rows, combined.metrics, folder / PICTURE_FILE)
    return result


@contextmanager
def open_cluster(scheduler: str | None, workers: int | None) -> Iterator[Any]:
    """A client of a running scheduler, or of `workers` local processes of one thread each.

    By default as many as this process may use processors. MissingInputError without Dask, or
    without workers; InputError if no scheduler answers.
    """
    dask, distributed = library('dask', _ABSENT), library('distributed', _ABSENT)
    # It logs starts and ends of processes; errors of the work are in the outcomes.
    logging.getLogger('distributed').setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        if scheduler is None:
            stack.enter_context(dask.config.set(
                {'distributed.scheduler.allowed-failures': _ALLOWED_DEATHS}))
            # Loopback only; no dashboard, whose port others may use.
            scheduler = stack.enter_context(distributed.LocalCluster(
                n_workers=workers or len(os.sched_getaffinity(0)), threads_per_worker=1,
                processes=True, host='127.0.0.1', dashboard_address=None,
                scheduler_kwargs={'dashboard_address': '127.0.0.1:0'},
                silence_logs=logging.CRITICAL))
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


def run_on_worker(client: Any, function: Callable[..., Any], *arguments: object) -> Any:
    """Result of a function on a worker, whose file system and package can be others."""
    return client.submit(function, *arguments, pure=False).result()


def _run_jobs(client: Any, jobs: Sequence[Job],
              work: Callable[[Job], Outcome]) -> Iterator[Outcome]:
    """Outcomes as they come; one job at a time for each thread of the workers.

    A worker that dies is replaced, and its job repeated, by another worker if possible.
    """
    distributed = library('distributed', _ABSENT)
    waiting = list(reversed(jobs))
    running: dict[Any, Job] = {}
    finished = distributed.as_completed()

    def fill() -> None:
        # A job that is queued at a worker would die with the one that is running there.
        while waiting and len(running) < max(1, sum(client.nthreads().values())):
            job = waiting.pop()
            future = client.submit(work, job, pure=False)
            running[future] = job
            finished.add(future)

    fill()
    for future in finished:
        job = running.pop(future)
        try:
            outcome = future.result()
        except distributed.scheduler.KilledWorker:
            outcome = Outcome(job, State.LOST, f'each of {_ALLOWED_DEATHS + 1} workers died over '
                              'this bag: out of memory, or a fault of a library')
        except Exception as error:  # noqa: BLE001 any error of a worker is the outcome of its bag
            outcome = Outcome(job, State.FAILED, f'{type(error).__name__}: {error}')
        yield outcome
        fill()
