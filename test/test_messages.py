"""Messages of rclpy and rosbags to arrays, and results to messages; transforms of a robot."""

import base64
from dataclasses import replace
from itertools import pairwise
import json
import math
from pathlib import Path
import re
import struct
from typing import Any
import zlib

import bag_kinds as bags
from conftest import BUNDLED_PARAMETERS
import cv2
import message_builders as build
import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation
from simulated_pairs import simulated_flight

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.bags.sensor_topics import CAMERA_FRAME, IMU_FRAME
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.calibration.findings import Assessment, Code, Finding, FindingState, Why
from rs_relpose_ros.cli import main as command_line
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import ImuConfig, IntrinsicsConfig, Parameters
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.messages import camera_info, incoming, outgoing, transforms
from rs_relpose_ros.messages.camera_info import intrinsics_from_info
from rs_relpose_ros.messages.incoming import Intake, repeats, Role, StuckGyro
from rs_relpose_ros.messages.published_pair import published_pair
from rs_relpose_ros.messages.transforms import FrameTree, Transform, with_extrinsics
from rs_relpose_ros.pipeline.pair import Learned, PairResult
from rs_relpose_ros.pipeline.sequencer import Refusal, Sequencer
from rs_relpose_ros.tracking.images import CompressedImage, GrayLevels

# Luma of ITU-R BT.601.
WEIGHTS = np.array([0.299, 0.587, 0.114])


RGB = np.random.default_rng(0).integers(0, 256, (7, 10, 3), dtype=np.uint8)
GRAY = np.ascontiguousarray(RGB[:, :, 0])


def padded(rows: np.ndarray, padding: int) -> tuple[bytes, int]:
    """Bytes of an array of rows with `padding` bytes of garbage after each, and the step."""
    flat = rows.reshape(len(rows), -1).view(np.uint8)
    filled = np.concatenate([flat, np.full((len(rows), padding), 0xAA, np.uint8)], axis=1)
    return filled.tobytes(), filled.shape[1]


def packed_yuv(luma_at: int) -> tuple[bytes, int]:
    packed = np.full((7, 10, 2), 128, np.uint8)
    packed[:, :, luma_at] = GRAY
    return packed.tobytes(), 20


# -- images ----------------------------------------------------------------------------------


def decoded(message: object) -> np.ndarray:
    return incoming.image_from_message(message).decoded()


@build.both_types
@pytest.mark.parametrize('padding', [0, 3])
@pytest.mark.parametrize(
    ('encoding', 'order'),
    [('rgb8', [0, 1, 2]), ('bgr8', [2, 1, 0]), ('rgba8', [0, 1, 2, 0]), ('bgra8', [2, 1, 0, 0])],
)
def test_color_becomes_luma(types, encoding, order, padding):
    data, step = padded(np.ascontiguousarray(RGB[:, :, order]), padding)
    gray = decoded(build.image(types, 10, 7, encoding, data, step=step))
    assert gray.dtype == np.uint8
    np.testing.assert_allclose(gray, RGB @ WEIGHTS, atol=0.51)


@build.both_types
@pytest.mark.parametrize(
    ('encoding', 'data', 'step'),
    [
        ('mono8', *padded(GRAY, 0)),
        ('mono8', *padded(GRAY, 5)),
        ('mono8', padded(GRAY, 5)[0][:-5], 15),  # the last row needs no padding
        # Planar: luma first.
        *((encoding, GRAY.tobytes() + bytes(35), 10) for encoding in ('nv12', 'nv21', 'i420')),
        *(
            (encoding, *packed_yuv(luma_at))
            for encoding, luma_at in (('yuv422_yuy2', 0), ('yuyv', 0), ('yuv422', 1), ('uyvy', 1))
        ),
    ],
)
def test_luma_is_used_as_it_is(types, encoding, data, step):
    np.testing.assert_array_equal(
        decoded(build.image(types, 10, 7, encoding, data, step=step)), GRAY
    )


@build.both_types
@pytest.mark.parametrize(('order', 'is_bigendian'), [('<u2', 0), ('>u2', 1)])
@pytest.mark.parametrize('encoding', ['mono16', '16UC1'])
def test_16_bits_honour_byte_order(types, order, is_bigendian, encoding):
    values = np.arange(0, 60000, 25, dtype=np.uint16).reshape(40, 60)
    data, step = padded(values.astype(order), 2)
    gray = decoded(
        build.image(types, 60, 40, encoding, data, step=step, is_bigendian=is_bigendian)
    )
    slope, offset = np.polyfit(values.ravel(), gray.ravel(), 1)
    assert 170 < gray.max() - gray.min() <= 255
    np.testing.assert_allclose(gray, slope * values + offset, atol=1.5)


def texture(low: float, high: float) -> np.ndarray:
    return np.random.default_rng(3).uniform(low, high, (120, 160)).astype(np.uint16)


@pytest.mark.parametrize(
    ('low', 'high'), [(0, 1023), (0, 4095), (100, 16383), (0, 65535), (29_800, 30_400)]
)
def test_16_bits_are_scaled_to_their_content(low, high):
    gray = GrayLevels().gray(texture(low, high))
    assert 120 < int(gray.max()) - int(gray.min()) <= 255
    # Few pixels are clipped.
    assert np.isin(gray, (0, 255)).mean() < 0.02
    # Dark images remain dark.
    assert GrayLevels().gray(texture(0, 20)).max() <= 25


def test_the_range_of_16_bits_is_kept_while_the_content_fits():
    levels = GrayLevels()
    pixels = texture(1000, 3000)
    first = levels.gray(pixels)
    # Automatic exposure, a little darker: the same range, so the image is darker, too.
    darker = levels.gray((pixels * 0.9).astype(np.uint16))
    assert first.mean() - darker.mean() > 10
    np.testing.assert_array_equal(levels.gray(pixels), first)
    # Ten times as bright: black and white are chosen again, and so they are on the way back.
    bright = levels.gray(pixels * 10)
    assert bright.mean() == pytest.approx(first.mean(), abs=3)
    np.testing.assert_array_equal(levels.gray(pixels), first)


@build.both_types
def test_messages_of_16_bits_use_the_given_range(types):
    levels = GrayLevels()
    bright = texture(0, 4000)
    dark = texture(0, 3000)
    first, second = (
        incoming.image_from_message(
            build.image(types, 160, 120, 'mono16', pixels.astype('<u2').tobytes(), step=320)
        ).decoded(levels)
        for pixels in (bright, dark)
    )
    assert second.mean() < first.mean() - 20
    png = cv2.imencode('.png', bright)[1].tobytes()
    np.testing.assert_array_equal(decoded(build.compressed(types, png)), first)


@pytest.mark.parametrize('noise', [0.0, 10.0])
@pytest.mark.parametrize('named', ['<', '>'])
@pytest.mark.parametrize('written', ['<', '>'])
def test_either_byte_order_of_16_bits_is_read(named, written, noise):
    """Also where a driver names the wrong one."""
    smooth = cv2.GaussianBlur(np.random.default_rng(3).normal(0.0, 1.0, (120, 160)), (0, 0), 3.0)
    shown = 2000.0 + 1500.0 * smooth / np.abs(smooth).max()
    shown = (shown + noise * np.random.default_rng(4).normal(0.0, 1.0, shown.shape)).astype('u2')
    message = build.image(
        build.rosbags_types, 160, 120, 'mono16', shown.astype(f'{written}u2').tobytes(), step=320
    )
    message.is_bigendian = int(named == '>')
    np.testing.assert_array_equal(decoded(message), GrayLevels().gray(shown))


@build.both_types
@pytest.mark.parametrize('bits', [8, 16])
@pytest.mark.parametrize('pattern', ['rggb', 'bggr', 'gbrg', 'grbg'])
def test_bayer_patterns_have_their_colors(types, pattern, bits):
    # Red and blue differ: exchanged, the luma would be 96 instead of 124.
    level = {'r': 200, 'g': 100, 'b': 50}
    tile = np.array([level[c] for c in pattern], dtype=np.uint8).reshape(2, 2)
    mosaic = np.tile(tile, (4, 5))
    raw = mosaic if bits == 8 else mosaic.astype('<u2') * 256
    gray = decoded(
        build.image(types, 10, 8, f'bayer_{pattern}{bits}', raw.tobytes(), step=10 * bits // 8)
    )
    luma = WEIGHTS @ [200, 100, 50]
    # Of 16 bits, black and white are a quarter of the range beyond the content.
    expected = luma if bits == 8 else (luma - 12.5) * 255 / 225
    np.testing.assert_allclose(gray[2:-2, 2:-2], expected, atol=1.5)


@pytest.mark.parametrize(
    ('change', 'expected'),
    [
        ({'encoding': '32FC1'}, "'32FC1' is not known; publish one of mono8"),
        ({'width': 0}, 'size 0x7'),
        ({'width': 2**32 - 1, 'height': 2**32 - 1, 'step': 2**32 - 1}, 'size .* is not usable'),
        ({'width': 16384, 'height': 16384, 'step': 16384}, 'size .* is not usable'),
        ({'width': 8192, 'height': 8192, 'step': 8192}, '70 bytes of data, but 8192x8192'),
        ({'step': 9}, 'step is 9 bytes, but a row .* has 10'),
        ({'height': 8}, '70 bytes of data, but 10x8 .* needs 80'),
        ({'encoding': 'bgr8'}, 'step is 10 bytes, but a row .* has 30'),
    ],
)
def test_unusable_image_is_refused(change, expected):
    fields = {'width': 10, 'height': 7, 'encoding': 'mono8', 'step': 10, **change}
    with pytest.raises(InputError, match=expected):
        decoded(build.image(build.rosbags_types, data=bytes(70), **fields))


def test_trailing_bytes_and_an_orientation_tag_change_nothing():
    """Drivers append bytes; the rows stay those of the sensor, whose times they have."""
    # An Exif segment that requests a rotation by 90 degrees (orientation 6).
    tiff = struct.pack('<2sHIHHHIHHI', b'II', 42, 8, 1, 0x0112, 3, 1, 6, 0, 0)
    segment = b'Exif\0\0' + tiff
    plain = build.jpeg(np.zeros((48, 64), np.uint8))
    data = plain[:2] + b'\xff\xe1' + struct.pack('>H', len(segment) + 2) + segment + plain[2:]
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE).shape == (64, 48)
    for variant in (data, plain + bytes(100)):
        assert decoded(build.compressed(build.rosbags_types, variant)).shape == (48, 64)


def png_of_size(width: int, height: int) -> bytes:
    chunk = b'IHDR' + struct.pack('>IIBBBBB', width, height, 8, 0, 0, 0, 0)
    end = b'IEND'
    return (
        b'\x89PNG\r\n\x1a\n'
        + struct.pack('>I', 13)
        + chunk
        + struct.pack('>I', zlib.crc32(chunk))
        + struct.pack('>I', 0)
        + end
        + struct.pack('>I', zlib.crc32(end))
    )


JPEG = build.jpeg(np.random.default_rng(1).integers(0, 256, (48, 64), dtype=np.uint8))


@build.both_types
@pytest.mark.parametrize(
    'wrapped',
    [
        lambda data: data + bytes(9000),
        lambda data: data + b'\xff' * 9000,
        lambda data: data + b'\xd9' * 9000,
        base64.b64encode,
    ],
    ids=['zeros', 'ones', 'bytes of its end', 'base64'],
)
def test_files_that_drivers_pad_or_write_as_text(types, wrapped):
    np.testing.assert_array_equal(
        decoded(build.compressed(types, wrapped(JPEG))), decoded(build.compressed(types, JPEG))
    )


@build.both_types
def test_a_png_in_the_format_jpeg(types):
    gray = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)
    png = cv2.imencode('.png', gray)[1].tobytes()
    message = build.compressed(types, png)
    message.format = 'mono8; jpeg compressed mono8'
    np.testing.assert_array_equal(decoded(message), gray)


@build.both_types
def test_an_image_whose_data_are_a_file(types):
    """Drivers in MJPEG mode name the encoding that they were asked for."""
    expected = decoded(build.compressed(types, JPEG))
    message = build.image(types, 64, 48, 'rgb8', JPEG + bytes(3 * 64 * 48 - len(JPEG)), step=192)
    np.testing.assert_array_equal(decoded(message), expected)
    # Pixels that begin as a JPEG does are still pixels.
    pixels = JPEG[:3] + bytes(3 * 64 * 48 - 3)
    assert decoded(build.image(types, 64, 48, 'rgb8', pixels, step=192)).shape == (48, 64)


@pytest.mark.parametrize(
    ('data', 'expected'),
    [
        (JPEG[: len(JPEG) // 2] + bytes(9000), 'is truncated'),
        (b'', '0 bytes is neither JPEG nor PNG'),
        (b'GIF89a' + bytes(100), '106 bytes is neither JPEG nor PNG'),
        (JPEG[: len(JPEG) // 2], 'is truncated'),
        (b'\xff\xd8\xff\xd9', 'has no frame header'),
        (b'\xff\xd8\xff\xe0\x00\x00' + bytes(20) + b'\xff\xd9', 'has no frame header'),
        (JPEG[:24] + b'\xff\xd9', 'has no frame header'),
        # Decoded, it would take 1.8 GB.
        (JPEG.replace(b'\x00\x30\x00\x40', b'\xa8\xca\xa8\xca', 1), 'size 43210x43210'),
        (png_of_size(2**31 - 1, 2**31 - 1), 'size 2147483647x2147483647'),
        (png_of_size(64, 48), 'is corrupt'),
        (png_of_size(64, 48)[:30], 'truncated'),
    ],
)
def test_unusable_compressed_image_is_refused(data, expected):
    with pytest.raises(InputError, match=expected):
        decoded(build.compressed(build.rosbags_types, data))


# -- calibration -----------------------------------------------------------------------------


@build.both_types
@pytest.mark.parametrize(
    ('change', 'size', 'corners'),
    [
        ({}, (640, 480), [[0.0, 0.0], [199.0, 149.0]]),
        # The first published pixel covers sensor pixels 100 and 101: its centre lies between them.
        (
            {'roi': (100, 60, 400, 300), 'binning': (2, 2)},
            (200, 150),
            [[100.5, 60.5], [498.5, 358.5]],
        ),
    ],
)
def test_region_and_binning_shift_rows(types, change, size, corners):
    calibration = intrinsics_from_info(build.camera_info(types, **change))
    assert (calibration.fx, calibration.fy, calibration.cx, calibration.cy) == (
        450.0,
        451.0,
        319.5,
        239.5,
    )
    assert (calibration.image_width, calibration.image_height) == size
    points = np.array([[0.0, 0.0], [199.0, 149.0]])
    np.testing.assert_array_equal(calibration.to_sensor(points), corners)
    np.testing.assert_allclose(calibration.to_image(np.array(corners)), points, atol=1e-12)


@build.both_types
@pytest.mark.parametrize(
    ('model', 'count'),
    [
        ('plumb_bob', 0),
        ('plumb_bob', 4),
        ('plumb_bob', 5),
        ('plumb_bob', 8),
        ('rational_polynomial', 8),
        ('equidistant', 4),
    ],
)
def test_distortions_of_known_models_are_taken_as_they_are(types, model, count):
    coefficients = tuple(0.001 * (i + 1) for i in range(count))
    calibration = intrinsics_from_info(build.camera_info(types, model=model, d=coefficients))
    assert (calibration.distortion_model, calibration.distortion) == (model, coefficients)


FIVE = (-0.3, 0.1, 0.001, 0.002, 0.03)


@pytest.mark.parametrize(
    ('model', 'd', 'expected'),
    [
        # Other names of the same models.
        ('radtan', FIVE[:4], ('plumb_bob', FIVE[:4])),
        ('Radial-Tangential', FIVE, ('plumb_bob', FIVE)),
        ('fisheye', FIVE[:4], ('equidistant', FIVE[:4])),
        ('kannala_brandt4', FIVE[:4], ('equidistant', FIVE[:4])),
        # No distortion.
        ('', (), ('plumb_bob', ())),
        ('none', (), ('plumb_bob', ())),
        ('pinhole', (0.0,) * 5, ('plumb_bob', ())),
        # Zeros behind the coefficients, as OpenCV returns them.
        ('plumb_bob', (*FIVE, *[0.0] * 9), ('plumb_bob', FIVE)),
        ('plumb_bob', (*FIVE, 0.0), ('plumb_bob', FIVE)),
        ('equidistant', (*FIVE[:4], 0.0), ('equidistant', FIVE[:4])),
        ('rational_polynomial', FIVE, ('rational_polynomial', (*FIVE, 0.0, 0.0, 0.0))),
        (
            'rational_polynomial',
            (*FIVE, 0.2, 0.01, 0.02, *[0.0] * 6),
            ('rational_polynomial', (*FIVE, 0.2, 0.01, 0.02, *[0.0] * 4)),
        ),
        (
            'plumb_bob',
            (*FIVE, 0.2, 0.01, 0.02, 1e-3, *[0.0] * 5),
            ('rational_polynomial', (*FIVE, 0.2, 0.01, 0.02, 1e-3, 0.0, 0.0, 0.0)),
        ),
    ],
)
def test_lenses_as_drivers_name_them(model, d, expected):
    found = intrinsics_from_info(build.camera_info(build.rosbags_types, model=model, d=d))
    assert (found.distortion_model, found.distortion) == expected


def central(width: int, height: int) -> tuple[float, ...]:
    return (0.7 * width, 0.0, 0.52 * width, 0.0, 0.7 * width, 0.47 * height, 0.0, 0.0, 1.0)


def test_a_binning_that_the_camera_matrix_has_counted_already(caplog):
    camera_info._warn_once.cache_clear()
    message = build.camera_info(
        build.rosbags_types, width=1280, height=960, k=central(640, 480), binning=(2, 2)
    )
    intrinsics_from_info(message)
    assert intrinsics_from_info(message) == intrinsics_from_info(
        build.camera_info(build.rosbags_types, width=640, height=480, k=central(640, 480))
    )
    # One warning, however many messages there are.
    assert len(caplog.records) == 1
    assert 'binning of 2x2' in caplog.text and 'image of 640x480' in caplog.text
    right = build.camera_info(
        build.rosbags_types, width=1280, height=960, k=central(1280, 960), binning=(2, 2)
    )
    assert intrinsics_from_info(right).binning_x == 2


@pytest.mark.parametrize('factor', [0.5, 2.0, 1.5, 0.66])
def test_a_matrix_of_another_resolution_is_refused_by_that_name(factor):
    scaled = build.camera_info(build.rosbags_types, k=central(640 * factor, 480 * factor))
    with pytest.raises(InputError, match='that of another resolution') as error:
        intrinsics_from_info(scaled)
    named = re.search(r'about ([\d.]+) times', str(error.value))
    assert float(named[1]) == pytest.approx(factor, rel=0.05)


@pytest.mark.parametrize(('cx', 'cy'), [(319.5 - 100.0, 239.5), (380.0, 290.0), (470.0, 180.0)])
def test_a_principal_point_off_the_centre_is_of_this_resolution(cx, cy):
    """Images that were cropped at one side, or a lens that is not centred."""
    k = (450.0, 0.0, cx, 0.0, 450.0, cy, 0.0, 0.0, 1.0)
    assert intrinsics_from_info(build.camera_info(build.rosbags_types, k=k)).cx == cx


def test_a_region_that_the_size_has_counted_already(caplog):
    camera_info._warn_once.cache_clear()
    # The principal point is that of the crop.
    message = build.camera_info(build.rosbags_types, roi=(200, 90, 640, 480))
    assert intrinsics_from_info(message) == intrinsics_from_info(
        build.camera_info(build.rosbags_types)
    )
    assert 'region of interest at (200, 90)' in caplog.text
    assert 'clear roi' in caplog.text


UNCALIBRATED = {'k': (0.0,) * 9}


@pytest.mark.parametrize(
    ('change', 'expected'),
    [
        (UNCALIBRATED, 'uncalibrated'),
        ({'model': 'double_sphere', 'd': (0.1, 0.2)}, "'double_sphere'"),
        ({'d': (0.1,) * 6}, 'got 6'),
        ({'model': '', 'd': FIVE}, "model '' and 5 coefficients"),
        ({'model': 'rational_polynomial', 'd': (0.1,) * 14}, 'tilt the sensor'),
        ({'model': 'fisheye', 'd': FIVE}, 'got 5'),
        ({'d': (float('nan'),) * 5}, 'distortion must be finite'),
        ({'k': (-450.0, 0, 320, 0, 450, 240, 0, 0, 1)}, 'fx must be'),
        ({'k': (float('inf'), 0, 320, 0, 450, 240, 0, 0, 1)}, 'must be finite'),
        ({'k': (450.0, 3.0, 320, 0, 450, 240, 0, 0, 1)}, r'must be \[fx 0 cx'),
        ({'width': 0}, 'size 0x480'),
        ({'roi': (400, 0, 400, 300)}, 'leaves the sensor in x'),
        ({'binning': (1000, 1)}, 'image_width must be >= 1'),
    ],
)
def test_unusable_calibration_is_refused(change, expected):
    # Only a missing one is replaced by the parameters.
    error = MissingInputError if change is UNCALIBRATED else InputError
    with pytest.raises(error, match=expected):
        intrinsics_from_info(build.camera_info(build.rosbags_types, **change))


# -- IMU -------------------------------------------------------------------------------------


@build.both_types
@pytest.mark.parametrize(
    ('change', 'gyro', 'force'),
    [
        ({}, (0.1, 0.2, 0.3), (0.0, 0.0, 9.8)),
        ({'accelerometer_covariance': -1.0}, (0.1, 0.2, 0.3), None),
        ({'accelerometer': (0.0,) * 3}, (0.1, 0.2, 0.3), None),
        ({'gyro_covariance': -1.0}, None, (0.0, 0.0, 9.8)),
        ({'gyro': (0.0,) * 3}, (0.0,) * 3, (0.0, 0.0, 9.8)),
    ],
)  # a gyro at rest is a sensor
def test_absent_sensors_are_none(types, change, gyro, force):
    stamp_ns = 1_700_000_000_123_456_789
    message = build.imu(types, stamp_ns, **change)
    for with_gyro in (True, False) if force else (True,):
        assert incoming.imu_sample_from_message(message, with_gyro=with_gyro) == ImuSample(
            stamp_ns, gyro if with_gyro else None, force
        )


@pytest.mark.parametrize(
    ('change', 'expected'),
    [
        ({'gyro': (float('nan'), 0.0, 0.0)}, 'angular_velocity .* finite'),
        ({'gyro': (0.0, -1e308, 0.0)}, 'angular_velocity .* at most 1000'),
        ({'accelerometer': (0.0, 0.0, 2e4)}, 'linear_acceleration .* at most'),
        ({'accelerometer': (0.0, float('inf'), 0.0)}, 'linear_acceleration .* finite'),
        ({'gyro_covariance': -1.0, 'accelerometer_covariance': -1.0}, 'neither gyro nor accel'),
    ],
)
def test_unusable_imu_is_refused(change, expected):
    with pytest.raises(InputError, match=expected):
        incoming.imu_sample_from_message(build.imu(build.rosbags_types, 0, **change))


# -- intake ----------------------------------------------------------------------------------

PIXELS = np.random.default_rng(5).integers(0, 256, (480, 640), dtype=np.uint8)
CONFIGURED = IntrinsicsConfig(
    camera_matrix=(400.0, 0.0, 320.0, 0.0, 401.0, 241.0, 0.0, 0.0, 1.0),
    distortion_coefficients=(0.1, -0.2, 0.0, 0.0),
)


class Fed:
    """An intake that has received the IMU of the first second, and its sequencer."""

    def __init__(self, configured: IntrinsicsConfig | None = None) -> None:
        self.sequencer = Sequencer(
            Parameters.from_mapping(
                {'readout_time': 0.02, 'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0]}
            ),
            offline=True,
        )
        self.intake = Intake(
            self.sequencer,
            None
            if configured is None
            else Parameters(intrinsics=configured, imu=ImuConfig(stuck_gyro_time=0.0)),
        )
        for stamp_ns in range(0, 10**9, 5_000_000):
            self.intake.receive(Role.IMU, build.imu(build.rosbags_types, stamp_ns))

    def info(self, **change: Any) -> Exception | None:
        return self.intake.receive(
            Role.CAMERA_INFO, build.camera_info(build.rosbags_types, **change)
        )

    def images(self, *numbers: int, height: int = 480) -> None:
        """Images at tenths of a second, no two alike."""
        for k in numbers:
            self.intake.receive(
                Role.IMAGE,
                build.gray_image(
                    build.rosbags_types, np.roll(PIXELS[:height], k), stamp_ns=k * 10**8
                ),
            )

    def taken(self) -> list[Any]:
        """Frames and refusals since the last call."""
        return list(iter(self.sequencer.take, None))


@pytest.fixture
def fed() -> Fed:
    return Fed()


def assert_refused(item: Any, refusal: Refusal, stamp_ns: int, reason: str) -> None:
    assert (item.refusal, item.stamp_ns) == (refusal, stamp_ns)
    assert reason in item.reason


def test_images_wait_for_their_camera_info_until_the_end(fed):
    fed.images(5)
    assert fed.taken() == []
    fed.info()
    [frame] = fed.taken()
    np.testing.assert_array_equal(frame.image, np.roll(PIXELS, 5))
    assert frame.frame_id == 'camera'
    without = Fed()
    without.images(*range(6))
    without.intake.finish()
    for k, item in enumerate(without.taken()):
        assert_refused(item, Refusal.NO_CALIBRATION, k * 10**8, 'no CameraInfo')
    assert k == 5


def test_no_outdated_calibration_is_used(fed):
    fed.info()
    assert isinstance(fed.info(**UNCALIBRATED), MissingInputError)
    assert 'uncalibrated' in fed.intake.camera_info_problem
    fed.images(1)
    [refused] = fed.taken()
    assert_refused(refused, Refusal.NO_CALIBRATION, 10**8, 'uncalibrated')


@pytest.mark.parametrize('change', [UNCALIBRATED, {}, {'model': 'bananas'}])
def test_configured_intrinsics_replace_the_camera_info(change):
    fed = Fed(CONFIGURED)
    fed.images(1)
    assert fed.info(**change) is None
    assert fed.intake.camera_info_problem == ''
    fed.images(2)
    for number, frame in enumerate(fed.taken(), start=1):
        assert frame.stamp_ns == number * 10**8
        assert frame.intrinsics == CONFIGURED.of_image(640, 480) == fed.intake.intrinsics
        assert fed.intake.camera_info_of(frame.intrinsics) is None
    # Each image has its own size.
    fed.images(6, height=240)
    [frame] = fed.taken()
    assert frame.intrinsics == CONFIGURED.of_image(640, 240)
    fed.intake.receive(
        Role.IMAGE, build.compressed(build.rosbags_types, b'none', stamp_ns=7 * 10**8)
    )
    [refused] = fed.taken()
    assert_refused(refused, Refusal.BAD_IMAGE, 7 * 10**8, 'neither JPEG nor PNG')
    # A recording that ends before.
    fed = Fed(CONFIGURED)
    fed.images(1, 2)
    fed.intake.finish()
    assert len(fed.taken()) == 2


def test_unusable_images_are_refused(fed):
    """Of another size, or with a stamp out of range."""
    fed.info()
    fed.images(1, height=240)
    image = build.gray_image(build.rosbags_types, PIXELS)
    image.header.stamp.nanosec = 10**9
    fed.intake.receive(Role.IMAGE, image)
    fed.images(2)
    # The last one was not queued.
    by_stamp = {item.stamp_ns: item for item in fed.taken()}
    assert_refused(by_stamp[10**8], Refusal.BAD_IMAGE, 10**8, '640x240')
    assert_refused(by_stamp[0], Refusal.BAD_IMAGE, 0, 'out of range')
    assert by_stamp[2 * 10**8].image.shape == (480, 640)
    assert fed.sequencer.counts().refused == {Refusal.BAD_IMAGE: 2}


# -- stuck sensors -----------------------------------------------------------------------------

NOISE = np.random.default_rng(0).normal(size=40)


def used(
    values: list[tuple[float, float, float]], step_ms: int = 5, longest: float = 0.025
) -> list[str]:
    """For each sample 'used', '' if it repeats the last one, or the error."""
    gyro = StuckGyro(longest)
    out = []
    for k, value in enumerate(values):
        try:
            repeats = gyro.repeats(ImuSample(k * step_ms * 10**6, value, None))
            out.append('' if repeats else 'used')
        except InputError as error:
            out.append(str(error))
    return out


def test_a_gyro_that_repeats_itself_is_stuck():
    found = used([(0.01, 0.02, 0.3)] * 8 + [(0.01, 0.02, 0.31)])
    # 25 ms are tolerated.
    assert found[:6] == ['used', *[''] * 5]
    assert all('it is stuck' in text for text in found[6:8])
    assert found[8] == 'used'
    assert 'it is stuck' in used([(0.0, 0.0, 0.0)] * 8)[-1]


def test_a_gyro_at_the_end_of_its_range_is_saturated():
    found = used([(-4.36, x, y) for x, y in NOISE[:16].reshape(8, 2)])
    assert found[1] == ''
    assert 'x axis' in found[-1] and found[-1].endswith('it is saturated')


def test_a_gyro_that_is_clipped_below_any_range_is_saturated():
    """Detected because it repeats the largest value so far."""
    rng = np.random.default_rng(0)
    rates = np.clip(1.3 * np.sin(np.linspace(0.0, 12.0, 240)), -0.7, 0.7)
    found = used([(x, y, z) for (x, y), z in zip(rng.normal(size=(240, 2)), rates, strict=True)])
    clipped = np.flatnonzero(np.abs(rates) == 0.7)
    assert 100 < len(clipped) < 180
    # The first of each stretch is true.
    firsts = clipped[np.diff(clipped, prepend=-2) > 1]
    assert [k for k, text in enumerate(found) if text != 'used'] == sorted(
        set(clipped.tolist()) - set(firsts.tolist())
    )
    assert any('z axis' in text and 'saturated' in text for text in found)


@pytest.mark.parametrize(
    ('values', 'options', 'count'),
    [
        # Coarse values that are not the largest, and a bias at rest that is.
        ([(1.0, -1.0, NOISE[0]), *((0.8, -0.8, z) for z in NOISE)], {}, 41),
        ([(0.15, -0.15, z) for z in NOISE], {}, 40),
        # A robot in the plane, and a coarse gyro at rest.
        ([(0.0, 0.0, z) for z in NOISE], {}, 40),
        ([(0.001, -0.001, z) for z in NOISE], {}, 40),
        # Drivers that are faster than their sensor.
        ([(z, z, z) for z in NOISE for _ in range(5)], {'step_ms': 1}, 40),
        ([(z, z, z) for z in NOISE for _ in range(2)], {'step_ms': 20}, 40),
        # Not to be detected.
        ([(0.0, 0.0, 0.0)] * 100, {'longest': 0.0}, 100),
    ],
)
def test_sensors_may_repeat_values(values, options, count):
    found = used(values, **options)
    assert found.count('used') == count
    assert set(found) <= {'used', ''}


def test_an_image_that_repeats_the_one_before():
    pixels = np.random.default_rng(0).integers(0, 256, 8000, dtype=np.uint8)
    other = pixels.copy()
    other[5050] ^= 1
    images = [
        CompressedImage(data, 'jpeg', stamp, 'camera')
        for stamp, data in enumerate((pixels, pixels.copy(), other, other, pixels[:4000], pixels))
    ]
    assert [repeats(*two) for two in pairwise(images)] == [True, False, True, False, False]
    assert not repeats(images[-1], images[-1])  # the same message once more


# -- Transforms of a robot: rules, bags, commands, calibration -------------------------------

QUATERNION = (0.5, -0.5, 0.5, 0.5)
FOUND: Transform = (0.1, 0.2, 0.3, *QUATERNION)
BUNDLED = read_parameters(BUNDLED_PARAMETERS)


def tf_message(*transforms: tuple[str, str, Transform]) -> Any:
    of = build.rosbags_types
    return of('tf2_msgs/msg/TFMessage')(
        transforms=[
            of('geometry_msgs/msg/TransformStamped')(
                header=build.header(of, 0, parent),
                child_frame_id=child,
                transform=of('geometry_msgs/msg/Transform')(
                    translation=of('geometry_msgs/msg/Vector3')(*values[:3]),
                    rotation=of('geometry_msgs/msg/Quaternion')(*values[3:]),
                ),
            )
            for parent, child, values in transforms
        ]
    )


def drawn(seed: int) -> Transform:
    rng = np.random.default_rng(seed)
    return *rng.normal(size=3), *Rotation.random(random_state=seed).as_quat()


def test_poses_are_chained_over_the_common_root():
    """Points mapped step by step are the independent result."""
    base_camera, camera_optical, base_imu = map(drawn, range(3))
    tree = FrameTree()
    tree.add(tf_message(('/base', 'camera', base_camera), ('camera', '/optical', camera_optical)))
    assert tree.lookup('optical', 'imu') is None
    tree.add(
        tf_message(
            ('base', 'imu', base_imu),
            ('base', 'imu', drawn(4)),
            ('base', 'broken', (math.nan, 0.0, 0.0, *QUATERNION)),
            ('base', 'zero', (0.0,) * 7),
        )
    )
    found = tree.lookup('optical', 'imu')

    def moved(pose: Transform, point: Any) -> Any:
        return Rotation.from_quat(pose[3:]).apply(point) + pose[:3]

    point = np.array([0.3, -0.2, 0.9])
    np.testing.assert_allclose(
        moved(base_imu, point), moved(base_camera, moved(camera_optical, moved(found, point)))
    )
    assert tree.lookup('base', 'broken') is tree.lookup('base', 'zero') is None
    tree.add(tf_message(('b', 'a', FOUND), ('a', 'b', FOUND)))
    assert tree.lookup('a', 'b') is tree.lookup('a', 'base') is None


def turned(degrees: float) -> Transform:
    turn = Rotation.from_rotvec([0.0, math.radians(degrees), 0.0])
    return *FOUND[:3], *(turn * Rotation.from_quat(QUATERNION)).as_quat()


@pytest.mark.parametrize(
    ('given', 'found', 'names', 'contradiction'),
    [
        ({}, FOUND, ['quat_cam_imu_xyzw', 'axes_sigma', 'imu_position', 'imu_position_sigma'], []),
        (
            {'quat_cam_imu_xyzw': QUATERNION},
            turned(4.0),
            ['imu_position', 'imu_position_sigma'],
            [],
        ),
        ({'quat_cam_imu_xyzw': QUATERNION}, turned(6.0), [], ['6.0 deg', '0.5000', '0.5255']),
        (
            {'quat_cam_imu_xyzw': QUATERNION, 'axes_sigma': 0.03},
            turned(6.0),
            ['imu_position', 'imu_position_sigma'],
            [],
        ),
        ({'imu_position': (0.1, 0.2, 0.36)}, FOUND, ['quat_cam_imu_xyzw', 'axes_sigma'], []),
        (
            {'imu_position': (0.1, 0.2, 0.5), 'quat_cam_imu_xyzw': QUATERNION},
            FOUND,
            [],
            ['0.3000', '0.5000'],
        ),
    ],
)
def test_configured_values_win_and_a_contradiction_has_both(given, found, names, contradiction):
    values, text = transforms.extrinsics(Parameters.from_mapping(given), found, 'camera', 'imu')
    assert list(values) == names
    assert bool(text) == bool(contradiction)
    assert all(part in text for part in contradiction)
    completed = Parameters.from_mapping(given).updated(values)
    if 'axes_sigma' in names:
        np.testing.assert_allclose(completed.sensor.quat_cam_imu_xyzw, QUATERNION)
        assert completed.sensor.axes_sigma == pytest.approx(math.radians(5.0))
    if 'imu_position' in names:
        assert completed.imu.imu_position == FOUND[:3]
        assert completed.imu.imu_position_sigma == 0.02


# -- bags ----------------------------------------------------------------------------------------

STATIC = tf_message(('base_link', 'mount', (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)))
TRUE = tf_message(
    ('mount', CAMERA_FRAME, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)),
    (CAMERA_FRAME, IMU_FRAME, (0.02, 0.01, 0.0, *BUNDLED.sensor.quat_cam_imu_xyzw)),
)


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory, bundled_bag: Path) -> Path:
    return bags.copied(
        bundled_bag,
        tmp_path_factory.mktemp('tf') / 'bag',
        seconds=2.0,
        first=[('/tf_static', STATIC), ('/tf', TRUE)],
    )


def test_a_bag_gives_what_is_missing(bag):
    wanted = {'base_frame': 'base_link'}
    with open_bag(bag) as opened:
        topics = opened.find_topics()
        found, contradiction = with_extrinsics(opened, topics, Parameters.from_mapping(wanted))
        left, _ = with_extrinsics(opened, topics, Parameters.from_mapping({'use_tf': False}))
    assert not contradiction
    np.testing.assert_allclose(
        found.sensor.quat_cam_imu_xyzw, BUNDLED.sensor.quat_cam_imu_xyzw, rtol=1e-5
    )
    np.testing.assert_allclose(found.imu.imu_position, (0.02, 0.01, 0.0), atol=1e-12)
    np.testing.assert_allclose(found.odometry.base_to_camera, (1.0, 0, 1.0, 0, 0, 0, 1.0))
    assert left == Parameters.from_mapping({'use_tf': False})


def test_one_frame_for_both_sensors_gives_nothing(tmp_path, bundled_bag):
    def change(message: Any) -> None:
        if hasattr(message, 'header'):
            message.header.frame_id = CAMERA_FRAME

    same = bags.copied(bundled_bag, tmp_path / 'bag', change, 0.2, [('/tf', TRUE)])
    with open_bag(same) as opened:
        assert with_extrinsics(opened, opened.find_topics(), Parameters())[0] == Parameters()


def run(*arguments: object) -> int:
    return command_line.main([str(argument) for argument in arguments])


def test_commands_need_only_the_readout_time(bag, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bias = ', '.join(map(str, BUNDLED.imu.gyro_bias))
    known = (
        '--set',
        f'readout_time={BUNDLED.sensor.readout_time}',
        '--set',
        f'gyro_bias=[{bias}]',
    )
    assert run('replay', bag, *known, '--no-pictures') == 0
    summary = json.loads((tmp_path / 'bag_relpose' / 'summary.json').read_text())
    assert summary['parameters']['imu_position_sigma'] == 0.02
    assert summary['errors_against_truth']['rotation_median_deg'] < 0.1
    assert run('unroll', bag, tmp_path / 'out', *known) == 0
    assert run('replay', bag, *known, '--set', 'use_tf=false', '--no-pictures') == 2


def test_commands_report_a_contradiction(bag, tmp_path, monkeypatch, capsys, caplog):
    monkeypatch.chdir(tmp_path)
    other = '--params', BUNDLED_PARAMETERS, '--set', 'imu_position=[0.5, 0, 0]'
    run('check', bag, *other, '--json')
    found = {item['name']: item for item in json.loads(capsys.readouterr().out)['findings']}
    assert found['transforms']['verdict'] == 'warning'
    assert '0.5000' in found['transforms']['text'] and '0.0200' in found['transforms']['text']
    assert run('replay', bag, *other, '--no-pictures') == 0
    assert '0.5000' in caplog.text


# -- results as messages ---------------------------------------------------------------------


def pair() -> PairResult:
    """A pair with covariances, outliers, and a rotation whose quaternion may have w < 0."""
    rng = np.random.default_rng(3)
    result = simulated_flight(0, 40).pairs[0]
    halves = rng.normal(size=(2, 6, 6))
    covariance, velocity_covariance = halves @ np.swapaxes(halves, 1, 2)
    # By more than 180 degrees about z.
    R = Rotation.from_euler('xyz', [0.1, -0.2, 3.3]).as_matrix()
    return replace(
        result,
        pose=replace(
            result.pose,
            R=R,
            inliers=rng.random(40) < 0.7,
            covariance=covariance,
            velocity_covariance=velocity_covariance,
        ),
        lesson=lambda: Learned(images_against_gyro=np.array([0.0, 3e-3, 4e-3])),
        gyro_bias=np.array([1e-3, 0.0, -2e-3]),
    )


def values_of(messages: dict[str, Any]) -> dict[str, str]:
    [status] = messages['pairs'].status
    return {item.key: item.value for item in status.values}


@build.both_types
def test_messages_of_a_pair_have_the_frames_and_conventions_of_ros(types):
    """Frames and conventions of ROS; `test_published_pair` reads all values back."""
    result = pair()
    messages = build.pair_messages(result, types)
    assert list(messages) == list(outgoing.PAIR_TOPICS)
    for topic, message in messages.items():
        assert incoming.stamp_ns(message.header) == result.stamp_ns
        assert message.header.frame_id == {
            'reference': 'camera',
            'velocity': 'camera',
            'pairs': '',
        }.get(topic, 'camera_reference')
    pose = messages['relative_pose'].pose
    rotation = messages['relative_rotation']
    q = pose.pose.orientation
    t = pose.pose.position
    assert q.w >= 0.0
    np.testing.assert_allclose(
        Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), result.pose.R, atol=1e-12
    )
    assert [t.x, t.y, t.z] == result.pose.t.tolist()
    # Row-major, x y z rotX rotY rotZ.
    np.testing.assert_allclose(
        np.reshape(pose.covariance, (6, 6)), result.pose.covariance, rtol=1e-9
    )
    twist = messages['velocity'].twist
    linear = twist.twist.linear
    angular = twist.twist.angular
    assert [linear.x, linear.y, linear.z] == result.pose.linear_velocity2.tolist()
    assert [angular.x, angular.y, angular.z] == result.pose.angular_velocity2.tolist()
    assert (rotation.orientation, rotation.angular_velocity) == (q, angular)
    for block, whole in (
        (rotation.orientation_covariance, pose.covariance),
        (rotation.angular_velocity_covariance, twist.covariance),
    ):
        np.testing.assert_allclose(
            np.reshape(block, (3, 3)), np.reshape(whole, (6, 6))[3:, 3:], rtol=1e-9
        )
    assert rotation.linear_acceleration_covariance[0] == -1.0
    [status] = messages['pairs'].status
    assert status.level in (0, b'\0')
    assert (status.message, status.hardware_id) == ('OK', 'camera')
    values = values_of(messages)
    assert (values['model'], values['matches'], values['inliers']) == (
        'uniform',
        '40',
        str(result.pose.inliers.sum()),
    )
    assert float(values['rotation_difference_to_gyro_deg']) == pytest.approx(np.degrees(5e-3))
    assert values['residual_rms_px'] == values['baseline_m'] == ''
    assert values['gyro_bias_rad_s'] == '0.001 0.0 -0.002'
    assert values['topics'] == 'relative_pose reference velocity matches relative_rotation'


@build.both_types
@pytest.mark.parametrize(('state', 'level'), [('ok', 0), ('suspect', 1), ('wrong', 2)])
def test_health_is_published_with_every_pair(types, state, level):
    finding = Finding(
        Code.TIME_OFFSET, FindingState(state), Why.CONSISTENT, (0.0,), (0.004,), 0.0005, 's'
    )
    messages = build.pair_messages(replace(pair(), health=Assessment((finding,))), types)
    values = values_of(messages)
    assert (values['health'], values['health_findings']) == (
        state,
        f'time_offset {state}: estimated 4.00 +- 0.50 ms, active 0.00 ms',
    )
    assert messages['pairs'].status[0].level in (level, bytes([level]))
    assert published_pair(messages).health == state


@build.both_types
@pytest.mark.parametrize(
    'status', [Status.PURE_ROTATION, Status.LOW_PARALLAX, Status.NO_CONSENSUS]
)
def test_a_pair_without_a_pose(types, status):
    whole = pair()
    known = status is not Status.NO_CONSENSUS
    result = replace(
        whole,
        pose=whole.pose.without_translation(status, 'none')
        if known
        else RelativePose(status=status, reason='none'),
    )
    messages = build.pair_messages(result, types, 'base')
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
        factor = rng.normal(size=(6, 5)) * 10.0 ** rng.uniform(-4.0, 0.0, (6, 1))
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
    assert build.pair_messages(result, types)['matches'].is_dense
    result.landmarks.points[result.pose.inliers.argmax()] = np.nan  # its rays are parallel
    cloud = build.pair_messages(result, types)['matches']
    assert cloud.header.frame_id == 'camera_reference'
    assert not cloud.is_dense
    names = [
        'u1',
        'v1',
        'u2',
        'v2',
        'tau1',
        'tau2',
        'x1',
        'y1',
        'z1',
        'x2',
        'y2',
        'z2',
        'x',
        'y',
        'z',
        'u1_gs',
        'v1_gs',
        'u2_gs',
        'v2_gs',
        'id',
    ]
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
        expected = [
            *result.matches.points1[index],
            *result.matches.points2[index],
            result.matches.row_times[0, index],
            result.matches.row_times[1, index],
            *result.matches.rays[0, index],
            *result.matches.rays[1, index],
            *result.landmarks.points[index],
            *result.landmarks.pixels1[index],
            *result.landmarks.pixels2[index],
            result.matches.track_ids[index],
        ]
        np.testing.assert_allclose(record, expected, rtol=1e-6)


def test_messages_of_rclpy_and_rosbags_serialise_alike():
    ours, theirs = (
        build.pair_messages(pair(), types) for types in (build.rclpy_types, build.rosbags_types)
    )
    for topic, message in theirs.items():
        assert deserialize_message(build.serialized(message), type(ours[topic])) == ours[topic]


# -- the bag writer ------------------------------------------------------------------------

STAMP_NS = 1_700_000_000_123_456_789


def test_messages_of_sensors(tmp_path):
    """As written by `simulate` and `convert`, whose tests read their images and poses back."""
    camera = RollingShutterCamera(
        width=64,
        height=48,
        fx=50.0,
        fy=51.0,
        cx=31.0,
        cy=23.0,
        readout_time=0.03,
        distortion=(-0.1, 0.01, 0.0, 0.0, 0.0),
    )
    with BagWriter(tmp_path / 'deep' / 'bag') as bag:
        for number, message in enumerate(
            (
                outgoing.imu_message(
                    STAMP_NS,
                    'imu_link',
                    (0.1, 0.2, 0.3),
                    (1.0, 2.0, 9.8),
                    bag.type,
                    covariances={'angular_velocity': 4e-6 * np.eye(3)},
                ),
                outgoing.camera_info_message(STAMP_NS, 'cam', camera, None, bag.type),
            )
        ):
            bag.write(f'/{number}', message.__msgtype__, message, STAMP_NS + number)
    with AnyReader([tmp_path / 'deep' / 'bag']) as reader:
        (topic, time_ns, imu), (*_, info) = (
            (connection.topic, time_ns, reader.deserialize(data, connection.msgtype))
            for connection, time_ns, data in reader.messages()
        )
    assert (topic, time_ns, incoming.stamp_ns(imu.header)) == ('/0', STAMP_NS, STAMP_NS)
    assert imu.header.frame_id == 'imu_link'
    assert (imu.angular_velocity.x, imu.linear_acceleration.z) == (0.1, 9.8)
    assert imu.orientation_covariance[0] == -1.0
    np.testing.assert_array_equal(imu.angular_velocity_covariance.reshape(3, 3), 4e-6 * np.eye(3))
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
    with pytest.raises(InputError, match='cannot be written'), BagWriter(occupied / 'bag'):
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
