"""Verdicts on gyro and accelerometer."""

from __future__ import annotations

import math

import numpy as np

from rs_relpose_ros.check.findings import Finding, Verdict
from rs_relpose_ros.check.inertial import InertialSummary
from rs_relpose_ros.check.judge_images import stamp_finding
from rs_relpose_ros.check.scan import Scan
from rs_relpose_ros.check.streams import StampSummary
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.imu.gravity import STANDARD_GRAVITY

_SLOW = 80.0
# Mean length of the specific force that hand-held motion explains [m/s^2].
_PLAUSIBLE_FORCE = (9.4, 10.8)
# No hand and no drone turns so fast in the median [rad/s]; degrees per second do.
_FASTEST_MEDIAN = 8.0


def findings(seen: Scan, reliability: str, parameters: Parameters) -> list[Finding]:
    """What is said of the IMU by itself."""
    stamps = seen.imu_stamps.summary()
    summary = seen.inertial.summary()
    if not seen.gyro_samples:
        problem = seen.imu_problem or 'all messages mark the gyro as absent'
        return [Finding('gyro', Verdict.FAILURE, f'no gyro: {problem}',
                        'choose the topic that has angular_velocity with --imu-topic')]
    return [_rate(seen, stamps, reliability, parameters),
            stamp_finding('imu stamps', stamps, 'the IMU'), _gyro(summary),
            _bias(summary, parameters), _accelerometer(seen, summary)]


def _rate(seen: Scan, stamps: StampSummary, reliability: str, parameters: Parameters) -> Finding:
    name, gap = 'imu rate', parameters.imu.max_imu_gap
    if not stamps.interval > 0.0:
        return Finding(name, Verdict.FAILURE, f'{stamps.count} message(s), no two of increasing '
                       'stamps', 'record longer, and see what stamps the driver gives')
    gaps, longest = seen.imu_stamps.longer_than(gap)
    figures = {'rate_hz': 1.0 / stamps.interval, 'count': stamps.count, 'gaps': gaps,
               'longest_step_s': longest, 'unusable': seen.bad_imu,
               'reliability': reliability or None}
    text = (f'{1.0 / stamps.interval:.0f} Hz, {stamps.count} in {stamps.duration:.1f} s, longest '
            f'step {1e3 * longest:.1f} ms')
    if reliability:
        text += f', recorded as {reliability}'
    if stamps.interval > gap:
        return Finding(name, Verdict.FAILURE, text, f'steps longer than max_imu_gap = {gap:g} s '
                       'are not interpolated: raise the rate to 100 Hz or more', figures)
    if seen.bad_imu:
        return Finding(name, Verdict.WARNING, f'{text}; {seen.bad_imu} messages cannot be used: '
                       f'{seen.imu_problem}', 'see what the driver publishes there', figures)
    if gaps:
        return Finding(name, Verdict.WARNING, f'{text}; {gaps} gaps above {1e3 * gap:.0f} ms',
                       "frames in a gap are refused: give the IMU's subscription a deeper queue, "
                       'or record on the machine of the driver', figures)
    if 1.0 / stamps.interval < _SLOW:
        return Finding(name, Verdict.WARNING, text, '200 Hz or more follow a hand during one '
                       'read-out', figures)
    return Finding(name, Verdict.OK, text, figures=figures)


def _gyro(summary: InertialSummary) -> Finding:
    rates = np.linalg.norm(summary.rates, axis=1)
    median, high = float(np.median(rates)), float(np.percentile(rates, 95))
    figures = {'median_rad_s': median, 'p95_rad_s': high}
    text = f'median {math.degrees(median):.1f} deg/s, 95 % {math.degrees(high):.1f} deg/s'
    if float(np.ptp(summary.rates, axis=0).max()) == 0.0:
        return Finding('gyro', Verdict.FAILURE, 'all samples are equal', 'the sensor hangs or is '
                       'not read: see its driver', figures)
    if median > _FASTEST_MEDIAN:
        return Finding('gyro', Verdict.FAILURE, f'median {median:.0f} rad/s', 'that is degrees '
                       'per second: sensor_msgs/Imu wants rad/s, so correct the driver', figures)
    return Finding('gyro', Verdict.OK, text, figures=figures)


def _bias(summary: InertialSummary, parameters: Parameters) -> Finding:
    told, sigma = np.array(parameters.imu.gyro_bias), parameters.imu.gyro_bias_sigma
    name = 'gyro bias'
    if summary.rest_bias is None:
        return Finding(name, Verdict.OK, 'not measured: the IMU never stands still here', 'to '
                       'have it measured, let the camera stand still for some seconds',
                       {'at_rest_rad_s': None})
    listed = [round(float(value), 5) for value in summary.rest_bias]
    figures = {'at_rest_rad_s': listed, 'sigma_rad_s': summary.rest_sigma}
    text = (f'mean at rest {listed} rad/s (+- {summary.rest_sigma:.4f})')
    off = float(np.abs(summary.rest_bias - told).max())
    if off > 4.0 * math.hypot(sigma, summary.rest_sigma):
        return Finding(name, Verdict.WARNING, f'{text}, gyro_bias says {list(told)} '
                       f'+- {sigma:g}', f'set gyro_bias: {listed} if the camera did stand still '
                       'there (a slow steady turn looks alike)', figures)
    return Finding(name, Verdict.OK, text, figures=figures)


def _accelerometer(seen: Scan, summary: InertialSummary) -> Finding:
    name, length = 'gravity', summary.force_length
    if not seen.accel_samples:
        own = summary.orientations > 0
        return Finding(name, Verdict.OK if own else Verdict.WARNING, 'no accelerometer'
                       + (', but an orientation' if own else ''),
                       '' if own else 'it works without, but not as well: give the '
                       "accelerometer's topic with --accel-topic (node: remap accel)",
                       {'mean_length_m_s2': None, 'orientations': summary.orientations})
    figures = {'mean_length_m_s2': length, 'mean_m_s2': summary.force.tolist(),
               'orientations': summary.orientations}
    text = f'|acc| {length:.2f} m/s^2 in the mean'
    if summary.orientations:
        text += f', and {summary.orientations} orientations with covariance'
    if abs(length - 1.0) < 0.15:
        return Finding(name, Verdict.FAILURE, text, 'that is in g: sensor_msgs/Imu wants m/s^2, '
                       'so correct the driver, or set use_gravity: false', figures)
    if length < 0.5 * STANDARD_GRAVITY:
        return Finding(name, Verdict.FAILURE, f'{text}: gravity was taken out', 'publish the '
                       'accelerometer as it measures (REP-145), or set use_gravity: false',
                       figures)
    if not _PLAUSIBLE_FORCE[0] <= length <= _PLAUSIBLE_FORCE[1]:
        return Finding(name, Verdict.WARNING, f'{text}, not near 9.81', 'calibrate the '
                       'accelerometer (bias, scale), or set use_gravity: false', figures)
    return Finding(name, Verdict.OK, text, figures=figures)
