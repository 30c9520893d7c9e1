"""Result of a calibration: values and sigmas, as report, parameter file, JSON and picture."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_ros.calibration.findings import Code
from rs_relpose_ros.calibration.findings_text import with_sigma
from rs_relpose_ros.calibration.observations import AXES, axes_text
from rs_relpose_ros.config.files import parameter_text, SourcedValue
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import readout_direction, RollingShutterCamera
from rs_relpose_ros.output_files import BLUE, ORANGE, save_picture


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value with its 1 sigma, in the unit of the field.

    If it is not observable, it is too uncertain for accurate poses, and `remark` is the reason.
    """

    value: float
    sigma: float
    observable: bool
    remark: str = ''
    determined: bool = True  # whether the value means anything


class LensEstimates(NamedTuple):
    """A lens that was not known."""

    focal_factor: Estimate  # true over assumed focal length
    radial: tuple[Estimate, ...]  # coefficients k1, k2, k3 of the distortion
    column: Estimate  # principal point [px]
    row: Estimate
    coefficients: tuple[float, ...]  # all of the distortion, in the order of CameraInfo
    displacement: Estimate  # of the image's corner by k1, k2, k3, over its radius
    radial_sigma: float  # of k1 that alone displaces as much as the sigmas of all three


class StepOfOffset(NamedTuple):
    """A clock was set: the offset changes between two times [s] after the first image."""

    begin: float
    end: float
    change: Estimate  # [s]


class OffsetChanges(NamedTuple):
    """How the time offset changes within the recording."""

    steps: tuple[StepOfOffset, ...]  # in the order of time
    drift: Estimate | None  # [s/s]
    at: float  # time [s] after the first image to which `time_offset` refers
    # Offset of row 0 [s] before the first step and after each, or in the middle.
    offsets: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """Calibration of a rolling-shutter camera against a gyro.

    ``t_imu(row v) = stamp + time_offset + v / row_count * readout_time``: a negative readout time
    is read upwards (or leftwards), with `time_offset` still that of row 0.
    """

    readout_time: Estimate  # signed [s]
    readout_axis: int  # pixel coordinate that is the row: 1 (v), or 0 (u) for turned images
    fitted_readout: float  # without its bound, the frame interval [s]
    time_offset: Estimate  # of row 0 [s], at the median interval between frames
    R_cam_imu: Array  # (3, 3) v_cam = R_cam_imu v_imu
    rotation_sigma: Array  # (3,) 1 sigma about the camera's axes [rad]
    rotation: Estimate  # angle to `axis_map` [rad], with the largest sigma
    axis_map: Array  # (3, 3) the nearest rotation between axes
    gyro_bias: tuple[Estimate, ...]  # of the three axes of the IMU [rad/s]
    lens: LensEstimates | None  # None if known
    exposure: Estimate  # at the median interval between frames [s]
    exposure_margin: float  # that interval less the exposure, if it follows it
    # Change of the offset by the interval between frames [s/s], as by automatic exposure; None if
    # the intervals do not vary like that.
    offset_by_interval: Estimate | None
    # Change of the offset by how early a stamp is against a smooth line [s/s], 1 if only the
    # stamps jitter; None if they do not.
    offset_by_jitter: Estimate | None
    stamp_jitter: float  # rms about the smooth line [s]
    offset_changes: OffsetChanges | None  # None if one offset holds for all of the recording
    rotation_rates: Array  # (3,) rms about the camera's axes less mean [rad/s]
    # (2, K) signed readout times [s], and the log-likelihood lost against the best with all other
    # parameters fitted again, scaled to independent pairs.
    curve: Array
    pixel_sigma: float  # of a match [px]
    inlier_ratio: float
    frames: int
    pairs: int
    matches: int
    frame_interval: float  # median [s]
    warnings: tuple[str, ...] = ()
    failure: str = ''  # why no value may be used; '' if they may

    @property
    def readout_direction(self) -> str:
        """The parameter of this name, by the sign of the readout time."""
        return readout_direction(self.readout_axis, self.readout_time.value)

    @property
    def needed(self) -> list[Estimate]:
        """All that a node needs."""
        parts = [self.readout_time, self.time_offset, self.rotation, *self.gyro_bias]
        return parts if self.lens is None else [*parts, self.lens.focal_factor]

    @property
    def observable(self) -> bool:
        """Whether all that a node needs is observable."""
        return all(part.observable for part in self.needed)

    @property
    def complete(self) -> bool:
        """Whether the parameter file has all that a node needs, however uncertain."""
        return all(part.determined for part in self.needed)

    @property
    def quat_cam_imu_xyzw(self) -> tuple[float, float, float, float]:
        """`R_cam_imu` as the parameter of the node."""
        x, y, z, w = (float(v) for v in Rotation.from_matrix(self.R_cam_imu).as_quat())
        return x, y, z, w

    @property
    def bias_sigma(self) -> float:
        """1 sigma of the bias of the worst axis after a restart of the gyro [rad/s]."""
        return math.hypot(max(bias.sigma for bias in self.gyro_bias), _BIAS_CHANGE)

    @property
    def shutter(self) -> str:
        """'rolling', 'global' or 'unsure'.

        Rolling: the readout time as fitted is 5 sigma and 1 ms from zero; global: it is within
        3 sigma or 1 ms of zero, and known to a millisecond.
        """
        value = abs(self.fitted_readout)
        sigma = self.readout_time.sigma
        if value > max(5.0 * sigma, 1e-3):
            return 'rolling'
        return 'global' if sigma < 1e-3 and value < max(3.0 * sigma, 1e-3) else 'unsure'


# -- Report, parameter file, JSON and picture ----------------------------------------------------

# Change of a gyro's bias from one start to the next [rad/s].
_BIAS_CHANGE = 1e-3
# Milliseconds in a second. [derived: definition]
_MS = 1e3
# What the report adds to a readout time, by the direction; the usual one needs no words.
_DIRECTIONS = {
    'down': '',
    'up': ', read upwards',
    'right': ', by columns from left to right',
    'left': ', by columns from right to left',
}
# Percent of the whole. [derived: definition]
_PERCENT = 100.0


# A quantity of the report: its name, its value with 1 sigma in words, and its estimate.
_Quantity = tuple[str, str, Estimate]


def quantities(result: CalibrationResult, camera: RollingShutterCamera) -> list[_Quantity]:
    """Each quantity: its name, its value with 1 sigma in words, and its estimate."""
    return [
        *_clock_quantities(result),
        *_motion_quantities(result),
        *_exposure_quantities(result),
        *_lens_quantities(result, camera),
    ]


def _clock_quantities(result: CalibrationResult) -> list[_Quantity]:
    """Readout time and time offset, and what the offset varies with."""
    readout = result.readout_time
    slope = result.offset_by_interval
    jitter = result.offset_by_jitter
    direction = _DIRECTIONS[result.readout_direction]
    text = _shown('readout_time', readout, abs(readout.value)) + direction
    offset = result.time_offset
    rows = [
        ('readout time', text, readout),
        ('time offset (row 0)', _shown('time_offset', offset), offset),
    ]
    if slope is not None:
        text = (
            f'{_rounded(slope, 3)} ms per ms of the interval to the previous frame, '
            f'{_MS * result.frame_interval:.2f} ms in the median (automatic exposure)'
        )
        rows.append(('offset by interval', text, slope))
    if jitter is not None:
        text = (
            f'{_MS * result.stamp_jitter:.2f} ms rms about a smooth line, which the images '
            f'follow by {_rounded(jitter, 2)} (1: the stamps alone jitter); not automatic '
            'exposure'
        )
        rows.append(('jitter of stamps', text, jitter))
    if result.offset_changes is not None:
        rows += _change_quantities(result.offset_changes)
    return rows


# Parts per million of one. [derived: definition]
_PPM = 1e6


def _change_quantities(changes: OffsetChanges) -> list[_Quantity]:
    """Steps and the drift of the offset."""
    rows = []
    for number, step in enumerate(changes.steps):
        before, after = changes.offsets[number : number + 2]
        text = (
            f'{_rounded(step.change, 2, _MS)} ms between {step.begin:.2f} and {step.end:.2f} s '
            f'after the first image, where a clock was set: {_MS * before:.2f} ms before, '
            f'{_MS * after:.2f} ms after'
        )
        rows.append(('offset_step', text, step.change))
    if changes.drift is not None:
        text = (
            f'{_rounded(changes.drift, 1, _PPM)} ppm, by which the clocks run apart; the time '
            f'offset is {_MS * changes.offsets[0]:.2f} ms at {changes.at:.1f} s after the first '
            'image, and its sigma contains the drift over the recording'
        )
        rows.append(('offset_drift', text, changes.drift))
    return rows


def _validity(changes: OffsetChanges | None) -> str:
    """When a time offset holds that changes within the recording; '' if it is constant."""
    if changes is None:
        return ''
    if changes.drift is not None:
        return (
            f' The clocks drift by {_PPM * changes.drift.value:.0f} ppm: time_offset is that at '
            f'{changes.at:.1f} s after the first image.'
        )
    borders = [f'{step.begin:.2f} s' for step in changes.steps]
    ends = [step.end for step in changes.steps]
    span = f'until {borders[0]}' if changes.at < ends[0] else f'from {ends[-1]:.2f} s on'
    return (
        f' A clock was set {len(borders)} time(s) while it was recorded: time_offset holds {span} '
        'after the first image.'
    )


def _motion_quantities(result: CalibrationResult) -> list[_Quantity]:
    """Rotation between IMU and camera, and the bias of the gyro."""
    sigmas = ', '.join(f'{np.degrees(sigma):.3f}' for sigma in result.rotation_sigma)
    text = (
        f'{axes_text(result.axis_map)}, and {np.degrees(result.rotation.value):.2f} deg off '
        f"it; 1 sigma about the camera's x, y, z: {sigmas} deg"
    )
    biases = [
        (f'gyro bias {axis}', _shown('gyro_bias', bias), bias)
        for axis, bias in zip('xyz', result.gyro_bias, strict=True)
    ]
    return [('rotation IMU to camera', text, result.rotation), *biases]


def _exposure_quantities(result: CalibrationResult) -> list[_Quantity]:
    """The exposure, where it was estimated."""
    exposure = result.exposure
    margin = _MS * result.exposure_margin
    if not exposure.sigma:
        return []
    text = (
        f'{_rounded(exposure, 1, _MS)} ms at the median interval, over which the gyro is averaged'
    )
    if margin:
        text += (
            f' (assumed: the interval less {margin:.0f} ms, as automatic exposure lengthens it)'
        )
    return [('exposure', text, exposure)]


def _lens_quantities(result: CalibrationResult, camera: RollingShutterCamera) -> list[_Quantity]:
    """The lens, where it was estimated."""
    if result.lens is None:
        return []
    lens = result.lens
    focal = lens.focal_factor
    length = with_sigma(Code.FOCAL_LENGTH, camera.fx * focal.value, camera.fx * focal.sigma)
    coefficients = ', '.join(_rounded(radial, 3) for radial in lens.radial)
    corner = _rounded(lens.displacement, 2, _PERCENT)
    distortion = f'{coefficients} (k1, k2, k3 of {camera.distortion_model}; corner {corner} %)'
    place = f'{_rounded(lens.column, 1)}, {_rounded(lens.row, 1)} px'
    return [
        ('focal length', length, focal),
        ('distortion', distortion, lens.displacement),
        ('principal point', place, lens.column),
    ]


def report(result: CalibrationResult, camera: RollingShutterCamera) -> list[str]:
    """Lines for a reader: each quantity with its 1 sigma and its observability."""
    rates = ', '.join(
        f'{axis} {np.degrees(rate):.1f}'
        for axis, rate in zip(AXES, result.rotation_rates, strict=True)
    )
    text = (
        f'{result.frames} frames, {result.pairs} pairs, {result.matches} matches; '
        f'{100 * result.inlier_ratio:.0f} % inliers, noise of a match '
        f'{result.pixel_sigma:.2f} px'
    )
    lines = [
        text,
        f'rotation of the camera, rms [deg/s]: {rates}',
        f'shutter: {_shutter_text(result)}',
    ]
    for name, text, of in quantities(result, camera):
        state = (
            'observable'
            if of.observable
            else ('weak: ' if of.determined else 'NOT OBSERVABLE: ') + of.remark
        )
        lines.append(f'{name}: {text} [{state}]')
    return [
        *lines,
        'quaternion x y z w: ' + ', '.join(f'{v:.6f}' for v in result.quat_cam_imu_xyzw),
        *(f'note: {warning}' for warning in result.warnings),
        *([f'NOT USABLE: {result.failure}'] if result.failure else []),
    ]


def _rounded(estimate: Estimate, digits: int, factor: float = 1.0) -> str:
    """Value and sigma."""
    return f'{factor * estimate.value:.{digits}f} +- {factor * estimate.sigma:.{digits}f}'


def _shown(name: str, estimate: Estimate, value: float | None = None) -> str:
    """A quantity with its sigma; `value` replaces its own."""
    return with_sigma(Code(name), estimate.value if value is None else value, estimate.sigma)


def _shutter_text(result: CalibrationResult) -> str:
    readout = result.readout_time
    shown = _shown('readout_time', result.readout_time)
    if result.shutter == 'global':
        return f'global: the readout time is {shown}'
    if result.shutter == 'unsure':
        return f'unsure: {shown}; record longer, and rotate the camera faster'
    sigmas = abs(readout.value) / max(readout.sigma, 1e-9)
    return (
        f'rolling: the readout time is {sigmas:.0f} sigma from 0, and the log-likelihood '
        f'of a global shutter is lower by {np.interp(0.0, *result.curve):.0f}'
    )


# Parameter of the node: name, value and source.
_Parameter = tuple[str, float | str | tuple[float, ...], str]


def parameter_file(
    result: CalibrationResult,
    title: str,
    *,
    camera: RollingShutterCamera,
    compressed: bool | None = None,
    feature_rows: tuple[float, ...] = (0.0, 0.0),
    placed: Mapping[str, Any] | None = None,
) -> str:
    """The node's parameter file: each value with its sigma; undetermined ones are named only.

    `camera` is that of the calibration: a guess if the lens was not known. `compressed`: the
    images of a bag. `placed`: parameters of a transform.
    """
    values: list[_Parameter] = (
        []
        if compressed is None
        else [('image_transport', 'compressed' if compressed else 'raw', 'As the bag has them.')]
    )
    groups = [*_parameters(result)]
    if result.lens is not None:
        groups.append(
            (result.lens.focal_factor, 'camera_matrix', _lens_parameters(result.lens, camera))
        )
    for part, _, group in groups:
        values += group if part.determined else []
    if feature_rows[1] > 0.0:
        values.append(('feature_rows', tuple(feature_rows), 'As given to calibrate.'))
    values += [(name, value, 'By /tf_static.') for name, value in (placed or {}).items()]
    title = f'{title} {holds_for(result, camera)}'
    missing = [f'{name} ({part.remark})' for part, name, _ in groups if not part.determined]
    if missing:
        title += ' Not observable in this recording, so left out: ' + '; '.join(missing) + '.'
    return parameter_text(title, [SourcedValue(*value) for value in values])


def holds_for(result: CalibrationResult, camera: RollingShutterCamera) -> str:
    """State the conditions of a calibration, beyond which its values may differ."""
    interval = f'{_MS * result.frame_interval:.1f} ms'
    if result.offset_by_interval is not None:
        exposure = f'automatic exposure that changes the frame interval (median {interval})'
    elif result.exposure_margin:
        exposure = f'an exposure that follows the frame interval of {interval}'
    else:
        exposure = (
            f'frames of {interval}; another exposure moves time_offset by half of its change'
        )
    return (
        f'It holds for images of {camera.width}x{camera.height}, the same focus and zoom, and '
        f'{exposure}.{_validity(result.offset_changes)}'
    )


def _sigma(name: str, value: float, digits: int, source: str = '') -> _Parameter:
    return f'{name}_sigma', max(round(value, digits), 10.0**-digits), source


# Estimate, main parameter, and all parameters of a quantity.
_Group = tuple[Estimate, str, list[_Parameter]]


def _parameters(result: CalibrationResult) -> Iterator[_Group]:
    """Groups of parameters of all quantities but the lens."""
    yield _readout_parameters(result)
    yield result.time_offset, 'time_offset', _clock_parameters(result)
    off = f'{np.degrees(result.rotation.value):.2f} deg off.'
    quat_xyzw = tuple(round(value, 7) for value in result.quat_cam_imu_xyzw)
    axes: list[_Parameter] = [
        ('quat_cam_imu_xyzw', quat_xyzw, f'{axes_text(result.axis_map)}, {off}'),
        _sigma('axes', result.rotation.sigma, 5, 'Of the worst axis [rad].'),
    ]
    yield result.rotation, 'quat_cam_imu_xyzw', axes
    biases = result.gyro_bias
    sigmas = ', '.join(f'{bias.sigma:.5f}' for bias in biases)
    restart = f'Of the worst axis, and {_BIAS_CHANGE:g} rad/s from one start to the next.'
    bias_values = tuple(round(bias.value, 5) for bias in biases)
    bias: list[_Parameter] = [
        ('gyro_bias', bias_values, f'1 sigma {sigmas} rad/s.'),
        _sigma('gyro_bias', result.bias_sigma, 5, restart),
    ]
    yield max(biases, key=lambda one: one.sigma), 'gyro_bias', bias


def _readout_parameters(result: CalibrationResult) -> _Group:
    readout = result.readout_time
    shutter = _shutter_text(result)
    rolling = result.shutter != 'global'
    source = (
        f'{shutter[:1].upper()}{shutter[1:]}. Estimate {_shown("readout_time", readout)} (1 '
        f'sigma); at most the {_MS * result.frame_interval:.1f} ms between frames.'
    )
    direction = readout_direction(result.readout_axis, readout.value if rolling else 0.0)
    values: list[_Parameter] = [
        ('readout_time', round(abs(readout.value), 6) if rolling else 0.0, source),
        _sigma('readout_time', readout.sigma, 6),
        ('readout_direction', direction, 'By the sign of that estimate.'),
    ]
    return readout, 'readout_time', values


def _clock_parameters(result: CalibrationResult) -> list[_Parameter]:
    """Offset of the clocks, what it varies with, and the exposure."""
    offset = result.time_offset
    slope = result.offset_by_interval
    exposure = result.exposure
    values: list[_Parameter] = [
        ('stamp_row', 'first', 'Convention of time_offset here.'),
        ('time_offset', round(offset.value, 6), 'To the middle of the exposure of row 0.'),
        _sigma('time_offset', offset.sigma, 6),
    ]
    if slope is not None:
        values += [
            ('time_offset_per_interval', round(slope.value, 4), 'Automatic exposure.'),
            _sigma('time_offset_per_interval', slope.sigma, 4),
            (
                'time_offset_reference_interval',
                round(result.frame_interval, 6),
                'Median interval between frames, to which time_offset refers.',
            ),
        ]
    if result.exposure_margin:
        margin = max(result.frame_interval - exposure.value, 1e-3)
        source = (
            f'Exposure {_rounded(exposure, 1, _MS)} ms at that interval, assumed as '
            f'{_MS * result.exposure_margin:.0f} ms less than it before the fit.'
        )
        values.append(('exposure_margin', round(margin, 5), source))
    elif exposure.determined and exposure.value > 2.0 * exposure.sigma:
        source = f'1 sigma {_MS * exposure.sigma:.1f} ms.'
        values.append(('exposure_time', round(exposure.value, 5), source))
    return values


def _lens_parameters(lens: LensEstimates, camera: RollingShutterCamera) -> list[_Parameter]:
    focal = lens.focal_factor
    column = lens.column
    row = lens.row
    return [
        (
            'camera_matrix',
            (
                round(camera.fx * focal.value, 2),
                0.0,
                round(column.value, 2),
                0.0,
                round(camera.fy * focal.value, 2),
                round(row.value, 2),
                0.0,
                0.0,
                1.0,
            ),
            f'For images of {camera.width}x{camera.height}, in place of their CameraInfo.',
        ),
        ('distortion_model', camera.distortion_model, ''),
        (
            'distortion_coefficients',
            tuple(round(value, 5) for value in lens.coefficients),
            'The radial coefficients k1, k2, k3 are estimated.',
        ),
        _sigma('focal_length', focal.sigma / focal.value, 5, 'Relative.'),
        _sigma('distortion', lens.radial_sigma, 5, 'Of k1 that displaces as much.'),
        _sigma('principal_point', max(column.sigma, row.sigma), 2, 'In pixels.'),
    ]


def as_mapping(result: CalibrationResult, camera: RollingShutterCamera) -> dict[str, Any]:
    """The result for a JSON file; seconds, radians, pixels."""
    slope = result.offset_by_interval
    jitter = result.offset_by_jitter
    lens: dict[str, Any] = dict.fromkeys(
        ('focal_px', 'distortion_first', 'distortion', 'displacement', 'principal_point_px')
    )
    if result.lens is not None:
        focal = asdict(result.lens.focal_factor)
        focal |= {name: focal[name] * camera.fx for name in ('value', 'sigma')}
        radial = [asdict(one) for one in result.lens.radial]
        lens = {
            'focal_px': focal,
            'distortion_first': radial[0],
            'distortion': radial,
            'displacement': asdict(result.lens.displacement),
            'principal_point_px': [asdict(result.lens.column), asdict(result.lens.row)],
        }
    return {
        'observable': result.observable,
        'failure': result.failure,
        'holds_for': holds_for(result, camera),
        'shutter': result.shutter,
        'readout_time_s': asdict(result.readout_time),
        'readout_direction': result.readout_direction,
        'time_offset_s': asdict(result.time_offset),
        'offset_changes': _changes_mapping(result.offset_changes),
        'offset_by_interval': slope and asdict(slope),
        'offset_by_jitter': jitter and asdict(jitter),
        'stamp_jitter_s': result.stamp_jitter,
        'quat_cam_imu_xyzw': list(result.quat_cam_imu_xyzw),
        'rotation_sigma_rad': result.rotation_sigma.tolist(),
        'rotation_from_axis_map_rad': asdict(result.rotation),
        'axis_map': result.axis_map.tolist(),
        'gyro_bias_rad_per_s': [asdict(bias) for bias in result.gyro_bias],
        **lens,
        'exposure_s': asdict(result.exposure),
        'exposure_margin_s': result.exposure_margin,
        'rotation_rate_rms_rad_per_s': result.rotation_rates.tolist(),
        'frames': result.frames,
        'pairs': result.pairs,
        'matches': result.matches,
        'inlier_ratio': result.inlier_ratio,
        'pixel_sigma': result.pixel_sigma,
        'frame_interval_s': result.frame_interval,
        'warnings': list(result.warnings),
        'cost_over_readout': dict(zip(('readout_s', 'cost'), result.curve.tolist(), strict=True)),
    }


def _changes_mapping(changes: OffsetChanges | None) -> dict[str, Any] | None:
    if changes is None:
        return None
    steps = [
        {'between_s': [step.begin, step.end], 'change_s': asdict(step.change)}
        for step in changes.steps
    ]
    return {
        'offset_step': steps,
        'offset_drift': changes.drift and asdict(changes.drift),
        'time_offset_at_s': changes.at,
        'time_offsets_s': list(changes.offsets),
    }


def draw_curve(result: CalibrationResult, path: Path) -> None:
    """Draw the cost over the readout time."""
    # A node draws nothing, and starts sooner.
    from matplotlib.figure import Figure

    picture = Figure(figsize=(7.5, 4.5), dpi=110, layout='constrained')
    axes = picture.subplots()
    readout = result.readout_time
    (tried, costs) = result.curve
    # The root of a parabola is straight on both sides of the best.
    axes.plot(_MS * tried, np.sqrt(2.0 * costs), 'o-', color=BLUE)
    axes.axvline(0.0, color='0.6', linewidth=0.8)
    axes.axvline(_MS * readout.value, color=ORANGE, label=_shown('readout_time', readout))
    axes.axvspan(
        _MS * (readout.value - 3 * readout.sigma),
        _MS * (readout.value + 3 * readout.sigma),
        color=ORANGE,
        alpha=0.25,
        label='3 sigma',
    )
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel('readout time [ms], negative: upwards; to +- one frame interval')
    axes.set_ylabel('cost: sqrt(2 x log-likelihood lost) [sigma]')
    axes.set_title(f'{result.shutter} shutter; all else fitted again at each point')
    axes.legend()
    axes.grid(alpha=0.3)
    save_picture(picture, path)
