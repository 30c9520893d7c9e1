"""Random two-view problems with known truth: the paper's section 'Synthetic Data'.

1920x1080 pixels, focal length 640 px, no distortion, 60 us per row; two cameras about 2 m apart,
each rotated by up to 10 degrees either way about each axis; about 300 points, 20 m away on
average.
Nothing of the estimator is used: points are projected at the times of their own rows.

What the paper leaves open, and what is done here: the baseline is 2 m along the optical axis of
the world frame (forward) or across it (sideways) plus 0.2 m (1 sigma) per axis; depths are 6 to
34 m; gravity points along +y, downwards in the image. Linear and angular velocity have the same
magnitude on each axis, with random signs, in the camera's own frame, and the opposite signs in
the second camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.simulation.rows import (
    Array,
    in_both_views,
    in_front,
    measured,
    uniform_motion,
    View,
)

Noise = Literal['paper', 'gaussian']

# Width of the paper's images [px]. [derived: section of the synthetic experiments, as the values
# below]
WIDTH = 1920
# Height of these images [px].
HEIGHT = 1080
# Focal length [px].
FOCAL = 640.0
# Column of the principal point [px]. [derived: the middle]
CENTRE_U = 959.5
# Row of the principal point [px]. [derived: the middle]
CENTRE_V = 539.5
# Time from one row to the next [s].
LINE_DELAY = 60e-6

# Projection and row times of this camera, for `rows.observe`.
VIEW = View(
    lambda local: FOCAL * local[:, :2] / local[:, 2:] + (CENTRE_U, CENTRE_V),
    lambda pixels: np.column_stack(
        [(pixels - (CENTRE_U, CENTRE_V)) / FOCAL, np.ones(len(pixels))]
    ),
    WIDTH,
    HEIGHT,
    LINE_DELAY,
    reference_row=0.0,
)

# Movement from the first camera to the second [m]. [derived: the paper]
BASELINES = {'forward': (0.0, 0.0, 2.0), 'sideways': (2.0, 0.0, 0.0)}
# Range of the depths of points [m]. [derived: the paper]
_DEPTHS = 6.0, 34.0


@dataclass(frozen=True, slots=True)
class Cell:
    """One setting of an experiment; the defaults are the base cell of the benchmark."""

    direction: str = 'forward'  # of `BASELINES`
    speed: float = 1.0  # [m/s] per axis, opposite in the frames
    rate: float = 1.0  # [rad/s] likewise
    pixel_noise: float = 0.5  # [px] 1 sigma per axis
    gravity_noise: float = 0.2  # [deg] 1 sigma per axis of one frame's direction
    gyro_noise: float = 0.1  # [deg/s] 1 sigma per axis
    outliers: float = 0.3  # share of matches whose second point is anywhere
    constant_velocity: bool = False  # both frames move along the baseline at ``sqrt(3) speed``
    matches: int = 300
    # Points drawn in a box of the world, or over the image 1.
    placing: Literal['box', 'image'] = 'box'


# Settings by name, as what differs from the base cell. [chosen: one thing at a time, to where an
# estimator fails]
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

CELLS = {
    f'{direction}-{name}': Cell(direction=direction, **changes)  # type: ignore[arg-type]
    for direction in BASELINES
    for name, changes in _VARIATIONS.items()
}


@dataclass(frozen=True, slots=True, eq=False)
class TwoViewProblem:
    """Matches, what the IMU measures, and the truth; pose and motion refer to row 0."""

    points1: Array
    points2: Array
    measured_rate1: Array  # [rad/s] in its own camera's frame, as all of these
    measured_rate2: Array
    measured_gravity1: Array  # unit, down
    measured_gravity2: Array
    R: Array  # truth: ``X1 = R X2 + t``, ``|t| = 1``
    t: Array
    v1: Array  # true velocities in their own frames [baselines per second]
    v2: Array
    w1: Array  # [rad/s]
    w2: Array
    gravity1: Array  # true direction in camera 1
    is_outlier: NDArray[np.bool_]


def make_problem(
    cell: Cell,
    seed: int | Sequence[int],
    noise: Noise = 'paper',
) -> TwoViewProblem:
    """Draw one problem of a cell.

    `seed`: equal seeds give the same cameras in all cells, and the same points in cells that
        differ in noise only.
    `noise` {'paper', 'gaussian'}: error of gravity. 'paper': of exactly `gravity_noise` about each
        axis, with random signs, opposite in the two frames. 'gaussian': of that standard deviation
        about each axis, independent in each frame, as a covariance can describe it. The gyro's is
        Gaussian in both.
    """
    rng = np.random.default_rng(seed)
    baseline = np.array(BASELINES[cell.direction]) + 0.2 * rng.normal(size=3)
    length = float(np.linalg.norm(baseline))
    attitude1, attitude2 = Rotation.from_euler(
        'xyz', rng.uniform(-10.0, 10.0, (2, 3)), degrees=True
    )
    velocity1 = cell.speed * rng.choice([-1.0, 1.0], 3)
    velocity2 = -velocity1
    if cell.constant_velocity:
        along = np.sqrt(3.0) * cell.speed * baseline / length
        velocity1 = attitude1.inv().apply(along)
        velocity2 = attitude2.inv().apply(along)
    rate1 = cell.rate * rng.choice([-1.0, 1.0], 3)
    rate2 = -rate1

    def candidates() -> Array:
        count = 2 * cell.matches
        if cell.placing == 'image':
            return in_front(VIEW, attitude1, np.zeros(3), count, _DEPTHS, rng)
        return rng.uniform([-30.0, -18.0, _DEPTHS[0]], [30.0, 18.0, _DEPTHS[1]], (count, 3))

    exact = in_both_views(
        candidates,
        uniform_motion(attitude1, np.zeros(3), rate1, velocity1),
        uniform_motion(attitude2, baseline, rate2, velocity2),
        VIEW,
        cell.matches,
    )
    points1, points2, is_outlier = measured(exact, VIEW, cell.pixel_noise, cell.outliers, rng)
    gyro_error1, gyro_error2 = np.radians(cell.gyro_noise) * rng.normal(size=(2, 3))
    if noise == 'paper':
        tilt = rng.choice([-1.0, 1.0], 3)
        tilts = np.array([tilt, -tilt])
    else:
        tilts = rng.normal(size=(2, 3))
    tilt1, tilt2 = Rotation.from_rotvec(np.radians(cell.gravity_noise) * tilts)
    down = np.array([0.0, 1.0, 0.0])
    gravity1 = attitude1.inv().apply(down)
    gravity2 = attitude2.inv().apply(down)
    return TwoViewProblem(
        points1=points1,
        points2=points2,
        measured_rate1=rate1 + gyro_error1,
        measured_rate2=rate2 + gyro_error2,
        measured_gravity1=tilt1.apply(gravity1),
        measured_gravity2=tilt2.apply(gravity2),
        R=(attitude1.inv() * attitude2).as_matrix(),
        t=attitude1.inv().apply(baseline) / length,
        v1=velocity1 / length,
        v2=velocity2 / length,
        w1=rate1,
        w2=rate2,
        gravity1=gravity1,
        is_outlier=is_outlier,
    )
