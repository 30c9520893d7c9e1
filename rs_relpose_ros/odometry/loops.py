"""Loop closures: keyframes far apart in time that probably have the same view."""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
import math
from typing import Any

import numpy as np

from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import NANOSECONDS, Sensor, to_nanoseconds
from rs_relpose_ros.messages.published_pair import PublishedPair
from rs_relpose_ros.odometry.estimator import OdometryEstimator
from rs_relpose_ros.odometry.graph import KeyframeState
from rs_relpose_ros.odometry.states import Base, Odometry
from rs_relpose_ros.pipeline.chosen_pairs import PairStamps
from rs_relpose_ros.pipeline.pair import PairResult

# The smoothed keyframes of each start.
Paths = list[list[tuple[KeyframeState, Odometry]]]
# By the time of a keyframe on the IMU's clock: the stamp of the row of its pose [ns], and the
# parallax to the keyframe before [px].
Views = Mapping[int, tuple[int, float]]

# Least time between the two keyframes of a loop [s]. Closer ones share tracks already, so that a
# loop adds nothing. [chosen: 5 to 30 s would do]
_APART = 10.0
# Least time between two loops at one of their ends [s]: closer ones share both images and repeat
# each other. [chosen: 0.5 to 3 s would do]
_SPACING = 1.0
# Largest number of loops per second of the path: each costs 0.5 s of a core.
# [measured: docs/lab/odometry.md, "Loop closures"]
_RATE = 1.0
# Least share of a view that is in the other one. Descriptors match too few points below it; above
# 0.7 loops with another heading are lost. [chosen: 0.3 to 0.7 would do]
_LEAST_OVERLAP = 0.5
# Longest baseline of a loop in depths of the scene: descriptors of views from other sides do not
# match. [chosen: 0.2 to 0.6 would do]
_LONGEST_BASELINE = 0.4
# Points of a view: columns and rows. [chosen: a share is then known to 2 %]
_GRID = (8, 6)
# Least parallax of a pair that gives a depth [px]: the noise of matches is 0.5 px.
# [chosen: 1 to 10 px would do, as the median over all pairs counts]
_LEAST_PARALLAX = 2.0


def scene_depth(
    path: Sequence[Odometry],
    views: Views,
    focal_length: float,
) -> float:
    """Median distance of the scene [m]; NaN without any."""
    depths = []
    for one, two in pairwise(path):
        _, parallax = views[two.imu_ns]
        if parallax > _LEAST_PARALLAX:
            baseline = float(np.linalg.norm(two.position - one.position))
            depths.append(focal_length * baseline / parallax)
    return float(np.median(depths)) if depths else math.nan


def proposed_loops(
    path: Sequence[Odometry],
    depth: float,
    camera: RollingShutterCamera,
) -> list[tuple[int, int]]:
    """Keyframes far apart in time with a common view, by a path of the camera.

    `depth`: of the scene [m]. Returns their positions in the path, the earlier one first; the most
    similar views first, and none within a second of another one at both ends.
    """
    seconds = np.array([pose.imu_ns - path[0].imu_ns for pose in path]) / NANOSECONDS
    found = []
    for j, pose in enumerate(path):
        last = int(np.searchsorted(seconds, seconds[j] - _APART))
        views = _common_views(path[:last], pose, depth, camera)
        found += [(share, i, j) for share, i in views]
    chosen: list[tuple[int, int]] = []
    for _, i, j in sorted(found, key=lambda one: -one[0]):
        if len(chosen) >= _RATE * seconds[-1]:
            break
        distances = [
            max(abs(seconds[i] - seconds[k]), abs(seconds[j] - seconds[m])) for k, m in chosen
        ]
        if min(distances, default=math.inf) >= _SPACING:
            chosen.append((i, j))
    return chosen


def _common_views(
    earlier: Sequence[Odometry],
    pose: Odometry,
    depth: float,
    camera: RollingShutterCamera,
) -> list[tuple[float, int]]:
    """Earlier keyframes that share a large part of a view: the share, and their position."""
    near = [
        k
        for k, one in enumerate(earlier)
        if one.path == pose.path
        and np.linalg.norm(one.position - pose.position) < _LONGEST_BASELINE * depth
    ]
    if not near:
        return []
    last = np.array([camera.width, camera.height]) - 1.0
    columns = np.linspace(0.0, last[0], _GRID[0])
    rows = np.linspace(0.0, last[1], _GRID[1])
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    points = pose.position + depth * camera.unproject(pixels) @ pose.R.T
    found = []
    for k in near:
        # NaN behind the camera. A margin for rounding, as a view has all of itself.
        shown = camera.project((points - earlier[k].position) @ earlier[k].R)
        inside = ((shown > -1.0) & (shown < last + 1.0)).all(axis=1)
        share = float(inside.mean())
        if share >= _LEAST_OVERLAP:
            found.append((share, k))
    return found


def close_loops(
    estimator: OdometryEstimator,
    paths: Paths,
    views: Views,
    sensor: Sensor,
    relate: Callable[[list[PairStamps]], Sequence[PairResult]],
) -> tuple[Paths, dict[str, Any], list[PublishedPair]]:
    """Add loops to smoothed paths; `relate`: results of pairs of image stamps.

    Returns the paths with loops, the report for summary.json, and the loops that count.
    """
    smoothed = [pose for path in paths for _, pose in path]
    base = estimator.base or Base()
    path = [base.camera(pose) for pose in smoothed if pose.imu_ns in views]
    delay_ns = to_nanoseconds(sensor.pose_row_delay)
    stamps = [views[pose.imu_ns][0] - delay_ns for pose in path]
    depth = scene_depth(path, views, sensor.camera.fx)
    offered = proposed_loops(path, depth, sensor.camera)
    related = relate([(stamps[i], stamps[j]) for i, j in offered]) if offered else []
    pairs = [PublishedPair.of_result(result) for result in related]
    informative = [pair for pair in pairs if pair.images is not None]
    taken = estimator.close_loops(informative)
    paths = estimator.smoothed_paths() if taken else paths
    closed = [pose for path in paths for _, pose in path]
    positions = {pose.imu_ns: pose.position for pose in smoothed}
    shifts = np.array([np.linalg.norm(pose.position - positions[pose.imu_ns]) for pose in closed])
    report = {  # shifts are those of the positions of keyframes
        'offered': len(offered),
        'related': len(informative),
        'taken': len(taken),
        'shift_m': float(np.sqrt((shifts**2).mean())),
        'largest_shift_m': float(shifts.max()),
        'end_to_start_without_m': _end_to_start(smoothed),
        'end_to_start_m': _end_to_start(closed),
    }
    return paths, report, taken


def _end_to_start(poses: Sequence[Odometry]) -> float:
    """Distance of the last position from the first one [m]."""
    return float(np.linalg.norm(poses[-1].position - poses[0].position))
