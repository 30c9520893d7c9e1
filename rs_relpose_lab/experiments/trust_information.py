"""In which seconds a motion can tell a wrong figure, by the laboratory and not by the product.

For each pair of a run that was told right: unknowns x (rotation, direction of translation, both
velocities), calibration c (`FIGURES`, the offset at the middle row), residuals of the matches and
priors of velocity and of the rotation by the gyro. At the truth, by finite differences:

    S = J_c^T W J_c - J_c^T W J_x (J_x^T W J_x)^-1 J_x^T W J_c        summed over a second

Nothing of `rs_relpose_ros.estimator` or `rs_relpose_ros.health` is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.trust_rows import FIGURES, Injected
from rs_relpose_ros.geometry.camera import RollingShutterCamera

Array = NDArray[np.float64]

_ENDS = dict(zip(FIGURES, accumulate(FIGURES.values()), strict=True))
PLACES: Mapping[str, slice] = {name: slice(end - FIGURES[name], end)
                               for name, end in _ENDS.items()}
_UNKNOWNS = 11   # x: rotation, direction of translation, velocities
_FREE = sum(FIGURES.values())
# Steps of the finite differences, and what is known of each figure before any motion, 1 sigma.
_STEPS = np.repeat([1e-5, 1e-5, 1e-5, 1e-5, 1e-5, 1e-5, 1e-5], list(FIGURES.values()))
_BEFORE = np.repeat([0.5, 0.1, 0.05, 0.1, 0.2, 0.3, 0.3], list(FIGURES.values()))
# Velocities differ from t / interval by so many baselines per second, 1 sigma.
_VELOCITY_SIGMA = 1.0
# Least noise of a match [px] and of a rotation by the gyro [rad]: no model is better.
_LEAST_PIXEL, _LEAST_TURN = 0.05, 3e-4
# An injected error must be so many times its sigma.
TELLING = 5.0
# Matches of a pair that are used, at most.
_MOST_MATCHES = 150


class TruePair(NamedTuple):
    """A pair with its true pose: ``X1 = R X2 + t`` of the middle rows, |t| = 1.

    `pixels1`, `pixels2` (N, 2): of the inliers, on the sensor; `sigma` [px]: of a match.
    `rates1`, `rates2` (N, 3): mean true rate [rad/s] from the middle row to each match's row;
    `rate1`, `rate2` (3,): at the middle rows. All rates are in the camera frame.
    """

    pixels1: Array
    pixels2: Array
    R: Array
    t: Array
    interval: float
    rates1: Array
    rates2: Array
    rate1: Array
    rate2: Array
    sigma: float
    gyro_noise_density: float


class PairInformation(NamedTuple):
    """`figures` (11, 11) about c; `turn` (3, 3): outer product of the turn, in sigmas."""

    figures: Array
    turn: Array


def pair_information(pair: TruePair, camera: RollingShutterCamera) -> PairInformation:
    """What a pair tells about the figures, and how far it turned."""
    residuals = _Residuals(pair, camera)
    zero = np.zeros(_UNKNOWNS + _FREE)
    at_truth = residuals(zero)
    steps = np.concatenate([np.full(_UNKNOWNS, 1e-5), _STEPS])
    jacobian = np.column_stack([
        (residuals(zero + step * unit) - at_truth) / step
        for step, unit in zip(steps, np.eye(len(zero)), strict=True)])
    by_x, by_c = jacobian[:, :_UNKNOWNS], jacobian[:, _UNKNOWNS:]
    H, mixed = by_x.T @ by_x, by_x.T @ by_c
    # By the images alone, without the last three residuals, which are the gyro's.
    seen = by_x[:-3].T @ by_x[:-3]
    of_turn = np.linalg.inv(np.linalg.inv(seen)[:3, :3])
    turn = Rotation.from_matrix(pair.R).as_rotvec()
    length = math.sqrt(float(turn @ of_turn @ turn)) / max(float(np.linalg.norm(turn)), 1e-9)
    return PairInformation(by_c.T @ by_c - mixed.T @ np.linalg.solve(H, mixed),
                           length**2 * np.outer(turn, turn))


class _Residuals:
    """Residuals, each by its sigma, of matches, velocities and gyro around the truth."""

    def __init__(self, pair: TruePair, camera: RollingShutterCamera) -> None:
        chosen = slice(None, None, -(-len(pair.pixels1) // _MOST_MATCHES))
        self._pair = pair._replace(pixels1=pair.pixels1[chosen], pixels2=pair.pixels2[chosen],
                                   rates1=pair.rates1[chosen], rates2=pair.rates2[chosen])
        # Each match stands for those that were left out.
        self._sigma = max(pair.sigma, _LEAST_PIXEL) * math.sqrt(
            len(self._pair.pixels1) / len(pair.pixels1))
        self._camera = camera
        self._tangent = np.linalg.svd(pair.t[None])[2][1:]
        self._turn_sigma = math.hypot(
            _LEAST_TURN, pair.gyro_noise_density * math.sqrt(pair.interval))
        self._slopes = self._gradient_lengths()

    def __call__(self, unknowns: Array) -> Array:
        x, c = unknowns[:_UNKNOWNS], unknowns[_UNKNOWNS:]
        pair = self._pair
        t = pair.t + x[3:5] @ self._tangent
        d = np.stack([x[5:8], x[8:11]])
        R = Rotation.from_rotvec(x[:3]).as_matrix() @ pair.R
        # Prior of the rotation: Log(R R_gyro(c)^T), whose change by c is linear.
        theta = x[:3] - self._gyro_change(c)
        return np.concatenate([
            self._matches(R, t, d + pair.t / pair.interval, c) / (self._sigma * self._slopes),
            (d - (t - pair.t) / pair.interval).ravel() / _VELOCITY_SIGMA,
            theta / self._turn_sigma])

    def _gyro_change(self, c: Array) -> Array:
        """Change (3,) of the gyro's rotation by c: axes, offset, bias, scale.

        ``Exp(a) R Exp(-a) = Exp(a - R a) R``; later by o: ``Exp(R w_2 o - w_1 o) R``.
        """
        pair = self._pair
        axes = c[PLACES['axes']]
        offset = float(c[PLACES['time_offset']][0])
        mean = 0.5 * pair.interval * (np.eye(3) + pair.R)
        return np.asarray(
            axes - pair.R @ axes + offset * (pair.R @ pair.rate2 - pair.rate1)
            - mean @ c[PLACES['gyro_bias']]
            + c[PLACES['gyro_scale']] * Rotation.from_matrix(pair.R).as_rotvec())

    def _matches(self, R: Array, t: Array, velocities: Array, c: Array) -> Array:
        """``(p_2 - p_1) . (g_1 x g_2)`` (N,) of rays and positions at their rows."""
        pair = self._pair
        place1, ray1 = self._row(pair.pixels1, pair.rates1, velocities[0], c)
        place2, ray2 = self._row(pair.pixels2, pair.rates2, velocities[1], c)
        return np.einsum('ni,ni->n', t + place2 - place1, np.cross(ray1, ray2 @ R.T))

    def _row(self, pixels: Array, rates: Array, velocity: Array, c: Array) -> tuple[Array, Array]:
        """Way since the middle row (N, 3), and rays (N, 3) turned to it."""
        camera = self._camera
        away = pixels[:, 1] - 0.5 * (camera.height - 1)
        readout = camera.line_delay * camera.height + c[PLACES['readout_time']]
        times = (away * readout / camera.height)[:, None]
        # The gyro's rate as c has it, at a row that is `offset` later; the change of the rate
        # itself within the offset is in the rotation between the frames.
        turned = Rotation.from_rotvec(c[PLACES['axes']]).apply(rates)
        turned = (1.0 + c[PLACES['gyro_scale']]) * turned - c[PLACES['gyro_bias']]
        rays = self._rays(pixels, c)
        angles = times * turned
        rays = rays + np.cross(angles, rays) + 0.5 * np.cross(angles, np.cross(angles, rays))
        return times * velocity, rays

    def _rays(self, pixels: Array, c: Array) -> Array:
        """Rays (N, 3) at z = 1 with another focal length and first coefficient, to first order.

        ``x_d = x (1 + k1 r^2)``: a change dk1 moves the undistorted point by ``-dk1 r^2 x``.
        """
        rays = self._camera.unproject(pixels)
        points = rays[:, :2] / rays[:, 2:]
        squares = (points**2).sum(axis=1, keepdims=True)
        points = points * (1.0 - c[PLACES['focal_length']] - c[PLACES['distortion']] * squares)
        return np.column_stack([points, np.ones(len(points))])

    def _gradient_lengths(self) -> Array:
        """Length (N,) of each residual's gradient by its four pixel coordinates."""
        pair = self._pair
        zero = np.zeros(_FREE)
        velocities = np.stack([pair.t, pair.t]) / pair.interval
        squares = np.zeros(len(pair.pixels1))
        middle = self._matches(pair.R, pair.t, velocities, zero)
        for name in ('pixels1', 'pixels2'):
            for shift in 0.01 * np.eye(2):
                self._pair = pair._replace(**{name: getattr(pair, name) + shift})
                moved = self._matches(pair.R, pair.t, velocities, zero)
                squares += ((moved - middle) / 0.01) ** 2
        self._pair = pair
        return np.sqrt(squares)


@dataclass(frozen=True, slots=True, eq=False)
class TellingMotion:
    """What each second of a recording tells: sums of `PairInformation` (F, 11, 11), (F, 3, 3)."""

    figures: Array
    turns: Array

    def seconds(self, injected: Injected | None) -> NDArray[np.bool_]:
        """Which seconds (F,) tell an error; None: that axes are another way round."""
        if injected is None:
            return np.array([_axes_told(turn) for turn in self.turns], dtype=bool)
        place = PLACES[injected.figure]
        before = np.diag(1.0 / _BEFORE**2)
        # The figure itself is not known before.
        before[place, place] = 0.0
        told = np.zeros(len(self.figures), dtype=bool)
        for second, information in enumerate(self.figures):
            if not information.any():
                continue
            # Information on the figure alone: the others eliminated.
            total = information + before
            rest = np.setdiff1d(np.arange(_FREE), np.arange(_FREE)[place])
            mixed = total[np.ix_(rest, np.arange(_FREE)[place])]
            alone = total[place, place] - mixed.T @ np.linalg.solve(
                total[np.ix_(rest, rest)], mixed)
            told[second] = injected.error @ alone @ injected.error >= TELLING**2
        return told


def _axes_told(turn: Array) -> bool:
    """Whether the turning about a second axis tells a quarter turn at `TELLING` sigmas."""
    return math.sqrt(max(float(np.linalg.eigvalsh(turn)[1]), 0.0)) * math.pi / 2 >= TELLING
