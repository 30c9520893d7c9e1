"""JSON files, each error with its file and line."""

from __future__ import annotations

from collections.abc import Iterator
from decimal import Decimal
import json
from pathlib import Path
from typing import Any

from rs_relpose_ros.errors import InputError, MissingInputError

# Far above any description of a camera.
_MAX_BYTES = 1 << 24
# Far above a line of a log.
_MAX_LINE = 1 << 16


def read_object(path: Path) -> dict[str, Any]:
    """The object in a JSON file."""
    if not path.is_file():
        raise MissingInputError(f'{path.name} is missing: there is no file {path}')
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(f'{path} has more than {_MAX_BYTES} bytes: it is another file')
    return _object(path.read_text(encoding='utf-8', errors='replace'), str(path), float)


def read_lines(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """The objects of a file with one in each line, and where each stands; numbers as Decimal."""
    if not path.is_file():
        raise MissingInputError(f'{path.name} is missing: there is no file {path}')
    with path.open(encoding='utf-8', errors='replace') as file:
        for number, line in enumerate(iter(lambda: file.readline(_MAX_LINE), ''), start=1):
            if line.strip():
                where = f'{path}, line {number}'
                yield where, _object(line, where, Decimal)


def _object(text: str, where: str, real: type[float] | type[Decimal]) -> dict[str, Any]:
    try:
        value = json.loads(text, parse_float=real)
    except (ValueError, RecursionError) as error:
        raise InputError(f'{where}: no JSON: {error}') from error
    if not isinstance(value, dict):
        raise InputError(f'{where}: there must be a JSON object')
    return value
