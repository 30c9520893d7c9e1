"""Results of many bags on the disk: a folder for each, and one table of all."""

from __future__ import annotations

from collections.abc import Sequence
import csv
from dataclasses import dataclass
import json
from pathlib import Path
import shutil

from rs_relpose_ros.batch.figures import Figures, figures_of, message_of
from rs_relpose_ros.batch.job import as_mapping, Job, LASTING, Outcome, State

RESULTS_FILE = 'results.csv'
_JOB_FILE = 'job.json'


@dataclass(frozen=True, slots=True)
class Row:
    """A line of the table."""

    bag: str
    name: str
    state: State
    message: str
    seconds: float
    figures: Figures


class Store:
    """The folder of the results; what lies in it from an earlier run is taken over."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def done(self, job: Job) -> Outcome | None:
        """The result of an earlier run of the same job; None where there is none that lasts."""
        folder = self.folder / job.name
        try:
            entry = json.loads((folder / _JOB_FILE).read_text(encoding='utf-8'))
            if entry['fingerprint'] != job.fingerprint:
                return None
            files = {name: (folder / name).read_bytes() for name in entry['files']}
            outcome = Outcome(State(entry['state']), entry['message'], entry['seconds'], files)
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return outcome if outcome.state in LASTING else None

    def add(self, job: Job, outcome: Outcome) -> None:
        """Replace what was there of a bag; its entry comes last, so that it is whole or absent."""
        folder = self.folder / job.name
        if (folder / _JOB_FILE).is_file():
            shutil.rmtree(folder)
        folder.mkdir(exist_ok=True)
        for name, data in outcome.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)
        entry = {'bag': job.bag.path, 'fingerprint': job.fingerprint, **as_mapping(outcome)}
        _write(folder / _JOB_FILE, json.dumps(entry, indent=1) + '\n')

    def write_table(self, rows: Sequence[Row]) -> None:
        """One row for each bag; figures that a bag does not have are empty."""
        columns = list(dict.fromkeys(name for row in rows for name in row.figures))
        path = self.folder / f'.{RESULTS_FILE}'
        with path.open('w', encoding='utf-8', newline='') as file:
            writer = csv.writer(file, lineterminator='\n')
            writer.writerow(['bag', 'name', 'state', 'message', 'seconds', *columns])
            for row in rows:
                writer.writerow([row.bag, row.name, row.state.value, ' '.join(row.message.split()),
                                 f'{row.seconds:.3f}',
                                 *(_text(row.figures.get(name)) for name in columns)])
        path.replace(self.folder / RESULTS_FILE)


def row_of(job: Job, outcome: Outcome) -> Row:
    """The line of a bag."""
    return Row(job.bag.path, job.name, outcome.state,
               outcome.message or (message_of(job.command, outcome.files)
                                   if outcome.state is State.FINDINGS else ''),
               outcome.seconds, figures_of(job.command, outcome.files))


def _text(value: object) -> str:
    return '' if value is None else repr(value) if isinstance(value, float) else str(value)


def _write(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    part = path.with_name(f'.{path.name}')
    part.write_text(text, encoding='utf-8')
    part.replace(path)
