"""A walk that ends as it began: recordings of it can be repeated without a seam.

A recording that is played backwards will not do: its rows would still be those of the motion
forwards.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.simulation.hand_held import EYE_HEIGHT
from rs_relpose_lab.simulation.trajectory import DEGREE, Trajectory

Array = NDArray[np.float64]


def closed_loop(period: float, *, speed: float = 1.5) -> Trajectory:
    """Trajectory from -2 to `period` + 2 seconds that repeats itself after `period`.

    Around an ellipse, half as deep as wide, with the bob of the steps and a hand's turns about
    all axes (30 deg/s rms), looking along x.

    `period`: time of one turn [s].
    `speed`: mean speed along the ellipse [m/s].
    """
    # 25 control points a second: quintic splines through them follow steps of 2 Hz.
    count = round(25 * period)
    phase = 2.0 * math.pi * np.arange(count) / count
    steps = max(round(1.8 * period), 2)
    # Ramanujan's perimeter of an ellipse with half axes 1 and 1/2.
    half_width = speed * period / 4.844
    positions = np.stack([
        0.5 * half_width * np.cos(phase), half_width * np.sin(phase),
        EYE_HEIGHT + 0.03 * np.cos(steps * phase)], axis=1)
    angles = _waves(phase, period, ((1, 0.2), (2, 1.3), (5, 2.1)), 0.45)
    angles = np.stack([angles, _waves(phase, period, ((1, 2.5), (3, 0.4), (6, 5.0)), 0.3),
                       _waves(phase, period, ((2, 4.1), (4, 1.0), (7, 3.0)), 0.2)], axis=1)
    spacing = period / count
    before = math.ceil(2.0 / spacing) + DEGREE
    turns = np.arange(-before, count + before) % count
    return Trajectory(positions[turns], angles[turns], -before * spacing, spacing)


def _waves(phase: Array, period: float, waves: tuple[tuple[int, float], ...],
           rate: float) -> Array:
    """Sum of harmonics (number, phase), each with its share of a rms `rate` [rad/s]."""
    total = np.zeros_like(phase)
    for harmonic, shift in waves:
        amplitude = rate * math.sqrt(2.0 / len(waves)) * period / (2.0 * math.pi * harmonic)
        total += amplitude * np.sin(harmonic * phase + shift)
    return total
