"""Relative poses chained into a path, the scale carried on through tracks that two pairs share.

Two views show no scale. But the current camera of a pair is the reference of the next, and many
tracks are seen in both: a point's distance there, in the one baseline and in the other, gives the
ratio of the baselines. Errors add up as in any odometry.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.messages.published_pair import PublishedPair

Array = NDArray[np.float64]

_ANEW = 'the path starts anew, at another scale'
# Squared sine of the angle between two rays below which they count as parallel.
_PARALLEL = 1e-18


@dataclass(frozen=True, slots=True, eq=False)
class PathPose:
    """A camera of the path, in the axes of the chain: those of its first camera."""

    stamp_ns: int
    R: Array   # (3, 3)
    position: Array   # (3,), in baselines of the path's first pair with a pose


@dataclass(frozen=True, slots=True, eq=False)
class PathStep:
    """What a pair adds to the path: the current camera, if its place on the path is known.

    Before it, where a new path begins, stands that path's first camera; `new_path` says why it
    begins, its place and scale have nothing to do with those before. `scale_sigma` is by the
    scatter of the tracks; the errors of the two poses, common to all, come on top.
    """

    poses: tuple[PathPose, ...]
    new_path: str   # empty where the path goes on, or where none is begun
    new_axes: bool   # whether the axes of the path have nothing to do with those before, either
    scale: float   # the pair's baseline, in baselines of the path's first; NaN without a pose
    shared_tracks: int   # that told the scale against the last pair with a pose
    scale_sigma: float   # 1 sigma of that ratio, relative; NaN where there is none


class PoseChain:
    """Chains the pairs of one node, in the order of their stamps.

    A pair with a rotation but no translation:

    - `PURE_ROTATION`: the camera stays where it is, and the path goes on. What it moved is less
      than the noise of the matches shows; it is missing from the path, and the distances of the
      tracks, which carry the scale over to the next pair with a pose, are taken for unchanged: the
      scale is then off by the share of that movement in these distances.
    - `LOW_PARALLAX`: where the camera is remains unknown. The path ends, and the next pair with a
      pose begins one at another scale, in the same axes, since the rotation goes on.

    Without a rotation the axes end with the path. With fewer than `min_shared_tracks` the scale is
    not carried on, and a new path begins.
    """

    def __init__(self, min_shared_tracks: int = 8) -> None:
        if min_shared_tracks < 1:
            raise InputError(f'min_shared_tracks must be at least 1, got {min_shared_tracks}')
        self._min_shared_tracks = min_shared_tracks
        # Of the last camera; None while the rotation or the place is not known.
        self._stamp_ns = 0
        self._R: Array | None = None
        self._position: Array | None = None
        # Baseline of the last pair with a pose, None while the path has none; distances of the
        # tracks from the camera that ended it, in these baselines.
        self._scale: float | None = None
        self._distances: dict[int, float] = {}
        # For the next path: why it begins, and whether its axes do, too.
        self._why, self._new_axes = 'the first pair: a path begins', True

    def add(self, pair: PublishedPair) -> PathStep:
        """Append a pair; where it does not continue the path, begin a new one with it."""
        if self._R is not None and pair.reference_stamp_ns != self._stamp_ns:
            self._lose_rotation(f'a pair is missing: {_ANEW}')
        if pair:
            return self._add_pose(pair)
        if pair.status == Status.PURE_ROTATION.value:
            return self._step(pair, np.zeros(3))
        if pair.rotation_known:
            self._lose_place(f'a pair has no translation ({pair.status}): {_ANEW}')
            self._turn(pair)
        else:
            self._lose_rotation(f'a pair has no rotation ({pair.status}): {_ANEW}')
        return PathStep((), '', False, math.nan, 0, math.nan)

    def _add_pose(self, pair: PublishedPair) -> PathStep:
        distances1, distances2 = track_distances(pair)
        ratios = np.array([self._distances[track] / distances1[track]
                           for track in distances1.keys() & self._distances.keys()])
        if self._scale is not None and len(ratios) < self._min_shared_tracks:
            self._lose_place(f'{len(ratios)} shared tracks do not carry the scale, it takes '
                             f'{self._min_shared_tracks}: {_ANEW}')
        self._distances = distances2
        if self._scale is None:
            self._scale = 1.0
            return self._step(pair, pair.t, 1.0)
        median = float(np.median(ratios))
        self._scale *= median
        # Of a median of normal deviates: sqrt(pi / 2) sigma / sqrt(n), sigma = 1.4826 MAD.
        scatter = float(np.median(np.abs(ratios - median))) / median
        return self._step(pair, self._scale * pair.t, self._scale, len(ratios),
                          1.2533 * 1.4826 * scatter / len(ratios)**0.5)

    def _step(self, pair: PublishedPair, movement: Array, scale: float = math.nan,
              shared_tracks: int = 0, scale_sigma: float = math.nan) -> PathStep:
        """Move on by `movement` (3,), in the reference camera and the units of the path."""
        start = np.eye(3) if self._R is None else self._R
        poses, new_path, new_axes = [], '', False
        if self._position is None:
            self._position = np.zeros(3)
            poses.append(PathPose(pair.reference_stamp_ns, start, self._position))
            new_path, new_axes, self._new_axes = self._why, self._new_axes, False
        self._position = self._position + start @ movement
        poses.append(PathPose(pair.stamp_ns, self._turn(pair), self._position))
        return PathStep(tuple(poses), new_path, new_axes, scale, shared_tracks, scale_sigma)

    def _turn(self, pair: PublishedPair) -> Array:
        self._stamp_ns = pair.stamp_ns
        self._R = pair.R if self._R is None else self._R @ pair.R
        return self._R

    def _lose_place(self, why: str) -> None:
        """End the path; the next one begins for the first reason since."""
        if self._position is not None:
            self._why = why
        self._position = self._scale = None
        self._distances = {}

    def _lose_rotation(self, why: str) -> None:
        self._lose_place(why)
        self._R, self._new_axes = None, True


def track_distances(pair: PublishedPair) -> tuple[dict[int, float], dict[int, float]]:
    """Distances of the tracks from the reference and from the current camera [baselines], by id.

    Each match has a baseline of its own, since the camera moves on while the rows are read: (4) of
    ``docs/conventions.md``, ``l_1 f_1 = l_2 R f_2 + t - tau_1 d_1 + tau_2 d_2``, in the sense of
    least squares. The velocity of the current camera stands for both. Tracks that would be behind
    a camera, or whose rays are parallel, are left out.
    """
    m = pair.matches
    f1 = np.stack([m[name] for name in ('x1', 'y1', 'z1')], axis=1).astype(np.float64)
    f2 = np.stack([m[name] for name in ('x2', 'y2', 'z2')], axis=1).astype(np.float64) @ pair.R.T
    tau = m['tau2'].astype(np.float64) - m['tau1']
    baselines = pair.t + tau[:, None] * (pair.R @ pair.linear_velocity)
    normals = np.cross(f1, f2)
    squared = np.sum(normals**2, axis=1)
    usable = squared > _PARALLEL
    divisors = np.where(usable, squared, 1.0)
    # The cross products of that equation with f_2 and f_1.
    l1 = np.sum(np.cross(baselines, f2) * normals, axis=1) / divisors
    l2 = np.sum(np.cross(baselines, f1) * normals, axis=1) / divisors
    usable &= (l1 > 0.0) & (l2 > 0.0)
    tracks = m['id'][usable].tolist()
    return (dict(zip(tracks, l1[usable].tolist(), strict=True)),
            dict(zip(tracks, l2[usable].tolist(), strict=True)))
