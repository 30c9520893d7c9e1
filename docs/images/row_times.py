"""Draws row_times.png: rows, stamps and offsets, by the package's own clock.

PYTHONPATH=. python docs/images/row_times.py
"""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import ImageClock
from rs_relpose_ros.output_files import save_picture

MS = 1_000_000
HEIGHT, READOUT, EXPOSURE, INTERVAL, OFFSET = 480, 0.020, 0.008, 0.0333, 0.006
ROWS, EXPOSED, STAMPED, CLOCK = '#1f4e79', '#c6d9ec', '#c0392b', '#2e7d32'


def clock(stamp_row: str, stamp_exposure: str, time_offset: float = 0.0) -> ImageClock:
    """Clock of a driver with this convention."""
    camera = RollingShutterCamera(width=640, height=HEIGHT, fx=450.0, fy=450.0, cx=319.5, cy=239.5,
                                  readout_time=READOUT, reference_row=stamp_row)
    return ImageClock(camera, time_offset, stamp_exposure, EXPOSURE)


def exposed_rows(axes: Axes, first_ms: float, label: bool) -> None:
    """The parallelogram of a frame whose row 0 is in mid-exposure at `first_ms`."""
    half, length = 500.0 * EXPOSURE, 1000.0 * READOUT
    axes.fill([first_ms - half, first_ms + half, first_ms + half + length,
               first_ms - half + length], [0, 0, HEIGHT, HEIGHT], color=EXPOSED,
              label='exposure of a row' if label else None)
    axes.plot([first_ms, first_ms + length], [0, HEIGHT], color=ROWS, lw=2,
              label='mid-exposure: the row time' if label else None)


def arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], text: str,
          place: tuple[float, float], color: str = 'black') -> None:
    """A double arrow with its name."""
    axes.annotate('', end, start, arrowprops={'arrowstyle': '<->', 'color': color, 'lw': 1.3,
                                              'shrinkA': 0, 'shrinkB': 0})
    axes.text(*place, text, ha='center', va='center', color=color, fontsize=9,
              bbox={'facecolor': 'white', 'edgecolor': 'none', 'pad': 1.0, 'alpha': 0.85})


def draw_two_frames(axes: Axes) -> None:
    """Stamp, offset, row times and the gyro samples of two frames, on the IMU's clock."""
    driver = clock('first', 'start', OFFSET)
    for k in range(2):
        stamp = 10.0 + 1000.0 * INTERVAL * k
        reference = driver.reference_ns(round(stamp * MS)) / MS
        exposed_rows(axes, reference, label=k == 0)
        axes.plot([stamp, stamp], [-95, HEIGHT + 60], color=STAMPED, ls=':', lw=1.2)
        axes.plot(stamp, -95, 'v', color=STAMPED, ms=9,
                  label='stamp of the driver' if k == 0 else None)
        if k == 0:
            earliest, latest = (reference + 1000.0 * t for t in driver.camera.row_time_span)
            arrow(axes, (stamp, -60), (stamp + 1000 * OFFSET, -60), 'time_offset',
                  (stamp + 500 * OFFSET, -28), STAMPED)
            arrow(axes, (reference - 500 * EXPOSURE, -95), (reference, -95),
                  'exposure_shift', (reference + 5.5, -95), STAMPED)
            arrow(axes, (earliest, HEIGHT + 25), (latest, HEIGHT + 25), 'readout_time',
                  ((earliest + latest) / 2, HEIGHT + 25))
            row = 300
            tau = 1000 * READOUT * row / HEIGHT
            axes.plot([reference, reference], [0, row], color='gray', ls='--', lw=1)
            arrow(axes, (reference, row), (reference + tau, row), 'tau of row v',
                  (reference + tau / 2, row))
    axes.annotate('line_delay: one row later', (36.3, 434), (44.0, 465), fontsize=9,
                  va='center', arrowprops={'arrowstyle': '->'})
    samples = np.arange(2.5, 80.0, 5.0)
    axes.plot(samples, np.full(len(samples), HEIGHT + 60), '|', color=CLOCK, ms=11, mew=2,
              label='gyro samples')
    axes.axhline(HEIGHT + 60, color=CLOCK, lw=0.8)
    axes.set(xlim=(0, 78), ylim=(HEIGHT + 95, -140), xlabel="time on the IMU's clock [ms]",
             ylabel='image row v',
             title='Two frames of a driver that stamps the start of exposure of the first row')
    axes.set_yticks([0, 240, 479])
    axes.legend(loc='upper right', fontsize=8, framealpha=1.0)


def draw_conventions(axes: Axes) -> None:
    """The nine times that a stamp may mark."""
    exposed_rows(axes, 0.0, label=False)
    for row, at, name in (('first', 0, 'first'), ('middle', (HEIGHT - 1) / 2, 'middle'),
                          ('last', HEIGHT - 1, 'last')):
        for exposure, marker in (('start', '>'), ('middle', 'o'), ('end', '<')):
            # Position of the stamp if row 0 is in mid-exposure at 0.
            driver = clock(row, exposure)
            earliest = driver.reference_ns(0) / MS + 1000.0 * driver.camera.row_time_span[0]
            axes.plot(-earliest, at, marker, color=STAMPED, ms=9, clip_on=False,
                      label=f'stamp_exposure: {exposure}' if row == 'first' else None)
        axes.text(-1000 * EXPOSURE, at, f'stamp_row:\n{name}', ha='right', va='center', fontsize=9)
    axes.set(xlim=(-19, 27), ylim=(HEIGHT + 95, -140), xlabel='time from mid-exposure of row 0 '
             '[ms]', title='What a stamp may mark')
    axes.set_yticks([])
    axes.legend(loc='upper right', fontsize=8)


def main() -> None:
    """Write the picture into the folder of this file."""
    figure = Figure(figsize=(12.5, 4.6), layout='constrained')
    left, right = figure.subplots(1, 2, width_ratios=[1.9, 1.0])
    draw_two_frames(left)
    draw_conventions(right)
    save_picture(figure, Path(__file__).with_suffix('.png'))


if __name__ == '__main__':
    main()
