"""Random two-view problems with known truth, made by brute force.

Uses NumPy and SciPy only and nothing of the package: the camera moves, each point is projected at
the instant at which its own row is read. The set-up is that of the paper's synthetic experiments:
1920x1080, f = 640 px, 60 us per row, baseline about 2 m, points 6 to 34 m away.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

Noise = Literal['paper', 'gaussian']

WIDTH, HEIGHT = 1920, 1080
FOCAL = 640.0
CENTRE_U, CENTRE_V = 959.5, 539.5
LINE_DELAY = 60e-6

_BASELINES = {'forward': (0.0, 0.0, 2.0), 'sideways': (2.0, 0.0, 0.0)}
_SETTLED = 1e-9  # [px]
_SWEEPS = 30


@dataclass(frozen=True, slots=True)
class Cell:
    """One setting of the experiment; the defaults are the base cell.

    Parameters
    ----------
    direction : {'forward', 'sideways'}
    speed, rate : float
        Linear [m/s] and angular [rad/s] velocity per axis, opposite in the two frames.
    pixel_noise : float
        1 sigma per coordinate [px].
    gravity_noise : float
        Per axis of one frame's direction [deg].
    gyro_noise : float
        1 sigma per axis [deg/s].
    outliers : float
        Share of matches whose second point is anywhere in the image.
    constant_velocity : bool
        Both frames move along the baseline at ``sqrt(3) speed``.
    matches : int
    """

    direction: str = 'forward'
    speed: float = 1.0
    rate: float = 1.0
    pixel_noise: float = 0.5
    gravity_noise: float = 0.2
    gyro_noise: float = 0.1
    outliers: float = 0.3
    constant_velocity: bool = False
    matches: int = 300


_VARIATIONS: dict[str, dict[str, float]] = {
    'base': {},
    'v0-w0': {'speed': 0.0, 'rate': 0.0},
    'v0-w3': {'speed': 0.0, 'rate': 3.0},
    'v5-w1': {'speed': 5.0},
    'v10-w1': {'speed': 10.0},
    'v10-w3': {'speed': 10.0, 'rate': 3.0},
    'constant-velocity': {'constant_velocity': True},
    'pixel-1': {'pixel_noise': 1.0},
    'gravity-1': {'gravity_noise': 1.0},
    'gyro-3': {'gyro_noise': 3.0},
    'outliers-0': {'outliers': 0.0},
    'outliers-50': {'outliers': 0.5},
    'outliers-60': {'outliers': 0.6},
    'v10-w3-outliers-60': {'speed': 10.0, 'rate': 3.0, 'outliers': 0.6},
    'v0-w0-outliers-60': {'speed': 0.0, 'rate': 0.0, 'outliers': 0.6},
}

CELLS = {f'{direction}-{name}': Cell(direction=direction, **changes)  # type: ignore[arg-type]
         for direction in _BASELINES for name, changes in _VARIATIONS.items()}


@dataclass(frozen=True, slots=True, eq=False)
class TwoViewProblem:
    """Matches, what the IMU measures, and the truth; pose and motion refer to row 0.

    Attributes
    ----------
    points1, points2 : (N, 2) ndarray
        Matches [px].
    measured_rate1, measured_rate2 : (3,) ndarray
        Gyro [rad/s], each in its own camera's frame.
    measured_gravity1, measured_gravity2 : (3,) ndarray
        Unit, down, each in its own camera's frame.
    R, t : (3, 3) and (3,) ndarray
        Truth: ``X1 = R X2 + t``, ``|t| = 1``.
    v1, v2 : (3,) ndarray
        True linear velocities, each in its own camera's frame [baselines per second].
    w1, w2 : (3,) ndarray
        True angular velocities, each in its own camera's frame [rad/s].
    gravity1 : (3,) ndarray
        True direction of gravity in camera 1.
    is_outlier : (N,) ndarray of bool
    """

    points1: Array
    points2: Array
    measured_rate1: Array
    measured_rate2: Array
    measured_gravity1: Array
    measured_gravity2: Array
    R: Array
    t: Array
    v1: Array
    v2: Array
    w1: Array
    w2: Array
    gravity1: Array
    is_outlier: NDArray[np.bool_]


def make_problem(cell: Cell, seed: int, noise: Noise = 'paper') -> TwoViewProblem:
    """Draw one problem of a cell.

    Parameters
    ----------
    cell : Cell
    seed : int
        Equal seeds give the same scene in cells that differ in noise only.
    noise : {'paper', 'gaussian'}
        Error of gravity. 'paper': of exactly `gravity_noise` about each axis, with random signs,
        opposite in the two frames. 'gaussian': of that standard deviation about each axis,
        independent in each frame, as a covariance can describe it. The gyro's is Gaussian in both.
    """
    rng = np.random.default_rng(seed)
    baseline = np.array(_BASELINES[cell.direction]) + 0.2 * rng.normal(size=3)
    length = float(np.linalg.norm(baseline))
    attitude1, attitude2 = Rotation.from_euler('xyz', rng.uniform(-10.0, 10.0, (2, 3)),
                                               degrees=True)
    velocity1 = cell.speed * rng.choice([-1.0, 1.0], 3)
    velocity2 = -velocity1
    if cell.constant_velocity:
        along = np.sqrt(3.0) * cell.speed * baseline / length
        velocity1, velocity2 = attitude1.inv().apply(along), attitude2.inv().apply(along)
    rate1 = cell.rate * rng.choice([-1.0, 1.0], 3)
    rate2 = -rate1

    pixels1, pixels2 = np.zeros((0, 2)), np.zeros((0, 2))
    while len(pixels1) < cell.matches:
        world = rng.uniform([-30.0, -18.0, 6.0], [30.0, 18.0, 34.0], (2 * cell.matches, 3))
        seen1, good1 = _project(world, np.zeros(3), attitude1, velocity1, rate1)
        seen2, good2 = _project(world, baseline, attitude2, velocity2, rate2)
        pixels1 = np.concatenate([pixels1, seen1[good1 & good2]])
        pixels2 = np.concatenate([pixels2, seen2[good1 & good2]])
    n = cell.matches
    points1 = pixels1[:n] + cell.pixel_noise * rng.normal(size=(n, 2))
    points2 = pixels2[:n] + cell.pixel_noise * rng.normal(size=(n, 2))
    is_outlier = np.zeros(n, dtype=bool)
    is_outlier[rng.permutation(n)[:round(cell.outliers * n)]] = True
    points2[is_outlier] = rng.uniform(0.0, [WIDTH - 1, HEIGHT - 1], (int(is_outlier.sum()), 2))

    gyro_error1, gyro_error2 = np.radians(cell.gyro_noise) * rng.normal(size=(2, 3))
    if noise == 'paper':
        tilt = rng.choice([-1.0, 1.0], 3)
        tilts = np.array([tilt, -tilt])
    else:
        tilts = rng.normal(size=(2, 3))
    tilt1, tilt2 = Rotation.from_rotvec(np.radians(cell.gravity_noise) * tilts)
    down = np.array([0.0, 1.0, 0.0])
    gravity1, gravity2 = attitude1.inv().apply(down), attitude2.inv().apply(down)
    return TwoViewProblem(
        points1=points1, points2=points2, measured_rate1=rate1 + gyro_error1,
        measured_rate2=rate2 + gyro_error2, measured_gravity1=tilt1.apply(gravity1),
        measured_gravity2=tilt2.apply(gravity2), R=(attitude1.inv() * attitude2).as_matrix(),
        t=attitude1.inv().apply(baseline) / length, v1=velocity1 / length, v2=velocity2 / length,
        w1=rate1, w2=rate2, gravity1=gravity1, is_outlier=is_outlier)


def _project(world: Array, position: Array, attitude: Rotation, velocity: Array, rate: Array,
             ) -> tuple[Array, NDArray[np.bool_]]:
    """Pixels (N, 2) of world points (N, 3), and whether each is seen.

    The row of a point decides when it is seen, and that its row: solved by secants. A point that
    crosses the rows as fast as they are read (it is close, or far from the axis) does not settle
    and is not seen.
    """
    still = attitude.inv().apply(world - position)

    def seen_at(rows: Array) -> tuple[Array, NDArray[np.bool_]]:
        tau = LINE_DELAY * rows[:, None]
        local = Rotation.from_rotvec(-tau * rate).apply(still - tau * velocity)
        ahead = local[:, 2] > 1.0
        plane = local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None]
        return FOCAL * plane + (CENTRE_U, CENTRE_V), ahead

    before = np.full(len(world), CENTRE_V)
    pixels, _ = seen_at(before)
    rows = pixels[:, 1]
    slope = np.zeros(len(world))
    for _ in range(_SWEEPS):
        earlier, (pixels, ahead) = pixels, seen_at(rows)
        change = rows - before
        moved = np.abs(change) > _SETTLED
        slope = np.where(moved, (pixels[:, 1] - earlier[:, 1]) / np.where(moved, change, 1.0),
                         slope)
        settled = np.abs(pixels[:, 1] - rows) < _SETTLED
        slow = np.abs(slope) < 1.0
        inside = ((pixels >= 0.0) & (pixels <= (WIDTH - 1, HEIGHT - 1))).all(axis=1)
        if settled[inside & ahead & slow].all():
            break
        before, rows = rows, np.where(slow, rows + (pixels[:, 1] - rows) / np.where(
            slow, 1.0 - slope, 1.0), pixels[:, 1])
    return pixels, inside & ahead & slow & settled
