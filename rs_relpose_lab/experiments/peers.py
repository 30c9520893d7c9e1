"""Estimators to be compared: this library, OpenCV and PoseLib, on the same matches.

OpenCV and PoseLib know no rolling shutter. *Derotated* points have been turned by the gyro to the
instant of row 0, which is all that a user of theirs can do about it; that time is not counted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import importlib
import importlib.util
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.accuracy import estimate, told_config
from rs_relpose_lab.experiments.problems import (
    Cell,
    CENTRE_U,
    CENTRE_V,
    FOCAL,
    HEIGHT,
    LINE_DELAY,
    TwoViewProblem,
    WIDTH,
)

Array = NDArray[np.float64]
Pose = tuple[Array, Array]

THRESHOLD = 1.5  # [px], of OpenCV and PoseLib
_CONFIDENCE = 0.999  # of OpenCV


@dataclass(frozen=True, slots=True)
class Method:
    """An estimator.

    Attributes
    ----------
    name : str
    prepare : callable
        From a problem, its cell and a seed makes the call that is timed; that returns
        ``X1 = R X2 + t`` or None.
    """

    name: str
    prepare: Callable[[TwoViewProblem, Cell, int], Callable[[], Pose | None]]


def this_library(problem: TwoViewProblem, cell: Cell, seed: int) -> Callable[[], Pose | None]:
    """The default configuration with the cell's sigmas; covariance included."""
    config = told_config(cell, 1.0, 'auto')

    def call() -> Pose | None:
        pose = estimate(problem, config, seed)
        return (pose.R, pose.t) if pose else None
    return call


def opencv_magsac(points1: Array, points2: Array, seed: int) -> Callable[[], Pose | None]:
    """OpenCV's 5-point estimator with USAC_MAGSAC."""
    K = np.array([[FOCAL, 0.0, CENTRE_U], [0.0, FOCAL, CENTRE_V], [0.0, 0.0, 1.0]])

    def call() -> Pose | None:
        cv2.setRNGSeed(seed)
        essential, mask = cv2.findEssentialMat(
            points1, points2, K, method=cv2.USAC_MAGSAC, prob=_CONFIDENCE, threshold=THRESHOLD)
        # None where it finds nothing, several solutions stacked.
        if np.shape(essential) != (3, 3):
            return None
        count, R, t, _ = cv2.recoverPose(essential, points1, points2, K, mask=mask)
        if not count:
            return None
        return _inverted(np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64).ravel())
    return call


def poselib(points1: Array, points2: Array, seed: int) -> Callable[[], Pose | None]:
    """PoseLib's `estimate_relative_pose` with default options."""
    library: Any = importlib.import_module('poselib')
    camera = {'model': 'PINHOLE', 'width': WIDTH, 'height': HEIGHT,
              'params': [FOCAL, FOCAL, CENTRE_U, CENTRE_V]}
    options = {'max_epipolar_error': THRESHOLD, 'seed': seed}

    def call() -> Pose | None:
        pose, _ = library.estimate_relative_pose(points1, points2, camera, camera, options, {})
        length = np.linalg.norm(pose.t)
        return _inverted(pose.R, pose.t / length) if length > 0.0 else None
    return call


def _inverted(R: Array, t: Array) -> Pose:
    """``X2 = R X1 + t`` to ``X1 = R X2 + t``, or back."""
    return R.T, -R.T @ t


def derotated(points: Array, rate: Array) -> Array:
    """Pixels (N, 2) turned by the measured rate [rad/s] to the instant of row 0."""
    rays = np.column_stack([(points - (CENTRE_U, CENTRE_V)) / FOCAL, np.ones(len(points))])
    rays = Rotation.from_rotvec(LINE_DELAY * points[:, 1:] * rate).apply(rays)
    return np.ascontiguousarray(FOCAL * rays[:, :2] / rays[:, 2:] + (CENTRE_U, CENTRE_V))


_OnPoints = Callable[[Array, Array, int], Callable[[], Pose | None]]


def _raw(method: _OnPoints) -> Callable[[TwoViewProblem, Cell, int], Callable[[], Pose | None]]:
    return lambda problem, _, seed: method(problem.points1, problem.points2, seed)


def _derotated(method: _OnPoints,
               ) -> Callable[[TwoViewProblem, Cell, int], Callable[[], Pose | None]]:
    return lambda problem, _, seed: method(
        derotated(problem.points1, problem.measured_rate1),
        derotated(problem.points2, problem.measured_rate2), seed)


LIBRARY = 'rs_relpose_ros'
POSELIB_DEROTATED = 'PoseLib, derotated points'


def available_methods() -> list[Method]:
    """This library first; PoseLib's only where it is installed."""
    methods = [
        Method(LIBRARY, this_library),
        Method('OpenCV USAC_MAGSAC, raw points', _raw(opencv_magsac)),
        Method('OpenCV USAC_MAGSAC, derotated points', _derotated(opencv_magsac)),
    ]
    if importlib.util.find_spec('poselib') is not None:
        methods += [Method('PoseLib, raw points', _raw(poselib)),
                    Method(POSELIB_DEROTATED, _derotated(poselib))]
    return methods
