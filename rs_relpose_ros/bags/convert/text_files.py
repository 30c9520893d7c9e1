"""Read text files of recordings: tables and JSON. Each error names the file and the line."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
import csv
from decimal import Decimal
import json
import math
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.so3 import Vector
from rs_relpose_ros.geometry.timing import END_OF_STAMPS_NS, NANOSECONDS

# A larger table is refused: reading it would fill the memory. [chosen: an hour of an IMU at
# 1 kHz has 4e8 bytes at most in any known logger; any value from 1e8 to 1e10 would do]
_MAX_TABLE_BYTES = 1 << 29
# A larger JSON file is refused: descriptions of devices have some kilobytes. [chosen: any value
# from 1e6 to 1e9 would do]
_MAX_OBJECT_BYTES = 1 << 24
# A longer line of a table is cut, so that a file without line ends is not read as one line.
# [chosen: rows of loggers have below 1000 characters; any value from 1e4 to 1e8 would do]
_MAX_LINE = 1 << 16

_Value = TypeVar('_Value', int, float)

# A quaternion whose length differs by more from 1 is an error of the file. [chosen: digits of text
# files give 1e-4; any value from 1e-3 to 1e-1 would do]
_QUATERNION_TOLERANCE = 1e-2


class Row(NamedTuple):
    """Words of one line of a file, by the name of their column or by its number from 0."""

    path: Path
    line: int
    words: Mapping[Any, Any]

    def error(self, what: str) -> InputError:
        """Make an error that names the place of the row."""
        return InputError(f'{self.path}, line {self.line}: {what}')

    def word(self, column: str | int) -> Any:
        """Return the text in a column."""
        if column not in self.words:
            present = ', '.join(map(str, self.words))[:200]
            raise self.error(f'it has no column {column}, only {present}')
        return self.words[column]

    def real(self, column: str | int) -> float:
        """Return a finite number."""
        return self._number(column, 'a finite number', float, math.isfinite)

    def vector(self, x: str | int, y: str | int, z: str | int) -> Vector:
        """Return three finite numbers."""
        return self.real(x), self.real(y), self.real(z)

    def quaternion(
        self, x: str | int, y: str | int, z: str | int, w: str | int
    ) -> tuple[float, float, float, float]:
        """Return a rotation as a quaternion of length 1."""
        quaternion = self.real(x), self.real(y), self.real(z), self.real(w)
        length = math.hypot(*quaternion)
        if abs(length - 1.0) > _QUATERNION_TOLERANCE:
            raise self.error(f'the quaternion must have length 1, got {length:.3g}')
        return quaternion

    def integer(self, column: str | int) -> int:
        """Return an integer with or without a sign."""
        return self._number(column, 'an integer', int, lambda _: True)

    def nanoseconds(self, column: str | int) -> int:
        """Return a stamp [ns] that is written in nanoseconds."""
        return self._number(column, 'a stamp in nanoseconds, an integer', int, _is_stamp)

    def seconds_as_nanoseconds(self, column: str | int) -> int:
        """Return a stamp [ns] that is written in decimal seconds.

        The stamp is rounded from the decimal number: a float would lose up to 240 ns.
        """
        return self._number(column, 'a stamp in seconds', _nanoseconds, _is_stamp)

    def _number(
        self,
        column: str | int,
        legal: str,
        convert: Callable[[str], _Value],
        is_legal: Callable[[_Value], bool],
    ) -> _Value:
        text = self.word(column)
        with suppress(ValueError, ArithmeticError):
            if isinstance(text, str) and is_legal(value := convert(text)):
                return value
        name = column if isinstance(column, str) else column + 1
        raise self.error(f'column {name} must be {legal}, got {str(text)[:40]!r}')


def _nanoseconds(text: str) -> int:
    return round(Decimal(text) * NANOSECONDS)


def _is_stamp(value: int) -> bool:
    return 0 <= value < END_OF_STAMPS_NS


def read_rows(
    path: Path, columns: Sequence[str | int] | None = None, separator: str | None = ','
) -> Iterator[Row]:
    """Read the rows of a text file, without empty lines and those that begin with '#'.

    Parameters
    ----------
    columns
        Columns that each row must have; None takes their names from the first line.
    separator
        ',' also accepts a file whose columns are separated by semicolons. None is white space.

    The file may begin with a byte order mark and have line ends of any system.
    """
    with check_file(path, _MAX_TABLE_BYTES).open(encoding='utf-8-sig', errors='replace') as file:
        for number, words in enumerate(_words(file, separator), start=1):
            if not _is_row(words):
                continue
            if columns is None:
                columns = words
                continue
            row = Row(path, number, dict(zip(columns, words, strict=False)))
            if len(words) != len(columns):
                raise row.error(f'there must be {len(columns)} columns, got {len(words)}')
            yield row


def _words(file: Any, separator: str | None) -> Iterator[list[str]]:
    """Split each line of a file into its words."""
    for line in iter(lambda: file.readline(_MAX_LINE), ''):
        text = line.strip()
        if separator is None:
            yield text.split()
            continue
        if ';' in text:  # as spreadsheets write it where the comma is the decimal sign
            text = text.replace(',', '.').replace(';', ',')
        words = next(csv.reader([text], skipinitialspace=True), [])
        yield [word.strip() for word in words]


def headless_rows(path: Path, fewest: int) -> list[Row]:
    """Read a table without a header line, whose first row has at least `fewest` columns."""
    with check_file(path, _MAX_TABLE_BYTES).open(encoding='utf-8-sig', errors='replace') as file:
        first = next((words for words in _words(file, ',') if _is_row(words)), [])
    return list(read_rows(path, range(max(len(first), fewest))))


def _is_row(words: list[str]) -> bool:
    return any(words) and not words[0].startswith('#')


def read_table(path: Path) -> list[Row]:
    """Read a table whose first line names its columns; MissingInputError if it has no rows."""
    rows = list(read_rows(path))
    if not rows:
        raise MissingInputError(f'{path} has no rows below its first line')
    return rows


def optional_table(path: Path) -> list[Row]:
    """Read a table that may be absent."""
    return read_table(path) if path.is_file() else []


def reals(rows: list[Row], column: str) -> list[float]:
    """Return the numbers of a column, without rows in which it is absent, empty or 'null'."""
    return [row.real(column) for row in rows if row.words.get(column, '') not in ('', 'null')]


def file_inside(folder: Path, row: Row, column: str | int) -> Path:
    """Return the path of a file that a table names; it must not be in another folder."""
    name = Path(row.word(column))
    if name.is_absolute() or '..' in name.parts:
        raise row.error(f'{str(name)[:80]!r} lies outside of the recording')
    return folder / name


def read_object(path: Path) -> dict[str, Any]:
    """Read the object in a JSON file."""
    with check_file(path, _MAX_OBJECT_BYTES).open(encoding='utf-8-sig', errors='replace') as file:
        try:
            value = json.load(file)
        except (ValueError, RecursionError) as error:
            raise InputError(f'{path}: no JSON: {error}') from error
    if not isinstance(value, dict):
        raise InputError(f'{path}: there must be a JSON object')
    return value


def optional_object(path: Path) -> Mapping[str, Any]:
    """Read the object in a JSON file that may be absent."""
    return read_object(path) if path.is_file() else {}


def check_file(path: Path, most_bytes: float = math.inf) -> Path:
    """Return the path of a file: MissingInputError without one, InputError if it is too large."""
    if not path.is_file():
        problem = 'is no regular file' if path.exists() else 'is missing'
        raise MissingInputError(f'{path} {problem}')
    if path.stat().st_size > most_bytes:
        raise InputError(f'{path} has more than {most_bytes} bytes: it is another file')
    return path
