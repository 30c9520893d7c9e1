"""``rs_relpose calibrate`` from bag to parameter file, and bags that it refuses."""

from __future__ import annotations

from collections.abc import Callable
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.calibration_tracks import about_one_axis
from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.bag import write_bag
from rs_relpose_lab.simulation.trajectory import Trajectory
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.calibrate import follow
from rs_relpose_ros.cli.main import main
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.errors import MissingInputError
from rs_relpose_ros.tracking.tracker import make_tracker

IMAGE, IMU = '/camera/image_raw/compressed', '/imu/data_raw'


def small(**given: Any) -> SimulationConfig:
    values: dict[str, Any] = {
        'duration': 3.0, 'width': 320, 'height': 240, 'fx': 225.0, 'edge_samples': 1,
        'plan': 'walk:3', 'readout_time': 0.02, 'time_offset': 0.03, 'seed': 5} | given
    return SimulationConfig(**values)


def rendered(folder: Path, config: SimulationConfig,
             trajectory: Trajectory | None = None) -> Path:
    write_bag(simulate(config, trajectory=trajectory), folder)
    return folder


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rendered(tmp_path_factory.mktemp('walk') / 'bag', small())


def calibrated(bag: Path, out: Path) -> tuple[int, dict[str, Any]]:
    code = main(['calibrate', str(bag), '--out', str(out)])
    return code, json.loads((out / 'calibration.json').read_text())


def test_bag_gives_a_parameter_file_that_the_node_takes(bag, tmp_path, capsys):
    code, figures = calibrated(bag, tmp_path)
    truth = small()
    assert code == 0
    assert 'shutter: rolling' in capsys.readouterr().out
    assert figures['readout_time_s']['value'] == pytest.approx(0.02, abs=1.5e-3)
    assert figures['time_offset_s']['value'] == pytest.approx(0.03, abs=1.5e-3)
    sensor = read_parameters(tmp_path / 'calibration.yaml').sensor
    turn = Rotation.from_matrix(sensor.R_cam_imu @ truth.R_cam_imu.T).magnitude()
    assert np.degrees(turn) < 0.6
    assert sensor.readout_time == pytest.approx(figures['readout_time_s']['value'], abs=1e-6)
    picture = cv2.imread(str(tmp_path / 'cost_over_readout.png'))
    assert picture is not None and picture.std() > 5.0


def test_chosen_tracker_follows_the_points(bag, tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(follow, 'make_tracker', lambda config: made.append(config) or make_tracker(
        config))
    assert main(['calibrate', str(bag), '--detector', 'sift', '--out', str(tmp_path)]) in (0, 1)
    figures = json.loads((tmp_path / 'calibration.json').read_text())
    assert [config.detector for config in made] == ['sift']
    assert figures['readout_time_s']['value'] == pytest.approx(0.02, abs=4e-3)
    assert figures['time_offset_s']['value'] == pytest.approx(0.03, abs=4e-3)
    assert figures['shutter'] == 'rolling'


@pytest.mark.long
def test_bag_of_a_global_shutter(tmp_path):
    code, figures = calibrated(rendered(tmp_path / 'bag', small(readout_time=0.0)),
                               tmp_path / 'out')
    assert code == 0
    assert figures['shutter'] == 'global'
    assert abs(figures['readout_time_s']['value']) < 1e-3


@pytest.mark.long
def test_bag_of_a_global_shutter_and_of_one_axis(tmp_path, capsys):
    """The rotation about the only axis cannot be told, read-out time and offset can.

    What lens and gyro may differ by moves the read-out of one axis by more than a millisecond,
    however long the recording: whether the shutter is global is then not sure.
    """
    config = small(readout_time=0.0)
    path = rendered(tmp_path / 'bag', config, about_one_axis(0, 3.0))
    code, figures = calibrated(path, tmp_path / 'out')
    assert code == 1
    assert figures['shutter'] == 'unsure'
    assert abs(figures['readout_time_s']['value']) < 1e-3 < figures['readout_time_s']['sigma']
    assert not figures['rotation_from_axis_map_rad']['observable']
    assert 'NOT OBSERVABLE: the camera turns about one axis only' in capsys.readouterr().out
    # The file leaves out what was not told, and the node asks for it.
    with pytest.raises(MissingInputError, match='quat_cam_imu_xyzw is not set'):
        _ = read_parameters(tmp_path / 'out/calibration.yaml').sensor.R_cam_imu


# -- refused ----------------------------------------------------------------------------------


def changed(bag: Path, path: Path, change: Callable[[str, Any], Any]) -> Path:
    """A copy of a bag with `change` applied to its messages; those it makes None are left out."""
    with open_bag(bag) as source, BagWriter(path) as copy:
        for item in source.messages(source.topics):
            message = change(item.topic, item.message)
            if message is not None:
                copy.write(item.topic, message.__msgtype__, message, item.bag_time_ns)
    return path


def repainted(paint: Callable[[np.ndarray], np.ndarray]) -> Callable[[str, Any], Any]:
    def change(topic: str, message: Any) -> Any:
        if topic == IMAGE:
            image = cv2.imdecode(np.asarray(message.data), cv2.IMREAD_GRAYSCALE)
            message.data = cv2.imencode('.jpg', paint(image))[1].ravel()
        return message
    return change


def refused(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(['calibrate', str(bag), '--out', str(tmp_path / 'out')]) == 2
    assert not (tmp_path / 'out').exists()
    return capsys.readouterr().err


def test_bag_without_texture(bag, tmp_path, capsys):
    bare = changed(bag, tmp_path / 'bare', repainted(lambda image: np.full_like(image, 120)))
    assert 'Record a scene with texture' in refused(bare, tmp_path, capsys)


def test_blurred_bag(bag, tmp_path, capsys):
    blurred = changed(bag, tmp_path / 'blurred', repainted(
        lambda image: cv2.blur(image, (161, 161))))
    assert 'Record' in refused(blurred, tmp_path, capsys)


def test_bag_without_a_gyro(bag, tmp_path, capsys):
    def no_gyro(topic: str, message: Any) -> Any:
        if topic == IMU:
            message.angular_velocity_covariance = np.array([-1.0] + 8 * [0.0])
        return message
    deaf = changed(bag, tmp_path / 'deaf', no_gyro)
    assert 'record the angular velocity' in refused(deaf, tmp_path, capsys)


def test_bag_without_an_imu(bag, tmp_path, capsys):
    lone = changed(bag, tmp_path / 'lone',
                   lambda topic, message: None if topic == IMU else message)
    assert 'Imu' in refused(lone, tmp_path, capsys)


def test_rows_below_the_image_are_refused(bag, tmp_path, capsys):
    assert main(['calibrate', str(bag), '--rows', '500', '900', '--out', str(tmp_path)]) == 2
    assert '--rows 500 900 leave nothing of an image of 240 rows' in capsys.readouterr().err


@pytest.mark.parametrize('option, values', [
    ('--max-offset', ['-1']), ('--rows', ['-5', '100']), ('--rows', ['100', '50'])])
def test_illegal_values_are_named_by_their_option(bag, option, values, tmp_path, capsys):
    assert main(['calibrate', str(bag), option, *values, '--out', str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert f'{option} must be' in error
    assert 'feature_rows' not in error and 'max_time_offset' not in error
