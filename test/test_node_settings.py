"""Parameters, QoS overrides and sensors that do not come: what the node says and does."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
import importlib.util
import os
from pathlib import Path
import signal
import time
from typing import Any

from builtin_interfaces.msg import Time
from conftest import BUNDLED_PARAMETERS
from diagnostic_msgs.msg import DiagnosticArray
import fault_stream as faults
from fault_stream import BAG_TOPICS, stamp_of
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
import numpy as np
import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu
from std_srvs.srv import Trigger

from rs_relpose_lab.live.graph import diagnostic_values, Graph
from rs_relpose_lab.live.processes import node_process, Process, wait_until
from rs_relpose_ros.nodes import relpose_node as node_module
from rs_relpose_ros.nodes.inputs import LATCHED

# The first node may have to compile the kernels.
pytestmark = [pytest.mark.live, pytest.mark.timeout(600)]

ERROR = b'\x02'
# Of the bag [s].
PLAYED = 1.5
# Reliable subscriptions, which a publisher of best effort does not match.
RELIABLE = ('/camera/image_raw', '/camera/camera_info')
UNKNOWN_OVERRIDE = 'qos_overrides./camera/nothing.subscription.depth'


@dataclass(frozen=True)
class Running:
    """A node that is ready, its drivers, and the beginning of the bag."""

    graph: Graph
    node: Process
    publishers: dict[type, Any]
    diagnostics: list[DiagnosticArray]
    messages: list[tuple[int, Any]]

    def play(self, *kinds: type, later: float = 0.0) -> None:
        """Publish the bag's messages of these types at bag time, with later stamps [s]."""
        faults.play({kind: self.publishers[kind] for kind in kinds}, self.messages, later)

    def wait_for_status(self, expected: str) -> dict[str, str]:
        """Values of the first report from now on with this error."""
        count = len(self.diagnostics)
        report = wait_until(
            lambda: next(
                (item for item in self.diagnostics[count:] if expected in item.status[0].message),
                None,
            ),
            expected,
            self.node,
            timeout=30.0,
        )
        assert report.status[0].level == ERROR
        return diagnostic_values(report)


@pytest.fixture(scope='module')
def running(module_ros_domain_id: int, bundled_bag: Path) -> Iterator[Running]:
    with (
        Graph() as graph,
        node_process(
            BUNDLED_PARAMETERS,
            remap=BAG_TOPICS,
            parameters={
                'image_transport': 'raw',
                UNKNOWN_OVERRIDE: 3,
                'qos_overrides./imu/data_raw.subscription.durability': 'volatile',
                **faults.reliable(*RELIABLE),
            },
        ) as node,
    ):
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        node.wait_for('ready')
        yield Running(
            graph,
            node,
            faults.drivers(graph, best_effort=[Imu]),
            diagnostics,
            faults.read_messages(bundled_bag, PLAYED),
        )
        assert node.signal(signal.SIGTERM)[0] == 0
        assert 'Traceback' not in node.output


# -- settings of a running node --------------------------------------------------------------


def test_quality_of_service_can_be_overridden_topic_by_topic(running):
    for topic in [*BAG_TOPICS.values(), '/accel']:
        # Of CameraInfo there is another one, for what was latched.
        [info] = wait_until(
            lambda topic=topic: [
                info
                for info in running.graph.node.get_subscriptions_info_by_topic(topic)
                if info.qos_profile.durability is DurabilityPolicy.VOLATILE
            ],
            topic,
        )
        assert info.qos_profile.reliability is (
            ReliabilityPolicy.RELIABLE if topic in RELIABLE else ReliabilityPolicy.BEST_EFFORT
        )
    assert 'there is no parameter' not in running.node.output
    assert running.node.output.count('is no QoS override of this node') == 1
    assert f'{UNKNOWN_OVERRIDE} is no QoS override of this node' in running.node.output


def test_missing_inputs_are_reported(running):
    """No CameraInfo yet, one that cannot be used, then no IMU: each with its reason."""
    running.play(Image)
    running.wait_for_status('not estimating: no CameraInfo on /camera')
    running.play(Image, Imu)
    values = diagnostic_values(running.diagnostics[-1])
    assert (values['missing'], values['poses']) == ('/camera/camera_info', '0')
    assert int(values['frames_refused_no_calibration']) > 25
    running.publishers[CameraInfo].publish(CameraInfo(width=640, height=480))
    assert running.wait_for_status('uncalibrated')['missing'] == 'calibration'
    time.sleep(1.0)  # more than two seconds without an IMU, with what is played next
    running.play(Image, CameraInfo, later=10.0)
    values = running.wait_for_status('not estimating: no IMU message on /imu/data_raw')
    assert values['poses'] == '0'
    lines = [line for line in running.node.output.splitlines() if line.startswith('[ERROR]')]
    assert [
        sum(text in line for line in lines)
        for text in ('no CameraInfo on', 'uncalibrated', 'no IMU message on')
    ] == [1, 1, 1], lines


def set_parameter(graph: Graph, name: str, value: Any) -> Any:
    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
    [result] = graph.call(SetParameters, '/relpose_node/set_parameters', request).results
    return result


def test_a_live_parameter_takes_effect(running):
    """Pairs are created by age alone, as the parallax is not reached."""
    refused = set_parameter(running.graph, 'threshold', -1.0)
    assert not refused.successful and 'threshold' in refused.reason
    assert set_parameter(running.graph, 'min_keyframe_parallax', 900.0).successful
    assert set_parameter(running.graph, 'max_keyframe_interval', 0.9).successful
    # As ros2 param set sends floats and integers.
    assert set_parameter(running.graph, 'gyro_bias', '[0.0, 0, 0]').successful
    running.play(Image, CameraInfo, Imu, later=20.0)
    # The report that counts the last frame.
    count = len(running.diagnostics)
    wait_until(lambda: len(running.diagnostics) >= count + 2, 'diagnostics')
    assert 1 <= int(diagnostic_values(running.diagnostics[-1])['pairs']) <= PLAYED / 0.9 + 1


# -- settings that keep a node from estimating -----------------------------------------------

NEVER = {'calibrate_at_start': 'never'}
QUATERNION = {'quat_cam_imu_xyzw': '[0.0, 0.0, 0.0, 1.0]'}
CANNOT_ESTIMATE = {
    'no_readout': (
        {**QUATERNION, **NEVER, 'readout_tme': 0.03},
        {},
        'not estimating: readout_time must be given',
        'readout_time',
    ),
    'rectified': (
        {'readout_time': 0, **QUATERNION},
        {'image': '/camera/image_rect'},
        '/camera/image_rect is a rectified image',
        '',
    ),
    'global_shutter': (
        NEVER,
        {},
        'not publishing: readout_time and quat_cam_imu_xyzw must be given',
        'readout_time, quat_cam_imu_xyzw',
    ),
}


def test_missing_parameters_are_reported_and_the_node_stays(ros_domain_id):
    """Three nodes at once, each without something."""
    with ExitStack() as stack:
        graph = stack.enter_context(Graph())
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        nodes = {
            name: stack.enter_context(
                node_process(
                    parameters=parameters,
                    remap={**remap, '__node': name},
                    node='global_shutter_node' if name == 'global_shutter' else 'relpose_node',
                )
            )
            for name, (parameters, remap, _, _) in CANNOT_ESTIMATE.items()
        }
        for name, node in nodes.items():
            _, _, expected, missing = CANNOT_ESTIMATE[name]
            report = wait_until(
                lambda name=name: next(
                    (item for item in diagnostics if f'/{name}:' in item.status[0].name), None
                ),
                'diagnostics',
                node,
            )
            assert report.status[0].level == ERROR
            assert expected in report.status[0].message
            assert diagnostic_values(report)['missing'] == missing
            answer = graph.call(Trigger, f'/{name}/reset', Trigger.Request())
            assert not answer.success
            assert expected in answer.message
            assert node.signal(signal.SIGTERM)[0] == 0
            assert node.output.count(expected) == 1
            assert 'Traceback' not in node.output
            assert (
                "there is no parameter 'readout_tme'; did you mean readout_time" in node.output
            ) == (name == 'no_readout')


ESTIMATES = {'readout_time': 0.03, **QUATERNION}
OVERRIDE = 'qos_overrides./image.subscription'
# In place of tf2_ros, which is in no wheel: publishes the transforms to be sent; knows the one of
# the environment variable TF, "parent child x y z qx qy qz qw".
FAKE_TF2_ROS = """
import os
from types import SimpleNamespace


class TransformException(Exception):
    pass


class Buffer:
    def lookup_transform(self, parent, child, time):
        known, names = os.environ.get('TF', '').split(), ('x', 'y', 'z', 'w')
        if known[:2] != [parent, child] or not os.path.exists(os.environ.get('TF_FILE', '/')):
            raise TransformException(f'"{child}" does not exist')
        values = [float(word) for word in known[2:]]
        return SimpleNamespace(transform=SimpleNamespace(
            translation=SimpleNamespace(**dict(zip(names, values[:3]))),
            rotation=SimpleNamespace(**dict(zip(names, values[3:])))))


class TransformListener:
    def __init__(self, buffer, node):
        pass

    def unregister(self):
        pass


class TransformBroadcaster:
    def __init__(self, node):
        self._publisher = node.create_publisher(__import__(
            'geometry_msgs.msg').msg.TransformStamped, '/sent_transform', 10)

    def sendTransform(self, transform):
        self._publisher.publish(transform)
"""


def test_a_camera_without_camera_info_gives_poses_and_transforms(
    ros_domain_id, bundled_bag, tmp_path, monkeypatch
):
    """Its calibration is in the parameters."""
    (tmp_path / 'tf2_ros.py').write_text(FAKE_TF2_ROS)
    monkeypatch.setenv(
        'PYTHONPATH',
        os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get('PYTHONPATH')])]),
    )
    messages = faults.read_messages(bundled_bag, 1.5)
    info = next(message for _, message in messages if isinstance(message, CameraInfo))
    parameters = {
        'camera_matrix': info.k.tolist(),
        'distortion_model': info.distortion_model,
        'distortion_coefficients': list(info.d),
        'image_transport': 'raw',
        'publish_tf': True,
    }
    with (
        Graph() as graph,
        node_process(BUNDLED_PARAMETERS, remap=BAG_TOPICS, parameters=parameters) as node,
    ):
        poses = graph.listen(PoseWithCovarianceStamped, '/relpose_node/relative_pose')
        transforms = graph.listen(TransformStamped, '/sent_transform')
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        node.wait_for('ready')
        for topic in ('/relpose_node/relative_pose', '/sent_transform'):
            graph.wait_for_publisher(topic)
        faults.play(faults.drivers(graph, Image, Imu), messages)
        wait_until(lambda: len(poses) >= 3 and len(transforms) >= 3, 'three poses', node)
        # The first images waited for a CameraInfo, and were used.
        count = len(diagnostics)
        wait_until(lambda: len(diagnostics) > count, 'diagnostics', node)
        assert 'no CameraInfo' not in node.output
    assert diagnostic_values(diagnostics[-1])['frames_refused_no_calibration'] == '0'
    # The camera has a parent in the robot's tree, so the reference keyframe is its child: the
    # transform is the inverse of the pose.
    for message, sent in zip(poses, transforms, strict=False):
        assert sent.header.stamp == message.header.stamp
        assert (sent.header.frame_id, sent.child_frame_id) == (
            'camera_optical_frame',
            'camera_optical_frame_reference',
        )
        t = message.pose.pose.position
        q = message.pose.pose.orientation
        found = sent.transform.translation
        r = sent.transform.rotation
        inverse = Rotation.from_quat([q.x, q.y, q.z, q.w]).inv()
        np.testing.assert_allclose([found.x, found.y, found.z], -inverse.apply([t.x, t.y, t.z]))
        np.testing.assert_allclose(
            Rotation.from_quat([r.x, r.y, r.z, r.w]).as_matrix(), inverse.as_matrix(), atol=1e-12
        )


def test_a_late_node_gets_a_latched_camera_info_and_says_why_no_image_comes(
    ros_domain_id, bundled_bag
):
    messages = faults.read_messages(bundled_bag, 1.5)
    info = next(message for _, message in messages if isinstance(message, CameraInfo))
    with Graph() as graph:
        driver = graph.node.create_publisher(CameraInfo, BAG_TOPICS['camera_info'], LATCHED)
        driver.publish(info)
        graph.node.create_publisher(CompressedImage, BAG_TOPICS['image'] + '/compressed', 1)
        poses = graph.listen(PoseWithCovarianceStamped, '/relpose_node/relative_pose')
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        with node_process(
            BUNDLED_PARAMETERS,
            remap=BAG_TOPICS,
            parameters={'image_transport': 'raw', 'use_sim_time': True},
        ) as node:
            node.wait_for('set image_transport:=compressed')
            clock = graph.publisher(Clock, '/clock')
            stands = Clock(clock=Time(sec=100))
            clock.publish(stands)
            faults.play(faults.drivers(graph, Image, Imu), messages)
            wait_until(lambda: len(poses) >= 3, 'three poses', node)
            assert 'no CameraInfo' not in node.output
            # Logged once; nothing is said of the driver's other durability.
            assert node.output.count(f'no image on {BAG_TOPICS["image"]} for 5 s; ') == 1
            assert 'incompatible' not in node.output
            # Stamped by the clock of the graph, at steady times.
            wait_until(
                lambda: clock.publish(stands) or stamp_of(diagnostics[-1]) == 100 * faults.SECOND,
                'time',
                node,
            )  # best effort


def test_a_wrong_parameter_is_detected_and_poses_are_withheld(ros_domain_id, bundled_bag):
    """A time offset that is 30 ms off: detected by the fourth pair or the fifth."""
    parameters = {'time_offset': 0.03, 'image_transport': 'raw'}
    with (
        Graph() as graph,
        node_process(BUNDLED_PARAMETERS, remap=BAG_TOPICS, parameters=parameters) as node,
    ):
        poses = graph.listen(PoseWithCovarianceStamped, '/relpose_node/relative_pose')
        pairs = graph.listen(DiagnosticArray, '/relpose_node/pairs')
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        node.wait_for('ready')
        for topic in ('relative_pose', 'pairs'):
            graph.wait_for_publisher(f'/relpose_node/{topic}')
        faults.play(faults.drivers(graph), faults.read_messages(bundled_bag, 2.5))
        report = wait_until(
            lambda: next(
                (item for item in diagnostics if diagnostic_values(item)['health'] == 'wrong'),
                None,
            ),
            'health: wrong',
            node,
        )
        wait_until(
            lambda: sum(diagnostic_values(message)['health'] == 'wrong' for message in pairs) >= 2,
            'two pairs of that',
            node,
        )
        assert node.signal(signal.SIGTERM)[0] == 0
        [line] = [line for line in node.output.splitlines() if 'ERROR' in line]
    values = diagnostic_values(report)
    text = 'time_offset is wrong: '
    assert report.status[0].level == ERROR
    assert report.status[0].message.startswith(text)
    assert (values['state'], values['last_reason_no_pose'].split(':')[0]) == (
        'told wrong',
        'WITHHELD',
    )
    assert 'time_offset wrong: ' in values['health_findings']
    assert all(
        part in line
        for part in (text, 'active 30.0', 'set time_offset: ', 'withhold_when_wrong: false')
    )
    wrong = {
        stamp_of(message): value
        for message in pairs
        if (value := diagnostic_values(message))['health'] == 'wrong'
    }
    assert wrong.keys().isdisjoint(map(stamp_of, poses))
    assert all(
        value['status'] == 'WITHHELD' and value['reason'].startswith(text)
        for value in wrong.values()
    )


@pytest.mark.parametrize(
    ('parameters', 'expected'),
    [
        ({'readout_time': 3.0}, 'readout_time'),
        ({'readout_time': 'fast'}, 'readout_time must be of type float'),
        ({'solver': '7pt'}, 'solver must be one of auto, uniform_9pt'),
        ({'quat_cam_imu_xyzw': '[0.0, 0.0, 0.0, 2.0]'}, 'quat_cam_imu_xyzw'),
        ({'quat_cam_imu_xyzw': '[0.0, 0.0, 1.0]'}, 'quat_cam_imu_xyzw must be 4 values'),
        (
            {**ESTIMATES, 'stamps_file': '/nowhere/stamps.txt'},
            'stamps_file /nowhere/stamps.txt cannot be written',
        ),
        pytest.param(
            {'publish_tf': True},
            'publish_tf needs tf2_ros, which is not installed',
            marks=pytest.mark.skipif(
                importlib.util.find_spec('tf2_ros') is not None, reason='tf2_ros is installed'
            ),
        ),
        (
            {**ESTIMATES, f'{OVERRIDE}.reliability': 'sometimes'},
            (
                'a QoS override is not legal: Unexpected QoS override for policy '
                '`reliability`: `sometimes`'
            ),
        ),
        ({**ESTIMATES, f'{OVERRIDE}.depth': 'many'}, f'{OVERRIDE}.depth'),
    ],
)
def test_an_illegal_parameter_ends_the_node_with_one_line(
    ros_domain_id, parameters, expected, capfd, monkeypatch
):
    """In this process, as a node of its own takes seconds to start."""
    # It would end this process.
    monkeypatch.setattr(
        'rs_relpose_ros.nodes.sensor_node.leave', lambda code: pytest.fail(f'left with {code}')
    )
    words = [word for name, value in parameters.items() for word in ('-p', f'{name}:={value}')]
    assert node_module.main(['--ros-args', *words]) == 2
    said = capfd.readouterr().err
    # Of /rosout, where this process had nodes of the same name before, rcl complains.
    lines = [
        line for line in said.splitlines() if '[relpose_node]: ' in line and '[INFO]' not in line
    ]
    assert 'Traceback' not in said
    assert len(lines) == 1, lines
    assert '[FATAL]' in lines[0]
    assert expected in lines[0]


@pytest.mark.parametrize(
    'content, expected',
    [
        (None, 'Error opening YAML file'),
        ('a: [1\nb: 2', 'Sequences can only be values'),
    ],
)
def test_a_parameter_file_that_cannot_be_read_is_one_line(tmp_path, content, expected, capfd):
    file = tmp_path / 'camera.yaml'
    if content is not None:
        file.write_text(content, encoding='utf-8')
    assert node_module.main(['--ros-args', '--params-file', str(file)]) == 2
    lines = capfd.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert 'FATAL' in lines[0]
    assert str(file) in lines[0]
    assert expected in lines[0]
