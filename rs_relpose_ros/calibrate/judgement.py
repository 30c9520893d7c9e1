"""Figures of a fit with their sigmas, and whether the recording determines them."""

from __future__ import annotations

from collections import defaultdict
import math

import numpy as np
from numpy.typing import NDArray
from scipy.stats import truncnorm

from rs_relpose_ros.calibrate.axis_maps import nearest_axis_map
from rs_relpose_ros.calibrate.coplanarity import (
    BIAS,
    FOCAL,
    GLOBAL,
    OFFSET,
    READOUT,
    ROTATION,
    SLOPE,
    Unknowns,
)
from rs_relpose_ros.calibrate.fit import Fit, LOCAL, stepped
from rs_relpose_ros.calibrate.observations import Observations
from rs_relpose_ros.calibrate.result import AXES, CalibrationResult, CostCurve, Estimate
from rs_relpose_ros.calibrate.stamps import Varying
from rs_relpose_ros.config.calibration import CalibrationConfig
from rs_relpose_ros.errors import InputError

Array = NDArray[np.float64]

_RECORD_MORE = ('too little rotation, too short, or too few points: record 10 s or more of a '
                'textured scene while turning 20 to 60 deg/s about all three axes')
# Error of every focal length, relative: the residual is not linear in the noise of the points.
_LEAST_FOCAL_SIGMA = 2e-4
# A note where the intervals between frames vary for an unknown reason.
_UNCLEAR = defaultdict(str, {Varying.UNCLEAR: (
    'the intervals between frames vary neither as automatic exposure does nor as jitter: the '
    'offset is taken to be the same in all frames')})
# Sigma of an observable slope of the offset [s/s].
_MOST_SLOPE_SIGMA = 0.5


def judged(data: Observations, final: Fit, free: NDArray[np.bool_], curve: CostCurve,
           config: CalibrationConfig) -> CalibrationResult:
    """The result of a calibration from its fit.

    Raises
    ------
    InputError
        The read-out time is longer than the interval between frames.
    """
    # Errors of tracker and model that are alike over all of a recording.
    tracker = np.zeros(GLOBAL)
    tracker[[READOUT, OFFSET]] = config.tracking_time_sigma
    tracker[ROTATION:ROTATION + 3] = config.tracking_rotation_sigma
    tracker[BIAS:BIAS + 3] = config.tracking_bias_sigma
    tracker[SLOPE] = config.exposure_slope_sigma
    tracker[FOCAL] = _LEAST_FOCAL_SIGMA
    covariance = final.covariance + np.diag(np.where(free, tracker, 0.0)**2)
    bounded, beyond = _bounded(final.unknowns, covariance, data.interval)
    parameters, R_cam_imu = bounded.parameters, bounded.R_imu_cam.T
    rates, one_axis = _excitation(data, parameters[BIAS:BIAS + 3], R_cam_imu, config)
    sigmas = np.sqrt(np.diag(covariance))
    # Row 0 is read this share of the read-out before the middle row.
    to_first = np.zeros(GLOBAL)
    to_first[OFFSET], to_first[READOUT] = 1.0, -0.5 * (data.camera.height - 1) / data.camera.height
    # Rotations about the axes of the camera.
    rotation_covariance = covariance[ROTATION:ROTATION + 3, ROTATION:ROTATION + 3]
    rotation_sigma = np.sqrt(np.diag(R_cam_imu @ rotation_covariance @ R_cam_imu.T))
    axis_map = nearest_axis_map(R_cam_imu)
    cosine = (np.trace(R_cam_imu @ axis_map.T) - 1.0) / 2.0
    bias_x, bias_y, bias_z = (
        _estimate(parameters[i], sigmas[i], config.max_bias_sigma) for i in range(BIAS, BIAS + 3))
    focal = slope = None
    if free[FOCAL]:
        factor = math.exp(parameters[FOCAL])
        focal = _estimate(factor, factor * sigmas[FOCAL], factor * config.max_focal_sigma,
                          one_axis)
    if free[SLOPE]:
        slope = _estimate(parameters[SLOPE], sigmas[SLOPE], _MOST_SLOPE_SIGMA)
    jitters = data.stamps.varying is Varying.JITTER
    unsettled = '' if final.converged else 'the fit had not settled when it was stopped'
    return CalibrationResult(
        readout_time=_estimate(parameters[READOUT], sigmas[READOUT], config.max_readout_sigma),
        fitted_readout=float(final.unknowns.parameters[READOUT]),
        time_offset=_estimate(float(to_first @ parameters),
                              math.sqrt(to_first @ covariance @ to_first),
                              config.max_offset_sigma),
        R_cam_imu=R_cam_imu, rotation_sigma=rotation_sigma,
        rotation=_estimate(math.acos(np.clip(cosine, -1.0, 1.0)), rotation_sigma.max(),
                           config.max_rotation_sigma, one_axis),
        axis_map=axis_map, gyro_bias=(bias_x, bias_y, bias_z), focal_factor=focal,
        offset_by_interval=None if jitters else slope,
        offset_by_jitter=slope if jitters else None, stamp_jitter=data.stamps.jitter,
        rotation_rates=rates, curve=curve,
        pixel_sigma=float(np.median(final.unknowns.noise)),
        inlier_ratio=float((final.weights > 0.25).mean()),
        frames=len(data.tracks), pairs=final.problem.pairs, matches=int(final.problem.begin[-1]),
        frame_interval=data.interval,
        warnings=tuple(filter(None, (unsettled, one_axis, beyond, _UNCLEAR[data.stamps.varying]))))


def _bounded(unknowns: Unknowns, covariance: Array, interval: float) -> tuple[Unknowns, str]:
    """The calibration with its read-out within an interval between frames, and a note.

    No camera reads longer than that. The read-out is the mean of its normal distribution between
    these bounds, and the others follow by their covariance with it. Sigmas stay: what comes out
    beyond the bound has errors of which the bound says nothing.
    """
    readout, sigma = float(unknowns.parameters[READOUT]), math.sqrt(covariance[READOUT, READOUT])
    found = f'the read-out time comes out as {1e3 * abs(readout):.1f} +- {1e3 * sigma:.1f} ms'
    if abs(readout) - 3.0 * sigma > interval:
        raise InputError(
            f'{found}, longer than the interval of {1e3 * interval:.1f} ms between frames, which '
            'no camera can do: stamps or frames are not what they seem (frames dropped and '
            'stamped anew, images cropped, scaled or rotated)')
    mean = float(truncnorm.mean(*((np.array([-interval, interval]) - readout) / sigma),
                                loc=readout, scale=sigma))
    step = covariance[:, READOUT] * ((mean - readout) / sigma**2)
    note = '' if abs(readout) <= interval else (
        f'{found}, but is at most the {1e3 * interval:.1f} ms between frames: all figures are for '
        f'{1e3 * abs(mean):.1f} ms, the mean below that')
    return stepped(unknowns, step, np.zeros((len(unknowns.direction), LOCAL))), note


def _estimate(value: float, sigma: float, limit: float, obstacle: str = '') -> Estimate:
    """Estimate that is observable where its sigma is within `limit` and there is no obstacle."""
    good = bool(sigma <= limit and not obstacle)
    return Estimate(float(value), float(sigma), good, '' if good else obstacle or _RECORD_MORE)


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
