"""Jobs on a Dask cluster: processes of this machine, or a scheduler that runs already."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, ExitStack
import importlib
import logging
import os
from types import ModuleType
from typing import Any

from rs_relpose_ros.batch.job import Job, Outcome, State
from rs_relpose_ros.errors import InputError, MissingInputError

# How often a bag may cost a worker its life before it is given up.
_ALLOWED_DEATHS = 1
_TIMEOUT = 20.0   # to find a scheduler and its workers [s]


@contextmanager
def open_cluster(scheduler: str | None, workers: int | None) -> Iterator[Any]:
    """A client of a running scheduler, or of `workers` processes of one thread each here.

    By default as many as this process may use processors. MissingInputError without Dask, or
    without workers; InputError where no scheduler answers.
    """
    dask, distributed = _library('dask'), _library('distributed')
    # Starts and ends of processes; what matters comes back as outcomes.
    logging.getLogger('distributed').setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        if scheduler is None:
            stack.enter_context(dask.config.set(
                {'distributed.scheduler.allowed-failures': _ALLOWED_DEATHS}))
            # Loopback only; no dashboard, and its port free for those of others.
            scheduler = stack.enter_context(distributed.LocalCluster(
                n_workers=workers or len(os.sched_getaffinity(0)), threads_per_worker=1,
                processes=True, host='127.0.0.1', dashboard_address=None,
                scheduler_kwargs={'dashboard_address': '127.0.0.1:0'},
                silence_logs=logging.CRITICAL))
        elif workers is not None:
            raise InputError('--workers is for processes of this machine: a running cluster has '
                             'its own')
        try:
            client = stack.enter_context(distributed.Client(scheduler, timeout=_TIMEOUT))
        except (OSError, ValueError) as error:
            raise InputError(f'no Dask scheduler answers at {scheduler}: {error}') from error
        try:
            client.wait_for_workers(1, timeout=_TIMEOUT)
        except TimeoutError as error:
            raise MissingInputError(f'the cluster at {scheduler} has no workers') from error
        yield client


def ask_a_worker(client: Any, function: Callable[..., Any], *arguments: object) -> Any:
    """What a function gives on a worker, which sees other files than we do."""
    return client.submit(function, *arguments, pure=False).result()


def run_jobs(client: Any, jobs: Sequence[Job],
             work: Callable[[Job], Outcome]) -> Iterator[tuple[Job, Outcome]]:
    """Outcomes as they come; one job at a time for each thread of the workers.

    A worker that dies is replaced, and its job done again, elsewhere where that is possible.
    """
    distributed = _library('distributed')
    waiting = list(reversed(jobs))
    doing: dict[Any, Job] = {}
    finished = distributed.as_completed()

    def fill() -> None:
        # Queued at a worker, a job would die along with the one that is being done.
        while waiting and len(doing) < max(1, sum(client.nthreads().values())):
            job = waiting.pop()
            future = client.submit(work, job, pure=False)
            doing[future] = job
            finished.add(future)

    fill()
    for future in finished:
        job = doing.pop(future)
        yield job, _outcome(future, distributed)
        fill()


def _outcome(future: Any, distributed: ModuleType) -> Outcome:
    try:
        outcome: Outcome = future.result()
    except distributed.scheduler.KilledWorker:
        return Outcome(State.LOST, f'each of {_ALLOWED_DEATHS + 1} workers died over this bag: '
                       'out of memory, or a fault of a library', 0.0, {})
    except Exception as error:  # noqa: BLE001 whatever a worker raised is the outcome of its bag
        return Outcome(State.FAILED, f'{type(error).__name__}: {error}', 0.0, {})
    return outcome


def _library(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingInputError('many bags need Dask, which is not installed: pip install '
                                "'dask[distributed]'") from error
