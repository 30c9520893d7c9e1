"""Experiments in several processes, each with one thread."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
import os
from typing import TypeVar

_Task = TypeVar('_Task')
_Result = TypeVar('_Result')


def use_one_thread() -> None:
    """Give numerical libraries one thread, here and in child processes.

    Every figure of the benchmarks is for one thread. To be called before NumPy is imported.
    """
    for name in ('OMP', 'OPENBLAS', 'MKL', 'NUMBA'):
        os.environ[f'{name}_NUM_THREADS'] = '1'


def in_processes(work: Callable[[_Task], _Result], tasks: Sequence[_Task], jobs: int,
                 prepare: Callable[[], object] | None = None) -> Iterator[_Result]:
    """Results of `work`, in the order of the tasks, which does not depend on `jobs`.

    `prepare` is called once in each process.
    """
    if jobs == 1:
        if prepare is not None:
            prepare()
        yield from map(work, tasks)
        return
    # Not forked: OpenCV's and Numba's threads do not survive that.
    with ProcessPoolExecutor(jobs, get_context('spawn'), initializer=prepare) as pool:
        try:
            yield from pool.map(work, tasks)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
