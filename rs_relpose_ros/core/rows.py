"""Orientation of the camera at the rows of a frame, and its derivatives by all deviations.

A row is read the time tau after the reference row, a share s of the readout after the middle row.
With A(u) the rotation by the gyro from the axes of the camera at time u to those at the reference
row, ``A(0) = I``, deviations c rotate A(tau) on the left by

    axes          (I - A(tau)) c
    time_offset   (A(tau) w(tau) - w(0)) c          all rows are later on the clock of the gyro
    readout_time  A(tau) w(tau) s c                 the row itself is later by s c
    gyro_bias     -B c,             B = integral from 0 to tau of A(u) R_cam_imu du
    gyro_scale, gyro_skew           integral of A(u) R_cam_imu M w_imu(u) du, M symmetric

A deviation that is not named here, such as those of the lens, does not turn the rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rs_relpose_ros.core.deviations import N_DEVIATIONS, PARTS
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.gyro import GyroPath, path_states

# Pairs of axes of `gyro_skew`, in its order.
_SKEWED = ((1, 2), (0, 2), (0, 1))


class RowStates(NamedTuple):
    """N rows of a frame."""

    rotation: Array  # (N, 3, 3) from the axes of the camera at the row to those at the reference
    by_deviation: Array  # (N, 3, D) rotation vector on its left
    time_by_deviation: Array  # (N, D) of tau [s]


def row_states(path: GyroPath, R_cam_imu: Array, times: Array, shares: Array) -> RowStates:
    """Rows at `times` tau (N,) [s], which are `shares` (N,) of the readout after the middle row.

    `path` is in camera axes, and relative to time 0.
    """
    rotations, rates, _ = path_states(path, times)
    first_rate = path_states(path, np.zeros(1))[1][0]
    by_rate, by_gyro = _integrals(path, R_cam_imu, times)
    velocity = np.einsum('nij,nj->ni', rotations, rates)
    turns = np.zeros((len(times), 3, N_DEVIATIONS))
    turns[:, :, PARTS['axes']] = np.eye(3) - rotations
    turns[:, :, PARTS['time_offset']] = (velocity - first_rate)[:, :, None]
    turns[:, :, PARTS['readout_time']] = (velocity * shares[:, None])[:, :, None]
    turns[:, :, PARTS['gyro_bias']] = -by_rate
    turns[:, :, PARTS['gyro_scale']] = np.einsum('nijj->nij', by_gyro)
    skewed = [by_gyro[:, :, i, j] + by_gyro[:, :, j, i] for i, j in _SKEWED]
    turns[:, :, PARTS['gyro_skew']] = np.stack(skewed, axis=2)
    delays = np.zeros((len(times), N_DEVIATIONS))
    delays[:, PARTS['readout_time']] = shares[:, None]
    return RowStates(rotations, turns, delays)


def _integrals(path: GyroPath, R_cam_imu: Array, times: Array) -> tuple[Array, Array]:
    """Integrals from 0 to each time (N,): of ``A R_cam_imu``, and of that times each rate.

    The first (N, 3, 3) [s] is by a rate, the second (N, 3, 3, 3) [rad] by the gyro's matrix: its
    last two axes are those of the matrix. Simpson's rule over each step of the gyro, and a cubic
    polynomial within it: to fourth order in the step.
    """

    def values(at: Array) -> Array:
        rotations, rates, _ = path_states(path, at)
        by_rate = rotations @ R_cam_imu
        by_gyro = by_rate[:, :, :, None] * (rates @ R_cam_imu)[:, None, None, :]
        return np.concatenate([by_rate.reshape(-1, 9), by_gyro.reshape(-1, 27)], axis=1)

    knots, steps = path.times, np.diff(path.times)
    of_knots = values(knots)
    of_middles = values(0.5 * (knots[1:] + knots[:-1]))
    of_steps = (of_knots[:-1] + 4.0 * of_middles + of_knots[1:]) / 6.0
    whole = np.vstack([np.zeros(36), np.cumsum(steps[:, None] * of_steps, axis=0)])
    ends = np.append(times, 0.0)
    before = np.clip(np.searchsorted(knots, ends, side='right') - 1, 0, len(steps) - 1)
    share = ((ends - knots[before]) / steps[before])[:, None]
    # Integral, over the step, of the parabola through the values at begin, middle and end.
    begin, middle, end = of_knots[before], of_middles[before], of_knots[before + 1]
    linear = -3.0 * begin + 4.0 * middle - end
    square = 2.0 * begin - 4.0 * middle + 2.0 * end
    part = share * (begin + share * (linear / 2.0 + share * square / 3.0))
    until = whole[before] + steps[before, None] * part
    since = until[:-1] - until[-1]
    return since[:, :9].reshape(-1, 3, 3), since[:, 9:].reshape(-1, 3, 3, 3)
