"""Verdicts on what images and gyro say together: clocks, figures told, rolling-shutter effect."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
import math

import numpy as np

from rs_relpose_ros.calibrate.axis_maps import axes_text
from rs_relpose_ros.calibrate.result import CalibrationResult, Estimate
from rs_relpose_ros.check.completion import Completion
from rs_relpose_ros.check.findings import (
    Case,
    FAILURE,
    Finding,
    judged,
    UNKNOWN,
    Verdict,
    WARNING,
)
from rs_relpose_ros.check.remeasured import contradicted
from rs_relpose_ros.check.scan import Scan
from rs_relpose_ros.check.trial import MOST_POSED, Trial
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.front_end.frame import sensor_camera
from rs_relpose_ros.health.findings import Finding as Seen
from rs_relpose_ros.health.findings import Health, HealthState, NOT_JUDGED
from rs_relpose_ros.health.judge import FIGURES

# Stamps of the two sensors that differ by more in their delay are of different clocks [s].
_SAME_CLOCK = 0.5
# Matches of a pair in the median that give no estimate, and that are few.
_NO_MATCHES, _FEW_MATCHES = 15, 30
# Read-out that is taken for example where none is known [s].
_EXAMPLE_READOUT = 0.030
# Displacement below the noise of matches, and one that spoils a global-shutter pose [px].
_NO_EFFECT, _STRONG_EFFECT = 1.0, 4.0

# Sigmas from which on a figure is off for certain, whether poses show it or not; and how many
# times the largest sigma of an observable one it may be off before the poses are called wrong.
_CERTAIN, _GROSS = 4.0, 3.0
_LIMITS = {figure.name: _GROSS * figure.observable for figure in FIGURES}
_VERDICTS = {HealthState.OK: Verdict.OK, HealthState.UNKNOWN: UNKNOWN,
             HealthState.SUSPECT: WARNING, HealthState.WRONG: FAILURE}
_MEASURE = 'have it measured with "rs_relpose calibrate"'
# Figures of the read-out, of which one is said.
_READOUT = frozenset(('readout_time', 'readout_direction'))
# Figures by the parameters that tell them.
_TOLD_BY = {'quat_cam_imu_xyzw': 'axes', 'readout_time': 'readout_time'}


def findings(seen: Scan, trial: Trial | None, completion: Completion,
             parameters: Parameters) -> list[Finding]:
    """What is said of both sensors together.

    `trial` is None where `completion` could not find what `parameters` do not tell.
    """
    health = NOT_JUDGED if trial is None else _remeasured(trial, seen, completion)
    found = [_overlap(seen, parameters)]
    if trial is not None:
        found += [_pairs(trial, health), _texture(trial, health)]
    why = completion.problem if trial is None else 'too few pairs of images were estimated'
    missing = {_TOLD_BY[name] for name in parameters.sensor.missing()}
    found += [_not_told(name, completion, seen) for name in sorted(missing)]
    found += [finding for finding in _figures(health, why) if finding.name not in missing]
    effect = _effect(seen, health, completion.parameters)
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


def _pairs(trial: Trial, health: Health) -> Finding:
    """What the front end makes of the recording."""
    pairs, posed = len(trial.matches), trial.poses
    figures = {'images': trial.frames, 'pairs': pairs, 'poses': posed}
    why = next(iter((trial.poseless if pairs else trial.reasons).most_common()),
               'too few images were processed')
    return judged(
        'pairs', f'{pairs} pairs in {trial.frames} images, {posed} with a pose', figures,
        Case(trial.is_refused, FAILURE, 'hardly any image can be used: remove the cause',
             f': {why}'),
        Case(not posed, UNKNOWN, '', f': {why}'),
        Case(posed < MOST_POSED * pairs and health.state is HealthState.WRONG, WARNING,
             'set right what is wrong, below', f'; without: {why}'),
        Case(posed < MOST_POSED * pairs, WARNING, 'move more, beside turning; where the camera '
             'does, a figure is too far off to be seen: have all measured with "rs_relpose '
             'calibrate"', f'; without: {why}'))


def _texture(trial: Trial, health: Health) -> Finding:
    if not trial.matches:
        return Finding('texture', UNKNOWN, 'not measured: there is no pair of images')
    median = float(np.median(trial.matches))
    poor = float(np.mean(np.array(trial.matches) < _FEW_MATCHES))
    few = median < _NO_MATCHES or poor > 0.3
    return judged(
        'texture', f'{median:.0f} matches of a pair in the median',
        {'median_matches': median, 'poor_share': poor},
        Case(few and health.state is HealthState.WRONG, UNKNOWN, 'see again once what is wrong is '
             'right: points are sought where the gyro expects them'),
        Case(median < _NO_MATCHES, FAILURE,
             'record a textured scene, in focus, with an exposure below 10 ms'),
        Case(few, WARNING, 'more light, more texture or slower motion',
             f', fewer than {_FEW_MATCHES} in {100 * poor:.0f} %'))


# -- figures that are told -------------------------------------------------------------------


def _remeasured(trial: Trial, seen: Scan, completion: Completion) -> Health:
    """What the trial found; where it got lost, what a calibration from nothing contradicts."""
    found, health = completion.found, trial.health
    # What no calibration finds: another unit, and axes of which no rotation is seen.
    beyond = any(fault.figure == 'gyro_unit' or (fault.figure == 'axes' and fault.seen is None)
                 for fault in health.faults)
    if found is None or seen.intrinsics is None or beyond or not trial.is_lost:
        return health
    wrong = contradicted(found, completion.parameters.sensor,
                         sensor_camera(seen.intrinsics, completion.parameters))
    if not wrong:
        return health
    named = {finding.figure for finding in wrong}
    if not named.isdisjoint(_READOUT):
        named |= _READOUT
    judged_by_pair = {figure.name for figure in FIGURES}
    why = f'not judged while {wrong[0].figure} is wrong'
    return Health((*wrong, *(
        replace(finding, observable=False, told=None, seen=None, sigma=None,
                state=HealthState.UNKNOWN, sentence=why) if finding.figure in judged_by_pair
        else finding for finding in health.findings if finding.figure not in named)))


def _figures(health: Health, why: str) -> Iterator[Finding]:
    """Each figure, by the trial; `why` none is known where there is none."""
    for seen in health.findings:
        state = _state(seen)
        yield Finding(
            seen.figure, _VERDICTS[state], seen.sentence,
            _MEASURE if state is not seen.state is HealthState.OK else
            'then check again: a figure that is far off hides others'
            if state is HealthState.WRONG else '', replace(seen, state=state).as_json())
    if not health.findings:
        for figure in FIGURES:
            yield _unknown(figure.name, figure.unit, f'not measured: {why}')


def _state(seen: Seen) -> HealthState:
    """That of a figure by itself: a figure that is off is told where no pose suffers, too."""
    if seen.told is None or seen.seen is None or seen.sigma is None:
        return seen.state
    apart = abs(seen.seen - seen.told)
    if apart < _CERTAIN * seen.sigma:
        return seen.state
    if seen.unit == 'deg':
        apart = math.radians(apart)
    elif seen.unit == 'px':
        apart /= seen.told
    figure = 'readout_time' if seen.figure == 'readout_direction' else seen.figure
    if seen.state is HealthState.WRONG or apart > _LIMITS.get(figure, math.inf):
        return HealthState.WRONG
    return HealthState.SUSPECT


def _unknown(name: str, unit: str, text: str, remedy: str = '',
             value: Estimate | None = None) -> Finding:
    """A figure that was not told, or is not known; `value` where it is seen nevertheless."""
    seen, sigma = (None, None) if value is None else (abs(value.value), value.sigma)
    return Finding(name, UNKNOWN, text, remedy, Seen(
        name, None, seen, sigma, unit, value is not None, HealthState.UNKNOWN, text).as_json())


def _not_told(name: str, completion: Completion, seen: Scan) -> Finding:
    """A figure that the node needs, as the calibration sees it."""
    found, remedy = completion.found, _MEASURE
    unit = 's' if name == 'readout_time' else 'deg'
    if found is None:
        return _unknown(name, unit, f'not told, and not found: {completion.problem}', remedy)
    if name == 'axes':
        return _axes_not_told(found, seen, remedy)
    readout = found.readout_time
    if not readout.observable:
        return _unknown(name, unit, f'not told, and not found: {readout.remark}', remedy)
    upwards = ', the last row first' if readout.value < 0.0 else ''
    return _unknown(name, unit, f'not told; {1e3 * abs(readout.value):.1f} +- '
                    f'{1e3 * readout.sigma:.1f} ms is seen{upwards}', remedy, readout)


def _axes_not_told(found: CalibrationResult, seen: Scan, remedy: str) -> Finding:
    if not found.rotation.observable:
        return _unknown('axes', 'deg', f'not told, and not found: {found.rotation.remark}', remedy)
    nearest, force = axes_text(found.axis_map), seen.inertial.force
    text = (f'quat_cam_imu_xyzw is not told; nearest map {nearest}, '
            f'{math.degrees(found.rotation.value):.1f} deg from it')
    if np.isfinite(force).all():
        down = -found.R_cam_imu @ force / np.linalg.norm(force)
        text += f'; gravity is at {_words(down)} of the image'
    return _unknown('axes', 'deg', text, remedy)


def _words(down: np.ndarray) -> str:
    """Where a direction of the camera frame points to, in words."""
    axis = int(np.argmax(np.abs(down)))
    names = (('the left', 'the right'), ('the top', 'the bottom'), ('the back', 'the front'))
    return names[axis][int(down[axis] > 0.0)]


# -- rolling shutter -------------------------------------------------------------------------


def _effect(seen: Scan, health: Health, parameters: Parameters) -> Finding | None:
    """Displacement of the last against the first row by rotation alone [px]."""
    name, intrinsics, inertial = 'rolling shutter', seen.intrinsics, seen.inertial
    if intrinsics is None or not len(inertial.rates.values):
        return None
    told = parameters.sensor.readout_time
    shown = {finding.figure: finding for finding in health.findings}.get('readout_time')
    readout, source, verdict = told, '', Verdict.OK
    faulty = shown is not None and _state(shown) in (HealthState.SUSPECT, HealthState.WRONG)
    if faulty and shown is not None and shown.seen is not None:
        readout, source = shown.seen, ' as seen'
    elif told is None:
        readout, source, verdict = _EXAMPLE_READOUT, ' (assumed; give readout_time)', UNKNOWN
    elif told == 0.0:
        sure = shown is not None and shown.state is HealthState.OK
        return Finding(name, Verdict.OK if sure else UNKNOWN, 'global shutter (readout_time 0)' + (
            ': any method will do' if sure else ', which this recording does not confirm'),
            figures={'readout_s': 0.0})
    assert readout is not None
    rest = inertial.rest()
    bias = np.array(parameters.imu.gyro_bias) if rest is None else rest.value
    rates = np.linalg.norm(inertial.rates.values - bias, axis=1)
    median, high = (readout * intrinsics.fx * float(np.percentile(rates, p)) for p in (50, 95))
    method = ('would do as well' if high < _NO_EFFECT else
              'would not do' if median > _STRONG_EFFECT else 'loses accuracy')
    return Finding(name, verdict, f'turning moves the last row by {median:.1f} px against the '
                   f'first in the median, {high:.1f} px at 95 %, at a read-out of '
                   f'{1e3 * readout:.1f} ms{source}: a global-shutter method {method}',
                   figures={'readout_s': readout, 'median_px': median, 'p95_px': high})
