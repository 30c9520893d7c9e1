"""The paper's synthetic two-view problems (its section 'Synthetic Data').

1920x1080 pixels, focal length 640 px, no distortion, 60 us per row; two cameras about 2 m apart,
each turned by up to 10 degrees either way about each axis; about 300 points, 20 m away on average.

What the paper leaves open, and what is done here: the baseline is 2 m along the optical axis of
the world frame (forward) or across it (sideways) plus 0.2 m (1 sigma) per axis; depths in camera 1
are uniform from 6 to 34 m; there are exactly 300 matches; gravity points along +y, downwards in
the image. Linear and angular velocity have the same magnitude on each axis, with random signs, in
the camera's own frame, and the opposite signs in the second camera.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.row_by_row import Motion, see, Shutter, View

Array = NDArray[np.float64]

WIDTH, HEIGHT, FOCAL = 1920, 1080, 640.0
CENTRE = (0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1))
LINE_DELAY = 60e-6
MATCHES = 300

MOTIONS = {'forward': (0.0, 0.0, 2.0), 'sideways': (2.0, 0.0, 0.0)}

_BASELINE_SPREAD = 0.2
_HALF_TURN_RANGE = 10.0
_NEAREST, _FARTHEST = 6.0, 34.0
_DOWN = np.array([0.0, 1.0, 0.0])
# Candidates drawn before a scene without common points is given up.
_MAX_CANDIDATES = 1_000_000


@dataclass(frozen=True, slots=True)
class SceneSettings:
    """One cell of an experiment.

    Attributes
    ----------
    linear_velocity : float
        Of each axis [m/s].
    angular_velocity : float
        Of each axis [rad/s].
    pixel_noise : float
        1 sigma of each coordinate [px].
    gravity_noise : float
        Turn of the measured gravity about each axis, with random signs, opposite in the two
        frames [rad].
    gyro_noise : float
        1 sigma of each axis of each frame's rate [rad/s].
    outliers : float
        Share of the matches that are random.
    constant_velocity : bool
        Both cameras move along the baseline, as one camera does at constant velocity, instead of
        opposite to each other.
    """

    linear_velocity: float = 1.0
    angular_velocity: float = 1.0
    pixel_noise: float = 0.0
    gravity_noise: float = 0.0
    gyro_noise: float = 0.0
    outliers: float = 0.0
    constant_velocity: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What camera and IMU measure, and the truth.

    Attributes
    ----------
    points1, points2 : (N, 2) ndarray
        Matches [px].
    rate1, rate2 : (3,) ndarray
        Measured angular velocities, camera frames [rad/s].
    gravity1, gravity2 : (3,) ndarray
        Measured directions of free fall, camera frames at the first row.
    R : (3, 3) ndarray
        True ``R_1^T R_2``, first rows.
    t : (3,) ndarray
        True ``R_1^T (p_2 - p_1)`` over its length.
    """

    points1: Array
    points2: Array
    rate1: Array
    rate2: Array
    gravity1: Array
    gravity2: Array
    R: Array
    t: Array


def make_scene(settings: SceneSettings, motion: str, seed: int, trial: int) -> Scene:
    """Draw one problem; the same trial of another cell has the same cameras and signs.

    Parameters
    ----------
    settings : SceneSettings
    motion : {'forward', 'sideways'}
    seed, trial : int
    """
    cameras, points, noise = (
        np.random.default_rng([seed, list(MOTIONS).index(motion), trial, part])
        for part in range(3))
    p2 = np.array(MOTIONS[motion]) + _BASELINE_SPREAD * cameras.standard_normal(3)
    turn1, turn2 = (Rotation.from_euler('xyz', angles, degrees=True) for angles in
                    cameras.uniform(-_HALF_TURN_RANGE, _HALF_TURN_RANGE, (2, 3)))
    v_signs, w_signs, g_signs = cameras.choice([-1.0, 1.0], (3, 3))
    v1, w1 = settings.linear_velocity * v_signs, settings.angular_velocity * w_signs
    v2 = -v1
    if settings.constant_velocity:
        along = math.sqrt(3.0) * settings.linear_velocity * p2 / np.linalg.norm(p2)
        v1, v2 = turn1.inv().apply(along), turn2.inv().apply(along)
    pixels1, pixels2 = measured(
        seen_by_both(_uniform_motion(turn1, np.zeros(3), w1, v1),
                     _uniform_motion(turn2, p2, -w1, v2), _VIEW, points),
        _VIEW, settings.pixel_noise, settings.outliers, noise)
    rate1 = w1 + settings.gyro_noise * noise.standard_normal(3)
    rate2 = -w1 + settings.gyro_noise * noise.standard_normal(3)
    tilt = Rotation.from_rotvec(settings.gravity_noise * g_signs)
    t = turn1.inv().apply(p2)
    return Scene(
        pixels1, pixels2, rate1, rate2,
        tilt.apply(turn1.inv().apply(_DOWN)), tilt.inv().apply(turn2.inv().apply(_DOWN)),
        (turn1.inv() * turn2).as_matrix(), t / np.linalg.norm(t))


def _uniform_motion(turn: Rotation, position: Array, w: Array, v: Array) -> Motion:
    """Constant angular and linear velocity, both in the camera's frame at time 0."""
    def at(times: Array) -> tuple[Rotation, Array]:
        return (turn * Rotation.from_rotvec(times[:, None] * w),
                position + times[:, None] * turn.apply(v))
    return at


def _pinhole(local: Array) -> Array:
    with np.errstate(divide='ignore', invalid='ignore'):
        return FOCAL * local[:, :2] / local[:, 2:] + CENTRE


def _directions(pixels: Array) -> Array:
    return np.hstack([(pixels - CENTRE) / FOCAL, np.ones((len(pixels), 1))])


_VIEW = View(_pinhole, _directions, Shutter(WIDTH, HEIGHT, LINE_DELAY, 0.0))


def seen_by_both(motion1: Motion, motion2: Motion, view: View,
                 rng: np.random.Generator) -> tuple[Array, Array]:
    """Pixels (MATCHES, 2) of points that both cameras see, spread over the image of the first.

    Depths in camera 1 are uniform from 6 to 34 m.
    """
    found: list[Array] = []
    count = drawn = 0
    turn1, position1 = motion1(np.zeros(1))
    size = (view.shutter.width - 1, view.shutter.height - 1)
    while count < MATCHES:
        if drawn > _MAX_CANDIDATES:
            raise RuntimeError(f'{count} of {drawn} points are seen by both cameras')
        candidates = 2 * MATCHES
        drawn += candidates
        depth = rng.uniform(_NEAREST, _FARTHEST, (candidates, 1))
        pixels = rng.uniform([0.0, 0.0], size, (candidates, 2))
        world = turn1.apply(depth * view.directions(pixels)) + position1
        both = np.hstack([see(world, motion, view.lens, view.shutter)
                          for motion in (motion1, motion2)])
        both = both[np.isfinite(both).all(axis=1)]
        found.append(both)
        count += len(both)
    together = np.concatenate(found)[:MATCHES]
    return together[:, :2], together[:, 2:]


def measured(points: tuple[Array, Array], view: View, pixel_noise: float, outliers: float,
             rng: np.random.Generator) -> tuple[Array, Array]:
    """Matches with noise, 1 sigma of each coordinate [px]; a share of them are random."""
    points1, points2 = (p + pixel_noise * rng.standard_normal(p.shape) for p in points)
    wrong = rng.permutation(len(points1))[:round(outliers * len(points1))]
    size = (view.shutter.width - 1, view.shutter.height - 1)
    points2[wrong] = rng.uniform([0.0, 0.0], size, (len(wrong), 2))
    return points1, points2
