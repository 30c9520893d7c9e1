"""Tracks and gyro on one time axis, the data of the fit made from them, and where it starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache
import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyfit
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.calibration import model
from rs_relpose_ros.calibration.knowledge import LensKnowledge, prior_information
from rs_relpose_ros.calibration.offset_course import OffsetCourse, RatesAtOffsets
from rs_relpose_ros.calibration.rotations import rotation_of_rays
from rs_relpose_ros.config.settings import CalibrationConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.geometry.camera import readout_direction, RollingShutterCamera
from rs_relpose_ros.geometry.lens import N_LENS
from rs_relpose_ros.geometry.timing import correlation_of_steps, FrameIntervals, NANOSECONDS
from rs_relpose_ros.imu.integration import integral, interpolated, mean_rates
from rs_relpose_ros.imu.noise import density_of, third_differences

# Axes of the camera, for people.
AXES = ('x (pitch)', 'y (yaw)', 'z (roll)')


@dataclass(frozen=True, slots=True, eq=False)
class TrackedPoints:
    """Observations of points over frames."""

    stamps_ns: NDArray[np.int64]  # (F,) of the frames, camera clock, strictly increasing
    frames: NDArray[np.int64]  # (N,) frame of each observation, not decreasing
    ids: NDArray[np.int64]  # (N,) its track; at most once per frame
    points: Array  # (N, 2) raw (distorted) pixels

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True, slots=True, eq=False)
class GyroSeries:
    """Samples of a gyro."""

    stamps_ns: NDArray[np.int64]  # (K,) IMU clock, strictly increasing
    rates: Array  # (K, 3) as measured, IMU frame [rad/s]
    delay_sigma: float = 0.0  # 1 sigma [s] of a delay of all stamps that nothing shows

    def __len__(self) -> int:
        return len(self.stamps_ns)


class Pair(NamedTuple):
    """Two frames with their common points."""

    first: int
    second: int
    rows: NDArray[np.int64]  # (2, n) observations of the points in both


def frames_of(pairs: Sequence[Pair]) -> NDArray[np.int64]:
    """Frames (2, P) of pairs."""
    frames = np.array([pair[:2] for pair in pairs], dtype=np.int64).reshape(-1, 2)
    # A transposed index makes transposed times, which compile the kernels a second time.
    return np.ascontiguousarray(frames.T)


class PairSelection(NamedTuple):
    """Pairs of frames of a fit."""

    spans: tuple[float, ...]  # time between the frames [s]; of less than a frame: neighbours
    max_matches: int  # of a pair; drawn from more
    min_matches: int  # pairs with fewer are left out
    most_pairs: int  # evenly over the recording


def make_pairs(
    tracks: TrackedPoints,
    gaps: Sequence[int],
    selection: PairSelection,
    max_interval: float,
    rng: np.random.Generator,
) -> list[Pair]:
    """Pairs `gaps` frames apart; none further apart than `max_interval` times the gap [s]."""
    borders = np.searchsorted(tracks.frames, np.arange(len(tracks) + 1))
    order = np.lexsort((tracks.ids, tracks.frames))
    ids = np.split(tracks.ids[order], borders[1:-1])  # of each frame
    pairs = []
    for i, j in ((i, i + gap) for gap in gaps for i in range(len(tracks) - gap)):
        interval = (tracks.stamps_ns[j] - tracks.stamps_ns[i]) * 1e-9
        if interval > (j - i) * max_interval:
            continue
        _, *common = np.intersect1d(ids[i], ids[j], assume_unique=True, return_indices=True)
        matches = np.array(common)
        count = matches.shape[1]
        if count < selection.min_matches:
            continue
        if count > selection.max_matches:
            drawn = rng.choice(count, selection.max_matches, replace=False)
            matches = matches[:, drawn]
        starts = borders[[i, j]]
        pairs.append(Pair(i, j, order[starts[:, None] + matches]))
    return pairs


# -- Stamps of the frames: exposure that changes, or stamps that jitter -------------------------
#
# Both make the offset of a frame depend on the interval T to the previous frame, by about the same
# -0.5: a driver that stamps a fixed time of a longer and longer exposure, and a stamp that is late
# by d, so that T is longer by d and the offset less by d. Only the first keeps T for many frames.

# Intervals that differ by more than this share may have exposures that differ.
_VARYING = 0.02
# Correlation of successive intervals beyond which, up or down, they are distinguished.
_DISTINCT = 0.15
# The smooth line: straight within so many frames (1 sigma of the weights).
_SMOOTH = 10.0


class Varying(str, Enum):
    """Why the intervals between frames vary, or the offset by time."""

    NOT = 'not'  # all are alike
    EXPOSURE = 'exposure'
    JITTER = 'jitter'
    UNCLEAR = 'unclear'
    COURSE = 'course'  # a clock is set or drifts


class FrameTimes(NamedTuple):
    """Why the intervals vary, and a covariate of the offset of F frames."""

    varying: Varying
    # (F,) [s]: T less its median where the exposure varies, the smooth line less the stamp where
    # stamps jitter; those of an `OffsetCourse`; otherwise zero.
    covariates: Array

    @property
    def size(self) -> float:
        """Rms of the covariates."""
        return float(np.sqrt((self.covariates**2).mean()))


def frame_times(stamps_ns: NDArray[np.int64]) -> FrameTimes:
    """Evaluate F stamps [ns]; at least two."""
    tracker = FrameIntervals()
    kept = [tracker.add(int(stamp)) for stamp in stamps_ns]
    steps_ns = np.diff(stamps_ns)
    median = float(np.median(steps_ns)) / NANOSECONDS
    # As in the node: the first frame has no T, and so none that differs.
    longer = np.zeros(len(stamps_ns))
    longer[1:] = np.array(kept[1:]) / NANOSECONDS - median
    low, high = np.quantile(longer, (0.1, 0.9))
    if high - low <= _VARYING * median:
        return FrameTimes(Varying.NOT, np.zeros(len(stamps_ns)))
    correlation = correlation_of_steps(steps_ns / NANOSECONDS / median)
    if correlation > _DISTINCT:
        return FrameTimes(Varying.EXPOSURE, longer)
    if correlation >= -_DISTINCT:
        return FrameTimes(Varying.UNCLEAR, np.zeros(len(stamps_ns)))
    times = (stamps_ns - stamps_ns[0]) / NANOSECONDS
    return FrameTimes(Varying.JITTER, _smoothed(times, median) - times)


def _smoothed(times: Array, interval: float) -> Array:
    """Times (F,) [s] on a smooth line through the stamps, which is straight near each frame."""
    advances = np.maximum(np.rint(np.diff(times) / interval), 1.0)
    numbers = np.concatenate([[0.0], np.cumsum(advances)])
    smooth = np.empty(len(times))
    for k, number in enumerate(numbers):
        apart = numbers - number
        weights = np.exp(-0.25 * (apart / _SMOOTH) ** 2)
        smooth[k] = polyfit(apart, times, 1, w=weights)[0]
    return smooth


# -- Exposure: the gyro is averaged over it -----------------------------------------------------

# Where automatic exposure lengthens the intervals, the exposure is the interval less this [s].
# [chosen: a sensor needs a few ms between two exposures]
_MARGIN = 0.008
# Its sigma [s]. A smaller one would make the readout time too certain, which it changes.
# [chosen: from nearly none to twice the margin]
_MARGIN_SIGMA = 0.004
# Change of the square of the exposure [s^2] over which its effect on the rates is taken.
_SQUARE = 0.03**2


class Exposure(NamedTuple):
    """What is known of the exposure of a row before the fit."""

    assumed: Array  # (F,) of each frame [s]
    square_sigma: float  # 1 sigma of its square [s^2]; 0 if it is given
    margin: float = 0.0  # frame interval less exposure [s], where it follows the interval

    @classmethod
    def of(cls, times: Array, stamps: FrameTimes, config: CalibrationConfig) -> Exposure:
        """Of frames at times (F,) [s]: as given, by automatic exposure, or at most an interval."""
        interval = float(np.median(np.diff(times)))
        follows = stamps.varying is Varying.EXPOSURE
        margin = config.exposure_margin
        if not margin and follows and not config.exposure_time:
            margin = _MARGIN
        if margin and config.exposed:
            exposure = np.maximum(interval + follows * stamps.covariates - margin, 0.0)
            margin_sigma = 0.0 if config.exposure_margin else _MARGIN_SIGMA
            square_sigma = 2.0 * margin_sigma * float(np.median(exposure))
            return cls(exposure, square_sigma, margin)
        if config.exposure_time or not config.exposed:
            return cls(np.full(len(times), config.exposure_time), 0.0)
        # Evenly distributed between zero and the interval: mean and sigma of the square.
        square = interval**2
        exposure = np.full(len(times), math.sqrt(square / 3.0))
        return cls(exposure, square * math.sqrt(4.0 / 45.0))


def exposed_rates(gyro: GyroSeries, exposure: Array) -> tuple[Array, Array]:
    """Rates (K, 3) averaged over the exposure (K,) [s] at each sample; derivative by its square.

    An image that is exposed for h has the mean over h of the rotation: to second order
    ``w + h^2 / 24 w''`` of the rate w, so that the derivative by h^2 hardly depends on h.
    """

    def mean(widths: Array) -> Array:
        # Width zero is the rate itself.
        return mean_rates(gyro.stamps_ns, gyro.rates, gyro.stamps_ns, np.maximum(widths, 1e-6))

    rates = mean(exposure)
    longer = np.sqrt(exposure**2 + _SQUARE)
    return rates, (mean(longer) - rates) / _SQUARE


def noise_density(times: Array, rates: Array) -> float:
    """White noise [rad/s/sqrt(Hz)] of rates (K, 3), by third differences: without motion."""
    steps = np.diff(times)
    step = float(np.median(steps))
    is_usual = np.abs(steps - step) < 0.2 * step
    even = is_usual[2:] & is_usual[1:-1] & is_usual[:-2]
    if not even.any():
        return 0.0
    return density_of(third_differences(rates)[even], times)


# Frames further apart than so many intervals have lost some in between.
# [derived: between one interval and two]
_LOST = 1.5
# Least number of pairs that a fit needs. Fewer do not determine the parameters.
# [chosen: as many as parameters]
_LEAST_PAIRS = 10
# Pairs of a second that a fit uses at most: with all of them its sigmas are no smaller.
_PAIRS_PER_SECOND = 80.0
# Longest step between samples of the gyro that is interpolated [s]. Over longer ones a hand turns
# in between. [chosen: a gyro of 33 Hz]
MAX_GYRO_GAP = 0.03
# Rms rate below which the camera is at rest about an axis [rad/s]. Lower would take noise for a
# rotation. [chosen: a tenth of the recommended 20 deg/s]
LEAST_ROTATION = math.radians(2.0)
# Prior of `bend`, 1 sigma, before the parallax is known.
_BEND_AT_START = 0.1
# Error of the rotation between two frames of a gyro without noise, by its sampling [rad].
_LEAST_ROTATION = 2e-5
# Cosine of the angle to the optical axis beyond which a point has no normalised coordinates.
_LEAST_COSINE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """A recording, in seconds since the first frame."""

    tracks: TrackedPoints  # of points that the camera model can map to rays
    camera: RollingShutterCamera  # as assumed, moved by `lens`; its readout time is not used
    lens: Array  # (9,) parameters `model.LENS`
    knowledge: LensKnowledge  # where the camera comes from
    times: Array  # (F,) stamps of the frames [s]
    stamps: FrameTimes
    exposure: Exposure  # before the fit
    gyro_times: Array  # (K,) [s]
    gyro_rates: Array  # (K, 3) mean over the assumed exposure [rad/s]
    blur_rates: Array  # (K, 3) their derivative by its square [rad/s^3]
    gyro_density: float  # white noise of the gyro [rad/s/sqrt(Hz)]
    course: OffsetCourse = OffsetCourse()  # noqa: RUF009 it is frozen
    doubt: float = 1.0  # factor of the sigmas of what is claimed of the lens

    @classmethod
    def of(
        cls,
        tracks: TrackedPoints,
        gyro: GyroSeries,
        camera: RollingShutterCamera,
        config: CalibrationConfig | None = None,
        lens: ArrayLike = (0.0,) * N_LENS,
        knowledge: LensKnowledge = LensKnowledge.CLAIMED,
    ) -> Observations:
        """Observations of at least two frames and two samples."""
        lens = np.array(lens)
        camera = camera.moved_lens(lens)
        rays = camera.unproject(tracks.points)
        ahead = np.isfinite(rays).all(axis=1) & (rays[:, 2] > _LEAST_COSINE)
        tracks = replace(
            tracks, frames=tracks.frames[ahead], ids=tracks.ids[ahead], points=tracks.points[ahead]
        )
        first_ns = tracks.stamps_ns[0]
        times = np.asarray((tracks.stamps_ns - first_ns) * 1e-9)
        gyro_times = np.asarray((gyro.stamps_ns - first_ns) * 1e-9)
        stamps = frame_times(tracks.stamps_ns)
        exposure = Exposure.of(times, stamps, config or CalibrationConfig())
        exposure_of_samples = np.interp(gyro_times, times, exposure.assumed)
        return cls(
            tracks,
            camera,
            lens,
            knowledge,
            times,
            stamps,
            exposure,
            gyro_times,
            *exposed_rates(gyro, exposure_of_samples),
            noise_density(gyro_times, gyro.rates),
        )

    def along(self, axis: int) -> Observations:
        """The same with rows along the pixel coordinate `axis`, 0 or 1."""
        if axis == self.camera.readout_axis:
            return self
        camera = replace(self.camera, readout_direction=readout_direction(axis, 1.0))
        return replace(self, camera=camera)

    def following(self, course: OffsetCourse) -> Observations:
        """The same with an offset that changes as `course`, and by an amount that is estimated.

        Where the offset follows the intervals already, the course is taken as it is.
        """
        stamps = self.stamps
        if course.is_constant and stamps.varying is Varying.COURSE:
            stamps = FrameTimes(Varying.NOT, np.zeros(len(self.times)))
        elif not course.is_constant and not self.follows_intervals:
            stamps = FrameTimes(Varying.COURSE, course.covariates(self.times))
        return replace(self, course=course, stamps=stamps)

    @property
    def follows_intervals(self) -> bool:
        """Whether the offset has the intervals between frames as its covariate."""
        return self.stamps.varying in (Varying.EXPOSURE, Varying.JITTER)

    @property
    def gyro_times_of_frames(self) -> Array:
        """Stamps (F,) [s], from which one offset for all leads to the clock of the gyro."""
        return np.asarray(self.times + self.course.at(self.times))

    def like(self, other: Observations) -> Observations:
        """The same as `other` about this lens: rows, course of the offset and doubt."""
        moved = self.along(other.camera.readout_axis).following(other.course)
        return replace(moved, doubt=other.doubt)

    @property
    def interval(self) -> float:
        """Median interval between frames [s]."""
        return float(np.median(np.diff(self.times)))

    def excitation(self, bias: Array, R_cam_imu: Array) -> tuple[Array, str, Array]:
        """Rms rates (3,) about the camera's axes [rad/s], what is missing, main axis (3,)."""
        inside = (self.gyro_times >= self.times[0]) & (self.gyro_times <= self.times[-1])
        rates = (self.gyro_rates[inside] - bias) @ R_cam_imu.T
        rates = rates - rates.mean(axis=0)
        moments = rates.T @ rates / len(rates)
        values, vectors = np.linalg.eigh(moments)
        main = vectors[:, 2]
        text = ''
        rms_of_second = np.sqrt(max(values[1], 0.0))
        if rms_of_second < LEAST_ROTATION:  # two axes fix a rotation
            by_share = np.argsort(np.abs(main))
            first, second, about = (AXES[axis] for axis in by_share)
            text = (
                f'the camera rotates about one axis only, nearly {about}, so the rotation '
                f'about it is not observable: rotate about {first} and {second} too, 20 to 60 '
                'deg/s'
            )
        rms = np.sqrt((rates**2).mean(axis=0))
        return rms, text, main

    def pairs(self, selection: PairSelection, rng: np.random.Generator) -> list[Pair]:
        """All pairs of these spans without lost frames."""
        gaps = sorted({max(1, round(span / self.interval)) for span in selection.spans})
        return make_pairs(self.tracks, gaps, selection, _LOST * self.interval, rng)

    def selected_problem(
        self, selection: PairSelection, offset: float, rng: np.random.Generator
    ) -> model.Problem:
        """Data of a fit to the pairs of `selected_pairs`."""
        return self.problem(self.selected_pairs(selection, offset, rng), offset)

    def selected_pairs(
        self, selection: PairSelection, offset: float, rng: np.random.Generator
    ) -> list[Pair]:
        """Pairs all of whose rows lie within the gyro and touch no gap of it.

        `offset` [s] is about that of the clocks. InputError if there are fewer than ten pairs.
        """
        pairs = self.pairs(selection, rng)
        half = 0.5 * self.interval + 0.01
        frames = frames_of(pairs)
        first, second = self.gyro_times_of_frames[frames] + offset
        begin = first - half
        end = second + half
        clear = (begin >= self.gyro_times[0]) & (end <= self.gyro_times[-1])
        clear &= self.course.clear_of_steps(*self.times[frames])
        gaps = np.flatnonzero(np.diff(self.gyro_times) > MAX_GYRO_GAP)
        for k in gaps:
            is_before = end <= self.gyro_times[k]
            is_after = begin >= self.gyro_times[k + 1]
            clear &= is_before | is_after
        pairs = list(itertools.compress(pairs, clear))
        if len(pairs) < _LEAST_PAIRS:
            raise InputError(
                f'only {len(pairs)} pairs of images have {selection.min_matches} points in common '
                'and a gyro without gaps: record a textured scene with a short exposure, and all '
                'of the gyro'
            )
        most = min(selection.most_pairs, round(_PAIRS_PER_SECOND * self.times[-1]))
        if len(pairs) > most:
            evenly = np.linspace(0, len(pairs) - 1, most)
            pairs = [pairs[int(k)] for k in evenly]
        return pairs

    def measured_rates(self, pairs: Sequence[Pair]) -> MeasuredRates:
        """Rates of P pairs and of the gyro, each on its clock, with the course of the offset."""
        begins, ends = self.gyro_times_of_frames[frames_of(pairs)]
        return MeasuredRates(
            self.image_rates(pairs), begins, ends, self.gyro_times, self.gyro_rates
        )

    def image_rates(self, pairs: Sequence[Pair]) -> Array:
        """Angular velocity (P, 3) [rad/s], camera frame, that rotates the rays of each pair."""
        rays = self.camera.unproject(self.tracks.points)
        times1, times2 = self.times[frames_of(pairs)]
        rotations = [rotation_of_rays(*rays[pair.rows]) for pair in pairs]
        intervals = times2 - times1
        return np.array(rotations).reshape(-1, 3) / intervals[:, None]

    def problem(self, pairs: Sequence[Pair], offset: float) -> model.Problem:
        """Data of a fit to `pairs`, which the gyro covers at about this `offset` [s]."""
        frames = frames_of(pairs)
        of_frames = self.gyro_times_of_frames
        times1, times2 = of_frames[frames]
        middles = np.searchsorted(self.gyro_times, 0.5 * (times1 + times2) + offset)
        turn_sigma = np.sqrt(self.gyro_density**2 * (times2 - times1) + _LEAST_ROTATION**2)
        center = np.zeros(model.GLOBAL)
        center[model.LENS] = -self.lens
        pixels = self.tracks.points[np.hstack([pair.rows for pair in pairs])]
        of_pixels = self.camera.points_by_lens(pixels.reshape(-1, 2))
        return model.Problem(
            self.gyro_times,
            self.gyro_rates,
            self.blur_rates,
            of_frames[frames],
            self.stamps.covariates[frames],
            np.cumsum([0, *(pair.rows.shape[1] for pair in pairs)]),
            middles,
            self.camera.readout_shares(pixels),
            of_pixels.values.reshape(pixels.shape),
            of_pixels.by_pixel.reshape(*pixels.shape, 2),
            of_pixels.by_lens.reshape(*pixels.shape, N_LENS),
            of_pixels.by_pixel_by_lens.reshape(*pixels.shape, 2, N_LENS),
            np.full(len(pairs), _BEND_AT_START),
            turn_sigma,
            self._prior(),
            center,
            np.ones(len(pairs)),
        )

    def _prior(self) -> Array:
        """Information (GLOBAL, GLOBAL) of the parameters before the fit."""
        information = prior_information(self.camera, self.knowledge, self.exposure.square_sigma)
        information[model.LENS] /= self.doubt
        information[:, model.LENS] /= self.doubt
        return information


# -- Initial clock offset, axes and focal length: rotation of the images against the gyro ---------


@cache
def axis_maps() -> Array:
    """All 24 rotations (24, 3, 3) that map axes to axes."""
    maps = np.array(
        [
            np.diag(signs) @ np.eye(3)[list(columns)] + 0.0  # no zero is negative
            for columns in itertools.permutations(range(3))
            for signs in itertools.product((1.0, -1.0), repeat=3)
        ]
    )
    maps = maps[np.linalg.det(maps) > 0.0]
    maps.setflags(write=False)  # shared
    return maps


def nearest_axis_map(R: Array) -> Array:
    """The axis map (3, 3) nearest to a rotation."""
    maps = axis_maps()
    return np.array(maps[int(np.argmax(np.einsum('kij,ij->k', maps, R)))])


def axes_text(axis_map: Array) -> str:
    """An axis map (3, 3) as text: ``cam x = -imu y, ...``."""
    parts = []
    for row, axis in zip(axis_map, 'xyz', strict=True):
        k = int(np.argmax(np.abs(row)))
        parts.append(f'cam {axis} = {"-" if row[k] < 0 else "+"}imu {"xyz"[k]}')
    return ', '.join(parts)


# Step of the offsets that are searched [s].
_STEP = 5e-3
# If the second axis of the common rotation is weaker than this share of the first, an axis map
# determines it.
_ONE_AXIS = 0.05


class Start(NamedTuple):
    """A coarse calibration."""

    offset: float  # of the middle row [s]: t_imu = stamp + offset
    R_cam_imu: Array  # (3, 3)
    focal_factor: float
    misfit: float  # share of the variance of the rotation that is not common


class MeasuredRates(NamedTuple):
    """Angular velocities of images and gyro, each on its own clock."""

    rates: Array  # (P, 3) of the camera, by the images [rad/s]
    begins: Array  # (P,) times between which they hold [s]
    ends: Array  # (P,)
    gyro_times: Array  # (K,) [s]
    gyro_rates: Array  # (K, 3) IMU frame [rad/s]


def find_starts(
    measured_rates: MeasuredRates,
    *,
    max_offset: float,
    focal_factors: Array,
    R_prior: Array | None = None,
    distant: Sequence[float] = (),
) -> list[Start]:
    """Offsets at which the rotated gyro agrees best with the images; best first.

    Offsets to +- `max_offset` [s], and near `distant` ones [s], are searched, with each of the
    `focal_factors` of the assumed focal length; at most three starts of different offsets are
    returned. Where the rotation about one axis is not determined, it is that of `R_prior`, or of
    an axis map.
    """
    rates, begins, ends, gyro_times, gyro_rates = measured_rates
    turned = integral(gyro_times, gyro_rates)

    def aligned(offset: float, factors: ArrayLike) -> Start | None:
        begin = begins + offset
        end = ends + offset
        inside = (begin >= gyro_times[0]) & (end <= gyro_times[-1])
        # An offset at which the gyro misses most frames cannot be evaluated.
        if inside.sum() < max(10, 0.5 * len(rates)):
            return None
        measured = _mean_rates(turned, gyro_times, begin[inside], end[inside])
        starts = [
            _aligned(rates[inside] * _lens(factor), measured, offset, float(factor), R_prior)
            for factor in np.atleast_1d(factors)
        ]
        return min(starts, key=_misfit)

    # The best offsets hardly depend on the focal length.
    near = np.arange(-max_offset, max_offset + 0.5 * _STEP, _STEP)
    around = np.arange(-_NEAR_DISTANT, _NEAR_DISTANT + 0.5 * _STEP, _STEP)
    offsets = np.concatenate([near, *(offset + around for offset in distant)])
    usual_factor = np.median(focal_factors)
    starts = (aligned(float(offset), usual_factor) for offset in offsets)
    chosen: list[Start] = []
    for start in sorted(filter(None, starts), key=_misfit):
        if all(abs(start.offset - other.offset) >= 4.0 * _STEP for other in chosen):
            chosen.append(start)
    refined = (aligned(start.offset, focal_factors) for start in chosen[:3])
    return sorted(filter(None, refined), key=_misfit)


def _misfit(start: Start) -> float:
    return start.misfit


def _lens(focal_factor: float) -> Array:
    """Factors (3,) of the rates of images with this factor of the assumed focal length."""
    across = 1.0 / focal_factor
    return np.array([across, across, 1.0])


def rates_at(measured_rates: MeasuredRates, offsets: Array, start: Start) -> RatesAtOffsets:
    """Rates of images and gyro at M offsets (M,) [s], in the axes and the lens of a start."""
    rates, begins, ends, gyro_times, gyro_rates = measured_rates
    turned = integral(gyro_times, gyro_rates)
    order = np.argsort(begins + ends, kind='stable')
    begins = begins[order]
    ends = ends[order]
    gyro = np.full((len(offsets), len(rates), 3), np.nan)
    for at_offset, offset in zip(gyro, offsets, strict=True):
        begin = begins + offset
        end = ends + offset
        known = (begin >= gyro_times[0]) & (end <= gyro_times[-1])
        means = _mean_rates(turned, gyro_times, begin[known], end[known])
        at_offset[known] = means @ start.R_cam_imu.T
    images = rates[order] * _lens(start.focal_factor)
    return RatesAtOffsets(0.5 * (begins + ends), offsets, images, gyro)


# Step of the times at which sizes of rates are correlated [s]. A longer one would miss a peak.
# [chosen: hands turn the other way after 0.1 s or more; 5 to 20 ms would do]
_GRID = 0.01
# Range about a distant offset that is searched in steps of `_STEP` [s]. [chosen: two of the grid]
_NEAR_DISTANT = 0.02
# Largest number of distant offsets. Each costs as much as a second of the near ones.
# [chosen: the right one has the highest peak wherever the motion does not repeat]
_MOST_DISTANT = 3
# Least correlation of the sizes of the rates at a distant offset. A lower one would try noise.
# [chosen: below that of images in which half of the rotation is right]
_LEAST_CORRELATION = 0.5
# Least share of the images that the gyro covers at an offset. [chosen: fewer can correlate by
# chance]
_LEAST_COVERED = 0.5


def distant_offsets(measured: MeasuredRates, beyond: float) -> list[float]:
    """Offsets [s] further than `beyond`, over the whole overlap, at which rates agree in size.

    The size of a rate does not depend on the axes.
    """
    middles = 0.5 * (measured.begins + measured.ends)
    order = np.argsort(middles)
    middles = middles[order]
    sizes_of_images = np.linalg.norm(measured.rates[order], axis=1)
    images = _on_grid(middles, sizes_of_images)
    moving = measured.gyro_rates - np.median(measured.gyro_rates, axis=0)
    sizes_of_gyro = np.linalg.norm(moving, axis=1)
    # The rates of the images are means over about a frame, and so is the gyro here.
    frame = float(np.median(np.diff(middles)))
    width = max(round(frame / _GRID), 1)
    mean = np.full(width, 1.0 / width)
    gyro = np.convolve(_on_grid(measured.gyro_times, sizes_of_gyro), mean, mode='same')
    correlation, covered = _correlation(images, gyro)
    lags = np.arange(len(correlation)) - (len(images) - 1)
    offsets = measured.gyro_times[0] - middles[0] + _GRID * lags
    allowed = (covered >= _LEAST_COVERED) & (np.abs(offsets) > beyond)
    correlation = np.where(allowed, correlation, -1.0)
    chosen: list[float] = []
    for k in np.argsort(correlation)[::-1]:
        if correlation[k] < _LEAST_CORRELATION or len(chosen) == _MOST_DISTANT:
            break
        apart = np.abs(np.array(chosen) - offsets[k])
        if (apart > 2.0 * _NEAR_DISTANT).all():
            chosen.append(float(offsets[k]))
    return chosen


def _correlation(images: Array, gyro: Array) -> tuple[Array, Array]:
    """Correlation of two series at each lag over what they share, and that share of `images`.

    Masked normalised cross-correlation: D. Padfield, IEEE Trans. Image Processing 21, 2012.
    """
    # By NumPy: scipy.signal takes seconds to import, at the start of a node.
    size = len(images) + len(gyro) - 1

    def summed(of_images: Array, of_gyro: Array) -> Array:
        spectrum = np.fft.rfft(of_gyro, size) * np.fft.rfft(of_images[::-1], size)
        return np.asarray(np.fft.irfft(spectrum, size))

    ones_images = np.ones_like(images)
    ones_gyro = np.ones_like(gyro)
    count = np.maximum(summed(ones_images, ones_gyro), 1.0)
    image_sum = summed(images, ones_gyro)
    gyro_sum = summed(ones_images, gyro)
    image_power = summed(images**2, ones_gyro) - image_sum**2 / count
    gyro_power = summed(ones_images, gyro**2) - gyro_sum**2 / count
    product = summed(images, gyro) - image_sum * gyro_sum / count
    # Rounding may leave less than nothing.
    image_power = np.maximum(image_power, 0.0)
    gyro_power = np.maximum(gyro_power, 0.0)
    scale = np.sqrt(image_power * gyro_power)
    correlation = product / np.maximum(scale, np.finfo(float).tiny)
    return correlation, count / len(images)


def _on_grid(times: Array, values: Array) -> Array:
    """Values at even times."""
    return np.interp(np.arange(times[0], times[-1], _GRID), times, values)


def _mean_rates(turned: Array, times: Array, begin: Array, end: Array) -> Array:
    """Mean rates (P, 3) between times (P,) by the angles `turned` (K, 3) at the `times` (K,)."""
    angles = interpolated(end, times, turned) - interpolated(begin, times, turned)
    duration = end - begin
    return angles / duration[:, None]


def _aligned(
    estimated: Array, measured: Array, offset: float, focal_factor: float, R_prior: Array | None
) -> Start:
    """Start with the rotation between two series of rates (P, 3) without their outliers."""
    kept = np.ones(len(estimated), dtype=bool)
    start = Start(offset, np.eye(3), focal_factor, 1.0)
    for _ in range(3):
        # A bias and a constant translation drop out with the means.
        images = estimated - estimated[kept].mean(axis=0)
        gyro = measured - measured[kept].mean(axis=0)
        R = _common_rotation(images[kept].T @ gyro[kept], R_prior)
        left = images - gyro @ R.T
        squares = (left**2).sum(axis=1)
        power_of_images = float((images[kept] ** 2).sum())
        power_of_gyro = float((gyro[kept] ** 2).sum())
        power = max(power_of_images + power_of_gyro, 1e-12)
        misfit = float(squares[kept].sum()) / power
        start = start._replace(R_cam_imu=R, misfit=misfit)
        typical = max(float(np.median(squares)), 1e-10)
        kept = squares <= 9.0 * typical
    return start


def _common_rotation(correlation: Array, R_prior: Array | None) -> Array:
    """Rotation (3, 3) by ``sum a b^T`` of rates; about one axis only, the nearest to a prior."""
    u, s, vt = np.linalg.svd(correlation)
    if s[1] >= _ONE_AXIS * s[0]:
        return so3.aligning_rotation(correlation)
    nearest = nearest_axis_map(correlation) if R_prior is None else R_prior
    tilt, _ = Rotation.align_vectors(u[:, :1].T, vt[:1] @ nearest.T)
    return np.asarray(tilt.as_matrix() @ nearest)
