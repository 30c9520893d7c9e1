"""The result of a fit: its values with their doubt, which of them are observable, and why not."""

from __future__ import annotations

from dataclasses import replace
import math

import numpy as np
from numpy.typing import NDArray
from scipy import special  # scipy.stats takes seconds to import, at the start of a node

from rs_relpose_ros.calibrate import acceptance, following
from rs_relpose_ros.calibrate.result import CalibrationResult, Estimate, LensEstimates
from rs_relpose_ros.calibration import errors, fit, knowledge, model, observations
from rs_relpose_ros.calibration.findings import Code
from rs_relpose_ros.calibration.findings_text import with_sigma
from rs_relpose_ros.calibration.knowledge import LensKnowledge
from rs_relpose_ros.calibration.observations import Observations
from rs_relpose_ros.config.settings import CalibrationConfig
from rs_relpose_ros.core import radial
from rs_relpose_ros.core.deviations import by_name, OFFLINE
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.imu.integration import integral, interpolated

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
    lens = _lens(data, parameters, covariance, wide, one_axis)
    offset = _offset_of_row_0(data, parameters, covariance, wide)
    notes = _notes(data, final, parameters, covariance)
    of_axes = sigmas[model.ROTATION]
    return CalibrationResult(
        readout_time=replace(of(model.READOUT), determined=True),
        readout_axis=data.camera.readout_axis,
        fitted_readout=float(unknowns.parameters[model.READOUT]),
        time_offset=offset,
        R_cam_imu=R_cam_imu,
        rotation_sigma=of_axes,
        rotation=_estimate(
            _angle_between(R_cam_imu, axis_map),
            of_axes.max(),
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
    unknowns = final.unknowns
    if not len(known):
        return unknowns, covariance
    off = final.problem.center[known] - unknowns.parameters[known]
    gain = _prior_gain(prior, known, covariance)
    reduced = covariance - gain @ covariance[:, known].T
    return fit.stepped(unknowns, gain @ off), reduced


def _prior_gain(prior: Array, known: NDArray[np.int64], covariance: Array) -> Array:
    """Moves (GLOBAL, m) of all parameters by the m known ones' distances from their prior.

    As of a measurement that has the information which `covariance` lacks of that prior.
    """
    of_known = np.ix_(known, known)
    prior_covariance = np.linalg.inv(prior[of_known])
    root = np.linalg.cholesky(prior_covariance)
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
    gain = own @ information @ np.linalg.inv(reduced)
    return np.asarray(gain)


def _against_claims(data: Observations, parameters: Array, covariance: Array) -> str:
    """Name what the images contradict of the lens of a CameraInfo, with its value; '' if nothing.

    The lens is not in the parameter file, and the axes would be wrong with another one.
    """
    camera = data.camera.moved_lens(parameters[model.LENS])
    coefficients = ', '.join(f'{one:.3f}' for one in camera.radial_coefficients)
    sideways = ', '.join(f'{one:.4f}' for one in camera.tangential_coefficients)
    values = {
        'focal_log': f'a focal length of {camera.fx:.1f} px',
        'aspect': f'focal lengths fx {camera.fx:.1f} and fy {camera.fy:.1f} px',
        'distortion': f'a distortion k1, k2, k3 of {coefficients}',
        'tangential': f'tangential coefficients p1, p2 of {sideways}',
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
    found = np.array([camera.cx, camera.cy])
    claimed = found - off[model.CENTER]
    # The centre of a pixel is at whole coordinates, the border of the image at -0.5.
    expected = math.exp(ratio) * (claimed + 0.5) - 0.5
    apart = np.hypot(*(expected - found))
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
) -> LensEstimates | None:
    """Estimates of the lens; None if a CameraInfo claims the lens.

    The focal length is not observable by a rotation about one axis.
    """
    if data.knowledge is LensKnowledge.CLAIMED:
        return None
    camera = data.camera.moved_lens(parameters[model.LENS])
    sigmas = np.sqrt(np.diag(covariance))
    focal_sigma = float(sigmas[model.FOCAL])
    column_sigma, row_sigma = map(float, sigmas[model.CENTER])
    coefficients = camera.radial_coefficients.tolist()
    of_coefficients = covariance[model.DISTORTION, model.DISTORTION]
    radial_estimates = tuple(
        Estimate(value, float(sigma), True)
        for value, sigma in zip(coefficients, sigmas[model.DISTORTION], strict=True)
    )
    factor = math.exp(data.lens[0] + parameters[model.FOCAL])
    most = factor * wide * _MOST[model.FOCAL]
    return LensEstimates(
        _estimate(factor, factor * focal_sigma, most, one_axis),
        radial_estimates,
        Estimate(camera.cx, column_sigma, True),
        Estimate(camera.cy, row_sigma, True),
        camera.distortion,
        _displacement(camera, coefficients, of_coefficients),
        radial.equivalent_sigma(radial.corner_radius(camera), of_coefficients),
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
    times = data.gyro_times
    angles = integral(times, data.gyro_rates)
    after_begin = times > times[0] + data.interval
    before_end = times < times[-1] - data.interval
    inside = times[after_begin & before_end]
    means = []
    for width in (data.interval, 2.0 * data.interval):
        begin = interpolated(inside - 0.5 * width, times, angles)
        end = interpolated(inside + 0.5 * width, times, angles)
        means.append((end - begin) / width)
    differences = means[1] - means[0]
    return math.sqrt(float(np.mean(differences**2))) / 3.0


def _exposure(data: Observations, final: fit.Fit, square_sigma: float) -> Estimate:
    """Exposure at the median interval [s]."""
    assumed = float(np.median(data.exposure.assumed))
    square = assumed**2 + float(final.unknowns.parameters[model.EXPOSURE])
    root = math.sqrt(max(square, 0.0))
    value = min(root, data.interval)
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
    reduced = covariance - gain @ covariance[known]
    return fit.stepped(unknowns, step), reduced


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
        place = np.array([k])
        middle = np.array([0.5 * interval])
        unknowns, covariance = joined(unknowns, covariance, place, middle, np.array([[known**2]]))
        hardly = (
            'the images hardly determine the readout time: it is mostly that of any camera '
            f'that is read downwards within the {1e3 * interval:.1f} ms between frames'
        )
        return unknowns, covariance, hardly
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
    shift = float(np.diff(density)[0] / np.diff(below)[0])
    mean = readout - sigma * shift
    step = covariance[:, k] * ((mean - readout) / sigma**2)
    note = ''
    if abs(readout) > interval:
        note = (
            f'{found}, but is at most the {1e3 * interval:.1f} ms between frames: all parameters '
            f'are for {1e3 * abs(mean):.1f} ms, the mean below that'
        )
    return fit.stepped(unknowns, step), covariance, note


def _estimate(value: float, sigma: float, limit: float, blocking_reason: str = '') -> Estimate:
    """Estimate, observable if its sigma is within `limit` and nothing blocks it."""
    is_blocked = bool(blocking_reason)
    observable = bool(sigma <= limit and not is_blocked)
    determined = bool(sigma <= _USELESS * limit and not is_blocked)
    reason = '' if observable else blocking_reason or _RECORD_MORE
    return Estimate(float(value), float(sigma), observable, reason, determined=determined)
