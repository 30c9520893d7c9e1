"""Verdicts on gyro and accelerometer."""

from __future__ import annotations

import math

import numpy as np

from rs_relpose_ros.check.findings import Case, FAILURE, Finding, judged, UNKNOWN, Verdict, WARNING
from rs_relpose_ros.check.inertial import Inertial
from rs_relpose_ros.check.judge_images import stamp_finding
from rs_relpose_ros.check.scan import Scan
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.geometry.vectors import STANDARD_GRAVITY
from rs_relpose_ros.messages.sensor_feed import Role

_SLOW = 80.0
# Mean length of the specific force that hand-held motion explains [m/s^2].
_PLAUSIBLE_FORCE = (9.4, 10.8)
# No hand and no drone turns so fast in the median [rad/s]; degrees per second do.
_FASTEST_MEDIAN = 8.0


def findings(seen: Scan, reliability: str, parameters: Parameters) -> list[Finding]:
    """What is said of the IMU by itself."""
    if not len(seen.inertial.rates.values):
        problem = seen.problems.get(Role.IMU, 'all messages mark the gyro as absent')
        return [Finding('gyro', FAILURE, f'no gyro: {problem}',
                        'choose the topic that has angular_velocity with --imu-topic')]
    return [_rate(seen, reliability, parameters),
            stamp_finding('imu stamps', seen.imu_stamps, 'the IMU'), _gyro(seen.inertial),
            _bias(seen.inertial, parameters), _accelerometer(seen.inertial)]


def _rate(seen: Scan, reliability: str, parameters: Parameters) -> Finding:
    name, stamps, gap = 'imu rate', seen.imu_stamps, parameters.imu.max_imu_gap
    interval = stamps.interval
    if not interval > 0.0:
        return Finding(name, FAILURE, f'{stamps.count} message(s), no two of increasing stamps',
                       'record longer, and see what stamps the driver gives')
    gaps, longest = stamps.longer_than(gap)
    figures = {'rate_hz': 1.0 / interval, 'count': stamps.count, 'gaps': gaps,
               'longest_step_s': longest, 'unusable': seen.bad_imu,
               'reliability': reliability or None}
    text = (f'{1.0 / interval:.0f} Hz, {stamps.count} in {stamps.duration:.1f} s, longest '
            f'step {1e3 * longest:.1f} ms')
    if reliability:
        text += f', recorded as {reliability}'
    return judged(
        name, text, figures,
        Case(interval > gap, FAILURE, f'steps longer than max_imu_gap = {gap:g} s are not '
             'interpolated: raise the rate to 100 Hz or more'),
        Case(seen.bad_imu > 0, WARNING, 'see what the driver publishes there',
             f'; {seen.bad_imu} messages cannot be used: {seen.problems.get(Role.IMU)}'),
        Case(gaps > 0, WARNING, "frames in a gap are refused: give the IMU's subscription a "
             'deeper queue, or record on the machine of the driver',
             f'; {gaps} gaps above {1e3 * gap:.0f} ms'),
        Case(1.0 / interval < _SLOW, WARNING, '200 Hz or more follow a hand during one read-out'))


def _gyro(inertial: Inertial) -> Finding:
    name, rates = 'gyro', np.linalg.norm(inertial.rates.values, axis=1)
    median, high = float(np.median(rates)), float(np.percentile(rates, 95))
    figures = {'median_rad_s': median, 'p95_rad_s': high}
    if float(np.ptp(inertial.rates.values, axis=0).max()) == 0.0:
        return Finding(name, FAILURE, 'all samples are equal',
                       'the sensor hangs or is not read: see its driver', figures)
    if median > _FASTEST_MEDIAN:
        return Finding(name, FAILURE, f'median {median:.0f} rad/s', 'that is degrees per second: '
                       'sensor_msgs/Imu wants rad/s, so correct the driver', figures)
    return Finding(name, Verdict.OK, f'median {math.degrees(median):.1f} deg/s, 95 % '
                   f'{math.degrees(high):.1f} deg/s', figures=figures)


def _bias(inertial: Inertial, parameters: Parameters) -> Finding:
    told, sigma = parameters.imu.gyro_bias, parameters.imu.gyro_bias_sigma
    name, rest = 'gyro at rest', inertial.rest()
    if rest is None:
        return Finding(name, UNKNOWN, 'not measured: the IMU never stands still here', 'to '
                       'have it measured, let the camera stand still for some seconds',
                       {'at_rest_rad_s': None})
    listed = [round(float(value), 5) for value in rest.value]
    off = float(np.abs(rest.value - np.array(told)).max())
    return judged(
        name, f'mean at rest {listed} rad/s (+- {rest.sigma:.4f})',
        {'at_rest_rad_s': listed, 'sigma_rad_s': rest.sigma},
        Case(off > 4.0 * math.hypot(sigma, rest.sigma), WARNING, f'set gyro_bias: {listed} if the '
             'camera did stand still there (a slow steady turn looks alike)',
             f', gyro_bias says {list(np.array(told))} +- {sigma:g}'))


def _accelerometer(inertial: Inertial) -> Finding:
    name, length = 'gravity', inertial.force_length
    if not inertial.forces:
        return judged(
            name, 'no accelerometer', {'mean_length_m_s2': None,
                                       'orientations': inertial.orientations},
            Case(inertial.orientations > 0, Verdict.OK, '', ', but an orientation'),
            Case(True, WARNING, 'it works without, but not as well: give the '
                 "accelerometer's topic with --accel-topic (node: remap accel)"))
    figures = {'mean_length_m_s2': length, 'mean_m_s2': inertial.force.tolist(),
               'orientations': inertial.orientations}
    text = f'|acc| {length:.2f} m/s^2 in the mean'
    if inertial.orientations:
        text += f', and {inertial.orientations} orientations with covariance'
    return judged(
        name, text, figures,
        Case(abs(length - 1.0) < 0.15, FAILURE, 'that is in g: sensor_msgs/Imu wants m/s^2, so '
             'correct the driver, or set use_gravity: false'),
        Case(length < 0.5 * STANDARD_GRAVITY, FAILURE, 'publish the accelerometer as it measures '
             '(REP-145), or set use_gravity: false', ': gravity was taken out'),
        Case(not _PLAUSIBLE_FORCE[0] <= length <= _PLAUSIBLE_FORCE[1], WARNING, 'calibrate the '
             'accelerometer (bias, scale), or set use_gravity: false', ', not near 9.81'))
