"""Extrinsics from the transforms of a robot: rules, bags, commands, calibration."""

import json
import math
from pathlib import Path
from typing import Any

import bag_kinds as bags
from conftest import BUNDLED_PARAMETERS
import message_builders as build
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_ros.bags.reader import CAMERA_FRAME, IMU_FRAME, open_bag
from rs_relpose_ros.cli import main as command_line
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.messages.transforms import (
    extrinsics,
    FrameTree,
    Transform,
    with_extrinsics,
)

QUATERNION = (0.5, -0.5, 0.5, 0.5)
FOUND: Transform = (0.1, 0.2, 0.3, *QUATERNION)
BUNDLED = read_parameters(BUNDLED_PARAMETERS)


def tf_message(*transforms: tuple[str, str, Transform]) -> Any:
    of = build.rosbags_types
    return of('tf2_msgs/msg/TFMessage')(transforms=[
        of('geometry_msgs/msg/TransformStamped')(
            header=build.header(of, 0, parent), child_frame_id=child,
            transform=of('geometry_msgs/msg/Transform')(
                translation=of('geometry_msgs/msg/Vector3')(*values[:3]),
                rotation=of('geometry_msgs/msg/Quaternion')(*values[3:])))
        for parent, child, values in transforms])


def drawn(seed: int) -> Transform:
    rng = np.random.default_rng(seed)
    return *rng.normal(size=3), *Rotation.random(random_state=seed).as_quat()


def test_poses_are_chained_over_the_common_root():
    """Points mapped step by step are the independent result."""
    base_camera, camera_optical, base_imu = map(drawn, range(3))
    tree = FrameTree()
    tree.add(tf_message(('/base', 'camera', base_camera), ('camera', '/optical', camera_optical)))
    assert tree.lookup('optical', 'imu') is None
    tree.add(tf_message(('base', 'imu', base_imu), ('base', 'imu', drawn(4)),
                        ('base', 'broken', (math.nan, 0.0, 0.0, *QUATERNION)),
                        ('base', 'zero', (0.0,) * 7)))
    found = tree.lookup('optical', 'imu')

    def moved(pose: Transform, point: Any) -> Any:
        return Rotation.from_quat(pose[3:]).apply(point) + pose[:3]

    point = np.array([0.3, -0.2, 0.9])
    np.testing.assert_allclose(
        moved(base_imu, point), moved(base_camera, moved(camera_optical, moved(found, point))))
    assert tree.lookup('base', 'broken') is tree.lookup('base', 'zero') is None
    tree.add(tf_message(('b', 'a', FOUND), ('a', 'b', FOUND)))
    assert tree.lookup('a', 'b') is tree.lookup('a', 'base') is None


def turned(degrees: float) -> Transform:
    turn = Rotation.from_rotvec([0.0, math.radians(degrees), 0.0])
    return *FOUND[:3], *(turn * Rotation.from_quat(QUATERNION)).as_quat()


@pytest.mark.parametrize(('given', 'found', 'names', 'contradiction'), [
    ({}, FOUND, ['quat_cam_imu_xyzw', 'axes_sigma', 'imu_position', 'imu_position_sigma'], []),
    ({'quat_cam_imu_xyzw': QUATERNION}, turned(4.0), ['imu_position', 'imu_position_sigma'], []),
    ({'quat_cam_imu_xyzw': QUATERNION}, turned(6.0), [], ['6.0 deg', '0.5000', '0.5255']),
    ({'quat_cam_imu_xyzw': QUATERNION, 'axes_sigma': 0.03}, turned(6.0),
     ['imu_position', 'imu_position_sigma'], []),
    ({'imu_position': (0.1, 0.2, 0.36)}, FOUND, ['quat_cam_imu_xyzw', 'axes_sigma'], []),
    ({'imu_position': (0.1, 0.2, 0.5), 'quat_cam_imu_xyzw': QUATERNION}, FOUND, [],
     ['0.3000', '0.5000'])])
def test_configured_values_win_and_a_contradiction_has_both(given, found, names, contradiction):
    result = extrinsics(Parameters.from_mapping(given), found, 'camera', 'imu')
    assert list(result.values) == names
    assert bool(result.contradiction) == bool(contradiction)
    assert all(text in result.contradiction for text in contradiction)
    completed = Parameters.from_mapping(given).updated(result.values)
    if 'axes_sigma' in names:
        np.testing.assert_allclose(completed.sensor.quat_cam_imu_xyzw, QUATERNION)
        assert completed.sensor.axes_sigma == pytest.approx(math.radians(5.0))
    if 'imu_position' in names:
        assert completed.imu.imu_position == FOUND[:3]
        assert completed.imu.imu_position_sigma == 0.02


# -- bags ----------------------------------------------------------------------------------------

STATIC = tf_message(('base_link', 'mount', (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)))
TRUE = tf_message(
    ('mount', CAMERA_FRAME, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)),
    (CAMERA_FRAME, IMU_FRAME, (0.02, 0.01, 0.0, *BUNDLED.sensor.quat_cam_imu_xyzw)))


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory, bundled_bag: Path) -> Path:
    return bags.copied(bundled_bag, tmp_path_factory.mktemp('tf') / 'bag', seconds=2.0,
                       first=[('/tf_static', STATIC), ('/tf', TRUE)])


def test_a_bag_gives_what_is_missing(bag):
    wanted = {'base_frame': 'base_link'}
    with open_bag(bag) as opened:
        topics = opened.find_topics()
        found, contradiction = with_extrinsics(opened, topics, Parameters.from_mapping(wanted))
        left, _ = with_extrinsics(opened, topics, Parameters.from_mapping({'use_tf': False}))
    assert not contradiction
    np.testing.assert_allclose(found.sensor.quat_cam_imu_xyzw, BUNDLED.sensor.quat_cam_imu_xyzw,
                               rtol=1e-5)
    np.testing.assert_allclose(found.imu.imu_position, (0.02, 0.01, 0.0), atol=1e-12)
    np.testing.assert_allclose(found.odometry.base_to_camera, (1.0, 0, 1.0, 0, 0, 0, 1.0))
    assert left == Parameters.from_mapping({'use_tf': False})


def test_one_frame_for_both_sensors_gives_nothing(tmp_path, bundled_bag):
    def change(message: Any) -> None:
        if hasattr(message, 'header'):
            message.header.frame_id = CAMERA_FRAME
    same = bags.copied(bundled_bag, tmp_path / 'bag', change, 0.2, [('/tf', TRUE)])
    with open_bag(same) as opened:
        assert with_extrinsics(opened, opened.find_topics(), Parameters())[0] == Parameters()


def run(*arguments: object) -> int:
    return command_line.main([str(argument) for argument in arguments])


def test_commands_need_only_the_readout_time(bag, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bias = ', '.join(map(str, BUNDLED.imu.gyro_bias))
    known = ('--set', f'readout_time={BUNDLED.sensor.readout_time}', '--set',
             f'gyro_bias=[{bias}]')
    assert run('replay', bag, *known, '--no-pictures') == 0
    summary = json.loads((tmp_path / 'bag_relpose' / 'summary.json').read_text())
    assert summary['parameters']['imu_position_sigma'] == 0.02
    assert summary['errors_against_truth']['rotation_median_deg'] < 0.1
    assert run('unroll', bag, tmp_path / 'out', *known) == 0
    assert run('replay', bag, *known, '--set', 'use_tf=false', '--no-pictures') == 2


def test_commands_report_a_contradiction(bag, tmp_path, monkeypatch, capsys, caplog):
    monkeypatch.chdir(tmp_path)
    other = '--params', BUNDLED_PARAMETERS, '--set', 'imu_position=[0.5, 0, 0]'
    run('check', bag, *other, '--json')
    found = {item['name']: item for item in json.loads(capsys.readouterr().out)['findings']}
    assert found['transforms']['verdict'] == 'warning'
    assert '0.5000' in found['transforms']['text'] and '0.0200' in found['transforms']['text']
    assert run('replay', bag, *other, '--no-pictures') == 0
    assert '0.5000' in caplog.text
