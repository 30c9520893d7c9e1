"""Results to messages, with the classes of rclpy and of rosbags; messages into a bag."""

from dataclasses import replace
import struct
from typing import Any

import message_builders as build
import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation
from simulated_pairs import simulated_flight

from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.messages import incoming, outgoing
from rs_relpose_ros.messages.published_pair import published_pair
from rs_relpose_ros.pipeline.findings import Assessment, Finding, FindingState
from rs_relpose_ros.pipeline.pair import PairResult


def pair() -> PairResult:
    """A pair with covariances, outliers, and a rotation whose quaternion may have w < 0."""
    rng = np.random.default_rng(3)
    result = simulated_flight(0, 40).pairs[0]
    halves = rng.normal(size=(2, 6, 6))
    covariance, velocity_covariance = halves @ np.swapaxes(halves, 1, 2)
    # By more than 180 degrees about z.
    R = Rotation.from_euler('xyz', [0.1, -0.2, 3.3]).as_matrix()
    return replace(result, pose=replace(
        result.pose, R=R, inliers=rng.random(40) < 0.7, covariance=covariance,
        velocity_covariance=velocity_covariance), images_against_gyro=np.array([0.0, 3e-3, 4e-3]),
        gyro_bias=np.array([1e-3, 0.0, -2e-3]))


def values_of(messages: dict[str, Any]) -> dict[str, str]:
    [status] = messages['pairs'].status
    return {item.key: item.value for item in status.values}


@build.both_types
def test_pair_messages(types):
    """Frames and conventions of ROS; `test_published_pair` reads all values back."""
    result = pair()
    messages = outgoing.pair_messages(result, types)
    assert list(messages) == list(outgoing.PAIR_TOPICS)
    for topic, message in messages.items():
        assert incoming.stamp_ns(message.header) == result.stamp_ns
        assert message.header.frame_id == {'reference': 'camera', 'velocity': 'camera',
                                           'pairs': ''}.get(topic, 'camera_reference')
    pose, rotation = messages['relative_pose'].pose, messages['relative_rotation']
    q, t = pose.pose.orientation, pose.pose.position
    assert q.w >= 0.0
    np.testing.assert_allclose(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(),
                               result.pose.R, atol=1e-12)
    assert [t.x, t.y, t.z] == result.pose.t.tolist()
    # Row-major, x y z rotX rotY rotZ.
    np.testing.assert_allclose(
        np.reshape(pose.covariance, (6, 6)), result.pose.covariance, rtol=1e-9)
    twist = messages['velocity'].twist
    linear, angular = twist.twist.linear, twist.twist.angular
    assert [linear.x, linear.y, linear.z] == result.pose.linear_velocity2.tolist()
    assert [angular.x, angular.y, angular.z] == result.pose.angular_velocity2.tolist()
    assert (rotation.orientation, rotation.angular_velocity) == (q, angular)
    for block, whole in ((rotation.orientation_covariance, pose.covariance),
                         (rotation.angular_velocity_covariance, twist.covariance)):
        np.testing.assert_allclose(
            np.reshape(block, (3, 3)), np.reshape(whole, (6, 6))[3:, 3:], rtol=1e-9)
    assert rotation.linear_acceleration_covariance[0] == -1.0
    [status] = messages['pairs'].status
    assert status.level in (0, b'\0')
    assert (status.message, status.hardware_id) == ('OK', 'camera')
    values = values_of(messages)
    assert (values['model'], values['matches'], values['inliers']) == (
        'uniform', '40', str(result.pose.inliers.sum()))
    assert float(values['rotation_difference_to_gyro_deg']) == pytest.approx(np.degrees(5e-3))
    assert values['residual_rms_px'] == values['baseline_m'] == ''
    assert values['gyro_bias_rad_s'] == '0.001 0.0 -0.002'
    assert values['topics'] == 'relative_pose reference velocity matches relative_rotation'


@build.both_types
@pytest.mark.parametrize(('state', 'level'), [('ok', 0), ('suspect', 1), ('wrong', 2)])
def test_health_is_published_with_every_pair(types, state, level):
    finding = Finding('time_offset', FindingState(state), 'as it is')
    messages = outgoing.pair_messages(replace(pair(), health=Assessment((finding,))), types)
    values = values_of(messages)
    assert (values['health'], values['health_findings']) == (
        state, f'time_offset {state}: as it is')
    assert messages['pairs'].status[0].level in (level, bytes([level]))
    assert published_pair(messages).health == state


@build.both_types
@pytest.mark.parametrize('status', [
    Status.PURE_ROTATION, Status.LOW_PARALLAX, Status.NO_CONSENSUS])
def test_a_pair_without_a_pose(types, status):
    whole = pair()
    known = status is not Status.NO_CONSENSUS
    result = replace(whole, pose=whole.pose.without_translation(status, 'none') if known
                     else RelativePose(status=status, reason='none'))
    messages = outgoing.pair_messages(result, types, 'base')
    assert list(messages) == ['relative_rotation'] * known + ['pairs']
    assert values_of(messages)['topics'] == 'relative_rotation' * known
    assert messages['pairs'].status[0].message == f'{status.value}: none'
    assert messages['pairs'].status[0].level in (1, b'\x01')
    if known:
        assert messages['relative_rotation'].header.frame_id == 'base'


def test_published_covariances_have_no_negative_eigenvalue():
    """Of rank 5, in any basis, as those of a pose are; and of values of very different size."""
    rng = np.random.default_rng(0)
    lowest = []
    for _ in range(300):
        factor = rng.normal(size=(6, 5)) * 10.0**rng.uniform(-4.0, 0.0, (6, 1))
        covariance = factor @ factor.T
        lowest.append(np.linalg.eigvalsh(covariance)[0])
        covariance[0, 5] *= 1.0 + 1e-15
        published = outgoing.published_covariance(covariance).reshape(6, 6)
        assert np.linalg.eigvalsh(published)[0] >= 0.0
        np.testing.assert_array_equal(published, published.T)
        assert np.abs(published - covariance).max() <= 1e-13 * np.trace(covariance)
    assert min(lowest) < 0.0


@build.both_types
def test_matches_are_the_inliers(types):
    result = pair()
    assert outgoing.pair_messages(result, types)['matches'].is_dense
    result.landmarks.points[result.pose.inliers.argmax()] = np.nan   # its rays are parallel
    cloud = outgoing.pair_messages(result, types)['matches']
    assert cloud.header.frame_id == 'camera_reference'
    assert not cloud.is_dense
    names = ['u1', 'v1', 'u2', 'v2', 'tau1', 'tau2', 'x1', 'y1', 'z1', 'x2', 'y2', 'z2',
             'x', 'y', 'z', 'u1_gs', 'v1_gs', 'u2_gs', 'v2_gs', 'id']
    assert [field.name for field in cloud.fields] == names
    # Floats first: read_points_numpy of sensor_msgs_py asks that all fields that it reads have the
    # type of the first, be that read or not.
    assert [field.datatype for field in cloud.fields] == [7] * 19 + [6]
    count = int(result.pose.inliers.sum())
    assert 0 < count < len(result.pose.inliers)
    assert (cloud.height, cloud.width) == (1, count)
    assert len(cloud.data) == cloud.row_step == count * cloud.point_step
    raw = bytes(cloud.data)
    for row, index in enumerate(np.flatnonzero(result.pose.inliers)):
        record = struct.unpack_from('<19fI', raw, row * cloud.point_step)
        expected = [*result.matches.points1[index],
                    *result.matches.points2[index], result.row_times1[index],
                    result.row_times2[index], *result.rays1[index], *result.rays2[index],
                    *result.landmarks.points[index], *result.landmarks.pixels1[index],
                    *result.landmarks.pixels2[index], result.matches.track_ids[index]]
        np.testing.assert_allclose(record, expected, rtol=1e-6)


def test_messages_of_rclpy_and_rosbags_serialise_alike():
    ours, theirs = (outgoing.pair_messages(pair(), types)
                    for types in (build.rclpy_types, build.rosbags_types))
    for topic, message in theirs.items():
        assert deserialize_message(build.serialized(message), type(ours[topic])) == ours[topic]


# -- the bag writer ------------------------------------------------------------------------

STAMP_NS = 1_700_000_000_123_456_789


def test_messages_of_sensors(tmp_path):
    """As written by `simulate` and `convert`, whose tests read their images and poses back."""
    camera = RollingShutterCamera(
        width=64, height=48, fx=50.0, fy=51.0, cx=31.0, cy=23.0, readout_time=0.03,
        distortion=(-0.1, 0.01, 0.0, 0.0, 0.0))
    with BagWriter(tmp_path / 'deep' / 'bag') as bag:
        for number, message in enumerate((
                outgoing.imu_message(STAMP_NS, 'imu_link', (0.1, 0.2, 0.3), (1.0, 2.0, 9.8),
                                     bag.type, angular_velocity_covariance=4e-6 * np.eye(3)),
                outgoing.camera_info_message(STAMP_NS, 'cam', camera, None, bag.type))):
            bag.write(f'/{number}', message.__msgtype__, message, STAMP_NS + number)
    with AnyReader([tmp_path / 'deep' / 'bag']) as reader:
        (topic, time_ns, imu), (*_, info) = (
            (connection.topic, time_ns, reader.deserialize(data, connection.msgtype))
            for connection, time_ns, data in reader.messages())
    assert (topic, time_ns, incoming.stamp_ns(imu.header)) == ('/0', STAMP_NS, STAMP_NS)
    assert imu.header.frame_id == 'imu_link'
    assert (imu.angular_velocity.x, imu.linear_acceleration.z) == (0.1, 9.8)
    assert imu.orientation_covariance[0] == -1.0
    np.testing.assert_array_equal(
        imu.angular_velocity_covariance.reshape(3, 3), 4e-6 * np.eye(3))
    assert (info.width, info.height, info.distortion_model) == (64, 48, 'plumb_bob')
    assert info.k.tolist() == [50.0, 0.0, 31.0, 0.0, 51.0, 23.0, 0.0, 0.0, 1.0]
    np.testing.assert_array_equal(info.p.reshape(3, 4)[:, :3], info.k.reshape(3, 3))
    np.testing.assert_array_equal(info.d, camera.distortion)


def test_path_that_cannot_be_used_is_untouched(tmp_path):
    occupied = tmp_path / 'bag'
    occupied.write_text('mine')
    with pytest.raises(InputError, match='exists already'):
        BagWriter(occupied)
    assert occupied.read_text() == 'mine'
    bag = BagWriter(tmp_path / 'later')
    (tmp_path / 'later').mkdir()
    with pytest.raises(InputError, match='exists already'), bag:
        pass
    assert (tmp_path / 'later').is_dir()
    with pytest.raises(InputError, match='cannot create'), BagWriter(occupied / 'bag'):
        pass


def an_imu_message(bag: BagWriter) -> Any:
    return outgoing.imu_message(0, 'imu', (0, 0, 0), (0, 0, 9), bag.type)


def test_failure_leaves_nothing(tmp_path):
    path = tmp_path / 'bag'
    with pytest.raises(RuntimeError, match='stopped'), BagWriter(path) as bag:
        bag.write('/imu', 'sensor_msgs/msg/Imu', an_imu_message(bag), 0)
        raise RuntimeError('stopped')
    assert not path.exists()


def test_one_type_per_topic_and_known_types(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        message = an_imu_message(bag)
        bag.write('/imu', 'sensor_msgs/msg/Imu', message, 0)
        with pytest.raises(InputError, match='carries sensor_msgs/msg/Imu'):
            bag.write('/imu', 'geometry_msgs/msg/PoseStamped', message, 1)
        with pytest.raises(InputError, match='no message type'):
            bag.write('/x', 'no_msgs/msg/Such', message, 1)
