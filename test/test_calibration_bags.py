"""``rs_relpose calibrate`` from bag to parameter file, and bags that it refuses."""

from dataclasses import replace
import json
from pathlib import Path
import tarfile
from typing import Any

from bag_kinds import copied
from conftest import rows_of
import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_walks import bag_of, small_walk
import yaml

from rs_relpose_lab.simulation import simulate
from rs_relpose_lab.simulation.bag import write_bag
from rs_relpose_ros.calibrate import procedure, recording
from rs_relpose_ros.calibration.observations import GyroSeries, TrackedPoints
from rs_relpose_ros.cli.main import main
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import TrackingConfig
from rs_relpose_ros.core.deviations import TANGENTIAL_SIGMA
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera

SMALL = small_walk(3.0)


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bag_of(SMALL, tmp_path_factory.mktemp('walk'))


def calibrated(bag: Path, out: Path, *options: str) -> tuple[int, dict[str, Any]]:
    code = main(['calibrate', str(bag), '--out', str(out), *options])
    return code, json.loads((out / 'calibration.json').read_text())


def test_bag_gives_a_parameter_file_that_the_node_takes(bag, tmp_path, capsys):
    code, values = calibrated(bag, tmp_path)
    assert code == 0
    assert 'shutter: rolling' in capsys.readouterr().out
    assert values['readout_time_s']['value'] == pytest.approx(0.02, abs=1.5e-3)
    assert values['time_offset_s']['value'] == pytest.approx(0.03, abs=1.5e-3)
    sensor = read_parameters(tmp_path / 'calibration.yaml').sensor
    turn = Rotation.from_matrix(sensor.R_cam_imu @ SMALL.R_cam_imu.T).magnitude()
    assert np.degrees(turn) < 0.6
    assert sensor.readout_time == pytest.approx(values['readout_time_s']['value'], abs=1e-6)
    picture = cv2.imread(str(tmp_path / 'cost_over_readout.png'))
    assert picture is not None and picture.std() > 5.0


def test_the_chosen_tracker_is_used(bag, tmp_path, monkeypatch, refused):
    def refuse(config: TrackingConfig) -> None:
        raise InputError(f'a tracker of {config.detector}')

    monkeypatch.setattr(recording, 'make_tracker', refuse)
    refused('a tracker of sift', 'calibrate', bag, '--out', tmp_path, '--detector', 'sift')


def nominal(message: Any) -> None:
    """A CameraInfo as of a data sheet: 10 % off, without distortion."""
    if hasattr(message, 'distortion_model'):
        message.d = np.zeros(5)
        message.k = message.k * ([1.1, 1.0, 1.0, 1.0, 1.1] + 4 * [1.0])


def binned(message: Any) -> None:
    nominal(message)
    if hasattr(message, 'distortion_model'):
        message.width = 640
        message.height = 480
        message.binning_x = 2
        message.binning_y = 2
        # The matrix of the full sensor: one of the binned image would count the binning twice.
        message.k = message.k * np.array([2.0, 1.0, 2.0, 1.0, 2.0, 2.0, 1.0, 1.0, 1.0])


def test_lens_of_a_nominal_camera_info_ends_in_poses(bag, tmp_path):
    path = copied(bag, tmp_path / 'bag', nominal)
    out = tmp_path / 'out'
    code, values = calibrated(path, out, '--lens')
    assert code == 0
    assert values['focal_px']['value'] == pytest.approx(225.0, rel=0.02)
    poses = []
    errors = []
    for parameters in (out / 'calibration.yaml', tmp_path / 'without.yaml'):
        if not parameters.exists():  # the same with the lens of the CameraInfo
            document = yaml.safe_load((out / 'calibration.yaml').read_text())
            given = document['/**']['ros__parameters']
            for name in ('camera_matrix', 'distortion_model', 'distortion_coefficients'):
                del given[name]
            parameters.write_text(yaml.safe_dump(document))
        assert main(
            [
                'replay',
                str(path),
                '--params',
                str(parameters),
                '--no-pictures',
                '--out',
                str(tmp_path / parameters.stem),
            ]
        ) in (0, 1)
        rows = rows_of(tmp_path / parameters.stem / 'relative_poses.csv')
        poses.append(sum(row['tx'] != '' for row in rows) / len(rows))
        errors.append(
            np.median(
                [
                    float(row['translation_error_deg'])
                    for row in rows_of(tmp_path / parameters.stem / 'errors.csv')
                    if row['translation_error_deg']
                ]
            )
        )
    assert poses[0] >= 0.9
    # With the lens of the CameraInfo, which the monitor names, the pose before is right by chance.
    assert errors[0] < 0.5 and poses[1] < 0.3


def test_lens_whose_coefficients_cancel_is_found(tmp_path):
    """Of a RealSense, whose CameraInfo has no distortion; k1 alone would be about zero."""
    true = (0.163, -0.520, 0.0, 0.0, 0.474)
    config = replace(SMALL, distortion=true, duration=6.0)
    write_bag(simulate(config), tmp_path / 'walk')
    path = copied(tmp_path / 'walk', tmp_path / 'bag', nominal)
    out = tmp_path / 'out'
    code, values = calibrated(path, out, '--lens')
    assert code == 0
    for found, expected in zip(values['distortion'], (0.163, -0.520, 0.474), strict=True):
        assert abs(found['value'] - expected) < 3.0 * found['sigma']
    assert values['distortion'][0]['value'] > 3.0 * values['distortion'][0]['sigma']
    focal = values['focal_px']
    assert abs(focal['value'] - SMALL.fx) < 3.0 * focal['sigma'] < 0.1 * SMALL.fx
    intrinsics = read_parameters(out / 'calibration.yaml').intrinsics.of_image(320, 240)
    assert intrinsics.distortion_model == 'plumb_bob'
    assert len(intrinsics.distortion) == 5
    np.testing.assert_allclose(intrinsics.distortion[2:4], 0.0, atol=2.0 * TANGENTIAL_SIGMA)
    assert intrinsics.distortion[4] == pytest.approx(values['distortion'][2]['value'], abs=1e-5)


def test_lens_is_estimated_about_the_distortion_of_a_camera_info(bag, tmp_path):
    code, values = calibrated(bag, tmp_path / 'out', '--lens')
    assert code == 0
    camera = SMALL.camera
    for found, expected in zip(values['distortion'], camera.radial_coefficients, strict=True):
        assert abs(found['value'] - expected) < 3.0 * found['sigma']
    # The CameraInfo knows tangential coefficients better than most motions show them.
    written = read_parameters(tmp_path / 'out' / 'calibration.yaml').intrinsics
    sideways = written.of_image(320, 240).distortion[2:4]
    np.testing.assert_allclose(sideways, camera.distortion[2:4], atol=2.0 * TANGENTIAL_SIGMA)


def test_lens_of_a_binned_image_is_not_estimated(bag, tmp_path, capsys):
    path = copied(bag, tmp_path / 'bag', binned)
    assert main(['calibrate', str(path), '--lens', '--out', str(tmp_path / 'out')]) == 2
    assert 'binning' in capsys.readouterr().err


def blank(message: Any) -> None:
    if hasattr(message, 'data'):
        message.data = cv2.imencode('.jpg', np.full((240, 320), 120, np.uint8))[1].ravel()


def no_gyro(message: Any) -> None:
    if hasattr(message, 'angular_velocity'):
        message.angular_velocity_covariance = np.array([-1.0] + 8 * [0.0])


@pytest.mark.parametrize(
    ('change', 'record_instead'),
    [
        (blank, 'texture'),
        (no_gyro, 'angular velocity'),
        (lambda message: hasattr(message, 'angular_velocity'), 'Imu'),
    ],
    ids=['no texture', 'no gyro', 'no IMU'],
)
def test_bags_that_are_refused(bag, change, record_instead, tmp_path, refused):
    unusable = copied(bag, tmp_path / 'bag', change)
    refused(record_instead, 'calibrate', unusable, '--out', tmp_path / 'out')
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize(
    'option, values, text',
    [
        ('--rows', ['500', '900'], '--rows 500 900 leave nothing of an image of 240 rows'),
        ('--max-offset', ['-1'], '--max-offset must be'),
        ('--rows', ['-5', '100'], '--rows must be'),
        ('--rows', ['100', '50'], '--rows must be'),
    ],
)
def test_illegal_values_are_named_by_their_option(bag, option, values, text, tmp_path, refused):
    refused(f'error: {text}', 'calibrate', bag, option, *values, '--out', tmp_path)


EUROC = RollingShutterCamera(
    width=752,
    height=480,
    fx=458.654,
    fy=457.296,
    cx=367.215,
    cy=248.375,
    distortion_model='plumb_bob',
    distortion=(-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0),
    readout_time=0.0,
)


def gyro_of(path: Path) -> GyroSeries:
    return GyroSeries(
        np.loadtxt(path, delimiter=',', usecols=0, dtype=np.int64),
        np.loadtxt(path, delimiter=',', usecols=(1, 2, 3)),
    )


def corners_of(path: Path, frames: slice) -> TrackedPoints:
    with tarfile.open(path) as archive:
        names = sorted(name for name in archive.getnames() if name.endswith('.csv'))[frames]
        lines = [archive.extractfile(name).read().decode().split()[1:] for name in names]
    values = np.loadtxt([line for of_frame in lines for line in of_frame], delimiter=',')
    return TrackedPoints(
        np.array([int(Path(name).stem) for name in names]),
        np.repeat(np.arange(len(names)), [len(of_frame) for of_frame in lines]),
        (4 * values[:, 10] + values[:, 11]).astype(np.int64),
        values[:, 5:7],
    )


@pytest.mark.recordings
def test_corners_of_a_global_shutter(recordings):
    folder = recordings / 'euroc_imu_april_corners'
    tracks = corners_of(folder / 'cam0_corners.tar.gz', slice(900, 1200))
    result = procedure.calibrate(tracks, gyro_of(folder / 'imu0.csv'), EUROC)
    assert abs(result.readout_time.value) <= 1e-3
    assert result.shutter == 'global'
    assert abs(result.time_offset.value) <= 1e-3
    # Extrinsics and gyro bias of the data set.
    sensor = (recordings / 'euroc_v101_10frames' / 'cam0_sensor.yaml').read_text()
    given = np.array(yaml.safe_load(sensor.split('\n', 1)[1])['T_BS']['data']).reshape(4, 4)
    turn = Rotation.from_matrix(result.R_cam_imu @ given[:3, :3]).magnitude()
    # Those of the two folders differ by 0.3 deg.
    assert np.degrees(turn) < 1.0
    biases = [bias.value for bias in result.gyro_bias]
    # A plane and the folder's intrinsics, which the corners contradict, leave up to 0.012 rad/s.
    np.testing.assert_allclose(biases, (-0.0016, 0.0250, 0.0777), atol=0.02)


@pytest.mark.recordings
def test_phone_in_a_car(converted, tmp_path):
    """Its README: readout 31.1 ms, offset -2.4 ms, and these axes."""
    _, values = calibrated(converted('xiaomi_cc9_rs'), tmp_path, '--rows', '0', '420')
    assert values['readout_time_s']['value'] == pytest.approx(0.031, abs=1.5e-3)
    assert values['time_offset_s']['value'] == pytest.approx(-0.0024, abs=2e-3)
    assert values['axis_map'] == [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]
    assert values['shutter'] == 'rolling'


@pytest.mark.recordings
def test_a_hand_that_turns_too_slowly_leaves_the_readout_time_open(converted, tmp_path):
    """Its README: 31.5 ms; offset -56 to -60 ms by the exposure.

    4.8 s at 3 to 4 deg/s are too little for the readout time, which is not observable. It and the
    rotation, known to half a degree, agree with the README within their sigmas.
    """
    _, values = calibrated(converted('realsense_rgb_rs'), tmp_path)
    readout = values['readout_time_s']
    assert not readout['observable']
    # The sigma is that of a readout time that nothing is known of where both halves differ.
    assert abs(readout['value'] - 0.0315) < 2.0 * readout['sigma'] <= 2.0 * 0.03
    assert values['shutter'] != 'global'  # about 5 sigma from zero: rolling from there on
    assert values['time_offset_s']['value'] == pytest.approx(-0.058, abs=5e-3)
    assert values['offset_by_interval']['value'] < 0.0
    assert np.allclose(values['axis_map'], np.eye(3))
    expected = Rotation.from_quat([-0.0018, -0.0021, 0.0016, 1.0])
    apart = (expected * Rotation.from_quat(values['quat_cam_imu_xyzw']).inv()).as_rotvec()
    assert (np.abs(apart) < 3.0 * np.array(values['rotation_sigma_rad'])).all()
    assert max(values['rotation_sigma_rad']) > 5e-3
