"""Pixels of points in a moving rolling-shutter camera: each at the time of its own row.

It uses nothing of the estimator's geometry, so that an error in one cannot hide behind the same
error in the other.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

# Points (N, 3) of the world [m] and times (N,) [s] -> points (N, 3) in the camera frame at each
# one's time. Time 0 is that of the reference row.
Motion = Callable[[Array, Array], Array]

# Distance of the assumed row from the projected one at which the row is found [px]. [chosen: far
# below the noise of any match, above rounding]
_SETTLED_ROWS = 1e-9
# Rounds after which the row of a point is given up: secants settle in a few. [chosen: any value
# in 10..100 would do]
_MAX_ROUNDS = 30
# A nearer point does not appear in an image [m]. [chosen: no scene has one]
_LEAST_DEPTH = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Projection of a camera at rest, and its row times."""

    project: Callable[[Array], Array]  # points (N, 3) to pixels (N, 2); NaN outside of the lens
    unproject: Callable[[Array], Array]  # pixels (N, 2) to directions (N, 3) of any length
    width: int
    height: int
    line_delay: float  # from one row of the sensor to the next [s]
    reference_row: float  # that is read at time 0
    axis: int = 1  # pixel coordinate that is the row of the sensor, 1 (v) or 0 (u)

    @property
    def rows(self) -> int:
        """Number of rows of the sensor."""
        return self.height if self.axis == 1 else self.width


def uniform_motion(attitude: Rotation, position: Array, rate: Array, velocity: Array) -> Motion:
    """Constant angular [rad/s] and linear velocity [m/s], both in the camera's frame at time 0.

    ``x(t) = Exp(-t w) (R_0^T (X - p_0) - t v)``
    """

    def to_camera(world: Array, times: Array) -> Array:
        moved = attitude.inv().apply(world - position) - times[:, None] * velocity
        return np.asarray(Rotation.from_rotvec(-times[:, None] * rate).apply(moved))

    return to_camera


def observe(world: Array, motion: Motion, view: View, margin: float = 0.0) -> Array:
    """Pixels of points in a camera that moves while it reads its rows.

    A point appears in row v if it is projected into row v from the camera's pose at the time of
    that row: a root of ``projected_row(v) - v``, found by secants.

    `margin`: distance beyond the centres of the outermost pixels at which a point still counts as
        inside [px].
    Returns pixels; NaN for a point outside of the image or nearer than 0.1 m, and for one that
        crosses the rows as fast as they are read, whose row is not unique.
    """

    def project(which: NDArray[np.intp], rows: Array) -> Array:
        local = motion(world[which], (rows - view.reference_row) * view.line_delay)
        with np.errstate(divide='ignore', invalid='ignore'):
            return np.where(local[:, 2:] > _LEAST_DEPTH, view.project(local), np.nan)

    observed = np.full((len(world), 2), np.nan)
    left = np.arange(len(world))
    before = np.full(len(world), 0.5 * (view.rows - 1))
    projected = project(left, before)[:, view.axis]
    ahead = np.isfinite(projected)
    left = left[ahead]
    before = before[ahead]
    projected = projected[ahead]
    rows = projected
    slope = np.zeros(len(left))
    for _ in range(_MAX_ROUNDS):
        if not len(left):
            break
        # A row far outside only means "not in the image"; the motion need not cover its time.
        rows = np.clip(rows, -view.rows, 2 * view.rows)
        pixels = project(left, rows)
        appears = pixels[:, view.axis]
        change = rows - before
        moved = np.abs(change) > _SETTLED_ROWS
        secant = (appears - projected) / np.where(moved, change, 1.0)
        slope = np.where(moved, secant, slope)
        slow = np.abs(slope) < 1.0
        settled = np.abs(appears - rows) < _SETTLED_ROWS
        observed[left[settled & slow]] = pixels[settled & slow]
        # From the last of those rows it is still further outside: it appears in no row.
        beyond_first = (rows <= -view.rows) & (appears < rows)
        beyond_last = (rows >= 2 * view.rows) & (appears > rows)
        again = ~settled & ~beyond_first & ~beyond_last & np.isfinite(appears)
        left = left[again]
        before = rows[again]
        projected = appears[again]
        slope = slope[again]
        divisors = np.where(slow[again], 1.0 - slope, 1.0)
        rows = before + (projected - before) / divisors
    last = np.array([view.width - 1, view.height - 1])
    inside = (observed >= -margin) & (observed <= last + margin)
    observed[~inside.all(axis=1)] = np.nan
    return observed


def in_front(
    view: View,
    attitude: Rotation,
    position: Array,
    count: int,
    depths: tuple[float, float],
    rng: np.random.Generator,
) -> Array:
    """World points (count, 3) spread evenly over the image of a camera at rest.

    `depths` [m]: range from which each point's depth is drawn.
    """
    depth = rng.uniform(*depths, (count, 1))
    pixels = rng.uniform([0.0, 0.0], (view.width - 1, view.height - 1), (count, 2))
    rays = view.unproject(pixels)
    return np.asarray(attitude.apply(depth * rays / rays[:, 2:]) + position)


def in_both_views(
    candidates: Callable[[], Array], motion1: Motion, motion2: Motion, view: View, count: int
) -> tuple[Array, Array]:
    """Pixels (count, 2) in each of two cameras of the first `candidates` inside both images."""
    most = 1_000_000
    pixels = np.empty((0, 4))
    drawn = 0
    while len(pixels) < count:
        if drawn > most:
            raise RuntimeError(f'{len(pixels)} of {drawn} points are inside both images')
        world = candidates()
        drawn += len(world)
        both = np.hstack([observe(world, motion, view) for motion in (motion1, motion2)])
        pixels = np.concatenate([pixels, both[np.isfinite(both).all(axis=1)]])
    return pixels[:count, :2], pixels[:count, 2:]


def measured(
    points: tuple[Array, Array],
    view: View,
    sigma: float,
    outliers: float,
    rng: np.random.Generator,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Matches with noise, 1 sigma of each coordinate [px], and which of them are random."""
    points1, points2 = (exact + sigma * rng.standard_normal(exact.shape) for exact in points)
    is_outlier = np.zeros(len(points1), dtype=bool)
    is_outlier[rng.permutation(len(points1))[: round(outliers * len(points1))]] = True
    points2[is_outlier] = rng.uniform(
        0.0, [view.width - 1, view.height - 1], (int(is_outlier.sum()), 2)
    )
    return points1, points2, is_outlier
