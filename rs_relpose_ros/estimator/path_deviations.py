"""What deviations of the configuration change in the observations of all frames of a pair.

The rows of a frame are those of `core.rows`, with its stamped row as the reference: shares of the
readout are counted from that row, and so the time offset of a selection is the one of the stamped
row, as the parameter.
"""

from __future__ import annotations

import numpy as np

from rs_relpose_ros.core.deviations import LENS, Selection
from rs_relpose_ros.core.reprojection import Changes
from rs_relpose_ros.core.rows import row_states
from rs_relpose_ros.estimator.pair_problem import PairProblem
from rs_relpose_ros.geometry.gyro import GyroPath
from rs_relpose_ros.geometry.motion import FrameMotion


def changes_by(selection: Selection, problem: PairProblem) -> Changes | None:
    """Changes of rays, times and rotations by a selection; None without the gyro of the pair.

    Observations that are not used have arbitrary values.
    """
    if problem.gyro is None or problem.R_cam_imu is None:
        return None
    camera, points = problem.camera, problem.matches.points
    views, count = points.shape[:2]
    basis = selection.basis * selection.scales(camera.width)
    # The gyro covers the rows of the image only: other observations are put into its middle.
    rows = camera.rows_of(points)
    inside = np.isfinite(points).all(axis=2) & (rows >= 0.0) & (rows <= camera.row_count - 1.0)
    middle = 0.5 * (camera.width - 1.0), 0.5 * (camera.height - 1.0)
    pixels = np.where(inside[..., None], points, middle)
    rows = camera.rows_of(pixels)
    lens = camera.rays_by_lens(pixels.reshape(-1, 2)).by_lens @ basis[LENS]
    rays = camera.unproject(pixels.reshape(-1, 2)).reshape(views, count, 3)
    by_lens = lens.reshape(views, count, 3, selection.size)
    shares = (rows - camera.reference_row_index) / camera.row_count
    times = camera.row_times(rows)
    of_rays = np.empty((views, count, 3, selection.size))
    of_times = np.empty((views, count, selection.size))
    for view, motion in enumerate(problem.motions):
        path = _path_of_rows(motion)
        states = row_states(path, problem.R_cam_imu, times[view], shares[view])
        turned = np.einsum('nij,nj->ni', states.rotation, rays[view])
        by_turn = np.cross(states.by_deviation @ basis, turned[:, :, None], axis=1)
        of_rays[view] = by_turn + states.rotation @ by_lens[view]
        of_times[view] = states.time_by_deviation @ basis
    between = row_states(problem.gyro, problem.R_cam_imu, problem.seconds, np.zeros(views))
    return Changes(of_rays, of_times, np.ascontiguousarray(between.by_deviation @ basis))


def _path_of_rows(motion: FrameMotion) -> GyroPath:
    """The rotation within a frame, also where it is known by its rate alone."""
    if motion.path is not None:
        return motion.path
    return GyroPath.constant(motion.angular_velocity, -1.0, 1.0)
