"""From what was seen to findings: which figure is off, by how much, does it matter, what to do.

A deviation is *suspect* where it is certain (more than `_CERTAIN` sigmas) and moves the pose by a
sigma of a pose that is told right, *wrong* where it moves the pose out of its covariance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.config.parameters import SensorConfig
from rs_relpose_ros.estimator.information import inverse, log_determinant
from rs_relpose_ros.geometry.camera import REFERENCE_ROWS, RollingShutterCamera
from rs_relpose_ros.geometry.so3 import exp_so3
from rs_relpose_ros.health.deviation import (
    AXES,
    BIAS,
    DEVIATIONS,
    DISTORTION,
    FOCAL,
    LARGEST_OFFSET,
    LARGEST_READOUT,
    OFFSET,
    READOUT,
    SCALE,
)
from rs_relpose_ros.health.findings import Finding, Health, HealthState
from rs_relpose_ros.health.recursion import Calibration, PRIOR_INFORMATION, PRIOR_SIGMA
from rs_relpose_ros.health.turning import TurnComparison

Array = NDArray[np.float64]

# Sigmas from which on a deviation is certain.
_CERTAIN = 4.0
# Shift of the pose in its own sigmas (Mahalanobis) that matters, and that leaves its covariance.
_MATTERS, _OUTSIDE = 1.0, 3.0
# Axes and unit are said to be wrong where this leaves less than this share of the images' turning.
_EXPLAINED_AT_BEST = 0.5
# Images over gyro beyond which only another unit explains the scale (deg/s: 0.017).
_UNIT_FACTOR = 5.0
# Turning of the gyro [rad] after which images must agree, and the share that they then must
# explain.
_LONG_TURN, _INDEPENDENT = 2.0, 0.85
# Rotations within this [rad] of half a turn about an axis of the image also are flipped images.
_HALF_TURN = 0.6
# Quantile of the pairs' shifts that says whether a deviation matters: quiet ones hide it.
_SEEN_IN = 0.9
# Sigmas of a figure that was told with one, within which it is as told.
_AS_TOLD = 3.0
# Gain in chi-square beyond which there is no doubt.
_LARGEST_GAIN = 100.0
# Figures that are asked for at most: traces of a gross one need some, too.
_MOST_CAUSES = 4
# Chi-square by which a second figure may explain less, and still fits as well.
_AS_GOOD = 4.0
# Part of the told distortion that rectified images have at most.
_LITTLE_OF = 0.25
# Deviations that move the pose by less than this share of the largest one's shift are not judged:
# a gross one leaves traces in all.
_TRACE = 0.34


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """What the pairs were estimated with."""

    sensor: SensorConfig
    camera: RollingShutterCamera
    gyro_bias: Array   # (3,) parameter [rad/s]
    gyro_bias_sigma: float
    in_force: Array   # (11,) deviations that were applied already: tracked figures, bias at rest

    @property
    def direction(self) -> float:
        """1 where row 0 is told to be read first, -1 where it is the last."""
        return 1.0 if self.sensor.readout_direction == 'down' else -1.0


class Effect(NamedTuple):
    """What deviations do to a pair's pose, or to its rotation where it has no more."""

    shift: Array   # (5 or 3, 11) in sigmas of a pose that is told right
    # (6 or 3, 11) in those that were claimed, which may hold the disagreement
    claimed_shift: Array


class Figure(NamedTuple):
    """A figure that is seen through deviations."""

    name: str
    part: slice
    observable: float   # largest sigma, in units of the deviation
    unit: str


FIGURES = (
    Figure('axes', AXES, math.radians(1.0), 'deg'),
    Figure('time_offset', slice(OFFSET, OFFSET + 1), 4e-3, 's'),
    Figure('readout_time', slice(READOUT, READOUT + 1), 5e-3, 's'),
    Figure('gyro_bias', BIAS, 0.01, 'rad/s'),
    Figure('gyro_scale', slice(SCALE, SCALE + 1), 0.03, ''),
    Figure('focal_length', slice(FOCAL, FOCAL + 1), 0.04, 'px'),
    Figure('distortion', slice(DISTORTION, DISTORTION + 1), 0.05, ''),
)

# Deviations of each figure, and the log-determinant of what is known of them before.
_PRIORS = tuple((figure.part, -2.0 * float(np.log(PRIOR_SIGMA[figure.part]).sum()))
                for figure in FIGURES)


class Cause(NamedTuple):
    """A figure whose deviation explains what the pairs show."""

    figure: Figure
    deviation: Array   # (11,) from what is in force; of the figure alone
    sigma: Array   # (11,)
    certainty: float   # in sigmas
    # Of the pose, Mahalanobis: in sigmas of one that is told right, of the pairs that it moves
    # most, and in those claimed, in the median.
    shift: float
    claimed_shift: float
    rival: Cause | None = None   # that explains the pairs as well, instead

    def matters(self, told: Told) -> bool:
        """Whether it moves the pose by its sigma, beyond what was told with a sigma."""
        beyond = np.abs(self.deviation[BIAS]) > _AS_TOLD * told.gyro_bias_sigma
        return self.shift > _MATTERS and (self.figure.part != BIAS or bool(beyond.any()))


def causes(seen: Calibration, effects: Sequence[Effect], in_force: Array) -> list[Cause]:
    """The fewest figures that explain the pairs, by forward selection; the strongest first.

    All figures at once would share a deviation of one among each other where few pairs tell them
    apart. A figure alone gains ``b_k^T S_kk^-1 b_k`` in chi-square; the one that gains most is
    taken for the cause, and the others are asked about what it leaves. Where that is not certain,
    a figure is a cause that is certain beside all others. One that explains as much as a single
    cause is its rival.
    """
    if not seen.pairs:
        return []
    found: list[tuple[Figure, float]] = []
    rival: tuple[Figure, float] | None = None
    together = sigma = np.zeros(DEVIATIONS)
    taken = np.zeros(DEVIATIONS, dtype=bool)
    while len(found) < _MOST_CAUSES:
        left = seen.b - seen.S @ (in_force + together)
        alone = sorted(((figure, _alone(figure, seen, left, taken)) for figure in FIGURES
                        if not taken[figure.part].any()), key=lambda item: -item[1])
        figure, certainty = alone[0]
        if certainty < _CERTAIN:
            figure, certainty = max(
                ((figure, _beside_all(figure, seen, in_force)) for figure, _ in alone),
                key=lambda item: item[1])
        elif not found and certainty**2 - alone[1][1]**2 < _AS_GOOD:
            rival = alone[1]
        if certainty < _CERTAIN:
            break
        found.append((figure, certainty))
        taken[figure.part] = True
        together, sigma = _solved(seen, taken, in_force)
    explained = [_cause(figure, together, sigma, certainty, effects)
                 for figure, certainty in found]
    if rival is not None and len(found) == 1:
        instead = np.zeros(DEVIATIONS, dtype=bool)
        instead[rival[0].part] = True
        explained[0] = explained[0]._replace(rival=_cause(
            rival[0], *_solved(seen, instead, in_force), rival[1], effects))
    return explained


def undetermined(seen: Calibration, in_force: Array) -> Array:
    """Second moment (11, 11) of what may be off, by the odds that anything is.

    Before the first pair these are even, and each figure as likely. Pairs where told and seen
    agree lower a figure's odds as they lower its sigma, against its prior P; others raise them
    (Bayes factor; Kass and Raftery, JASA 1995)::

        odds_k = (|Sigma_k| / |P_k|)^1/2 exp(b_k^T Sigma_k b_k / 2),  Sigma_k = (S_kk + P_k^-1)^-1
    """
    odds = 0.0
    posterior = seen.S / seen.scatter + PRIOR_INFORMATION
    left = (seen.b - seen.S @ in_force) / seen.scatter
    for part, of_prior in _PRIORS:
        information = np.ascontiguousarray(posterior[part, part])
        gain = min(float(left[part] @ inverse(information) @ left[part]), _LARGEST_GAIN)
        odds += math.exp(0.5 * (of_prior - log_determinant(information) + gain)) / len(FIGURES)
    off = seen.c - in_force
    return (seen.undetermined + off[:, None] * off) * odds / (1.0 + odds)


def _solved(seen: Calibration, taken: NDArray[np.bool_], in_force: Array) -> tuple[Array, Array]:
    """Deviations (11,) from what is in force where only those `taken` are off; 1 sigma each."""
    together, sigma = np.zeros(DEVIATIONS), np.zeros(DEVIATIONS)
    covariance = inverse(seen.S[np.ix_(taken, taken)])
    together[taken] = covariance @ (seen.b - seen.S @ in_force)[taken]
    sigma[taken] = np.sqrt(seen.misfit * np.diag(covariance))
    return together, sigma


def _beside_all(figure: Figure, seen: Calibration, in_force: Array) -> float:
    """Sigmas by which a figure is off when all are free."""
    part = figure.part
    return float((np.abs(seen.c - in_force)[part] / seen.sigma[part]).max())


def _alone(figure: Figure, seen: Calibration, left: Array, taken: NDArray[np.bool_]) -> float:
    """Sigmas by which a figure is off when, beside those that are taken, it is off alone."""
    part = figure.part
    S = seen.S[part, part] + PRIOR_INFORMATION[part, part]
    if taken.any():
        cross = seen.S[part][:, taken]
        S = S - cross @ inverse(seen.S[np.ix_(taken, taken)]) @ cross.T
    of_part = left[part] / S[0] if len(S) == 1 else np.linalg.solve(S, left[part])
    gain = float(left[part] @ of_part) / seen.misfit
    # A vector gains more by chance.
    return math.sqrt(max(gain - 2.0 * (part.stop - part.start - 1), 0.0))


def _cause(figure: Figure, together: Array, sigma: Array, certainty: float,
           effects: Sequence[Effect]) -> Cause:
    deviation = np.zeros(DEVIATIONS)
    deviation[figure.part] = together[figure.part]
    return Cause(figure, deviation, sigma, certainty,
                 _length([effect.shift @ deviation for effect in effects], _SEEN_IN),
                 _length([effect.claimed_shift @ deviation for effect in effects], 0.5))


def judged(seen: Calibration, explained: list[Cause], turned: TurnComparison | None,
           told: Told) -> Health:
    """Findings on all figures; `explained`: the `causes` of what the pairs show."""
    gross = tuple(_gross(turned, told))
    if gross:
        # Poses of wrong axes or units say nothing of the other figures.
        named = {finding.figure for finding in gross}
        why = f'not judged while {gross[0].figure} is wrong'
        return Health(gross + tuple(_unknown(figure, why) for figure in FIGURES
                                    if figure.name not in named))
    largest = max((cause.shift for cause in explained), default=0.0)
    faults = {cause.figure.name: cause for cause in explained
              if cause.matters(told) and cause.shift > _TRACE * largest}
    faults |= {cause.rival.figure.name: cause.rival for cause in faults.values()
               if cause.rival is not None}
    rivals = ' or '.join(faults) if any(cause.rival for cause in faults.values()) else ''
    found: list[Finding] = []
    for figure in FIGURES:
        if figure.name in faults:
            found += _fault_of(faults[figure.name], told, rivals)
        elif float(seen.sigma[figure.part].max()) > figure.observable:
            found.append(_unknown(figure, 'this motion does not show it, or too few pairs came'))
        elif faults:
            found.append(_unknown(figure, 'not judged while another figure is off'))
        else:
            described = _described(figure, (seen.c - told.in_force)[figure.part],
                                   seen.sigma[figure.part], told)
            found.append(Finding(figure.name, described.told, described.seen, described.sigma,
                                 figure.unit, True, HealthState.OK, described.text))
    return Health(tuple(found))


def _length(shifts: list[Array], quantile: float) -> float:
    return float(np.quantile([np.linalg.norm(s) for s in shifts], quantile)) if shifts else 0.0


# -- figures one by one ----------------------------------------------------------------------


def _fault_of(cause: Cause, told: Told, rivals: str) -> Iterator[Finding]:
    """Findings on a figure that is off by enough to matter; `rivals`: that fit as well, if any."""
    figure = cause.figure
    sure = cause.claimed_shift * (1.0 - 2.0 / cause.certainty)
    state = HealthState.WRONG if sure > _OUTSIDE else HealthState.SUSPECT
    described = _described(figure, cause.deviation[figure.part], cause.sigma[figure.part], told)
    if figure.name == 'readout_time' and described.seen < 0.0:
        other = 'up' if told.sensor.readout_direction == 'down' else 'down'
        yield Finding('readout_direction', described.told, described.seen, described.sigma, 's',
                      True, state, f'rows are read the other way, in {-1e3 * described.seen:.1f} '
                      f'+- {1e3 * described.sigma:.1f} ms: set readout_direction: {other}')
        return
    yield Finding(figure.name, described.told, described.seen, described.sigma, figure.unit, True,
                  state, f'{described.text} (moves the pose by {cause.shift:.1f} of its sigmas): '
                  f'{_remedy(figure, cause.deviation[figure.part], described, told)}'
                  + (f' ({rivals}: both fit as well)' if rivals else ''))
    if figure.name == 'time_offset':
        yield from _another_row(cause, state, told)
    if figure.name == 'distortion' and described.told and (
            abs(described.seen) < _LITTLE_OF * abs(described.told)):
        yield _fault('image_geometry', state, 'the images have hardly any distortion left: are '
                     'they rectified? subscribe to the raw ones, whose rows have one instant each')


def _another_row(cause: Cause, state: HealthState, told: Told) -> Iterator[Finding]:
    """Another stamped row, where it makes the same offset."""
    camera, deviation = told.camera, cause.deviation[OFFSET]
    for name in REFERENCE_ROWS:
        row = replace(camera, reference_row=name).reference_row_index
        makes = (camera.reference_row_index - row) * camera.line_delay
        if name != camera.reference_row and abs(deviation - makes) < 2.0 * cause.sigma[OFFSET]:
            yield _fault('stamp_row', state, f'the stamps may mark the {name} row instead, which '
                         f'makes the same offset: set stamp_row: {name}')


class _Described(NamedTuple):
    """A figure in its own unit and words."""

    told: float
    seen: float
    sigma: float
    text: str   # told and seen


def _described(figure: Figure, left: Array, sigmas: Array, told: Told) -> _Described:
    """Value told and seen, in the figure's own unit; of a vector the most certain component."""
    sensor, camera, force = told.sensor, told.camera, told.in_force
    worst = int(np.argmax(np.abs(left) / sigmas))
    deviation, sigma = float(left[worst]), float(sigmas[worst])
    if figure.name == 'axes':
        angle, spread = math.degrees(float(np.linalg.norm(left))), math.degrees(sigma)
        return _Described(0.0, angle, spread, f'the IMU is turned by {angle:.2f} +- {spread:.2f} '
                          'deg against quat_cam_imu_xyzw')
    if figure.name == 'gyro_bias':
        before = told.gyro_bias + force[BIAS]
        now = before + left
        return _Described(float(before[worst]), float(now[worst]), sigma,
                          f'{_listed(now)} +- {sigma:.5f} rad/s is seen, {_listed(before)} in '
                          'force')
    if figure.name == 'time_offset':
        return _in_ms(sensor.time_offset + float(force[OFFSET]), deviation, sigma)
    if figure.name == 'readout_time':
        # Signed: the deviation is that of the signed read-out.
        return _in_ms(camera.readout_time, told.direction * deviation, sigma)
    if figure.name == 'gyro_scale':
        return _Described(1.0, 1.0 + deviation, sigma, f'the gyro must be multiplied by '
                          f'{1.0 + deviation:.3f} +- {sigma:.3f}')
    if figure.name == 'focal_length':
        seen = camera.fx / (1.0 + deviation)
        return _Described(camera.fx, seen, sigma * seen, f'{seen:.1f} +- {sigma * seen:.1f} px is '
                          f'seen, {camera.fx:.1f} px in force')
    first = camera.distortion[0] if camera.distortion else 0.0
    return _Described(first, first + deviation, sigma, f'the first coefficient is seen as '
                      f'{first + deviation:+z.3f} +- {sigma:.3f}, {first:+z.3f} in force')


def _in_ms(told: float, deviation: float, sigma: float) -> _Described:
    seen = told + deviation
    return _Described(told, seen, sigma, f'{1e3 * seen:z.1f} +- {1e3 * sigma:.1f} ms is seen, '
                      f'{1e3 * told:z.1f} ms in force')


def _listed(values: Array, digits: int = 5) -> list[float]:
    # Plus zero: a value that is rounded to -0.0 is no other than 0.0.
    return [round(float(value), digits) + 0.0 for value in values]


def _remedy(figure: Figure, left: Array, described: _Described, told: Told) -> str:
    """What to do about a figure that is off."""
    seen, sensor = described.seen, told.sensor
    if figure.name == 'axes':
        xyzw = Rotation.from_matrix(exp_so3(left) @ told.sensor.R_cam_imu).as_quat()
        return f'set quat_cam_imu_xyzw: {_listed(xyzw)}'
    if figure.name == 'gyro_bias':
        return (f'set gyro_bias: {_listed(told.gyro_bias + told.in_force[BIAS] + left)}, and let '
                'the camera stand still at the start')
    return {
        'time_offset': f'set time_offset: {seen:z.4f}' + (
            ', or track_time_offset: true' if not sensor.track_time_offset
            and abs(seen - sensor.time_offset) < LARGEST_OFFSET else ''),
        'readout_time': f'set readout_time: {seen:.4f}' + (
            ', or track_readout_time: true' if not sensor.track_readout_time
            and abs(seen - (sensor.readout_time or 0.0)) < LARGEST_READOUT else ''),
        'gyro_scale': 'calibrate the gyro, or correct its driver',
        'focal_length': 'calibrate the camera at this resolution and focus',
        'distortion': 'calibrate the lens'}[figure.name]


def _fault(figure: str, state: HealthState, sentence: str, told: float | None = None,
           seen: float | None = None, unit: str = '') -> Finding:
    return Finding(figure, told, seen, None, unit, True, state, sentence)


def _unknown(figure: Figure, why: str) -> Finding:
    return Finding(figure.name, None, None, None, figure.unit, False, HealthState.UNKNOWN, why)


# -- gross errors ----------------------------------------------------------------------------


def _gross(turned: TurnComparison | None, told: Told) -> Iterator[Finding]:
    """Axes, unit and flips, from the turning of images and gyro."""
    if turned is None:
        return
    wrong, explained = HealthState.WRONG, min(turned.left_at_best, turned.left_mirrored)
    if explained < _EXPLAINED_AT_BEST:
        if turned.scale * _UNIT_FACTOR < 1.0 or turned.scale > _UNIT_FACTOR:
            yield _fault('gyro_unit', wrong, f'images turn {turned.scale:.3g} times as far as the '
                         'gyro: it must be in rad/s, which is pi / 180 = 0.0175 times deg/s',
                         1.0, turned.scale)
        if turned.is_left_handed or turned.is_turned:
            yield from _turned_axes(turned, told)
    elif turned.by_gyro > _LONG_TURN and min(explained, turned.left_of_all) > _INDEPENDENT:
        # Of a steady turn nothing but noise is left once the constant rate is taken out.
        text = ('images and gyro turn independently of each other: is it the IMU of this camera, '
                'do both stamp by one clock, is electronic stabilisation off?')
        yield _fault('image_geometry', wrong, text)
        yield _fault('time_offset', wrong, text)


def _turned_axes(turned: TurnComparison, told: Told) -> Iterator[Finding]:
    wrong = HealthState.WRONG
    if turned.is_left_handed:
        # In the IMU's own axes one sign is all that is wrong, as a rule.
        R_cam_imu = told.sensor.R_cam_imu
        signs = np.diag(R_cam_imu.T @ turned.reflection @ R_cam_imu)
        axis = 'xyz'[int(np.argmin(signs))] if sorted(signs)[1] > 0.7 > -0.7 > min(signs) else ''
        yield _fault('axes', wrong, 'the axes of the gyro are left-handed: ' + (
            f'its {axis} has' if axis else 'one or all of them have') + ' the wrong sign, which '
            'no quat_cam_imu_xyzw sets right: correct the driver')
        return
    angle, Q = turned.angle, turned.rotation
    xyzw = _listed(Rotation.from_matrix(Q @ told.sensor.R_cam_imu).as_quat(), 3)
    yield _fault('axes', wrong, f'images turn about axes that are {math.degrees(angle):.0f} deg '
                 f'from those of the gyro by quat_cam_imu_xyzw: about {xyzw} fits, which '
                 '"rs_relpose calibrate" refines (a static transform with parent imu holds the '
                 'inverse)', 0.0, math.degrees(angle), 'deg')
    if abs(angle - math.pi) < _HALF_TURN:
        axis = np.abs(np.linalg.eigh(Q + Q.T)[1][:, -1])
        if float(axis.max()) > math.cos(_HALF_TURN):
            how = 'upside down' if axis[2] == axis.max() else 'mirrored'
            yield _fault('image_geometry', wrong, f'the images may be {how} instead: publish them '
                         'as the sensor gives them')
