"""The estimators that are compared: this library, OpenCV's and PoseLib's, on the same matches.

OpenCV and PoseLib assume a global shutter. *Derotated* points are rotated by the gyro to the time
of the middle row, which is all that a user of theirs can do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
import importlib
import importlib.util
from typing import Any, Literal

import cv2
import numpy as np

from rs_relpose_lab.experiments import problems
from rs_relpose_lab.experiments.scoring import NO_POSE, pose_error, PoseError
from rs_relpose_ros.config.settings import EstimatorConfig
from rs_relpose_ros.estimator.arguments import estimate_relative_pose
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.motion import FrameMotion

# Camera of the problems that are drawn at random.
CAMERA = RollingShutterCamera(
    width=problems.WIDTH,
    height=problems.HEIGHT,
    fx=problems.FOCAL,
    fy=problems.FOCAL,
    cx=problems.CENTRE_U,
    cy=problems.CENTRE_V,
    readout_time=problems.HEIGHT * problems.LINE_DELAY,
)


@dataclass(frozen=True, slots=True)
class Method:
    """How a pair is estimated."""

    label: str
    solver: str = ''  # of this library, as in `EstimatorConfig`
    refinement: str = 'alternating'  # likewise
    library: Literal['', 'opencv', 'poselib'] = ''  # another one
    derotated: bool = False  # points are derotated by the gyro to the middle row
    continuous_gyro: bool = False  # the gyro over the rows and between the frames is used, too
    threshold: float = 1.0  # of another library [px]


# Of a pose [deg]: 0.5 rad, independent of the node's limit. For the other libraries, without
# sigmas, all poses count.
MAX_TRANSLATION_SIGMA = float(np.degrees(0.5))

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
    'opencv': Method('OpenCV', library='opencv'),
    'opencv_derotated': Method('OpenCV derot.', library='opencv', derotated=True),
    'opencv_gyro': Method('OpenCV + gyro', library='opencv', derotated=True, continuous_gyro=True),
} | (
    {
        'poselib': Method('PoseLib', library='poselib', threshold=1.5),
        'poselib_derotated': Method(
            'PoseLib derot.', library='poselib', derotated=True, threshold=1.5
        ),
        'poselib_gyro': Method(
            'PoseLib + gyro',
            library='poselib',
            derotated=True,
            continuous_gyro=True,
            threshold=1.5,
        ),
    }
    if importlib.util.find_spec('poselib') is not None
    else {}
)


@dataclass(frozen=True, slots=True, eq=False)
class ContinuousGyro:
    """Motion of a pair by a continuous gyro, in addition to one mean rate a frame."""

    motion1: FrameMotion
    motion2: FrameMotion
    rotation: Array  # (3, 3) ``R_1^T R_2`` between the reference rows
    covariance: Array  # (3, 3) of its error [rad^2]
    interval: float  # [s] between the reference rows
    rate_sigma: float  # [rad/s] of the motions, per axis
    gravity_sigma: float | None = None  # [rad] likewise


@dataclass(frozen=True, slots=True, eq=False)
class PairProblem:
    """A pair of frames as every method gets it, and its truth."""

    points1: Array  # (N, 2) matches [px]
    points2: Array
    camera: RollingShutterCamera
    motion1: FrameMotion  # one angular velocity and one direction of gravity
    motion2: FrameMotion
    R: Array  # true pose between the reference rows, ``X1 = R X2 + t``
    t: Array  # of any length
    configured: EstimatorConfig  # noise levels among them
    quality: Array | None = None  # (N,) of the matches
    gyro: ContinuousGyro | None = None

    def error(self, pose: Pose | RelativePose | None) -> PoseError:
        """Error of a pose; `NO_POSE` where there is none."""
        if not pose:
            return NO_POSE
        return pose_error(pose.R, pose.t, self.R, self.t, pose.covariance)


def as_pair(
    problem: problems.TwoViewProblem, cell: problems.Cell, sigma_factor: float = 1.0
) -> PairProblem:
    """A random problem of a cell; the configured sigmas are the true ones, times a factor."""
    # Sigmas must be positive, also where there is no noise at all.
    configured = EstimatorConfig(
        pixel_sigma=max(cell.pixel_noise * sigma_factor, 0.01),
        gravity_sigma=max(float(np.radians(cell.gravity_noise)) * sigma_factor, 1e-5),
        gyro_sigma=max(float(np.radians(cell.gyro_noise)) * sigma_factor, 1e-6),
    )
    return PairProblem(
        problem.points1,
        problem.points2,
        CAMERA,
        FrameMotion(problem.measured_rate1, problem.measured_gravity1),
        FrameMotion(problem.measured_rate2, problem.measured_gravity2),
        problem.R,
        problem.t,
        configured,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Pose ``X1 = R X2 + t``, t of unit length, of a library without covariance."""

    R: Array
    t: Array
    covariance: None = None

    @classmethod
    def of_inverse(cls, R: Array, t: Array) -> Pose:
        """From ``X2 = R X1 + t``, as OpenCV and PoseLib have it."""
        return cls(np.asarray(R.T), np.asarray(-R.T @ t))


# The call that is timed where time counts.
Estimate = Callable[[], 'Pose | RelativePose | None']


def prepared(method: Method, problem: PairProblem, seed: int) -> Estimate:
    """The estimate of a pair by a method, as a call; `seed` is that of its sampling."""
    if not method.library:
        return _of_this_library(method, problem, seed)
    motions = problem.motion1, problem.motion2
    if method.continuous_gyro:
        assert problem.gyro is not None, f'{method.label} needs a pair with a continuous gyro'
        motions = problem.gyro.motion1, problem.gyro.motion2
    points = [problem.points1, problem.points2]
    middle = (np.eye(3), np.eye(3))
    if method.derotated:
        points, middle = _derotated(points, problem.camera, motions)
    pixels = [undistorted(p, problem.camera) for p in points]
    five_point = opencv_five_point if method.library == 'opencv' else poselib_five_point

    def call() -> Pose | None:
        pose = five_point(pixels[0], pixels[1], problem.camera, method.threshold, seed=seed)
        if pose is None:
            return None
        # From the middle rows to the reference rows; how the camera moved in between is unknown.
        return replace(pose, R=middle[0] @ pose.R @ middle[1].T, t=middle[0] @ pose.t)

    return call


def run_method(name: str, problem: PairProblem, seed: int) -> tuple[Status, PoseError]:
    """Estimate a pair by the method `name` of `METHODS`."""
    pose = prepared(METHODS[name], problem, seed)()
    status = (
        pose.status
        if isinstance(pose, RelativePose)
        else (Status.OK if pose else Status.NO_CONSENSUS)
    )
    return status, problem.error(pose)


def _of_this_library(method: Method, problem: PairProblem, seed: int) -> Estimate:
    motion1 = problem.motion1
    motion2 = problem.motion2
    gyro = None
    config = replace(
        problem.configured,
        solver=method.solver,
        refinement=method.refinement,
        max_translation_sigma=MAX_TRANSLATION_SIGMA,
    )
    if method.continuous_gyro:
        gyro = problem.gyro
        assert gyro is not None, f'{method.label} needs a pair with a continuous gyro'
        motion1 = gyro.motion1
        motion2 = gyro.motion2
        config = replace(config, gyro_sigma=gyro.rate_sigma)
        if gyro.gravity_sigma is not None:
            config = replace(config, gravity_sigma=min(gyro.gravity_sigma, 1.5))
    return lambda: estimate_relative_pose(
        problem.points1,
        problem.points2,
        problem.camera,
        motion1,
        motion2,
        relative_rotation=gyro.rotation if gyro else None,
        relative_rotation_covariance=gyro.covariance if gyro else None,
        interval=gyro.interval if gyro else None,
        config=config,
        rng=seed,
        quality=problem.quality,
    )


def _derotated(
    points: list[Array],
    camera: RollingShutterCamera,
    motions: tuple[FrameMotion, FrameMotion],
) -> tuple[list[Array], tuple[Array, Array]]:
    """Pixels of the points in cameras with the orientation of their middle rows.

    Also each camera's rotation from its reference row to its middle row. Matches with a point
    outside of the lens are left out.
    """
    delay = float(camera.row_times((camera.height - 1) / 2))
    middle1, middle2 = (motion.rotations([delay])[0] for motion in motions)
    moved = [
        camera.project(motion.derotate(camera.unproject(p), camera.row_times(p[:, 1])) @ R)
        for p, motion, R in zip(points, motions, (middle1, middle2), strict=True)
    ]
    observed = np.isfinite(np.hstack(moved)).all(axis=1)
    return [p[observed] for p in moved], (middle1, middle2)


def undistorted(points: Array, camera: RollingShutterCamera) -> Array:
    """Pixels (N, 2) of the pinhole camera with the same focal lengths and centre."""
    rays = camera.unproject(points)
    return np.ascontiguousarray(
        rays[:, :2] / rays[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    )


# OpenCV's robust estimators by the names of their methods.
OPENCV_ESTIMATORS = {'RANSAC': cv2.RANSAC, 'USAC_MAGSAC': cv2.USAC_MAGSAC}


def opencv_five_point(
    pixels1: Array,
    pixels2: Array,
    camera: RollingShutterCamera,
    threshold: float,
    *,
    estimator: str = 'USAC_MAGSAC',
    seed: int = 0,
) -> Pose | None:
    """Pose by OpenCV's essential matrix, as if both images had a global shutter, or None.

    `pixels1`, `pixels2` (N, 2): undistorted; `threshold` [px]; `estimator` of `OPENCV_ESTIMATORS`.
    """
    if len(pixels1) < 5:
        return None
    K = camera.camera_matrix
    cv2.setRNGSeed(seed)
    try:
        essential, mask = cv2.findEssentialMat(
            pixels1,
            pixels2,
            K,
            method=OPENCV_ESTIMATORS[estimator],
            prob=0.999,
            threshold=threshold,
        )
        # Several solutions come stacked; none comes as None.
        if np.shape(essential) != (3, 3):
            return None
        count, R, t, _ = cv2.recoverPose(essential, pixels1, pixels2, K, mask=mask)
    except cv2.error:  # too few, or degenerate
        return None
    if not count:
        return None
    return Pose.of_inverse(
        np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64).ravel()
    )


def poselib_five_point(
    pixels1: Array,
    pixels2: Array,
    camera: RollingShutterCamera,
    threshold: float,
    *,
    seed: int = 0,
) -> Pose | None:
    """Pose by PoseLib's `estimate_relative_pose` with default options; else as OpenCV's."""
    library: Any = importlib.import_module('poselib')
    pinhole = {
        'model': 'PINHOLE',
        'width': camera.width,
        'height': camera.height,
        'params': [camera.fx, camera.fy, camera.cx, camera.cy],
    }
    pose, _ = library.estimate_relative_pose(
        pixels1, pixels2, pinhole, pinhole, {'max_epipolar_error': threshold, 'seed': seed}, {}
    )
    length = np.linalg.norm(pose.t)
    if not length > 0.0:
        return None
    return Pose.of_inverse(pose.R, pose.t / length)
