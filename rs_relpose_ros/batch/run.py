"""A command over many bags: what was done before is taken over, the rest goes to the cluster."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
import json
from pathlib import Path
from typing import Any

from rs_relpose_ros.batch.cluster import ask_a_worker, run_jobs
from rs_relpose_ros.batch.combine import combine, CombinedCalibration
from rs_relpose_ros.batch.figures import RESULT_FILES
from rs_relpose_ros.batch.job import Bag, Job, look_at, Outcome, State, unique_names
from rs_relpose_ros.batch.picture import draw, PICTURE_FILE
from rs_relpose_ros.batch.store import Row, row_of, Store
from rs_relpose_ros.errors import MissingInputError
from rs_relpose_ros.result_files import SUMMARY_FILE


@dataclass(frozen=True, slots=True)
class Request:
    """What is to be done with each bag."""

    command: str
    paths: tuple[str, ...]   # bags, or globs of them, as the workers see them
    parameters: str | None   # text of a parameter file for all; None: that beside each bag
    options: tuple[str, ...]
    version: str   # of this package


@dataclass(frozen=True, slots=True)
class BatchOutcome:
    """All bags, in their order, and their calibrations as one."""

    rows: tuple[Row, ...]
    combined: CombinedCalibration
    taken_over: int   # bags whose results were there

    @property
    def states(self) -> Counter[State]:
        """How many bags ended how."""
        return Counter(row.state for row in self.rows)


def run_batch(client: Any, request: Request, folder: Path, work: Callable[[Job], Outcome],
              on_start: Callable[[int], object] = lambda count: None,
              on_bag: Callable[[], object] = lambda: None) -> BatchOutcome:
    """Do the work and write ``results.csv``, ``summary.json`` and a picture into `folder`.

    `work` runs on the workers, which must be able to import it. `on_start` gets the number of
    bags, `on_bag` is called after each. MissingInputError where there is no bag.
    """
    bags: list[Bag] = ask_a_worker(client, look_at, list(request.paths))
    if all(bag.size < 0 for bag in bags):
        raise MissingInputError(f'the workers find no bag at {", ".join(request.paths)}')
    jobs = [Job(request.command, bag, name, bag.parameters if request.parameters is None
                else request.parameters, request.options, request.version)
            for bag, name in zip(bags, unique_names([bag.path for bag in bags]), strict=True)]
    on_start(len(jobs))
    store = Store(folder)
    outcomes: dict[str, Outcome] = {}
    for job in jobs:
        before = store.done(job)
        if before is not None:
            outcomes[job.name] = before
            on_bag()
    taken_over = len(outcomes)
    for job, outcome in run_jobs(client, [job for job in jobs if job.name not in outcomes], work):
        store.add(job, outcome)
        outcomes[job.name] = outcome
        # After each: what is there can be read while the rest is being done.
        store.write_table(_rows(jobs, outcomes))
        on_bag()
    rows = _rows(jobs, outcomes)
    store.write_table(rows)
    combined = _combined(request.command, jobs, outcomes)
    result = BatchOutcome(tuple(rows), combined, taken_over)
    _write_summary(folder / SUMMARY_FILE, request, result)
    draw(request.command, rows, combined.figures, folder / PICTURE_FILE)
    return result


def _rows(jobs: Sequence[Job], outcomes: dict[str, Outcome]) -> list[Row]:
    return [row_of(job, outcomes[job.name]) for job in jobs if job.name in outcomes]


def _combined(command: str, jobs: Sequence[Job],
              outcomes: dict[str, Outcome]) -> CombinedCalibration:
    if command != 'calibrate':
        return CombinedCalibration()
    name = RESULT_FILES[command]
    return combine({job.name: json.loads(outcomes[job.name].files[name]) for job in jobs
                    if name in outcomes[job.name].files})


def _write_summary(path: Path, request: Request, result: BatchOutcome) -> None:
    summary = {
        'command': request.command, 'options': list(request.options),
        'version': request.version, 'bags': len(result.rows),
        'states': {state.value: result.states[state] for state in State},
        'combined': asdict(result.combined)}
    path.write_text(json.dumps(summary, indent=1) + '\n', encoding='utf-8')
