"""The whole calibration on tracks: start from nothing, fit, judge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibrate.alignment import find_starts, Start
from rs_relpose_ros.calibrate.axis_maps import nearest_axis_map
from rs_relpose_ros.calibrate.coplanarity import (
    BIAS,
    FOCAL,
    GLOBAL,
    OFFSET,
    READOUT,
    ROTATION,
    SLOPE,
)
from rs_relpose_ros.calibrate.fit import (
    evaluate,
    Fit,
    fit,
    Problem,
    robust_weights,
    State,
    with_bends,
)
from rs_relpose_ros.calibrate.gyro_path import GyroSeries
from rs_relpose_ros.calibrate.observations import evenly, Observations
from rs_relpose_ros.calibrate.result import AXES, CalibrationResult, CostCurve, Estimate
from rs_relpose_ros.calibrate.tracks import Tracks
from rs_relpose_ros.config.declarations import check_settings, setting
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera

Array = NDArray[np.float64]
Progress = Callable[[float], object]

# Frame pairs this far apart [s]: far ones, whose rows the gyro has turned by different rates, and
# near ones, over which a tracker's errors do not add up and the camera moves evenly. The noise of
# each pair, as found, decides what counts.
_SPANS = (0.033, 0.067, 0.133, 0.267)
_SPAN_AT_START = (0.067,)
_LEAST_MATCHES = 20
_MATCHES_PER_PAIR, _MATCHES_PER_PAIR_AT_START = 80, 40
_MOST_PAIRS, _PAIRS_AT_START = 800, 100
# Intervals between frames that differ by more than this share may have exposures that differ.
_VARYING = 0.02
_FOCAL_FACTORS = np.geomspace(0.5, 2.0, 9)
_CURVE_POINTS = 13


@dataclass(frozen=True, slots=True)
class CalibrationConfig:
    """What a recording must have, and from where on a figure counts as observable."""

    max_time_offset: float = setting(
        0.25, 'largest clock offset that is searched for', 's', low=0.01, high=5.0)
    min_frames: int = setting(40, 'frames that a recording must have', low=10, high=100_000)
    min_rotation_rate: float = setting(
        np.radians(2.0).item(), 'rms of the rotation below which a camera stands still', 'rad/s',
        low=0.0, high=10.0)
    max_gyro_gap: float = setting(
        0.03, 'longest step between gyro samples that is interpolated', 's', low=1e-3, high=1.0)
    max_readout_sigma: float = setting(
        1.5e-3, 'sigma of an observable read-out time', 's', low=1e-5, high=1.0)
    max_offset_sigma: float = setting(
        3e-3, 'sigma of an observable offset', 's', low=1e-5, high=1.0)
    max_rotation_sigma: float = setting(
        np.radians(0.7).item(), 'sigma of an observable rotation, each axis', 'rad', low=1e-5,
        high=1.0)
    max_bias_sigma: float = setting(
        0.01, 'sigma of an observable gyro bias', 'rad/s', low=1e-5, high=1.0)
    max_focal_sigma: float = setting(
        0.03, 'sigma of an observable focal length, relative', low=1e-4, high=1.0)

    tracking_time_sigma: float = setting(
        0.0, 'error of read-out and offset by the tracker, beyond scatter', 's', low=0.0, high=0.1)
    tracking_rotation_sigma: float = setting(
        0.0, 'error of the rotation by the tracker, beyond scatter', 'rad', low=0.0, high=1.0)
    tracking_bias_sigma: float = setting(
        0.0, 'error of the gyro bias by the tracker, beyond scatter', 'rad/s', low=0.0, high=1.0)

    def __post_init__(self) -> None:
        check_settings(self)


def calibrate(tracks: Tracks, gyro: GyroSeries, camera: RollingShutterCamera, *,
              focal_known: bool = True, config: CalibrationConfig | None = None,
              rng: np.random.Generator | int = 0,
              progress: Progress = lambda share: None) -> CalibrationResult:
    """Read-out time, clock offset, rotation, gyro bias and perhaps focal length, from nothing.

    Two views of every pair of frames obey the coplanarity of the rows' own instants; see
    `rs_relpose_ros.calibrate.coplanarity` and docs/calibration.md.

    Parameters
    ----------
    tracks : Tracks
        Raw pixels of `camera`, of the whole recording, frame after frame.
    gyro : GyroSeries
        On a clock that differs from the camera's by at most ``config.max_time_offset``.
    camera : RollingShutterCamera
        Intrinsics; its read-out time is not looked at.
    focal_known : bool
        Whether fx and fy are those of the camera; where not, they are a guess within a factor of
        2, whose ratio holds, and the camera has no distortion.
    config : CalibrationConfig, optional
    rng : numpy.random.Generator or int
        Chooses among matches where there are more than needed.
    progress : callable
        Called with the share of the work that is done.

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
    free[FOCAL] = not focal_known
    coarse = _coarse_fit(data, starts, free, config, rng)
    progress(0.4)
    problem = _problem(data, _SPANS, coarse.state.parameters[OFFSET],
                       _MATCHES_PER_PAIR, _MOST_PAIRS, config, rng)
    begin = coarse.state.restarted(problem, 2.0)
    problem = with_bends(problem, begin)
    free[SLOPE] = _intervals_vary(data)
    final = fit(problem, begin, free)
    progress(0.8)
    some = with_bends(_problem(
        data, _SPANS, final.state.parameters[OFFSET], _MATCHES_PER_PAIR_AT_START,
        _PAIRS_AT_START, config, rng), final.state)
    curve = _cost_curve(some, len(problem.points1), final, free, data.interval,
                        lambda share: progress(0.8 + 0.2 * share))
    return _judged(data, problem, final, free, curve, config)


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


def _intervals_vary(data: Observations) -> bool:
    low, high = np.quantile(data.covariates, (0.1, 0.9))
    return bool(high - low > _VARYING * data.interval)


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
                config: CalibrationConfig, rng: np.random.Generator) -> Fit:
    """The best of the starts after a fit to some of the pairs."""
    best: Fit | None = None
    best_cost = np.inf
    for start in starts:
        problem = _problem(data, _SPAN_AT_START, start.offset,
                           _MATCHES_PER_PAIR_AT_START, _PAIRS_AT_START, config, rng)
        state = State.start(problem, start.R_cam_imu.T, start.offset,
                            log_focal=float(np.log(start.focal_factor)))
        result = fit(problem, state, free, rounds=20, tolerance=0.3)
        # Pairs differ between the starts; sigma of the matches does not depend on their number.
        cost = float(np.median(result.state.noise))
        if cost < best_cost:
            best, best_cost = result, cost
    assert best is not None
    return best


def _problem(data: Observations, spans: tuple[float, ...], offset: float, matches: int,
             most_pairs: int, config: CalibrationConfig, rng: np.random.Generator) -> Problem:
    """Pairs whose rows the gyro covers, as the fit takes them."""
    pairs = data.pairs(data.frames_in(spans), max_matches=matches, min_matches=_LEAST_MATCHES,
                       rng=rng)
    pairs = evenly(pairs.chosen(data.covered(pairs, offset, config.max_gyro_gap)), most_pairs)
    if len(pairs) < 10:
        raise InputError(
            f'only {len(pairs)} pairs of images have {_LEAST_MATCHES} points in common and a gyro '
            'without gaps: record a textured scene with a short exposure, and all of the gyro')
    return data.problem(pairs, offset)


# -- outcome -----------------------------------------------------------------------------------


def _cost_curve(problem: Problem, matches: int, final: Fit, free: NDArray[np.bool_],
                interval: float, progress: Progress) -> CostCurve:
    """Cost with the read-out time held, from one frame interval upwards to one downwards."""
    best = float(final.state.parameters[READOUT])
    held = free.copy()
    held[READOUT] = False
    values = np.unique(np.concatenate([np.linspace(-interval, interval, _CURVE_POINTS), [best]]))
    costs = np.empty(len(values))
    order = np.argsort(np.abs(values - best))
    begin = _refitted(problem, final.state.restarted(problem), held, 5)
    for side in (order[values[order] <= best], order[values[order] > best]):
        state = begin
        for k in side:
            parameters = state.parameters.copy()
            parameters[READOUT] = values[k]
            state = _refitted(problem, replace(state, parameters=parameters), held, 2)
            costs[k] = evaluate(problem, state, derivatives=False).cost
            progress(float(np.isfinite(costs).mean()))
    # Matches of a frame serve in many pairs: scaled so that its bend at the minimum tells sigma.
    information = final.information[np.ix_(free, free)] * len(problem.points1) / matches
    naive = float(np.linalg.inv(information)[0, 0])
    variance = float(final.covariance[READOUT, READOUT])
    return CostCurve(values, (costs - costs.min()) * naive / variance)


def _refitted(problem: Problem, state: State, free: NDArray[np.bool_], rounds: int) -> State:
    """A few plain Gauss-Newton steps."""
    for _ in range(rounds):
        evaluation = evaluate(problem, state)
        H = evaluation.reduced.sum(axis=0)[np.ix_(free, free)]
        step = np.zeros(GLOBAL)
        step[free] = -np.linalg.solve(H + 1e-6 * np.diag(np.diag(H)),
                                      evaluation.score.sum(axis=0)[free])
        local = -evaluation.back[:, :, GLOBAL] - evaluation.back[:, :, :GLOBAL] @ step
        state = state.moved(step, local)
    return state


def _judged(data: Observations, problem: Problem, final: Fit, free: NDArray[np.bool_],
            curve: CostCurve, config: CalibrationConfig) -> CalibrationResult:
    """Figures with their sigmas and verdicts."""
    covariance = _inflated(final.covariance, free, config)
    parameters, R_cam_imu = final.state.parameters, final.state.R_imu_cam.T
    interval = data.interval
    rates, weak = _excitation(data, parameters[BIAS:BIAS + 3], R_cam_imu, config)
    readout = float(parameters[READOUT])
    readout_sigma = float(np.sqrt(covariance[READOUT, READOUT]))
    if abs(readout) - 3.0 * readout_sigma > interval:
        raise InputError(
            f'the read-out time comes out as {1e3 * abs(readout):.1f} +- '
            f'{1e3 * readout_sigma:.1f} ms, longer than the interval of {1e3 * interval:.1f} ms '
            'between frames, which no camera can do: stamps or frames are not what they seem '
            '(frames dropped and stamped anew, images cropped, scaled or rotated)')
    # Row 0 is read this share of the read-out before the middle row.
    to_first = np.zeros(GLOBAL)
    to_first[OFFSET], to_first[READOUT] = 1.0, -0.5 * (data.camera.height - 1) / data.camera.height
    offset_sigma = float(np.sqrt(to_first @ covariance @ to_first))
    # About the camera's axes.
    rotation = covariance[ROTATION:ROTATION + 3, ROTATION:ROTATION + 3]
    rotation_sigma = np.sqrt(np.diag(R_cam_imu @ rotation @ R_cam_imu.T))
    axis_map = nearest_axis_map(R_cam_imu)
    angle = float(np.arccos(np.clip((np.trace(R_cam_imu @ axis_map.T) - 1.0) / 2.0, -1.0, 1.0)))
    weights = robust_weights(problem, final.state, final.evaluation)
    warnings = []
    if not final.converged:
        warnings.append('the fit had not settled when it was stopped')
    if weak:
        warnings.append(weak)

    def told(value: float, sigma: float, limit: float, more: str = weak) -> Estimate:
        good = sigma <= limit and not more
        return Estimate(float(value), float(sigma), good, '' if good else (
            more or 'too little rotation, too short, or too few points: record 10 s or more of '
            'a textured scene while turning 20 to 60 deg/s about all three axes'))

    bias_sigma = np.sqrt(np.diag(covariance))[BIAS:BIAS + 3]
    biases = [told(parameters[BIAS + i], bias_sigma[i], config.max_bias_sigma, '')
              for i in range(3)]
    focal = slope = None
    if free[FOCAL]:
        factor = float(np.exp(parameters[FOCAL]))
        sigma = float(np.sqrt(covariance[FOCAL, FOCAL]))
        focal = told(factor, factor * sigma, factor * config.max_focal_sigma)
    if free[SLOPE]:
        sigma = float(np.sqrt(covariance[SLOPE, SLOPE]))
        slope = told(parameters[SLOPE], sigma, 0.5, '')
    return CalibrationResult(
        readout_time=told(readout, readout_sigma, config.max_readout_sigma, ''),
        time_offset=told(float(to_first @ parameters), offset_sigma, config.max_offset_sigma, ''),
        R_cam_imu=R_cam_imu, rotation_sigma=rotation_sigma,
        rotation=told(angle, float(rotation_sigma.max()), config.max_rotation_sigma),
        axis_map=axis_map, gyro_bias=(biases[0], biases[1], biases[2]), focal_factor=focal,
        offset_by_interval=slope, rotation_rates=rates, curve=curve,
        pixel_sigma=float(np.median(final.state.noise)),
        inlier_ratio=float((weights > 0.25).mean()), frames=len(data.tracks),
        pairs=problem.pairs, matches=len(problem.points1), frame_interval=interval,
        warnings=tuple(warnings))


def _inflated(covariance: Array, free: NDArray[np.bool_], config: CalibrationConfig) -> Array:
    """Covariance with what a tracker does to all of a recording alike."""
    floors = np.zeros(GLOBAL)
    floors[[READOUT, OFFSET]] = config.tracking_time_sigma
    floors[ROTATION:ROTATION + 3] = config.tracking_rotation_sigma
    floors[BIAS:BIAS + 3] = config.tracking_bias_sigma
    floors[~free] = 0.0
    return covariance + np.diag(floors**2)


def _excitation(data: Observations, bias: Array, R_cam_imu: Array,
                config: CalibrationConfig) -> tuple[Array, str]:
    """Rms rates about the camera's axes [rad/s], and what is missing of them (empty: nothing)."""
    inside = (data.gyro_times >= data.times[0]) & (data.gyro_times <= data.times[-1])
    rates = (data.gyro_rates[inside] - bias) @ R_cam_imu.T
    rates = rates - rates.mean(axis=0)
    rms = np.sqrt((rates**2).mean(axis=0))
    values, vectors = np.linalg.eigh(rates.T @ rates / len(rates))
    # Two axes fix a rotation.
    if np.sqrt(max(values[1], 0.0)) >= config.min_rotation_rate:
        return rms, ''
    main = vectors[:, 2]
    lacking = [AXES[i] for i in np.argsort(np.abs(main))[:2]]
    about = AXES[int(np.argmax(np.abs(main)))]
    return rms, (f'the camera turns about one axis only, nearly {about}, so the rotation about it '
                 f'cannot be told: turn about {lacking[0]} and {lacking[1]} too, 20 to 60 deg/s')
