"""Message conversion, with rclpy's classes and with those of rosbags."""

from __future__ import annotations

from dataclasses import replace
import struct
from types import SimpleNamespace
import zlib

import cv2
import message_builders as build
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_pairs import simulated_flight

from rs_relpose_ros.config.intrinsics import IntrinsicsConfig
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.front_end.frame import EncodedFrame
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.front_end.sequencer import FrameRefused, ReadyFrame, Refusal, Sequencer
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.health.findings import Finding, Health, HealthState
from rs_relpose_ros.images.gray_levels import GrayLevels
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.messages import incoming, outgoing
from rs_relpose_ros.messages.hanging import HangingCamera, HangingGyro
from rs_relpose_ros.messages.intake import Intake
from rs_relpose_ros.messages.published_pair import published_pair
from rs_relpose_ros.messages.sensor_feed import Role

# Luma of ITU-R BT.601.
WEIGHTS = np.array([0.299, 0.587, 0.114])


@pytest.fixture(params=['rclpy', 'rosbags'])
def types(request: pytest.FixtureRequest) -> build.Types:
    return build.rclpy_types if request.param == 'rclpy' else build.rosbags_types


@pytest.fixture
def rgb() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (7, 10, 3), dtype=np.uint8)


def padded(rows: np.ndarray, padding: int) -> tuple[bytes, int]:
    """Bytes of an array of rows with `padding` bytes of garbage after each, and the step."""
    flat = rows.reshape(len(rows), -1).view(np.uint8)
    filled = np.concatenate([flat, np.full((len(rows), padding), 0xaa, np.uint8)], axis=1)
    return filled.tobytes(), filled.shape[1]


# -- images ----------------------------------------------------------------------------------


def decoded(message: object) -> np.ndarray:
    return incoming.image_from_message(message).image.decoded()


@pytest.mark.parametrize('padding', [0, 3])
@pytest.mark.parametrize(('encoding', 'order'), [
    ('rgb8', [0, 1, 2]), ('bgr8', [2, 1, 0]), ('rgba8', [0, 1, 2, 0]), ('bgra8', [2, 1, 0, 0])])
def test_color_becomes_luma(types, rgb, encoding, order, padding):
    data, step = padded(np.ascontiguousarray(rgb[:, :, order]), padding)
    gray = decoded(build.image(types, 10, 7, encoding, data, step=step))
    assert gray.dtype == np.uint8
    np.testing.assert_allclose(gray, rgb @ WEIGHTS, atol=0.51)


@pytest.mark.parametrize(('padding', 'end'), [(0, None), (5, None), (5, -5)])
def test_mono8_is_passed_on(types, rgb, padding, end):
    """The last row needs no padding."""
    data, step = padded(rgb[:, :, 0], padding)
    gray = decoded(build.image(types, 10, 7, 'mono8', data[:end], step=step))
    np.testing.assert_array_equal(gray, rgb[:, :, 0])


@pytest.mark.parametrize(('order', 'is_bigendian'), [('<u2', 0), ('>u2', 1)])
@pytest.mark.parametrize('encoding', ['mono16', '16UC1'])
def test_16_bits_honour_byte_order(types, order, is_bigendian, encoding):
    values = np.arange(0, 60000, 25, dtype=np.uint16).reshape(40, 60)
    data, step = padded(values.astype(order), 2)
    gray = decoded(
        build.image(types, 60, 40, encoding, data, step=step, is_bigendian=is_bigendian))
    slope, offset = np.polyfit(values.ravel(), gray.ravel(), 1)
    assert 170 < gray.max() - gray.min() <= 255
    np.testing.assert_allclose(gray, slope * values + offset, atol=1.5)


def texture(low: float, high: float) -> np.ndarray:
    return np.random.default_rng(3).uniform(low, high, (120, 160)).astype(np.uint16)


@pytest.mark.parametrize(('low', 'high'), [
    (0, 1023), (0, 4095), (100, 16383), (0, 65535), (29_800, 30_400)])
def test_16_bits_are_shown_as_their_content_fills_them(low, high):
    gray = GrayLevels().gray(texture(low, high))
    assert 120 < int(gray.max()) - int(gray.min()) <= 255
    # Little of it is cut off.
    assert np.isin(gray, (0, 255)).mean() < 0.02


def test_a_png_of_16_bits_is_shown_alike(types):
    pixels = texture(0, 4095)
    data = cv2.imencode('.png', pixels)[1].tobytes()
    message = build.compressed(types, data)
    np.testing.assert_array_equal(decoded(message), GrayLevels().gray(pixels))


def test_what_is_dark_stays_dark():
    assert GrayLevels().gray(texture(0, 20)).max() <= 25


def test_the_range_stays_while_the_content_fits_and_follows_it_otherwise():
    levels, pixels = GrayLevels(), texture(1000, 3000)
    first = levels.gray(pixels)
    # Automatic exposure, a little darker: the same range, so the image is darker, too.
    darker = levels.gray((pixels * 0.9).astype(np.uint16))
    assert first.mean() - darker.mean() > 10
    np.testing.assert_array_equal(levels.gray(pixels), first)
    # Ten times as bright: black and white are chosen anew, and back again.
    bright = levels.gray(pixels * 10)
    assert bright.mean() == pytest.approx(first.mean(), abs=3)
    np.testing.assert_array_equal(levels.gray(pixels), first)


def test_frames_of_a_camera_share_the_range(types):
    levels = GrayLevels()
    intrinsics = Intrinsics(width=160, height=120, fx=100.0, fy=100.0, cx=79.5, cy=59.5,
                            image_width=160, image_height=120)
    first, second = (EncodedFrame(k, incoming.image_from_message(build.image(
        types, 160, 120, 'mono16', texture(0, high).astype('<u2').tobytes(), step=320)).image,
        '', intrinsics, levels).decoded().image for k, high in enumerate((4000, 3000)))
    assert second.mean() < first.mean() - 20


@pytest.mark.parametrize('encoding', ['nv12', 'nv21', 'i420'])
def test_planar_yuv_begins_with_its_luma(types, rgb, encoding):
    luma = np.ascontiguousarray(rgb[:6, :, 0])
    data = luma.tobytes() + bytes(30)
    np.testing.assert_array_equal(decoded(build.image(types, 10, 6, encoding, data, step=10)),
                                  luma)


@pytest.mark.parametrize(('encoding', 'luma_first'), [
    ('yuv422_yuy2', True), ('yuyv', True), ('yuv422', False), ('uyvy', False)])
def test_packed_yuv_gives_its_luma(types, rgb, encoding, luma_first):
    luma = rgb[:, :, 0]
    packed = np.full((7, 10, 2), 128, np.uint8)
    packed[:, :, 0 if luma_first else 1] = luma
    gray = decoded(build.image(types, 10, 7, encoding, packed.tobytes(), step=20))
    np.testing.assert_array_equal(gray, luma)


@pytest.mark.parametrize('bits', [8, 16])
@pytest.mark.parametrize('pattern', ['rggb', 'bggr', 'gbrg', 'grbg'])
def test_bayer_knows_its_colors(types, pattern, bits):
    # Red and blue differ: exchanged, the luma would be 96 instead of 124.
    level = {'r': 200, 'g': 100, 'b': 50}
    tile = np.array([level[c] for c in pattern], dtype=np.uint8).reshape(2, 2)
    mosaic = np.tile(tile, (4, 5))
    raw = mosaic if bits == 8 else mosaic.astype('<u2') * 256
    gray = decoded(build.image(
        types, 10, 8, f'bayer_{pattern}{bits}', raw.tobytes(), step=10 * bits // 8))
    luma = WEIGHTS @ [200, 100, 50]
    # Of 16 bits, black and white are a quarter of the range beyond the content.
    expected = luma if bits == 8 else (luma - 12.5) * 255 / 225
    np.testing.assert_allclose(gray[2:-2, 2:-2], expected, atol=1.5)


@pytest.mark.parametrize(('change', 'sentence'), [
    ({'encoding': '32FC1'}, "encoding '32FC1' is not known; publish one of mono8"),
    ({'encoding': 'bayer_rggb12'}, "encoding 'bayer_rggb12' is not known"),
    ({'width': 0}, 'image size 0x7 is not usable'),
    ({'height': 0}, 'image size 10x0 is not usable'),
    ({'width': 2**32 - 1, 'height': 2**32 - 1, 'step': 2**32 - 1}, 'is not usable'),
    ({'width': 16384, 'height': 16384, 'step': 16384}, 'is not usable'),
    ({'width': 8192, 'height': 8192, 'step': 8192}, 'image has 70 bytes of data, but 8192x8192'),
    ({'step': 9}, 'image step is 9 bytes, but a row of 10 px in mono8 has 10'),
    ({'step': 2**32 - 1}, 'image has 70 bytes of data'),
    ({'height': 8}, 'image has 70 bytes of data, but 10x8 in mono8 with step 10 needs 80'),
    ({'encoding': 'bgr8'}, 'image step is 10 bytes, but a row of 10 px in bgr8 has 30'),
    ({'encoding': 'mono16'}, 'image step is 10 bytes, but a row of 10 px in mono16 has 20'),
])
def test_unusable_image_is_refused(change, sentence):
    fields = {'width': 10, 'height': 7, 'encoding': 'mono8', 'step': 10, **change}
    message = build.image(build.rosbags_types, data=bytes(70), **fields)
    with pytest.raises(InputError) as caught:
        decoded(message)
    assert sentence in str(caught.value)


@pytest.mark.parametrize('extension', ['.jpg', '.png'])
def test_compressed_image_is_decoded(types, extension):
    ramp = np.tile(np.arange(64, dtype=np.uint8) * 3, (48, 1))
    data = cv2.imencode(extension, ramp)[1].tobytes()
    gray = decoded(build.compressed(types, data))
    np.testing.assert_allclose(gray, ramp, atol=4 if extension == '.jpg' else 0)


def test_trailing_bytes_of_a_camera_are_no_fault():
    data = build.jpeg(np.full((48, 64), 77, np.uint8)) + bytes(100)
    gray = decoded(build.compressed(build.rosbags_types, data))
    assert gray.shape == (48, 64)


def test_orientation_tag_does_not_turn_the_rows():
    # An Exif segment that asks for a turn by 90 degrees (orientation 6).
    tiff = struct.pack('<2sHIHHHIHHI', b'II', 42, 8, 1, 0x0112, 3, 1, 6, 0, 0)
    segment = b'Exif\0\0' + tiff
    plain = build.jpeg(np.zeros((48, 64), np.uint8))
    data = plain[:2] + b'\xff\xe1' + struct.pack('>H', len(segment) + 2) + segment + plain[2:]
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE).shape == (64, 48)
    gray = decoded(build.compressed(build.rosbags_types, data))
    assert gray.shape == (48, 64)


def png_of_size(width: int, height: int) -> bytes:
    chunk = b'IHDR' + struct.pack('>IIBBBBB', width, height, 8, 0, 0, 0, 0)
    end = b'IEND'
    return (b'\x89PNG\r\n\x1a\n' + struct.pack('>I', 13) + chunk
            + struct.pack('>I', zlib.crc32(chunk)) + struct.pack('>I', 0) + end
            + struct.pack('>I', zlib.crc32(end)))


JPEG = build.jpeg(np.random.default_rng(1).integers(0, 256, (48, 64), dtype=np.uint8))


@pytest.mark.parametrize(('data', 'sentence'), [
    (b'', 'of 0 bytes is neither JPEG nor PNG'),
    (b'GIF89a' + bytes(100), 'of 106 bytes is neither JPEG nor PNG'),
    (JPEG[:len(JPEG) // 2], 'is truncated'),
    (JPEG[:3], 'is truncated'),
    (b'\xff\xd8\xff\xd9', 'has no frame header'),
    (b'\xff\xd8\xff\xe0\x00\x00' + bytes(20) + b'\xff\xd9', 'has no frame header'),
    (JPEG[:24] + b'\xff\xd9', 'has no frame header'),
    # Decoded, it would take 1.8 GB.
    (JPEG.replace(b'\x00\x30\x00\x40', b'\xa8\xca\xa8\xca', 1), 'size 43210x43210 is not usable'),
    (png_of_size(2**31 - 1, 2**31 - 1), 'size 2147483647x2147483647 is not usable'),
    (png_of_size(64, 48), 'cannot be decoded: it is corrupt'),
    (png_of_size(64, 48)[:30], 'truncated'),
])
def test_unusable_compressed_image_is_refused(data, sentence):
    with pytest.raises(InputError) as caught:
        decoded(build.compressed(build.rosbags_types, data))
    assert sentence in str(caught.value)


# -- calibration -----------------------------------------------------------------------------


def test_calibration_of_the_full_sensor(types):
    calibration = incoming.intrinsics_from_info(build.camera_info(
        types, d=(0.1, -0.2, 0.001, 0.002, 0.05)))
    assert (calibration.fx, calibration.fy, calibration.cx, calibration.cy) == (
        450.0, 451.0, 319.5, 239.5)
    assert calibration.distortion == (0.1, -0.2, 0.001, 0.002, 0.05)
    assert (calibration.image_width, calibration.image_height) == (640, 480)
    points = np.array([[0.0, 0.0], [12.25, 400.5]])
    np.testing.assert_array_equal(calibration.to_sensor(points), points)


def test_region_and_binning_shift_rows(types):
    calibration = incoming.intrinsics_from_info(build.camera_info(
        types, roi=(100, 60, 400, 300), binning=(2, 2)))
    assert (calibration.image_width, calibration.image_height) == (200, 150)
    # The first published pixel covers sensor pixels 100 and 101: its centre lies between them.
    np.testing.assert_array_equal(
        calibration.to_sensor([[0.0, 0.0], [199.0, 149.0]]), [[100.5, 60.5], [498.5, 358.5]])
    points = np.random.default_rng(0).uniform(0, 150, (20, 2))
    np.testing.assert_allclose(
        calibration.to_image(calibration.to_sensor(points)), points, atol=1e-12)


@pytest.mark.parametrize(('model', 'count'), [
    ('plumb_bob', 0), ('plumb_bob', 4), ('plumb_bob', 5), ('plumb_bob', 8),
    ('rational_polynomial', 8), ('equidistant', 4)])
def test_known_distortion(types, model, count):
    coefficients = tuple(0.001 * (i + 1) for i in range(count))
    calibration = incoming.intrinsics_from_info(
        build.camera_info(types, model=model, d=coefficients))
    assert (calibration.distortion_model, calibration.distortion) == (model, coefficients)


def test_capital_fields_of_ros_1():
    new = build.camera_info(build.rosbags_types)
    old = SimpleNamespace(
        header=new.header, height=480, width=640, distortion_model='plumb_bob', D=new.d, K=new.k,
        binning_x=0, binning_y=0, roi=new.roi)
    assert incoming.intrinsics_from_info(old) == incoming.intrinsics_from_info(new)


@pytest.mark.parametrize(('change', 'error', 'sentence'), [
    ({'k': (0.0,) * 9}, MissingInputError, 'uncalibrated'),
    ({'model': 'double_sphere', 'd': (0.1, 0.2)}, InputError, "'double_sphere'"),
    ({'d': (0.1,) * 6}, InputError, 'got 6'),
    ({'d': (0.1,) * 1000}, InputError, '1000 coefficients'),
    ({'d': (float('nan'),) * 5}, InputError, 'distortion must be finite'),
    ({'k': (-450.0, 0, 320, 0, 450, 240, 0, 0, 1)}, InputError, 'fx must be'),
    ({'k': (float('inf'), 0, 320, 0, 450, 240, 0, 0, 1)}, InputError, 'must be finite'),
    ({'k': (450.0, 3.0, 320, 0, 450, 240, 0, 0, 1)}, InputError, 'must be [fx 0 cx'),
    ({'width': 0}, InputError, 'image size 0x480'),
    ({'roi': (400, 0, 400, 300)}, InputError, 'leaves the sensor in x'),
    ({'roi': (0, 400, 400, 300)}, InputError, 'leaves the sensor in y'),
    ({'binning': (1000, 1)}, InputError, 'image_width must be >= 1'),
])
def test_unusable_calibration_is_refused(change, error, sentence):
    with pytest.raises(error) as caught:
        incoming.intrinsics_from_info(build.camera_info(build.rosbags_types, **change))
    assert sentence in str(caught.value)


# -- IMU -------------------------------------------------------------------------------------


def test_imu_sample(types):
    sample = incoming.imu_sample_from_message(build.imu(types, 1_700_000_000_123_456_789))
    assert sample.stamp_ns == 1_700_000_000_123_456_789
    assert sample.angular_velocity == (0.1, 0.2, 0.3)
    assert sample.linear_acceleration == (0.0, 0.0, 9.8)


@pytest.mark.parametrize(('change', 'gyro', 'force'), [
    ({'accelerometer_covariance': -1.0}, (0.1, 0.2, 0.3), None),
    ({'accelerometer': (0.0,) * 3}, (0.1, 0.2, 0.3), None),
    ({'gyro_covariance': -1.0}, None, (0.0, 0.0, 9.8)),
    ({'gyro': (0.0,) * 3}, (0.0,) * 3, (0.0, 0.0, 9.8))])   # a gyro at rest is a sensor
def test_absent_sensors_are_none(types, change, gyro, force):
    sample = incoming.imu_sample_from_message(build.imu(types, 0, **change))
    assert (sample.angular_velocity, sample.linear_acceleration) == (gyro, force)


def test_accelerometer_topic_has_no_gyro(types):
    sample = incoming.imu_sample_from_message(build.imu(types, 5), with_gyro=False)
    assert (sample.angular_velocity, sample.linear_acceleration) == (None, (0.0, 0.0, 9.8))


@pytest.mark.parametrize(('change', 'sentence'), [
    ({'gyro': (float('nan'), 0.0, 0.0)}, 'angular_velocity of an IMU message must be finite'),
    ({'gyro': (0.0, -1e308, 0.0)}, 'angular_velocity of an IMU message must be at most 1000'),
    ({'accelerometer': (0.0, 0.0, 2e4)}, 'linear_acceleration of an IMU message must be at most'),
    ({'accelerometer': (0.0, float('inf'), 0.0)}, 'linear_acceleration of an IMU message must be'),
    ({'gyro_covariance': -1.0, 'accelerometer_covariance': -1.0}, 'neither gyro nor accel'),
])
def test_unusable_imu_is_refused(change, sentence):
    with pytest.raises(InputError, match=sentence):
        incoming.imu_sample_from_message(build.imu(build.rosbags_types, 0, **change))


def test_impossible_stamp_is_refused():
    header = build.header(build.rosbags_types, 0)
    header.stamp.nanosec = 1_000_000_000
    with pytest.raises(InputError, match='out of range'):
        incoming.stamp_ns(header)


# -- outgoing --------------------------------------------------------------------------------


def pair() -> PairResult:
    """A pair with covariances, outliers, and a turn that is told by a quaternion with w < 0."""
    rng = np.random.default_rng(3)
    result = simulated_flight(0, 40).pairs[0]
    halves = rng.normal(size=(2, 6, 6))
    covariance, velocity_covariance = halves @ np.swapaxes(halves, 1, 2)
    # By more than 180 degrees about z.
    R = Rotation.from_euler('xyz', [0.1, -0.2, 3.3]).as_matrix()
    return replace(result, pose=replace(
        result.pose, R=R, inliers=rng.random(40) < 0.7, covariance=covariance,
        velocity_covariance=velocity_covariance))


def test_pair_messages(types):
    result = pair()
    messages = outgoing.pair_messages(result, types)
    for message in (messages.relative_pose, messages.reference, messages.velocity,
                    messages.matches):
        assert incoming.stamp_ns(message.header) == result.stamp_ns
    pose = messages.relative_pose
    assert pose.header.frame_id == 'camera_reference'
    position, orientation = pose.pose.pose.position, pose.pose.pose.orientation
    assert [position.x, position.y, position.z] == result.pose.t.tolist()
    assert orientation.w >= 0.0
    np.testing.assert_allclose(
        Rotation.from_quat([orientation.x, orientation.y, orientation.z, orientation.w]
                           ).as_matrix(), result.pose.R, atol=1e-12)
    # ROS: row-major, x y z rotX rotY rotZ.
    np.testing.assert_allclose(
        np.reshape(pose.pose.covariance, (6, 6)), result.pose.covariance, rtol=1e-9)
    time_ref = messages.reference.time_ref
    assert time_ref.sec * 10**9 + time_ref.nanosec == result.reference_stamp_ns
    velocity = messages.velocity
    assert velocity.header.frame_id == 'camera'
    linear, angular = velocity.twist.twist.linear, velocity.twist.twist.angular
    assert [linear.x, linear.y, linear.z] == result.pose.linear_velocity2.tolist()
    assert [angular.x, angular.y, angular.z] == result.pose.angular_velocity2.tolist()
    np.testing.assert_allclose(
        np.reshape(velocity.twist.covariance, (6, 6)), result.pose.velocity_covariance, rtol=1e-9)
    rotation = messages.relative_rotation
    assert rotation.header == pose.header
    assert rotation.orientation == orientation
    np.testing.assert_allclose(np.reshape(rotation.orientation_covariance, (3, 3)),
                               result.pose.covariance[3:, 3:], rtol=1e-9)
    assert rotation.angular_velocity == angular
    np.testing.assert_allclose(np.reshape(rotation.angular_velocity_covariance, (3, 3)),
                               result.pose.velocity_covariance[3:, 3:], rtol=1e-9)
    assert rotation.linear_acceleration_covariance[0] == -1.0


def told(messages: outgoing.PairMessages) -> dict[str, str]:
    [status] = messages.pairs.status
    return {item.key: item.value for item in status.values}


def test_every_pair_is_told(types):
    result = replace(pair(), images_against_gyro=np.array([0.0, 3e-3, 4e-3]),
                     gyro_bias=np.array([1e-3, 0.0, -2e-3]))
    messages = outgoing.pair_messages(result, types)
    assert incoming.stamp_ns(messages.pairs.header) == result.stamp_ns
    [status] = messages.pairs.status
    assert (status.level, status.message, status.hardware_id) in [
        (level, 'OK', 'camera') for level in (0, b'\x00')]
    values = told(messages)
    assert int(values['reference_stamp_ns']) == result.reference_stamp_ns
    assert (int(values['reference_imu_ns']), int(values['current_imu_ns'])) == (
        result.reference_ns1, result.reference_ns2)
    assert (values['status'], values['reason'], values['model']) == ('OK', '', 'uniform')
    assert (values['matches'], values['inliers']) == ('40', str(result.pose.inliers.sum()))
    assert float(values['rotation_difference_to_gyro_deg']) == pytest.approx(np.degrees(5e-3))
    assert values['residual_rms_px'] == values['baseline_m'] == values['baseline_log_sigma'] == ''
    assert values['gyro_bias_rad_s'] == '0.001 0.0 -0.002'
    assert values['topics'] == 'relative_pose reference velocity matches relative_rotation'


@pytest.mark.parametrize(('state', 'level'), [('ok', 0), ('suspect', 1), ('wrong', 2)])
def test_health_is_told_with_every_pair(types, state, level):
    finding = Finding('time_offset', 0.03, 0.0, 6e-4, 's', True, HealthState(state), 'as it is')
    messages = outgoing.pair_messages(replace(pair(), health=Health((finding,))), types)
    values = told(messages)
    assert (values['health'], values['health_findings']) == (
        state, f'time_offset {state}: as it is')
    assert messages.pairs.status[0].level in (level, bytes([level]))
    assert published_pair(messages).health == state


@pytest.mark.parametrize('status', [Status.PURE_ROTATION, Status.LOW_PARALLAX])
def test_a_pair_with_a_rotation_alone(types, status):
    whole = pair()
    result = replace(whole, pose=whole.pose.without_translation(status, 'as it is'))
    messages = outgoing.pair_messages(result, types, 'base')
    assert [topic for topic, _ in messages.by_topic()] == ['relative_rotation', 'pairs']
    rotation = messages.relative_rotation
    same = outgoing.pair_messages(whole, types, 'base').relative_rotation
    assert (rotation.orientation, rotation.angular_velocity) == (
        same.orientation, same.angular_velocity)
    for name in ('orientation_covariance', 'angular_velocity_covariance'):
        np.testing.assert_array_equal(getattr(rotation, name), getattr(same, name))
    assert rotation.header.frame_id == 'base'
    assert messages.pairs.status[0].message == f'{status.value}: as it is'
    assert messages.pairs.status[0].level in (1, b'\x01')
    assert told(messages)['topics'] == 'relative_rotation'


def test_a_pair_without_a_rotation(types):
    result = replace(pair(), pose=RelativePose(status=Status.NO_CONSENSUS, reason='none'))
    messages = outgoing.pair_messages(result, types)
    assert [topic for topic, _ in messages.by_topic()] == ['pairs']
    assert told(messages)['topics'] == ''
    assert told(messages)['reason'] == 'none'


def test_published_covariances_have_no_negative_eigenvalue():
    """Of rank 5, in any basis, as those of a pose are; and of figures of very different size."""
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


def test_matches_are_the_inliers(types):
    result = pair()
    cloud = outgoing.pair_messages(result, types).matches
    assert cloud.header.frame_id == 'camera_reference'
    assert cloud.is_dense
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


def test_both_worlds_serialise_alike():
    from rclpy.serialization import deserialize_message
    ours = outgoing.pair_messages(pair(), build.rclpy_types)
    theirs = outgoing.pair_messages(pair(), build.rosbags_types)
    for name, message in theirs.by_topic():
        data = build.TYPESTORE.serialize_cdr(message, message.__msgtype__)
        assert deserialize_message(bytes(data), type(getattr(ours, name))) == getattr(ours, name)


def test_diagnostics(types):
    status = outgoing.status_message(1, 'node: pose', 'text', 'cam', [('a', '1')], types)
    message = outgoing.diagnostics_message(1_500_000_000, status, types)
    assert message.header.stamp.sec == 1
    assert message.status[0].level in (1, b'\x01')
    assert [(v.key, v.value) for v in message.status[0].values] == [('a', '1')]


# -- intake ----------------------------------------------------------------------------------


def intake(*, calibrated: bool = False,
           told: IntrinsicsConfig | None = None) -> tuple[Intake, Sequencer]:
    """An intake that has received the IMU of the first second."""
    sequencer = Sequencer(Parameters.from_mapping({
        'readout_time': 0.02, 'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0]}), offline=True)
    target = Intake(sequencer, told=told)
    for stamp_ns in range(0, 10**9, 5_000_000):
        target.receive(Role.IMU, build.imu(build.rosbags_types, stamp_ns))
    if calibrated:
        target.receive(Role.CAMERA_INFO, build.camera_info(build.rosbags_types))
    return target, sequencer


def taken(sequencer: Sequencer) -> list[ReadyFrame | FrameRefused]:
    out = []
    while (item := sequencer.take()) is not None:
        out.append(item)
    return out


PIXELS = np.random.default_rng(5).integers(0, 256, (480, 640), dtype=np.uint8)


def test_image_before_its_camera_info_is_kept():
    target, sequencer = intake()
    image = build.gray_image(build.rosbags_types, PIXELS, stamp_ns=500_000_000)
    target.receive(Role.IMAGE, image)
    assert taken(sequencer) == []
    target.receive(Role.CAMERA_INFO, build.camera_info(build.rosbags_types))
    [frame] = taken(sequencer)
    np.testing.assert_array_equal(frame.frame.image, PIXELS)
    assert frame.frame.frame_id == 'camera'


def test_images_without_camera_info_are_counted():
    target, sequencer = intake()
    for k in range(6):
        image = build.gray_image(build.rosbags_types, PIXELS, stamp_ns=k * 10**8)
        target.receive(Role.IMAGE, image)
    target.release_held()
    refused = taken(sequencer)
    assert [item.stamp_ns for item in refused] == [k * 10**8 for k in range(6)]
    assert {item.cause for item in refused} == {Refusal.NO_CALIBRATION}
    assert 'no CameraInfo' in refused[0].reason


def test_no_outdated_calibration_is_used():
    target, sequencer = intake(calibrated=True)
    with pytest.raises(MissingInputError):
        target.receive(Role.CAMERA_INFO, build.camera_info(build.rosbags_types, k=(0.0,) * 9))
    assert 'uncalibrated' in target.camera_info_problem
    target.receive(Role.IMAGE, build.gray_image(build.rosbags_types, PIXELS, stamp_ns=10**8))
    [refused] = taken(sequencer)
    assert refused.cause is Refusal.NO_CALIBRATION
    assert 'uncalibrated' in refused.reason


TOLD = IntrinsicsConfig(
    camera_matrix=(400.0, 0.0, 320.0, 0.0, 401.0, 241.0, 0.0, 0.0, 1.0),
    distortion_coefficients=(0.1, -0.2, 0.0, 0.0))


def receive_images(target: Intake, first: int, count: int) -> None:
    for k in range(first, first + count):
        pixels = np.roll(PIXELS, k)   # each another
        target.receive(Role.IMAGE, build.compressed(
            build.rosbags_types, build.jpeg(pixels), stamp_ns=k * 10**8))


def test_told_intrinsics_take_the_place_of_those_that_are_missing():
    target, sequencer = intake(told=TOLD)
    target.receive(Role.CAMERA_INFO, build.camera_info(build.rosbags_types, k=(0.0,) * 9))
    assert target.camera_info_problem == ''
    receive_images(target, 1, 2)
    frames = taken(sequencer)
    assert [frame.frame.stamp_ns for frame in frames] == [10**8, 2 * 10**8]
    for frame in frames:
        assert frame.frame.intrinsics == TOLD.of_image(640, 480) == target.intrinsics
    # A calibration that comes later is better, and one that goes is not used any more.
    target.receive(Role.CAMERA_INFO, build.camera_info(build.rosbags_types))
    receive_images(target, 3, 1)
    assert taken(sequencer)[0].frame.intrinsics.fx == 450.0
    target.receive(Role.CAMERA_INFO, build.camera_info(build.rosbags_types, k=(0.0,) * 9))
    receive_images(target, 4, 1)
    assert taken(sequencer)[0].frame.intrinsics == TOLD.of_image(640, 480)
    # One that cannot be used is no missing one.
    with pytest.raises(InputError):
        target.receive(Role.CAMERA_INFO, build.camera_info(build.rosbags_types, model='bananas'))
    receive_images(target, 5, 1)
    [refused] = taken(sequencer)
    assert (refused.cause, 'bananas' in refused.reason) == (Refusal.NO_CALIBRATION, True)


def test_without_a_camera_info_the_first_images_wait():
    target, sequencer = intake(told=TOLD)
    receive_images(target, 1, 4)
    assert taken(sequencer) == [] and target.intrinsics is None
    receive_images(target, 5, 1)
    assert [frame.frame.intrinsics.fy for frame in taken(sequencer)] == [401.0] * 5
    # Of each image the size is its own.
    target.receive(Role.IMAGE, build.gray_image(build.rosbags_types, PIXELS[:240], 6 * 10**8))
    [frame] = taken(sequencer)
    assert frame.frame.intrinsics == TOLD.of_image(640, 240)
    target.receive(Role.IMAGE, build.compressed(build.rosbags_types, b'none', stamp_ns=7 * 10**8))
    [refused] = taken(sequencer)
    assert (refused.cause, refused.stamp_ns) == (Refusal.BAD_IMAGE, 7 * 10**8)
    # A recording that ends before.
    target, sequencer = intake(told=TOLD)
    receive_images(target, 1, 2)
    target.release_held()
    assert len(taken(sequencer)) == 2


def test_image_of_another_size_is_refused():
    target, sequencer = intake(calibrated=True)
    image = build.gray_image(build.rosbags_types, PIXELS[:240], stamp_ns=10**8)
    target.receive(Role.IMAGE, image)
    target.receive(
        Role.IMAGE, build.compressed(build.rosbags_types, build.jpeg(PIXELS), stamp_ns=2 * 10**8))
    refused, ready = taken(sequencer)
    assert refused.cause is Refusal.BAD_IMAGE
    assert 'image is 640x240, but its CameraInfo tells 640x480' in refused.reason
    assert ready.frame.image.shape == (480, 640)
    assert sequencer.counts().refused == {Refusal.BAD_IMAGE: 1}


def test_image_whose_stamp_is_out_of_range_is_refused():
    target, sequencer = intake()
    image = build.gray_image(build.rosbags_types, PIXELS, stamp_ns=10**8)
    image.header.stamp.nanosec = 10**9
    target.receive(Role.IMAGE, image)
    [refused] = taken(sequencer)
    assert (refused.cause, refused.stamp_ns) == (Refusal.BAD_IMAGE, 0)
    assert 'out of range' in refused.reason


# -- sensors that hang -----------------------------------------------------------------------


def used(values: list[tuple[float, float, float]], step_ms: int = 5,
         longest: float = 0.025) -> list[str]:
    """Of each sample: whether it is used, or what is said."""
    gyro, told = HangingGyro(longest), []
    for k, value in enumerate(values):
        try:
            repeats = gyro.repeats(ImuSample(k * step_ms * 10**6, value, None))
            told.append('' if repeats else 'used')
        except InputError as error:
            told.append(str(error))
    return told


def test_a_gyro_that_repeats_itself_hangs():
    told = used([(0.01, 0.02, 0.3)] * 8 + [(0.01, 0.02, 0.31)])
    # 25 ms are borne.
    assert told[:6] == ['used', *[''] * 5]
    assert all('it hangs' in text for text in told[6:8])
    assert told[8] == 'used'
    assert 'it hangs' in used([(0.0, 0.0, 0.0)] * 8)[-1]


def test_a_gyro_at_the_end_of_its_range_is_saturated():
    moving = np.random.default_rng(0).normal(size=(8, 2))
    told = used([(-4.36, x, y) for x, y in moving])
    assert told[1] == ''
    assert told[-1] == 'the x axis of the gyro repeats -4.36 rad/s bit by bit: it is saturated'


def test_a_gyro_that_is_clipped_below_any_range_is_saturated():
    """Told by what it repeats being the largest value that ever came."""
    rng = np.random.default_rng(0)
    turn = np.clip(1.3 * np.sin(np.linspace(0.0, 12.0, 240)), -0.7, 0.7)
    told = used([(x, y, z) for (x, y), z in zip(rng.normal(size=(240, 2)), turn, strict=True)])
    clipped = np.flatnonzero(np.abs(turn) == 0.7)
    assert 100 < len(clipped) < 180
    # Of each stretch the first is true.
    firsts = clipped[np.diff(clipped, prepend=-2) > 1]
    assert [k for k, text in enumerate(told) if text != 'used'] == sorted(
        set(clipped.tolist()) - set(firsts.tolist()))
    assert 'the z axis of the gyro repeats -0.7 rad/s bit by bit: it is saturated' in told


def test_what_sensors_do_repeat():
    noise = np.random.default_rng(0).normal(size=40)
    # Coarse values that are not the largest, and a bias at rest that is.
    assert set(used([(1.0, -1.0, z) for z in noise[:1]] + [
        (0.8, -0.8, z) for z in noise])) == {'used'}
    assert set(used([(0.15, -0.15, z) for z in noise])) == {'used'}
    # A robot in the plane, and a coarse gyro at rest.
    assert set(used([(0.0, 0.0, z) for z in noise])) == {'used'}
    assert set(used([(0.001, -0.001, z) for z in noise])) == {'used'}
    # Drivers that are faster than their sensor.
    assert used([(z, z, z) for z in noise for _ in range(5)], step_ms=1).count('used') == 40
    assert used([(z, z, z) for z in noise for _ in range(2)], step_ms=20).count('used') == 40
    assert set(used([(0.0, 0.0, 0.0)] * 100, longest=0.0)) == {'used'}


def test_an_image_that_repeats_the_one_before():
    camera = HangingCamera()
    pixels = np.random.default_rng(0).integers(0, 256, 8000, dtype=np.uint8)
    other = pixels.copy()
    other[5050] ^= 1
    told = [bool(camera.problem(stamp, data)) for stamp, data in enumerate((
        pixels, pixels.copy(), other, other, pixels[:4000], pixels))]
    assert told == [False, True, False, True, False, False]
    # The same message once more.
    assert camera.problem(5, pixels.copy()) == ''
