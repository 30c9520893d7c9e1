"""Verdicts on what images and gyro say together: clocks, axes, and the rolling-shutter effect."""

from __future__ import annotations

import math

import numpy as np

from rs_relpose_ros.calibrate.axis_maps import axes_text, nearest_axis_map
from rs_relpose_ros.check.findings import Case, FAILURE, Finding, judged, Verdict, WARNING
from rs_relpose_ros.check.scan import Scan
from rs_relpose_ros.check.turning import Alignment
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.geometry.so3 import log_so3

# Stamps of the two sensors that differ by more in their delay are of different clocks [s].
_SAME_CLOCK = 0.5
# Share of the images' turning that the gyro must explain to be of the same camera. A strong
# translation looks like turning, so that only a small share is beyond doubt.
_EXPLAINED, _DOUBTFUL = 0.7, 0.25
# Slower than this [rad/s] the images say nothing of clocks and axes.
_LEAST_RATE = 0.03
# Second over first principal rate: below, the axes' rotation is not known about one axis.
_BALANCED = 0.12
# Offset beyond the parameter [s] and rotation beyond it [deg] that are worth a word, and too much.
_OFFSET_LIMITS = (0.003, 0.012)
_AXES_LIMITS = (5.0, 12.0)
_SCALE_LIMIT = 0.12
# Read-out that is taken for example where none is given [s].
_EXAMPLE_READOUT = 0.030
# Displacement below the noise of matches, and one that spoils a global-shutter pose [px].
_NO_EFFECT, _STRONG_EFFECT = 1.0, 4.0


def findings(seen: Scan, parameters: Parameters) -> list[Finding]:
    """What is said of both sensors together."""
    found = [_overlap(seen, parameters), _texture(seen)]
    if found[0].verdict is not FAILURE:
        sensor = parameters.sensor
        readout = sensor.readout_time
        if readout is not None and sensor.readout_direction == 'up':
            readout = -readout
        alignment = seen.turning.align(readout)
        found += ([Finding('axes and clock', Verdict.OK, 'not measured: too few images to track '
                           'beside the gyro', 'record some seconds of a textured scene')]
                  if alignment is None else _aligned(alignment, seen, parameters))
    effect = _effect(seen, parameters)
    return found if effect is None else [*found, effect]


def _overlap(seen: Scan, parameters: Parameters) -> Finding:
    """Whether the gyro covers the images in time, as stamped."""
    name, images, imu = 'clocks', seen.image_stamps, seen.imu_stamps
    if not images.count or not imu.count:
        return Finding(name, FAILURE, 'no stamps to compare', 'see above')
    offset_ns = round(parameters.sensor.time_offset * 1e9)
    first, last = images.first_ns + offset_ns, images.last_ns + offset_ns
    common = (min(last, imu.last_ns) - max(first, imu.first_ns)) * 1e-9
    delay, imu_delay = images.delay, imu.delay
    apart = delay - imu_delay
    figures = {'common_s': common, 'image_delay_s': delay, 'imu_delay_s': imu_delay}
    if common <= 0.0 or abs(apart + parameters.sensor.time_offset) > max(
            _SAME_CLOCK, 0.5 * images.duration):
        return Finding(name, FAILURE, f'images and IMU are stamped {abs(apart):.3f} s apart',
                       'let both drivers use one clock (ROS time, not time since boot), or set '
                       f'time_offset: {apart:.3f} if the difference is constant', figures)
    return judged(
        name, f'{common:.1f} s in common; recorded {1e3 * delay:.0f} ms (images) and '
        f'{1e3 * imu_delay:.0f} ms (IMU) after their stamps', figures,
        Case(common < 0.8 * images.duration, WARNING, "images outside of the IMU's time are "
             'refused: start the IMU first and stop it last'),
        Case(abs(apart) > _SAME_CLOCK, WARNING,
             'the delays differ: see that both stamp the instant of measuring'))


def _texture(seen: Scan) -> Finding:
    points = seen.turning.points
    if not points:
        return Finding('texture', Verdict.OK, 'not measured: no two consecutive images with their '
                       'CameraInfo')
    median = float(np.median(points))
    poor = float(np.mean(np.array(points) < 30))
    return judged(
        'texture', f'{median:.0f} points tracked from image to image in the median',
        {'median_points': median, 'poor_share': poor},
        Case(median < 15, FAILURE,
             'record a textured scene, in focus, with an exposure below 10 ms'),
        Case(poor > 0.3, WARNING, 'more light, more texture or slower motion',
             f', fewer than 30 in {100 * poor:.0f} %'))


def _aligned(found: Alignment, seen: Scan, parameters: Parameters) -> list[Finding]:
    figures = {'explained': found.explained, 'rate_rad_s': found.rate, 'pairs': found.pairs}
    if found.rate < _LEAST_RATE:
        return [Finding('axes and clock', Verdict.OK, 'not measured: the camera turns by '
                        f'{math.degrees(found.rate):.1f} deg/s only', 'turn it about all axes for '
                        'some seconds', figures)]
    text = f'the gyro explains {100 * found.explained:.0f} % of how the images turn'
    if found.explained < _EXPLAINED:
        return [Finding(
            'axes and clock', FAILURE if found.explained < _DOUBTFUL else WARNING, text,
            'is it the IMU of this camera, are both clocks within 0.25 s, is electronic '
            'stabilisation off and the scene at rest? Then record more turning and less moving',
            figures)]
    both = [Finding('gyro and images', Verdict.OK, text, figures=figures), _scale(found.scale)]
    if both[1].verdict is FAILURE:
        return both
    told = parameters.sensor.offset_at(seen.image_stamps.interval)
    return [*both, _clock(found, parameters, told), _axes(found, seen, parameters)]


def _scale(scale: float) -> Finding:
    return judged(
        'scale', f'images turn {scale:.3f} times as far as the gyro', {'scale': scale},
        Case(not 0.5 < scale < 2.0, FAILURE,
             'correct the unit of the gyro (rad/s) or the focal length of the CameraInfo'),
        Case(abs(scale - 1.0) > _SCALE_LIMIT, WARNING, 'the focal length of the CameraInfo may be '
             'of another resolution, or the gyro off in scale'))


def _clock(found: Alignment, parameters: Parameters, told: float) -> Finding:
    """Offset of the middle row, taken to that of the stamped row where the read-out is known.

    `told` is the offset [s] that the parameters say at the usual interval between the frames.
    """
    name, sensor, sigma = 'time offset', parameters.sensor, found.offset_sigma
    if sensor.readout_time is None:
        return Finding(name, Verdict.OK, f'the middle row is seen {1e3 * found.offset:+.1f} +- '
                       f"{1e3 * sigma:.1f} ms after its stamp by the IMU's clock: time_offset "
                       'plus half the read-out for a stamp of the first row',
                       'give readout_time for a verdict',
                       {'middle_row_s': found.offset, 'sigma_s': sigma})
    rows = {'first': 0.5, 'middle': 0.0, 'last': -0.5}[sensor.stamp_row]
    shift = {'start': 0.5, 'middle': 0.0, 'end': -0.5}[sensor.stamp_exposure]
    down = 1.0 if sensor.readout_direction == 'down' else -1.0
    offset = found.offset - rows * down * sensor.readout_time - shift * sensor.exposure_time
    off = max(abs(offset - told) - 2.0 * sigma, 0.0)
    remedy = (f'set time_offset: {offset:.4f}, or have it measured with "rs_relpose calibrate"; '
              'track_time_offset follows it')
    return judged(
        name, f'{1e3 * offset:+.1f} +- {1e3 * sigma:.1f} ms by images and gyro, time_offset says '
        f'{1e3 * told:+.1f} ms',
        {'middle_row_s': found.offset, 'time_offset_s': offset, 'sigma_s': sigma},
        Case(off > _OFFSET_LIMITS[1], FAILURE, remedy),
        Case(off > _OFFSET_LIMITS[0], WARNING, remedy))


def _axes(found: Alignment, seen: Scan, parameters: Parameters) -> Finding:
    nearest = axes_text(nearest_axis_map(found.R_cam_imu))
    figures = {'nearest': nearest, 'R_cam_imu': found.R_cam_imu.tolist(),
               'balance': found.balance}
    if parameters.sensor.quat_cam_imu_xyzw is None:
        if found.balance < _BALANCED:
            return Finding('axes', WARNING, 'the camera turns about one axis only: the map of '
                           'axes is not known', 'turn it about all three', figures)
        text, force = f'nearest map {nearest}', seen.inertial.force
        if np.isfinite(force).all():
            down = -found.R_cam_imu @ force / np.linalg.norm(force)
            text += f'; gravity is at {_words(down)} of the image'
        return Finding('axes', Verdict.OK, text, 'rs_relpose calibrate finds quat_cam_imu_xyzw',
                       figures)
    difference = np.ascontiguousarray(found.R_cam_imu @ parameters.sensor.R_cam_imu.T)
    apart = math.degrees(float(np.linalg.norm(log_so3(difference))))
    remedy = ('see that quat_cam_imu_xyzw turns IMU vectors into the camera (a static transform '
              'with parent imu holds the inverse), or have it measured with '
              '"rs_relpose calibrate"')
    return judged(
        'axes', f'{apart:.1f} deg between quat_cam_imu_xyzw and images with gyro ({nearest})',
        figures | {'apart_deg': apart},
        Case(found.balance < _BALANCED, Verdict.OK, 'turn it about all three for a verdict',
             ', but the camera turns about one axis only'),
        Case(apart > _AXES_LIMITS[1], FAILURE, remedy),
        Case(apart > _AXES_LIMITS[0], WARNING, remedy))


def _words(down: np.ndarray) -> str:
    """Where a direction of the camera frame points to, in words."""
    axis = int(np.argmax(np.abs(down)))
    names = (('the left', 'the right'), ('the top', 'the bottom'), ('the back', 'the front'))
    return names[axis][int(down[axis] > 0.0)]


def _effect(seen: Scan, parameters: Parameters) -> Finding | None:
    """Displacement of the last against the first row by rotation alone [px]."""
    intrinsics, inertial = seen.intrinsics, seen.inertial
    if intrinsics is None or not len(inertial.rates.values):
        return None
    given, rest = parameters.sensor.readout_time, inertial.rest()
    readout = _EXAMPLE_READOUT if given is None else given
    bias = np.array(parameters.imu.gyro_bias) if rest is None else rest.value
    rates = np.linalg.norm(inertial.rates.values - bias, axis=1)
    median, high = (readout * intrinsics.fx * float(np.percentile(rates, p)) for p in (50, 95))
    figures = {'readout_s': readout, 'given': given is not None, 'median_px': median,
               'p95_px': high}
    name = 'rolling shutter'
    if readout == 0.0:
        return Finding(name, Verdict.OK, 'global shutter (readout_time 0): any method will do',
                       figures=figures)
    assumed = '' if given is not None else ' (assumed; give readout_time)'
    method = ('would do as well' if high < _NO_EFFECT else
              'would not do' if median > _STRONG_EFFECT else 'loses accuracy')
    return Finding(name, Verdict.OK, f'turning moves the last row by {median:.1f} px against the '
                   f'first in the median, {high:.1f} px at 95 %, at a read-out of '
                   f'{1e3 * readout:.1f} ms{assumed}: a global-shutter method {method}',
                   figures=figures)
