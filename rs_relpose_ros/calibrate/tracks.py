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
    """Where points were seen; taken as array_likes."""

    stamps_ns: NDArray[np.int64]    # (F,) of the frames, camera clock, strictly increasing
    frames: NDArray[np.int64]       # (N,) frame of each observation, not decreasing
    ids: NDArray[np.int64]          # (N,) its track; at most once per frame
    points: Array                   # (N, 2) raw (distorted) pixels

    def __post_init__(self) -> None:
        stamps, frames, ids = (np.ascontiguousarray(values, dtype=np.int64)
                               for values in (self.stamps_ns, self.frames, self.ids))
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
    """Pairs of frames with their common points, matches of a pair one after the other."""

    first: NDArray[np.int64]     # (P,) frames
    second: NDArray[np.int64]
    begin: NDArray[np.int64]     # (P + 1,) matches of pair p: begin[p] to begin[p + 1]
    points1: Array               # (N, 2) raw pixels
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

    More than `max_matches` are drawn from, a pair with fewer than `min_matches` is left out, and
    so is one further apart than `max_interval` times the gap [s], which has lost frames.
    """
    borders = np.searchsorted(tracks.frames, np.arange(len(tracks) + 1))
    order = np.lexsort((tracks.ids, tracks.frames))
    ids = tracks.ids[order]
    none = np.empty(0, dtype=np.int64)
    first, second, counts, rows1, rows2 = [], [], [], [none], [none]
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
    begin = np.concatenate([[0], np.cumsum(np.array(counts, dtype=np.int64))])
    return Pairs(np.array(first, dtype=np.int64), np.array(second, dtype=np.int64), begin,
                 tracks.points[np.concatenate(rows1)], tracks.points[np.concatenate(rows2)])
