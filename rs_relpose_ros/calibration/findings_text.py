"""The text of findings, for logs, messages and JSON: the only place that makes it.

No code reads a text back. What another process needs of a finding, `message_json` writes as codes
and numbers, and `read_message_json` makes the same finding of them, which has the same text.

A new cause needs a function in `_BY_CAUSE`; a new parameter that images and gyro determine needs
an entry in `findings.QUANTITIES` instead, and has the texts of the others.
"""

from collections.abc import Callable, Mapping
import json
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rs_relpose_ros.calibration.findings import (
    Assessment,
    BY_CODE,
    Code,
    COMPARED,
    Evidence,
    Finding,
    FindingState,
    rounded,
    Why,
)
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.timing import clocks_apart, NANOSECONDS
from rs_relpose_ros.imu.buffer import ForceFault

# Longest text [characters] that is read as findings of a message: those of all causes at once
# need a tenth of it. [chosen: 20,000 to 1,000,000 would do; it bounds the work of a reader]
_LONGEST = 100_000
# Rotation of axes [deg] below which the gyro itself may be misaligned. [chosen: data sheets state
# up to a degree]
_MISALIGNED = 1.0
# Difference of the logarithm of a factor within which it is pi / 180. A smaller one would not
# allow for what wrong tracks take from the images' rotation, a larger one would include other
# units. [measured: 0.23 on a walk with a gyro in deg/s, which predicts no point of the tracks]
_ONE_UNIT = 0.4
# Least factor, of which a logarithm is taken. [derived: above zero, and below that of any unit]
_LEAST_FACTOR = 1e-9


class Text(NamedTuple):
    """What a finding says, with units, and the suggested fix; empty if there is nothing to do."""

    message: str
    fix: str = ''

    @property
    def description(self) -> str:
        """Message and suggested fix."""
        return self.message + (f': {self.fix}' if self.fix else '')


def with_sigma(code: Code, values: ArrayLike, sigma: float) -> str:
    """Values of a parameter with their sigma, in the unit of messages."""
    shown = BY_CODE[code].shown
    return f'{_number(code, values)} +- {_number(code, sigma)} {shown.unit}'.rstrip()


def _number(code: Code, values: ArrayLike) -> str:
    """A value, or a list of those of a vector, in the unit of messages but without it."""
    shown = BY_CODE[code].shown
    scaled = shown.factor * np.atleast_1d(values)
    if len(scaled) > 1:
        return str(rounded(scaled, shown.digits))
    return f'{scaled[0]:z.{shown.digits}f}'


# -- the text of a finding by its cause -----------------------------------------------------


def text_of(finding: Finding) -> Text:
    """Message and fix of a finding; KeyError for a cause without a text."""
    write = _BY_CAUSE.get((finding.code, finding.why)) or _BY_WHY[finding.why]
    return write(finding)


def item(finding: Finding) -> str:
    """Code, state and description, as an item of a list."""
    return f'{finding.code.value} {finding.state.value}: {text_of(finding).description}'


def line(finding: Finding) -> str:
    """The same as a line of a log."""
    return f'{finding.code.value} is {finding.state.value}: {text_of(finding).description}'


def one_line(health: Assessment) -> str:
    """All findings in one line."""
    return '; '.join(map(item, health.findings))


def summary_lines(health: Assessment) -> list[str]:
    """A line for each inconsistent parameter, or else one for all parameters."""
    if health.faults:
        return list(map(line, health.faults))
    if not health.findings:
        return ['health: unknown: there was no pair to evaluate']
    observed, unobserved = (
        ', '.join(
            finding.code.value for finding in health.findings if finding.observable is observable
        )
        for observable in (True, False)
    )
    if not unobserved:
        return [f'health: ok ({observed} observed)']
    also = f' ({observed} ok)' if observed else ''
    return [f'health: unknown: {unobserved} not observable in this motion{also}']


def _compared(finding: Finding) -> str:
    """Estimated and active value, in words."""
    assert finding.sigma is not None
    shown = BY_CODE[finding.code].shown
    estimated = with_sigma(finding.code, finding.estimated, finding.sigma)
    active = f'{_number(finding.code, finding.configured)} {shown.unit}'.rstrip()
    return shown.compared.format(estimated, active)


def _off(finding: Finding) -> Text:
    """A parameter that the pairs contradict; the first of its settings is the value to set."""
    settings = finding.settings
    fix = BY_CODE[finding.code].shown.fix.format(*settings.values())
    for name in settings:
        if name.startswith('track_'):
            fix += f', or {name}: true'
    if 'stamp_row' in settings:
        fix += f' (stamp_row: {settings["stamp_row"]} is equivalent)'
    if finding.code is Code.AXES and (finding.estimate or 0.0) < _MISALIGNED:
        fix += ' (a gyro with misaligned axes looks alike)'
    if finding.candidates:
        fix += f' (ambiguous: {" or ".join(code.value for code in finding.candidates)})'
    return Text(
        f'{_compared(finding)} (shifts the pose by {finding.evidence.shift:.1f} sigmas)', fix
    )


def _by_calibration(finding: Finding) -> Text:
    fix = BY_CODE[finding.code].shown.fix.format(*finding.settings.values())
    return Text(f'by a calibration: {_compared(finding)}', fix)


def _other_wrong(finding: Finding) -> Text:
    assert finding.parent is not None
    return Text(f'not evaluated while {finding.parent.value} is wrong')


# Texts that all parameters share.
_BY_WHY: dict[Why, Callable[[Finding], Text]] = {
    Why.CONSISTENT: lambda finding: Text(_compared(finding)),
    Why.NOT_OBSERVABLE: lambda _: Text('not observable in this motion, or too few pairs'),
    Why.OTHER_INCONSISTENT: lambda _: Text(
        'not evaluated while another parameter is inconsistent'
    ),
    Why.OTHER_WRONG: _other_wrong,
    Why.OFF: _off,
    Why.BY_CALIBRATION: _by_calibration,
}


def _other_direction(finding: Finding) -> str:
    return f'set readout_direction: {finding.settings["readout_direction"]}'


def _direction_off(finding: Finding) -> Text:
    assert finding.estimate is not None and finding.sigma is not None
    readout = with_sigma(Code.READOUT_TIME, -finding.estimate, finding.sigma)
    return Text(
        f'rows are read in the opposite direction, in {readout}', _other_direction(finding)
    )


def _direction_by_calibration(finding: Finding) -> Text:
    assert finding.estimate is not None and finding.sigma is not None
    estimated = with_sigma(Code.READOUT_TIME, -finding.estimate, finding.sigma)
    active = f'{_number(Code.READOUT_TIME, finding.configured)} ms'
    return Text(
        f'by a calibration: {COMPARED.format(estimated, active)}, in the opposite direction',
        _other_direction(finding),
    )


# How the image is read, by the direction of the readout.
_READ = {
    'down': 'row by row, the top one first',
    'up': 'row by row, the bottom one first',
    'right': 'column by column, the left one first',
    'left': 'column by column, the right one first',
}


def _by_columns(finding: Finding) -> Text:
    direction = finding.settings['readout_direction']
    row = finding.settings['stamp_row']
    return Text(
        'the images are turned by 90 deg: rows of the sensor are read ' + _READ[direction],
        f'set readout_direction: {direction} and stamp_row: {row}',
    )


def _other_unit(finding: Finding) -> Text:
    factor = finding.estimate
    assert factor is not None
    is_degree = abs(math.log(max(factor, _LEAST_FACTOR) / math.radians(1.0))) < _ONE_UNIT
    fix = (
        'publish rad/s, which is pi / 180 = 0.0175 times deg/s'
        if is_degree
        else 'publish rad/s: verify the unit and the full-scale range of the driver, whose rates '
        f'have to be multiplied by about {factor:.2g}'
    )
    return Text(f'images rotate {factor:.3g} times as far as the gyro', fix)


def _left_handed(finding: Finding) -> Text:
    axis = finding.evidence.measured['axis']
    return Text(
        'the axes of the gyro are left-handed: '
        + (f'wrong sign of {axis}' if axis else 'wrong sign of one or of all axes'),
        'correct the driver (no quat_cam_imu_xyzw corrects a sign)',
    )


def _turned(finding: Finding) -> Text:
    return Text(
        f'rotation axes of the images are {finding.estimate:.0f} deg from those of the gyro by '
        f'quat_cam_imu_xyzw; about {finding.settings["quat_cam_imu_xyzw"]} fits',
        'refine it with "rs_relpose calibrate" (a static transform with parent imu holds the '
        'inverse)',
    )


def _on_their_side(finding: Finding) -> Text:
    return Text(
        f'alternatively, the images are rotated by 90 deg {finding.why.value}',
        'publish them as the sensor provides them, with its CameraInfo, or set quat_cam_imu_xyzw '
        'and readout_direction (right or left) of the rotated images',
    )


def _flipped(finding: Finding) -> Text:
    flip = finding.why.value.replace('_', ' ')
    return Text(
        f'alternatively, the images are {flip}', 'publish them as the sensor provides them'
    )


def _rectified(_: Finding) -> Text:
    return Text(
        'hardly any distortion left in the images: they may be rectified',
        'subscribe to the original images',
    )


def _independent(_: Finding) -> Text:
    return Text(
        'images and gyro rotate independently of each other',
        'verify that the IMU is that of this camera, that both stamp by one clock, and that '
        'electronic stabilisation is off',
    )


def _clocks_apart(finding: Finding) -> Text:
    return Text(
        clocks_apart(finding.evidence.measured['ahead_s']),
        'stamp both by one clock, or set time_offset: '
        f'{finding.settings["time_offset"]:.2f} if they differ by a constant',
    )


def _at_other_time(finding: Finding) -> Text:
    assert finding.active is not None
    if finding.estimate is None:
        return Text(
            'images and gyro rotate alike at another time offset, one of several yet, active '
            f'{finding.active:.2f} s',
            'find it with "rs_relpose calibrate", or turn the camera in several ways',
        )
    return Text(
        f'images and gyro rotate alike at a time offset of about {finding.estimate:.2f} s and no '
        f'other one, active {finding.active:.2f} s',
        f'set time_offset: {finding.settings["time_offset"]:.2f}, and refine it with '
        '"rs_relpose calibrate" or track_time_offset: true',
    )


def _no_specific_force(finding: Finding) -> Text:
    fault = ForceFault(finding.evidence.measured['mean_length_m_s2'])
    return Text(fault.message, fault.fix)


def _scale_of_force(finding: Finding) -> Text:
    length = finding.evidence.measured['mean_length_m_s2']
    return Text(
        f'the accelerometer measures {length:.2f} m/s^2 at rest: true forces are '
        f'{finding.estimate:.3f} times as large, and so are baselines in metres',
        'calibrate the accelerometer (scale, bias) in the driver, or set accel_scale_sigma',
    )


def _with_the_images(finding: Finding) -> str:
    return f'with the images (log-likelihood {finding.evidence.log_likelihood:+.0f})'


def _accelerometer(finding: Finding) -> Text:
    return Text(f'accelerometer consistent {_with_the_images(finding)}')


def _contradicting_accelerometer(finding: Finding) -> Text:
    return Text(
        f'accelerometer inconsistent {_with_the_images(finding)}, not used until both agree',
        'reverse its sign: at rest a specific force of +9.8 m/s^2 points up'
        if finding.why is Why.OPPOSITE
        else 'correct the driver: the axes differ from those of the gyro, or the data are of '
        'another IMU',
    )


def _repeated_images(finding: Finding) -> Text:
    measured = finding.evidence.measured
    return Text(
        f'{measured["repeated"]} of the last {measured["images"]} images repeat the one before '
        'though the camera turns: they are not used',
        'have the driver publish each image once',
    )


def _static_region(finding: Finding) -> Text:
    return Text(
        f'{_extent(finding)} do not move with the scene: this part is masked',
        'if it is a caption, a dirty lens, the hood or the interior of a vehicle, nothing has to '
        'be done; poses come from the rest of the image',
    )


def _interior(finding: Finding) -> Text:
    return Text(
        f'{_extent(finding)} do not move though the camera turns: most of the view moves with the '
        'IMU, as inside a vehicle, and is masked; poses are those of the vehicle, from the rest',
        'let the scene outside fill most of the view: mount the camera at the window, or crop the '
        'images to it with their CameraInfo. Turn the camera by hand: an interior then moves, '
        'what covers the lens does not',
    )


def _extent(finding: Finding) -> str:
    """Share and place of what does not move."""
    measured = finding.evidence.measured
    (left, right), (top, bottom) = measured['columns'], measured['rows']
    return (
        f'{100.0 * measured["share"]:.0f} % of the image (within columns {left} to {right}, rows '
        f'{top} to {bottom})'
    )


def _moving_object(finding: Finding) -> Text:
    share = 100.0 * finding.evidence.measured['share_of_matches']
    return Text(
        f'a moving object fills much of the view: {share:.0f} % of the matches have a second '
        'motion, and images and gyro contradict each other; poses are withheld',
        'point the camera at a scene at rest, or mask what moves with the camera or before it',
    )


def _offset_step(finding: Finding) -> Text:
    step = with_sigma(Code.TIME_OFFSET, finding.estimated, finding.sigma or 0.0)
    measured = finding.evidence.measured
    before, after = (measured[name] / NANOSECONDS for name in ('before_ns', 'after_ns'))
    return Text(
        f'the time offset between camera and IMU stepped by {step} between the images stamped '
        f'{before:.3f} and {after:.3f} s: the poses of this time are withheld, later ones have '
        'the new offset',
        'find out what sets a clock or its stamps while the sensors run, and let both be stamped '
        'by one clock that is never set',
    )


def _offset_drift(finding: Finding) -> Text:
    assert finding.estimate is not None and finding.sigma is not None
    rate = 1e6 * finding.estimate
    sigma = 1e6 * finding.sigma
    return Text(
        f'the time offset between camera and IMU drifts by {rate:.0f} +- {sigma:.0f} ppm: it is '
        'followed from now on',
        'have both sensors stamped by one clock',
    )


def _focal_drift(finding: Finding) -> Text:
    assert finding.estimate is not None and finding.sigma is not None
    rate = 100.0 * finding.estimate
    sigma = 100.0 * finding.sigma
    return Text(
        f'the focal length changes by {rate:.3f} +- {sigma:.3f} % in a second: the lens zooms, or '
        'its focus follows the scene',
        'fix zoom and focus, and calibrate the camera with them',
    )


def _unknown_cause(finding: Finding) -> Text:
    ratio = finding.evidence.measured['chi_square_per_freedom']
    return Text(
        f'pairs contradict each other, whatever parameter is changed (chi-square per degree of '
        f'freedom {ratio:.1f}), and the cause is not known; candidates: stabilisation of lens or '
        'images, vibration or noise of the gyro, an object that fills much of the view, jitter of '
        'the stamps, filters of the IMU that lag',
        'switch stabilisation off; put the running carrier at rest and compare the gyro with '
        'gyro_noise_density; point the camera at a scene that does not move; stamp images at '
        'their exposure',
    )


# What may be wrong where images and gyro do not agree. [derived: text for people]
_UNKNOWN_OF_BOTH = (
    'and the cause is not known; candidates: focal length or lens, stabilisation of lens or '
    'images, images that were resized or squeezed without their CameraInfo, two views side by '
    'side in one image (stereo), vibration, a moving object, clocks'
)
# What to do then. [derived: text for people]
_COMPARE_BOTH = (
    'compare size, lens and focal lengths of the CameraInfo with the images; switch stabilisation '
    'off; run "rs_relpose calibrate"'
)


def _contradicting(finding: Finding) -> Text:
    evidence = finding.evidence
    return Text(
        f'images and gyro contradict each other in {evidence.measured["differing"]} of the last '
        f'{evidence.pairs} pairs, {_UNKNOWN_OF_BOTH}',
        _COMPARE_BOTH,
    )


def _impossible(finding: Finding) -> Text:
    names = ', '.join(finding.evidence.measured['parameters'])
    return Text(
        f'no value of {names} that sensors have makes images and gyro agree, {_UNKNOWN_OF_BOTH}',
        _COMPARE_BOTH,
    )


# What to do about a map of residuals that has a pattern, by its name. [derived: text for people]
_OF_MAP = {
    'cells': 'compare the CameraInfo with the images (cropped, resized, another lens), and mask '
    'what moves with the camera; run "rs_relpose calibrate --lens"',
    'rows_rate': 'verify readout_time and readout_direction: run "rs_relpose calibrate"',
    'time': 'have both sensors stamped by one clock, and fix zoom and focus',
    'halves': 'run "rs_relpose calibrate", and compare its values with the parameters',
}


def _pattern(finding: Finding) -> Text:
    measured = finding.evidence.measured
    candidates = ', '.join(code.value for code in finding.candidates) or 'not known'
    return Text(
        f'residuals have a pattern that no parameter explains (map {measured["map"]}, '
        f'p {measured["p"]:.1g}: {measured["worst"]}); candidates: {candidates}',
        _OF_MAP[measured['map']],
    )


def _noise_of_imu(finding: Finding) -> Text:
    (parameter, value) = next(iter(finding.settings.items()))
    assert finding.estimate is not None and finding.active is not None
    return Text(
        f'it is {finding.estimate:.2g} +- {finding.sigma:.1g} {finding.unit}, configured '
        f'{finding.active:.2g}: vibration, held samples, or a wrong scale; used as it shows',
        f'set {parameter}: {value:g} if it is always so, or mount the IMU softly',
    )


def _jitter(finding: Finding) -> Text:
    assert finding.estimate is not None
    return Text(
        f'images are stamped on arrival, or when a program had time: the stamps scatter by '
        f'{1e3 * finding.estimate:.1f} ms about an even rhythm (jitter), which is in the '
        'covariance of each pose',
        'have the driver stamp images with the time of their exposure, on the clock of the IMU',
    )


def _knock(finding: Finding) -> Text:
    measured = finding.evidence.measured
    return Text(
        f'the specific force jumps by {finding.estimate:.0f} m/s^2 between two samples '
        f'({measured["knocks"]} so far): its effect on the velocity is not known',
        'nothing has to be done if the device was put down or hit',
    )


# Texts of single causes, which come before the texts of `_BY_WHY`.
_BY_CAUSE: dict[tuple[Code, Why], Callable[[Finding], Text]] = {
    (Code.REPEATED_IMAGES, Why.STILL): _repeated_images,
    (Code.STATIC_REGION, Why.STILL): _static_region,
    (Code.INTERIOR, Why.STILL): _interior,
    (Code.MOVING_OBJECT, Why.TWO_MOTIONS): _moving_object,
    (Code.OFFSET_STEP, Why.STEPPED): _offset_step,
    (Code.OFFSET_DRIFT, Why.DRIFTING): _offset_drift,
    (Code.FOCAL_DRIFT, Why.DRIFTING): _focal_drift,
    (Code.UNKNOWN_CAUSE, Why.UNEXPLAINED): _unknown_cause,
    (Code.UNKNOWN_CAUSE, Why.CONTRADICTING): _contradicting,
    (Code.UNKNOWN_CAUSE, Why.IMPOSSIBLE): _impossible,
    (Code.UNKNOWN_CAUSE, Why.RESIDUALS): _pattern,
    (Code.GYRO_NOISE, Why.OFF): _noise_of_imu,
    (Code.ACCEL_NOISE, Why.OFF): _noise_of_imu,
    (Code.STAMP_JITTER, Why.OFF): _jitter,
    (Code.KNOCK, Why.OFF): _knock,
    (Code.READOUT_DIRECTION, Why.OFF): _direction_off,
    (Code.READOUT_DIRECTION, Why.BY_CALIBRATION): _direction_by_calibration,
    (Code.READOUT_DIRECTION, Why.SIDEWAYS): _by_columns,
    (Code.GYRO_UNIT, Why.GROSS): _other_unit,
    (Code.AXES, Why.GROSS): _turned,
    (Code.AXES, Why.LEFT_HANDED): _left_handed,
    (Code.IMAGE_GEOMETRY, Why.CLOCKWISE): _on_their_side,
    (Code.IMAGE_GEOMETRY, Why.COUNTERCLOCKWISE): _on_their_side,
    (Code.IMAGE_GEOMETRY, Why.UPSIDE_DOWN): _flipped,
    (Code.IMAGE_GEOMETRY, Why.MIRRORED): _flipped,
    (Code.IMAGE_GEOMETRY, Why.RECTIFIED): _rectified,
    (Code.IMAGE_GEOMETRY, Why.INDEPENDENT): _independent,
    (Code.TIME_OFFSET, Why.INDEPENDENT): _independent,
    (Code.TIME_OFFSET, Why.CLOCKS_APART): _clocks_apart,
    (Code.TIME_OFFSET, Why.AT_OTHER_TIME): _at_other_time,
    (Code.ACCEL_SCALE, Why.NO_SPECIFIC_FORCE): _no_specific_force,
    (Code.ACCEL_SCALE, Why.OFF): _scale_of_force,
    (Code.ACCEL_AXES, Why.CONSISTENT): _accelerometer,
    (Code.ACCEL_AXES, Why.OPPOSITE): _contradicting_accelerometer,
    (Code.ACCEL_AXES, Why.OFF): _contradicting_accelerometer,
}


# -- JSON: summary.json, `check --json`, and the key `findings` of messages -----------------


def summary_json(health: Assessment) -> dict[str, Any]:
    """The assessment in summary.json."""
    return {
        'state': health.state.value,
        'findings': [
            earlier_keys(finding, text_of(finding)) | new_keys(finding)
            for finding in health.findings
        ],
    }


def earlier_keys(finding: Finding, text: Text) -> dict[str, Any]:
    """The keys of a finding that the second release introduced."""
    return {
        'figure': finding.code.value,
        'told': finding.active,
        'seen': finding.estimate,
        'sigma': finding.sigma,
        'unit': finding.unit,
        'observable': finding.observable,
        'state': finding.state.value,
        'sentence': text.description,
    }


def new_keys(finding: Finding) -> dict[str, Any]:
    """The keys of a finding that the fourth release introduced."""
    evidence = finding.evidence
    return {
        'code': finding.code.value,
        'why': finding.why.value,
        'configured': list(finding.configured),
        'estimated': list(finding.estimated),
        'evidence': {
            'sigmas': evidence.sigmas,
            'shift': evidence.shift,
            'pairs': evidence.pairs,
            'log_likelihood': evidence.log_likelihood,
            'measured': dict(evidence.measured),
        },
        'candidates': [code.value for code in finding.candidates],
        'parent': finding.parent and finding.parent.value,
        'settings': dict(finding.settings),
    }


def message_json(health: Assessment) -> str:
    """Codes and numbers of all findings, for the key `findings` of a message."""
    return json.dumps(
        [
            new_keys(finding)
            | {
                'state': finding.state.value,
                'sigma': finding.sigma,
                'unit': finding.unit,
                'component': finding.component,
            }
            for finding in health.findings
        ],
        separators=(',', ':'),
    )


def read_message_json(text: str) -> Assessment:
    """The findings of a message; InputError if they are malformed or of an unknown cause."""
    try:
        if len(text) > _LONGEST:
            raise ValueError(f'{len(text)} characters')
        health = Assessment(tuple(map(_finding, json.loads(text))))
        one_line(health)  # each has a text
    except (
        ArithmeticError,
        AssertionError,
        AttributeError,
        LookupError,
        RecursionError,
        TypeError,
        ValueError,
    ) as error:
        raise InputError(
            'findings of a message must be those of a relpose_node of this release, got '
            f'{text[:60]!r} ({type(error).__name__})'
        ) from error
    return health


def _finding(values: Mapping[str, Any]) -> Finding:
    evidence = values['evidence']
    return Finding(
        Code(values['code']),
        FindingState(values['state']),
        Why(values['why']),
        tuple(map(float, values['configured'])),
        tuple(map(float, values['estimated'])),
        None if values['sigma'] is None else float(values['sigma']),
        str(values['unit']),
        int(values['component']),
        Evidence(**evidence),
        tuple(map(Code, values['candidates'])),
        None if values['parent'] is None else Code(values['parent']),
        dict(values['settings']),
    )
