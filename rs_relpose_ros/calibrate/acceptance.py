"""Tests of a fit that presuppose no cause, before its result is used.

A calibration that fails one of them has no value for use: its sigmas are those of a model that the
recording contradicts. Each half of the recording is a test of the other one, which it has not been
fitted to; what is claimed of camera, gyro and exposure before the fit is another.
"""

from __future__ import annotations

from dataclasses import replace
import math

import numpy as np

from rs_relpose_ros.calibrate.result import CalibrationResult, Estimate
from rs_relpose_ros.calibration import fit, knowledge, model
from rs_relpose_ros.calibration.image_motion import gains, repeated_axis
from rs_relpose_ros.calibration.knowledge import LensKnowledge
from rs_relpose_ros.calibration.observations import (
    MeasuredRates,
    Observations,
    PairSelection,
    rates_at,
    Start,
)
from rs_relpose_ros.calibration.rotations import factor_of, is_other_factor
from rs_relpose_ros.core.deviations import ENTRIES, OFFLINE
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array

# Sigmas of a claim and of its estimate together beyond which images contradict the claim. Fewer
# would contradict a right CameraInfo by chance, more would hide a wrong one.
# [chosen: as other contradictions of a configuration]
CONTRADICTED = 4.0
# Sigmas by which the square of the exposure may exceed that of the interval between frames, which
# no camera can exceed. [chosen: as that of a claim]
_IMPOSSIBLE = 4.0
# Mean squared difference of the parameters of both halves, in sigmas, that is no chance. Each is
# limited to that of 3 sigmas. [derived: p = 1e-5 of chi-square over the 18 parameters of a fit is
# 3.0]
_HALVES_APART = 3.5
# Variance of a value by regions of the image over that by time and model, beyond which regions
# contradict each other. [derived: three sigmas; measured: at most 3.9 on ten correct recordings]
_REGIONS_APART = 9.0
# Noise of the mean rate of the gyro over an interval between frames, as a share of the rms of its
# rate, beyond which the rows of an image see another rotation than the gyro. The readout time is
# wrong by the square of the share. [measured: 0.001 to 0.009 of correct and real recordings,
# 0.07 to 0.11 of vibrating ones, whose readout time is up to 14 sigma off]
_VIBRATING = 0.05
# Share of the rotation of the camera below which the images show something else than a scene at
# rest. A focal length that is wrong by a factor of 5 shows as much. [measured: 0.03 with an object
# in 0.8 of the view, 0.3 to 0.4 with one in 0.4 or an interior in 0.75 of it]
_OTHER_VIEW = 0.2
# Correlation of the rates of images and gyro from which they are of one rotation. [chosen: 0.5 to
# 0.9 would do]
_SAME_ROTATION = 0.7
# Relative difference of a factor from that of a unit. [chosen: translation changes gains by 10 %]
_SAME_UNIT = 0.2
# Pairs that are compared for two views in one image: apart by time [s], points, least points, and
# largest number. [chosen: the camera moves by more than the noise]
_PAIRS = PairSelection((0.133,), 200, 40, 60)


# -- Before the fit -----------------------------------------------------------------------------


def refuse_two_views(data: Observations) -> None:
    """InputError if the images have two views of a stereo camera."""
    pairs = data.pairs(_PAIRS, np.random.default_rng(0))
    step = math.ceil(len(pairs) / _PAIRS.most_pairs) or 1
    points = data.tracks.points
    of_pairs = [(points[pair.rows[0]], points[pair.rows[1]]) for pair in pairs[::step]]
    axis = repeated_axis(of_pairs, (data.camera.width, data.camera.height))
    if axis is None:
        return
    place = 'beside' if axis == 0 else 'above'
    raise InputError(
        f'there are two views in one image, {place} each other, as of a stereo camera '
        '(two_views): nothing can be determined. Publish each view as a camera of its own, with '
        'its own CameraInfo'
    )


def refuse_other_motion(measured: MeasuredRates, start: Start, interval: float) -> None:
    """InputError if the images do not turn as the camera does.

    They are stabilised, or most of the view does not belong to the scene. `interval` [s] is that
    between frames.
    """
    rates = rates_at(measured, np.array([start.offset]), start)
    known = np.isfinite(rates.gyro[0]).all(axis=1)
    found = gains(rates.images[known], rates.gyro[0][known], interval)
    if found is None:
        return
    fast, slow = (f'{100.0 * gain:.0f} %' for gain in found)
    if found.are_stabilised:
        raise InputError(
            f'the images are stabilised (stabilisation): they follow {fast} of fast rotations of '
            f'the camera and {slow} of slow ones. Nothing can be determined: switch the '
            'stabilisation of lens and video off'
        )
    alike = np.corrcoef(rates.images[known, :2].ravel(), rates.gyro[0][known, :2].ravel())[0, 1]
    factor = 1.0 / max(found.fast, 1e-3)
    of_images, of_gyro = rates.images[known], rates.gyro[0][known]
    along = factor_of(of_images[:, 2:], of_gyro[:, 2:])
    is_factor = is_other_factor(along, factor_of(of_images[:, :2], of_gyro[:, :2]))
    is_gross = not _OTHER_VIEW < found.fast < 1.0 / _OTHER_VIEW
    if alike > _SAME_ROTATION and (is_gross or is_factor):
        in_degrees = abs(factor / math.degrees(1.0) - 1.0) < _SAME_UNIT
        unit = 'it is in deg/s' if in_degrees else f'it gives {factor:.2g} times the rotation'
        raise InputError(
            f'the gyro is not in rad/s (gyro_unit): {unit}. Nothing can be determined: correct '
            'the driver'
        )
    if max(found) < _OTHER_VIEW:
        raise InputError(
            f'most of the view does not turn against the camera (by {slow} of its rotation): it '
            'is inside a vehicle (interior), an object fills the view (moving_object), or gyro '
            'and images are of two devices. Nothing can be determined: record a scene at rest'
        )


# -- Claims -------------------------------------------------------------------------------------


def contradiction(data: Observations, final: fit.Fit) -> float:
    """Factor by which sigmas of a CameraInfo that images refute are too small; 1 if not."""
    if data.knowledge is not LensKnowledge.CLAIMED or not final.free[model.FOCAL]:
        return 1.0
    prior = knowledge.prior_covariance_of_lens(data.camera)
    off = data.lens + final.unknowns.parameters[model.LENS]
    farthest = max(_distances(off, prior))
    return farthest if farthest > CONTRADICTED else 1.0


def _distances(off: Array, prior: Array) -> list[float]:
    """Distances of the entries of the lens (9,) from their claims, in sigmas of the prior."""
    found = []
    first = model.LENS.start
    for name in ('focal_log', 'aspect', 'distortion', 'tangential', 'principal_point'):
        part = OFFLINE.part(name)
        own = slice(part.start - first, part.stop - first)
        square = float(off[own] @ np.linalg.solve(prior[own, own], off[own]))
        found.append(math.sqrt(square / (part.stop - part.start)))
    return found


# Sigmas of the deviations before anything is measured; of the exposure, that of an interval at
# 30 Hz. [derived: `ENTRIES`]
_SIGMAS = {entry.name: entry.sigma for entry in ENTRIES} | {'exposure': 0.03}

# -- After the fit ------------------------------------------------------------------------------


def accepted(result: CalibrationResult, data: Observations, final: fit.Fit) -> CalibrationResult:
    """The result, without values where the recording contradicts the model of the fit."""
    vibration = _vibration(data, result)
    if vibration:
        result = replace(
            result,
            readout_time=_not_determined(result.readout_time, 'readout_time', vibration),
            time_offset=_not_determined(result.time_offset, 'time_offset', vibration),
            exposure=_not_determined(result.exposure, 'exposure', vibration),
            warnings=(*result.warnings, vibration),
        )
    failure = _failure(data, final)
    if not failure:
        return result
    lens = result.lens
    if lens is not None:
        lens = lens._replace(focal_factor=_not_determined(lens.focal_factor, 'focal_log', failure))
    return replace(
        result,
        readout_time=_not_determined(result.readout_time, 'readout_time', failure),
        time_offset=_not_determined(result.time_offset, 'time_offset', failure),
        rotation=_not_determined(result.rotation, 'axes', failure),
        gyro_bias=tuple(_not_determined(bias, 'gyro_bias', failure) for bias in result.gyro_bias),
        rotation_sigma=np.maximum(result.rotation_sigma, _SIGMAS['axes']),
        lens=lens,
        exposure=_not_determined(result.exposure, 'exposure', failure),
        # They are about values that mean nothing.
        warnings=(),
        failure=failure,
    )


def _not_determined(estimate: Estimate, name: str, reason: str) -> Estimate:
    """An estimate of a deviation by its name, with the sigma of before anything is measured."""
    sigma = max(estimate.sigma, _SIGMAS[name])
    return Estimate(estimate.value, sigma, observable=False, remark=reason, determined=False)


def _vibration(data: Observations, result: CalibrationResult) -> str:
    """What is wrong with a gyro whose noise is no small part of the rotation; '' for nothing."""
    rate = float(np.linalg.norm(result.rotation_rates))
    noise = data.gyro_density / math.sqrt(data.interval)
    if noise <= _VIBRATING * rate:
        return ''
    return (
        f'vibration: the gyro has a noise of {data.gyro_density:.2g} rad/s/sqrt(Hz), '
        f'{100.0 * noise / rate:.0f} % of the rotation over a frame, so that rows and gyro cannot '
        'be compared: mount the device softly, or move it by hand, with motors off'
    )


def _failure(data: Observations, final: fit.Fit) -> str:
    """Why the model does not describe the recording; '' if it does."""
    parameters = final.unknowns.parameters
    sigmas = np.sqrt(np.maximum(np.diag(final.covariance), 0.0))
    assumed = float(np.median(data.exposure.assumed))
    if final.free[model.EXPOSURE]:
        square = assumed**2 + float(parameters[model.EXPOSURE])
        if square - data.interval**2 > _IMPOSSIBLE * sigmas[model.EXPOSURE]:
            return (
                'the images turn more smoothly than the gyro, by more than any exposure makes: '
                'candidates are stabilisation of the images (switch it off) and vibration'
            )
    claims = contradiction(data, final)
    if claims > 1.0 and _gyro_distance(final) > CONTRADICTED:
        return (
            'the images contradict what is claimed of the lens as well as of the gyro, so that no '
            'value can be used. Candidates: a gyro in another unit (gyro_unit), stabilised images '
            '(stabilisation), several views or moving parts in the image (moving_object), images '
            'that were changed after they were taken'
        )
    if final.halves_apart > _HALVES_APART:
        return (
            'both halves of the recording contradict each other '
            f'({math.sqrt(final.halves_apart):.1f} sigma in the mean of all values): something '
            'changes. Candidates: zoom or focus, a mount that moves, a clock, stabilised images'
        )
    return ''


def regions_in_words(final: fit.Fit) -> str:
    """Name regions of the image that contradict each other; '' if they do not."""
    needed = OFFLINE.mask('readout_time', 'time_offset', 'axes')
    if not len(final.regions) or final.regions[needed].max() < _REGIONS_APART:
        return ''
    return (
        'parts of the image contradict each other, which the sigmas contain. Candidates: a part '
        'that does not move with the scene (static_region, moving_object), a distortion that is '
        'none of the radial ones, images that were changed after they were taken'
    )


def _gyro_distance(final: fit.Fit) -> float:
    """Largest deviation of scale and skew of the gyro from none, in sigmas of the prior."""
    which = OFFLINE.mask('gyro_scale', 'gyro_skew') & final.free
    if not which.any():
        return 0.0
    prior = np.sqrt(np.diag(final.problem.prior)[which])
    return float(np.max(np.abs(final.unknowns.parameters[which]) * prior))
