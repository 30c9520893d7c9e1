"""A calibration in words, as the node's parameter file, as JSON and as a picture."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
import numpy as np

from rs_relpose_ros.calibrate.axis_maps import axes_text
from rs_relpose_ros.calibrate.result import AXES, CalibrationResult, Estimate
from rs_relpose_ros.config.parameter_file import parameter_text, SourcedValue
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.picture_files import save_picture

_BLUE, _ORANGE = '#0072B2', '#E69F00'
_MS = 1e3


def report(result: CalibrationResult, camera: RollingShutterCamera) -> list[str]:
    """Lines for a reader: each figure with its 1 sigma and its verdict."""
    readout, focal = result.readout_time, result.focal_factor
    slope, jitter = result.offset_by_interval, result.offset_by_jitter
    rates = ', '.join(f'{axis} {np.degrees(rate):.1f}'
                      for axis, rate in zip(AXES, result.rotation_rates, strict=True))
    sigmas = ', '.join(f'{np.degrees(sigma):.3f}' for sigma in result.rotation_sigma)
    lines = [
        (f'{result.frames} frames, {result.pairs} pairs, {result.matches} matches; '
         f'{100 * result.inlier_ratio:.0f} % inliers, noise of a match '
         f'{result.pixel_sigma:.2f} px'),
        f'rotation of the camera, rms [deg/s]: {rates}',
        f'shutter: {_shutter_text(result)}',
        _line('read-out time', f'{_ms(readout, abs(readout.value))}'
              + (', read upwards' if readout.value < 0.0 else ''), readout),
        _line('time offset (row 0)', _ms(result.time_offset), result.time_offset)]
    if slope is not None:
        meaning = ('the exposure moves against the stamp' if result.follows_exposure
                   else 'none that is sure')
        lines.append(_line(
            'offset by interval', f'{slope.value:.3f} +- {slope.sigma:.3f} ms per ms of the '
            f'interval to the frame before, {_MS * result.frame_interval:.2f} ms in the median '
            f'({meaning})', slope))
    if jitter is not None:
        lines.append(_line(
            'stamps jitter', f'{_MS * result.stamp_jitter:.2f} ms rms about a smooth line, which '
            f'the images follow by {jitter.value:.2f} +- {jitter.sigma:.2f} (1: the stamps alone '
            'are at fault); not taken for exposure', jitter))
    lines += [
        _line('rotation IMU to camera', f'{axes_text(result.axis_map)}, and '
              f"{np.degrees(result.rotation.value):.2f} deg off it; 1 sigma about the camera's "
              f'x, y, z: {sigmas} deg', result.rotation),
        '  quaternion x y z w: ' + ', '.join(f'{v:.6f}' for v in result.quat_cam_imu_xyzw),
        *(_line(f'gyro bias {axis}', f'{bias.value:.5f} +- {bias.sigma:.5f} rad/s', bias)
          for axis, bias in zip('xyz', result.gyro_bias, strict=True))]
    if focal is not None:
        lines.append(_line(
            'focal length', f'{camera.fx * focal.value:.1f} +- {camera.fx * focal.sigma:.1f} px '
            '(CameraInfo has none: camera_matrix takes its place)', focal))
    return lines + [f'note: {warning}' for warning in result.warnings]


def _line(name: str, text: str, estimate: Estimate) -> str:
    verdict = 'observable' if estimate.observable else f'NOT OBSERVABLE: {estimate.remark}'
    return f'{name}: {text} [{verdict}]'


def _ms(estimate: Estimate, value: float | None = None) -> str:
    """A time with its sigma; `value` is shown in place of its own."""
    shown = estimate.value if value is None else value
    return f'{_MS * shown:.2f} +- {_MS * estimate.sigma:.2f} ms'


def _shutter_text(result: CalibrationResult) -> str:
    """Rolling or global, and how sure."""
    readout = result.readout_time
    if result.shutter == 'global':
        return f'global: the read-out time is {_ms(readout)}'
    if result.shutter == 'unsure':
        return f'not sure: {_ms(readout)}; record longer, and turn faster'
    sigmas = abs(readout.value) / max(readout.sigma, 1e-9)
    at_zero = float(np.interp(0.0, result.curve.readout_times, result.curve.costs))
    return (f'rolling: the read-out time is {sigmas:.0f} sigma from 0, and the log-likelihood '
            f'of a global shutter is lower by {at_zero:.0f}')


def parameter_file(result: CalibrationResult, title: str, *, camera: RollingShutterCamera,
                   compressed: bool, feature_rows: tuple[float, ...] = (0.0, 0.0)) -> str:
    """The node's parameter file; figures that are not observable are left out, and named.

    `camera` is what was calibrated with: a guess where the focal length was not known.
    """
    readout, offset, rotation = result.readout_time, result.time_offset, result.rotation
    shutter, biases = _shutter_text(result), result.gyro_bias
    rolling = result.shutter != 'global'
    # What a file has of each figure that is observable.
    told = [
        (readout.observable, f'readout_time ({readout.remark})', [
            SourcedValue(
                'readout_time', round(abs(readout.value), 6) if rolling else 0.0,
                f'{shutter[:1].upper()}{shutter[1:]}. Estimate {_ms(readout)} (1 sigma).'),
            SourcedValue('readout_direction', 'up' if rolling and readout.value < 0.0 else 'down',
                         'By the sign of that estimate.')]),
        (offset.observable, f'time_offset ({offset.remark})', [
            SourcedValue('stamp_row', 'first', 'Convention of time_offset here.'),
            SourcedValue('time_offset', round(offset.value, 6),
                         f'1 sigma {_MS * offset.sigma:.2f} ms.'), *_by_interval(result)]),
        (rotation.observable, f'quat_cam_imu_xyzw ({rotation.remark})', [SourcedValue(
            'quat_cam_imu_xyzw', tuple(round(v, 7) for v in result.quat_cam_imu_xyzw),
            f'{axes_text(result.axis_map)}, {np.degrees(rotation.value):.2f} deg off; '
            f'1 sigma {np.degrees(rotation.sigma):.3f} deg at most.')]),
        (all(bias.observable for bias in biases), 'gyro_bias', [SourcedValue(
            'gyro_bias', tuple(round(bias.value, 5) for bias in biases), '1 sigma '
            + ', '.join(f'{bias.sigma:.5f}' for bias in biases) + ' rad/s.')])]
    focal = result.focal_factor
    if focal is not None:
        told.append((focal.observable, f'camera_matrix ({focal.remark})', [SourcedValue(
            'camera_matrix',
            (round(camera.fx * focal.value, 2), 0.0, camera.cx, 0.0,
             round(camera.fy * focal.value, 2), camera.cy, 0.0, 0.0, 1.0),
            f'Focal length, 1 sigma {camera.fx * focal.sigma:.2f} px; for images of '
            f'{camera.width}x{camera.height}. The principal point is assumed in the middle, '
            'without distortion. A calibrated CameraInfo comes first.')]))
    values = [SourcedValue('image_transport', 'compressed' if compressed else 'raw',
                           'As the bag has them.')]
    values += [value for observable, _, group in told if observable for value in group]
    if feature_rows[1] > 0.0:
        values.append(SourcedValue('feature_rows', tuple(feature_rows), 'As given to calibrate.'))
    missing = [name for observable, name, _ in told if not observable]
    if missing:
        title += ' Not observable in this recording, so left out: ' + '; '.join(missing) + '.'
    return parameter_text(title, values)


def _by_interval(result: CalibrationResult) -> list[SourcedValue]:
    """Parameters of an offset that follows automatic exposure; none where it does not."""
    slope = result.offset_by_interval
    if slope is None or not result.follows_exposure:
        return []
    return [SourcedValue('time_offset_per_interval', round(slope.value, 4),
                         f'Automatic exposure; 1 sigma {slope.sigma:.3f} s/s.'),
            SourcedValue('time_offset_reference_interval', round(result.frame_interval, 6),
                         'Median interval between frames, at which time_offset holds.')]


def as_mapping(result: CalibrationResult, camera: RollingShutterCamera) -> dict[str, Any]:
    """The result for a JSON file; seconds, radians, pixels."""
    slope, jitter = result.offset_by_interval, result.offset_by_jitter
    focal = result.focal_factor
    if focal is not None:
        focal = replace(focal, value=focal.value * camera.fx, sigma=focal.sigma * camera.fx)
    return {
        'observable': result.observable, 'shutter': result.shutter,
        'readout_time_s': asdict(result.readout_time),
        'time_offset_s': asdict(result.time_offset),
        'offset_by_interval': slope and asdict(slope),
        'offset_by_jitter': jitter and asdict(jitter), 'stamp_jitter_s': result.stamp_jitter,
        'quat_cam_imu_xyzw': list(result.quat_cam_imu_xyzw),
        'rotation_sigma_rad': result.rotation_sigma.tolist(),
        'rotation_from_axis_map_rad': asdict(result.rotation),
        'axis_map': result.axis_map.tolist(),
        'gyro_bias_rad_per_s': [asdict(bias) for bias in result.gyro_bias],
        'focal_px': focal and asdict(focal),
        'rotation_rate_rms_rad_per_s': result.rotation_rates.tolist(),
        'frames': result.frames, 'pairs': result.pairs, 'matches': result.matches,
        'inlier_ratio': result.inlier_ratio, 'pixel_sigma': result.pixel_sigma,
        'frame_interval_s': result.frame_interval, 'warnings': list(result.warnings),
        'cost_over_readout': {'readout_s': result.curve.readout_times.tolist(),
                              'cost': result.curve.costs.tolist()}}


def draw_curve(result: CalibrationResult, path: Path) -> None:
    """Cost over the read-out time."""
    figure = Figure(figsize=(7.5, 4.5), dpi=110, layout='constrained')
    axes = figure.subplots()
    readout = result.readout_time
    # A parabola's root: straight on both sides of the best, so that a few points draw it.
    axes.plot(_MS * result.curve.readout_times, np.sqrt(2.0 * result.curve.costs), 'o-',
              color=_BLUE)
    axes.axvline(0.0, color='0.6', linewidth=0.8)
    axes.axvline(_MS * readout.value, color=_ORANGE,
                 label=_ms(readout))
    axes.axvspan(_MS * (readout.value - 3 * readout.sigma),
                 _MS * (readout.value + 3 * readout.sigma), color=_ORANGE, alpha=0.25,
                 label='3 sigma')
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel('read-out time [ms], negative: upwards; to +- one frame interval')
    axes.set_ylabel('cost: sqrt(2 x log-likelihood lost) [sigma]')
    axes.set_title(f'{result.shutter} shutter; everything else fitted anew at each point')
    axes.legend()
    axes.grid(alpha=0.3)
    save_picture(figure, path)
