"""Residual of a track in the frames of a pair, with the path of the camera by the IMU.

In the axes of camera 1 at its reference row, which is the origin, with the baseline as unit of
length and s from 0 at that row to T at the reference row of the last frame::

    p(s)  = s/T t + k (S(s) + sum_j e_j B_j(s))            |t| = 1, p(0) = 0, p(T) = t
    R(s)  = Exp(s b + phi_v) R_v E_v(s)
    u     ~ R(s)^T (f_i - rho_i p(s))                      observation of track i in frame v at s

k is the inverse of the baseline [1/m]. S is the measured acceleration integrated twice, less its
chord [m]. e_j is the acceleration that is not in S [m/s^2]: with an accelerometer, e_0 alone, a
constant, is the error of gravity and accelerometer; without one, the e_j are the coefficients of
three Legendre polynomials. The B_j are their double integrals, zero at both ends. b is the error
of the gyro's bias, phi_v the error of its rotation R_v between the reference rows (phi_0 = 0), and
E_v the rotation by the gyro within the frame.

Each track has a direction f_i, since its observation in frame 1 has noise, too, and an inverse
distance rho_i. The residual is the distance of the observation u from its prediction [px].

Tracks are evaluated in blocks, the values of one quantity contiguous in memory, which the compiler
vectorises.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.core.deviations import LENS
from rs_relpose_ros.core.least_squares import first_indices
from rs_relpose_ros.core.rows import (
    add_by_delay,
    add_by_row,
    part_of_frame,
    RowsOfFrames,
    RowState,
    TurnedFrames,
)
from rs_relpose_ros.core.triangulate import scaled_depths
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.gyro import knot_before, write_state
from rs_relpose_ros.geometry.so3 import (
    add,
    column,
    cross,
    dot,
    norm,
    rotated,
    rotated_back,
    scale,
    Vector,
    write_column,
)
from rs_relpose_ros.jit import inlined_kernel, kernel, small_kernel

Flags = NDArray[np.bool_]

# Tracks of a block. Fewer leave a part of the vector registers unused; more do not fit into the
# nearest cache with their rows.
# [chosen: any multiple of 8 in 32..128 would do; 40 divides the most tracks of a pair]
BLOCK = 40
# Most polynomials of the unknown acceleration: of a higher degree, only the prior would determine
# them. [chosen: pairs span a few correlation times of the acceleration]
MOST_ACCELERATIONS = 3

# First row of each value of an observation in its block: the unit ray in the axes of the frame's
# reference row, the derivatives of both pixel coordinates by the ray [px], s [s], S(s) [m], and
# the derivative of S by s [m/s].
_OBSERVATION = first_indices(ray=3, to_pixels=6, time=1, moved=3, moving=3)
RAY = _OBSERVATION['ray']  # unit vector, axes of the reference row
TO_PIXELS = _OBSERVATION['to_pixels']  # derivatives of both pixel coordinates by the ray [px]
TIME = _OBSERVATION['time']  # s, the time of the row [s]
MOVED = _OBSERVATION['moved']  # S(s), the place of the camera [m]
MOVING = _OBSERVATION['moving']  # derivative of S by s [m/s]
VALUES = _OBSERVATION['end']  # number of rows of an observation

# First row of each value of a track in its block: f, two vectors across the ray of frame 1, along
# which f moves, and rho times the length of f.
_TRACK = first_indices(direction=3, columns=6, inverse_distance=1)
DIRECTION = _TRACK['direction']  # f
COLUMNS = _TRACK['columns']  # the vectors along which f moves
INVERSE_DISTANCE = _TRACK['inverse_distance']  # rho times the length of f
TRACK_VALUES = _TRACK['end']  # number of rows of a track
# Unknowns of a track: two steps of its direction, and its inverse distance.
TRACK_UNKNOWNS = 3

# First unknown of the path: two steps of t in its tangent plane, log k, b, and e_0, e_1, ...; the
# phi of the frames 1, 2, ... follow after them.
_UNKNOWNS = first_indices(tangent=2, log_scale=1, bias=3, acceleration=3 * MOST_ACCELERATIONS)
TANGENT = _UNKNOWNS['tangent']  # steps of t
LOG_SCALE = _UNKNOWNS['log_scale']  # log k
BIAS = _UNKNOWNS['bias']  # b
ACCELERATION = _UNKNOWNS['acceleration']  # e_0, e_1, ...

# First row of an observation's derivatives: by the unknowns of its track, the residual itself, by
# phi of its frame, by the path, and by the place p(s); then the factor of all of them.
_ROWS = first_indices(
    track=TRACK_UNKNOWNS,
    residual=1,
    phi=3,
    path=_UNKNOWNS['end'],
    place=3,
    factor=1,
)
RESIDUAL = _ROWS['residual']  # the residual [px]
PHI = _ROWS['phi']  # by phi of the frame
PATH = _ROWS['path']  # by the unknowns of the path
PLACE = _ROWS['place']  # by the place p(s)
FACTOR = _ROWS['factor']  # root of the observation's weight over the variance [1/px]
ROWS = _ROWS['end']  # number of rows

# Place of the first entry of the lens among the deviations.
_FIRST_OF_LENS = LENS.start

# Square of the sine of the parallax below which the distance of a track is not triangulated.
# [chosen: 1e-4 rad, a tenth of a pixel; the adjustment finds the distance in any case]
_PARALLEL = 1e-8
# Inverse distance [1/baselines] at which such a track starts.
# [chosen: far away, but not at infinity, where the derivatives by the path vanish]
_FAR = 1e-2


class TrackBlocks(NamedTuple):
    """Observations of N tracks in V frames, in blocks; observations that are not used are zero."""

    observations: Array  # (V, blocks, VALUES, BLOCK)
    used: Flags  # (V, blocks, BLOCK)
    rotations: Array  # (V, 3, 3) R_v by the gyro
    duration: float  # T [s]
    number: int  # N


def empty_blocks(rotations: Array, duration: float, count: int) -> TrackBlocks:
    """Blocks of `count` tracks, to be filled by `fill_view`."""
    shape = len(rotations), -(-count // BLOCK)
    return TrackBlocks(
        np.zeros((*shape, VALUES, BLOCK)),
        np.zeros((*shape, BLOCK), dtype=bool),
        rotations,
        duration,
        count,
    )


class FrameRays(NamedTuple):
    """Observations of N tracks in one frame, as measured."""

    used: Flags  # (N,)
    rays: Array  # (N, 3) unit rays in the camera's axes at their rows
    by_pixel: Array  # (N, 3, 2) derivatives of the rays by their pixels
    times: Array  # (N,) of their rows after the reference row of the frame [s]
    rotations: Array  # (N, 3, 3) E_v of their rows
    row_rotation: Array  # (3,) rotation of the camera from one row to the next [rad]
    axis: int  # of the pixel coordinate that is the row: 1 (v) or 0 (u)
    rate: Array  # (3,) of the camera [rad/s]


class FrameInertia(NamedTuple):
    """Motion of the IMU from the first frame to one frame, as measured; zero if unknown."""

    interval: float  # between the reference rows [s]
    moved: Array  # (3,) acceleration, integrated twice [m]
    moving: Array  # (3,) acceleration, integrated once [m/s]
    acceleration: Array  # (3,) during the readout [m/s^2]
    lever_arm: Array  # (3,) place of the IMU in the camera's axes [m]
    chord: Array  # (3,) displacement of the camera up to the last frame [m]


@kernel
def fill_view(tracks: TrackBlocks, v: int, frame: FrameRays, inertia: FrameInertia) -> None:
    """Fill the observations of view v: derotated rays, and the displacement by the IMU."""
    R = tracks.rotations[v]
    per_second = 1.0 / tracks.duration
    for n in range(len(frame.rays)):
        if not frame.used[n]:
            continue
        b = n // BLOCK
        i = n % BLOCK
        tracks.used[v, b, i] = True
        o = tracks.observations[v, b]
        E = frame.rotations[n]
        tau = frame.times[n]
        ray = rotated(E, frame.rays[n])
        by_u = rotated(E, frame.by_pixel[n, :, 0])
        by_v = rotated(E, frame.by_pixel[n, :, 1])
        # One row further, the camera has rotated on.
        turned = cross(frame.row_rotation, ray)
        if frame.axis == 1:
            by_v = add(by_v, turned)
        else:
            by_u = add(by_u, turned)
        u_by_ray, v_by_ray = _pseudo_inverse(by_u, by_v)
        write_column(ray, o, RAY, i)
        write_column(u_by_ray, o, TO_PIXELS, i)
        write_column(v_by_ray, o, TO_PIXELS + 3, i)
        s = inertia.interval + tau
        o[TIME, i] = s
        # The IMU moves; the camera is at the other end of the lever arm, which rotates.
        arm = rotated(E, inertia.lever_arm)
        swing = rotated(R, arm)
        swinging = rotated(R, cross(frame.rate, arm))
        for x in range(3):
            half = 0.5 * tau * inertia.acceleration[x]
            by_imu = inertia.moved[x] + tau * (inertia.moving[x] + half)
            by_arm = inertia.lever_arm[x] - swing[x]
            o[MOVED + x, i] = by_imu + by_arm - s * per_second * inertia.chord[x]
            velocity = inertia.moving[x] + tau * inertia.acceleration[x]
            o[MOVING + x, i] = velocity - swinging[x] - per_second * inertia.chord[x]


@small_kernel
def _pseudo_inverse(by_u: Vector, by_v: Vector) -> tuple[Vector, Vector]:
    """Rows of ``(J^T J)^-1 J^T``, J having the two columns."""
    uu = dot(by_u, by_u)
    uv = dot(by_u, by_v)
    vv = dot(by_v, by_v)
    inverse = 1.0 / (uu * vv - uv * uv)
    return (
        scale(inverse, add(scale(vv, by_u), scale(-uv, by_v))),
        scale(inverse, add(scale(uu, by_v), scale(-uv, by_u))),
    )


@kernel
def start_of_tracks(tracks: TrackBlocks, R: Array, t: Array) -> Array:
    """Tracks (blocks, TRACK_VALUES, BLOCK) by their first and last rays and the pose R, t."""
    first = tracks.observations[0]
    last = tracks.observations[-1]
    out = np.zeros((len(first), TRACK_VALUES, BLOCK))
    baseline = (t[0], t[1], t[2])
    for b in range(len(first)):
        for i in range(BLOCK):
            f = column(first[b], RAY, i)
            if not tracks.used[0, b, i]:  # no observation of this track counts
                f = (0.0, 0.0, 1.0)
            one, other = _across(f)
            write_column(f, out[b], DIRECTION, i)
            write_column(one, out[b], COLUMNS, i)
            write_column(other, out[b], COLUMNS + 3, i)
            h = rotated(R, column(last[b], RAY, i))
            along_f, along_h, squared_sine = scaled_depths(f, h, baseline)
            usable = squared_sine > _PARALLEL and along_f > 0.0 and along_h > 0.0
            out[b, INVERSE_DISTANCE, i] = squared_sine / along_f if usable else _FAR
    return out


@small_kernel
def _across(ray: Vector) -> tuple[Vector, Vector]:
    """Two unit vectors across a unit vector and each other.

    Duff et al., "Building an Orthonormal Basis, Revisited" (JCGT 6, 2017).
    """
    x, y, z = ray
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    return (1.0 + sign * x * x * a, sign * x * y * a, -sign * x), (x * y * a, sign + y * y * a, -y)


class Path(NamedTuple):
    """The unknowns of a path, and what follows from them."""

    t: Array  # (3,) unit
    basis: Array  # (3, 2) tangent plane of t
    scale: float  # k [1/m]
    bias: Array  # (3,) b [rad/s]
    accelerations: Array  # (MOST_ACCELERATIONS, 3) e; zero for those that are no unknowns
    duration: float  # T [s]


class Noise(NamedTuple):
    """What the residuals of an observation may be."""

    variance: float  # of each coordinate [px^2]
    farthest: float  # largest squared residual of an observation that counts [px^2]


@small_kernel
def _bends(s: float, T: float) -> tuple[float, float, float]:
    """``B_j(s)`` of the polynomials 1, 2 x - 1 and 6 x^2 - 6 x + 1 of ``x = s / T``."""
    x = s / T
    return (
        0.5 * T * T * (x * x - x),
        T * T * x * (x * x / 3.0 - 0.5 * x + 1.0 / 6.0),
        0.5 * T * T * x * x * (x * x - 2.0 * x + 1.0),
    )


@small_kernel
def _bending(s: float, T: float) -> tuple[float, float, float]:
    """Derivatives of ``B_j(s)`` by s."""
    x = s / T
    return (
        T * (x - 0.5),
        T * (x * x - x + 1.0 / 6.0),
        T * x * (2.0 * x * x - 3.0 * x + 1.0),
    )


@small_kernel
def _with_accelerations(measured: Vector, factors: Vector, path: Path) -> Vector:
    """``S + sum_j factor_j e_j``, or the same of their derivatives by s."""
    e = path.accelerations
    total = add(measured, scale(factors[0], e[0]))
    total = add(total, scale(factors[1], e[1]))
    return add(total, scale(factors[2], e[2]))


@inlined_kernel
def observe(
    o: Array,
    track: Array,
    R: Array,
    moves: float,
    path: Path,
    noise: Noise,
    rows: Array,
    squares: Array,
) -> None:
    """Write residuals and derivatives (ROWS, 2, BLOCK) of a block's observations in one frame.

    `o` (VALUES, BLOCK), `track` (TRACK_VALUES, BLOCK): a block of observations and of tracks.
    R (3, 3): ``Exp(phi_v) R_v``. `moves`: 0 for the first frame, whose phi is zero, else 1. Rows
    are times the root of the observation's weight over the variance of the `noise`: the Cauchy
    weight, or zero if it is far. `squares` (BLOCK,) receives the squared residuals [px^2].
    """
    k = path.scale
    for i in range(BLOCK):
        s = o[TIME, i]
        rho = track[INVERSE_DISTANCE, i]
        share = s / path.duration
        bends = _bends(s, path.duration)
        moved = _with_accelerations(column(o, MOVED, i), bends, path)
        place = add(scale(share, path.t), scale(k, moved))
        before = add(column(track, DIRECTION, i), scale(-rho, place))
        # Exp(s b) to first order: b is the error of a calibrated gyro.
        away = add(before, scale(-s, cross(path.bias, before)))
        ahead = rotated_back(R, away)
        per_length = 1.0 / norm(ahead)
        ray = scale(per_length, ahead)
        off = add(ray, scale(-1.0, column(o, RAY, i)))
        r_u = dot(column(o, TO_PIXELS, i), off)
        r_v = dot(column(o, TO_PIXELS + 3, i), off)
        squares[i] = r_u * r_u + r_v * r_v
        root = 1.0 / math.sqrt(noise.variance + 0.25 * squares[i])
        root = root if squares[i] <= noise.farthest else 0.0
        rows[FACTOR, 0, i] = rows[FACTOR, 1, i] = root
        rows[RESIDUAL, 0, i], rows[RESIDUAL, 1, i] = root * r_u, root * r_v
        for m in range(2):
            to_pixel = column(o, TO_PIXELS + 3 * m, i)
            across = add(to_pixel, scale(-dot(to_pixel, ray), ray))
            # By `away`, in the axes of camera 1; by a rotation of the camera; by its place.
            by_away = rotated(R, scale(root * per_length, across))
            turned = cross(by_away, away)
            by_place = scale(-rho, by_away)
            rows[2, m, i] = -dot(by_away, place)
            rows[PATH + LOG_SCALE, m, i] = k * dot(by_place, moved)
            for x in range(2):
                tangent = (path.basis[0, x], path.basis[1, x], path.basis[2, x])
                rows[x, m, i] = dot(by_away, column(track, COLUMNS + 3 * x, i))
                rows[PATH + TANGENT + x, m, i] = share * dot(by_place, tangent)
            for x in range(3):
                rows[PHI + x, m, i] = moves * turned[x]
                rows[PLACE + x, m, i] = by_place[x]
                rows[PATH + BIAS + x, m, i] = s * turned[x]
                for j in range(MOST_ACCELERATIONS):
                    acceleration = PATH + ACCELERATION + 3 * j + x
                    rows[acceleration, m, i] = k * bends[j] * by_place[x]


class Changes(NamedTuple):
    """What the tracks' residuals take as given, and what changes it.

    Derivatives are by the deviations of the configuration, D in all, and then by the errors that
    each frame has for itself, if they are wanted: of its rate (three axes) and of its stamp. Such
    an error of the rate turns the rows against the reference row. One of the stamp moves all rows
    in time, and turns them as far as the rate changes; its effect on the rotations between frames
    is part of their prior.
    """

    rows: RowsOfFrames  # of the N observations in V frames; arbitrary where they are not used
    turned: TurnedFrames
    rotations: Array  # (V, 3, D) changes of R_v by the deviations: rotation vectors on its left
    lens: Array  # (V, N, 3, L) of the unit rays in the camera's axes, by the entries of the lens
    # (V, 3) change of each frame's rate by time [rad/s^2]; (0, 3) without errors of its own
    rate_changes: Array


# Number of errors that a frame has for itself: of its rate (three axes), and of its stamp.
OF_FRAME = 4


@inlined_kernel
def observe_changes(
    o: Array,
    rows: Array,
    path: Path,
    changes: Changes,
    place: tuple[int, int],
    derivatives: Array,
    out: Array,
) -> None:
    """Write derivatives (columns, 2, BLOCK) of a block's residuals in one frame by all changes.

    `place`: view and number of the first track of the block; `derivatives` (D,) is room for those
    of one residual. The other arguments are those of `observe`, after it.
    """
    v, first = place
    out[:] = 0.0
    turned = part_of_frame(changes.turned.whole, changes.rows.first_knots, v)
    at_reference = changes.turned.at_reference[v]
    rotation = np.empty((3, 3))
    rate = np.empty(3)
    knot = 0
    for i in range(min(BLOCK, changes.rows.times.shape[1] - first)):
        if rows[FACTOR, 0, i] == 0.0:  # far
            continue
        tau = changes.rows.times[v, first + i]
        share = changes.rows.shares[v, first + i]
        knot = knot_before(turned.path.times, tau, knot)
        write_state(turned.path, tau, knot, rotation, rate)
        row = RowState(rotation, rate, tau, share, knot)
        bending = _bending(o[TIME, i], path.duration)
        moving = _with_accelerations(column(o, MOVING, i), bending, path)
        velocity = add(scale(1.0 / path.duration, path.t), scale(path.scale, moving))
        lens = changes.lens[v, first + i]
        for m in range(2):
            by_ray = scale(rows[FACTOR, m, i], column(o, TO_PIXELS + 3 * m, i))
            by_turn = cross(by_ray, column(o, RAY, i))
            by_phi = (rows[PHI, m, i], rows[PHI + 1, m, i], rows[PHI + 2, m, i])
            by_place = (rows[PLACE, m, i], rows[PLACE + 1, m, i], rows[PLACE + 2, m, i])
            by_time = dot(by_place, velocity)
            derivatives[:] = 0.0
            add_by_row(derivatives, by_turn, turned, row)
            add_by_delay(derivatives, by_time, share)
            for x in range(3):
                for d in range(len(derivatives)):
                    of_row = by_turn[x] * at_reference[x, d]
                    derivatives[d] += by_phi[x] * changes.rotations[v, x, d] - of_row
            by_unrotated = rotated_back(rotation, by_ray)
            for k in range(lens.shape[1]):
                derivatives[_FIRST_OF_LENS + k] -= dot(by_unrotated, column(lens, 0, k))
            for d in range(len(derivatives)):
                out[d, m, i] = derivatives[d]
            if len(changes.rate_changes) > 0:
                own = len(derivatives) + OF_FRAME * v
                for x in range(3):
                    out[own + x, m, i] = tau * by_turn[x]
                of_rate = tau * dot(by_turn, changes.rate_changes[v])
                out[own + 3, m, i] = of_rate + by_time
