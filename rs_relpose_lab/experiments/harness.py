"""Shared by the experiments: groups, tables in Markdown and CSV, and worker processes."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
import csv
from dataclasses import asdict
from multiprocessing import get_context
import os
from pathlib import Path
from typing import Any, TypeVar

_Record = TypeVar('_Record')
_Task = TypeVar('_Task')
_Result = TypeVar('_Result')


def grouped(records: Iterable[_Record], key: Callable[[_Record], Any]) -> dict[Any, list[_Record]]:
    """Records by their key, in the order in which the keys first occur."""
    groups: dict[Any, list[_Record]] = {}
    for record in records:
        groups.setdefault(key(record), []).append(record)
    return groups


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A padded table: first column text (left), the others numbers (right)."""
    lines = [list(header), *map(list, rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(header))]

    first_width = widths[0]

    def padded(line: Sequence[str]) -> str:
        numbers = zip(line[1:], widths[1:], strict=True)
        cells = [line[0].ljust(first_width)]
        cells += [text.rjust(width) for text, width in numbers]
        return f'| {" | ".join(cells)} |\n'

    rule = ['-' * first_width]
    rule += ['-' * (width - 1) + ':' for width in widths[1:]]
    above = padded(lines[0]) + padded(rule)
    return above + ''.join(padded(line) for line in lines[1:])


def write_csv(path: Path, records: Iterable[Any]) -> None:
    """Write a line for each dataclass or mapping; NaN is an empty cell.

    A dataclass inside of another gives columns ``outer_inner``.
    """
    rows = [
        dict(_flat(record if isinstance(record, Mapping) else asdict(record)))
        for record in records
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open('w', newline='', encoding='utf-8') as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def write_table(folder: Path, name: str, records: Iterable[Any], text: str) -> str:
    """Write the records (NAME.csv) and the report (NAME.md), and return the latter."""
    write_csv(folder / f'{name}.csv', records)
    (folder / f'{name}.md').write_text(text, encoding='utf-8')
    return text


def _flat(values: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f'{prefix}{name}_')
        else:
            yield prefix + name, '' if value != value else value


def use_one_thread() -> None:
    """Give numerical libraries one thread, here and in child processes.

    All numbers of the benchmarks are for one thread. To be called before NumPy is imported.
    """
    for name in ('OMP', 'OPENBLAS', 'MKL', 'NUMBA'):
        os.environ[f'{name}_NUM_THREADS'] = '1'


def in_processes(
    work: Callable[[_Task], _Result],
    tasks: Sequence[_Task],
    jobs: int,
    prepare: Callable[[], object] | None = None,
) -> Iterator[_Result]:
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
