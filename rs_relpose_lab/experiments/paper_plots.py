"""Box plots of errors, on canvases of their own (matplotlib's Agg)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.experiments.paper_methods import METHODS
from rs_relpose_lab.experiments.paper_results import Cell, CellErrors
from rs_relpose_ros.picture_files import save_picture

_DPI = 110
# Colours that are told apart in every kind of colour vision (Okabe and Ito).
_COLORS = ('#999999', '#E69F00', '#56B4E9', '#009E73', '#D55E00', '#0072B2', '#CC79A7', '#F0E442',
           '#000000')
# Errors below this [deg] are rounding; a logarithmic axis must end somewhere.
FLOOR = 1e-5
_LARGEST = 180.0
_GROUP = 0.86
_LOST_COLOR = '#B00000'


def draw_boxes(cells: Mapping[Cell, Mapping[str, CellErrors]], title: str, axis: str,
               path: Path) -> None:
    """Draw one experiment: a row of plots for each case, rotation left and translation right.

    Boxes hold the quartiles, whiskers reach to the 5th and 95th percentiles, dots are beyond. Red
    figures above the boxes say how many estimates are in none, for want of a pose.

    Parameters
    ----------
    cells : mapping
        Of this experiment, as `results.by_cell` gives it.
    title, axis : str
        Of the figure; of the levels.
    path : Path
        PNG file.
    """
    cases = list(dict.fromkeys(cell.case for cell in cells))
    methods = list(next(iter(cells.values())))
    figure = Figure(figsize=(13.0, 1.1 + 3.5 * len(cases)), dpi=_DPI, layout='constrained')
    axes = figure.subplots(len(cases), 2, squeeze=False)
    limits = {side: _limits(cells, side) for side in ('rotation', 'translation')}
    for row, case in zip(axes, cases, strict=True):
        levels = {cell.level: found for cell, found in cells.items() if cell.case == case}
        for plot, side, label in ((row[0], 'rotation', 'rotation error [deg]'),
                                  (row[1], 'translation', 'translation direction error [deg]')):
            _boxes(plot, levels, methods, side, limits[side])
            plot.set_title(case, fontsize=11)
            plot.set_ylabel(label)
            plot.set_xlabel(axis)
    axes[0, 1].legend(handles=[
        Patch(facecolor=color, edgecolor='black', linewidth=0.6, label=METHODS[method].label)
        for method, color in zip(methods, _COLORS, strict=False)],
        loc='upper left', bbox_to_anchor=(1.0, 1.0), fontsize=9)
    figure.suptitle(title, fontsize=13)
    save_picture(figure, path)


def _limits(cells: Mapping[Cell, Mapping[str, CellErrors]], side: str) -> tuple[float, float]:
    """Decades that hold all errors, the same for every plot of a side."""
    errors = np.concatenate([np.empty(0), *(getattr(found, side) for methods in cells.values()
                                            for found in methods.values())])
    if not len(errors):
        return FLOOR, 1.0
    least, most = np.log10(np.maximum([errors.min(), errors.max()], FLOOR))
    low = 10.0**np.floor(least)
    return low, max(min(10.0**np.ceil(most), _LARGEST), 10.0 * low)


def _boxes(plot: Axes, levels: Mapping[str, Mapping[str, CellErrors]], methods: Sequence[str],
           side: str, limits: tuple[float, float]) -> None:
    step = _GROUP / len(methods)
    low, high = limits
    # A strip of a seventh of the height, above all boxes, is for what has no pose.
    top = high * (high / low)**(1.0 / 6.0)
    strip = high * (high / low)**(1.0 / 12.0)
    for k, (method, color) in enumerate(zip(methods, _COLORS, strict=False)):
        values: list[NDArray[np.float64]] = []
        positions = []
        for place, row in enumerate(levels.values()):
            errors = row[method]
            position = place + (k + 0.5) * step - 0.5 * _GROUP
            lost = 1.0 - len(errors.rotation) / errors.trials
            if lost > 0.0:
                plot.text(position, strip, f'{100.0 * lost:.0f} %', rotation=90, fontsize=7,
                          ha='center', va='center', color=_LOST_COLOR)
            if len(errors.rotation):
                values.append(np.maximum(getattr(errors, side), FLOOR))
                positions.append(position)
        if values:
            plot.boxplot(
                values, positions=positions, widths=0.8 * step, whis=(5.0, 95.0),
                patch_artist=True, manage_ticks=False,
                boxprops={'facecolor': color, 'linewidth': 0.6},
                medianprops={'color': 'black', 'linewidth': 1.4},
                whiskerprops={'linewidth': 0.7}, capprops={'linewidth': 0.7},
                flierprops={'marker': '.', 'markersize': 3.5, 'markerfacecolor': color,
                            'markeredgecolor': color})
    plot.set_yscale('log')
    plot.set_ylim(0.7 * low, top)
    decades = 10.0**np.arange(round(np.log10(low)), int(np.floor(np.log10(1.01 * high))) + 1)
    plot.set_yticks(decades, [_tick(decade) for decade in decades])
    if any(len(errors.rotation) < errors.trials for row in levels.values()
           for errors in row.values()):
        plot.text(-0.49, strip, 'no pose:', fontsize=7, va='center', color=_LOST_COLOR)
    plot.set_xticks(range(len(levels)), list(levels))
    plot.set_xlim(-0.5, len(levels) - 0.5)
    plot.axhline(high, color='0.7', linewidth=0.8)
    for border in np.arange(len(levels) - 1) + 0.5:
        plot.axvline(border, color='0.85', linewidth=0.8)
    plot.grid(True, axis='y', color='0.88')
    plot.set_axisbelow(True)


def _tick(decade: float) -> str:
    text = f'{decade:.{max(0, -round(np.log10(decade)))}f}'
    # What is drawn there is that or less.
    return f'≤ {text}' if decade <= 1.01 * FLOOR else text
