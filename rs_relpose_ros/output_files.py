"""Files of results: pictures, and their folder."""

from __future__ import annotations  # Matplotlib is imported where it draws

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
import json
import math
import os
from pathlib import Path
import tempfile
from typing import Any, IO, TYPE_CHECKING

import numpy as np

from rs_relpose_ros.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def save_picture(picture: Figure, path: Path) -> None:
    """Write a plot as PNG on white; the same file for every backend, version and user."""
    import matplotlib as mpl  # takes a second, and a node draws nothing
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with mpl.rc_context({'savefig.facecolor': 'white'}):
        FigureCanvasAgg(picture)
        with written(path, 'wb') as file:
            picture.savefig(file, format=path.suffix[1:], metadata={'Software': None})


# File of the numbers of a run, in the folder of its results. [derived: interface]
SUMMARY_FILE = 'summary.json'
# Colours that are distinguishable in every kind of colour vision. [derived: Okabe and Ito]
BLUE = '#0072B2'
ORANGE = '#E69F00'  # likewise
GREEN = '#009E73'  # likewise
RED = '#D55E00'  # likewise


def json_text(data: Any, indent: int = 2) -> str:
    """Return data as JSON with a line end; NumPy's types are allowed, NaN becomes null."""
    return json.dumps(_plain(data), indent=indent, allow_nan=False) + '\n'


def _plain(data: Any) -> Any:
    """Return data of the types that JSON has."""
    if isinstance(data, np.generic | np.ndarray):
        data = data.tolist()
    if isinstance(data, Mapping):
        return {str(key): _plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(value) for value in data]
    if isinstance(data, float) and not math.isfinite(data):
        return None
    return data


def refuse_existing(*paths: Path) -> None:
    """Raise an InputError if one of the files or folders to be written exists."""
    for path in paths:
        if path.exists():
            raise InputError(f'{path} exists already: remove it or choose another path')


def refuse_unwritable(folder: Path) -> None:
    """Raise an InputError if a folder cannot be created or written; it is not created."""
    nearest = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK):
        return
    problem = 'cannot be written' if nearest.is_dir() else 'is a file'
    raise InputError(f'{nearest} {problem}: choose another directory for the results')


@contextmanager
def written(path: Path, mode: str = 'w') -> Iterator[IO[Any]]:
    """A file that is written beside, line by line, and has its name once it is complete.

    An OSError names it; that of a full disk does not by itself.
    """
    part = path.with_name(f'{path.name}.part')
    text = 'b' not in mode
    try:
        with part.open(
            mode,
            encoding='utf-8' if text else None,
            newline='' if text else None,
            buffering=1 if text else -1,
        ) as file:
            yield file
        part.replace(path)
    except Exception as error:
        with suppress(OSError):
            part.unlink()
        if isinstance(error, OSError):
            raise type(error)(error.errno, error.strerror, str(path)) from error
        raise


def prepare_folder(folder: Path, replaced: Sequence[str]) -> None:
    """Create a folder of results if needed, and remove the files that will be replaced."""
    refuse_unwritable(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in replaced:
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f'{folder} cannot be written: {error.strerror}') from error


@contextmanager
def beside(out: Path) -> Iterator[Path]:
    """Path to write before it is renamed to `out`, so that this appears when it is complete.

    It has the same name, in a temporary folder beside, which is removed with what is left. An
    OSError of writing names `out`.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        temporary = tempfile.TemporaryDirectory(
            prefix=f'.{out.name}.', suffix='.part', dir=out.parent
        )
    except OSError as error:
        raise InputError(f'{out} cannot be written: {error.strerror}') from error
    with temporary as folder:
        try:
            yield Path(folder) / out.name
        except OSError as error:
            if folder in str(error.filename or folder):  # not of an input
                raise type(error)(error.errno, error.strerror, str(out)) from error
            raise
