"""Tracks and gyro on one time axis, and what the coarse search and the fit take of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibrate.alignment import seen_rates
from rs_relpose_ros.calibrate.coplanarity import BIAS, EXPOSURE, GLOBAL, Problem, View
from rs_relpose_ros.calibrate.gyro_path import blur, GyroSeries, noise_density
from rs_relpose_ros.calibrate.stamps import frame_times, FrameTimes
from rs_relpose_ros.calibrate.tracks import make_pairs, Pairs, Tracks
from rs_relpose_ros.geometry.camera import RollingShutterCamera

Array = NDArray[np.float64]

# Frames further apart than so many intervals have lost some in between.
_LOST = 1.5
# Prior of `bend`, 1 sigma, before the parallax is known.
_BEND_AT_START = 0.1
# 1 sigma of a gyro's bias [rad/s], and of the exposure, as a share of the interval.
_BIAS_SIGMA, _EXPOSED = 0.03, 0.8
# Rotation between two frames that even a gyro without noise misses between its samples [rad].
_LEAST_TURN = 2e-5
# Cosine of the angle to the optical axis beyond which a point has no normalised coordinates.
_LEAST_COSINE = 0.05


class PairSelection(NamedTuple):
    """Which pairs of frames take part in a fit."""

    spans: tuple[float, ...]    # time between the frames [s]
    max_matches: int            # of a pair; more are drawn from
    min_matches: int            # pairs with fewer are left out
    most_pairs: int             # evenly over the recording


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """What was recorded, in seconds since the first frame."""

    tracks: Tracks                  # of points that the camera model can map to rays
    camera: RollingShutterCamera    # its read-out time is not looked at
    times: Array                    # (F,) stamps of the frames [s]
    stamps: FrameTimes              # what the stamps tell of exposure and jitter
    gyro_times: Array               # (K,) [s]
    gyro_rates: Array               # (K, 3) [rad/s]
    gyro_density: float             # white noise of the gyro [rad/s/sqrt(Hz)]

    @classmethod
    def of(cls, tracks: Tracks, gyro: GyroSeries, camera: RollingShutterCamera) -> Observations:
        """Observations of at least two frames and two samples."""
        rays = camera.unproject(tracks.points)
        ahead = np.isfinite(rays).all(axis=1) & (rays[:, 2] > _LEAST_COSINE)
        tracks = replace(tracks, frames=tracks.frames[ahead], ids=tracks.ids[ahead],
                         points=tracks.points[ahead])
        times, gyro_times = (np.asarray((stamps_ns - tracks.stamps_ns[0]) * 1e-9)
                             for stamps_ns in (tracks.stamps_ns, gyro.stamps_ns))
        return cls(tracks, camera, times, frame_times(tracks.stamps_ns), gyro_times, gyro.rates,
                   noise_density(gyro_times, gyro.rates))

    @property
    def interval(self) -> float:
        """Median interval between frames [s]."""
        return float(np.median(np.diff(self.times)))

    @property
    def gyro_steps(self) -> Array:
        """Steps (K - 1,) between samples of the gyro [s]."""
        return np.diff(self.gyro_times)

    def pairs(self, gaps: tuple[int, ...], *, max_matches: int, min_matches: int,
              rng: np.random.Generator) -> Pairs:
        """Pairs of frames `gaps` frames apart that have lost none in between; see `make_pairs`."""
        return make_pairs(self.tracks, gaps, max_matches=max_matches, min_matches=min_matches,
                          max_interval=_LOST * self.interval, rng=rng)

    def selected(self, selection: PairSelection, offset: float, max_gyro_gap: float,
                 rng: np.random.Generator) -> Pairs:
        """Selected pairs all of whose rows lie within the gyro and touch no gap of it."""
        frames = sorted({max(1, round(span / self.interval)) for span in selection.spans})
        pairs = self.pairs(tuple(frames), max_matches=selection.max_matches,
                           min_matches=selection.min_matches, rng=rng)
        half = 0.5 * self.interval + 0.01
        pairs = pairs.chosen(
            (self.times[pairs.first] + offset - half >= self.gyro_times[0])
            & (self.times[pairs.second] + offset + half <= self.gyro_times[-1])
            & self.clear_of_gaps(pairs, offset, half, max_gyro_gap))
        if len(pairs) <= selection.most_pairs:
            return pairs
        return pairs.chosen(np.linspace(0, len(pairs) - 1, selection.most_pairs).astype(np.int64))

    def clear_of_gaps(self, pairs: Pairs, offset: float, margin: float,
                      max_gyro_gap: float) -> NDArray[np.bool_]:
        """Mask (P,) of pairs with no longer step of the gyro in them or `margin` [s] around."""
        begin = self.times[pairs.first] + offset - margin
        end = self.times[pairs.second] + offset + margin
        clear = np.ones(len(pairs), dtype=bool)
        for k in np.flatnonzero(self.gyro_steps > max_gyro_gap):
            clear &= (end <= self.gyro_times[k]) | (begin >= self.gyro_times[k + 1])
        return clear

    def seen_rates(self, pairs: Pairs) -> Array:
        """Angular velocity (P, 3) [rad/s], camera frame; see `alignment.seen_rates`."""
        return seen_rates(pairs.begin, self.camera.unproject(pairs.points1),
                          self.camera.unproject(pairs.points2),
                          self.times[pairs.second] - self.times[pairs.first])

    def problem(self, pairs: Pairs, offset: float) -> Problem:
        """Data of a fit to `pairs`, which the gyro covers at about this `offset` [s]."""
        times1, times2 = self.times[pairs.first], self.times[pairs.second]
        middles = np.searchsorted(self.gyro_times, 0.5 * (times1 + times2) + offset)
        turn_sigma = np.sqrt(self.gyro_density**2 * (times2 - times1) + _LEAST_TURN**2)
        prior = np.zeros(GLOBAL)
        prior[BIAS:BIAS + 3] = _BIAS_SIGMA**-2
        prior[EXPOSURE] = (_EXPOSED * self.interval)**-4
        return Problem(
            self.gyro_times, self.gyro_rates, *blur(self.gyro_times, self.gyro_rates), pairs.begin,
            middles,
            self._view(pairs.first, pairs.points1), self._view(pairs.second, pairs.points2),
            np.full(len(pairs), _BEND_AT_START), turn_sigma, prior)

    def _view(self, frames: NDArray[np.int64], pixels: Array) -> View:
        rays, by_pixel = self.camera.unproject_with_jacobian(pixels)
        # n = m_xy / m_z, so dn = (dm_xy - n dm_z) / m_z.
        points = np.asarray(rays[:, :2] / rays[:, 2:])
        by_pixel = (by_pixel[:, :2] - points[:, :, None] * by_pixel[:, 2:]) / rays[:, 2:, None]
        height = self.camera.height
        return View(self.times[frames], self.stamps.covariates[frames], points,
                    (pixels[:, 1] - 0.5 * (height - 1)) / height, np.ascontiguousarray(by_pixel))
