"""The whole calibration on tracks: search, fit, evaluation; and tracks from a bag."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import logging
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special  # scipy.stats takes seconds to import, at the start of a node
from scipy.spatial.transform import Rotation

from rs_relpose_ros.bags.reader import Bag
from rs_relpose_ros.bags.sensor_topics import SensorTopics
from rs_relpose_ros.calibrate import acceptance, following
from rs_relpose_ros.calibrate.result import CalibrationResult, Estimate, LensEstimates
from rs_relpose_ros.calibration import (
    errors,
    fit,
    knowledge,
    model,
    observations,
    offset_course,
    repeated,
)
from rs_relpose_ros.calibration.findings import Code
from rs_relpose_ros.calibration.findings_text import with_sigma
from rs_relpose_ros.calibration.knowledge import LensKnowledge
from rs_relpose_ros.calibration.observations import (
    GyroSeries,
    MeasuredRates,
    Observations,
    PairSelection,
    TrackedPoints,
)
from rs_relpose_ros.calibration.readout_direction import along_other_axis
from rs_relpose_ros.calibration.rotations import LEAST_RAYS
from rs_relpose_ros.config.settings import CalibrationConfig, TrackingConfig
from rs_relpose_ros.core import radial
from rs_relpose_ros.core.deviations import by_name, OFFLINE
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import Intrinsics, RollingShutterCamera
from rs_relpose_ros.geometry.lens import DISTORTION_MODELS, N_LENS
from rs_relpose_ros.geometry.so3 import log_so3
from rs_relpose_ros.geometry.timing import seconds_between, to_nanoseconds
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.imu.integration import integral, interpolated
from rs_relpose_ros.messages.burst_times import SampleTimes
from rs_relpose_ros.messages.incoming import PARTS, ReasonCounts, Role, sensor_messages
from rs_relpose_ros.messages.streams import burst_warning
from rs_relpose_ros.messages.transforms import AXES_SIGMA
from rs_relpose_ros.tracking.features import make_tracker
from rs_relpose_ros.tracking.images import EncodedImage, GrayLevels

# Least number of points in common of a pair, and of points per image in the median. Fewer hardly
# determine the unknowns of a pair. [chosen: twice the eight unknowns, and some]
_LEAST_MATCHES = 20
# Least number of frames of a recording. [chosen: more than a second at 30 Hz]
_LEAST_FRAMES = 40
# Spans [s]: over long ones the gyro's rates at the rows differ; over short ones the errors of the
# tracker add up less and the velocity of the camera is constant. The noise of each pair determines
# its weight.
_ALL_PAIRS = PairSelection((0.033, 0.067, 0.133, 0.267), 80, _LEAST_MATCHES, 800)
# Pairs of quick fits: of the lens before all pairs, and of the cost over the readout time.
_SOME_PAIRS = _ALL_PAIRS._replace(max_matches=40, most_pairs=100)
# Pairs of the fits from each of the starts, of the span that converges from afar.
_PAIRS_AT_START = _SOME_PAIRS._replace(spans=(0.067,))
# Neighbouring frames, whose rotation is compared with the gyro.
_NEIGHBOURS = _ALL_PAIRS._replace(spans=(0.0,), min_matches=LEAST_RAYS)
# Changes of the lens within which the fit is linear in it: focal length, aspect, coefficients,
# principal point [px]. [chosen: the error of second order is below 0.1 px there]
_LENS_STAYS = (0.01, 0.01, 0.02, 0.05, 0.05, 5.0, 5.0)
# Largest number of fits, each about its own lens. [chosen: two or three are usual]
_LENS_ROUNDS = 6
# Sigma of an angle that is not known [rad].
_ANY_ANGLE = math.pi / math.sqrt(3.0)
# Focal lengths that are tried, over the guess. [chosen: steps of 19 %, from which the fit
# converges]
_FOCAL_FACTORS = np.geomspace(0.5, 2.0, 9)


def calibrate(
    tracks: TrackedPoints,
    gyro: GyroSeries,
    camera: RollingShutterCamera,
    *,
    focal_known: bool = True,
    config: CalibrationConfig | None = None,
    quat_prior: Sequence[float] | None = None,
    rng: np.random.Generator | int = 0,
    progress: Callable[[float], object] = lambda share: None,
) -> CalibrationResult:
    """Readout time, clock offset, rotation, gyro bias and perhaps focal length, without a guess.

    See `rs_relpose_ros.calibration.model` and docs/calibration.md. The clock of `gyro` differs
    from the camera's by at most ``config.max_time_offset``, or by any time that leaves half of the
    images with a gyro (``config.search_overlap``); the readout time of `camera` is not used.
    `quat_prior`: rotation IMU to camera of a transform, x y z w, +- 5 deg. Unless `focal_known`,
    fx and fy are a guess within a factor of 2, whose ratio holds, and focal length, radial
    distortion (k1, k2, k3) and principal point are estimated. Rows of the sensor are rows of the
    image, or columns where these fit better for certain. `rng` selects matches if there are more
    than needed; `progress` is called with the finished share of the work. InputError if the
    recording cannot be used, with what to record instead.
    """
    recording = CalibrationInput(tracks, gyro, camera, focal_known, {})
    return recording.calibrated(
        CalibrationConfig() if config is None else config,
        quat_prior=quat_prior,
        rng=rng,
        progress=progress,
    )


def rotation_of(quat_xyzw: Sequence[float] | None) -> Array | None:
    """Rotation matrix (3, 3) of a quaternion, None without one."""
    return None if quat_xyzw is None else Rotation.from_quat(quat_xyzw).as_matrix()


class Fitted(NamedTuple):
    """The fit to one recording, with its data and the cost over the readout time."""

    data: Observations
    final: fit.Fit
    curve: Array


def result_of(
    found: Fitted, config: CalibrationConfig, R_prior: Array | None
) -> CalibrationResult:
    """Result of a fit, joined with the rotation of a transform, without values if it fails."""
    final, axes_known = _with_axes(found.data, found.final, R_prior)
    result = evaluated(found.data, final, found.curve, config, axes_known=axes_known)
    return acceptance.accepted(result, found.data, final)


def fitted(
    recording: CalibrationInput,
    config: CalibrationConfig,
    *,
    R_prior: Array | None,
    rng: np.random.Generator | int = 0,
    progress: Callable[[float], object] = lambda share: None,
) -> Fitted:
    """The fit of `calibrate`, before it is evaluated."""
    tracks = recording.tracks
    gyro = recording.gyro
    if len(tracks) < 2 or len(gyro) < 2:
        raise InputError(
            f'{len(tracks)} frames and {len(gyro)} gyro samples are too few: record '
            'at least 10 s with both'
        )

    def about(lens: Array) -> Observations:
        return Observations.of(
            tracks, gyro, recording.camera, config, lens, recording.lens_knowledge
        )

    data = about(np.zeros(N_LENS))
    _check_recording(data, config)
    progress(0.15)

    generator = np.random.default_rng(rng)
    found = _calibrated(about, data, R_prior, recording.focal_known, config, generator, progress)
    # The images do not show by how much stamps of arrival are late.
    covariance = found.final.covariance.copy()
    covariance[model.OFFSET, model.OFFSET] += gyro.delay_sigma**2
    return found._replace(final=replace(found.final, covariance=covariance))


def _calibrated(
    about: Callable[[Array], Observations],
    data: Observations,
    R_prior: Array | None,
    focal_known: bool,
    config: CalibrationConfig,
    rng: np.random.Generator,
    progress: Callable[[float], object],
) -> Fitted:
    """The calibration of a usable recording: coarse, with some pairs, then with all pairs.

    `data` are the observations as assumed, `about` gives them with a deviation of the lens.
    """
    free = OFFLINE.mask('axes', 'time_offset', 'readout_time', 'gyro_bias')
    free[model.FOCAL] = not focal_known
    data, coarse = _coarse_fit(about, data, free, R_prior, config, rng)
    free[knowledge.LENS] = not focal_known
    if not focal_known:
        data, settled = _fit_with_lens(about, data, coarse, free, _SOME_PAIRS, rng)
        coarse = settled.unknowns
    progress(0.4)
    free[model.SLOPE] = data.stamps.covariates.any()
    free[model.EXPOSURE] = data.exposure.square_sigma > 0.0
    if config.exposed:
        free |= knowledge.CLAIMED
    data, final = _fit_with_lens(about, data, coarse, free, _ALL_PAIRS, rng)

    def refitted(changed: Observations, before: fit.Fit) -> tuple[Observations, fit.Fit]:
        free[model.SLOPE] = changed.stamps.covariates.any()
        return _fit_with_lens(about, changed, before.unknowns, free, _ALL_PAIRS, rng)

    data, final = following.followed(data, final, refitted, at_end=config.offset_at_end)
    progress(0.7)
    final = errors.weighted(final)
    final = errors.widened(final, in_images=config.exposed)
    progress(0.8)
    some = data.selected_problem(_SOME_PAIRS, final.unknowns.parameters[model.OFFSET], rng)
    curve = fit.cost_curve(
        fit.with_bends(some, final.unknowns),
        final,
        data.interval,
        lambda share: progress(0.8 + 0.2 * share),
    )
    return Fitted(data, final, curve)


def warm_up_fit() -> None:
    """Compile (or load from the cache) the kernels of a calibration, on made-up points."""
    frames = 60
    points = 30
    rng = np.random.default_rng(0)
    stamps_ns = np.arange(frames) * to_nanoseconds(1.0 / 30.0)
    tracks = TrackedPoints(
        stamps_ns,
        np.repeat(np.arange(frames), points),
        np.tile(np.arange(points), frames),
        rng.uniform(0, 200, (frames * points, 2)),
    )
    gyro_ns = np.arange(-100, 500) * to_nanoseconds(5e-3)
    camera = RollingShutterCamera(
        width=200,
        height=200,
        fx=150.0,
        fy=150.0,
        cx=100.0,
        cy=100.0,
        distortion=(1e-3, 0.0, 0.0, 0.0),
        readout_time=0.0,
    )
    data = Observations.of(tracks, GyroSeries(gyro_ns, rng.normal(size=(600, 3))), camera)
    data.image_rates(data.pairs(_NEIGHBOURS, rng))
    problem = data.selected_problem(_SOME_PAIRS, 0.0, rng)
    begin = fit.initial(problem, np.eye(3), 0.0)
    some = OFFLINE.mask('axes', 'readout_time')
    found = errors.fit(fit.with_bends(problem, begin), begin, some, rounds=2)
    errors.widened(found, in_images=True)


def _with_axes(data: Observations, final: fit.Fit, R_prior: Array | None) -> tuple[fit.Fit, bool]:
    """The fit joined with the rotation of a transform, and whether: not if they contradict."""
    if R_prior is None:
        return final, False
    R = final.unknowns.R_cam_imu
    part = model.ROTATION
    covariance = final.covariance.copy()
    _, one_axis, axis = data.excitation(final.unknowns.parameters[model.BIAS], R)
    if one_axis:  # about which the fit means nothing
        covariance[part] -= np.outer(axis, axis @ covariance[part])
        covariance[:, part] -= np.outer(covariance[:, part] @ axis, axis)
        covariance[part, part] += _ANY_ANGLE**2 * np.outer(axis, axis)
    turn = log_so3(np.ascontiguousarray(R_prior @ R.T))
    # As `angle_between`, axis by axis.
    of_prior = AXES_SIGMA**2 * np.eye(3)
    if turn @ np.linalg.solve(of_prior + 9.0 * covariance[part, part], turn) > 1.0:
        return final, False
    places = np.arange(model.GLOBAL)[part]
    unknowns, covariance = joined(final.unknowns, covariance, places, turn, of_prior)
    return replace(final, unknowns=unknowns, covariance=covariance), True


def _check_recording(data: Observations, config: CalibrationConfig) -> None:
    """Refuse recordings that do not determine a calibration, with what to record instead."""
    frames = len(data.tracks)
    if frames < _LEAST_FRAMES:
        raise InputError(
            f'the recording is too short: {frames} frames in {data.times[-1]:.1f} s, at least '
            f'{_LEAST_FRAMES} are needed. Record 10 s or more while you rotate the camera '
            'about all three axes'
        )
    first = max(data.times[0], data.gyro_times[0] - config.max_time_offset)
    last = min(data.times[-1], data.gyro_times[-1] + config.max_time_offset)
    if last - first < 0.5 * data.times[-1]:
        raise InputError(
            f'the gyro covers {max(last - first, 0.0):.1f} s of the {data.times[-1]:.1f} s of '
            'images: record both together, and let the clocks differ by less than '
            f'{config.max_time_offset:g} s'
        )
    step = float(np.median(np.diff(data.gyro_times)))
    if step > observations.MAX_GYRO_GAP:
        raise InputError(
            f'the gyro has {1.0 / step:.0f} samples per second, at least '
            f'{1.0 / observations.MAX_GYRO_GAP:.0f} are needed, 200 are good'
        )
    count = np.median(np.bincount(data.tracks.frames, minlength=frames))
    if count < _LEAST_MATCHES:
        raise InputError(
            f'there are too few points to follow: {count:.0f} per image in the '
            f'median, at least {_LEAST_MATCHES} are needed. Record a scene with texture, in good '
            'light and focus'
        )
    spread = data.gyro_rates - np.median(data.gyro_rates, axis=0)
    rate = float(np.sqrt((spread**2).sum(axis=1).mean()))
    if rate < observations.LEAST_ROTATION:
        raise InputError(
            f'the camera hardly rotates: {np.degrees(rate):.2f} deg/s rms by the gyro, at least '
            f'{np.degrees(observations.LEAST_ROTATION):.1f} are needed. Rotate it to and fro '
            'about all three axes, 20 to 60 deg/s'
        )


def _coarse_fit(
    about: Callable[[Array], Observations],
    data: Observations,
    free: NDArray[np.bool_],
    R_prior: Array | None,
    config: CalibrationConfig,
    rng: np.random.Generator,
) -> tuple[Observations, model.Unknowns]:
    """The best of the fits to a few pairs from each of the starts, and its data.

    With rows along the axis of the image that fits.
    """
    acceptance.refuse_two_views(data)
    pairs = data.pairs(_NEIGHBOURS, rng)
    if len(pairs) < 0.5 * len(data.tracks):
        raise InputError(
            f'points can be followed over {len(pairs)} of {len(data.tracks) - 1} steps between '
            'images only: the images are blurred, the scene has no texture, or it moves too fast. '
            'Record with a short exposure in good light, and rotate more slowly'
        )
    measured = data.measured_rates(pairs)
    reach = config.max_time_offset + 0.02
    distant = observations.distant_offsets(measured, reach) if config.search_overlap else []

    def starts_of(rates: MeasuredRates) -> list[observations.Start]:
        return observations.find_starts(
            rates,
            max_offset=reach,
            distant=distant,
            R_prior=R_prior,
            focal_factors=_FOCAL_FACTORS if free[model.FOCAL] else np.ones(1),
        )

    starts = starts_of(measured)
    if not starts:
        raise InputError('the gyro does not cover the images: record both together')
    tried = offset_course.tried_offsets(starts[0].offset)
    course = offset_course.proposed(observations.rates_at(measured, tried, starts[0]))
    if not course.is_constant:
        measured = data.following(course).measured_rates(pairs)
        starts = starts_of(measured) or starts
    acceptance.refuse_other_motion(measured, starts[0], data.interval)
    fits = []
    for start in starts:
        lens = np.log(start.focal_factor) * np.eye(N_LENS)[0]
        data = about(lens).following(course)
        chosen = data.selected_pairs(_PAIRS_AT_START, start.offset, rng)
        problem = data.problem(chosen, start.offset)
        unknowns = fit.initial(problem, start.R_cam_imu, start.offset)
        coarse = fit.minimised(problem, unknowns, free, rounds=20, tolerance=0.3)
        fits.append((data, chosen, coarse))
    # By the noise of the matches: pairs and cost differ between the starts.
    data, chosen, best = min(fits, key=lambda one: float(np.median(one[2].unknowns.noise)))
    return along_other_axis(data, chosen, best, free) or (data, best.unknowns)


def _fit_with_lens(
    about: Callable[[Array], Observations],
    data: Observations,
    coarse: model.Unknowns,
    free: NDArray[np.bool_],
    selection: PairSelection,
    rng: np.random.Generator,
) -> tuple[Observations, fit.Fit]:
    """Fit from `coarse`, linear in the lens, repeated about its own lens until that stays."""
    seed = int(rng.integers(2**32))
    offset = coarse.parameters[model.OFFSET]
    found = None
    for _ in range(_LENS_ROUNDS):
        moved = about(data.lens + coarse.parameters[model.LENS])
        data = moved.like(data)
        problem = data.selected_problem(selection, offset, np.random.default_rng(seed))
        if found is not None and np.array_equal(problem.rows[0], found.problem.rows[0]):
            # The same matches: only the lens is linearised again.
            parameters = coarse.parameters.copy()
            parameters[model.LENS] = 0.0
            begin = coarse._replace(parameters=parameters)
        else:
            begin = fit.restarted(problem, coarse, 2.0)
        found = errors.fit(fit.with_bends(problem, begin), begin, free)
        coarse = found.unknowns
        beyond = acceptance.contradiction(data, found)
        if beyond > 2.0 * data.doubt:
            # A claim that is refuted must not pull the others in the next round.
            data = replace(data, doubt=beyond)
            continue
        if (np.abs(coarse.parameters[model.LENS]) <= _LENS_STAYS).all():
            break
    assert found is not None
    return data, found


# -- Several recordings of one camera -----------------------------------------------------------


class CommonResult(NamedTuple):
    """Calibration of several recordings of one camera."""

    result: CalibrationResult  # what they have in common, for another recording of the camera
    of_recordings: tuple[CalibrationResult, ...]
    between: dict[str, list[float]]  # 1 sigma of each parameter between recordings


def calibrate_together(
    recordings: Sequence[CalibrationInput],
    config: CalibrationConfig,
    *,
    quat_prior: Sequence[float] | None = None,
    progress: Callable[[float], object] = lambda share: None,
) -> CommonResult:
    """Calibration of at least two recordings of one camera; see `calibration.repeated`.

    InputError if the cameras differ.
    """
    for other in recordings[1:]:
        if other.camera != recordings[0].camera or other.focal_known != recordings[0].focal_known:
            raise InputError(
                'the recordings have different CameraInfo or image sizes: calibrate bags of one '
                'camera at one resolution together, others each alone'
            )
    R_prior = rotation_of(quat_prior)
    count = len(recordings)
    found: list[Fitted] = []
    for recording in recordings:

        def progress_of_all(share: float) -> None:
            progress((len(found) + share) / count)

        found.append(fitted(recording, config, R_prior=R_prior, progress=progress_of_all))
    if len({one.data.camera.readout_axis for one in found}) > 1:
        raise InputError(
            'the images of some recordings are turned against those of others, rows against '
            'columns: calibrate bags of one orientation together, others each alone'
        )
    fits = [one.final for one in found]
    changing = [number for number, one in enumerate(found) if not one.data.course.is_constant]
    if changing:
        raise InputError(
            f'the clocks change within recording {changing[0] + 1} (a clock was set, or drifts): '
            'calibrate it alone, and the others together'
        )
    reference = int(np.argmax([one.problem.begin[-1] for one in fits]))
    lenses = np.array([one.data.lens for one in found])
    jitters = any(one.data.stamps.varying is observations.Varying.JITTER for one in found)
    intervals = None if jitters else np.array([one.data.interval for one in found])
    common = repeated.combined(fits, lenses, reference, intervals)
    result = result_of(found[reference]._replace(final=common.fit), config, R_prior)
    results = tuple(result_of(one, config, R_prior) for one in found)
    total = replace(
        result,
        frames=sum(one.frames for one in results),
        pairs=sum(one.pairs for one in results),
        matches=sum(one.matches for one in results),
    )
    between = {name: common.between[part].tolist() for name, part in OFFLINE.parts.items()}
    return CommonResult(total, results, between)


# -- Result of a fit, and observability --------------------------------------------------------

# What to do if a value is not observable.
_RECORD_MORE = (
    'too little rotation, too short, or too few points: record 10 s or more of a '
    'textured scene while rotating 20 to 60 deg/s about all three axes'
)
# A note if the intervals between frames vary for an unknown reason.
_UNCLEAR = {
    observations.Varying.UNCLEAR: (
        'the intervals between frames vary neither as automatic exposure does nor as jitter: the '
        'offset is assumed to be the same in all frames'
    )
}
# Sigma, in those of an observable value, beyond which a rotation or focal length is of no use.
_USELESS = 10.0
# Largest sigmas of observable values: readout time and offset [s], its slope [s/s], bias [rad/s],
# focal length (relative). [chosen: errors that poses hardly notice; docs/calibration.md]
_MOST = by_name(
    readout_time=1.5e-3,
    time_offset=3e-3,
    offset_per_interval=0.5,
    gyro_bias=0.01,
    focal_log=0.03,
)
# Least share of a prior's variance that another variance is divided by, where it is known exactly.
# [chosen: below any share that matters]
_LEAST_SHARE = 1e-12
# Error that is common to a recording and not part of its scatter: of the focal length (relative),
# as the residual is not linear in the noise of the points. [measured: simulated tracks]
_COMMON = by_name(focal_log=2e-4)
# The same with a tracker: its own errors [s, rad, rad/s]; of the slope [s/s], as the exposure also
# changes within one step of the interval. [measured: rendered bags with KLT]
_COMMON_IN_IMAGES = by_name(
    focal_log=2e-4,
    readout_time=5e-5,
    time_offset=5e-5,
    offset_per_interval=0.08,
    axes=1e-3,
    gyro_bias=2.5e-4,
)


def evaluated(
    data: Observations,
    final: fit.Fit,
    curve: Array,
    config: CalibrationConfig,
    *,
    axes_known: bool = False,
) -> CalibrationResult:
    """Result of a fit; `axes_known`: also of a transform. InputError for a readout too long."""
    unknowns, covariance = _with_common_errors(final, config)
    bounded, covariance, beyond = _bounded(unknowns, covariance, data.interval)
    parameters = bounded.parameters
    R_cam_imu = bounded.R_cam_imu
    rates, one_axis, _ = data.excitation(parameters[model.BIAS], R_cam_imu)
    sigmas = np.sqrt(np.diag(covariance))
    wide = _tolerance(final, covariance, config)
    axis_map = observations.nearest_axis_map(R_cam_imu)

    def of(k: int) -> Estimate:
        return _estimate(parameters[k], sigmas[k], wide * _MOST[k])

    slope = _slope(data, final, parameters, sigmas)
    jitters = data.stamps.varying is observations.Varying.JITTER
    lens = None
    if data.knowledge is not LensKnowledge.CLAIMED:
        lens = _lens(data, parameters, covariance, wide, one_axis)
    offset = _offset_of_row_0(data, parameters, covariance, wide)
    notes = _notes(data, final, parameters, covariance)
    return CalibrationResult(
        readout_time=replace(of(model.READOUT), determined=True),
        readout_axis=data.camera.readout_axis,
        fitted_readout=float(unknowns.parameters[model.READOUT]),
        time_offset=offset,
        R_cam_imu=R_cam_imu,
        rotation_sigma=sigmas[model.ROTATION],
        rotation=_estimate(
            _angle_between(R_cam_imu, axis_map),
            sigmas[model.ROTATION].max(),
            wide * config.max_rotation_sigma,
            '' if axes_known else one_axis,
        ),
        axis_map=axis_map,
        gyro_bias=tuple(of(k) for k in range(model.GLOBAL)[model.BIAS]),
        lens=lens,
        exposure=_exposure(data, final, sigmas[model.EXPOSURE]),
        exposure_margin=data.exposure.margin,
        offset_by_interval=None if jitters else slope,
        offset_by_jitter=slope if jitters else None,
        offset_changes=following.offset_changes(data, final, offset),
        stamp_jitter=jitters * data.stamps.size,
        rotation_rates=rates,
        curve=curve,
        pixel_sigma=float(np.median(final.unknowns.noise)),
        inlier_ratio=float((final.weights > 0.25).mean()),
        frames=len(data.tracks),
        pairs=final.problem.pairs,
        matches=int(final.problem.begin[-1]),
        frame_interval=data.interval,
        warnings=tuple(filter(None, (*notes, one_axis, beyond))),
    )


def _tolerance(final: fit.Fit, covariance: Array, config: CalibrationConfig) -> float:
    """Factor of the largest sigmas of observable values: wider if poses hardly notice them."""
    if errors.move_of_poses(final, covariance) <= 1.0:
        return max(config.tolerance, config.unnoticed_tolerance)
    return config.tolerance


def _notes(
    data: Observations, final: fit.Fit, parameters: Array, covariance: Array
) -> tuple[str, ...]:
    """What a user has to know of a fit beside its values; empty texts where there is nothing."""
    unsettled = '' if final.converged else 'the fit has not converged'
    against = ''
    if data.knowledge is LensKnowledge.CLAIMED and final.free[model.FOCAL]:
        against = _against_claims(data, parameters, covariance)
    unclear = _UNCLEAR.get(data.stamps.varying, '')
    change = following.change_in_words(final)
    return unsettled, unclear, against, change, acceptance.regions_in_words(final)


def _slope(
    data: Observations, final: fit.Fit, parameters: Array, sigmas: Array
) -> Estimate | None:
    """Change of the offset by the interval of the frames; None if that does not vary."""
    if not (final.free[model.SLOPE] and data.follows_intervals):
        return None
    return _estimate(parameters[model.SLOPE], sigmas[model.SLOPE], _MOST[model.SLOPE])


def _with_common_errors(final: fit.Fit, config: CalibrationConfig) -> tuple[model.Unknowns, Array]:
    """Unknowns and covariance of a fit with the errors that are common to the recording."""
    sigmas = _COMMON_IN_IMAGES if config.exposed else _COMMON
    common = np.where(final.free, sigmas, 0.0)
    covariance = final.covariance + np.diag(common**2)
    return within_priors(final, covariance)


def within_priors(final: fit.Fit, covariance: Array) -> tuple[model.Unknowns, Array]:
    """The calibration without sigmas of claimed parameters that are larger than their priors'.

    Widened, sigmas may exceed those of the priors. The information that is then missing is added
    in these directions alone: the prior does not count twice.
    """
    prior = final.problem.prior
    is_known = knowledge.CLAIMED & final.free & (np.diag(prior) > 0.0)
    known = np.flatnonzero(is_known)
    if not len(known):
        return final.unknowns, covariance
    off = final.problem.center[known] - final.unknowns.parameters[known]
    gain = _prior_gain(prior, known, covariance)
    return fit.stepped(final.unknowns, gain @ off), covariance - gain @ covariance[:, known].T


def _prior_gain(prior: Array, known: NDArray[np.int64], covariance: Array) -> Array:
    """Moves (GLOBAL, m) of all parameters by the m known ones' distances from their prior.

    As of a measurement that has the information which `covariance` lacks of that prior.
    """
    of_known = np.ix_(known, known)
    root = np.linalg.cholesky(np.linalg.inv(prior[of_known]))
    # The covariance in units of the prior, and its axes.
    to_units = np.linalg.inv(root)
    in_units = to_units @ covariance[of_known] @ to_units.T
    variances, axes = np.linalg.eigh(in_units)
    of_data = 1.0 / np.maximum(variances, _LEAST_SHARE)
    missing = np.maximum(1.0 - of_data, 0.0)
    directions = to_units.T @ axes
    information = (directions * missing) @ directions.T
    own = covariance[:, known]
    reduced = np.eye(len(known)) + own[known] @ information
    return np.asarray(own @ information @ np.linalg.inv(reduced))


def _against_claims(data: Observations, parameters: Array, covariance: Array) -> str:
    """Name what the images contradict of the lens of a CameraInfo, with its value; '' if nothing.

    The lens is not in the parameter file, and the axes would be wrong with another one.
    """
    camera = data.camera.moved_lens(parameters[model.LENS])
    coefficients = ', '.join(f'{one:.3f}' for one in camera.radial_coefficients)
    values = {
        'focal_log': f'a focal length of {camera.fx:.1f} px',
        'aspect': f'focal lengths fx {camera.fx:.1f} and fy {camera.fy:.1f} px',
        'distortion': f'a distortion k1, k2, k3 of {coefficients}',
        'principal_point': f'a principal point of {camera.cx:.1f}, {camera.cy:.1f} px',
    }
    off = np.zeros(model.GLOBAL)
    off[model.LENS] = data.lens + parameters[model.LENS]
    spread = covariance.copy()
    spread[model.LENS, model.LENS] += knowledge.prior_covariance_of_lens(data.camera)
    names = []
    for name, text in values.items():
        part = OFFLINE.part(name)
        own = off[part]
        gain = float(own @ np.linalg.solve(spread[part, part], own))
        # A vector gains more by chance.
        if gain > acceptance.CONTRADICTED**2 + len(own) - 1:
            names.append(text)
    if not names:
        return ''
    by_resolution = _of_another_resolution(camera, off)
    if by_resolution:
        return by_resolution
    return (
        f'the images contradict the CameraInfo, and show {" and ".join(names)}: calibrate with '
        '--lens, and check for images that were cropped, scaled or rotated'
    )


# Change of a focal length (logarithm) from which a matrix may be that of another resolution.
# [chosen: 1.2 times; resolutions differ by more]
_OTHER_RESOLUTION = 0.18
# Largest distance of the principal point from that of such a matrix, as a share of the width.
# [chosen: twice the sigma of a principal point, 1.5 %]
_SAME_PLACE = 0.03


def _of_another_resolution(camera: RollingShutterCamera, off: Array) -> str:
    """Name a claimed matrix all of whose values are those of `camera` by one factor; '' if not.

    `off` (GLOBAL,) is the lens of `camera` less the claimed one.
    """
    ratio = float(off[model.FOCAL])
    claimed = np.array([camera.cx, camera.cy]) - off[model.CENTER]
    expected = math.exp(ratio) * (claimed + 0.5) - 0.5
    apart = np.hypot(*(expected - (camera.cx, camera.cy)))
    if abs(ratio) < _OTHER_RESOLUTION or apart > _SAME_PLACE * camera.width:
        return ''
    return (
        f'the camera matrix is that of images of another resolution, {math.exp(-ratio):.2f} times '
        f'as large: the images have a focal length of {camera.fx:.1f} px and a principal point of '
        f'{camera.cx:.1f}, {camera.cy:.1f} px. Give the CameraInfo of this resolution'
    )


def _offset_of_row_0(
    data: Observations, parameters: Array, covariance: Array, wide: float
) -> Estimate:
    """Time offset of row 0, which is read half of the readout before the middle row."""
    camera = data.camera
    by_parameters = np.zeros(model.GLOBAL)
    by_parameters[model.OFFSET] = 1.0
    by_parameters[model.READOUT] = -camera.middle_row / camera.row_count
    value = float(by_parameters @ parameters)
    variance = float(by_parameters @ covariance @ by_parameters)
    sigma = math.hypot(math.sqrt(variance), following.sigma_over_recording(data))
    if data.stamps.varying is observations.Varying.JITTER:
        # The offset is for the stamps of single frames, which have this error.
        sigma = math.hypot(sigma, data.stamps.size)
    unknown = ''
    if data.follows_intervals and not data.course.is_constant:
        unknown = 'a clock was set or drifts, and the offset varies with the intervals as well'
    offset = _estimate(value, sigma, wide * _MOST[model.OFFSET], unknown)
    if data.course.drift and not offset.observable:
        return replace(offset, remark='the clocks drift: no value holds for all of the recording')
    return offset


def _angle_between(first: Array, second: Array) -> float:
    """Angle [rad] of the rotation between two rotation matrices (3, 3)."""
    cosine = (np.trace(first @ second.T) - 1.0) / 2.0
    return math.acos(np.clip(cosine, -1.0, 1.0))


def _lens(
    data: Observations, parameters: Array, covariance: Array, wide: float, one_axis: str
) -> LensEstimates:
    """Estimates of the lens; the focal length is not observable by a rotation about one axis."""
    camera = data.camera.moved_lens(parameters[model.LENS])
    sigmas = np.sqrt(np.diag(covariance))
    focal_sigma = float(sigmas[model.FOCAL])
    column_sigma, row_sigma = map(float, sigmas[model.CENTER])
    coefficients = camera.radial_coefficients.tolist()
    factor = math.exp(data.lens[0] + parameters[model.FOCAL])
    most = factor * wide * _MOST[model.FOCAL]
    return LensEstimates(
        _estimate(factor, factor * focal_sigma, most, one_axis),
        tuple(
            Estimate(value, float(sigma), True)
            for value, sigma in zip(coefficients, sigmas[model.DISTORTION], strict=True)
        ),
        Estimate(camera.cx, column_sigma, True),
        Estimate(camera.cy, row_sigma, True),
        camera.distortion,
        _displacement(camera, coefficients, covariance[model.DISTORTION, model.DISTORTION]),
        radial.equivalent_sigma(
            radial.corner_radius(camera), covariance[model.DISTORTION, model.DISTORTION]
        ),
    )


def _displacement(
    camera: RollingShutterCamera, coefficients: list[float], covariance: Array
) -> Estimate:
    """Displacement of the corner of the image by k1, k2, k3, over its radius."""
    by_coefficients = radial.displacements([radial.corner_radius(camera)])[0]
    sigma = math.sqrt(by_coefficients @ covariance @ by_coefficients)
    return Estimate(float(by_coefficients @ coefficients), sigma, True)


def _changed_by_an_interval(data: Observations) -> float:
    """Rms change [rad/s] of the gyro's rates by an exposure of an interval.

    Means over one and two intervals differ by three times that, to second order in the exposure,
    and have little of the noise of single samples.
    """
    angles = integral(data.gyro_times, data.gyro_rates)
    inside = data.gyro_times[
        (data.gyro_times > data.gyro_times[0] + data.interval)
        & (data.gyro_times < data.gyro_times[-1] - data.interval)
    ]
    means = []
    for width in (data.interval, 2.0 * data.interval):
        ends = [
            interpolated(inside + half, data.gyro_times, angles)
            for half in (-0.5 * width, 0.5 * width)
        ]
        means.append((ends[1] - ends[0]) / width)
    return math.sqrt(float(np.mean((means[1] - means[0]) ** 2))) / 3.0


def _exposure(data: Observations, final: fit.Fit, square_sigma: float) -> Estimate:
    """Exposure at the median interval [s]."""
    assumed = float(np.median(data.exposure.assumed))
    square = assumed**2 + float(final.unknowns.parameters[model.EXPOSURE])
    value = min(math.sqrt(max(square, 0.0)), data.interval)
    # Also of a square near zero, where the root has no derivative.
    sigma = math.sqrt(value**2 + square_sigma) - value
    noise = data.gyro_density / math.sqrt(data.interval)
    if noise > _changed_by_an_interval(data):
        # An exposure averages the noise, too: rows fit the images better with it.
        reason = 'the gyro has more noise than an exposure of an interval would change its rates'
        return Estimate(value, data.interval, False, reason)
    return Estimate(value, sigma, sigma <= 0.5 * value, 'the images do not show any')


def joined(
    unknowns: model.Unknowns,
    covariance: Array,
    known: NDArray[np.int64],
    values: Array,
    of_values: Array,
) -> tuple[model.Unknowns, Array]:
    """The calibration with independent values of the parameters `known` (m,), and its covariance.

    `of_values` (m, m) is the covariance of the `values` (m,).
    """
    own = covariance[np.ix_(known, known)]
    gain = covariance[:, known] @ np.linalg.inv(own + of_values)
    step = gain @ (values - unknowns.parameters[known])
    return fit.stepped(unknowns, step), covariance - gain @ covariance[known]


def _bounded(
    unknowns: model.Unknowns, covariance: Array, interval: float
) -> tuple[model.Unknowns, Array, str]:
    """The calibration with its readout within an interval T between frames, and a note.

    The readout time is the mean of its normal distribution between these bounds, and the others
    follow by their covariance with it; an estimate less certain than the bound itself is joined
    with that. See docs/calibration.md, "Interpretation of the results".
    """
    k = model.READOUT
    known = interval / math.sqrt(12.0)
    if covariance[k, k] > known**2:
        return (
            *joined(
                unknowns,
                covariance,
                np.array([k]),
                np.array([0.5 * interval]),
                np.array([[known**2]]),
            ),
            (
                'the images hardly determine the readout time: it is mostly that of any camera '
                f'that is read downwards within the {1e3 * interval:.1f} ms between frames'
            ),
        )
    readout = float(unknowns.parameters[k])
    sigma = math.sqrt(covariance[k, k])
    found = 'the readout time is estimated as ' + with_sigma(
        Code.READOUT_TIME, abs(readout), sigma
    )
    if abs(readout) - 3.0 * sigma > interval:
        raise InputError(
            f'{found}, longer than the interval of {1e3 * interval:.1f} ms between frames, which '
            'no camera can do: check for stabilised images (stabilisation), for frames that were '
            'dropped and stamped again, and for images that were cropped, scaled or rotated'
        )
    # Of a truncated normal distribution; at least 0.1 % of it lies within.
    ends = (np.array([-interval, interval]) - readout) / sigma
    density = np.exp(-0.5 * ends**2) / math.sqrt(2.0 * math.pi)
    below = special.ndtr(ends)
    mean = readout - sigma * float(np.diff(density)[0] / np.diff(below)[0])
    step = covariance[:, k] * ((mean - readout) / sigma**2)
    note = (
        ''
        if abs(readout) <= interval
        else (
            f'{found}, but is at most the {1e3 * interval:.1f} ms between frames: all parameters '
            f'are '
            f'for {1e3 * abs(mean):.1f} ms, the mean below that'
        )
    )
    return fit.stepped(unknowns, step), covariance, note


def _estimate(value: float, sigma: float, limit: float, blocking_reason: str = '') -> Estimate:
    """Estimate, observable if its sigma is within `limit` and nothing blocks it."""
    good = bool(sigma <= limit and not blocking_reason)
    return Estimate(
        float(value),
        float(sigma),
        good,
        '' if good else blocking_reason or _RECORD_MORE,
        determined=bool(sigma <= _USELESS * limit and not blocking_reason),
    )


# -- Tracks and gyro of a bag -------------------------------------------------------------------

# Guess of an unknown focal length, share of the longer side: 64 deg of view.
_FOCAL_GUESS = 0.8
# The current image becomes the reference when less than this share of the points is left. A larger
# share adds up errors from reference to reference, a smaller one loses points.
# [chosen: 0.7 to 0.9 would do]
_KEPT = 0.8
# It also does after so many images, by which the appearance of points has changed.
# [chosen: a second at 30 Hz]
_RENEWED_AFTER = 30
# The gyro is kept for longer than the images [ns], as the clocks may differ.
_MARGIN_NS = to_nanoseconds(1.0)
# A driver repeats the last sample for at most this time [ns]. A gyro that gives equal values for
# longer is one of a simulation at rest, whose samples are kept. [chosen: the largest gap that is
# interpolated, 30 ms; above the period of a slow sensor, 20 ms]
_LONGEST_HELD_NS = to_nanoseconds(0.03)

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationInput:
    """Tracks (pixels of the full sensor), gyro and camera of a bag."""

    tracks: TrackedPoints
    gyro: GyroSeries
    camera: RollingShutterCamera  # of the full sensor, its readout time 0
    focal_known: bool  # by the CameraInfo; else `camera` is a guess
    unused: dict[str, int]  # messages that were not used, by reason
    is_whole: bool = True  # whether the images show the whole sensor, without binning
    lens_given: bool = False  # whether the distortion is that of a CameraInfo, yet estimated

    @property
    def lens_knowledge(self) -> LensKnowledge:
        """Where its lens comes from."""
        if self.focal_known:
            return LensKnowledge.CLAIMED
        return LensKnowledge.GIVEN if self.lens_given else LensKnowledge.GUESSED

    def calibrated(
        self,
        config: CalibrationConfig,
        *,
        quat_prior: Sequence[float] | None = None,
        rng: np.random.Generator | int = 0,
        progress: Callable[[float], object] = lambda share: None,
    ) -> CalibrationResult:
        """Its calibration, as by `calibrate`."""
        R_prior = rotation_of(quat_prior)
        found = fitted(self, config, R_prior=R_prior, rng=rng, progress=progress)
        return result_of(found, config, R_prior)

    def with_unknown_lens(self, distortion_model: str) -> CalibrationInput:
        """The same for a lens that is to be estimated, about the distortion of its CameraInfo.

        Without a distortion there, the lens is of this model.
        """
        if not self.is_whole:
            raise InputError(
                'the CameraInfo has a region of interest or binning, which '
                'camera_matrix cannot describe: calibrate without --lens'
            )
        if any(self.camera.distortion):
            return replace(self, focal_known=False, lens_given=True)
        counts = DISTORTION_MODELS[distortion_model].coefficient_counts
        none = (0.0,) * max(counts[0], 5 if len(counts) > 2 else 4)
        return replace(
            self,
            focal_known=False,
            lens_given=self.focal_known,
            camera=replace(self.camera, distortion_model=distortion_model, distortion=none),
        )


def read_recording(
    bag: Bag, topics: SensorTopics, tracking: TrackingConfig, *, images: range | None = None
) -> CalibrationInput:
    """Follow points through the images of an open bag, and collect its gyro.

    Of `images`, by their number in the bag, and of the gyro meanwhile; None: all. InputError or
    MissingInputError if the bag is damaged, or has no usable image or no gyro.
    """
    recorder = Recorder(tracking)
    number = 0
    if topics.camera_info is None:
        recorder.uncalibrated = True
    for role, message in sensor_messages(bag, topics, (Role.IMU, Role.CAMERA_INFO, Role.IMAGE)):
        if images is None or role is Role.CAMERA_INFO or number in images:
            error = recorder.add(role, message.message)
            if error is not None and recorder.unused.add(reason := f'{message.topic}: {error}'):
                _logger.info('not used: %s', reason)
        number += role is Role.IMAGE
    return recorder.recording()


class Recorder:
    """Follows points by the chosen tracker, and keeps the gyro, of the last `longest` seconds."""

    def __init__(self, tracking: TrackingConfig, longest: float = math.inf) -> None:
        self.intrinsics: Intrinsics | None = None
        self.uncalibrated = False  # whether there is no calibrated CameraInfo
        self.unused = ReasonCounts()  # messages
        self._longest = longest
        self._tracker = make_tracker(tracking)
        self._levels = GrayLevels()
        self._since_renewed = 0  # images
        # Stamps of the images, ids and pixels (N, 2) of their points.
        self._frames: deque[tuple[int, NDArray[np.uint32], NDArray[np.float32]]] = deque()
        self.size = (0, 0)  # of the images [px]
        self._times = SampleTimes()
        self._gyro: dict[int, tuple[float, float, float]] = {}
        self._last_rates: tuple[float, ...] = ()  # of the last sample
        self._changed_ns = 0  # stamp of the first sample with these rates

    @property
    def seconds(self) -> float:
        """Time between the first and the last image."""
        frames = self._frames
        return seconds_between(frames[0][0], frames[-1][0]) if frames else 0.0

    @property
    def warning(self) -> str:
        """What is wrong with the stamps of the gyro, which are corrected; empty for nothing."""
        return burst_warning('the IMU', self._times)

    @property
    def last_ns(self) -> int:
        """Stamp of the last image."""
        return self._frames[-1][0]

    def add(self, role: Role, message: Any) -> RsRelposeError | None:
        """Use a message; the error of one that cannot be used."""
        try:
            value = PARTS[role].read(message)
            if role is Role.IMAGE:
                self.follow(value)
            elif role is Role.CAMERA_INFO:
                self.intrinsics = value
            elif value.angular_velocity is None:
                raise MissingInputError('an IMU message has no gyro')
            else:
                self._add_gyro(value)
        except RsRelposeError as error:
            # Without a calibration the focal length is guessed.
            if role is Role.CAMERA_INFO and isinstance(error, MissingInputError):
                self.uncalibrated = True
                return None
            return error
        return None

    def _add_gyro(self, sample: ImuSample) -> None:
        """Keep the samples whose times are known by the next one."""
        timed = self._times.add(sample)
        if timed and self._times.corrects:
            self._times.corrects = False
            self._gyro.clear()
        for one in timed:
            rates = one.angular_velocity
            if rates is not None and not self._is_held(one.stamp_ns, rates):
                self._gyro.setdefault(one.stamp_ns, rates)

    def _is_held(self, stamp_ns: int, rates: tuple[float, float, float]) -> bool:
        """Whether a driver has repeated the last sample; its stamp would make the gyro late."""
        since_ns = stamp_ns - self._changed_ns
        if rates == self._last_rates:
            return 0 <= since_ns < _LONGEST_HELD_NS
        self._last_rates = rates
        self._changed_ns = stamp_ns
        return False

    def follow(self, encoded: EncodedImage) -> None:
        """Track the points of the images before in another one; InputError if it is unusable."""
        if self._frames and encoded.stamp_ns <= self.last_ns:
            raise InputError('the stamp of an image is not later than the previous one')
        image = encoded.decoded(self._levels)
        tracker = self._tracker
        if not self._frames:
            tracker.start(image)
        # Matches with the reference, so that errors do not add up from frame to frame.
        tracker.track(image)
        matches = tracker.refined_matches()
        self._since_renewed += 1
        if tracker.tracked_fraction < _KEPT or self._since_renewed >= _RENEWED_AFTER:
            tracker.promote()
            self._since_renewed = 0
        self._frames.append(
            (encoded.stamp_ns, matches.track_ids, matches.points2.astype(np.float32))
        )  # to 1e-4 px
        self.size = image.shape[1], image.shape[0]
        while self.seconds > self._longest:
            self._frames.popleft()
            begin_ns = self._frames[0][0] - _MARGIN_NS
            while self._gyro and (first := next(iter(self._gyro))) < begin_ns:
                del self._gyro[first]

    def set_back(self, stamp_ns: int) -> None:
        """Move all that is recorded to end a second before `stamp_ns`, on a clock set back."""
        earlier_ns = self.last_ns - stamp_ns + _MARGIN_NS
        self._frames = deque(
            (stamp - earlier_ns, ids, points) for stamp, ids, points in self._frames
        )
        moved: dict[int, tuple[float, float, float]] = {}
        last_ns = next(iter(self._gyro), 0)
        for stamp, rates in self._gyro.items():
            if stamp < last_ns - _MARGIN_NS:  # since then
                break
            last_ns = stamp
            moved[stamp - earlier_ns] = rates
        self._gyro = moved

    def recording(self) -> CalibrationInput:
        """All that was recorded; InputError or MissingInputError if something is missing."""
        unused = self.unused.most_common()
        why = ''.join(f'; {reason}' for reason in list(unused)[:2])
        if not self._frames:
            raise InputError(f'no image can be used{why}')
        if not self._gyro:
            raise MissingInputError(
                f'no message of the IMU has a gyro{why}: record the angular '
                'velocity together with the images'
            )
        intrinsics = self.intrinsics
        if intrinsics is None and not self.uncalibrated:
            raise MissingInputError(f'no CameraInfo can be used{why}')
        of_frames, ids, pixels = zip(*self._frames, strict=True)
        points = np.concatenate(pixels, dtype=np.float64)
        stamps = sorted(self._gyro)
        if intrinsics is not None:
            points = intrinsics.to_sensor(points)
        frames = np.repeat(np.arange(len(ids)), list(map(len, ids)))
        tracks = TrackedPoints(np.array(of_frames), frames, np.concatenate(ids), points)
        rates = np.array([self._gyro[stamp] for stamp in stamps])
        gyro = GyroSeries(np.array(stamps), rates, self._times.delay_sigma)
        width, height = self.size
        if intrinsics is None:
            guess = _FOCAL_GUESS * max(width, height)
            camera = RollingShutterCamera(
                width=width,
                height=height,
                fx=guess,
                fy=guess,
                cx=0.5 * (width - 1),
                cy=0.5 * (height - 1),
                readout_time=0.0,
            )
        elif (width, height) == (intrinsics.image_width, intrinsics.image_height):
            camera = intrinsics.global_shutter_camera()
        else:
            raise InputError(
                f'the images are {width}x{height}, but the CameraInfo is for '
                f'{intrinsics.image_width}x{intrinsics.image_height}: a resized image needs a '
                'CameraInfo of its own'
            )
        return CalibrationInput(
            tracks,
            gyro,
            camera,
            intrinsics is not None,
            unused,
            is_whole=self.size == (camera.width, camera.height),
        )
