"""The whole calibration on tracks: search for a start, fit, and result; of several bags, too."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.calibrate import acceptance, evaluation, following
from rs_relpose_ros.calibrate.recording import CalibrationInput
from rs_relpose_ros.calibrate.result import CalibrationResult
from rs_relpose_ros.calibration import (
    errors,
    fit,
    knowledge,
    model,
    observations,
    offset_course,
    repeated,
)
from rs_relpose_ros.calibration.observations import (
    GyroSeries,
    MeasuredRates,
    Observations,
    PairSelection,
    TrackedPoints,
)
from rs_relpose_ros.calibration.readout_direction import along_other_axis
from rs_relpose_ros.calibration.rotations import LEAST_RAYS
from rs_relpose_ros.config.settings import CalibrationConfig
from rs_relpose_ros.core.deviations import OFFLINE
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.lens import N_LENS
from rs_relpose_ros.geometry.so3 import log_so3
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.messages.transforms import AXES_SIGMA

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
# Changes of the lens within which the fit is linear in it: focal length, aspect, radial and
# tangential coefficients, principal point [px]. [chosen: the error of second order is below 0.1 px
# there]
_LENS_STAYS = (0.01, 0.01, 0.02, 0.05, 0.05, 0.01, 0.01, 5.0, 5.0)
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
    used = CalibrationConfig() if config is None else config
    return calibrated(recording, used, quat_prior=quat_prior, rng=rng, progress=progress)


def calibrated(
    recording: CalibrationInput,
    config: CalibrationConfig,
    *,
    quat_prior: Sequence[float] | None = None,
    rng: np.random.Generator | int = 0,
    progress: Callable[[float], object] = lambda share: None,
) -> CalibrationResult:
    """The calibration of a recording, as by `calibrate`."""
    R_prior = rotation_of(quat_prior)
    found = fitted(recording, config, R_prior=R_prior, rng=rng, progress=progress)
    return result_of(found, config, R_prior)


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
    data = found.data
    result = evaluation.evaluated(data, final, found.curve, config, axes_known=axes_known)
    return acceptance.accepted(result, data, final)


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

    def progress_of_curve(share: float) -> None:
        progress(0.8 + 0.2 * share)

    offset = final.unknowns.parameters[model.OFFSET]
    some = data.selected_problem(_SOME_PAIRS, offset, rng)
    bent = fit.with_bends(some, final.unknowns)
    curve = fit.cost_curve(bent, final, data.interval, progress_of_curve)
    return Fitted(data, final, curve)


def warm_up_fit() -> None:
    """Compile (or load from the cache) the kernels of a calibration, on made-up points."""
    frames = 60
    points = 30
    rng = np.random.default_rng(0)
    stamps_ns = np.arange(frames) * to_nanoseconds(1.0 / 30.0)
    frame_of_points = np.repeat(np.arange(frames), points)
    track_of_points = np.tile(np.arange(points), frames)
    pixels = rng.uniform(0, 200, (frames * points, 2))
    tracks = TrackedPoints(stamps_ns, frame_of_points, track_of_points, pixels)
    gyro_ns = np.arange(-100, 500) * to_nanoseconds(5e-3)
    gyro = GyroSeries(gyro_ns, rng.normal(size=(600, 3)))
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
    data = Observations.of(tracks, gyro, camera)
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
    unknowns = final.unknowns
    R = unknowns.R_cam_imu
    part = model.ROTATION
    covariance = final.covariance.copy()
    _, one_axis, axis = data.excitation(unknowns.parameters[model.BIAS], R)
    if one_axis:
        _forget_axis(covariance, axis)
    turn = log_so3(np.ascontiguousarray(R_prior @ R.T))
    # As `angle_between`, axis by axis.
    of_prior = AXES_SIGMA**2 * np.eye(3)
    largest = of_prior + 9.0 * covariance[part, part]
    if turn @ np.linalg.solve(largest, turn) > 1.0:
        return final, False
    places = np.arange(model.GLOBAL)[part]
    unknowns, covariance = evaluation.joined(unknowns, covariance, places, turn, of_prior)
    return replace(final, unknowns=unknowns, covariance=covariance), True


def _forget_axis(covariance: Array, axis: Array) -> None:
    """Make the angle about an axis (3,) unknown in a covariance, in place.

    The fit of a rotation about one axis means nothing about this axis.
    """
    part = model.ROTATION
    covariance[part] -= np.outer(axis, axis @ covariance[part])
    covariance[:, part] -= np.outer(covariance[:, part] @ axis, axis)
    covariance[part, part] += _ANY_ANGLE**2 * np.outer(axis, axis)


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

    def noise_of_matches(one: tuple[Observations, list[observations.Pair], fit.Fit]) -> float:
        return float(np.median(one[2].unknowns.noise))

    # Pairs and cost differ between the starts, the noise of the matches does not.
    data, chosen, best = min(fits, key=noise_of_matches)
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
        is_same = found is not None and np.array_equal(problem.rows[0], found.problem.rows[0])
        if is_same:
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
        steps = np.abs(coarse.parameters[model.LENS])
        if (steps <= _LENS_STAYS).all():
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
    first = recordings[0]
    for other in recordings[1:]:
        if other.camera != first.camera or other.focal_known != first.focal_known:
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
    of_data = [one.data for one in found]
    _refuse_unlike(of_data)
    fits = [one.final for one in found]
    matches = [one.problem.begin[-1] for one in fits]
    reference = int(np.argmax(matches))
    lenses = np.array([data.lens for data in of_data])
    jitters = any(data.stamps.varying is observations.Varying.JITTER for data in of_data)
    intervals = None if jitters else np.array([data.interval for data in of_data])
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


def _refuse_unlike(recordings: Sequence[Observations]) -> None:
    """Refuse recordings that have no common calibration: turned images, or clocks that change."""
    if len({data.camera.readout_axis for data in recordings}) > 1:
        raise InputError(
            'the images of some recordings are turned against those of others, rows against '
            'columns: calibrate bags of one orientation together, others each alone'
        )
    for number, data in enumerate(recordings, start=1):
        if not data.course.is_constant:
            raise InputError(
                f'the clocks change within recording {number} (a clock was set, or drifts): '
                'calibrate it alone, and the others together'
            )
