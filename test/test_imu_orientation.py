"""The IMU's own orientation: read where its covariance tells of one, believed where it agrees."""

from message_builders import imu, rosbags_types
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.imu.buffer import ImuBuffer
from rs_relpose_ros.imu.samples import ImuSample, Orientation
from rs_relpose_ros.messages.incoming import imu_sample_from_message

PERIOD = 5_000_000
# World (z up) from IMU.
WORLD_IMU = Rotation.from_euler('zyx', [40.0, 25.0, -70.0], degrees=True)
QUAT = tuple(WORLD_IMU.as_quat())
DOWN = WORLD_IMU.inv().apply([0.0, 0.0, -1.0])


def message(first, fifth=None, quat=QUAT):
    msg = imu(rosbags_types, 0)
    msg.orientation.x, msg.orientation.y, msg.orientation.z, msg.orientation.w = map(float, quat)
    msg.orientation_covariance[0] = first
    msg.orientation_covariance[4] = first if fifth is None else fifth
    msg.orientation_covariance[8] = 1e6   # heading is nobody's business here
    return msg


def test_down_is_the_worlds_and_sigma_that_of_roll_and_pitch():
    own = imu_sample_from_message(message(1e-4, 4e-4)).orientation
    np.testing.assert_allclose(own.down, DOWN, atol=1e-12)
    assert own.sigma == pytest.approx(0.02)


@pytest.mark.parametrize('msg', [
    message(-1.0), message(0.0), message(float('nan')), message(1e6),
    message(1e-4, quat=(0.0, 0.0, 0.0, 0.0)), message(1e-4, quat=(np.nan, 0.0, 0.0, 1.0)),
])
def test_what_does_not_say_how_good_it_is_is_no_orientation(msg):
    assert imu_sample_from_message(msg).orientation is None


def fed(own, config=None, force=-9.81 * DOWN, seconds=4.0, turn=(0.0, 0.0, 0.0)):
    """A buffer of an IMU at WORLD_IMU that turns, with orientations `own(k)`."""
    buffer = ImuBuffer(config or ImuConfig())
    for k in range(round(200 * seconds)):
        buffer.add(ImuSample(k * PERIOD, tuple(turn), None if force is None else tuple(force),
                             own(k)))
    return buffer, (k - 1) * PERIOD + 2_000_000


def off(degrees):
    """Down, wrong by some degrees."""
    axis = np.cross(DOWN, [1.0, 0.0, 0.0])
    return tuple(Rotation.from_rotvec(
        np.radians(degrees) * axis / np.linalg.norm(axis)).apply(DOWN))


@pytest.mark.parametrize('gravity_filter', ['complementary', 'mean'])
def test_an_orientation_that_agrees_is_used(gravity_filter):
    config = ImuConfig(gravity_filter=gravity_filter)
    buffer, at = fed(lambda k: Orientation(off(1.0), 0.02), config)
    estimate = buffer.gravity(at)
    np.testing.assert_allclose(estimate.direction, off(1.0), atol=1e-9)
    assert estimate.sigma == 0.02
    unused, at = fed(lambda k: Orientation(off(1.0), 0.02),
                     ImuConfig(gravity_filter=gravity_filter, use_imu_orientation=False))
    np.testing.assert_allclose(unused.gravity(at).direction, DOWN, atol=1e-9)


def test_without_accelerometer_it_is_all_there_is():
    buffer, at = fed(lambda k: Orientation(tuple(DOWN), 1e-6), force=None)
    estimate = buffer.gravity(at)
    np.testing.assert_allclose(estimate.direction, DOWN, atol=1e-9)
    # Nobody believes a thousandth of a degree.
    assert estimate.sigma == 0.01


@pytest.mark.parametrize('wrong', [off(180.0), off(60.0), (0.0, 0.0, -1.0)],
                         ids=['north-east-down', 'other start', 'identity'])
def test_an_orientation_of_another_world_is_not_believed(wrong):
    buffer, at = fed(lambda k: Orientation(wrong, 0.01))
    np.testing.assert_allclose(buffer.gravity(at).direction, DOWN, atol=1e-9)


def test_it_is_turned_by_the_gyro_to_the_instant_and_forgotten_when_old():
    rate = np.array([0.0, 1.0, 0.0])
    start = tuple(DOWN)

    def only_once(k):
        return Orientation(start, 0.02) if k == 790 else None
    buffer, at = fed(only_once, force=None, turn=rate)
    expected = Rotation.from_rotvec(-(at - 790 * PERIOD) * 1e-9 * rate).apply(DOWN)
    np.testing.assert_allclose(buffer.gravity(at).direction, expected, atol=1e-9)
    # Older than a gap (0.05 s) it counts no more.
    buffer, at = fed(lambda k: Orientation(start, 0.02) if k == 780 else None, force=None)
    assert buffer.gravity(at) is None
