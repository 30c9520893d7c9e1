"""Tracks and gyro on one time axis, and the data of search and fit made from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyfit
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import cumulative_trapezoid

from rs_relpose_ros.calibrate.coplanarity import (
    BIAS,
    CENTER,
    EXPOSURE,
    GLOBAL,
    LENS,
    Problem,
    RADIAL,
    SLOPE,
    View,
)
from rs_relpose_ros.calibrate.result import AXES
from rs_relpose_ros.calibrate.start import GyroSeries, noise_density
from rs_relpose_ros.config.settings import CalibrationConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import DISTORTION_MODELS, RollingShutterCamera
from rs_relpose_ros.geometry.timing import correlation_of_steps, FrameIntervals, NANOSECONDS
from rs_relpose_ros.imu.integration import mean_rates
from rs_relpose_ros.pipeline.rotations import rotation_of_rays


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Observations of points over frames."""

    stamps_ns: NDArray[np.int64]    # (F,) of the frames, camera clock, strictly increasing
    frames: NDArray[np.int64]       # (N,) frame of each observation, not decreasing
    ids: NDArray[np.int64]          # (N,) its track; at most once per frame
    points: Array                   # (N, 2) raw (distorted) pixels

    def __len__(self) -> int:
        return len(self.stamps_ns)


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
        """Some of the pairs, by indices in their order or by mask."""
        kept, counts = np.zeros(len(self), dtype=bool), np.diff(self.begin)
        kept[pairs] = True
        rows = np.repeat(kept, counts)
        return Pairs(self.first[kept], self.second[kept], np.cumsum([0, *counts[kept]]),
                     self.points1[rows], self.points2[rows])


class PairSelection(NamedTuple):
    """Pairs of frames of a fit."""

    spans: tuple[float, ...]    # time between the frames [s]; of less than a frame: neighbours
    max_matches: int            # of a pair; drawn from more
    min_matches: int            # pairs with fewer are left out
    most_pairs: int             # evenly over the recording


def make_pairs(tracks: Tracks, gaps: Sequence[int], selection: PairSelection,
               max_interval: float, rng: np.random.Generator) -> Pairs:
    """Pairs of frames `gaps` frames apart, at every frame, with the matches of `selection`.

    Pairs further apart than `max_interval` times the gap [s] have lost frames, and are left out.
    """
    borders = np.searchsorted(tracks.frames, np.arange(len(tracks) + 1))
    order = np.lexsort((tracks.ids, tracks.frames))
    ids = tracks.ids[order]
    frames, counts, rows = [], [], [np.empty((2, 0), dtype=np.int64)]
    for i, j in ((i, i + gap) for gap in gaps for i in range(len(tracks) - gap)):
        if (tracks.stamps_ns[j] - tracks.stamps_ns[i]) * 1e-9 > (j - i) * max_interval:
            continue
        _, *common = np.intersect1d(
            ids[borders[i]:borders[i + 1]], ids[borders[j]:borders[j + 1]],
            assume_unique=True, return_indices=True)
        matches = np.array(common)
        if matches.shape[1] < selection.min_matches:
            continue
        if matches.shape[1] > selection.max_matches:
            matches = matches[:, rng.choice(matches.shape[1], selection.max_matches,
                                            replace=False)]
        frames.append((i, j))
        counts.append(matches.shape[1])
        rows.append(order[borders[[[i], [j]]] + matches])
    first, second = np.array(frames, dtype=np.int64).reshape(-1, 2).T
    points1, points2 = tracks.points[np.hstack(rows)]
    return Pairs(first, second, np.cumsum([0, *counts]), points1, points2)


# -- Stamps of the frames: exposure that changes, or stamps that jitter -------------------------
#
# Both make the offset of a frame depend on the interval T to the previous frame, by about the same
# -0.5: a driver that stamps a fixed time of a longer and longer exposure, and a stamp that is late
# by d, so that T is longer by d and the offset less by d. Only the first is due to the camera.
# They differ in time: automatic exposure keeps an interval for many frames (successive T are
# equal), while jitter makes one interval longer and the next one shorter (correlation -0.5).

# Intervals that differ by more than this share may have exposures that differ.
_VARYING = 0.02
# Correlation of successive intervals beyond which, up or down, they are distinguished.
_DISTINCT = 0.15
# The smooth line: straight within so many frames (1 sigma of the weights).
_SMOOTH = 10.0


class Varying(str, Enum):
    """Why the intervals between frames vary."""

    NOT = 'not'             # all are alike
    EXPOSURE = 'exposure'
    JITTER = 'jitter'
    UNCLEAR = 'unclear'


class FrameTimes(NamedTuple):
    """Why the intervals vary, and a covariate of the offset of F frames."""

    varying: Varying
    # (F,) [s]: T less its median where the exposure varies, the smooth line less the stamp where
    # stamps jitter; otherwise zero.
    covariates: Array
    jitter: float = 0.0     # rms of the stamps about the smooth line [s]; 0 unless they jitter


def frame_times(stamps_ns: NDArray[np.int64]) -> FrameTimes:
    """Evaluate F stamps [ns]; at least two."""
    tracker = FrameIntervals()
    kept = [tracker.add(int(stamp)) for stamp in stamps_ns]
    steps = np.diff(stamps_ns) / NANOSECONDS
    median = float(np.median(np.diff(stamps_ns))) / NANOSECONDS
    # As in the node: the first frame has no T, and so none that differs.
    longer = np.array([0.0, *(np.array(kept[1:]) / NANOSECONDS - median)])
    low, high = np.quantile(longer, (0.1, 0.9))
    if high - low <= _VARYING * median:
        return FrameTimes(Varying.NOT, np.zeros(len(stamps_ns)))
    correlation = correlation_of_steps(steps / median)
    if correlation > _DISTINCT:
        return FrameTimes(Varying.EXPOSURE, longer)
    if correlation < -_DISTINCT:
        late = _smooth(stamps_ns, median)
        return FrameTimes(Varying.JITTER, late, float(np.sqrt((late**2).mean())))
    return FrameTimes(Varying.UNCLEAR, np.zeros(len(stamps_ns)))


def _smooth(stamps_ns: NDArray[np.int64], interval: float) -> Array:
    """A smooth line through the stamps less the stamps (F,) [s]: straight near each frame."""
    times = (stamps_ns - stamps_ns[0]) / NANOSECONDS
    numbers = np.cumsum([0.0, *np.maximum(np.rint(np.diff(times) / interval), 1.0)])
    lines = (polyfit(numbers - number, times, 1,
                     w=np.exp(-0.25 * ((numbers - number) / _SMOOTH) ** 2)) for number in numbers)
    return np.array([line[0] for line in lines]) - times


# -- Exposure: the gyro is averaged over it -----------------------------------------------------

# Where automatic exposure lengthens the intervals, the exposure is the interval less this [s].
_MARGIN, _MARGIN_SIGMA = 0.008, 0.004
# Change of the square of the exposure [s^2] over which its effect on the rates is taken.
_SQUARE = 0.03**2


class Exposure(NamedTuple):
    """What is known of the exposure of a row before the fit."""

    assumed: Array          # (F,) of each frame [s]
    square_sigma: float     # 1 sigma of its square [s^2]; 0 if it is given
    margin: float = 0.0     # frame interval less exposure [s], where it follows the interval

    @classmethod
    def of(cls, times: Array, stamps: FrameTimes, config: CalibrationConfig) -> Exposure:
        """Of frames at times (F,) [s]: as given, by automatic exposure, or at most an interval."""
        interval = float(np.median(np.diff(times)))
        margin = config.exposure_margin
        if not margin and stamps.varying is Varying.EXPOSURE and not config.exposure_time:
            margin = _MARGIN
        if margin and config.exposed:
            longer = stamps.covariates if stamps.varying is Varying.EXPOSURE else 0.0 * times
            exposure = np.maximum(interval + longer - margin, 0.0)
            doubt = 0.0 if config.exposure_margin else _MARGIN_SIGMA
            return cls(exposure, 2.0 * doubt * float(np.median(exposure)), margin)
        if config.exposure_time or not config.exposed:
            return cls(np.full(len(times), config.exposure_time), 0.0)
        # Evenly distributed between zero and the interval: mean and sigma of the square.
        square = interval**2
        return cls(np.full(len(times), math.sqrt(square / 3.0)), square * math.sqrt(4.0 / 45.0))


def exposed_rates(gyro: GyroSeries, exposure: Array) -> tuple[Array, Array]:
    """Rates (K, 3) averaged over the exposure (K,) [s] at each sample; derivative by its square.

    An image that is exposed for h has the mean over h of the rotation: to second order
    ``w + h^2 / 24 w''`` of the rate w, so that the derivative by h^2 hardly depends on h.
    """
    def mean(widths: Array) -> Array:
        # Width zero is the rate itself.
        return mean_rates(gyro.stamps_ns, gyro.rates, gyro.stamps_ns, np.maximum(widths, 1e-6))

    rates = mean(exposure)
    return rates, (mean(np.sqrt(exposure**2 + _SQUARE)) - rates) / _SQUARE


def with_lens(camera: RollingShutterCamera, lens: Array) -> RollingShutterCamera:
    """Camera moved by ``[log focal length, first coefficient, principal point (2) [px]]``."""
    counts = DISTORTION_MODELS[camera.distortion_model].coefficient_counts
    first, *others = camera.distortion or (0.0,) * max(counts[0], 4)
    return replace(camera, fx=camera.fx * math.exp(lens[0]), fy=camera.fy * math.exp(lens[0]),
                   distortion=(first + float(lens[1]), *others), cx=camera.cx + float(lens[2]),
                   cy=camera.cy + float(lens[3]))


# Frames further apart than so many intervals have lost some in between.
_LOST = 1.5
_LEAST_PAIRS = 10
# Pairs of a second that a fit uses at most: with all of them its sigmas are no smaller.
_PAIRS_PER_SECOND = 80.0
# Longest step between samples of the gyro that is interpolated [s], and rms rate below which the
# camera is at rest about an axis [rad/s].
MAX_GYRO_GAP, LEAST_ROTATION = 0.03, math.radians(2.0)
# Prior of `bend`, 1 sigma, before the parallax is known.
_BEND_AT_START = 0.1
# 1 sigma of a gyro's bias [rad/s]; of the offset's change by a covariate [s/s]; of an unknown
# lens: first coefficient of the distortion, principal point as a share of the width.
_BIAS_SIGMA, _SLOPE_SIGMA = 0.03, 1.0
_RADIAL_SIGMA, _CENTER_SIGMA = 0.3, 0.015
# Steps of the lens [1, 1, px, px] for its derivatives.
_LENS_STEPS = (1e-5, 1e-5, 1e-2, 1e-2)
# Error of the rotation between two frames of a gyro without noise, by its sampling [rad].
_LEAST_ROTATION = 2e-5
# Cosine of the angle to the optical axis beyond which a point has no normalised coordinates.
_LEAST_COSINE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """A recording, in seconds since the first frame."""

    tracks: Tracks                  # of points that the camera model can map to rays
    camera: RollingShutterCamera    # as assumed, moved by `lens`; its readout time is not used
    lens: Array                     # (4,) as of `with_lens`
    times: Array                    # (F,) stamps of the frames [s]
    stamps: FrameTimes              # exposure and jitter by the stamps
    exposure: Exposure              # before the fit
    gyro_times: Array               # (K,) [s]
    gyro_rates: Array               # (K, 3) mean over the assumed exposure [rad/s]
    blur_rates: Array               # (K, 3) their derivative by its square [rad/s^3]
    gyro_density: float             # white noise of the gyro [rad/s/sqrt(Hz)]

    @classmethod
    def of(cls, tracks: Tracks, gyro: GyroSeries, camera: RollingShutterCamera,
           config: CalibrationConfig | None = None, lens: ArrayLike = (0.0, 0.0, 0.0, 0.0),
           ) -> Observations:
        """Observations of at least two frames and two samples."""
        lens = np.array(lens)
        camera = with_lens(camera, lens)
        rays = camera.unproject(tracks.points)
        ahead = np.isfinite(rays).all(axis=1) & (rays[:, 2] > _LEAST_COSINE)
        tracks = replace(tracks, frames=tracks.frames[ahead], ids=tracks.ids[ahead],
                         points=tracks.points[ahead])
        times, gyro_times = (np.asarray((stamps_ns - tracks.stamps_ns[0]) * 1e-9)
                             for stamps_ns in (tracks.stamps_ns, gyro.stamps_ns))
        stamps = frame_times(tracks.stamps_ns)
        exposure = Exposure.of(times, stamps, config or CalibrationConfig())
        return cls(tracks, camera, lens, times, stamps, exposure, gyro_times,
                   *exposed_rates(gyro, np.interp(gyro_times, times, exposure.assumed)),
                   noise_density(gyro_times, gyro.rates))

    @property
    def interval(self) -> float:
        """Median interval between frames [s]."""
        return float(np.median(np.diff(self.times)))

    @property
    def gyro_steps(self) -> Array:
        """Steps (K - 1,) between samples of the gyro [s]."""
        return np.diff(self.gyro_times)

    def excitation(self, bias: Array, R_cam_imu: Array) -> tuple[Array, str, Array]:
        """Rms rates (3,) about the camera's axes [rad/s], what is missing (empty: nothing), axis.

        The latter (3,) is that of the most rotation, a unit vector of the camera.
        """
        inside = (self.gyro_times >= self.times[0]) & (self.gyro_times <= self.times[-1])
        rates = (self.gyro_rates[inside] - bias) @ R_cam_imu.T
        rates = rates - rates.mean(axis=0)
        rms = np.sqrt((rates**2).mean(axis=0))
        values, vectors = np.linalg.eigh(rates.T @ rates / len(rates))
        # Two axes fix a rotation.
        if np.sqrt(max(values[1], 0.0)) >= LEAST_ROTATION:
            return rms, '', vectors[:, 2]
        main = vectors[:, 2]
        lacking = [AXES[i] for i in np.argsort(np.abs(main))[:2]]
        about = AXES[int(np.argmax(np.abs(main)))]
        return rms, (f'the camera rotates about one axis only, nearly {about}, so the rotation '
                     f'about it is not observable: rotate about {lacking[0]} and {lacking[1]} '
                     'too, 20 to 60 deg/s'), main

    def pairs(self, selection: PairSelection, rng: np.random.Generator) -> Pairs:
        """All pairs of these spans without lost frames."""
        gaps = sorted({max(1, round(span / self.interval)) for span in selection.spans})
        return make_pairs(self.tracks, gaps, selection, _LOST * self.interval, rng)

    def selected_problem(self, selection: PairSelection, offset: float,
                         rng: np.random.Generator) -> Problem:
        """Data of a fit to pairs all of whose rows lie within the gyro and touch no gap of it.

        `offset` [s] is about that of the clocks. InputError if there are fewer than ten pairs.
        """
        pairs, half = self.pairs(selection, rng), 0.5 * self.interval + 0.01
        begin = self.times[pairs.first] + offset - half
        end = self.times[pairs.second] + offset + half
        clear = (begin >= self.gyro_times[0]) & (end <= self.gyro_times[-1])
        for k in np.flatnonzero(self.gyro_steps > MAX_GYRO_GAP):
            clear &= (end <= self.gyro_times[k]) | (begin >= self.gyro_times[k + 1])
        pairs = pairs.chosen(clear)
        if len(pairs) < _LEAST_PAIRS:
            raise InputError(
                f'only {len(pairs)} pairs of images have {selection.min_matches} points in common '
                'and a gyro without gaps: record a textured scene with a short exposure, and all '
                'of the gyro')
        most = min(selection.most_pairs, round(_PAIRS_PER_SECOND * self.times[-1]))
        if len(pairs) > most:
            pairs = pairs.chosen(np.linspace(0, len(pairs) - 1, most).astype(np.int64))
        return self.problem(pairs, offset)

    def image_rates(self, pairs: Pairs) -> Array:
        """Angular velocity (P, 3) [rad/s], camera frame, that rotates the rays of each pair."""
        rays1, rays2 = map(self.camera.unproject, (pairs.points1, pairs.points2))
        rotations = [rotation_of_rays(rays1[begin:end], rays2[begin:end])
                     for begin, end in itertools.pairwise(pairs.begin)]
        return np.array(rotations).reshape(-1, 3) / (
            self.times[pairs.second] - self.times[pairs.first])[:, None]

    def problem(self, pairs: Pairs, offset: float) -> Problem:
        """Data of a fit to `pairs`, which the gyro covers at about this `offset` [s]."""
        times1, times2 = self.times[pairs.first], self.times[pairs.second]
        middles = np.searchsorted(self.gyro_times, 0.5 * (times1 + times2) + offset)
        turn_sigma = np.sqrt(self.gyro_density**2 * (times2 - times1) + _LEAST_ROTATION**2)
        prior, center = np.zeros(GLOBAL), np.zeros(GLOBAL)
        center[LENS] = -self.lens
        prior[BIAS:BIAS + 3] = _BIAS_SIGMA**-2
        prior[SLOPE] = _SLOPE_SIGMA**-2
        prior[RADIAL] = _RADIAL_SIGMA**-2
        prior[CENTER:CENTER + 2] = (_CENTER_SIGMA * self.camera.width)**-2
        if self.exposure.square_sigma:
            prior[EXPOSURE] = self.exposure.square_sigma**-2
        blur_turns = cumulative_trapezoid(self.blur_rates, self.gyro_times, axis=0, initial=0.0)
        return Problem(
            self.gyro_times, self.gyro_rates, self.blur_rates, blur_turns, pairs.begin, middles,
            self._view(pairs.first, pairs.points1), self._view(pairs.second, pairs.points2),
            np.full(len(pairs), _BEND_AT_START), turn_sigma, prior, center)

    def _view(self, frames: NDArray[np.int64], pixels: Array) -> View:
        points, by_pixel = _normalized(self.camera, pixels)
        by_lens, by_both = np.empty((len(pixels), 2, 4)), np.empty((len(pixels), 2, 2, 4))
        for k, step in enumerate(_LENS_STEPS):
            moved = _normalized(with_lens(self.camera, step * np.eye(4)[k]), pixels)
            by_lens[:, :, k] = (moved[0] - points) / step
            by_both[:, :, :, k] = (moved[1] - by_pixel) / step
        height = self.camera.height
        return View(self.times[frames], self.stamps.covariates[frames], points,
                    (pixels[:, 1] - 0.5 * (height - 1)) / height, by_pixel, by_lens, by_both)


def _normalized(camera: RollingShutterCamera, pixels: Array) -> tuple[Array, Array]:
    """Normalised points (N, 2) of pixels, and their derivatives (N, 2, 2) by them."""
    rays, by_pixel = camera.unproject_with_jacobian(pixels)
    # n = m_xy / m_z, so dn = (dm_xy - n dm_z) / m_z.
    points = rays[:, :2] / rays[:, 2:]
    by_pixel = (by_pixel[:, :2] - points[:, :, None] * by_pixel[:, 2:]) / rays[:, 2:, None]
    return np.ascontiguousarray(points), np.ascontiguousarray(by_pixel)
