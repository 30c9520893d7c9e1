"""Files of results: pictures, and their folder."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
import os
from pathlib import Path
import tempfile

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rs_relpose_ros.config.files import written
from rs_relpose_ros.errors import InputError


def save_picture(picture: Figure, path: Path) -> None:
    """Write a plot as PNG on white; the file is the same for every backend."""
    # Independent of the version of matplotlib and of the user's settings.
    with mpl.rc_context({'savefig.facecolor': 'white'}):
        FigureCanvasAgg(picture)
        with written(path, 'wb') as file:
            picture.savefig(file, format=path.suffix[1:], metadata={'Software': None})


SUMMARY_FILE = 'summary.json'
# Distinguishable in every kind of colour vision (Okabe and Ito).
BLUE, ORANGE, GREEN, RED = '#0072B2', '#E69F00', '#009E73', '#D55E00'


def refuse_unwritable(folder: Path) -> None:
    """Raise an InputError if a folder cannot be created or written; it is not created."""
    nearest = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not nearest.is_dir():
        raise InputError(f'{nearest} is a file: choose another directory for the results')
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f'{nearest} cannot be written: choose another directory for the results')


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

    It has the same name, in a temporary folder beside, which is removed with what is left.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        temporary = tempfile.TemporaryDirectory(prefix=f'.{out.name}.', suffix='.part',
                                                dir=out.parent)
    except OSError as error:
        raise InputError(f'{out} cannot be written: {error.strerror}') from error
    with temporary as folder:
        yield Path(folder) / out.name
