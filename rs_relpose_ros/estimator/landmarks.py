"""Matches of a pair as if both cameras had seen all rows at once, with their stamped row.

Camera i is at ``tau_i v_i`` of its own stamped frame while it sees a match, so that, with
``d_1 = v_1`` and ``d_2 = R v_2`` as in (4) of ``docs/conventions.md``,

    tau_1 d_1 + l_1 f_1 = t + tau_2 d_2 + l_2 R f_2,

which gives both distances l in the sense of least squares.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.geometry.camera import RollingShutterCamera

Array = NDArray[np.float64]

# Squared sine between rays below which they are parallel: 2e-4 rad, a tenth of a pixel.
_PARALLEL = 4e-8


class Landmarks(NamedTuple):
    """Of the N matches of a pair with a pose; NaN for outliers.

    `pixels1`, `pixels2` (N, 2): where global shutters at the stamped rows' instants would see
    them. `points` (N, 3): in the reference camera [baselines]; NaN where the
    rays are parallel or meet behind a camera: their pixels are turned as if they were far away.
    """

    pixels1: Array
    pixels2: Array
    points: Array


def landmarks(pose: RelativePose, rays1: Array, rays2: Array, row_times1: Array, row_times2: Array,
              camera: RollingShutterCamera) -> Landmarks:
    """Landmarks of the inliers of a pose, pixels on the sensor.

    Parameters
    ----------
    rays1, rays2 : (N, 3) ndarray
        Unit rays of the matches, turned to the stamped row of their frame.
    row_times1, row_times2 : (N,) ndarray
        Instants at which they were seen, from that of the stamped row [s].
    """
    inliers = pose.inliers
    f1, f2 = rays1[inliers], rays2[inliers]
    moved1 = row_times1[inliers, None] * pose.linear_velocity1
    moved2 = row_times2[inliers, None] * pose.linear_velocity2
    in_first = f2 @ pose.R.T
    baselines = pose.t + moved2 @ pose.R.T - moved1
    normals = np.cross(f1, in_first)
    squared = np.sum(normals**2, axis=1)
    near = squared > _PARALLEL
    squared = np.where(near, squared, 1.0)
    l1 = np.sum(np.cross(baselines, in_first) * normals, axis=1) / squared
    l2 = np.sum(np.cross(baselines, f1) * normals, axis=1) / squared
    near &= (l1 > 0.0) & (l2 > 0.0)
    # Inverse distances, which are 0 far away.
    r1, r2 = (np.where(near, 1.0 / np.where(near, l, 1.0), 0.0)[:, None] for l in (l1, l2))  # noqa: E741
    seen1, seen2 = f1 + r1 * moved1, f2 + r2 * moved2
    middle = 0.5 * (l1[:, None] * seen1 + pose.t + (l2[:, None] * seen2) @ pose.R.T)
    out = Landmarks(*(np.full((len(inliers), size), np.nan) for size in (2, 2, 3)))
    for values, found in zip(out, (
            camera.project(seen1), camera.project(seen2),
            np.where(near[:, None], middle, np.nan)), strict=True):
        values[inliers] = found
    return out
