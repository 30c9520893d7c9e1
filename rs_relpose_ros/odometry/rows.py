"""Poses of camera, IMU and base at any time, such as those of the rows of an image.

Smoothed keyframes are exact; between two of them the IMU is integrated from the first one, with
its biases, and the error at the second one is spread over the interval: in the rotation as a
constant rate, in the position as the cubic polynomial that is zero at the first keyframe and
meets position and velocity at the second one. A constant error of rate or acceleration in the
interval cancels thereby.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, Self
import zipfile

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array, validate
from rs_relpose_ros.geometry.gyro import integrated_rotations
from rs_relpose_ros.geometry.so3 import log_so3, STANDARD_GRAVITY
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.imu.buffer import ImuInterval, ImuSamples
from rs_relpose_ros.imu.integration import force_integrals
from rs_relpose_ros.messages.outgoing import quat_xyzw
from rs_relpose_ros.output_files import written

# Name of the file that `RowTrajectory` writes and reads, part of the public interface.
ROWS_FILE = 'trajectory_rows.npz'

Stamps = NDArray[np.int64]

CAMERA = 'camera'  # optical axes of the camera
IMU = 'imu'  # axes of the IMU
BASE = 'base'  # `base_frame`, the robot
# Frames whose poses a trajectory gives.
FRAMES = (CAMERA, IMU, BASE)
_GRAVITY = np.array([0.0, 0.0, -STANDARD_GRAVITY])  # of the world, z up [m/s^2]
# Columns of the samples of a trajectory, in the order of `RowTrajectory`.
_Columns = tuple[Stamps, Array, Array, Array, Array]


class Knot(NamedTuple):
    """A smoothed keyframe."""

    camera_ns: int  # the same time on both clocks
    imu_ns: int
    R: Array  # (3, 3) from the IMU to the world
    position: Array  # (3,) of the IMU [m]
    velocity: Array  # (3,) of the IMU in the world [m/s]
    gyro_bias: Array
    accel_bias: Array
    covariance: Array  # (6, 6) of the base's position and rotation, in the axes of the world


class ArrayFile:
    """A dataclass of arrays that is written and read as an npz file."""

    __slots__ = ()
    __match_args__: tuple[str, ...]

    def save(self, path: Path | str) -> None:
        """Write an npz file of the attributes, exactly."""
        with written(Path(path), 'wb') as file:
            np.savez_compressed(
                file, **{name: getattr(self, name) for name in self.__match_args__}
            )

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a file of `save`; InputError if it is none."""
        try:
            with Path(path).open('rb') as stream, np.load(stream, allow_pickle=False) as file:
                return cls(**{name: file[name] for name in cls.__match_args__})
        except FileNotFoundError:
            raise InputError(f'{path} does not exist: `rs_relpose odometry` writes it') from None
        except (ValueError, TypeError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(
                f'{path} is damaged or no file of `rs_relpose odometry`: {error}'
            ) from error


@dataclass(frozen=True, slots=True, eq=False)
class RowTrajectory(ArrayFile):
    """Metric poses in a world with z up, at any time within `spans`.

    Times are integers [ns] on the **clock of the IMU**, scalars or arrays (N,). That of row v of
    an image is ``stamp + time_offset + (v - v_stamp) line_delay`` (docs/conventions.md). Frames
    are 'camera' (optical axes), 'imu' and 'base', which is the camera without `base_frame`.

    Attributes
    ----------
    spans : (S, 2) ndarray of int64
        First and last times of the stretches with poses; there is none in the gaps between.
    stamps_ns : (K,) ndarray of int64
        Times of the samples; all following (K, ...) arrays are of the IMU.
    quats_xyzw, positions, velocities, rates : (K, 4), (K, 3), (K, 3), (K, 3) ndarrays
        Orientation in the world, position [m] and velocity [m/s] there, and angular velocity in
        the axes of the IMU [rad/s].
    keyframes_ns : (M, 2) ndarray of int64
        Times of the keyframes on the clock of the camera and on that of the IMU.
    covariances : (M, 6, 6) ndarray
        Of the base's position [m] and rotation [rad] at the keyframes, in the world's axes.
    mounts : (3, 3, 4) ndarray
        R and p of camera, IMU and base on the IMU: ``X_imu = R X_frame + p``.
    loops_ns : (L, 2) ndarray of int64
        Times of the two keyframes that each loop closure relates.
    """

    spans: Stamps
    stamps_ns: Stamps
    quats_xyzw: Array
    positions: Array
    velocities: Array
    rates: Array
    keyframes_ns: Stamps
    covariances: Array
    mounts: Array
    loops_ns: Stamps

    @classmethod
    def of_paths(
        cls,
        paths: Iterable[Sequence[Knot]],
        samples: ImuSamples,
        mounts: Array,
        loops_ns: Sequence[tuple[int, int]] = (),
    ) -> RowTrajectory:
        """From the keyframes of consecutive paths and the samples of the IMU, at least two."""
        spans: list[tuple[int, int]] = []
        knots: list[Knot] = []
        parts: list[_Columns] = []
        for path in paths:
            # A path that continues one whose end was wrong begins at its end.
            later = [knot for knot in path if not spans or knot.imu_ns >= spans[-1][1]]
            pieces = _pieces(later, samples)
            if not pieces:
                continue
            spans.append((later[0].imu_ns, later[-1].imu_ns))
            parts += pieces
            knots += later
        if not spans:
            raise InputError(
                'there are no two keyframes with the IMU between them: a trajectory '
                'needs an odometry that has started'
            )
        stamps, quats, positions, velocities, rates = (
            np.concatenate(column) for column in zip(*parts, strict=True)
        )
        return cls(
            np.array(spans),
            stamps,
            quats,
            positions,
            velocities,
            rates,
            np.array([(knot.camera_ns, knot.imu_ns) for knot in knots]),
            np.array([knot.covariance for knot in knots]),
            mounts,
            np.array(loops_ns, dtype=np.int64).reshape(-1, 2),
        )

    # -- queries ---------------------------------------------------------------------------------

    def covers(self, t_ns: ArrayLike) -> NDArray[np.bool_]:
        """Whether there are poses at these times."""
        times = np.asarray(t_ns)
        k = np.searchsorted(self.spans[:, 0], times, side='right') - 1
        last = self.spans[k, 1]
        return np.asarray((k >= 0) & (times <= last))

    def pose(
        self,
        t_ns: ArrayLike,
        frame: str = CAMERA,
    ) -> tuple[Array, Array]:
        """R (..., 3, 3) from a frame to the world, and its position (..., 3) [m].

        Raises
        ------
        InputError
            A time is outside of `spans`, or the frame is not known.
        """
        mount = self._mount(frame)
        R, position, _, _ = self._imu_at(self._covered(t_ns))
        return R @ mount[:, :3], position + R @ mount[:, 3]

    def velocity(
        self,
        t_ns: ArrayLike,
        frame: str = CAMERA,
    ) -> tuple[Array, Array]:
        """Linear [m/s] and angular velocity [rad/s] (..., 3), in the axes of the frame itself."""
        mount = self._mount(frame)
        R, _, velocity, rate = self._imu_at(self._covered(t_ns))
        axes, arm = mount[:, :3], mount[:, 3]
        moved = np.einsum('...ji,...j->...i', R @ axes, velocity)
        return moved + np.cross(rate, arm) @ axes, rate @ axes

    def covariance(
        self,
        t_ns: ArrayLike,
        frame: str = CAMERA,
    ) -> Array:
        """Covariance (..., 6, 6) of position [m] and rotation [rad], in the axes of the world.

        It is that of the keyframes, linear in between. The mounting is taken as exact.
        """
        mount = self._mount(frame)
        base_mount = self._mount(BASE)
        times = self._covered(t_ns)
        knots = self.keyframes_ns[:, 1]
        k, share = _between_stamps(knots, times)
        share = share[..., None, None]
        before, after = self.covariances[k], self.covariances[k + 1]
        covariance = (1.0 - share) * before + share * after
        # The position of a frame beside the base also changes with the rotation of the base.
        R, _, _, _ = self._imu_at(times)
        arm = R @ (mount[:, 3] - base_mount[:, 3])
        by = np.broadcast_to(np.eye(6), covariance.shape).copy()
        by[..., :3, 3:] = -np.cross(np.eye(3), arm[..., None, :])
        transposed = np.swapaxes(by, -1, -2)
        return np.asarray(by @ covariance @ transposed)

    def camera_ns(self, t_ns: ArrayLike) -> Stamps:
        """Times on the clock of the camera, as of image stamps."""
        offsets = np.diff(self.keyframes_ns)[:, 0]  # of the IMU's clock from the camera's
        times = np.asarray(t_ns)
        return times - np.rint(np.interp(times, self.keyframes_ns[:, 1], offsets)).astype(np.int64)

    def _mount(self, frame: str) -> Array:
        """R and p (3, 4) of a frame on the IMU."""
        validate.choice('frame', frame, FRAMES)
        return np.asarray(self.mounts[FRAMES.index(frame)])

    def _covered(self, t_ns: ArrayLike) -> Stamps:
        """Times as an array; InputError if one of them has no pose."""
        times = np.asarray(t_ns)
        if not np.issubdtype(times.dtype, np.integer):
            raise InputError(f't_ns must be integers [ns], got {times.dtype}')
        known = self.covers(times)
        if not known.all():
            spans = ', '.join(f'{first} to {last}' for first, last in self.spans)
            raise InputError(
                f'there is no pose at {int(times[~known].flat[0])} ns: the '
                f'trajectory extends from {spans} ns on the clock of the IMU'
            )
        return times

    def _imu_at(self, times: Stamps) -> tuple[Array, Array, Array, Array]:
        """The IMU at times (...): R, position and velocity in the world; rate in its own axes."""
        shape = times.shape
        if not times.size:  # SciPy 1.11 has no empty rotations
            nothing = np.zeros((*shape, 3))
            return np.zeros((*shape, 3, 3)), nothing, nothing, nothing
        k, share = _between_stamps(self.stamps_ns, times)
        duration_ns = self.stamps_ns[k + 1] - self.stamps_ns[k]
        step = duration_ns[..., None] / NANOSECONDS
        share = share[..., None]
        rate1, rate2 = self.rates[k], self.rates[k + 1]
        velocity1, velocity2 = self.velocities[k], self.velocities[k + 1]
        # Between samples rotation and position are cubic polynomials with the values and the
        # derivatives of both samples.
        quats1 = self.quats_xyzw[k].reshape(-1, 4)
        quats2 = self.quats_xyzw[k + 1].reshape(-1, 4)
        first, second = Rotation.from_quat(quats1), Rotation.from_quat(quats2)
        turn = (first.inv() * second).as_rotvec().reshape(*shape, 3)
        turned = _cubic(share, step, turn, rate1, rate2)
        at_time = first * Rotation.from_rotvec(turned.reshape(-1, 3))
        R = at_time.as_matrix().reshape(*shape, 3, 3)
        position1, position2 = self.positions[k], self.positions[k + 1]
        moved = _cubic(share, step, position2 - position1, velocity1, velocity2)
        velocity = velocity1 + share * (velocity2 - velocity1)
        rate = rate1 + share * (rate2 - rate1)
        return R, position1 + moved, velocity, rate


def _between_stamps(stamps: Stamps, times: Stamps) -> tuple[Stamps, Array]:
    """Indices (...) of the stamps before times, and the times as shares of the steps from them."""
    k = np.searchsorted(stamps, times, side='right') - 1
    k = np.clip(k, 0, len(stamps) - 2)
    begin, end = stamps[k], stamps[k + 1]
    return k, np.asarray((times - begin) / np.maximum(end - begin, 1))


def _cubic(
    s: Array,
    step: Array,
    way: Array,
    slope1: Array,
    slope2: Array,
) -> Array:
    """The cubic polynomial from 0 to `way` at s = 0 to 1 with these slopes, per `step` [s]."""
    rest1 = step * slope1 - way
    rest2 = step * slope2 - way
    bend = (1.0 - s) * rest1 - s * rest2
    return np.asarray(s * way + s * (1.0 - s) * bend)


def _pieces(path: Sequence[Knot], samples: ImuSamples) -> list[_Columns]:
    """Columns of the samples of a path; none if it is too short, or samples are missing."""
    pieces = []
    for one, two in pairwise(path):
        interval = samples.between(one.imu_ns, two.imu_ns)
        if interval is None:
            return []
        pieces.append(_between(one, two, interval))
    if not pieces:
        return []
    # A keyframe is the last sample of one piece and the first one of the next: it counts once.
    parts = [_cut(piece, slice(None, -1)) for piece in pieces]
    return [*parts, _cut(pieces[-1], slice(-1, None))]


def _cut(columns: _Columns, part: slice) -> _Columns:
    """Some rows of all columns."""
    stamps, quats, positions, velocities, rates = columns
    return stamps[part], quats[part], positions[part], velocities[part], rates[part]


def _between(
    one: Knot,
    two: Knot,
    interval: ImuInterval,
) -> _Columns:
    """Columns of the samples from one keyframe up to the next one."""
    seconds = interval.seconds[:, None]
    duration = interval.duration
    share = seconds / duration
    rates = interval.rates - one.gyro_bias
    turns = integrated_rotations(interval.seconds, np.ascontiguousarray(rates))
    by_gyro = Rotation.from_matrix(one.R @ turns)
    # The error of the rotation at the second keyframe is spread as a constant rate.
    last_R = by_gyro[-1].as_matrix()
    error = log_so3(last_R.T @ two.R)
    closing = Rotation.from_rotvec(share * error)
    R = by_gyro * closing
    forces = R.apply(interval.forces - one.accel_bias)
    once, twice = force_integrals(interval.seconds, forces)
    velocity = one.velocity + once + seconds * _GRAVITY
    position = one.position + seconds * one.velocity + twice + 0.5 * seconds**2 * _GRAVITY
    # The errors of position and velocity there are spread as a cubic polynomial.
    way = two.position - position[-1]
    change = duration * (two.velocity - velocity[-1])
    bend = change - 2.0 * way
    position = position + share**2 * (3.0 * way - change + share * bend)
    slope = 6.0 * way - 2.0 * change + 3.0 * share * bend
    velocity = velocity + share * slope / duration
    since_ns = np.rint(NANOSECONDS * interval.seconds).astype(np.int64)
    turning = closing.inv().apply(rates) + error / duration
    return one.imu_ns + since_ns, R.as_quat(), position, velocity, turning


# -- files of poses ---------------------------------------------------------------------------


# A time on the clock of the camera [ns], with rotation and position of the camera in the world.
StampedPose = tuple[int, Array, Array]


def camera_poses(rows: RowTrajectory, rate: float) -> list[StampedPose]:
    """Poses of the camera at a rate [Hz], from the begin of each span; 0: at the keyframes."""
    times = rows.keyframes_ns[:, 1]
    if rate:
        step = NANOSECONDS / rate
        times = np.concatenate(
            [
                first + np.rint(np.arange(0.0, last - first + 1.0, step)).astype(np.int64)
                for first, last in rows.spans
            ]
        )
    times = times[rows.covers(times)]
    R, positions = rows.pose(times)
    return list(zip(rows.camera_ns(times).tolist(), R, positions, strict=True))


def write_tum(path: Path, poses: Iterable[StampedPose]) -> None:
    """Lines ``seconds x y z qx qy qz qw``, seconds being those of the stamps."""
    with written(path) as file:
        for stamp_ns, R, position in poses:
            seconds, rest = divmod(stamp_ns, NANOSECONDS)
            numbers = ' '.join(f'{value:.9f}' for value in (*position, *quat_xyzw(R)))
            file.write(f'{seconds}.{rest:09d} {numbers}\n')
