"""Calibration of real recordings, against what their folders say."""

from __future__ import annotations

import io
import json
from pathlib import Path
import tarfile

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
import yaml

from rs_relpose_ros.calibrate.gyro_path import GyroSeries
from rs_relpose_ros.calibrate.procedure import calibrate
from rs_relpose_ros.calibrate.tracks import Tracks
from rs_relpose_ros.cli.main import main
from rs_relpose_ros.geometry.camera import RollingShutterCamera

pytestmark = pytest.mark.recordings

EUROC = RollingShutterCamera(
    width=752, height=480, fx=458.654, fy=457.296, cx=367.215, cy=248.375,
    distortion_model='plumb_bob',
    distortion=(-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0), readout_time=0.0)


def gyro_of(path: Path) -> GyroSeries:
    return GyroSeries(np.loadtxt(path, delimiter=',', usecols=0, dtype=np.int64),
                      np.loadtxt(path, delimiter=',', usecols=(1, 2, 3)))


def corners_of(path: Path, frames: slice) -> Tracks:
    stamps, frame, ids, points = [], [], [], []
    with tarfile.open(path) as archive:
        names = sorted(name for name in archive.getnames() if name.endswith('.csv'))[frames]
        for index, name in enumerate(names):
            text = archive.extractfile(name).read().decode()
            rows = [line for line in text.splitlines()[1:] if line]
            stamps.append(int(Path(name).stem))
            if rows:
                values = np.loadtxt(io.StringIO('\n'.join(rows)), delimiter=',', ndmin=2)
                frame.append(np.full(len(rows), index))
                ids.append((4 * values[:, 10] + values[:, 11]).astype(np.int64))
                points.append(values[:, 5:7])
    return Tracks(np.array(stamps), np.concatenate(frame), np.concatenate(ids),
                  np.concatenate(points))


def test_corners_of_a_global_shutter(recordings):
    folder = recordings / 'euroc_imu_april_corners'
    tracks = corners_of(folder / 'cam0_corners.tar.gz', slice(900, 1200))
    result = calibrate(tracks, gyro_of(folder / 'imu0.csv'), EUROC)
    assert abs(result.readout_time.value) <= 1e-3
    assert result.shutter == 'global'
    assert abs(result.time_offset.value) <= 1e-3
    # Its extrinsics, and its gyro's well known bias, as the folders give them.
    sensor = (recordings / 'euroc_v101_10frames' / 'cam0_sensor.yaml').read_text()
    given = np.array(yaml.safe_load(sensor.split('\n', 1)[1])['T_BS']['data']).reshape(4, 4)
    turn = Rotation.from_matrix(result.R_cam_imu @ given[:3, :3]).magnitude()
    # Both folders' own figures differ by 0.3 deg.
    assert np.degrees(turn) < 1.0
    biases = [bias.value for bias in result.gyro_bias]
    # A plane and the folder's intrinsics, which the corners contradict, leave up to 0.012 rad/s.
    np.testing.assert_allclose(biases, (-0.0016, 0.0250, 0.0777), atol=0.02)


def calibrated(recordings: Path, name: str, tmp_path: Path, *options: str) -> dict[str, object]:
    bag = tmp_path / name
    assert main(['convert', name, str(recordings / name), str(bag)]) == 0
    main(['calibrate', str(bag), '--out', str(tmp_path / 'out'), *options])
    figures = json.loads((tmp_path / 'out' / 'calibration.json').read_text())
    assert isinstance(figures, dict)
    return figures


def test_phone_in_a_car(recordings, tmp_path):
    """Its README: read-out 31.1 ms, offset -2.4 ms, and these axes."""
    figures = calibrated(recordings, 'xiaomi_cc9_rs', tmp_path, '--rows', '0', '420')
    assert figures['readout_time_s']['value'] == pytest.approx(0.031, abs=1.5e-3)
    assert figures['time_offset_s']['value'] == pytest.approx(-0.0024, abs=2e-3)
    assert figures['axis_map'] == [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]
    assert figures['shutter'] == 'rolling'


def test_slow_hand(recordings, tmp_path):
    """Its README estimates 28 ms, without a sigma; offset -56 to -58 ms by the exposure.

    4.8 s at 3 to 4 deg/s are too little for the read-out time and the rotation: neither is
    observable, and what is told agrees with the README within its sigma.
    """
    figures = calibrated(recordings, 'realsense_rgb_rs', tmp_path)
    readout = figures['readout_time_s']
    assert not readout['observable']
    assert abs(readout['value'] - 0.028) < 2.0 * readout['sigma'] < 15e-3
    assert figures['shutter'] == 'rolling'
    assert figures['time_offset_s']['value'] == pytest.approx(-0.057, abs=5e-3)
    assert figures['offset_by_interval']['value'] < 0.0
    assert np.allclose(figures['axis_map'], np.eye(3))
    assert not figures['rotation_from_axis_map_rad']['observable']
