"""The arguments of `estimate_relative_pose`, checked and put together to a `PairProblem`.

Each error names the argument, what is legal, and what came.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from numpy.typing import ArrayLike

from rs_relpose_ros.config.settings import EstimatorConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.estimate import estimate, with_global_shutter_pixels
from rs_relpose_ros.estimator.pair_problem import PairProblem
from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.geometry import Array, validate
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.matches import Matches
from rs_relpose_ros.geometry.motion import FrameMotion, InertialMotion

# Largest magnitude of a pixel's coordinate [px]. A larger one is a mistake of the caller, and its
# square would lose all digits. [chosen: any value in 1e5..1e7 is beyond every image]
_LARGEST_PIXEL = 1e6
# Largest variance of a predicted rotation [rad^2]. A rotation that is not known at all has 10; the
# bound only keeps products finite. [chosen: any value in 1e2..1e15 would do]
_LARGEST_COVARIANCE = 1e12
# Shortest and longest time between two frames [s]: beyond them a unit was mistaken.
# [chosen: a camera has 1e-4 s at least, and a recording 1e5 s at most]
_SHORTEST = 1e-6
# [chosen: the same]
_LONGEST = 1e6
# Largest difference of two values for the same time [s]: stamps have nanoseconds.
# [chosen: any value in 1e-9..1e-4 would do]
_SAME_TIME = 1e-6


def _checked_rotation(
    rotation: ArrayLike | None, covariance: ArrayLike | None, of: str = ''
) -> tuple[Array | None, Array | None]:
    """A predicted rotation with its covariance, or None twice."""
    if rotation is None and covariance is None:
        return None, None
    if rotation is None or covariance is None:
        raise InputError(
            f'relative_rotation and relative_rotation_covariance{of} go together: '
            'give both or neither'
        )
    checked = validate.covariance(
        f'relative_rotation_covariance{of}',
        covariance,
        3,
        largest=_LARGEST_COVARIANCE,
        unit='rad^2',
        rounding=1e-12,
    )
    return validate.rotations(f'relative_rotation{of}', rotation), checked


@dataclass(frozen=True, slots=True, eq=False)
class IntermediateFrame:
    """A frame between the two of a pair, as an argument of `estimate_relative_pose`.

    Parameters
    ----------
    points : (N, 2) array_like
        Raw pixels, a row for each match of the pair; NaN where it was not tracked.
    motion : FrameMotion
        Angular velocity at its reference row.
    interval : float
        Seconds from the first frame's reference row to its own.
    relative_rotation, relative_rotation_covariance : (3, 3) array_like, optional
        ``R_1^T R`` of its reference row by the gyro, as for the second frame.
    inertial : InertialMotion, optional
        From the first frame to this one, with the gravity that the second frame's has.

    Raises
    ------
    InputError
        A value of the wrong shape, or not finite.
    """

    points: Array
    motion: FrameMotion
    interval: float
    relative_rotation: Array | None = None
    relative_rotation_covariance: Array | None = None
    inertial: InertialMotion | None = None

    def __post_init__(self) -> None:
        points = np.array(self.points, dtype=np.float64, order='C')
        validate.array(
            'points of a frame between',
            np.nan_to_num(points, nan=0.0, posinf=np.inf),
            ('N', 2),
            largest=_LARGEST_PIXEL,
            unit='px',
        )
        validate.number('interval of a frame between', self.interval, _SHORTEST, _LONGEST, 's')
        R, covariance = _checked_rotation(
            self.relative_rotation, self.relative_rotation_covariance, ' of a frame between'
        )
        object.__setattr__(self, 'points', points)
        object.__setattr__(self, 'relative_rotation', R)
        object.__setattr__(self, 'relative_rotation_covariance', covariance)
        if self.inertial is None:
            return
        if not math.isclose(self.inertial.duration, self.interval, abs_tol=_SAME_TIME):
            raise InputError(
                'the interval of a frame between must equal the duration of its '
                f'inertial, got {self.interval:.9g} and '
                f'{self.inertial.duration:.9g} s'
            )


def estimate_relative_pose(
    points1: ArrayLike,
    points2: ArrayLike,
    camera: RollingShutterCamera,
    motion1: FrameMotion,
    motion2: FrameMotion,
    relative_rotation: ArrayLike | None = None,
    relative_rotation_covariance: ArrayLike | None = None,
    interval: float | None = None,
    config: EstimatorConfig | None = None,
    rng: int | np.random.Generator = 0,
    *,
    quality: ArrayLike | None = None,
    inertial: InertialMotion | None = None,
    between: Sequence[IntermediateFrame] = (),
    global_shutter_pixels: bool = False,
) -> RelativePose:
    """Relative pose of two rolling-shutter frames from matches, gyro and gravity.

    Parameters
    ----------
    points1, points2 : (N, 2) array_like
        Matches in raw (distorted) pixels.
    camera : RollingShutterCamera
        The pose relates its reference rows.
    motion1, motion2 : FrameMotion
        Angular velocity and gravity of each frame at its reference row; gravity may be None.
    relative_rotation, relative_rotation_covariance : (3, 3) array_like, optional
        ``R_1^T R_2`` between the reference rows as predicted from the gyro, and the covariance of
        its error in camera 1 [rad^2]: ``R_true = Exp(dtheta) relative_rotation``.
    interval : float, optional
        Seconds between the two reference rows, for velocities of `EstimatorConfig.motion`.
    rng : int or numpy.random.Generator
        Equal input and state give an equal result, bit by bit.
    quality : (N,) array_like, optional
        Higher is better: the sampling order of the matches.
    inertial : InertialMotion, optional
        Preintegrated acceleration between the two reference rows: determines velocities and
        baseline in metres. `interval` must be its duration, or None.
    between : sequence of IntermediateFrame
        Frames between the two, in the order of time; requires `interval` or `inertial`.
    global_shutter_pixels : bool
        Whether the result has `pixels1_gs` and `pixels2_gs`.

    Returns
    -------
    RelativePose
        Falsy, with `status` and `reason`, if the data determine no pose. InputError (a
        ValueError) is raised for arguments of the wrong shape, not finite, or contradictory.
    """
    matches = _checked_matches(points1, points2, quality)
    rotation = _checked_rotation(relative_rotation, relative_rotation_covariance)
    last = motion2, _checked_interval(interval, inertial), rotation, inertial
    seed = int(np.random.default_rng(rng).integers(2**63))
    problem = _problem(matches, camera, motion1, last, between, config or EstimatorConfig(), seed)
    pose = estimate(problem)
    return with_global_shutter_pixels(pose, problem) if global_shutter_pixels and pose else pose


# Of the second frame: motion, time since the first one, rotation with covariance, acceleration.
_Last = tuple[FrameMotion, float | None, tuple[Array | None, Array | None], InertialMotion | None]


def _problem(
    matches: Matches,
    camera: RollingShutterCamera,
    motion1: FrameMotion,
    last: _Last,
    between: Sequence[IntermediateFrame],
    config: EstimatorConfig,
    seed: int,
) -> PairProblem:
    """The problem of the checked arguments; InputError if `between` does not fit them."""
    motion2, interval, (rotation, covariance), inertial = last
    _check_between(between, matches.points1, interval)
    if between:
        points = [matches.points1, *(frame.points for frame in between), matches.points2]
        matches = replace(matches, points=np.stack(points))
    rotations = [frame.relative_rotation for frame in between]
    covariances = [frame.relative_rotation_covariance for frame in between]
    end = math.nan if interval is None else interval
    return PairProblem(
        matches,
        camera,
        (motion1, *(frame.motion for frame in between), motion2),
        np.array([0.0, *(frame.interval for frame in between), end]),
        _after_first(np.eye(3), [*rotations, rotation]),
        _after_first(np.zeros((3, 3)), [*covariances, covariance]),
        (None, *(frame.inertial for frame in between), inertial),
        config,
        seed,
    )


def _checked_matches(points1: ArrayLike, points2: ArrayLike, quality: ArrayLike | None) -> Matches:
    """Matches of two frames; without `quality` they are equally good."""
    count: int | str = 'N'
    points = []
    for name, value in (('points1', points1), ('points2', points2)):
        empty = value.size == 0 if isinstance(value, np.ndarray) else value in ([], ())
        checked = validate.array(
            name,
            np.empty((0, 2)) if empty else value,
            (count, 2),
            largest=_LARGEST_PIXEL,
            unit='px',
        )
        count = len(checked)
        points.append(checked)
    ids = np.arange(len(points[0]), dtype=np.uint32)
    if quality is None:
        return Matches(ids, np.stack(points), np.ones(len(ids)))
    return Matches(ids, np.stack(points), validate.array('quality', quality, (count,)))


def _checked_interval(interval: float | None, inertial: InertialMotion | None) -> float | None:
    """Seconds between the frames: `interval` or the duration of `inertial`; None without both."""
    if interval is not None:
        interval = validate.number('interval', interval, _SHORTEST, _LONGEST, 's')
    if inertial is None:
        return interval
    if interval is not None and not math.isclose(interval, inertial.duration, abs_tol=_SAME_TIME):
        raise InputError(
            'interval must equal the duration of inertial, '
            f'got {interval:.9g} and {inertial.duration:.9g} s'
        )
    return inertial.duration


def _check_between(
    between: Sequence[IntermediateFrame], points1: Array, interval: float | None
) -> None:
    """InputError unless the frames fit the interval [s] and the matches `points1` (N, 2)."""
    if not between:
        return
    if interval is None:
        raise InputError('between requires interval (or inertial) of the second frame')
    before = 0.0
    for frame in between:
        if len(frame.points) != len(points1):
            raise InputError(
                'points of a frame between must have a row for each match, '
                f'{points1.shape}, got {frame.points.shape}'
            )
        if not before < frame.interval < interval:
            raise InputError(
                'intervals of the frames between must increase and be less than '
                f'interval = {interval:.9g} s, got {frame.interval:.9g} after '
                f'{before:.9g} s'
            )
        before = frame.interval


def _after_first(first: Array, others: Sequence[Array | None]) -> Array:
    """Matrices (V, 3, 3) of the first frame and of the others; NaN where there is none."""
    matrices = np.full((len(others) + 1, 3, 3), math.nan)
    matrices[0] = first
    for number, matrix in enumerate(others, 1):
        if matrix is not None:
            matrices[number] = matrix
    return matrices
