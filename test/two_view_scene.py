"""Random two-view problems by brute force: SciPy only, nothing of the package's geometry.

The paper's set-up: 1920x1080, f = 640 px, 60 us per row, baseline about 2 m, points 6 to 34 m
away, velocities opposite in the two frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT, FOCAL, CENTRE = 1920, 1080, 640.0, (959.5, 539.5)
LINE_DELAY = 60e-6
GRAVITY_NOISE, GYRO_NOISE = np.radians(0.2), np.radians(0.1)


@dataclass(frozen=True)
class TwoViewScene:
    """Matches in pixels, what the IMU measures, and the truth (velocities in baselines/s)."""

    points1: NDArray[np.float64]
    points2: NDArray[np.float64]
    measured_rate1: NDArray[np.float64]
    measured_rate2: NDArray[np.float64]
    measured_gravity1: NDArray[np.float64]
    measured_gravity2: NDArray[np.float64]
    R: NDArray[np.float64]
    t: NDArray[np.float64]
    v1: NDArray[np.float64]
    v2: NDArray[np.float64]
    w1: NDArray[np.float64]
    w2: NDArray[np.float64]
    is_outlier: NDArray[np.bool_]


def project(world, R, p, w, v, reference_row):
    """Pixels and depths of world points (N, 3) seen by a camera that moves while it reads rows."""
    rows = np.full(len(world), HEIGHT / 2)
    for _ in range(60):
        tau = (rows - reference_row) * LINE_DELAY
        turn = Rotation.from_matrix(R) * Rotation.from_rotvec(tau[:, None] * w)
        local = turn.inv().apply(world - p - tau[:, None] * (R @ v))
        pixels = FOCAL * local[:, :2] / local[:, 2:] + CENTRE
        settled = np.abs(pixels[:, 1] - rows) < 1e-9
        rows = pixels[:, 1]
    return pixels, local[:, 2], settled


def make_scene(seed, *, n=300, direction='forward', speed=1.0, rate=1.0, pixel_noise=0.5,
               gravity_noise=GRAVITY_NOISE, gyro_noise=GYRO_NOISE, outliers=0.3,
               constant_velocity=False, pure_rotation=False, reference='first'):
    """Draw one problem.

    `speed` [m/s] and `rate` [rad/s] are per axis; `gravity_noise` [rad] per axis and opposite in
    the frames; `gyro_noise` [rad/s] 1 sigma; `reference` the row that pose and motion refer to.
    """
    rng = np.random.default_rng(seed)
    reference_row = {'first': 0.0, 'middle': (HEIGHT - 1) / 2, 'last': HEIGHT - 1.0}[reference]
    baseline = {'forward': [0.0, 0.0, 2.0], 'sideways': [2.0, 0.0, 0.0]}[direction]
    p2 = np.array(baseline) + rng.normal(size=3) * 0.2
    if pure_rotation:
        p2, speed = np.zeros(3), 0.0
    R1, R2 = (Rotation.from_euler('xyz', rng.uniform(-10, 10, 3), degrees=True).as_matrix()
              for _ in range(2))
    v1 = speed * rng.choice([-1.0, 1.0], 3)
    v2 = -v1
    if constant_velocity:
        velocity = speed * np.sqrt(3.0) * p2 / np.linalg.norm(p2)
        v1, v2 = R1.T @ velocity, R2.T @ velocity
    w1 = rate * rng.choice([-1.0, 1.0], 3)
    w2 = -w1
    found1, found2 = [], []
    while sum(map(len, found1)) < n:
        world = rng.uniform([-30, -18, 6], [30, 18, 34], (8 * n, 3))
        a, za, settled_a = project(world, R1, np.zeros(3), w1, v1, reference_row)
        b, zb, settled_b = project(world, R2, p2, w2, v2, reference_row)
        size = [WIDTH - 1, HEIGHT - 1]
        seen = (za > 1) & (zb > 1) & settled_a & settled_b
        seen &= ((a >= 0) & (b >= 0) & (a <= size) & (b <= size)).all(axis=1)
        found1.append(a[seen])
        found2.append(b[seen])
    points1 = np.concatenate(found1)[:n] + rng.normal(size=(n, 2)) * pixel_noise
    points2 = np.concatenate(found2)[:n] + rng.normal(size=(n, 2)) * pixel_noise
    is_outlier = np.zeros(n, dtype=bool)
    is_outlier[rng.permutation(n)[:int(outliers * n)]] = True
    points2[is_outlier] = rng.uniform([0, 0], size, (is_outlier.sum(), 2))
    length = np.linalg.norm(p2) if not pure_rotation else 1.0
    tilt = Rotation.from_rotvec(gravity_noise * rng.choice([-1.0, 1.0], 3))
    down = np.array([0.0, 1.0, 0.0])
    return TwoViewScene(
        points1, points2, w1 + rng.normal(size=3) * gyro_noise,
        w2 + rng.normal(size=3) * gyro_noise, tilt.apply(R1.T @ down),
        tilt.inv().apply(R2.T @ down), R1.T @ R2, R1.T @ p2 / length, v1 / length, v2 / length,
        w1, w2, is_outlier)


def rotation_error(R, truth):
    """Degrees between two rotation matrices."""
    return np.degrees(np.linalg.norm(Rotation.from_matrix(R.T @ truth).as_rotvec()))


def direction_error(t, truth):
    """Degrees between two directions; 180 for opposite ones."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(t, truth)), t @ truth))
