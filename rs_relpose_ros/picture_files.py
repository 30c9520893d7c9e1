"""How matplotlib figures become files."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def save_picture(figure: Figure, path: Path) -> None:
    """Write a figure as PNG on white; equal figures are equal files, whatever draws them."""
    # Without the version of matplotlib in it, and without its user's settings.
    with mpl.rc_context({'savefig.facecolor': 'white'}):
        FigureCanvasAgg(figure)
        figure.savefig(path, metadata={'Software': None})
