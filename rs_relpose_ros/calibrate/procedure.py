"""The whole calibration on tracks: start from nothing, fit, judge."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibrate.alignment import find_starts, Start
from rs_relpose_ros.calibrate.coplanarity import (
    EXPOSURE,
    FOCAL,
    GLOBAL,
    OFFSET,
    Problem,
    SLOPE,
    Unknowns,
)
from rs_relpose_ros.calibrate.fit import cost_curve, fit, initial, refit, with_bends
from rs_relpose_ros.calibrate.gyro_path import GyroSeries
from rs_relpose_ros.calibrate.judgement import judged
from rs_relpose_ros.calibrate.observations import Observations, PairSelection
from rs_relpose_ros.calibrate.result import CalibrationResult
from rs_relpose_ros.calibrate.tracks import Tracks
from rs_relpose_ros.calibrate.uncertainty import ModelErrors, UNCALIBRATED, widened
from rs_relpose_ros.config.calibration import CalibrationConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera

Array = NDArray[np.float64]
Progress = Callable[[float], object]

_LEAST_MATCHES = 20
# Spans [s]: over long ones the gyro's rates at the rows differ; over short ones the errors of the
# tracker add up less and the velocity of the camera is constant. The noise that is found for each
# pair decides on its weight.
_ALL_PAIRS = PairSelection((0.033, 0.067, 0.133, 0.267), 80, _LEAST_MATCHES, 800)
_SOME_PAIRS = _ALL_PAIRS._replace(max_matches=40, most_pairs=100)
_PAIRS_AT_START = _SOME_PAIRS._replace(spans=(0.067,))
_FOCAL_FACTORS = np.geomspace(0.5, 2.0, 9)


def calibrate(tracks: Tracks, gyro: GyroSeries, camera: RollingShutterCamera, *,
              focal_known: bool = True, config: CalibrationConfig | None = None,
              rng: np.random.Generator | int = 0,
              progress: Progress = lambda share: None) -> CalibrationResult:
    """Read-out time, clock offset, rotation, gyro bias and perhaps focal length, from nothing.

    Two views of every pair of frames obey the coplanarity of the rows' own instants; see
    `rs_relpose_ros.calibrate.coplanarity` and docs/calibration.md.

    `tracks` are of the whole recording, `gyro` is on a clock that differs from the camera's by at
    most ``config.max_time_offset``; the read-out time of `camera` is not looked at. Unless
    `focal_known`, fx and fy are a guess within a factor of 2, whose ratio holds, and the camera
    has no distortion. `rng` chooses among matches where there are more than needed; `progress` is
    called with the share of the work that is done.

    Raises
    ------
    InputError
        The recording cannot be used; the text says what to record instead.
    """
    config = CalibrationConfig() if config is None else config
    rng = np.random.default_rng(rng)
    if len(tracks) < 2 or len(gyro) < 2:
        raise InputError(f'{len(tracks)} frames and {len(gyro)} gyro samples are too few: record '
                         'at least 10 s with both')
    data = Observations.of(tracks, gyro, camera)
    _check_recording(data, config)
    starts = _starts(data, focal_known, config, rng)
    progress(0.15)
    free = np.ones(GLOBAL, dtype=bool)
    free[SLOPE] = False
    free[FOCAL], free[EXPOSURE] = not focal_known, False
    coarse = _coarse_fit(data, starts, free, config, rng)
    progress(0.4)
    free[SLOPE] = bool(data.stamps.covariates.any())
    free[EXPOSURE] = config.exposed
    offset = coarse.parameters[OFFSET]
    final = refit(_problem(data, _ALL_PAIRS, offset, config, rng), coarse, free)
    progress(0.7)
    errors = None if not config.exposed else ModelErrors() if focal_known else UNCALIBRATED
    final = widened(final, free, errors)
    progress(0.8)
    offset = final.unknowns.parameters[OFFSET]
    some = with_bends(_problem(data, _SOME_PAIRS, offset, config, rng), final.unknowns)
    curve = cost_curve(some, final, free, data.interval,
                       lambda share: progress(0.8 + 0.2 * share))
    return judged(data, final, free, curve, config)


# -- what comes in -----------------------------------------------------------------------------


def _check_recording(data: Observations, config: CalibrationConfig) -> None:
    """Refuse what cannot give a calibration, with what to record instead."""
    frames = len(data.tracks)
    if frames < config.min_frames:
        raise InputError(
            f'the recording is too short: {frames} frames in {data.times[-1]:.1f} s, at least '
            f'{config.min_frames} are needed. Record 10 s or more while you turn the camera about '
            'all three axes')
    first = max(data.times[0], data.gyro_times[0] - config.max_time_offset)
    last = min(data.times[-1], data.gyro_times[-1] + config.max_time_offset)
    if last - first < 0.5 * data.times[-1]:
        raise InputError(
            f'the gyro covers {max(last - first, 0.0):.1f} s of the {data.times[-1]:.1f} s of '
            'images: record both together, and let the clocks differ by less than '
            f'{config.max_time_offset:g} s')
    if np.median(data.gyro_steps) > config.max_gyro_gap:
        raise InputError(
            f'the gyro has {1.0 / np.median(data.gyro_steps):.0f} samples per second, at least '
            f'{1.0 / config.max_gyro_gap:.0f} are needed, 200 are good')
    counts = np.bincount(data.tracks.frames, minlength=frames)
    if np.median(counts) < _LEAST_MATCHES:
        raise InputError(
            f'there is too little to follow: {np.median(counts):.0f} points per image in the '
            f'median, at least {_LEAST_MATCHES} are needed. Record a scene with texture, in good '
            'light and focus')
    spread = data.gyro_rates - np.median(data.gyro_rates, axis=0)
    rate = float(np.sqrt((spread**2).sum(axis=1).mean()))
    if rate < config.min_rotation_rate:
        raise InputError(
            f'the camera hardly turns: {np.degrees(rate):.2f} deg/s rms by the gyro, at least '
            f'{np.degrees(config.min_rotation_rate):.1f} are needed. Turn it to and fro about all '
            'three axes, 20 to 60 deg/s')


# -- start -------------------------------------------------------------------------------------


def _starts(data: Observations, focal_known: bool, config: CalibrationConfig,
            rng: np.random.Generator) -> list[Start]:
    pairs = data.pairs((1,), max_matches=80, min_matches=8, rng=rng)
    if len(pairs) < 0.5 * len(data.tracks):
        raise InputError(
            f'points can be followed over {len(pairs)} of {len(data.tracks) - 1} steps between '
            'images only: the images are blurred, the scene has no texture, or it moves too fast. '
            'Record with a short exposure in good light, and turn more slowly')
    found = find_starts(
        data.seen_rates(pairs), data.times[pairs.first], data.times[pairs.second],
        data.gyro_times, data.gyro_rates, max_offset=config.max_time_offset + 0.02, step=5e-3,
        focal_factors=np.ones(1) if focal_known else _FOCAL_FACTORS, count=3)
    if not found:
        raise InputError('the gyro does not cover the images: record both together')
    return found


def _coarse_fit(data: Observations, starts: list[Start], free: NDArray[np.bool_],
                config: CalibrationConfig, rng: np.random.Generator) -> Unknowns:
    """The best of the fits to a few pairs from each of the starts."""
    fits = []
    for start in starts:
        problem = _problem(data, _PAIRS_AT_START, start.offset, config, rng)
        unknowns = initial(problem, start.R_cam_imu.T, start.offset,
                           log_focal=float(np.log(start.focal_factor)))
        fits.append(fit(problem, unknowns, free, rounds=20, tolerance=0.3).unknowns)
    # By the noise of the matches: pairs and cost differ between the starts.
    return min(fits, key=lambda found: float(np.median(found.noise)))


def _problem(data: Observations, selection: PairSelection, offset: float,
             config: CalibrationConfig, rng: np.random.Generator) -> Problem:
    """Data of a fit to selected pairs whose rows the gyro covers at this `offset` [s]."""
    pairs = data.selected(selection, offset, config.max_gyro_gap, rng)
    if len(pairs) < 10:
        raise InputError(
            f'only {len(pairs)} pairs of images have {_LEAST_MATCHES} points in common and a gyro '
            'without gaps: record a textured scene with a short exposure, and all of the gyro')
    return data.problem(pairs, offset)
