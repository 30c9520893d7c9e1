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
# Of the finite differences, in the units of `Injected` and of x.
_STEP = 1e-5
# What is known of each figure before any motion, 1 sigma.
_BEFORE = np.repeat([0.5, 0.1, 0.05, 0.1, 0.2, 0.3, 0.3], list(FIGURES.values()))
# Velocities differ from t / interval by so many baselines per second, 1 sigma.
_VELOCITY_SIGMA = 1.0
# Least noise of a match [px] and of a rotation by the gyro [rad]: no model is better.
_LEAST_PIXEL, _LEAST_TURN = 0.05, 3e-4
# An injected error must be so many times its sigma.
TELLING = 5.0
# Share of the information that tells it, which a second must hold to count.
_LEAST_PART = 0.01
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
    unknowns = _UNKNOWNS + _FREE
    residuals = _Residuals(pair, camera)(_STEP * np.eye(unknowns + 1, unknowns, -1))
    jacobian = (residuals[1:] - residuals[0]).T / _STEP
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
    """Residuals, each by its sigma, of matches, velocities and gyro around the truth.

    They are evaluated at K sets of unknowns at once: arrays of matches are (K, N, ...).
    """

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
        """Residuals (K, M) of unknowns (K, 22)."""
        x, c = unknowns[:, :_UNKNOWNS], unknowns[:, _UNKNOWNS:]
        pair, count = self._pair, len(unknowns)
        t = pair.t + x[:, 3:5] @ self._tangent
        d = x[:, 5:].reshape(count, 2, 3)
        R = Rotation.from_rotvec(x[:, :3]).as_matrix() @ pair.R
        matches = self._matches(R, t, d + pair.t / pair.interval, c)
        # Prior of the velocities: that of the baseline, which goes with t.
        slower = d - (t - pair.t)[:, None] / pair.interval
        # Prior of the rotation: Log(R R_gyro(c)^T), whose change by c is linear.
        theta = x[:, :3] - self._gyro_change(c)
        return np.hstack([matches / (self._sigma * self._slopes),
                          slower.reshape(count, 6) / _VELOCITY_SIGMA, theta / self._turn_sigma])

    def _gyro_change(self, c: Array) -> Array:
        """Change (K, 3) of the gyro's rotation by c (K, 11): axes, offset, bias, scale.

        ``Exp(a) R Exp(-a) = Exp(a - R a) R``; later by o: ``Exp(R w_2 o - w_1 o) R``.
        """
        pair = self._pair
        axes = c[:, PLACES['axes']]
        mean = 0.5 * pair.interval * (np.eye(3) + pair.R)
        return np.asarray(
            axes - axes @ pair.R.T
            + c[:, PLACES['time_offset']] * (pair.R @ pair.rate2 - pair.rate1)
            - c[:, PLACES['gyro_bias']] @ mean.T
            + c[:, PLACES['gyro_scale']] * Rotation.from_matrix(pair.R).as_rotvec())

    def _matches(self, R: Array, t: Array, velocities: Array, c: Array) -> Array:
        """``(p_2 - p_1) . (g_1 x g_2)`` (K, N) of rays and positions at their rows."""
        pair = self._pair
        place1, ray1 = self._row(pair.pixels1, pair.rates1, velocities[:, 0], c)
        place2, ray2 = self._row(pair.pixels2, pair.rates2, velocities[:, 1], c)
        across = np.cross(ray1, ray2 @ np.swapaxes(R, 1, 2))
        return np.asarray(((t[:, None] + place2 - place1) * across).sum(axis=2))

    def _row(self, pixels: Array, rates: Array, velocity: Array, c: Array) -> tuple[Array, Array]:
        """Way since the middle row (K, N, 3), and rays (K, N, 3) turned to it."""
        camera = self._camera
        away = pixels[:, 1] - 0.5 * (camera.height - 1)
        readout = camera.line_delay * camera.height + c[:, PLACES['readout_time']]
        times = (readout * away / camera.height)[..., None]
        # The gyro's rate as c has it; its change within the offset is in the rotation between
        # the frames.
        axes, bias, scale = (c[:, None, PLACES[name]]
                             for name in ('axes', 'gyro_bias', 'gyro_scale'))
        angles = times * ((1.0 + scale) * (rates + np.cross(axes, rates)) - bias)
        rays = self._rays(pixels, c)
        turned = np.cross(angles, rays)
        return times * velocity[:, None], rays + turned + 0.5 * np.cross(angles, turned)

    def _rays(self, pixels: Array, c: Array) -> Array:
        """Rays (K, N, 3) at z = 1 with another focal length and first coefficient.

        ``x_d = x (1 + k1 r^2)``: a change dk1 moves the undistorted point by ``-dk1 r^2 x``.
        """
        rays = self._camera.unproject(pixels)
        points = rays[:, :2] / rays[:, 2:]
        squares = (points**2).sum(axis=1, keepdims=True)
        focal, distortion = (c[:, None, PLACES[name]] for name in ('focal_length', 'distortion'))
        points = points * (1.0 - focal - distortion * squares)
        return np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=2)

    def _gradient_lengths(self) -> Array:
        """Length (N,) of each residual's gradient by its four pixel coordinates."""
        pair = self._pair
        squares = np.zeros(len(pair.pixels1))
        middle = self._at_truth()
        for name in ('pixels1', 'pixels2'):
            for shift in 0.01 * np.eye(2):
                self._pair = pair._replace(**{name: getattr(pair, name) + shift})
                squares += ((self._at_truth() - middle) / 0.01) ** 2
        self._pair = pair
        return np.sqrt(squares)

    def _at_truth(self) -> Array:
        pair = self._pair
        velocities = np.stack([pair.t, pair.t]) / pair.interval
        return np.asarray(self._matches(pair.R[None], pair.t[None], velocities[None],
                                        np.zeros((1, _FREE)))[0])


@dataclass(frozen=True, slots=True, eq=False)
class TellingMotion:
    """What each second of a recording tells: sums of `PairInformation` (F, 11, 11), (F, 3, 3)."""

    figures: Array
    turns: Array

    def seconds(self, injected: Injected | None) -> NDArray[np.bool_]:
        """Which seconds (F,) can tell an error; None: that axes are another way round.

        What has been seen up to a second's end tells the error, and the second adds to it: a
        camera that rests tells nothing, whatever it has told before.
        """
        if injected is None:
            # A quarter turn, squared in sigmas, by the turning about one axis and about a second.
            quarter = (math.pi / 2)**2
            each = quarter * np.linalg.eigvalsh(self.turns)[:, 2]
            so_far = quarter * np.linalg.eigvalsh(np.cumsum(self.turns, axis=0))[:, 1]
        else:
            each, so_far = (
                np.array([_squared_error(injected, figures) for figures in information])
                for information in (self.figures, np.cumsum(self.figures, axis=0)))
        return np.asarray((so_far >= TELLING**2) & (each >= _LEAST_PART * TELLING**2))


def _squared_error(injected: Injected, figures: Array) -> float:
    """An error squared in sigmas that the information gives its figure, the others eliminated."""
    place = np.arange(_FREE)[PLACES[injected.figure]]
    rest = np.setdiff1d(np.arange(_FREE), place)
    # Of the figure itself nothing is known before.
    others = figures[np.ix_(rest, rest)] + np.diag(1.0 / _BEFORE[rest]**2)
    mixed = figures[np.ix_(rest, place)]
    alone = figures[np.ix_(place, place)] - mixed.T @ np.linalg.solve(others, mixed)
    return float(injected.error @ alone @ injected.error)
