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
from typing import Any, NamedTuple, Self
import zipfile

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array, validate
from rs_relpose_ros.geometry.so3 import integrated_rotations, log_so3, STANDARD_GRAVITY
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.imu.buffer import ImuInterval, ImuSamples
from rs_relpose_ros.imu.integration import force_integrals
from rs_relpose_ros.messages.outgoing import quat_xyzw
from rs_relpose_ros.odometry.states import Odometry
from rs_relpose_ros.output_files import written

ROWS_FILE = 'trajectory_rows.npz'

Stamps = NDArray[np.int64]

CAMERA, IMU, BASE = FRAMES = ('camera', 'imu', 'base')
_GRAVITY = np.array([0.0, 0.0, -STANDARD_GRAVITY])


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
        parts = []
        for path in paths:
            # A path that continues one whose end was wrong begins at its end.
            later = [knot for knot in path if not spans or knot.imu_ns >= spans[-1][1]]
            steps = [
                (one, two, samples.between(one.imu_ns, two.imu_ns)) for one, two in pairwise(later)
            ]
            pieces = [
                _between(one, two, interval)
                for one, two, interval in steps
                if interval is not None
            ]
            if len(pieces) < max(len(steps), 1):
                continue  # too short, or its samples are not there
            spans.append((later[0].imu_ns, later[-1].imu_ns))
            parts += [tuple(column[:-1] for column in piece) for piece in pieces]
            parts.append(tuple(column[-1:] for column in pieces[-1]))
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
        return np.asarray((k >= 0) & (times <= self.spans[k, 1]))

    def pose(self, t_ns: ArrayLike, frame: str = CAMERA) -> tuple[Array, Array]:
        """R (..., 3, 3) from a frame to the world, and its position (..., 3) [m].

        Raises
        ------
        InputError
            A time is outside of `spans`, or the frame is not known.
        """
        _, _, R, p, _, _ = self._at(t_ns, frame)
        return R, p

    def velocity(self, t_ns: ArrayLike, frame: str = CAMERA) -> tuple[Array, Array]:
        """Linear [m/s] and angular velocity [rad/s] (..., 3), in the axes of the frame itself."""
        mount, _, R, _, velocity, rate = self._at(t_ns, frame)
        moved = np.einsum('...ji,...j->...i', R, velocity)
        return moved + np.cross(rate, mount[:, 3]) @ mount[:, :3], rate @ mount[:, :3]

    def covariance(self, t_ns: ArrayLike, frame: str = CAMERA) -> Array:
        """Covariance (..., 6, 6) of position [m] and rotation [rad], in the axes of the world.

        That of the keyframes, linear in between. The mounting is taken as exact.
        """
        mount, times, R, _, _, _ = self._at(t_ns, frame)
        knots = self.keyframes_ns[:, 1]
        k = np.clip(np.searchsorted(knots, times, side='right') - 1, 0, len(knots) - 2)
        share = ((times - knots[k]) / np.maximum(knots[k + 1] - knots[k], 1))[..., None, None]
        covariance = (1.0 - share) * self.covariances[k] + share * self.covariances[k + 1]
        # Off the base the position also changes with the rotation.
        arm = R @ mount[:, :3].T @ (mount[:, 3] - self.mounts[FRAMES.index(BASE), :, 3])
        by = np.broadcast_to(np.eye(6), covariance.shape).copy()
        by[..., :3, 3:] = -np.cross(np.eye(3), arm[..., None, :])
        return np.asarray(by @ covariance @ np.swapaxes(by, -1, -2))

    def camera_ns(self, t_ns: ArrayLike) -> Stamps:
        """Times on the clock of the camera, as of image stamps."""
        offsets = np.diff(self.keyframes_ns)[:, 0]  # of the IMU's clock from the camera's
        times = np.asarray(t_ns)
        return times - np.rint(np.interp(times, self.keyframes_ns[:, 1], offsets)).astype(np.int64)

    def _at(self, t_ns: ArrayLike, frame: str) -> tuple[Array, Stamps, Array, Array, Array, Array]:
        """Mount, times, R and p of a frame; velocity in the world and rate of the IMU."""
        validate.choice('frame', frame, FRAMES)
        times, mount = np.asarray(t_ns), self.mounts[FRAMES.index(frame)]
        if not np.issubdtype(times.dtype, np.integer):
            raise InputError(f't_ns must be integers [ns], got {times.dtype}')
        if not (known := self.covers(times)).all():
            spans = ', '.join(f'{first} to {last}' for first, last in self.spans)
            raise InputError(
                f'there is no pose at {int(times[~known].flat[0])} ns: the '
                f'trajectory extends from {spans} ns on the clock of the IMU'
            )
        if not times.size:  # SciPy 1.11 has no empty rotations
            nothing = np.zeros((*times.shape, 3))
            return mount, times, np.zeros((*times.shape, 3, 3)), nothing, nothing, nothing
        k = np.clip(
            np.searchsorted(self.stamps_ns, times, side='right') - 1, 0, len(self.stamps_ns) - 2
        )
        step = np.maximum(self.stamps_ns[k + 1] - self.stamps_ns[k], 1)[..., None] / NANOSECONDS
        s = (times - self.stamps_ns[k])[..., None] / NANOSECONDS / step
        # Between samples: cubic polynomials with values and derivatives of both.
        first, shape = Rotation.from_quat(self.quats_xyzw[k].reshape(-1, 4)), times.shape
        turn = (
            (first.inv() * Rotation.from_quat(self.quats_xyzw[k + 1].reshape(-1, 4)))
            .as_rotvec()
            .reshape(*shape, 3)
        )
        rate1, rate2, v1, v2 = (
            values[i] for values in (self.rates, self.velocities) for i in (k, k + 1)
        )
        turned = _cubic(s, step, turn, rate1, rate2)
        R = (first * Rotation.from_rotvec(turned.reshape(-1, 3))).as_matrix().reshape(*shape, 3, 3)
        p = self.positions[k] + _cubic(s, step, self.positions[k + 1] - self.positions[k], v1, v2)
        return (
            mount,
            times,
            R @ mount[:, :3],
            p + R @ mount[:, 3],
            v1 + s * (v2 - v1),
            rate1 + s * (rate2 - rate1),
        )


def _cubic(s: Array, step: Array, way: Array, slope1: Array, slope2: Array) -> Array:
    """The cubic polynomial from 0 to `way` at s = 0 to 1 with these slopes, per `step` [s]."""
    rest1, rest2 = step * slope1 - way, step * slope2 - way
    return np.asarray(s * way + s * (1.0 - s) * ((1.0 - s) * rest1 - s * rest2))


def _between(one: Knot, two: Knot, interval: ImuInterval) -> tuple[Any, ...]:
    """Columns of the samples from one keyframe up to the next one."""
    seconds, rates, forces = interval
    rates, duration = rates - one.gyro_bias, interval.duration
    s = (seconds / duration)[:, None]
    by_gyro = Rotation.from_matrix(
        one.R @ integrated_rotations(seconds, np.ascontiguousarray(rates))
    )
    error = log_so3(by_gyro[-1].as_matrix().T @ two.R)
    closing = Rotation.from_rotvec(s * error)
    R = by_gyro * closing
    once, twice = force_integrals(np.diff(seconds), R.apply(forces - one.accel_bias))
    at = seconds[:, None]
    velocity = one.velocity + once + at * _GRAVITY
    position = one.position + at * one.velocity + twice + 0.5 * at**2 * _GRAVITY
    way, change = two.position - position[-1], duration * (two.velocity - velocity[-1])
    position = position + s**2 * (3.0 * way - change + s * (change - 2.0 * way))
    velocity = (
        velocity + s * (6.0 * way - 2.0 * change + 3.0 * s * (change - 2.0 * way)) / duration
    )
    stamps = one.imu_ns + np.rint(NANOSECONDS * seconds).astype(np.int64)
    return (stamps, R.as_quat(), position, velocity, closing.inv().apply(rates) + error / duration)


# -- files of poses ---------------------------------------------------------------------------


class StampedPose(NamedTuple):
    """The camera in the world."""

    stamp_ns: int  # on the clock of the camera
    R: Array
    position: Array


def camera_poses(rows: RowTrajectory, rate: float) -> list[StampedPose]:
    """Poses of the camera at a rate [Hz], from the begin of each span; 0: at the keyframes."""
    times = (
        rows.keyframes_ns[:, 1]
        if not rate
        else np.concatenate(
            [
                first
                + np.rint(np.arange(0.0, last - first + 1.0, NANOSECONDS / rate)).astype(np.int64)
                for first, last in rows.spans
            ]
        )
    )
    times = times[rows.covers(times)]
    return [
        StampedPose(int(stamp_ns), *pose)
        for stamp_ns, *pose in zip(rows.camera_ns(times), *rows.pose(times), strict=True)
    ]


def write_tum(path: Path, trajectory: Sequence[Odometry | StampedPose]) -> None:
    """Lines ``seconds x y z qx qy qz qw``, seconds being those of the stamps."""
    with written(path) as file:
        for pose in trajectory:
            values = [*pose.position, *quat_xyzw(pose.R)]
            file.write(
                f'{pose.stamp_ns // 10**9}.{pose.stamp_ns % 10**9:09d} '
                + ' '.join(f'{value:.9f}' for value in values)
                + '\n'
            )
