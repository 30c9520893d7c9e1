"""Folders of Android loggers: each is known by its files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rs_relpose_ros.convert import jsonl, mars, phone_tables, posecam
from rs_relpose_ros.convert.recording import Conversion
from rs_relpose_ros.errors import MissingInputError


@dataclass(frozen=True, slots=True)
class Logger:
    """A logger, the files by which its folders are known, and how they are read."""

    name: str
    files: tuple[str, ...]
    read: Callable[[Path], Conversion]


LOGGERS = (
    Logger('PoseCam', posecam.FILES, posecam.read_conversion),
    Logger('MARS Logger', mars.FILES, mars.read_conversion),
    Logger('data.jsonl', jsonl.FILES, jsonl.read_conversion),
    Logger('tables', phone_tables.FILES, phone_tables.read_conversion),
)


def read_conversion(folder: Path) -> Conversion:
    """A recording by whichever logger it is of; MissingInputError where none knows it."""
    for logger in LOGGERS:
        if all((folder / name).exists() for name in logger.files):
            return logger.read(folder)
    known = '; '.join(f'{", ".join(logger.files)} ({logger.name})' for logger in LOGGERS)
    raise MissingInputError(f'{folder} is of no known logger, by its files: {known}')
