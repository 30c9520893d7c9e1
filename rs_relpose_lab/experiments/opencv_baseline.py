"""OpenCV's global-shutter 5-point on the matches of a pair, for comparison.

OpenCV has ``X_2 = R' X_1 + t'``, here it is ``X_1 = R X_2 + t``: so ``R = R'^T`` and
``t = -R'^T t'``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.experiments.comparison import Score, score
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.replay.run import ReplayedPair
from rs_relpose_ros.replay.truth import TrueTrajectory

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


def best_opencv_score(method: str, pairs: Sequence[ReplayedPair], calibration: Intrinsics,
                      truth: TrueTrajectory) -> Score:
    """Score of a method at that of `THRESHOLDS` which suits it best.

    Best in the median rotation error against the truth: a choice that no user could make, in the
    baseline's favour.

    Parameters
    ----------
    method : {'RANSAC', 'USAC_MAGSAC'}
    pairs : sequence of ReplayedPair
        Those that the pipeline answered: the same matches, and none of a camera that stands.
    calibration : Intrinsics
    truth : TrueTrajectory
    """
    camera = calibration.global_shutter_camera()
    scores = []
    for threshold in THRESHOLDS:
        errors = []
        for pair in pairs:
            matches = pair.result.matches
            pose = opencv_five_point(
                calibration.to_sensor(matches.points1), calibration.to_sensor(matches.points2),
                camera, method, threshold)
            errors.append(None if pose is None else truth.errors(
                pose.R, pose.t, pair.result.reference_ns1, pair.result.reference_ns2))
        scores.append(score(f'OpenCV 5-point, {method}, {threshold:g} px', len(pairs), errors))
    return min(scores, key=lambda s: np.nan_to_num(s.rotation[0], nan=np.inf))
