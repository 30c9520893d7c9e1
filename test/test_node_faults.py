"""Bad input to the running node: one clear message each, no traceback, no pose made up.

One node takes one fault after the other, as it would in the field, and works again after them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import copy
from dataclasses import dataclass, field
import importlib.util
import itertools
import os
from pathlib import Path
import re
import signal
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from fault_stream import gray_image, read_messages
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
import numpy as np
import pytest
from rcl_interfaces.msg import Parameter, ParameterDescriptor, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.qos import ReliabilityPolicy
import ros_graph
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image, Imu

from rs_relpose_ros.estimator.estimate import warm_up

# Whoever comes first compiles the kernels.
pytestmark = pytest.mark.timeout(600)

SECOND = 10**9
# Of the bag, and between one phase and the next on the camera's clock.
PHASE_SECONDS = 2.6
PAUSE_SECONDS = 1.0

Edit = Callable[[Any, float], Any]


@dataclass
class Field:
    """The node under test, and the drivers that feed it."""

    graph: ros_graph.Graph
    node: ros_graph.Process
    publishers: dict[type, Any]
    messages: list[tuple[int, Any]]
    poses: list[PoseWithCovarianceStamped]
    diagnostics: list[DiagnosticArray]
    phase: Iterator[int] = field(default_factory=itertools.count)

    def play(self, edit: Edit) -> tuple[list[str], int]:
        """Play the bag's beginning at real time.

        `edit` gets each message with its time [s] since the start and gives the one to publish or
        None. Returns the warnings and errors that the node logged meanwhile, and the number of
        poses.
        """
        written, poses = len(self.node.output), len(self.poses)
        later_ns = round(next(self.phase) * (PHASE_SECONDS + PAUSE_SECONDS) * SECOND)
        first_ns = self.messages[0][0]

        def edited() -> Iterator[tuple[Any, int, Any]]:
            for bag_time_ns, message in self.messages:
                out = edit(copy.deepcopy(message), (bag_time_ns - first_ns) / SECOND)
                if out is not None:
                    stamp_ns = out.header.stamp.sec * SECOND + out.header.stamp.nanosec + later_ns
                    out.header.stamp.sec, out.header.stamp.nanosec = divmod(stamp_ns, SECOND)
                    yield self.publishers[type(out)], bag_time_ns, out

        ros_graph.publish_in_time(edited())
        # Two reports later everything has been processed and told.
        count = len(self.diagnostics)
        ros_graph.wait_until(lambda: len(self.diagnostics) >= count + 2, 'diagnostics')
        output = self.node.output[written:]
        assert 'Traceback' not in output
        lines = [line for line in output.splitlines() if re.match(r'\[(WARN|ERROR|FATAL)\]', line)]
        # A busy machine is no fault of the input.
        print(output, ros_graph.diagnostic_values(self.diagnostics[-1]))
        return [line for line in lines if '(overload)' not in line], len(self.poses) - poses

    @property
    def status(self) -> Any:
        return self.diagnostics[-1].status[0]


@pytest.fixture(scope='module')
def field_(module_ros_domain_id: int, bundled_bag: Path) -> Iterator[Field]:
    warm_up()
    with ros_graph.Graph() as graph, ros_graph.node_process(
            ros_graph.ROOT / 'bags' / 'hand_held.yaml', remap=ros_graph.BAG_TOPICS,
            parameters={'image_transport': 'raw'}) as node:
        poses = graph.listen(PoseWithCovarianceStamped, '/relpose_node/relative_pose')
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        node.wait_for('ready')
        publishers = {
            Image: graph.publisher(Image, '/camera/image_raw'),
            # Either kind of publisher will do.
            CameraInfo: graph.publisher(CameraInfo, '/camera/camera_info', best_effort=True),
            Imu: graph.publisher(Imu, '/imu/data_raw', best_effort=True)}
        yield Field(graph, node, publishers, read_messages(bundled_bag, PHASE_SECONDS), poses,
                    diagnostics)
        code, seconds = node.signal(signal.SIGINT)
        assert code == 0, node.output
        assert seconds <= 1.0


def edit_only(kind: type, edit: Callable[[Any], None]) -> Edit:
    """Change every message of one type in place."""
    def edited(message: Any, _: float) -> Any:
        if isinstance(message, kind):
            edit(message)
        return message
    return edited


def is_like(lines: list[str], sentence: str) -> bool:
    return len(lines) == 1 and sentence in lines[0]


def test_no_camera_info(field_):
    # The first test: once there was one, it stays in force.
    lines, poses = field_.play(lambda m, _: None if isinstance(m, CameraInfo) else m)
    assert is_like(lines, 'no CameraInfo on /camera/camera_info'), lines
    assert poses == 0
    values = ros_graph.diagnostic_values(field_.diagnostics[-1])
    assert '/camera/camera_info' in values['missing']
    assert int(values['frames_refused_no_calibration']) > 50


def test_uncalibrated(field_):
    lines, poses = field_.play(edit_only(
        CameraInfo, lambda m: setattr(m, 'k', np.zeros(9))))
    assert is_like(lines, 'uncalibrated (k[0] of its CameraInfo is 0)'), lines
    assert poses == 0
    assert field_.status.level == b'\x02'
    assert 'uncalibrated' in field_.status.message
    assert ros_graph.diagnostic_values(field_.diagnostics[-1])['missing'] == 'calibration'


def test_unknown_distortion_model(field_):
    lines, poses = field_.play(edit_only(
        CameraInfo, lambda m: setattr(m, 'distortion_model', 'double_sphere')))
    assert is_like(lines, "distortion_model must be one of ('plumb_bob', 'rational_polynomial', "
                          "'equidistant'), got 'double_sphere'"), lines
    assert poses == 0


def test_no_imu(field_):
    lines, poses = field_.play(lambda m, _: None if isinstance(m, Imu) else m)
    assert is_like(lines, 'no IMU message on /imu/data_raw'), lines
    assert poses == 0
    assert 'no I' in field_.status.message


def test_unknown_encoding(field_):
    lines, poses = field_.play(edit_only(Image, lambda m: setattr(m, 'encoding', 'mono12')))
    assert is_like(lines, "image encoding 'mono12' is not known; publish one of mono8"), lines
    assert poses == 0


def test_image_size_changes_in_mid_stream(field_):
    def edit(message: Any, seconds: float) -> Any:
        if isinstance(message, Image) and seconds > 1.5:
            pixels = np.frombuffer(message.data, np.uint8).reshape(480, 640)[::2, ::2]
            return gray_image(message.header, pixels)
        return message

    lines, _ = field_.play(edit)
    assert is_like(lines, 'image is 320x240, but its CameraInfo tells 640x480'), lines
    first = field_.poses[-1].header.stamp if field_.poses else None
    # Back at the right size it goes on.
    lines, poses = field_.play(lambda m, _: m)
    assert lines == []
    assert poses > 0
    assert field_.poses[-1].header.stamp != first


def test_image_and_camera_info_change_together(field_):
    def edit(message: Any, seconds: float) -> Any:
        if seconds > 1.0 and isinstance(message, Image):
            pixels = np.frombuffer(message.data, np.uint8).reshape(480, 640)[100:, 40:]
            return gray_image(message.header, np.ascontiguousarray(pixels))
        if seconds > 1.0 and isinstance(message, CameraInfo):
            roi = message.roi
            roi.x_offset, roi.y_offset, roi.width, roi.height = 40, 100, 600, 380
        return message

    lines, poses = field_.play(edit)
    # One image may cross the CameraInfo that belongs to it, and is refused for its size.
    assert len(lines) <= 1, lines
    assert poses > 0


def test_nan_in_imu(field_):
    count = itertools.count()

    def edit(message: Imu) -> None:
        if next(count) % 20 == 0:
            message.angular_velocity.y = float('nan')

    lines, poses = field_.play(edit_only(Imu, edit))
    assert is_like(lines, 'angular_velocity of an IMU message must be finite'), lines
    # A sample that is missing now and then is bridged.
    assert poses > 0
    assert int(ros_graph.diagnostic_values(field_.diagnostics[-1])['messages_invalid']) >= 20


def test_a_bag_that_starts_again(field_):
    lines, poses = field_.play(lambda m, _: m)
    assert (lines, poses > 0) == ([], True)
    jumps = int(ros_graph.diagnostic_values(field_.diagnostics[-1])['clock_jumps'])
    field_.phase = itertools.count()
    lines, poses = field_.play(lambda m, _: m)
    assert poses > 0
    after = int(ros_graph.diagnostic_values(field_.diagnostics[-1])['clock_jumps'])
    # IMU and images jump one after the other.
    assert jumps < after <= jumps + 2
    assert field_.status.level in (b'\x00', b'\x01')


# -- settings --------------------------------------------------------------------------------


def set_parameter(graph: ros_graph.Graph, name: str, **value: Any) -> Any:
    kind = {'double_value': ParameterType.PARAMETER_DOUBLE,
            'string_value': ParameterType.PARAMETER_STRING}[next(iter(value))]
    request = SetParameters.Request(parameters=[
        Parameter(name=name, value=ParameterValue(type=kind, **value))])
    [result] = graph.call(SetParameters, '/relpose_node/set_parameters', request).results
    return result


def test_live_parameters(field_):
    """Each legal change takes effect, each other one is refused with its reason."""
    refused = set_parameter(field_.graph, 'threshold', double_value=-1.0)
    assert not refused.successful
    assert 'threshold' in refused.reason
    refused = set_parameter(field_.graph, 'threshold', string_value='wide')
    assert not refused.successful
    assert refused.reason == "threshold must be of type float, got 'wide'"
    refused = set_parameter(field_.graph, 'readout_time', double_value=0.02)
    assert not refused.successful
    assert 'read-only' in refused.reason
    # Pairs that close at a parallax that is not reached, and by age only.
    assert set_parameter(field_.graph, 'min_keyframe_parallax', double_value=900.0).successful
    assert set_parameter(field_.graph, 'max_keyframe_interval', double_value=0.9).successful
    before = ros_graph.diagnostic_values(field_.diagnostics[-1])
    field_.play(lambda m, _: m)
    after = ros_graph.diagnostic_values(field_.diagnostics[-1])
    # 2.5 s of images.
    assert 1 <= int(after['pairs']) - int(before['pairs']) <= 4


def test_parameters_are_described(field_):
    [threshold, readout] = field_.graph.call(
        DescribeParameters, '/relpose_node/describe_parameters',
        DescribeParameters.Request(names=['threshold', 'readout_time'])).descriptors
    assert isinstance(threshold, ParameterDescriptor)
    assert (threshold.read_only, readout.read_only) == (False, True)
    assert threshold.description.endswith('[px]')
    [bounds] = threshold.floating_point_range
    assert (bounds.from_value, bounds.to_value) == (0.05, 50.0)


@pytest.mark.parametrize(('parameters', 'remap', 'sentence', 'missing'), [
    ({'quat_cam_imu_xyzw': '[0.0, 0.0, 0.0, 1.0]'}, {},
     'not estimating: readout_time must be given as parameter', 'readout_time'),
    ({'readout_time': 0.03}, {},
     'not estimating: quat_cam_imu_xyzw must be given as parameter', 'quat_cam_imu_xyzw'),
    ({'readout_time': 0, 'quat_cam_imu_xyzw': '[0, 0, 0, 1]'},
     {'image': '/camera/image_rect'}, '/camera/image_rect is a rectified image', ''),
])
def test_what_is_needed_is_told_and_the_node_stays(ros_domain_id, parameters, remap, sentence,
                                                   missing):
    with ros_graph.Graph() as graph, ros_graph.node_process(
            parameters=parameters, remap=remap) as node:
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        ros_graph.wait_until(lambda: len(diagnostics) >= 2, 'diagnostics')
        [status] = diagnostics[-1].status
        assert status.level == b'\x02'
        assert sentence in status.message
        assert ros_graph.diagnostic_values(diagnostics[-1])['missing'] == missing
        code, _ = node.signal(signal.SIGTERM)
        assert code == 0
        assert node.output.count(sentence) == 1
        assert 'Traceback' not in node.output


@pytest.mark.parametrize(('parameters', 'sentence'), [
    ({'readout_time': 3.0}, 'readout_time'),
    ({'readout_time': 'fast'}, 'readout_time must be of type float'),
    ({'solver': '7pt'}, 'solver must be one of auto, uniform_9pt'),
    ({'quat_cam_imu_xyzw': '[0.0, 0.0, 0.0, 2.0]'}, 'quat_cam_imu_xyzw'),
    ({'quat_cam_imu_xyzw': '[0.0, 0.0, 1.0]'}, 'quat_cam_imu_xyzw must be 4 values'),
    ({'readout_time': 0.03, 'quat_cam_imu_xyzw': '[0.0, 0.0, 0.0, 1.0]',
      'stamps_file': '/nowhere/stamps.txt'}, 'stamps_file /nowhere/stamps.txt cannot be written'),
])
def test_an_illegal_parameter_ends_the_node_with_one_line(ros_domain_id, parameters, sentence):
    with ros_graph.node_process(parameters=parameters) as node:
        assert node.wait() == 2
        lines = node.output.strip().splitlines()
        assert len(lines) == 1, lines
        assert '[FATAL]' in lines[0]
        assert sentence in lines[0]


def test_a_misspelt_parameter_is_told(ros_domain_id):
    with ros_graph.node_process(parameters={'readout_tme': 0.03}) as node:
        node.wait_for("there is no parameter 'readout_tme'; did you mean readout_time")
        assert node.signal(signal.SIGINT)[0] == 0


@pytest.mark.parametrize('reliable', [
    ['/camera/image_raw'], ['/imu/data_raw', '/camera/camera_info']])
def test_quality_of_service_can_be_overridden(ros_domain_id, reliable):
    """Reliable subscriptions, which a publisher of best effort does not match; one by one."""
    unknown = 'qos_overrides./camera/nothing.subscription.depth'
    parameters = {f'qos_overrides.{topic}.subscription.reliability': 'reliable'
                  for topic in reliable}
    with ros_graph.Graph() as graph, ros_graph.node_process(
            ros_graph.ROOT / 'bags' / 'hand_held.yaml', remap=ros_graph.BAG_TOPICS,
            parameters={'image_transport': 'raw', unknown: 3, **parameters}) as node:
        node.wait_for('ready')
        for topic in [*ros_graph.BAG_TOPICS.values(), '/accel']:
            [info] = ros_graph.wait_until(
                lambda topic=topic: graph.node.get_subscriptions_info_by_topic(topic), 'discovery')
            assert info.qos_profile.reliability is (
                ReliabilityPolicy.RELIABLE if topic in reliable else ReliabilityPolicy.BEST_EFFORT)
        assert node.signal(signal.SIGINT)[0] == 0
        assert 'there is no parameter' not in node.output
        assert node.output.count('is no QoS override of this node') == 1
        assert f'{unknown} is no QoS override of this node' in node.output


@pytest.mark.parametrize(('policy', 'value', 'sentence'), [
    ('reliability', 'sometimes', 'override for policy `reliability`: `sometimes`'),
    ('depth', 'many', 'qos_overrides./camera/image_raw.subscription.depth')])
def test_an_illegal_override_ends_the_node_with_one_line(ros_domain_id, policy, value, sentence):
    override = f'qos_overrides./camera/image_raw.subscription.{policy}'
    with ros_graph.node_process(
            ros_graph.ROOT / 'bags' / 'hand_held.yaml', remap=ros_graph.BAG_TOPICS,
            parameters={'image_transport': 'raw', override: value}) as node:
        assert node.wait() == 2
        lines = [line for line in node.output.strip().splitlines() if '[INFO]' not in line]
        assert len(lines) == 1, lines
        assert '[FATAL]' in lines[0]
        assert 'a QoS override is not legal' in lines[0]
        assert sentence in lines[0]


# -- transform -------------------------------------------------------------------------------

# In place of tf2_ros, which is in no wheel: says what it is asked to send.
FAKE_TF2_ROS = """
class TransformBroadcaster:
    def __init__(self, node):
        self._publisher = node.create_publisher(__import__(
            'geometry_msgs.msg').msg.TransformStamped, '/sent_transform', 10)

    def sendTransform(self, transform):
        self._publisher.publish(transform)
"""


def test_transform_is_the_inverse_of_the_pose(ros_domain_id, bundled_bag, tmp_path, monkeypatch):
    """The camera has a parent in the robot's tree, so the reference keyframe is its child."""
    (tmp_path / 'tf2_ros.py').write_text(FAKE_TF2_ROS)
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(
        [str(tmp_path), *filter(None, [os.environ.get('PYTHONPATH')])]))
    with ros_graph.Graph() as graph, ros_graph.node_process(
            ros_graph.ROOT / 'bags' / 'hand_held.yaml', remap=ros_graph.BAG_TOPICS,
            parameters={'publish_tf': True}) as node:
        poses = graph.listen(PoseWithCovarianceStamped, '/relpose_node/relative_pose')
        transforms = graph.listen(TransformStamped, '/sent_transform')
        with ros_graph.Process('rs_relpose_lab.live.player', str(bundled_bag),
                               '--wait-for-subscribers', '300'):
            ros_graph.wait_until(lambda: len(poses) >= 3 and len(transforms) >= 3, 'poses')
        assert node.signal(signal.SIGINT)[0] == 0
    for message, sent in zip(poses, transforms, strict=False):
        assert sent.header.stamp == message.header.stamp
        assert (sent.header.frame_id, sent.child_frame_id) == (
            'camera_optical_frame', 'camera_optical_frame_reference')
        t, q = message.pose.pose.position, message.pose.pose.orientation
        found, r = sent.transform.translation, sent.transform.rotation
        inverse = Rotation.from_quat([q.x, q.y, q.z, q.w]).inv()
        np.testing.assert_allclose([found.x, found.y, found.z], -inverse.apply([t.x, t.y, t.z]))
        np.testing.assert_allclose(
            Rotation.from_quat([r.x, r.y, r.z, r.w]).as_matrix(), inverse.as_matrix(), atol=1e-12)


def test_a_transform_without_tf2_ros(ros_domain_id):
    if importlib.util.find_spec('tf2_ros'):
        pytest.skip('tf2_ros is installed')
    with ros_graph.node_process(parameters={'publish_tf': True}) as node:
        assert node.wait() == 2
        assert 'publish_tf needs tf2_ros, which is not installed' in node.output
        assert 'Traceback' not in node.output
