"""The methods that the experiments compare, and one estimate by one of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.estimator import EstimatorConfig
from rs_relpose_ros.estimator.estimate import estimate_relative_pose
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.replay.truth import direction_angle, rotation_angle

Array = NDArray[np.float64]

# Threshold of OpenCV's estimator [px]: the middle one of `replay.baselines.THRESHOLDS`.
_OPENCV_THRESHOLD = 1.0


@dataclass(frozen=True, slots=True)
class Method:
    """How a pair is estimated.

    Attributes
    ----------
    label : str
        For tables and legends.
    solver, refinement : str
        As in `EstimatorConfig`; no solver stands for OpenCV's estimator.
    continuous_gyro : bool
        Whether it is given the gyro over the rows and between the frames, too.
    derotated : bool
        Whether OpenCV's estimator gets the points as if all rows had been read with the middle
        one, as far as the gyro knows.
    """

    label: str
    solver: str = ''
    refinement: str = 'alternating'
    continuous_gyro: bool = False
    derotated: bool = False


# The paper's algorithms have the paper's refinement, as in its experiments; auto is the default.
METHODS: Mapping[str, Method] = {
    'global_5pt': Method('5-point', 'global_5pt'),
    'uniform_9pt': Method('9-point', 'uniform_9pt'),
    'uniform_11pt': Method('11-point', 'uniform_11pt'),
    'auto': Method('auto', 'auto', 'map'),
    'auto_gyro': Method('auto + gyro', 'auto', 'map', continuous_gyro=True),
    'angular_5pt': Method('angular 5-pt', 'angular_5pt'),
    'angular_3pt': Method('angular 3-pt', 'angular_3pt'),
    'linear_9pt': Method('linear 9-pt', 'linear_9pt'),
    'opencv': Method('OpenCV'),
    'opencv_derotated': Method('OpenCV derot.', derotated=True),
    'opencv_gyro': Method('OpenCV + gyro', derotated=True, continuous_gyro=True),
}
PAPER_METHODS = ('global_5pt', 'uniform_9pt', 'uniform_11pt', 'auto')
PENNCOSYVIO_METHODS = (*PAPER_METHODS, 'auto_gyro', 'opencv_derotated',
                       'opencv_gyro')


@dataclass(frozen=True, slots=True, eq=False)
class ContinuousGyro:
    """What a gyro that runs on knows of a pair, beyond one mean rate a frame.

    Attributes
    ----------
    motion1, motion2 : FrameMotion
        From the gyro over the rows.
    rotation, covariance : (3, 3) ndarray
        ``R_1^T R_2`` between the reference rows, and the covariance of its error [rad^2].
    interval : float
        Between the reference rows [s].
    rate_sigma : float
        Of the motions' rates, per axis [rad/s].
    gravity_sigma : float or None
        Of the motions' gravity, per axis [rad].
    """

    motion1: FrameMotion
    motion2: FrameMotion
    rotation: Array
    covariance: Array
    interval: float
    rate_sigma: float
    gravity_sigma: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PairProblem:
    """A pair of frames as every method gets it, and its truth.

    Attributes
    ----------
    points1, points2 : (N, 2) ndarray
        Matches [px].
    camera : RollingShutterCamera
    motion1, motion2 : FrameMotion
        One angular velocity and one direction of gravity each.
    R, t : (3, 3), (3,) ndarray
        True pose between the reference rows, ``X1 = R X2 + t``; t of any length.
    told : EstimatorConfig
        Noise figures that the estimator is told, and its other settings.
    quality : (N,) ndarray or None
        Of the matches.
    gyro : ContinuousGyro or None
        For the methods that use it.
    """

    points1: Array
    points2: Array
    camera: RollingShutterCamera
    motion1: FrameMotion
    motion2: FrameMotion
    R: Array
    t: Array
    told: EstimatorConfig
    quality: Array | None = None
    gyro: ContinuousGyro | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a method on a pair; errors [deg] are NaN where it gave no pose."""

    status: Status
    rotation_error: float
    translation_error: float

    @classmethod
    def of_pose(cls, R: Array, t: Array, problem: PairProblem) -> Outcome:
        """Errors of a pose against the truth of `problem`."""
        return cls(Status.OK, rotation_angle(R.T @ problem.R), direction_angle(t, problem.t))

    @classmethod
    def without_pose(cls, status: Status) -> Outcome:
        """No pose: there is nothing to compare."""
        return cls(status, float('nan'), float('nan'))


def run_method(name: str, problem: PairProblem, seed: int) -> Outcome:
    """Estimate a pair by the method `name` of `METHODS`; `seed` is that of its sampling."""
    method = METHODS[name]
    if not method.solver:
        return _opencv(problem, method)
    motion1, motion2, gyro = problem.motion1, problem.motion2, None
    config = replace(problem.told, solver=method.solver, refinement=method.refinement)
    if method.continuous_gyro:
        gyro = problem.gyro
        assert gyro is not None, f'{name} needs a pair with a continuous gyro'
        motion1, motion2 = gyro.motion1, gyro.motion2
        config = replace(config, gyro_sigma=gyro.rate_sigma)
        if gyro.gravity_sigma is not None:
            config = replace(config, gravity_sigma=min(gyro.gravity_sigma, 1.5))
    pose = estimate_relative_pose(
        problem.points1, problem.points2, problem.camera, motion1, motion2,
        relative_rotation=gyro.rotation if gyro else None,
        relative_rotation_covariance=gyro.covariance if gyro else None,
        interval=gyro.interval if gyro else None,
        config=config, rng=seed, quality=problem.quality)
    return Outcome.of_pose(pose.R, pose.t, problem) if pose \
        else Outcome.without_pose(pose.status)


def _opencv(problem: PairProblem, method: Method) -> Outcome:
    # Imported here: it brings the whole replay along.
    from rs_relpose_lab.experiments.opencv_baseline import opencv_five_point
    points1, points2, camera = problem.points1, problem.points2, problem.camera
    turns = np.eye(3), np.eye(3)
    if method.derotated:
        delay = float(camera.row_times((camera.height - 1) / 2))
        motions = problem.motion1, problem.motion2
        if method.continuous_gyro:
            assert problem.gyro is not None, 'a pair without a continuous gyro'
            motions = problem.gyro.motion1, problem.gyro.motion2
        turn1, turn2 = (motion.rotations([delay])[0] for motion in motions)
        points1, points2 = (
            _derotated(points, camera, motion, turn) for points, motion, turn in
            zip((points1, points2), motions, (turn1, turn2), strict=True))
        seen = np.isfinite(points1).all(axis=1) & np.isfinite(points2).all(axis=1)
        points1, points2 = points1[seen], points2[seen]
        turns = turn1, turn2
    pose = opencv_five_point(points1, points2, camera, 'USAC_MAGSAC', _OPENCV_THRESHOLD)
    if pose is None:
        return Outcome.without_pose(Status.NO_CONSENSUS)
    # From the middle rows to the reference rows; the camera's own way in between is not known.
    return Outcome.of_pose(turns[0] @ pose.R @ turns[1].T, turns[0] @ pose.t, problem)


def _derotated(points: Array, camera: RollingShutterCamera, motion: FrameMotion,
               turn: Array) -> Array:
    """Pixels (N, 2) at which the camera with the orientation of its middle row would see."""
    rays = motion.derotate(camera.unproject(points), camera.row_times(points[:, 1]))
    return camera.project(rays @ turn)
