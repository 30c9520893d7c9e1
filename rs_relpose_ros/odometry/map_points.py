"""Tracks over several keyframes, and their points in the world by the poses of their rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.timing import NANOSECONDS, Sensor
from rs_relpose_ros.odometry.formats import rotated, rotated_back
from rs_relpose_ros.odometry.rows import ArrayFile, RowTrajectory
from rs_relpose_ros.pipeline.pair import PairResult

# Tracks of an odometry, for export. [derived: interface]
TRACKS_FILE = 'tracks.npz'

Ints = NDArray[np.int64]

# Fewest keyframes in which a point is observed. With two, a wrong match fits a wrong depth
# exactly. [derived: the third observation is the first one that can contradict]
_LEAST_VIEWS = 3
# Largest deviation of an observation from its point [px]. A wrong match of a smaller deviation
# stays; a smaller limit cuts right ones, whose noise is 0.3 to 0.5 px. [chosen: 1.5 to 4 would do]
_GATE = 2.0
# Deviation at which the weight of an observation is a quarter [px] (Geman-McClure).
# [chosen: 2 to 3 sigma of right observations]
_SCALE = 1.0
# Rounds of the fit, each with the weights of the one before. [chosen: 5 to 20 would do]
_ROUNDS = 8
# Largest relative 1 sigma of the depth, if observations have 1 px. Points that are less certain
# look like smoke along the rays. [chosen: 0.02 to 0.1 would do]
_DEPTH_SIGMA = 0.05
# Bounds against a division by zero: distance of a point [m], information of a direction.
_LEAST_DISTANCE = 1e-3
# [chosen: far below any real information]
_LEAST_INFORMATION = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeObservations(ArrayFile):
    """Inliers of keyframe pairs (N,), in the order of tracks and time."""

    ids: Ints
    keyframes_ns: Ints  # time of the image's reference row on the clock of the IMU
    times_ns: Ints  # of the observed row
    pixels: Array  # (N, 2) of the published image

    @classmethod
    def of_pair(cls, pair: PairResult) -> KeyframeObservations:
        """Observations in both images of a pair."""
        found, matches = pair.pose.inliers, pair.matches
        ids = matches.track_ids[found].astype(np.int64)
        keyframes = np.repeat([pair.reference_ns1, pair.reference_ns2], len(ids))
        delays = [times[found] for times in matches.row_times]
        delays_ns = np.rint(NANOSECONDS * np.concatenate(delays)).astype(np.int64)
        pixels = [matches.points1[found], matches.points2[found]]
        return cls(
            ids=np.tile(ids, 2),
            keyframes_ns=keyframes,
            times_ns=keyframes + delays_ns,
            pixels=np.concatenate(pixels),
        )

    @classmethod
    def merged(cls, parts: Sequence[KeyframeObservations]) -> KeyframeObservations:
        """Observations of all pairs; one that two pairs share counts once."""
        if not parts:
            nothing = np.zeros(0, dtype=np.int64)
            return cls(nothing, nothing, nothing, np.zeros((0, 2)))
        columns = [
            np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(cls)
        ]
        whole = cls(*columns)
        keys = np.column_stack([whole.ids, whole.keyframes_ns])
        _, first = np.unique(keys, axis=0, return_index=True)
        return whole.kept(first)

    def kept(self, which: NDArray[np.bool_] | Ints) -> KeyframeObservations:
        """Some of the observations."""
        return KeyframeObservations(*(getattr(self, one.name)[which] for one in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class MapPoints:
    """Points in the world and their observations; `points`: which point each one is of."""

    positions: Array  # (P, 3) [m]
    errors: Array  # (P,) mean deviation of the observations [px]
    points: Ints  # (N,)
    observations: KeyframeObservations  # (N,)


def triangulated(
    tracks: KeyframeObservations,
    rows: RowTrajectory,
    sensor: Sensor,
    most: int,
) -> MapPoints:
    """At most so many points, those whose depth is known best, each with 3 observations or more.

    A point minimises the squared distances from its rays, each from the pose of its own row, with
    robust weights by the deviations in the image. Observations beyond 2 px do not count; points
    with a depth that 1 px of noise would change by more than 5 % are left out.
    """
    tracks = tracks.kept(rows.covers(tracks.times_ns))
    R, p = rows.pose(tracks.times_ns)
    camera, intrinsics = sensor.camera, sensor.intrinsics
    rays = rotated(R, camera.unproject(intrinsics.to_sensor(tracks.pixels)))
    # Projections across the rays: |normal (x - p)| is the distance of x from a ray.
    normals = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    _, starts, points, counts = np.unique(
        tracks.ids, return_index=True, return_inverse=True, return_counts=True
    )

    def summed(values: Array) -> Array:
        """Sums over the observations of each point."""
        return np.asarray(np.add.reduceat(values, starts, axis=0))

    usable = np.isfinite(rays).all(axis=1)
    usable &= (counts >= _LEAST_VIEWS)[points]
    weights: Array = np.ones(len(rays))
    errors: Array = np.zeros(len(rays))
    positions: Array = np.zeros((len(starts), 3))
    for _ in range(_ROUNDS if len(starts) else 0):
        weights = np.where(usable, weights, 0.0)
        weighted = np.nan_to_num(normals) * weights[:, None, None]
        towards = summed(rotated(weighted, p))[..., None]
        # Points without observations stay at the origin.
        matrices = summed(weighted) + _LEAST_INFORMATION * np.eye(3)
        positions = np.asarray(np.linalg.solve(matrices, towards)[..., 0], dtype=np.float64)
        local = rotated_back(R, positions[points] - p)
        deviations = intrinsics.to_image(camera.project(local)) - tracks.pixels
        errors = np.nan_to_num(np.linalg.norm(deviations, axis=1), nan=np.inf)
        # Divided by the distance, an error of the position is an angle.
        distances = np.maximum(np.linalg.norm(local, axis=1), _LEAST_DISTANCE)
        robust = 1.0 + (errors / _SCALE) ** 2
        weights = 1.0 / (distances * robust) ** 2
    good = usable & (errors < _GATE)
    information = summed(np.where(good[:, None, None], normals, 0.0))
    # The depth of a point is its least certain direction.
    least = np.linalg.eigvalsh(information)[:, 0]
    sigmas = 1.0 / (camera.fx * np.sqrt(np.maximum(least, _LEAST_INFORMATION)))
    views = summed(good.astype(np.float64))
    chosen = np.flatnonzero((views >= _LEAST_VIEWS) & (sigmas < _DEPTH_SIGMA))
    best = np.argsort(sigmas[chosen], kind='stable')[:most]
    chosen = np.sort(chosen[best])
    means = summed(np.where(good, errors, 0.0)) / np.maximum(views, 1.0)
    numbers = np.full(len(starts), -1)
    numbers[chosen] = np.arange(len(chosen))
    good &= numbers[points] >= 0
    return MapPoints(positions[chosen], means[chosen], numbers[points[good]], tracks.kept(good))
