"""One picture of all bags."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rs_relpose_ros.batch.combine import Combined
from rs_relpose_ros.batch.store import Row
from rs_relpose_ros.picture_files import save_picture

PICTURE_FILE = 'overview.png'

_BLUE, _ORANGE, _GREEN, _RED, _GRAY = '#0072B2', '#E69F00', '#009E73', '#D55E00', '0.75'
_MS = 1e3
_NAME_LENGTH = 40
_ROW_HEIGHT = 0.3   # [inch]


def draw(command: str, rows: Sequence[Row], combined: Sequence[Combined], path: Path) -> None:
    """Draw the rows, from top to bottom in their order."""
    figure = Figure(figsize=(10.0, 1.8 + _ROW_HEIGHT * len(rows)), dpi=110, layout='constrained')
    left, right = figure.subplots(1, 2, sharey=True)
    _PICTURES[command](left, right, rows, {one.figure: one for one in combined})
    left.set_yticks(range(len(rows)), [_name(row) for row in rows])
    left.set_ylim(len(rows) - 0.4, -0.6)
    legend: dict[str, Any] = {}
    for axes in (left, right):
        axes.grid(axis='x', color='0.9')
        axes.set_axisbelow(True)
        handles, labels = axes.get_legend_handles_labels()
        legend |= dict(zip(labels, handles, strict=True))
    # Above both, over the room of a title.
    left.set_title(' ', pad=9.0)
    left.legend(legend.values(), legend.keys(), loc='lower left', bbox_to_anchor=(0.0, 1.0),
                ncols=5, fontsize='small', frameon=False).set_in_layout(False)
    save_picture(figure, path)


def _name(row: Row) -> str:
    name = row.name if len(row.name) <= _NAME_LENGTH else f'...{row.name[3 - _NAME_LENGTH:]}'
    return name if row.figures else f'{name} ({row.state.value})'


def _check(left: Axes, right: Axes, rows: Sequence[Row], _: Mapping[str, Combined]) -> None:
    _stack(left, rows, {'ok': _GREEN, 'unknown': _GRAY, 'warning': _ORANGE, 'failure': _RED})
    left.set_xlabel('findings')
    _seconds(right, rows)


def _calibrate(left: Axes, right: Axes, rows: Sequence[Row],
               combined: Mapping[str, Combined]) -> None:
    for axes, figure, label in ((left, 'readout_time_s', 'read-out time [ms]'),
                                (right, 'time_offset_s', 'time offset of row 0 [ms]')):
        axes.set_xlabel(label)
        axes.locator_params(axis='x', nbins=6)
        mean = combined.get(figure)
        if mean is not None:
            axes.axvline(_MS * mean.mean, color=_BLUE, linewidth=1.0)
            axes.axvspan(_MS * (mean.mean - mean.sigma), _MS * (mean.mean + mean.sigma),
                         color=_BLUE, alpha=0.2, label='weighted mean, 1 sigma')
        groups = {'in the mean': _BLUE, 'outlier': _RED, 'not observable': _GRAY}
        for group, colour in groups.items():
            chosen = [(y, row.figures) for y, row in enumerate(rows)
                      if row.figures.get(figure) is not None
                      and _group(row, figure, mean) == group]
            if chosen:
                axes.errorbar([_MS * figures[figure] for _, figures in chosen],
                              [y for y, _ in chosen],
                              xerr=[_MS * figures[f'{figure}_sigma'] for _, figures in chosen],
                              fmt='o', markersize=4, color=colour, label=group)


def _group(row: Row, figure: str, mean: Combined | None) -> str:
    if not row.figures[f'{figure}_observable']:
        return 'not observable'
    return 'outlier' if mean is not None and row.name in mean.outliers else 'in the mean'


def _replay(left: Axes, right: Axes, rows: Sequence[Row], _: Mapping[str, Combined]) -> None:
    answered = [row.figures.get('answered', 0) for row in rows]
    without = [row.figures.get('pairs', 0) - count
               for row, count in zip(rows, answered, strict=True)]
    left.barh(range(len(rows)), answered, color=_BLUE, label='pairs with a pose')
    left.barh(range(len(rows)), without, left=answered, color=_GRAY, label='pairs without')
    left.set_xlabel('pairs')
    if not any(row.figures.get('pairs_with_truth') for row in rows):
        _seconds(right, rows)
        return
    for name, colour in (('rotation', _GREEN), ('translation', _ORANGE)):
        chosen = [(y, row.figures) for y, row in enumerate(rows)
                  if row.figures.get(f'{name}_median_deg') is not None]
        medians = [figures[f'{name}_median_deg'] for _, figures in chosen]
        right.hlines([y for y, _ in chosen], medians,
                     [figures[f'{name}_p90_deg'] for _, figures in chosen], color=colour)
        right.plot(medians, [y for y, _ in chosen], 'o', markersize=4, color=colour,
                   label=f'{name}: median to 90 %')
    right.set_xscale('log')
    right.set_xlabel('error against the truth [deg]')


def _seconds(axes: Axes, rows: Sequence[Row]) -> None:
    axes.barh(range(len(rows)), [row.seconds for row in rows], color=_BLUE)
    axes.set_xlabel('time of the run [s]')


def _stack(axes: Axes, rows: Sequence[Row], colours: Mapping[str, str]) -> None:
    before = [0] * len(rows)
    for name, colour in colours.items():
        counts = [row.figures.get(name, 0) for row in rows]
        axes.barh(range(len(rows)), counts, left=before, color=colour, label=name)
        before = [b + n for b, n in zip(before, counts, strict=True)]


_PICTURES: Mapping[str, Callable[[Axes, Axes, Sequence[Row], Mapping[str, Combined]], None]] = {
    'check': _check, 'calibrate': _calibrate, 'replay': _replay}
