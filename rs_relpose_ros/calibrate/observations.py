"""Tracks and gyro on one time axis, and what the coarse search and the fit take of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibrate.alignment import seen_rates
from rs_relpose_ros.calibrate.fit import BEND_AT_START, Problem
from rs_relpose_ros.calibrate.gyro_path import GyroSeries, noise_density
from rs_relpose_ros.calibrate.tracks import make_pairs, Pairs, Tracks
from rs_relpose_ros.geometry.camera import RollingShutterCamera

Array = NDArray[np.float64]

# Frames further apart than so many intervals have lost some in between.
_LOST = 1.5
# Cosine of the angle to the optical axis beyond which a point has no normalised coordinates.
_LEAST_COSINE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """What was recorded, in seconds since the first frame.

    Attributes
    ----------
    tracks : Tracks
        Those points that the camera model can map to rays.
    camera : RollingShutterCamera
        Its read-out time is not looked at.
    times : (F,) ndarray
        Stamps of the frames [s].
    covariates : (F,) ndarray
        By how much the interval to the next frame is longer than the median one [s]; 0 where
        frames were lost.
    gyro_times, gyro_rates : (K,), (K, 3) ndarray
        [s], [rad/s].
    gyro_density : float
        White noise of the gyro [rad/s/sqrt(Hz)].
    """

    tracks: Tracks
    camera: RollingShutterCamera
    times: Array
    covariates: Array
    gyro_times: Array
    gyro_rates: Array
    gyro_density: float

    @classmethod
    def of(cls, tracks: Tracks, gyro: GyroSeries, camera: RollingShutterCamera) -> Observations:
        """Observations of at least two frames and two samples."""
        rays = camera.unproject(tracks.points)
        ahead = np.isfinite(rays).all(axis=1) & (rays[:, 2] > _LEAST_COSINE)
        tracks = replace(tracks, frames=tracks.frames[ahead], ids=tracks.ids[ahead],
                         points=tracks.points[ahead])
        origin_ns = int(tracks.stamps_ns[0])
        times, gyro_times = tracks.seconds(origin_ns), gyro.seconds(origin_ns)
        intervals = np.diff(times)
        to_next = np.append(intervals, intervals[-1])
        longer = to_next - np.median(intervals)
        # Where frames are lost, the interval tells nothing of the exposure.
        longer[longer > (_LOST - 1.0) * np.median(intervals)] = 0.0
        return cls(tracks, camera, times, longer, gyro_times, gyro.rates,
                   noise_density(gyro_times, gyro.rates))

    @property
    def interval(self) -> float:
        """Median interval between frames [s]."""
        return float(np.median(np.diff(self.times)))

    @property
    def gyro_steps(self) -> Array:
        """Steps (K - 1,) between samples of the gyro [s]."""
        return np.diff(self.gyro_times)

    def frames_in(self, spans: tuple[float, ...]) -> tuple[int, ...]:
        """Numbers of frames that make up these spans of time [s]."""
        return tuple(sorted({max(1, round(span / self.interval)) for span in spans}))

    def pairs(self, gaps: tuple[int, ...], *, max_matches: int, min_matches: int,
              rng: np.random.Generator) -> Pairs:
        """Pairs of frames `gaps` frames apart that have lost none in between; see `make_pairs`."""
        return make_pairs(self.tracks, gaps, max_matches=max_matches, min_matches=min_matches,
                          max_interval=_LOST * self.interval, rng=rng)

    def covered(self, pairs: Pairs, offset: float, max_gyro_gap: float) -> NDArray[np.bool_]:
        """Mask (P,) of pairs all of whose rows lie within the gyro and touch no gap of it."""
        half = 0.5 * self.interval + 0.01
        return np.asarray(
            (self.times[pairs.first] + offset - half >= self.gyro_times[0])
            & (self.times[pairs.second] + offset + half <= self.gyro_times[-1])
            & self.clear_of_gaps(pairs, offset, half, max_gyro_gap))

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
        return seen_rates(pairs, _normalised(self.camera, pairs.points1),
                          _normalised(self.camera, pairs.points2),
                          self.times[pairs.second] - self.times[pairs.first])

    def problem(self, pairs: Pairs, offset: float) -> Problem:
        """Data of a fit to `pairs`, which the gyro covers at about this `offset` [s]."""
        camera = self.camera
        middle = 0.5 * (camera.height - 1)
        points1, by_pixel1 = _normalised_by_pixel(camera, pairs.points1)
        points2, by_pixel2 = _normalised_by_pixel(camera, pairs.points2)
        times1, times2 = self.times[pairs.first], self.times[pairs.second]
        return Problem(
            self.gyro_times, self.gyro_rates, pairs.begin,
            np.searchsorted(self.gyro_times, 0.5 * (times1 + times2) + offset), pairs.first,
            pairs.second, times1, times2, self.covariates[pairs.first],
            self.covariates[pairs.second], points1, points2,
            (pairs.points1[:, 1] - middle) / camera.height,
            (pairs.points2[:, 1] - middle) / camera.height, by_pixel1, by_pixel2,
            self.gyro_density, np.full(len(pairs), BEND_AT_START))


def evenly(pairs: Pairs, most: int) -> Pairs:
    """At most so many of the pairs, evenly among all."""
    if len(pairs) <= most:
        return pairs
    return pairs.chosen(np.linspace(0, len(pairs) - 1, most).astype(np.int64))


def _normalised(camera: RollingShutterCamera, points: Array) -> Array:
    rays = camera.unproject(points)
    return np.asarray(rays[:, :2] / rays[:, 2:])


def _normalised_by_pixel(camera: RollingShutterCamera, points: Array) -> tuple[Array, Array]:
    """Normalised points (N, 2), and their derivative by the pixels (N, 2, 2)."""
    rays, jacobian = camera.unproject_with_jacobian(points)
    normalised = np.asarray(rays[:, :2] / rays[:, 2:])
    # n = m_xy / m_z, so dn = (dm_xy - n dm_z) / m_z.
    by_pixel = (jacobian[:, :2] - normalised[:, :, None] * jacobian[:, 2:]) / rays[:, 2:, None]
    return normalised, np.ascontiguousarray(by_pixel)
