"""Tables in Markdown and CSV, and the groups of records that become their lines."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import csv
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

_Record = TypeVar('_Record')


def grouped(records: Iterable[_Record], key: Callable[[_Record], Any]) -> dict[Any, list[_Record]]:
    """Records by their key, in the order in which the keys first occur."""
    groups: dict[Any, list[_Record]] = {}
    for record in records:
        groups.setdefault(key(record), []).append(record)
    return groups


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table whose first column is text and whose others are figures, padded to be read as is."""
    lines = [list(header), *map(list, rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(header))]

    def padded(line: Sequence[str]) -> str:
        cells = [line[0].ljust(widths[0]),
                 *(text.rjust(width) for text, width in zip(line[1:], widths[1:], strict=True))]
        return '| ' + ' | '.join(cells) + ' |'

    rule = ['-' * widths[0], *('-' * (width - 1) + ':' for width in widths[1:])]
    return '\n'.join([padded(lines[0]), padded(rule), *map(padded, lines[1:])]) + '\n'


def write_csv(path: Path, records: Iterable[Any]) -> None:
    """Write a line for each dataclass or mapping; NaN is an empty cell.

    A dataclass inside of another gives columns ``outer_inner``.
    """
    rows = [dict(_flat(record if isinstance(record, Mapping) else asdict(record)))
            for record in records]
    with path.open('w', newline='', encoding='utf-8') as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _flat(values: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f'{prefix}{name}_')
        else:
            yield prefix + name, '' if value != value else value
