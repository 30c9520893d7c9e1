"""Cells of an experiment by name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase

from rs_relpose_ros.errors import InputError


def matching_cells(patterns: Iterable[str], names: Mapping[str, object]) -> tuple[str, ...]:
    """Those of the names that match any of the patterns ('all', or with ``*`` as in file names).

    Raises InputError: a pattern matches none.
    """
    chosen: set[str] = set()
    for pattern in patterns:
        matching = {name for name in names if pattern == 'all' or fnmatchcase(name, pattern)}
        if not matching:
            raise InputError(f'no cell is named {pattern!r}; there are {", ".join(names)}')
        chosen |= matching
    return tuple(name for name in names if name in chosen)
