"""Orientation of the camera at the rows of a frame, and its derivatives by all deviations.

With A(u) the rotation by the gyro from the axes of the camera at time u to those at the reference
of its path, and R_cam_imu from the axes of the IMU to those of the camera, deviations c of the
configuration rotate A(t) on the left by

    axes          -A(t) c                      and by +c, which is common to all times
    time_offset   A(t) w(t) c                  the row is later on the clock of the gyro
    offset_per_interval                        the same times the covariate of the frame
    readout_time  A(t) w(t) s c                the row, a share s of the readout after the middle
                                               row, is later by s c
    gyro_bias     -integral of A(u) R_cam_imu du c
    gyro_scale, gyro_skew    integral of A(u) R_cam_imu M w_imu(u) du, M symmetric
    exposure_square          integral of A(u) R_cam_imu v(u) du c, v the change of the rates

Kernels add these turns, times the derivative of a residual by a turn, to the derivatives of the
residual. Only turns relative to another time matter: those at the reference are subtracted.
A deviation that is not named here, such as those of the lens, does not turn the rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.core.deviations import N_DEVIATIONS, PARTS
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.gyro import GyroPath, knot_before, write_state
from rs_relpose_ros.geometry.so3 import dot, rotated, rotated_back, Vector
from rs_relpose_ros.jit import inlined_kernel, kernel, small_kernel

# Places of the deviations in the whole vector, as numbers for the kernels.
_AXES = PARTS['axes'].start
_OFFSET = PARTS['time_offset'].start  # IMU's clock minus the camera's
_SLOPE = PARTS['offset_per_interval'].start  # offset by the interval between frames
_READOUT = PARTS['readout_time'].start  # signed readout time
# Deviations of the rates of the gyro, which are neighbours in the whole vector: the first of
# them, and their number.
_GYRO = PARTS['gyro_bias'].start
_N_GYRO = PARTS['exposure_square'].stop - _GYRO  # bias, scale, skew, exposure
# Places among the deviations of the rates.
_SCALE = PARTS['gyro_scale'].start - _GYRO
_SKEW = PARTS['gyro_skew'].start - _GYRO  # first of three
_EXPOSURE = PARTS['exposure_square'].start - _GYRO  # square of the exposure
# Pairs of axes of `gyro_skew`, in its order.
_SKEWED = ((1, 2), (0, 2), (0, 1))


class TurnedPath(NamedTuple):
    """A path in the axes of the camera, and how G deviations of the gyro's rates turn it."""

    path: GyroPath
    # (K, 3, G) rotation vector at each knot, relative to the first knot, and its derivative by
    # time.
    turns: Array
    turn_rates: Array


def gyro_matrix(deviations: Array) -> Array:
    """Matrix M (3, 3) of scale and skew: the true rates are ``(I + M) w``."""
    matrix = np.diag(deviations[PARTS['gyro_scale']])
    for (first, second), skew in zip(_SKEWED, deviations[PARTS['gyro_skew']], strict=True):
        matrix[first, second] = matrix[second, first] = skew
    return matrix


@inlined_kernel
def _write_turn_rates(
    rotation: Array, R_cam_imu: Array, rate: Array, blur_rate: Array, out: Array
) -> None:
    """Write the derivatives (3, G) by time of the turns at one time."""
    rate_imu = rotated_back(R_cam_imu, rate)
    for i in range(3):
        row = rotated_back(R_cam_imu, rotation[i])
        for axis in range(3):
            out[i, axis] = -row[axis]
            out[i, _SCALE + axis] = row[axis] * rate_imu[axis]
        for k, (first, second) in enumerate(_SKEWED):
            out[i, _SKEW + k] = row[first] * rate_imu[second] + row[second] * rate_imu[first]
        out[i, _EXPOSURE] = dot(row, blur_rate)


@kernel
def turned_path(path: GyroPath, R_cam_imu: Array, blur_rates: Array) -> TurnedPath:
    """Integrate the turns of a path (Simpson's rule over each step of the gyro).

    `blur_rates` (K, 3) are the derivatives of the rates of the IMU by the square of the exposure
    [rad/s^3].
    """
    knots = len(path.times)
    turns = np.zeros((knots, 3, _N_GYRO))
    turn_rates = np.empty((knots, 3, _N_GYRO))
    rotation = np.empty((3, 3))
    rate = np.empty(3)
    blur_rate = np.empty(3)
    of_middle = np.empty((3, _N_GYRO))
    for k in range(knots):
        _write_turn_rates(
            path.rotations[k], R_cam_imu, path.rates[k], blur_rates[k], turn_rates[k]
        )
    for k in range(knots - 1):
        step = path.times[k + 1] - path.times[k]
        write_state(path, path.times[k] + 0.5 * step, k, rotation, rate)
        for i in range(3):
            blur_rate[i] = 0.5 * (blur_rates[k, i] + blur_rates[k + 1, i])
        _write_turn_rates(rotation, R_cam_imu, rate, blur_rate, of_middle)
        for i in range(3):
            for g in range(_N_GYRO):
                ends = turn_rates[k, i, g] + turn_rates[k + 1, i, g]
                turns[k + 1, i, g] = turns[k, i, g] + step / 6.0 * (ends + 4.0 * of_middle[i, g])
    return TurnedPath(path, turns, turn_rates)


@inlined_kernel
def add_by_gyro(J: Array, by_turn: Vector, turned: TurnedPath, time: float, k: int) -> None:
    """Add the derivatives by the gyro's rates, at a time after knot `k`.

    `by_turn` is the derivative of a residual by a turn of the camera at this time. The integral
    within the step is the cubic polynomial through its values and its derivatives at the knots.
    """
    step = turned.path.times[k + 1] - turned.path.times[k]
    s = (time - turned.path.times[k]) / step
    of_end = s * s * (3.0 - 2.0 * s)
    of_begin_rate = s * (1.0 - s) * (1.0 - s) * step
    of_end_rate = -s * s * (1.0 - s) * step
    for i in range(3):
        begin = (1.0 - of_end) * by_turn[i]
        end = of_end * by_turn[i]
        begin_rate = of_begin_rate * by_turn[i]
        end_rate = of_end_rate * by_turn[i]
        for g in range(_N_GYRO):
            J[_GYRO + g] += (
                begin * turned.turns[k, i, g]
                + end * turned.turns[k + 1, i, g]
                + begin_rate * turned.turn_rates[k, i, g]
                + end_rate * turned.turn_rates[k + 1, i, g]
            )


@inlined_kernel
def add_by_axes(J: Array, by_turn: Vector, rotation: Array) -> None:
    """Add the derivatives by the axes at a time with this rotation of the camera."""
    by_axes = rotated_back(rotation, by_turn)
    for axis in range(3):
        J[_AXES + axis] -= by_axes[axis]


@inlined_kernel
def add_by_time(
    J: Array, by_turn: Vector, rotation: Array, rate: Array, share: float, covariate: float
) -> None:
    """Add the derivatives by offset and readout time of a row, `share` after the middle row."""
    by_time = dot(by_turn, rotated(rotation, rate))
    J[_OFFSET] += by_time
    J[_SLOPE] += covariate * by_time
    J[_READOUT] += share * by_time


class RowState(NamedTuple):
    """The camera at one row."""

    rotation: Array  # (3, 3) from its axes to those at the reference
    rate: Array  # (3,) in its axes [rad/s]
    time: float  # tau [s]
    share: float  # of the readout after the middle row
    knot: int  # of the path, before the row


@inlined_kernel
def add_by_row(J: Array, by_turn: Vector, turned: TurnedPath, row: RowState) -> None:
    """Add the derivatives of a residual by all deviations that turn its row."""
    add_by_axes(J, by_turn, row.rotation)
    add_by_time(J, by_turn, row.rotation, row.rate, row.share, 0.0)
    add_by_gyro(J, by_turn, turned, row.time, row.knot)


@inlined_kernel
def add_by_delay(J: Array, by_time: float, share: float) -> None:
    """Add the derivatives of a residual by all deviations that delay its row against others."""
    J[_READOUT] += share * by_time


# -- All rows of a frame --------------------------------------------------------------------------


class RowStates(NamedTuple):
    """N rows of a frame."""

    rotation: Array  # (N, 3, 3) from the axes of the camera at the row to those at the reference
    by_deviation: Array  # (N, 3, D) rotation vector on its left
    time_by_deviation: Array  # (N, D) of tau [s]


@kernel
def row_states(path: GyroPath, R_cam_imu: Array, times: Array, shares: Array) -> RowStates:
    """Rows at `times` tau (N,) [s], which are `shares` (N,) of the readout after the middle row.

    `path` is in camera axes, and relative to time 0, which is the time of the reference row.
    """
    count = len(times)
    turned = turned_path(path, R_cam_imu, np.zeros(path.rates.shape))
    rotations = np.empty((count, 3, 3))
    turns = np.zeros((count, 3, N_DEVIATIONS))
    delays = np.zeros((count, N_DEVIATIONS))
    at_reference = np.zeros((3, N_DEVIATIONS))
    _write_turns(turned, 0.0, 0.0, np.empty((3, 3)), at_reference)
    for n in range(count):
        _write_turns(turned, times[n], shares[n], rotations[n], turns[n])
        for i in range(3):
            for d in range(N_DEVIATIONS):
                turns[n, i, d] -= at_reference[i, d]
        add_by_delay(delays[n], 1.0, shares[n])
    return RowStates(rotations, turns, delays)


@kernel
def _write_turns(
    turned: TurnedPath, time: float, share: float, rotation: Array, turns: Array
) -> None:
    """Write the rotation at one time and add its turns (3, D) by all deviations."""
    rate = np.empty(3)
    axes = np.eye(3)
    k = knot_before(turned.path.times, time, 0)
    write_state(turned.path, time, k, rotation, rate)
    for i in range(3):
        axis = (axes[i, 0], axes[i, 1], axes[i, 2])
        add_by_row(turns[i], axis, turned, RowState(rotation, rate, time, share, k))


# -- Rows of several frames -----------------------------------------------------------------------


class RowsOfFrames(NamedTuple):
    """N rows in each of V frames, with the paths of the frames one after the other."""

    path: GyroPath  # in camera axes, each part relative to the reference row of its frame
    first_knots: NDArray[np.int64]  # (V + 1,) of the parts
    times: Array  # (V, N) tau of the rows [s]
    shares: Array  # (V, N) of the readout after the middle row


class TurnedFrames(NamedTuple):
    """How deviations of the gyro's rates turn the paths of V frames."""

    whole: TurnedPath  # the parts one after the other, each relative to its first knot
    at_reference: Array  # (V, 3, D) turn of each frame's reference row by all deviations


@kernel
def turned_frames(rows: RowsOfFrames, R_cam_imu: Array) -> TurnedFrames:
    """Integrate the turns of all frames."""
    frames = len(rows.times)
    turns = np.empty((len(rows.path.times), 3, _N_GYRO))
    turn_rates = np.empty((len(rows.path.times), 3, _N_GYRO))
    whole = TurnedPath(rows.path, turns, turn_rates)
    at_reference = np.zeros((frames, 3, N_DEVIATIONS))
    for v in range(frames):
        part = part_of_frame(whole, rows.first_knots, v)
        turned = turned_path(part.path, R_cam_imu, np.zeros(part.path.rates.shape))
        part.turns[:] = turned.turns
        part.turn_rates[:] = turned.turn_rates
        _write_turns(turned, 0.0, 0.0, np.empty((3, 3)), at_reference[v])
    return TurnedFrames(whole, at_reference)


@small_kernel
def part_of_frame(whole: TurnedPath, first_knots: NDArray[np.int64], v: int) -> TurnedPath:
    """The turned path of frame v."""
    begin = first_knots[v]
    end = first_knots[v + 1]
    return TurnedPath(
        GyroPath(
            whole.path.times[begin:end],
            whole.path.rates[begin:end],
            whole.path.rotations[begin:end],
        ),
        whole.turns[begin:end],
        whole.turn_rates[begin:end],
    )
