"""Folders of results: their making, and names of files that more than one command knows."""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path

from rs_relpose_ros.errors import InputError

SUMMARY_FILE = 'summary.json'


def refuse_unwritable(folder: Path) -> None:
    """Raise an InputError where a folder cannot be written, or cannot be made; nothing is made."""
    nearest = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not nearest.is_dir():
        raise InputError(f'{nearest} is a file: choose another directory for the results')
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f'{nearest} cannot be written: choose another directory for the results')


def prepare_folder(folder: Path, replaced: Sequence[str]) -> None:
    """Create a folder of results as needed, and remove the files that will be replaced."""
    refuse_unwritable(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in replaced:
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f'{folder} cannot be written: {error.strerror}') from error
