"""OpenCV's global-shutter 5-point on the matches of a pair, for comparison.

OpenCV has ``X_2 = R' X_1 + t'``, here it is ``X_1 = R X_2 + t``: so ``R = R'^T`` and
``t = -R'^T t'``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.camera import RollingShutterCamera
from rs_relpose_ros.pipeline.pair import PairResult
from rs_relpose_ros.replay.truth import median_and_p90, TrueTrajectory

Array = NDArray[np.float64]

METHODS = {'RANSAC': cv2.RANSAC, 'USAC_MAGSAC': cv2.USAC_MAGSAC}
THRESHOLDS = (0.5, 1.0, 2.0)

_CONFIDENCE = 0.999
_MIN_MATCHES = 5


@dataclass(frozen=True, slots=True, eq=False)
class GlobalPose:
    """Pose of camera 2 in camera 1 (``X1 = R X2 + t``), t of unit length, and the inliers (N,)."""

    R: Array
    t: Array
    inliers: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Score:
    """Errors of a method over pairs, in degrees.

    Attributes
    ----------
    name : str
    pairs, answered : int
    rotation, translation : (float, float)
        Median and 90th percentile over the answered pairs; NaN without any.
    """

    name: str
    pairs: int
    answered: int
    rotation: tuple[float, float]
    translation: tuple[float, float]


def opencv_five_point(points1: Array, points2: Array, camera: RollingShutterCamera, method: str,
                      threshold: float) -> GlobalPose | None:
    """Essential matrix by OpenCV, as if both images had a global shutter.

    Parameters
    ----------
    points1, points2 : (N, 2) ndarray
        Raw pixels; undistorted here, rows have no time.
    camera : RollingShutterCamera
    method : {'RANSAC', 'USAC_MAGSAC'}
    threshold : float
        [px].

    Returns
    -------
    GlobalPose or None
        None where OpenCV finds nothing.
    """
    if len(points1) < _MIN_MATCHES:
        return None
    pixels = []
    for points in (points1, points2):
        rays = camera.unproject(points)
        plane = rays[:, :2] / rays[:, 2:]
        pixels.append(np.ascontiguousarray(
            plane * (camera.fx, camera.fy) + (camera.cx, camera.cy)))
    cv2.setRNGSeed(0)
    try:
        essential, mask = cv2.findEssentialMat(
            pixels[0], pixels[1], camera.camera_matrix, method=METHODS[method], prob=_CONFIDENCE,
            threshold=threshold)
        # Several solutions come stacked; none comes as None.
        if np.shape(essential) != (3, 3):
            return None
        inliers = np.asarray(mask).ravel().astype(bool)
        count, R, t, _ = cv2.recoverPose(
            essential, pixels[0], pixels[1], camera.camera_matrix,
            mask=inliers.astype(np.uint8)[:, None])
    except cv2.error:   # too few, or degenerate
        return None
    if not count:
        return None
    return GlobalPose(np.asarray(R.T), np.asarray(-R.T @ t).ravel(), inliers)


def best_opencv_score(method: str, pairs: Sequence[tuple[PairResult, int, int]],
                      camera: RollingShutterCamera, to_sensor: Callable[[Array], Array],
                      truth: TrueTrajectory) -> tuple[Score, float]:
    """Score of a method at that of `THRESHOLDS` which suits it best, and this threshold [px].

    Best in the median rotation error against the truth: a choice that no user could make, in the
    baseline's favour.

    Parameters
    ----------
    method : {'RANSAC', 'USAC_MAGSAC'}
    pairs : sequence of (PairResult, int, int)
        With the instants of their two stamped rows on the IMU clock.
    camera : RollingShutterCamera
    to_sensor : callable
        Sensor pixels of pixels of the published image.
    truth : TrueTrajectory
    """
    scored = []
    for threshold in THRESHOLDS:
        errors = []
        for result, ns1, ns2 in pairs:
            pose = opencv_five_point(to_sensor(result.matches.points1),
                                     to_sensor(result.matches.points2), camera, method, threshold)
            if pose is not None:
                errors.append(truth.errors(pose.R, pose.t, ns1, ns2))
        known = [e for e in errors if e is not None]
        score = Score(f'OpenCV 5-point, {method}', len(pairs), len(errors),
                      median_and_p90([e.rotation_error for e in known]),
                      median_and_p90([e.translation_error for e in known]))
        scored.append((score, threshold))
    return min(scored, key=lambda item: np.nan_to_num(item[0].rotation[0], nan=np.inf))
