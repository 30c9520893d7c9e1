"""Time and accuracy of this library, OpenCV and PoseLib, side by side on the same problems."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
import gc
from multiprocessing import get_context
from pathlib import Path
import time

import cv2
import numpy as np

from rs_relpose_lab.experiments.accuracy import estimate, told_config
from rs_relpose_lab.experiments.peers import available_methods, Pose
from rs_relpose_lab.experiments.problems import Cell, CELLS, make_problem
from rs_relpose_lab.experiments.scoring import NO_POSE, pose_error
from rs_relpose_ros import warm_up


@dataclass(frozen=True, slots=True)
class Run:
    """One method on one problem.

    Attributes
    ----------
    cell, method : str
    matches, seed : int
    duration : float
        The shortest of the repeats [ms].
    rotation, translation : float
        Errors [deg]; infinite without a pose.
    """

    cell: str
    matches: int
    method: str
    seed: int
    duration: float
    rotation: float
    translation: float


@dataclass(frozen=True, slots=True)
class FirstEstimate:
    """Of a new process with compiled kernels on disk: first and second estimate [ms]."""

    first: float
    second: float


@dataclass(frozen=True, slots=True)
class Soak:
    """Resident memory [MB] while estimates of ever new problems go on.

    Attributes
    ----------
    estimates : int
        Between the two.
    before, after : float
    """

    estimates: int
    before: float
    after: float


def compare(cell_name: str, matches: int, trials: int, repeats: int, first_seed: int = 0,
            on_run: Callable[[int], object] = lambda count: None) -> list[Run]:
    """Run every method on the same problems of a cell.

    The methods take turns on each problem, and each of them the shortest of a few repeats, so that
    what else the machine does spoils none more than the others.
    """
    cell = replace(CELLS[cell_name], matches=matches)
    # OpenCV would take all cores.
    cv2.setNumThreads(1)
    warm_up()
    runs = []
    for seed in range(first_seed, first_seed + trials):
        problem = make_problem(cell, seed)
        for method in available_methods():
            pose, duration = _timed(method.prepare(problem, cell, seed), repeats)
            error = NO_POSE if pose is None else pose_error(*pose, problem.R, problem.t)
            runs.append(Run(cell_name, matches, method.name, seed, duration * 1e3, error.rotation,
                            error.translation))
        on_run(1)
    return runs


def _timed(call: Callable[[], Pose | None], repeats: int) -> tuple[Pose | None, float]:
    """The pose, which repeats do not change, and the shortest time [s]."""
    durations = []
    gc.disable()
    try:
        for _ in range(repeats):
            started = time.perf_counter()
            pose = call()
            durations.append(time.perf_counter() - started)
    finally:
        gc.enable()
    return pose, min(durations)


def first_estimates(processes: int) -> list[FirstEstimate]:
    """Time the first estimate in new processes, one after the other; imports are not counted.

    The kernels' cache on disk is filled before, by an estimate in this process.
    """
    warm_up()
    results = []
    for _ in range(processes):
        with ProcessPoolExecutor(1, mp_context=get_context('spawn')) as pool:
            results.append(pool.submit(_first_estimate).result())
    return results


def _first_estimate() -> FirstEstimate:
    cell = Cell()
    problem, config = make_problem(cell, 0), told_config(cell, 1.0, 'auto')
    durations = []
    for _ in range(2):
        started = time.perf_counter()
        estimate(problem, config, 0)
        durations.append((time.perf_counter() - started) * 1e3)
    return FirstEstimate(*durations)


def soak(estimates: int, on_estimates: Callable[[int], object] = lambda count: None) -> Soak:
    """Estimate again and again and see whether memory grows.

    A tenth as many estimates go before, so that buffers have their size.
    """
    cell = Cell()
    config = told_config(cell, 1.0, 'auto')
    problems = [make_problem(cell, seed) for seed in range(20)]

    def work(count: int) -> None:
        for k in range(count):
            estimate(problems[k % len(problems)], config, k)
            on_estimates(1)

    work(estimates // 10)
    before = _resident()
    work(estimates)
    return Soak(estimates, before, _resident())


def _resident() -> float:
    """Resident memory of this process [MB], as Linux tells."""
    for line in Path('/proc/self/status').read_text().splitlines():
        if line.startswith('VmRSS:'):
            return float(line.split()[1]) / 1024.0
    raise OSError('/proc/self/status has no VmRSS')


def medians(runs: Sequence[Run], method: str) -> dict[int, float]:
    """Median time [ms] of a method by the number of matches."""
    sizes = sorted({run.matches for run in runs})
    return {size: float(np.median([run.duration for run in runs
                                   if run.matches == size and run.method == method]))
            for size in sizes}


def exponent(times: dict[int, float]) -> float:
    """Slope of log time over log matches: 1 is linear."""
    if len(times) < 2:
        return float('nan')
    return float(np.polyfit(np.log(list(times)), np.log(list(times.values())), 1)[0])
