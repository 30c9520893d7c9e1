"""A command over many bags on a Dask cluster; bags with a result of an earlier run are skipped."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass
import json
import logging
import os
from pathlib import Path
from typing import Any

from rs_relpose_ros.errors import InputError, library, MissingInputError
from rs_relpose_ros.offline import batch_results
from rs_relpose_ros.offline.batch_results import Bag, Job, Outcome, State, Store
from rs_relpose_ros.output_files import SUMMARY_FILE, written

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
    combined: batch_results.CombinedCalibration
    reused: int   # bags with results of an earlier run

    @property
    def states(self) -> Counter[State]:
        """Number of bags of each state."""
        return Counter(row.state for row in self.rows)


def run_batch(client: Any, request: Request, folder: Path, work: Callable[[Job], Outcome],
              on_start: Callable[[int], object] = lambda count: None,
              on_bag: Callable[[], object] = lambda: None) -> BatchOutcome:
    """Do the work and write ``results.csv``, ``summary.json`` and a picture into `folder`.

    `work` runs on the workers, which must be able to import it. `on_start` gets the number of
    bags, `on_bag` is called after each. MissingInputError if there is no bag.
    """
    bags: list[Bag] = run_on_worker(client, batch_results.find_bags, list(request.paths))
    if all(bag.size < 0 for bag in bags):
        raise MissingInputError(f'the workers find no bag at {", ".join(request.paths)}')
    names = batch_results.unique_names([bag.path for bag in bags])
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
    combined = batch_results.combine({row.job.name: row.metrics for row in rows if (
        row.metrics and request.command == 'calibrate')})
    result = BatchOutcome(rows, combined, reused)
    summary = {
        'command': request.command, 'options': list(request.options),
        'version': request.version, 'bags': len(rows),
        'states': {state.value: result.states[state] for state in State},
        'combined': combined.as_json()}
    with written(folder / SUMMARY_FILE) as file:
        file.write(json.dumps(summary, indent=1) + '\n')
    batch_results.draw(request.command, rows, combined.metrics,
                       folder / batch_results.PICTURE_FILE)
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
