"""The bag writer: what a reader gets back, and what a failure leaves behind."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera

STAMP_NS = 1_700_000_000_123_456_789


def read(path):
    """Every message of a bag as (topic, bag time, message)."""
    with AnyReader([path]) as reader:
        return [(connection.topic, time_ns, reader.deserialize(data, connection.msgtype))
                for connection, time_ns, data in reader.messages()]


def test_messages_come_back_as_written(tmp_path):
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.integers(0, 256, (48, 64), dtype=np.uint8), (5, 5), 2.0)
    jpeg = cv2.imencode('.jpg', picture)[1].tobytes()
    camera = RollingShutterCamera(
        width=64, height=48, fx=50.0, fy=51.0, cx=31.0, cy=23.0, readout_time=0.03,
        distortion=(-0.1, 0.01, 0.0, 0.0, 0.0))
    with BagWriter(tmp_path / 'deep' / 'bag') as bag:
        bag.write('/imu', 'sensor_msgs/msg/Imu',
                  bag.imu(STAMP_NS, 'imu_link', (0.1, 0.2, 0.3), (1.0, 2.0, 9.8),
                          angular_velocity_variance=4e-6), STAMP_NS + 2)
        bag.write('/info', 'sensor_msgs/msg/CameraInfo',
                  bag.camera_info(STAMP_NS, 'cam', camera), STAMP_NS + 3)
        bag.write('/jpeg', 'sensor_msgs/msg/CompressedImage',
                  bag.compressed_image(STAMP_NS, 'cam', jpeg), STAMP_NS + 4)
        bag.write('/raw', 'sensor_msgs/msg/Image',
                  bag.image(STAMP_NS, 'cam', picture), STAMP_NS + 5)
        bag.write('/pose', 'geometry_msgs/msg/PoseStamped',
                  bag.pose(STAMP_NS, 'world', (1.0, 2.0, 3.0), (0.5, -0.5, 0.5, -0.5)),
                  STAMP_NS + 6)
    messages = read(tmp_path / 'deep' / 'bag')
    assert [(topic, time_ns - STAMP_NS) for topic, time_ns, _ in messages] == [
        ('/imu', 2), ('/info', 3), ('/jpeg', 4), ('/raw', 5), ('/pose', 6)]
    imu, info, compressed, raw, pose = (message for _, _, message in messages)
    for message in (imu, info, compressed, raw, pose):
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == STAMP_NS
    assert imu.header.frame_id == 'imu_link'
    assert (imu.angular_velocity.x, imu.linear_acceleration.z) == (0.1, 9.8)
    assert imu.orientation_covariance[0] == -1.0
    np.testing.assert_array_equal(
        imu.angular_velocity_covariance.reshape(3, 3), 4e-6 * np.eye(3))
    assert (info.width, info.height, info.distortion_model) == (64, 48, 'plumb_bob')
    np.testing.assert_array_equal(
        info.k.reshape(3, 3), [[50.0, 0.0, 31.0], [0.0, 51.0, 23.0], [0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(info.p.reshape(3, 4)[:, :3], info.k.reshape(3, 3))
    np.testing.assert_array_equal(info.d, camera.distortion)
    assert compressed.data.tobytes() == jpeg
    assert (raw.encoding, raw.step) == ('mono8', 64)
    np.testing.assert_array_equal(raw.data.reshape(48, 64), picture)
    assert (pose.pose.position.y, pose.pose.orientation.w) == (2.0, -0.5)


def test_absent_sensors_are_marked(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        for stamp, rate, force in ((1, (1.0, 2.0, 3.0), None), (2, None, (0.0, 0.0, 9.8))):
            bag.write('/imu', 'sensor_msgs/msg/Imu', bag.imu(stamp, 'imu', rate, force), stamp)
    (_, _, gyro), (_, _, accel) = read(tmp_path / 'bag')
    assert gyro.linear_acceleration_covariance[0] == -1.0
    assert gyro.angular_velocity_covariance[0] == 0.0
    assert accel.angular_velocity_covariance[0] == -1.0
    assert accel.linear_acceleration_covariance[0] == 0.0


def test_plain_pinhole_gets_five_zeros(tmp_path):
    camera = RollingShutterCamera(
        width=4, height=3, fx=5.0, fy=5.0, cx=1.5, cy=1.0, readout_time=0.0)
    bag = BagWriter(tmp_path / 'bag')
    np.testing.assert_array_equal(bag.camera_info(0, 'cam', camera).d, np.zeros(5))


@pytest.mark.parametrize('pixels', [np.zeros((3, 4)), np.zeros((3, 4, 3), dtype=np.uint8)])
def test_image_of_wrong_kind_is_refused(tmp_path, pixels):
    with pytest.raises(InputError, match='encoding'):
        BagWriter(tmp_path / 'bag').image(0, 'cam', pixels)


def test_existing_path_is_refused_and_untouched(tmp_path):
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


def test_path_that_cannot_be_created(tmp_path):
    (tmp_path / 'file').touch()
    with pytest.raises(InputError, match='cannot create'), BagWriter(tmp_path / 'file' / 'bag'):
        pass


def test_failure_leaves_nothing(tmp_path):
    path = tmp_path / 'bag'
    with pytest.raises(RuntimeError, match='stopped'), BagWriter(path) as bag:
        bag.write('/imu', 'sensor_msgs/msg/Imu', bag.imu(0, 'imu', (0, 0, 0), (0, 0, 9)), 0)
        raise RuntimeError('stopped')
    assert not path.exists()


def test_one_type_per_topic_and_known_types(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        message = bag.imu(0, 'imu', (0, 0, 0), (0, 0, 9))
        bag.write('/imu', 'sensor_msgs/msg/Imu', message, 0)
        with pytest.raises(InputError, match='carries sensor_msgs/msg/Imu'):
            bag.write('/imu', 'geometry_msgs/msg/PoseStamped', message, 1)
        with pytest.raises(InputError, match='no message type'):
            bag.write('/x', 'no_msgs/msg/Such', message, 1)
