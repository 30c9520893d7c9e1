"""What time, accelerometer and carrier say of the linear velocities of a pair.

With the baseline b [m], the interval T, and the acceleration preintegrated to alpha and beta, in
the axes of camera 1 and moved from the IMU to the camera (R and w_i by the gyro, p: lever arm)::

    alpha' = alpha + T w_1 x p + p - R p        beta' = beta + w_1 x p - R (w_2 x p)
    b d_1 = (b t - alpha') / T                  b d_2 = b d_1 + beta'

so one unknown, b, stands for six. Without accelerometer alpha' and beta' are those of an
acceleration that is zero on average and correlated over a time.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.estimator import CarrierMotion, MOTIONS
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.information import inverse
from rs_relpose_ros.estimator.priors import PINNED, VelocityPrior
from rs_relpose_ros.estimator.problem import TwoViewProblem
from rs_relpose_ros.estimator.velocity_prior import Scales
from rs_relpose_ros.geometry.inertial import InertialMotion

Array = NDArray[np.float64]

# Correlation time of a carrier's acceleration [s]: steps, gusts, gears.
CORRELATION_TIME = 0.2
# What a velocity constant over the read-out leaves out [m/s].
ROW_VELOCITY_SIGMA = 0.005
# Scales of the baseline over the speeds of a carrier.
SCALES = 4
# Of the prior of each, as a share of the distance to the next one.
WIDTH = 0.7

# Without a time between the frames: prior sigmas [baselines per second], and the exponent of their
# prior as its inverse. Where the data cannot tell (sideways motion, cameras at rest), a wide prior
# would turn noise into velocity and degrees of translation.
GRID = np.array([0.003, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
SMALL_IS_LIKELIER = 0.5
TIMELESS = Scales(np.asarray(-np.log(GRID)), np.asarray(-SMALL_IS_LIKELIER * np.log(GRID)))
# Velocities that are held at zero.
AT_ZERO = Scales(np.array([0.5 * math.log(PINNED)]), np.zeros(1))


def velocities_expected(problem: TwoViewProblem, motion: str, interval: float,
                        inertial: InertialMotion | None) -> tuple[VelocityPrior, Scales]:
    """Prior of the velocities at the middle rows, and the grid of their scales.

    Parameters
    ----------
    motion : str
        Of `MOTIONS`: what carries the camera.
    interval : float
        Between the frames [s].
    inertial : InertialMotion or None
        Between their reference rows.
    """
    carrier = MOTIONS[motion]
    if inertial is None:
        expected, covariance = np.zeros(6), _of_carrier(carrier, interval)
    else:
        expected, covariance = _of_imu(problem, inertial)
    # (alpha', beta') to u = b (d - c t) + a: a = (alpha' / T, alpha' / T - beta')
    to_velocities = np.kron(np.array([[1.0 / interval, 0.0], [1.0 / interval, -1.0]]), np.eye(3))
    covariance = to_velocities @ covariance @ to_velocities.T + ROW_VELOCITY_SIGMA**2 * np.eye(6)
    lowest, highest = span_of_scales(motion, interval)
    step = (highest - lowest) / SCALES
    centres = np.array([lowest + step * (0.5 + k) for k in range(SCALES)])
    prior = VelocityPrior(1.0 / interval, to_velocities @ expected,
                          inverse(covariance),
                          float(centres[SCALES // 2]), 0.0, (WIDTH * step) ** -2, 0.0)
    return prior, Scales(centres, np.zeros(SCALES))


def span_of_scales(motion: str, interval: float) -> tuple[float, float]:
    """``log b`` between which a carrier's speeds put it."""
    carrier = MOTIONS[motion]
    lowest = math.log(interval * carrier.slow)
    return lowest, lowest + math.log(carrier.fast / carrier.slow)


def _of_imu(problem: TwoViewProblem, inertial: InertialMotion) -> tuple[Array, Array]:
    """(alpha', beta') of the camera between the middle rows, and their covariance (6, 6)."""
    delay = -problem.reference_row_time
    # The turn from the reference to the middle row.
    turn = problem.motion1.rotations([-delay])[0].T
    moved, p = inertial.shifted(delay, turn), np.asarray(inertial.lever_arm)
    alpha, beta = moved.alpha, moved.beta
    if p.any():
        if problem.rotation is None:
            raise InputError('inertial with a lever_arm needs relative_rotation, too')
        R, arm1 = problem.rotation, np.cross(problem.motion1.angular_velocity, p)
        arm2 = np.cross(problem.motion2.angular_velocity, p)
        alpha = alpha + inertial.duration * arm1 + p - R @ p
        beta = beta + arm1 - R @ arm2
    return np.concatenate([alpha, beta]), moved.covariance


def _of_carrier(carrier: CarrierMotion, interval: float) -> Array:
    """Covariance (6, 6) of (alpha, beta) of a random acceleration, correlated exponentially."""
    parts = 16
    instants = (np.arange(parts) + 0.5) * interval / parts
    to_both = np.vstack([interval - instants, np.ones(parts)]) * interval / parts
    correlation = np.exp(-np.abs(instants[:, None] - instants) / CORRELATION_TIME)
    covariance: Array = carrier.acceleration**2 * to_both @ correlation @ to_both.T
    return np.asarray(np.kron(covariance, np.eye(3)))
