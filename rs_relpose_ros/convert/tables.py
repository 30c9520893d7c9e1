"""Numbers in text files, each error with its file and line."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
import math
from pathlib import Path

from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.timing import NANOSECONDS

# Far above any log of a few minutes; what is bigger is another file.
_MAX_BYTES = 1 << 28
_MAX_HEADER = 10_000


@dataclass(frozen=True, slots=True)
class Row:
    """The words of one line of a table."""

    path: Path
    line: int
    words: tuple[str, ...]

    def error(self, what: str) -> InputError:
        """An error that says where it is."""
        return InputError(f'{self.path}, line {self.line}: {what}')

    def real(self, column: int) -> float:
        """A finite number."""
        try:
            value = float(self.words[column])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.error(f'column {column + 1} must be a finite number, got '
                             f'{self.words[column][:40]!r}')
        return value

    def reals(self, first: int, count: int) -> tuple[float, ...]:
        """`count` finite numbers from column `first` on."""
        return tuple(self.real(column) for column in range(first, first + count))

    def integer(self, column: int) -> int:
        """An integer with or without a sign."""
        text = self.words[column]
        if not (text.isascii() and text.removeprefix('-').isdigit()) or len(text) > 19:
            raise self.error(f'column {column + 1} must be an integer, got {text[:40]!r}')
        return int(text)

    def nanoseconds(self, column: int) -> int:
        """A stamp [ns] that is written as such."""
        text = self.words[column]
        if not (text.isascii() and text.isdigit()):
            raise self.error(f'column {column + 1} must be a stamp in nanoseconds, an integer, '
                             f'got {text[:40]!r}')
        return int(text)

    def seconds_as_nanoseconds(self, column: int) -> int:
        """A stamp [ns] that is written in decimal seconds; rounded, never a float on the way."""
        text = self.words[column]
        try:
            seconds = Decimal(text)
        except InvalidOperation:
            seconds = Decimal('NaN')
        # The seconds of a ROS stamp are an int32.
        if not seconds.is_finite() or not 0 <= seconds < 2**31:
            raise self.error(f'column {column + 1} must be a stamp in seconds, got {text[:40]!r}')
        return int((seconds * NANOSECONDS).to_integral_value())


@dataclass(frozen=True, slots=True)
class Table:
    """A table whose first line names its columns."""

    path: Path
    header: tuple[str, ...]
    rows: tuple[Row, ...]

    def column(self, *names: str) -> int:
        """Index of the column that has one of the names."""
        for name in names:
            if name in self.header:
                return self.header.index(name)
        raise InputError(f'{self.path} has no column {" or ".join(names)}; its first line names '
                         f'{", ".join(self.header)[:200]}')

    def has(self, name: str) -> bool:
        """Whether there is such a column."""
        return name in self.header


def file_inside(folder: Path, row: Row, column: int) -> Path:
    """A file that a table names; a table from elsewhere must not reach other folders."""
    name = Path(row.words[column])
    if name.is_absolute() or '..' in name.parts:
        raise row.error(f'{str(name)[:80]!r} lies outside of the recording')
    return folder / name


def read_table(path: Path) -> Table:
    """A file of comma-separated values, its columns named by its first line.

    MissingInputError where it is absent or has no rows.
    """
    if not path.is_file():
        raise MissingInputError(f'{path.name} is missing: there is no file {path}')
    with path.open(encoding='utf-8', errors='replace') as file:
        first = file.readline(_MAX_HEADER).strip()
    header = tuple(word.strip() for word in first.split(','))
    rows = tuple(read_rows(path, len(header), ','))[1:]
    if not rows:
        raise MissingInputError(f'{path} has no rows below its first line')
    return Table(path, header, rows)


def read_rows(path: Path, columns: int, separator: str | None = None) -> Iterator[Row]:
    """Lines of a text file, without the empty ones and those that begin with '#'.

    Each must have so many `columns`, with a `separator` between them, white space by default.
    """
    if not path.is_file():
        raise MissingInputError(f'{path.name} is missing: there is no file {path}')
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(f'{path} has more than {_MAX_BYTES} bytes: it is another file')
    with path.open(encoding='utf-8', errors='replace') as file:
        for number, line in enumerate(file, start=1):
            text = line.strip()
            if not text or text.startswith('#'):
                continue
            row = Row(path, number, tuple(word.strip() for word in text.split(separator)))
            if len(row.words) != columns:
                raise row.error(f'there must be {columns} columns, got {len(row.words)}')
            yield row
