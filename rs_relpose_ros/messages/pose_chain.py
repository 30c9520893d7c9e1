"""Relative poses chained into a path, the scale carried on through tracks that two pairs share.

Two views show no scale. But the current camera of a pair is the reference of the next, and many
tracks are seen in both: a point's distance there, in the one baseline and in the other, gives the
ratio of the baselines. Errors add up as in any odometry.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.messages.published_pair import PublishedPair

Array = NDArray[np.float64]

# Squared sine of the angle between two rays below which they count as parallel.
_PARALLEL = 1e-18


@dataclass(frozen=True, slots=True, eq=False)
class PathPose:
    """A camera in the axes of the path's first camera."""

    stamp_ns: int
    R: Array   # (3, 3)
    position: Array   # (3,), in baselines of the path's first pair


@dataclass(frozen=True, slots=True, eq=False)
class PathStep:
    """What a pair adds to the path: the current camera.

    Before it, where a new path begins, stands that path's first camera; `new_path` says why it
    begins, its scale has nothing to do with the one before. `scale_sigma` is by the scatter of the
    tracks, NaN where a path begins; the errors of the two poses, common to all, come on top.
    """

    poses: tuple[PathPose, ...]
    new_path: str   # empty where the path goes on
    scale: float   # the pair's baseline, in baselines of the path's first pair
    shared_tracks: int   # that told the scale against the pair before
    scale_sigma: float   # 1 sigma of that ratio, relative


class PoseChain:
    """Chains the pairs of one node, in the order of their stamps.

    With fewer than `min_shared_tracks` the scale is not carried on, and a new path begins.
    """

    def __init__(self, min_shared_tracks: int = 8) -> None:
        if min_shared_tracks < 1:
            raise InputError(f'min_shared_tracks must be at least 1, got {min_shared_tracks}')
        self._min_shared_tracks = min_shared_tracks
        self._end: PathPose | None = None
        self._scale = 1.0
        self._distances: dict[int, float] = {}

    def add(self, pair: PublishedPair) -> PathStep:
        """Append a pair; where it does not continue the path, begin a new one with it."""
        distances1, distances2 = track_distances(pair)
        ratios = np.array([self._distances[track] / distances1[track]
                           for track in distances1.keys() & self._distances.keys()])
        new_path = self._why_not_continued(pair, len(ratios))
        self._distances = distances2
        if new_path:
            start = PathPose(pair.reference_stamp_ns, np.eye(3), np.zeros(3))
            self._scale = 1.0
            self._end = _moved(start, pair, self._scale)
            return PathStep((start, self._end), new_path, 1.0, 0, float('nan'))
        assert self._end is not None
        median = float(np.median(ratios))
        self._scale *= median
        self._end = _moved(self._end, pair, self._scale)
        # Of a median of normal deviates: sqrt(pi / 2) sigma / sqrt(n), sigma = 1.4826 MAD.
        scatter = float(np.median(np.abs(ratios - median))) / median
        return PathStep((self._end,), '', self._scale, len(ratios),
                        1.2533 * 1.4826 * scatter / len(ratios)**0.5)

    def _why_not_continued(self, pair: PublishedPair, shared_tracks: int) -> str:
        if self._end is None:
            return 'the first pair: a path begins'
        if pair.reference_stamp_ns != self._end.stamp_ns:
            return 'a pair is missing: the path starts anew, at another scale'
        if shared_tracks < self._min_shared_tracks:
            return (f'{shared_tracks} shared tracks do not carry the scale, it takes '
                    f'{self._min_shared_tracks}: the path starts anew')
        return ''


def _moved(start: PathPose, pair: PublishedPair, scale: float) -> PathPose:
    return PathPose(pair.stamp_ns, start.R @ pair.R, start.position + scale * start.R @ pair.t)


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
