"""Time and accuracy of this library, OpenCV and PoseLib, side by side on the same problems."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
import gc
from multiprocessing import get_context
import os
import time

import cv2
import numpy as np

from rs_relpose_lab.experiments.methods import as_pair, Estimate, METHODS, prepared
from rs_relpose_lab.experiments.problems import Cell, CELLS, make_problem
from rs_relpose_lab.live.processes import process_figures
from rs_relpose_ros import warm_up

THRESHOLD = 1.5  # [px], of OpenCV and PoseLib
LIBRARY = 'rs_relpose_ros'
REFERENCE = 'PoseLib, derotated points'
# In the report; PoseLib's only where it is installed.
COMPARED = {LIBRARY: METHODS['auto']} | {
    name: replace(METHODS[key], threshold=THRESHOLD) for name, key in (
        ('OpenCV USAC_MAGSAC, raw points', 'opencv'),
        ('OpenCV USAC_MAGSAC, derotated points', 'opencv_derotated'),
        ('PoseLib, raw points', 'poselib'), (REFERENCE, 'poselib_derotated')) if key in METHODS}


@dataclass(frozen=True, slots=True)
class Timing:
    """One method on one problem.

    `duration`: the shortest of the repeats [ms].
    `rotation`, `translation`: errors [deg]; infinite without a pose.
    """

    cell: str
    matches: int
    method: str
    seed: int
    duration: float
    rotation: float
    translation: float


@dataclass(frozen=True, slots=True)
class Soak:
    """Resident memory [MB] while estimates of twenty problems go on.

    `estimates`: between the two.
    """

    estimates: int
    before: float
    after: float


def compare(cell_name: str, matches: int, trials: int, repeats: int, first_seed: int = 0,
            on_problem: Callable[[], object] = lambda: None) -> list[Timing]:
    """Run every method on the same problems of a cell.

    The methods take turns on each problem, and each of them the shortest of a few repeats, so that
    what else the machine does spoils none more than the others.
    """
    cell = replace(CELLS[cell_name], matches=matches)
    # OpenCV would take all cores.
    cv2.setNumThreads(1)
    warm_up()
    timings = []
    for seed in range(first_seed, first_seed + trials):
        pair = as_pair(make_problem(cell, seed), cell)
        for name, method in COMPARED.items():
            call = prepared(method, pair, seed)
            duration = 1e3 * _shortest(call, repeats)
            error = pair.error(call())
            timings.append(Timing(cell_name, matches, name, seed, duration, error.rotation,
                                  error.translation))
        on_problem()
    return timings


def _shortest(call: Estimate, repeats: int) -> float:
    """The shortest time of a call [s]."""
    durations = []
    gc.disable()
    try:
        for _ in range(repeats):
            started = time.perf_counter()
            call()
            durations.append(time.perf_counter() - started)
    finally:
        gc.enable()
    return min(durations)


def _base_problem(seed: int) -> Estimate:
    cell = Cell()
    return prepared(METHODS['auto'], as_pair(make_problem(cell, seed), cell), seed)


def first_estimates(processes: int) -> list[tuple[float, float]]:
    """First and second estimate [ms] of new processes, one after the other; without imports.

    The kernels' cache on disk is filled before, by an estimate in this process.
    """
    warm_up()
    results = []
    for _ in range(processes):
        with ProcessPoolExecutor(1, get_context('spawn')) as pool:
            results.append(pool.submit(_first_estimates).result())
    return results


def _first_estimates() -> tuple[float, float]:
    call = _base_problem(0)
    return 1e3 * _shortest(call, 1), 1e3 * _shortest(call, 1)


def soak(estimates: int, on_estimate: Callable[[], object] = lambda: None) -> Soak:
    """Estimate again and again and see whether memory grows.

    A tenth as many estimates go before, so that buffers have their size.
    """
    calls = [_base_problem(seed) for seed in range(20)]

    def work(count: int) -> None:
        for k in range(count):
            calls[k % len(calls)]()
            on_estimate()

    work(estimates // 10)
    before = process_figures(os.getpid())
    work(estimates)
    return Soak(estimates, before.resident, process_figures(os.getpid()).resident)


def medians(timings: Sequence[Timing], method: str) -> dict[int, float]:
    """Median time [ms] of a method by the number of matches."""
    return {size: float(np.median([timing.duration for timing in timings
                                   if (timing.matches, timing.method) == (size, method)]))
            for size in sorted({timing.matches for timing in timings})}


def exponent(times: dict[int, float]) -> float:
    """Slope of log time over log matches: 1 is linear."""
    if len(times) < 2:
        return float('nan')
    return float(np.polyfit(np.log(list(times)), np.log(list(times.values())), 1)[0])
