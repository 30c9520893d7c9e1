"""The figures of one bag's results that are columns of results.csv."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import json
from typing import Any

from rs_relpose_ros.result_files import SUMMARY_FILE

Figures = dict[str, Any]

RESULT_FILES = {'check': 'check.json', 'calibrate': 'calibration.json', 'replay': SUMMARY_FILE}
_VERDICTS = ('ok', 'unknown', 'warning', 'failure')


def figures_of(command: str, files: Mapping[str, bytes]) -> Figures:
    """Figures by column; none where there are no results."""
    data = files.get(RESULT_FILES[command])
    return {} if data is None else _FIGURES[command](json.loads(data))


def message_of(command: str, files: Mapping[str, bytes]) -> str:
    """What a command that ran says of a bag that it is not content with."""
    data = files.get(RESULT_FILES[command])
    return '' if data is None else '; '.join(_MESSAGES[command](json.loads(data)))


def calibrated(name: str, mapping: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """A figure of calibration.json: value, sigma, observable; `name` may end in an index."""
    key, _, index = name.partition('.')
    found = mapping.get(key)
    if index and found is not None:
        found = found[int(index)]
    return found


# Figures of a calibration that are one number.
CALIBRATED = ('readout_time_s', 'time_offset_s', 'focal_px', 'gyro_bias_rad_per_s.0',
              'gyro_bias_rad_per_s.1', 'gyro_bias_rad_per_s.2')


def _check(report: Mapping[str, Any]) -> Figures:
    verdicts = [finding['verdict'] for finding in report['findings']]
    return {verdict: verdicts.count(verdict) for verdict in _VERDICTS}


def _calibrate(mapping: Mapping[str, Any]) -> Figures:
    figures: Figures = {'shutter': mapping['shutter']}
    for name in CALIBRATED:
        found = calibrated(name, mapping)
        for part in ('value', 'sigma', 'observable'):
            suffix = '' if part == 'value' else f'_{part}'
            figures[name.replace('.', '_') + suffix] = None if found is None else found[part]
    figures |= dict(zip(('quat_x', 'quat_y', 'quat_z', 'quat_w'), mapping['quat_cam_imu_xyzw'],
                        strict=True))
    figures |= dict(zip(('rotation_x_sigma_rad', 'rotation_y_sigma_rad', 'rotation_z_sigma_rad'),
                        mapping['rotation_sigma_rad'], strict=True))
    return {**figures, 'rotation_observable': mapping['rotation_from_axis_map_rad']['observable'],
            'frames': mapping['frames'], 'pixel_sigma': mapping['pixel_sigma']}


def _replay(summary: Mapping[str, Any]) -> Figures:
    errors = summary['errors_against_truth'] or {}
    medians, frames, timing = summary['medians'], summary['frames'], summary['timing']
    return {
        'pairs': summary['pairs']['total'], 'answered': summary['pairs']['answered'],
        'health': summary['health']['state'],
        **{name: errors.get(name) for name in (
            'rotation_median_deg', 'rotation_p90_deg', 'translation_median_deg',
            'translation_p90_deg')},
        'pairs_with_truth': errors.get('pairs', 0),
        'inliers_median': medians['inliers'], 'residual_rms_px_median': medians['residual_rms_px'],
        'rotation_difference_to_gyro_deg_median': medians['rotation_difference_to_gyro_deg'],
        'frames': frames['in_bag'], 'frames_processed': frames['processed'],
        'bag_s': timing['bag_s'], 'processing_per_frame_ms': timing['processing_per_frame_ms'],
    }


def _failures(report: Mapping[str, Any]) -> list[str]:
    return [f'{finding["name"]}: {finding["text"]}' for finding in report['findings']
            if finding['verdict'] == 'failure']


def _not_observable(mapping: Mapping[str, Any]) -> list[str]:
    figures = {name: calibrated(name, mapping) for name in CALIBRATED}
    figures['rotation'] = mapping['rotation_from_axis_map_rad']
    return [f'{name} is not observable: {found["remark"]}' for name, found in figures.items()
            if found is not None and not found['observable']]


def _wrong(summary: Mapping[str, Any]) -> list[str]:
    wrong = [finding['sentence'] for finding in summary['health']['findings']
             if finding['state'] == 'wrong']
    if not summary['pairs']['answered']:
        by_status = summary['pairs']['by_status']
        wrong.append('no pair got a pose: ' + (', '.join(
            f'{count} {status}' for status, count in by_status.items() if count) or 'none closed'))
    return wrong


_FIGURES: Mapping[str, Callable[[Mapping[str, Any]], Figures]] = {
    'check': _check, 'calibrate': _calibrate, 'replay': _replay}
_MESSAGES: Mapping[str, Callable[[Mapping[str, Any]], list[str]]] = {
    'check': _failures, 'calibrate': _not_observable, 'replay': _wrong}
