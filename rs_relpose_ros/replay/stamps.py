"""Files of frame stamps, one integer [ns] per line, as the node's `stamps_file` writes them."""

from __future__ import annotations

from pathlib import Path

from rs_relpose_ros.errors import InputError, MissingInputError


def read_stamps(path: Path | str) -> frozenset[int]:
    """Stamps [ns] of a file; empty lines do not count.

    Raises
    ------
    InputError, MissingInputError
        No such file, a line that is no integer, or no stamp at all.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingInputError(f'there is no file of stamps {path}')
    stamps = set()
    with path.open(encoding='utf-8', errors='replace') as file:
        for number, line in enumerate(file, start=1):
            text = line.strip()
            if not text:
                continue
            # A table of poses will not do: the frames between keyframes move the tracks as well.
            if not text.isascii() or not text.isdigit():
                raise InputError(
                    f'{path}, line {number}: {text[:40]!r} is no stamp; the file must have one '
                    'integer [ns] per line, as the parameter stamps_file of the node writes it')
            stamps.add(int(text))
    if not stamps:
        raise InputError(f'{path} has no stamps')
    return frozenset(stamps)
