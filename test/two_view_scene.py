"""Random two-view problems, independent of the package's geometry: cameras of the laboratory.

The paper's set-up: 1920x1080, f = 640 px, 60 us per row, baseline about 2 m, points 6 to 34 m
away, velocities opposite in the two frames.
"""

from dataclasses import make_dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.problems import BASELINES, HEIGHT, LINE_DELAY, VIEW, WIDTH
from rs_relpose_lab.simulation.rows import in_both_views, measured, uniform_motion

SIZE = (WIDTH - 1, HEIGHT - 1)
GRAVITY_NOISE = np.radians(0.2)
GYRO_NOISE = np.radians(0.1)
DOWN = np.array([0.0, 1.0, 0.0])

# Matches in pixels, measurements of the IMU, and the truth (velocities in baselines/s).
TwoViewScene = make_dataclass(
    'TwoViewScene',
    (
        'points1',
        'points2',
        'measured_rate1',
        'measured_rate2',
        'measured_gravity1',
        'measured_gravity2',
        'R',
        't',
        'v1',
        'v2',
        'w1',
        'w2',
        'is_outlier',
    ),
    frozen=True,
)
# K problems of n exact matches each; the truth in their own units (|t| = 1). `rays*` (K, n, 3) as
# measured; `derotated*` the same in the camera's orientation at tau 0; row times `tau*` (K, n);
# `gravity*`, `t`, `v*`, `w*` (K, 3); `R` (K, 3, 3).
MinimalProblems = make_dataclass(
    'MinimalProblems',
    (
        'rays1',
        'rays2',
        'derotated1',
        'derotated2',
        'tau1',
        'tau2',
        'gravity1',
        'gravity2',
        'R',
        't',
        'v1',
        'v2',
        'w1',
        'w2',
    ),
    frozen=True,
)


def make_scene(
    seed,
    *,
    n=300,
    direction='forward',
    speed=1.0,
    rate=1.0,
    pixel_noise=0.5,
    gravity_noise=GRAVITY_NOISE,
    gyro_noise=GYRO_NOISE,
    outliers=0.3,
    constant_velocity=False,
    pure_rotation=False,
    on_a_line=False,
    reference='first',
):
    """Draw one problem.

    `speed` [m/s] and `rate` [rad/s] are per axis; `gravity_noise` [rad] per axis and opposite in
    the frames; `gyro_noise` [rad/s] 1 sigma; `on_a_line`: all points lie on one line in space;
    `reference` the row that pose and motion refer to.
    """
    rng = np.random.default_rng(seed)
    reference_rows = {'first': 0.0, 'middle': (HEIGHT - 1) / 2, 'last': HEIGHT - 1.0}
    view = replace(VIEW, reference_row=reference_rows[reference])
    p2 = BASELINES[direction] + rng.normal(size=3) * 0.2
    if pure_rotation:
        p2 = np.zeros(3)
        speed = 0.0
    R1, R2 = Rotation.from_euler('xyz', rng.uniform(-10, 10, (2, 3)), degrees=True)
    v1 = speed * rng.choice([-1.0, 1.0], 3)
    v2 = -v1
    if constant_velocity:
        velocity = speed * np.sqrt(3.0) * p2 / np.linalg.norm(p2)
        v1 = R1.inv().apply(velocity)
        v2 = R2.inv().apply(velocity)
    w1 = rate * rng.choice([-1.0, 1.0], 3)
    w2 = -w1
    ends = rng.uniform([-4, -2, 8], [4, 2, 20], (2, 3)) if on_a_line else None

    def candidates():
        if on_a_line:
            return ends[0] + rng.uniform(size=(8 * n, 1)) * (ends[1] - ends[0])
        return rng.uniform([-30, -18, 6], [30, 18, 34], (8 * n, 3))

    motion1 = uniform_motion(R1, np.zeros(3), w1, v1)
    motion2 = uniform_motion(R2, p2, w2, v2)
    exact = in_both_views(candidates, motion1, motion2, view, n)
    points1, points2, is_outlier = measured(exact, view, pixel_noise, outliers, rng)
    length = np.linalg.norm(p2) if not pure_rotation else 1.0
    tilt = Rotation.from_rotvec(gravity_noise * rng.choice([-1.0, 1.0], 3))
    return TwoViewScene(
        points1,
        points2,
        w1 + rng.normal(size=3) * gyro_noise,
        w2 + rng.normal(size=3) * gyro_noise,
        tilt.apply(R1.inv().apply(DOWN)),
        tilt.inv().apply(R2.inv().apply(DOWN)),
        (R1.inv() * R2).as_matrix(),
        R1.inv().apply(p2) / length,
        v1 / length,
        v2 / length,
        w1,
        w2,
        is_outlier,
    )


def make_minimal_problems(
    seed, count, n, *, speed=(0.0, 10.0), rate=(0.0, 3.0), constant_velocity=False, turned=False
):
    """Draw problems of the same set-up, half of them forward and half sideways, without noise.

    `speed` [m/s] and `rate` [rad/s] are ranges of what each axis has. Row times count from the
    first row. `turned` gives each camera a frame of its own, turned by any rotation: the relative
    rotation, and gravity in either frame, are then anything. Rays are consistent with their row
    times to rounding, however far the search for the row has come.
    """
    rng = np.random.default_rng(seed)
    p2 = np.where(np.arange(count)[:, None] % 2, BASELINES['sideways'], BASELINES['forward'])
    p2 = p2 + rng.normal(size=(count, 3)) * 0.2
    R1, R2 = (
        Rotation.from_euler('xyz', rng.uniform(-10, 10, (count, 3)), degrees=True)
        for _ in range(2)
    )
    v1, w1 = (
        rng.uniform(*size, (count, 1)) * rng.choice([-1.0, 1.0], (count, 3))
        for size in (speed, rate)
    )
    v2 = -v1
    w2 = -w1
    length = np.linalg.norm(p2, axis=1, keepdims=True)
    if constant_velocity:
        velocity = np.linalg.norm(v1, axis=1, keepdims=True) * p2 / length
        v1 = R1.inv().apply(velocity)
        v2 = R2.inv().apply(velocity)
    owner = np.repeat(np.arange(count), n)
    rays1, tau1, rays2, tau2 = _exact_rays(rng, owner, (R1, w1, v1), (R2, p2, w2, v2))
    Q1, Q2 = (
        Rotation.random(count, random_state=rng) if turned else Rotation.identity(count)
        for _ in range(2)
    )
    derotated = [
        Rotation.from_rotvec(tau[:, None] * w[owner]).apply(rays)
        for tau, w, rays in ((tau1, w1, rays1), (tau2, w2, rays2))
    ]
    rays = [
        Q[owner].apply(f).reshape(count, n, 3) / np.linalg.norm(f, axis=1).reshape(count, n, 1)
        for Q, f in zip((Q1, Q2, Q1, Q2), (rays1, rays2, *derotated), strict=True)
    ]
    return MinimalProblems(
        *rays,
        tau1.reshape(count, n),
        tau2.reshape(count, n),
        (Q1 * R1.inv()).apply(DOWN),
        (Q2 * R2.inv()).apply(DOWN),
        (Q1 * R1.inv() * R2 * Q2.inv()).as_matrix(),
        (Q1 * R1.inv()).apply(p2 / length),
        Q1.apply(v1 / length),
        Q2.apply(v2 / length),
        Q1.apply(w1),
        Q2.apply(w2),
    )


def _exact_rays(rng, owner, first, second):
    """Rays (N, 3) and row times (N,) of points in both views of the problems `owner` (N,).

    `first` has the rotations, rates and velocities of the first cameras, `second` has rotations,
    positions, rates and velocities of the second ones.
    """
    R1, w1, v1 = first
    R2, p2, w2, v2 = second
    rays1, rays2 = np.empty((2, len(owner), 3))
    tau1, tau2 = np.empty((2, len(owner)))
    missing = np.arange(len(owner))
    while len(missing):
        k = owner[missing]
        pixels = rng.uniform([0, 0], SIZE, (len(k), 2))
        a = VIEW.unproject(pixels)
        tau = pixels[:, 1] * LINE_DELAY
        turn = R1[k] * Rotation.from_rotvec(tau[:, None] * w1[k])
        depths = rng.uniform(6, 34, (len(k), 1))
        world = turn.apply(depths * a) + tau[:, None] * R1[k].apply(v1[k])
        motion = uniform_motion(R2[k], p2[k], w2[k], v2[k])
        rows = np.full(len(k), HEIGHT / 2)
        for _ in range(15):
            later = rows * LINE_DELAY
            b = motion(world, later)
            pixels = VIEW.project(b)
            rows = pixels[:, 1]
        inside = ((pixels >= 0) & (pixels <= SIZE)).all(axis=1)
        observed = inside & (b[:, 2] > 1.0)
        found = missing[observed]
        rays1[found] = a[observed]
        tau1[found] = tau[observed]
        rays2[found] = b[observed]
        tau2[found] = later[observed]
        missing = missing[~observed]
    return rays1, tau1, rays2, tau2


def rotation_error(R, truth):
    """Degrees between two rotation matrices."""
    return np.degrees(np.linalg.norm(Rotation.from_matrix(R.T @ truth).as_rotvec()))


def direction_error(t, truth):
    """Degrees between two directions; 180 for opposite ones."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(t, truth)), t @ truth))
