"""Tracks of image points over frames, and pairs of frames that see the same points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Where points were seen.

    Parameters
    ----------
    stamps_ns : (F,) array_like of int
        Stamps of the frames, camera clock, strictly increasing.
    frames : (N,) array_like of int
        Frame of each observation, not decreasing.
    ids : (N,) array_like of int
        Track of each observation; at most once per frame.
    points : (N, 2) array_like
        Raw (distorted) pixels.
    """

    stamps_ns: NDArray[np.int64]
    frames: NDArray[np.int64]
    ids: NDArray[np.int64]
    points: Array

    def __post_init__(self) -> None:
        stamps = np.ascontiguousarray(self.stamps_ns, dtype=np.int64)
        frames = np.ascontiguousarray(self.frames, dtype=np.int64)
        ids = np.ascontiguousarray(self.ids, dtype=np.int64)
        points = np.ascontiguousarray(self.points, dtype=np.float64)
        if stamps.ndim != 1 or not (np.diff(stamps) > 0).all():
            raise InputError('stamps_ns of the tracks must be (F,) and strictly increasing')
        if frames.ndim != 1 or ids.shape != frames.shape or points.shape != (len(frames), 2):
            raise InputError('frames, ids and points must have shapes (N,), (N,) and (N, 2), got '
                             f'{frames.shape}, {ids.shape} and {points.shape}')
        if len(frames) and (frames[0] < 0 or frames[-1] >= len(stamps)
                            or not (np.diff(frames) >= 0).all()):
            raise InputError(f'frames must not decrease and lie in [0, {len(stamps) - 1}]')
        if not np.isfinite(points).all():
            raise InputError('points of the tracks must be finite')
        for name, value in (('stamps_ns', stamps), ('frames', frames), ('ids', ids),
                            ('points', points)):
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def seconds(self, origin_ns: int) -> Array:
        """Stamps (F,) [s] since `origin_ns`."""
        return np.asarray((self.stamps_ns - origin_ns) * 1e-9, dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Pairs of frames with their common points, matches of a pair one after the other.

    Attributes
    ----------
    first, second : (P,) ndarray of int
        Frames.
    begin : (P + 1,) ndarray of int
        Matches of pair p: ``begin[p]`` to ``begin[p + 1]``.
    points1, points2 : (N, 2) ndarray
        Raw pixels.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    begin: NDArray[np.int64]
    points1: Array
    points2: Array

    def __len__(self) -> int:
        return len(self.first)

    def chosen(self, pairs: NDArray[np.int64] | NDArray[np.bool_]) -> Pairs:
        """Some of the pairs, by index or mask."""
        pairs = np.arange(len(self))[pairs]
        rows = np.concatenate([np.empty(0, dtype=np.int64), *(
            np.arange(self.begin[p], self.begin[p + 1]) for p in pairs)])
        begin = np.concatenate([[0], np.cumsum(np.diff(self.begin)[pairs])])
        return Pairs(self.first[pairs], self.second[pairs], begin, self.points1[rows],
                     self.points2[rows])


def make_pairs(tracks: Tracks, gaps: Sequence[int], *, max_matches: int, min_matches: int,
               max_interval: float, rng: np.random.Generator) -> Pairs:
    """Pairs of frames `gaps` frames apart, at every frame.

    Parameters
    ----------
    tracks : Tracks
    gaps : sequence of int
    max_matches, min_matches : int
        More are drawn from, a pair with fewer is left out.
    max_interval : float
        Pairs further apart than `max_interval` times the gap [s] have lost frames in between and
        are left out.
    rng : numpy.random.Generator
    """
    borders = np.searchsorted(tracks.frames, np.arange(len(tracks) + 1))
    order = np.lexsort((tracks.ids, tracks.frames))
    ids = tracks.ids[order]
    first, second, counts, rows1, rows2 = [], [], [], [], []
    for gap in gaps:
        for i in range(len(tracks) - gap):
            j = i + gap
            if (tracks.stamps_ns[j] - tracks.stamps_ns[i]) * 1e-9 > gap * max_interval:
                continue
            _, in1, in2 = np.intersect1d(
                ids[borders[i]:borders[i + 1]], ids[borders[j]:borders[j + 1]],
                assume_unique=True, return_indices=True)
            if len(in1) < min_matches:
                continue
            if len(in1) > max_matches:
                kept = rng.choice(len(in1), max_matches, replace=False)
                in1, in2 = in1[kept], in2[kept]
            first.append(i)
            second.append(j)
            counts.append(len(in1))
            rows1.append(order[borders[i] + in1])
            rows2.append(order[borders[j] + in2])
    none = np.empty(0, dtype=np.int64)
    points1 = tracks.points[np.concatenate([none, *rows1])]
    points2 = tracks.points[np.concatenate([none, *rows2])]
    begin = np.concatenate([[0], np.cumsum(np.array(counts, dtype=np.int64))])
    return Pairs(np.array(first, dtype=np.int64), np.array(second, dtype=np.int64), begin,
                 points1, points2)
