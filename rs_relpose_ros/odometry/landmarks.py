"""Tracks over several keyframes, and their points in the world by the poses of their rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.timing import NANOSECONDS, Sensor
from rs_relpose_ros.odometry.rows import ArrayFile, RowTrajectory
from rs_relpose_ros.pipeline.pair import PairResult

TRACKS_FILE = 'tracks.npz'

Ints = NDArray[np.int64]

# Fewest keyframes of a point, and the largest deviation of an observation from it [px].
_LEAST_VIEWS, _GATE = 3, 2.0
# Deviation at which the weight of an observation is a quarter [px]; rounds of the fit.
_SCALE, _ROUNDS = 1.0, 8
# Largest relative 1 sigma of the depth, of observations with 1 px.
_DEPTH_SIGMA = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Tracks(ArrayFile):
    """Inliers of keyframe pairs (N,), in the order of tracks and time."""

    ids: Ints
    keyframes_ns: Ints  # time of the image's reference row on the clock of the IMU
    times_ns: Ints  # of the observed row
    pixels: Array  # (N, 2) of the published image

    @classmethod
    def of_pair(cls, pair: PairResult) -> Tracks:
        """Of both images."""
        found, matches = pair.pose.inliers, pair.matches
        ids = matches.track_ids[found].astype(np.int64)
        rows = [
            np.rint(NANOSECONDS * row_times[found]).astype(np.int64)
            for row_times in (pair.row_times1, pair.row_times2)
        ]
        keyframes = np.repeat([pair.reference_ns1, pair.reference_ns2], len(ids))
        return cls(
            np.tile(ids, 2),
            keyframes,
            keyframes + np.concatenate(rows),
            np.concatenate([matches.points1[found], matches.points2[found]]),
        )

    @classmethod
    def merged(cls, parts: Sequence[Tracks]) -> Tracks:
        """Those of all pairs; an observation that two pairs share counts once."""
        if not parts:
            nothing = np.zeros(0, dtype=np.int64)
            return cls(nothing, nothing, nothing, np.zeros((0, 2)))
        whole = cls(
            *(np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(cls))
        )
        _, first = np.unique(
            np.column_stack([whole.ids, whole.keyframes_ns]), axis=0, return_index=True
        )
        return whole.kept(first)

    def kept(self, which: NDArray[np.bool_] | Ints) -> Tracks:
        """Some of the observations."""
        return Tracks(*(getattr(self, one.name)[which] for one in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Points in the world and their observations; `points`: which point each one is of."""

    positions: Array  # (P, 3) [m]
    errors: Array  # (P,) mean deviation of the observations [px]
    points: Ints  # (N,)
    observations: Tracks  # (N,)


def triangulated(tracks: Tracks, rows: RowTrajectory, sensor: Sensor, most: int) -> Landmarks:
    """At most so many points, those whose depth is known best, each with 3 observations or more.

    A point minimises the squared distances from its rays, each from the pose of its own row, with
    robust weights by the deviations in the image. Observations beyond 2 px do not count; points
    with a depth that 1 px of noise would change by more than 5 % are left out.
    """
    tracks = tracks.kept(rows.covers(tracks.times_ns))
    R, p = rows.pose(tracks.times_ns)
    camera, intrinsics = sensor.camera, sensor.intrinsics
    rays = np.einsum('nij,nj->ni', R, camera.unproject(intrinsics.to_sensor(tracks.pixels)))
    good = np.isfinite(rays).all(axis=1)
    normals = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    _, starts, points, counts = np.unique(
        tracks.ids, return_index=True, return_inverse=True, return_counts=True
    )
    enough = (counts >= _LEAST_VIEWS)[points]
    weights: Array = np.ones(len(rays))
    errors: Array = np.zeros(len(rays))
    positions: Array = np.zeros((len(starts), 3))

    def summed(values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, starts, axis=0))

    for _ in range(_ROUNDS if len(starts) else 0):
        weights = np.where(good & enough, weights, 0.0)
        A = np.nan_to_num(normals) * weights[:, None, None]
        # Points without observations stay at the origin.
        towards = summed(np.einsum('nij,nj->ni', A, p))[..., None]
        positions = np.asarray(
            np.linalg.solve(summed(A) + 1e-12 * np.eye(3), towards)[..., 0], dtype=np.float64
        )
        local = np.einsum('nji,nj->ni', R, positions[points] - p)
        pixels = intrinsics.to_image(camera.project(local))
        errors = np.asarray(
            np.nan_to_num(np.linalg.norm(pixels - tracks.pixels, axis=1), nan=np.inf)
        )
        # By the distance, angles count instead of lengths.
        distances = np.maximum(np.linalg.norm(local, axis=1), 1e-3)
        weights = 1.0 / (distances * (1.0 + (errors / _SCALE) ** 2)) ** 2
    good &= enough & (errors < _GATE)
    spread = np.linalg.eigvalsh(summed(np.where(good[:, None, None], normals, 0.0)))[:, 0]
    sigmas = 1.0 / (camera.fx * np.sqrt(np.maximum(spread, 1e-12)))
    views = summed(good.astype(np.float64))
    chosen = np.flatnonzero((views >= _LEAST_VIEWS) & (sigmas < _DEPTH_SIGMA))
    chosen = np.sort(chosen[np.argsort(sigmas[chosen], kind='stable')[:most]])
    means = summed(np.where(good, errors, 0.0)) / np.maximum(views, 1.0)
    number = np.full(len(starts), -1)
    number[chosen] = np.arange(len(chosen))
    good &= number[points] >= 0
    return Landmarks(positions[chosen], means[chosen], number[points[good]], tracks.kept(good))
