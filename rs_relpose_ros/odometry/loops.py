"""Loop closures: keyframes far apart in time that probably have the same view."""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
import math
from typing import Any, NamedTuple

import numpy as np

from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import NANOSECONDS, Sensor, to_nanoseconds
from rs_relpose_ros.odometry.estimator import OdometryEstimator
from rs_relpose_ros.odometry.graph import KeyframeState
from rs_relpose_ros.odometry.pair import KeyframePair
from rs_relpose_ros.odometry.states import Base, Odometry
from rs_relpose_ros.pipeline.chosen_pairs import Stamps
from rs_relpose_ros.pipeline.pair import PairResult

# The smoothed keyframes of each start.
Paths = list[list[tuple[KeyframeState, Odometry]]]

# Least time between the two keyframes of a loop, and between those of two loops [s].
_APART, _SPACING = 10.0, 1.0
# Loops per second of the path, at most.
_RATE = 1.0
# Least share of a view that is in the other one; longest baseline in depths of the scene.
_LEAST_OVERLAP, _LONGEST_BASELINE = 0.5, 0.4
# Points of a view: columns and rows.
_GRID = (8, 6)
# Least parallax of a pair that gives a depth [px].
_LEAST_PARALLAX = 2.0


class View(NamedTuple):
    """The image of a keyframe."""

    stamp_ns: int  # of its pose's row
    parallax: float  # [px] to the keyframe before


def scene_depth(path: Sequence[Odometry], views: Mapping[int, View], focal_length: float) -> float:
    """Median distance of the scene [m]; `views`: by `imu_ns`; NaN without any."""
    depths = [
        focal_length * float(np.linalg.norm(two.position - one.position)) / parallax
        for one, two in pairwise(path)
        if (parallax := views[two.imu_ns].parallax) > _LEAST_PARALLAX
    ]
    return float(np.median(depths)) if depths else math.nan


def proposed_loops(
    path: Sequence[Odometry], depth: float, camera: RollingShutterCamera
) -> list[tuple[int, int]]:
    """Keyframes far apart in time with a common view, by a path of the camera.

    `depth`: of the scene [m]. Returns their positions in the path, the earlier one first; the most
    similar views first, and none within a second of another one at both ends.
    """
    seconds = np.array([pose.imu_ns - path[0].imu_ns for pose in path]) / NANOSECONDS
    found = [
        (share, i, j)
        for j, pose in enumerate(path)
        for share, i in _common_views(
            path[: int(np.searchsorted(seconds, seconds[j] - _APART))], pose, depth, camera
        )
    ]
    chosen: list[tuple[int, int]] = []
    for _, i, j in sorted(found, key=lambda one: -one[0]):
        if len(chosen) >= _RATE * seconds[-1]:
            break
        if all(
            max(abs(seconds[i] - seconds[k]), abs(seconds[j] - seconds[m])) >= _SPACING
            for k, m in chosen
        ):
            chosen.append((i, j))
    return chosen


def _common_views(
    earlier: Sequence[Odometry], pose: Odometry, depth: float, camera: RollingShutterCamera
) -> list[tuple[float, int]]:
    """Shares of the view that others have, of those with a large one, and their positions."""
    near = [
        k
        for k, one in enumerate(earlier)
        if one.path == pose.path
        and np.linalg.norm(one.position - pose.position) < _LONGEST_BASELINE * depth
    ]
    if not near:
        return []
    last = np.array([camera.width, camera.height]) - 1.0
    grid = np.meshgrid(
        *(np.linspace(0.0, end, count) for end, count in zip(last, _GRID, strict=True))
    )
    rays = camera.unproject(np.stack(grid, axis=-1).reshape(-1, 2))
    points = pose.position + depth * rays @ pose.R.T
    in_view = np.stack([(points - earlier[k].position) @ earlier[k].R for k in near])
    pixels = camera.project(in_view.reshape(-1, 3))  # NaN behind the camera
    # With a margin for rounding, as a view has all of itself.
    inside = ((pixels > -1.0) & (pixels < last + 1.0)).all(axis=1)
    shares = inside.reshape(len(near), -1).mean(axis=1).tolist()
    return [(share, k) for k, share in zip(near, shares, strict=True) if share >= _LEAST_OVERLAP]


def close_loops(
    estimator: OdometryEstimator,
    paths: Paths,
    views: Mapping[int, View],
    sensor: Sensor,
    relate: Callable[[list[Stamps]], Sequence[PairResult]],
) -> tuple[Paths, dict[str, Any], list[KeyframePair]]:
    """Add loops to smoothed paths; `views`: by `imu_ns`; `relate`: results of pairs of stamps."""
    smoothed = [pose for path in paths for _, pose in path]
    base, later_ns = estimator.base or Base(), to_nanoseconds(sensor.pose_row_delay)
    path = [base.camera(pose) for pose in smoothed if pose.imu_ns in views]
    stamps = [views[pose.imu_ns].stamp_ns - later_ns for pose in path]
    offered = proposed_loops(path, scene_depth(path, views, sensor.camera.fx), sensor.camera)
    pairs = (
        [
            KeyframePair.of_result(result)
            for result in relate([(stamps[i], stamps[j]) for i, j in offered])
        ]
        if offered
        else []
    )
    informative = [pair for pair in pairs if pair.images is not None]
    taken = estimator.close_loops(informative)
    paths = estimator.smoothed_paths() if taken else paths
    closed = [pose for path in paths for _, pose in path]
    positions = {pose.imu_ns: pose.position for pose in smoothed}
    shifts = np.array([np.linalg.norm(pose.position - positions[pose.imu_ns]) for pose in closed])
    before, after = (
        float(np.linalg.norm(poses[-1].position - poses[0].position))
        for poses in (smoothed, closed)
    )
    return (
        paths,
        {  # for summary.json; shifts: of the keyframes' positions
            'offered': len(offered),
            'related': len(informative),
            'taken': len(taken),
            'shift_m': float(np.sqrt((shifts**2).mean())),
            'largest_shift_m': float(shifts.max()),
            'end_to_start_without_m': before,
            'end_to_start_m': after,
        },
        taken,
    )
