"""A node without parameters: it calibrates itself, stores the result, and uses the file."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
import os
from pathlib import Path
import time
from typing import Any
from unittest.mock import MagicMock

from conftest import BUNDLED_PARAMETERS
from diagnostic_msgs.msg import DiagnosticArray
import fault_stream as faults
from geometry_msgs.msg import PoseWithCovarianceStamped
import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from scipy.spatial.transform import Rotation
from small_walks import bag_of, small_walk
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_node_settings import FAKE_TF2_ROS

from rs_relpose_lab.live.graph import diagnostic_values, Graph
from rs_relpose_lab.live.processes import node_process, player_process, wait_until
from rs_relpose_ros.bags import sensor_topics
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.calibrate import live, stored
from rs_relpose_ros.calibrate.live import LiveCalibration
from rs_relpose_ros.calibrate.stored import Calibrated, CameraId, Progress
from rs_relpose_ros.config.files import read_parameters, text_values
from rs_relpose_ros.config.settings import Parameters, StoredCalibrationConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.messages.incoming import Role, sensor_messages
from rs_relpose_ros.nodes.inputs import LATCHED
from rs_relpose_ros.nodes.sensor_node import SensorNode
from rs_relpose_ros.pipeline.sequencer import Refusal

QUATERNION = (0.0, 0.0, 0.0, 1.0)
CAMERA = CameraId('a/b:c', 320, 240)
TEXT = '/**:\n  ros__parameters:\n    readout_time: 0.02\n    readout_time_sigma: 0.001\n'
TRUTH = small_walk(8.0)


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bag_of(TRUTH, tmp_path_factory.mktemp('walk'))


# -- the file ------------------------------------------------------------------------------------


def test_a_stored_calibration_is_of_its_camera_only(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    path = stored.path_of(StoredCalibrationConfig(), CAMERA)
    assert path == tmp_path / 'rs_relpose' / 'a_b_c_320x240.yaml'
    stored.save(path, CAMERA, TEXT)
    values, text = stored.load(path, CAMERA)
    assert values == {'readout_time': 0.02, 'readout_time_sigma': 0.001} and '+- 1.00 ms' in text
    assert [item.name for item in path.parent.iterdir()] == [path.name]
    for other in (CameraId('a/b:d', 320, 240), CameraId('a/b:c', 640, 240)):
        with pytest.raises(InputError, match='is for the camera'):
            stored.load(path, other)
    path.write_text(TEXT)
    with pytest.raises(InputError, match='rs_relpose_calibration'):
        stored.load(path, CAMERA)


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / 'file').write_text('')
    config = StoredCalibrationConfig(calibration_file=str(tmp_path / 'file' / 'c.yaml'))
    with pytest.raises(InputError, match=r'c\.yaml.*calibration_file'):
        stored.save(stored.path_of(config, CAMERA), CAMERA, TEXT)


def test_a_typo_in_an_edited_file_is_named(tmp_path):
    path = tmp_path / 'file.yaml'
    stored.save(path, CAMERA, TEXT)
    good = path.read_text()
    for old, new, named in (
        ('readout_time:', 'readout_tim:', 'did you mean readout_time'),
        ('0.02', "'fast'", 'readout_time must be'),
        (':', '', 'YAML'),
        ('  ros__parameters:', '  parameters:', 'ros__parameters'),
    ):
        path.write_text(good.replace(old, new, 1))
        with pytest.raises(InputError, match=named) as error:
            stored.load(path, CAMERA)
        assert str(path) in str(error.value)
        with pytest.raises(InputError, match=f'(?s){named}.*It is kept.*save_calib'):
            stored.save(path, CAMERA, TEXT, replace=False)
        assert path.read_text() != good


def test_two_cameras_of_one_frame_id_do_not_share_a_file(tmp_path):
    path = tmp_path / 'file.yaml'
    left, right = (replace(CAMERA, topic=topic) for topic in ('/left/image', '/right/image'))
    stored.save(path, left, TEXT)
    assert stored.load(path, left)[0]['readout_time'] == 0.02
    with pytest.raises(InputError, match=r'on /left/image, not on /right/image.*camera_name'):
        stored.load(path, right)
    assert stored.load(path, CAMERA)  # the user has named it


def test_a_user_without_a_home_directory(monkeypatch, bag):
    def without() -> Path:
        raise RuntimeError('Could not determine home directory.')

    monkeypatch.delenv('ROS_HOME', raising=False)
    monkeypatch.setattr(Path, 'home', without)
    calibration = LiveCalibration(Parameters(), use_stored=True)
    found = next(outcome for outcome in outcomes(bag, calibration) if outcome is not None)
    calibration.close()
    assert isinstance(found, InputError) and 'ROS_HOME' in str(found)
    # A result is used all the same.
    node = MagicMock(calibrates=True)
    node._settings.current = Parameters.from_mapping(KNOWN)
    SensorNode._use_calibration(node, Calibrated(CAMERA, TEXT, ''))
    assert 'ROS_HOME' in node._error.call_args.args[0]
    assert node.adopt.call_args.args[0] == TEXT and node._begin.called


# -- without ROS ---------------------------------------------------------------------------------


def outcomes(
    bag: Path, calibration: LiveCalibration, *, moving: bool = True, images: int = 1000
) -> Iterator[Any]:
    """Outcomes of the messages, the fits awaited; not `moving`: of the first image and a gyro."""
    first: Any = None
    with open_bag(bag) as opened:
        for role, message in sensor_messages(opened, opened.find_topics({})):
            content = message.message
            images -= role is Role.IMAGE
            if images < 0:
                return
            if not moving and role is Role.IMAGE:
                first = content if first is None else first
                content.data = first.data
            elif not moving and role is Role.IMU:
                content.angular_velocity.x = content.angular_velocity.y = 0.01
                content.angular_velocity.z = 0.0
            calibration.receive(role, content)
            yield calibration.step()
            while calibration.fitting:
                yield calibration.step(0.02)


@pytest.fixture
def calibration() -> Iterator[LiveCalibration]:
    with closing(LiveCalibration(Parameters(), use_stored=False)) as calibrating:
        yield calibrating


def is_near_the_truth(parameters: str) -> bool:
    values = text_values(parameters, 'text')
    turn = Rotation.from_quat(values['quat_cam_imu_xyzw']).as_matrix() @ TRUTH.R_cam_imu.T
    return (
        abs(values['readout_time'] - 0.02) < 4.0 * values['readout_time_sigma'] < 8e-3
        and abs(values['time_offset'] - 0.03) < 4.0 * values['time_offset_sigma'] < 8e-3
        and Rotation.from_matrix(turn).magnitude() < 0.03
    )


def test_a_recording_that_is_too_short_counts_when_it_is_looped(bag, calibration, monkeypatch):
    """The stamps begin again, and so does a clock that is set back."""
    monkeypatch.setattr(live, '_SILENCE', 0.0)
    assert not any(
        isinstance(outcome, Calibrated) for outcome in outcomes(bag, calibration, images=120)
    )
    short = calibration.step()
    assert 'after 4.0 s, too short' in short.text
    assert calibration.step() is None
    found = list(outcomes(bag, calibration, images=120))
    assert is_near_the_truth(
        next(outcome.parameters for outcome in found if isinstance(outcome, Calibrated))
    )


def test_images_that_come_too_fast_are_counted(bag, calibration):
    with open_bag(bag) as opened:
        for role, message in sensor_messages(opened, opened.find_topics({}), (Role.IMAGE,)):
            calibration.receive(role, message.message)
    while calibration.step() is not None or calibration.counts().frames_taken < 8:
        pass
    counts = calibration.counts()
    assert (counts.frames, counts.frames_taken) == (240, 8)
    assert counts.refused == {Refusal.OVERLOAD: 232}


def test_a_camera_at_rest_is_never_calibrated_and_the_motion_is_named(bag, calibration):
    found = [
        outcome for outcome in outcomes(bag, calibration, moving=False) if outcome is not None
    ]
    assert {type(outcome) for outcome in found} == {Progress}
    assert 'about all three axes' in found[-1].text


# -- the node ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'given', [{}, {'readout_time': 0.02, 'quat_cam_imu_xyzw': (0.0, 0.0, 0.0, 1.0)}]
)
def test_a_file_that_lacks_a_parameter_is_not_read_again(given):
    """Edited by hand: the node calibrates, in place of reading it once a second."""
    node = MagicMock(calibrates=True)
    node._settings.current = Parameters.from_mapping(given)
    SensorNode._use_calibration(node, Calibrated(CAMERA, TEXT, '', new=False))
    node._begin.assert_called_once_with(calibrate=not given)
    assert node._warn.called == (not given)


KNOWN = {
    'readout_time': 0.02,
    'quat_cam_imu_xyzw': tuple(Rotation.from_matrix(TRUTH.R_cam_imu).as_quat()),
}


@pytest.mark.parametrize(
    ('given', 'frames', 'turn', 'adopted', 'warned'),
    [
        (KNOWN, {Role.IMAGE: 'camera', Role.IMU: 'imu'}, 0.02, True, False),
        (KNOWN, {Role.IMAGE: 'camera', Role.IMU: 'imu'}, 0.2, False, True),
        (KNOWN, {Role.IMAGE: 'camera', Role.IMU: 'other'}, 0.02, False, False),
        (KNOWN, {Role.IMAGE: 'same', Role.IMU: 'same'}, 0.02, False, False),
        (KNOWN, {Role.IMAGE: 'camera'}, 0.02, False, False),
        ({'readout_time': 0.02}, {Role.IMAGE: 'camera', Role.IMU: 'imu'}, 0.2, True, False),
    ],
)
def test_extrinsics_are_those_of_tf(given, frames, turn, adopted, warned):
    quaternion = (
        Rotation.from_rotvec([0.0, turn, 0.0]) * Rotation.from_matrix(TRUTH.R_cam_imu)
    ).as_quat()
    known = {('camera', 'imu'): (0.1, 0.2, 0.3, *quaternion), ('same', 'same'): (0.0,) * 7}
    node = MagicMock(_lookup=lambda parent, child: known.get((parent, child)), _calibration=None)
    node._settings.current = Parameters.from_mapping(given)
    SensorNode._use_transform(node, frames)
    assert node._settings.adopt.called == adopted
    assert node._warn.called == warned
    assert (node._lookup is None) == (adopted or warned)
    if adopted:
        values = node._settings.adopt.call_args.args[0]
        assert values['imu_position'] == (0.1, 0.2, 0.3)
        assert ('quat_cam_imu_xyzw' in values) == ('quat_cam_imu_xyzw' not in given)


def test_a_calibration_starts_from_the_rotation_of_tf():
    """It is used as it is only where nothing else is missing, or to be calibrated."""
    node = MagicMock(
        _lookup=lambda parent, child: (0.1, 0.2, 0.3, *QUATERNION), _waits_for_tf=lambda: False
    )
    node._settings.current = Parameters()
    SensorNode._use_transform(node, {Role.IMAGE: 'camera', Role.IMU: 'imu'})
    assert node._calibration.quat_prior == node._quat_prior == QUATERNION
    assert not node._settings.adopt.called and node._lookup is not None


@pytest.mark.live
def test_a_node_waits_for_the_transform_and_names_the_missing_frame(
    ros_domain_id, bundled_bag, tmp_path, monkeypatch
):
    """tf2_ros is in no wheel: a stand-in that knows the transform once a file exists."""
    values = ' '.join(
        map(str, (0.1, 0.2, 0.3, *read_parameters(BUNDLED_PARAMETERS).sensor.quat_cam_imu_xyzw))
    )
    (tmp_path / 'tf2_ros.py').write_text(FAKE_TF2_ROS)
    monkeypatch.setenv(
        'PYTHONPATH',
        os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get('PYTHONPATH')])]),
    )
    monkeypatch.setenv('TF', f'{sensor_topics.CAMERA_FRAME} {sensor_topics.IMU_FRAME} {values}')
    monkeypatch.setenv('TF_FILE', str(tmp_path / 'tf'))
    messages = faults.read_messages(bundled_bag, 1.5)
    given = {'readout_time': 0.03, 'calibrate_at_start': 'never', 'image_transport': 'raw'}
    with Graph() as graph, node_process(remap=faults.BAG_TOPICS, parameters=given) as node:
        poses = graph.listen(PoseWithCovarianceStamped, '/relpose_node/relative_pose')
        node.wait_for('waiting for the first image')
        publishers = faults.drivers(graph)
        faults.play(publishers, messages)
        node.wait_for(f'on /tf_static: "{sensor_topics.IMU_FRAME}"')
        (tmp_path / 'tf').touch()
        node.wait_for(
            f'from /tf_static, {sensor_topics.IMU_FRAME} in {sensor_topics.CAMERA_FRAME}: '
            'quat_cam_imu_xyzw'
        )
        wait_until(lambda: node.output.count('ready:') == 1, 'a start', node)
        faults.play(publishers, messages, later=100.0)
        wait_until(lambda: poses, 'a pose', node)
        assert 'Traceback' not in node.output


def test_services_that_cannot_be_done_say_why(tmp_path):
    node = MagicMock(_cannot_start='', _loop=None, _calibrated=None)

    def called(service: Any) -> Any:
        response = service(node, None, Trigger.Response())
        assert not response.success
        return response.message

    assert 'calibrating' in called(SensorNode._reset)
    assert '~/calibrate' in called(SensorNode._save_now)
    (tmp_path / 'file').touch()
    node._calibrated = Calibrated(CAMERA, TEXT, '')
    node._settings.current = Parameters.from_mapping(
        {'calibration_file': str(tmp_path / 'file' / 'c.yaml')}
    )
    assert 'c.yaml' in called(SensorNode._save_now)
    node._cannot_start = 'a rectified image'
    for service in (SensorNode._reset, SensorNode._calibrate_now):
        assert called(service) == 'a rectified image'


@pytest.mark.live
def test_two_nodes_of_one_name_and_messages_without_frame_id_are_reported(
    ros_domain_id, bundled_bag
):
    messages = faults.read_messages(bundled_bag, 1.0)
    for _, message in messages:
        message.header.frame_id = ''
    with (
        Graph() as graph,
        node_process(
            BUNDLED_PARAMETERS, remap=faults.BAG_TOPICS, parameters={'image_transport': 'raw'}
        ) as node,
    ):
        node.wait_for('ready')
        assert 'another node' not in node.output
        faults.play(faults.drivers(graph), messages)
        node.wait_for(f'messages on {faults.BAG_TOPICS["image"]} have no frame_id')
        with node_process(BUNDLED_PARAMETERS, remap=faults.BAG_TOPICS) as other:
            for one in (node, other):
                one.wait_for('another node has the name /relpose_node')


@pytest.mark.live
def test_other_nodes_take_the_published_calibration(ros_domain_id):
    text = TEXT + '    quat_cam_imu_xyzw: [0.0, 0.0, 0.0, 1.0]\n    axes_sigma: 0.01\n'
    topic = '/relpose_node/calibration'
    with (
        Graph() as graph,
        node_process(node='odometry_node', remap={'calibration': topic}) as odometry,
        node_process(node='global_shutter_node', remap={'calibration': topic}) as global_shutter,
    ):
        nodes = odometry, global_shutter
        for node in nodes:
            node.wait_for('waiting for')
        graph.node.create_publisher(String, topic, LATCHED).publish(String(data=text))
        for node in nodes:
            node.wait_for('ready')
            node.stop()


@pytest.mark.live
@pytest.mark.timeout(600)
def test_a_node_without_parameters_calibrates_itself(bag, ros_domain_id, tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    start = {
        'parameters': {
            'image_transport': 'compressed',
            **faults.reliable(sensor_topics.COMPRESSED_TOPIC, sensor_topics.IMU_TOPIC),
        },
        'remap': faults.BAG_TOPICS,
    }
    path = tmp_path / 'rs_relpose' / 'camera_optical_frame_320x240.yaml'
    with Graph() as graph:
        poses = graph.listen(PoseWithCovarianceStamped, '/relpose_node/relative_pose')
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        published: list[String] = []
        graph.node.create_subscription(
            String, '/relpose_node/calibration', published.append, LATCHED
        )
        with node_process(**start) as node:
            node.wait_for('waiting for the first image')
            with player_process(bag) as playing:
                assert playing.wait() == 0
            node.wait_for(f'stored in {path}')
            states = {diagnostic_values(item)['state'] for item in diagnostics}
            assert 'calibrating' in states
            node.wait_for('ready')
            with player_process(bag) as playing:
                wait_until(lambda: poses, 'a pose', node, playing)
            wait_until(lambda: published, 'the calibration', node)
            assert is_near_the_truth(published[0].data)
            path.unlink()
            assert graph.call(Trigger, '/relpose_node/save_calibration', Trigger.Request()).success
            assert is_near_the_truth(path.read_text())
            node.stop()
        # The second start takes the file; values can be set while it runs.
        with node_process(**start) as node:
            node.wait_for('waiting for the first image')
            with player_process(bag):
                node.wait_for('using the calibration of')
            node.wait_for('ready')
            request = SetParameters.Request(
                parameters=[
                    Parameter('readout_time', value=value).to_parameter_msg()
                    for value in (0.0201, 0.0202)
                ]
            )  # the second while the kernels are loaded
            assert (
                graph.call(SetParameters, '/relpose_node/set_parameters', request)
                .results[1]
                .successful
            )
            wait_until(lambda: node.output.count('ready:') > 1, 'a new start', node)
            time.sleep(0.3)
            assert node.output.count('ready:') == 2  # one timer waits for them
            assert 'Traceback' not in node.output
            node.stop()
