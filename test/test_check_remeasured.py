"""Figures of a check that a calibration contradicts: conventions of rows, signs and exposures."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_ros.calibrate.result import Estimate
from rs_relpose_ros.check.remeasured import contradicted
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.front_end.frame import sensor_camera
from rs_relpose_ros.geometry.intrinsics import Intrinsics

INTRINSICS = Intrinsics(width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5,
                        image_width=640, image_height=480)
INTERVAL = 0.05
TRUE = {'readout_time': 0.024, 'time_offset': -0.03, 'exposure_time': 0.012,
        'quat_cam_imu_xyzw': (0.5, -0.5, 0.5, -0.5), 'time_offset_per_interval': -0.5,
        'time_offset_reference_interval': 0.04}
CONVENTIONS = list(itertools.product(('first', 'middle', 'last'), ('down', 'up'),
                                     ('start', 'middle', 'end')))


def told_as(row, direction, exposure, **changes):
    """Parameters, and the camera that they make."""
    parameters = Parameters.from_mapping(TRUE | {
        'stamp_row': row, 'readout_direction': direction, 'stamp_exposure': exposure} | changes)
    return parameters.sensor, sensor_camera(INTRINSICS, parameters)


def found_by(row, direction, exposure, offset_observable=True):
    """A calibration that found the truth of these conventions, by their definition."""
    stamped = {'first': 0.0, 'middle': 239.5, 'last': 479.0}[row]
    signed = {'down': 1.0, 'up': -1.0}[direction] * TRUE['readout_time']
    middle_of_exposure = {'start': 0.006, 'middle': 0.0, 'end': -0.006}[exposure]
    at_interval = TRUE['time_offset'] - 0.5 * (INTERVAL - 0.04)
    row_0 = at_interval + middle_of_exposure - stamped / 480.0 * signed
    R = Rotation.from_quat(TRUE['quat_cam_imu_xyzw']).as_matrix()
    return SimpleNamespace(
        R_cam_imu=R, rotation_sigma=np.full(3, 1e-3), frame_interval=INTERVAL,
        quat_cam_imu_xyzw=TRUE['quat_cam_imu_xyzw'], readout_time=Estimate(signed, 3e-4, True),
        time_offset=Estimate(row_0, 2e-4, offset_observable))


@pytest.mark.parametrize('convention', CONVENTIONS)
def test_the_truth_is_not_contradicted_in_any_convention(convention):
    assert contradicted(found_by(*convention), *told_as(*convention)) == ()


@pytest.mark.parametrize('convention', CONVENTIONS)
def test_what_is_seen_is_what_must_be_told(convention):
    found = found_by(*convention)
    offset, = contradicted(found, *told_as(*convention, time_offset=0.01))
    assert (offset.figure, offset.told) == ('time_offset', 0.01)
    assert offset.seen == pytest.approx(-0.03, abs=1e-6)
    assert 'set time_offset: -0.0300' in offset.sentence
    readout, = contradicted(found, *told_as(*convention, readout_time=0.05))
    assert (readout.figure, readout.told) == ('readout_time', pytest.approx(0.05))
    assert readout.seen == pytest.approx(0.024, abs=1e-9)
    axes, = contradicted(found, *told_as(*convention, quat_cam_imu_xyzw=(0.0, 0.0, 0.0, 1.0)))
    assert axes.figure == 'axes' and axes.seen == pytest.approx(120.0)
    assert 'quat_cam_imu_xyzw: [0.5, -0.5, 0.5, -0.5]' in axes.sentence


def test_a_read_out_the_other_way():
    found = found_by('middle', 'down', 'middle')
    direction, = contradicted(found, *told_as('middle', 'up', 'middle'))
    assert direction.figure == 'readout_direction'
    assert 'readout_direction: down' in direction.sentence


def test_small_differences_and_an_unknown_offset_contradict_nothing():
    found = found_by('first', 'down', 'middle')
    assert contradicted(found, *told_as('first', 'down', 'middle', time_offset=-0.025)) == ()
    unknown = found_by('first', 'down', 'middle', offset_observable=False)
    assert contradicted(unknown, *told_as('first', 'down', 'middle', time_offset=0.2)) == ()
