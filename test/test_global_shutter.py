"""Derotated images: map, pixels, stamps, and bags, against independent truth."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from conftest import BUNDLED_PARAMETERS
import cv2
import message_builders as build
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments import global_shutter as lab
from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.bag import write_bag, write_parameters
from rs_relpose_ros.bags.reader import open_bag, RawMessage
from rs_relpose_ros.calibration.findings import Assessment
from rs_relpose_ros.cli.main import main as command_line
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.geometry.camera import Intrinsics, RollingShutterCamera
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.timing import ImageClock, Sensor
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.messages import incoming
from rs_relpose_ros.messages.camera_info import intrinsics_from_info
from rs_relpose_ros.messages.incoming import Intake, Role, stamp_ns
from rs_relpose_ros.pipeline.global_shutter import MiddleRow, unrolling_loop
from rs_relpose_ros.pipeline.pair import Frame
from rs_relpose_ros.tracking.images import CompressedImage, RawImage

# Whoever comes first compiles the kernels.
pytestmark = pytest.mark.timeout(600)

MS = 10**6
LENSES = {
    'plumb_bob': (-0.12, 0.05, 0.0008, -0.0005, 0.0),
    'rational_polynomial': (0.3, 0.05, 4e-4, -3e-4, 0.01, 0.5, 0.1, 0.02),
    'equidistant': (0.01, -0.01, 0.002, 0.0),
}
# Part of the sensor that is published: offset x, y; binning x, y; size of the image.
REGIONS = {
    'whole': (0, 0, 1, 1, 640, 480),
    'region': (64, 120, 1, 1, 512, 240),
    'binning': (0, 0, 2, 2, 320, 240),
    'both': (40, 80, 2, 4, 200, 80),
}
RATE = np.array([1.2, -2.4, 1.3])  # 3.0 rad/s


def sensor(
    lens: str = 'plumb_bob',
    region: str = 'whole',
    direction: str = 'down',
    stamp_row: str = 'first',
    **values: Any,
) -> Sensor:
    x, y, binning_x, binning_y, width, height = REGIONS[region]
    intrinsics = Intrinsics(
        **{
            'width': 640,
            'height': 480,
            'fx': 450.0,
            'fy': 452.0,
            'cx': 322.0,
            'cy': 236.0,
            'distortion_model': lens,
            'distortion': LENSES[lens],
            'x_offset': x,
            'y_offset': y,
            'binning_x': binning_x,
            'binning_y': binning_y,
            'image_width': width,
            'image_height': height,
            **values,
        }
    )
    camera = replace(
        intrinsics.global_shutter_camera(),
        readout_time=0.03,
        readout_direction=direction,
        reference_row=stamp_row,
    )
    return Sensor(camera, intrinsics, ImageClock(camera))


def opencv_pixels(rays: np.ndarray, camera: RollingShutterCamera) -> np.ndarray:
    """Projection by OpenCV, which shares no code with ours."""
    if camera.distortion_model == 'equidistant':
        points = (rays[:, :2] / rays[:, 2:])[:, None]
        return cv2.fisheye.distortPoints(
            points, camera.camera_matrix, np.array(camera.distortion)
        )[:, 0]
    points, _ = cv2.projectPoints(
        rays, np.zeros(3), np.zeros(3), camera.camera_matrix, np.array(camera.distortion)
    )
    return points[:, 0]


# Every lens in every region, every direction and stamped row in every region.
CASES = [
    (lens, region, ('down', 'up')[(k + j) % 2], ('first', 'last')[k % 2])
    for k, lens in enumerate(LENSES)
    for j, region in enumerate(REGIONS)
]


@pytest.mark.parametrize(('lens', 'region', 'direction', 'stamp_row'), CASES)
def test_a_ray_is_where_its_own_row_observed_it(lens, region, direction, stamp_row):
    """Of a ray in the middle row's frame the pixel as read, by OpenCV, SciPy and bisection."""
    middle = MiddleRow(sensor(lens, region, direction, stamp_row))
    camera = middle.sensor.camera
    intrinsics = middle.sensor.intrinsics
    found = np.concatenate([band for _, band in middle.map(FrameMotion(RATE)).bands()])
    assert found.shape == (intrinsics.image_height, intrinsics.image_width, 2)
    rng = np.random.default_rng(0)
    rays = rng.uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 1.0], (3000, 3))
    in_image = intrinsics.to_image(opencv_pixels(rays, camera))
    delay = camera.line_delay * (
        intrinsics.to_sensor([[0.0, 0.5 * (intrinsics.image_height - 1)]])[0, 1]
        - camera.reference_row_index
    )
    assert middle.delay == pytest.approx(delay, abs=1e-12)

    def rays_from(rows: np.ndarray) -> np.ndarray:
        times = (rows - camera.reference_row_index) * camera.line_delay
        rotation = Rotation.from_rotvec((delay - times)[:, None] * RATE)
        return opencv_pixels(rotation.apply(rays), camera)

    low = np.full(len(rays), -100.0)
    high = np.full(len(rays), 600.0)
    for _ in range(40):
        rows = 0.5 * (low + high)
        below = rays_from(rows)[:, 1] > rows
        low = np.where(below, rows, low)
        high = np.where(below, high, rows)
    as_read = intrinsics.to_image(rays_from(rows))
    # What lies within both images, where the map can be interpolated at the destination.
    size = np.array([intrinsics.image_width - 1, intrinsics.image_height - 1])
    both = ((in_image >= 0) & (in_image < size) & (as_read >= 0) & (as_read <= size)).all(1)
    assert both.sum() > 200
    by_map = np.stack(
        [map_coordinates(found[..., axis], in_image[both].T[::-1], order=1) for axis in range(2)],
        axis=1,
    )
    errors = np.linalg.norm(by_map - as_read[both], axis=1)
    assert errors.max() <= 0.02 and np.median(errors) <= 0.01


def test_pixels_outside_of_the_lens_are_black_for_any_border():
    """Corners of a fisheye beyond 90 degrees."""
    found = MiddleRow(
        sensor(
            'equidistant', fx=200.0, fy=200.0, cx=319.5, cy=239.5, distortion=(0.0, 0.0, 0.0, 0.0)
        )
    ).map(FrameMotion(RATE))
    assert np.isnan(found.nodes).any()
    sources = np.concatenate([band for _, band in found.bands()])
    assert np.isnan(sources[0, 0]).all()
    assert np.isfinite(sources[200:280, 200:440]).all()


def derotated(image: Any, *, rate: Any = RATE, **configured: Any) -> Any:
    """The result of the loop for an image of the usual sensor."""
    parameters = Parameters.from_mapping(
        {
            'readout_time': 0.03,
            'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0],
            'stuck_gyro_time': 0.0,
            'track_gyro_bias': False,
            **configured,
        }
    )
    loop = unrolling_loop(parameters, offline=True)
    for ms in range(0, 400, 5):
        loop.sequencer.add_imu(ImuSample(ms * MS, tuple(rate), (0.0, -9.81, 0.0)))
    loop.sequencer.add_frame(
        replace(image, stamp_ns=100 * MS, frame_id='camera'), sensor().intrinsics
    )
    outcome = loop.step()
    assert isinstance(outcome, Frame), outcome
    return outcome.result


def smooth(channels: int, dtype: Any = np.uint8) -> np.ndarray:
    rng = np.random.default_rng(1)
    image = cv2.GaussianBlur(
        rng.integers(0, 256, (480, 640, channels)).astype(np.float32), (0, 0), 3.0
    )
    return (
        cv2.normalize(image, None, 0, 1, cv2.NORM_MINMAX).reshape(480, 640, channels)
        * np.iinfo(dtype).max
    ).astype(dtype)


def raw(values: np.ndarray, encoding: str, *, big: bool = False) -> RawImage:
    data = values.byteswap() if big else values
    return RawImage(
        np.frombuffer(data.tobytes(), np.uint8), encoding, 640, 480, values[0].nbytes, big
    )


@pytest.mark.parametrize(
    ('encoding', 'channels', 'dtype'),
    [
        ('mono8', 1, np.uint8),
        ('bgr8', 3, np.uint8),
        ('rgb8', 3, np.uint8),
        ('bgra8', 4, np.uint8),
        ('mono16', 1, np.uint16),
    ],
)
def test_pixels_are_interpolated_in_their_encoding(encoding, channels, dtype):
    values = smooth(channels, dtype)
    frame = derotated(raw(values, encoding, big=dtype is np.uint16))
    found = frame.image()
    assert found.encoding == encoding
    assert found.values.dtype == dtype
    sources = np.concatenate([band for _, band in frame.map.bands()])
    expected = np.stack(
        [
            map_coordinates(
                channel, np.moveaxis(sources, 2, 0)[::-1], np.float64, order=1, mode='nearest'
            )
            for channel in np.moveaxis(values, 2, 0)
        ],
        axis=2,
    )
    # Places are rounded to 1/32 px by some versions of OpenCV.
    tolerance = 0.02 * np.iinfo(dtype).max
    difference = np.abs(found.values.reshape(480, 640, channels) - expected)
    assert difference.max() <= tolerance
    assert frame.map.shift > 15.0
    assert difference.mean() < 0.2 * np.abs(values - expected).mean()


@pytest.mark.parametrize(
    ('suffix', 'channels', 'dtype', 'encoding'),
    [
        ('.png', 1, np.uint8, 'mono8'),
        ('.png', 3, np.uint8, 'bgr8'),
        ('.png', 1, np.uint16, 'mono16'),
        ('.jpg', 1, np.uint8, 'mono8'),
        ('.jpg', 3, np.uint8, 'bgr8'),
    ],
)
def test_compressed_images_are_turned_as_raw_ones(suffix, channels, dtype, encoding):
    values = smooth(channels, dtype)
    data = cv2.imencode(suffix, values)[1]
    frame = derotated(CompressedImage(data, 'whatever'))
    decoded = cv2.imdecode(data, cv2.IMREAD_UNCHANGED).reshape(480, 640, channels)
    assert frame.is_png == (suffix == '.png')
    assert frame.image().encoding == encoding
    np.testing.assert_array_equal(
        frame.image().values, derotated(raw(decoded, encoding)).image().values
    )


@pytest.mark.parametrize('encoding', ['bayer_rggb8', 'nv12'])
def test_other_encodings_become_gray(encoding):
    frame = derotated(RawImage(smooth(1).ravel(), encoding, 640, 480, 640, False))
    assert frame.image().encoding == 'mono8'


def test_border_is_replicated_or_black_and_the_mask_tells_where():
    white = np.full((480, 640, 1), 255, dtype=np.uint8)
    replicated, black = (
        derotated(raw(white, 'mono8'), border=border) for border in ('replicate', 'black')
    )
    assert (replicated.image().values == 255).all()
    pixels = black.image().values
    mask = black.mask()
    assert mask.encoding == 'mono8'
    assert set(np.unique(mask.values)) == {0, 255}
    assert 0.02 < (mask.values == 0).mean() < 0.2
    # At the border itself black is mixed in.
    assert (pixels[mask.values == 255] == 255).all()
    assert (pixels[cv2.dilate(mask.values, np.ones((5, 5))) == 0] == 0).all()


@pytest.mark.parametrize(
    ('changed', 'expected_ms'),
    [
        ({}, 14.96875),
        ({'stamp_row': 'last'}, -14.96875),
        ({'stamp_row': 'middle'}, 0.0),
        ({'readout_direction': 'up'}, -14.96875),
        ({'stamp_exposure': 'start', 'exposure_time': 0.01}, 19.96875),
    ],
)
def test_stamps_are_those_of_the_middle_row(changed, expected_ms):
    image = raw(smooth(1), 'mono8')
    for clock, offset_ms in (('imu', 20.0), ('camera', 0.0)):
        frame = derotated(image, **changed, time_offset=0.02, stamp_clock=clock)
        assert frame.stamp_ns == pytest.approx((100.0 + offset_ms + expected_ms) * MS, abs=2)


@pytest.mark.parametrize(('changed', 'rate'), [({}, np.zeros(3)), ({'readout_time': 0.0}, RATE)])
def test_without_rotation_or_readout_the_image_is_unchanged(changed, rate):
    values = smooth(1)
    frame = derotated(raw(values, 'mono8'), rate=rate, **changed)
    assert frame.map.shift < 1e-6
    np.testing.assert_array_equal(frame.image().values, values[..., 0])


def test_a_swinging_camera_against_the_truth():
    """Measured IMU, its bias and noise included; the aim of the project."""
    errors = lab.map_errors(
        'swing', SimulationConfig(seed=9301, duration=0.4), lab.swinging(3.0, 0.4)
    )
    assert errors.rate > 2.5
    assert errors.left <= 0.05
    assert errors.left_p90 <= 0.15


def test_a_tracked_time_offset_is_applied():
    """The pairs show it, as to relpose_node, and the stamps move by it."""
    simulation = simulate(
        SimulationConfig(
            seed=9304,
            duration=4.0,
            plan='walk:4.0',
            time_offset=0.008,
            width=320,
            height=240,
            fx=225.0,
        )
    )
    parameters = lab.configured(simulation).updated(
        {'time_offset': 0.0, 'track_time_offset': True}
    )
    *_, (index, last) = lab.derotated_frames(simulation, parameters, images=True)
    assert last.applied_offset_ns == pytest.approx(8 * MS, abs=1.5 * MS)
    middle = simulation.reference_ns(index) + round(119.5 / 240 * 30 * MS)
    assert last.stamp_ns == pytest.approx(middle, abs=1.5 * MS)


@pytest.fixture(scope='module')
def bag(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp('bag')
    simulation = simulate(
        SimulationConfig(
            seed=9305, duration=1.0, width=320, height=240, fx=225.0, time_offset=0.004
        )
    )
    write_bag(simulation, folder / 'walk')
    write_parameters(simulation, folder / 'walk.yaml')
    return folder / 'walk', folder / 'walk.yaml'


def messages_of(path: Path) -> list[RawMessage]:
    with open_bag(path) as opened:
        return list(opened.raw_messages(opened.topics))


def unroll(bag: Path, parameters: Path, out: Path, *options: str) -> int:
    return command_line(['unroll', str(bag), str(out), '--params', str(parameters), *options])


@pytest.fixture(scope='module')
def unrolled(bag, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp('unrolled') / 'out'
    assert unroll(*bag, out) == 0
    assert list(out.parent.iterdir()) == [out]
    return out


def test_everything_else_is_copied_bit_by_bit(bag, unrolled):
    before = messages_of(bag[0])
    after = messages_of(unrolled)
    own = ('/camera/image_raw/compressed', '/camera/camera_info')

    def others(messages):
        return [
            (m.topic, m.msgtype, m.bag_time_ns, bytes(m.data))
            for m in messages
            if m.topic not in own
        ]

    assert others(after) == others(before)
    assert len(others(after)) > 200
    for topic in own:
        times = [
            [m.bag_time_ns for m in messages if m.topic == topic] for messages in (before, after)
        ]
        assert times[0] == times[1] == sorted(times[1])
    with open_bag(bag[0]) as opened, open_bag(unrolled) as copied:
        assert {topic: opened.origin(topic) for topic in opened.topics} == {
            topic: copied.origin(topic) for topic in copied.topics
        }


def sensor_messages_of(path: Path) -> tuple[list[Any], list[Any]]:
    """Images and CameraInfos."""
    with open_bag(path) as opened:
        topics = opened.find_topics()
        assert topics.camera_info.name == '/camera/camera_info'
        return tuple(
            [m.message for m in opened.messages([topic])]
            for topic in (topics.image, topics.camera_info)
        )


def test_images_and_infos_have_the_stamp_of_the_middle_row(bag, unrolled):
    before = sensor_messages_of(bag[0])
    after = sensor_messages_of(unrolled)
    delay = round(4 * MS + 119.5 / 240 * 30 * MS)
    for messages in after:
        assert [stamp_ns(m.header) for m in messages] == pytest.approx(
            [stamp_ns(m.header) + delay for m in before[0]], abs=1
        )
    assert intrinsics_from_info(before[1][0]) == intrinsics_from_info(after[1][0])
    assert after[0][0].format.startswith('mono8; jpeg')
    pixels = [
        incoming.image_from_message(images[20]).decoded().astype(int)
        for images, _ in (before, after)
    ]
    assert 1.0 < np.abs(pixels[1] - pixels[0]).mean() < 40.0


def rewritten(path: Path, out: Path, keep: Any, extra: Any = lambda writer: None) -> Path:
    """A copy of a bag with the raw messages for which `keep` is true, and extra ones."""
    with (
        open_bag(path) as opened,
        Writer2(out, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        connections = {
            topic.name: writer.add_connection(topic.name, topic.msgtype, typestore=build.TYPESTORE)
            for topic in opened.topics
        }
        for m in filter(keep, opened.raw_messages(opened.topics)):
            writer.write(connections[m.topic], m.bag_time_ns, m.data)
        extra(writer)
    return out


def test_images_without_gyro_are_left_out_and_configured_intrinsics_become_a_camera_info(
    bag, tmp_path, capsys
):
    path, parameters = bag
    start = messages_of(path)[0].bag_time_ns
    info = sensor_messages_of(path)[1][0]
    bare = rewritten(
        path,
        tmp_path / 'bare',
        lambda m: (
            not (
                m.topic == '/camera/camera_info'
                or (m.topic == '/imu/data_raw' and 500 * MS < m.bag_time_ns - start < 600 * MS)
            )
        ),
    )
    matrix, distortion = ([float(v) for v in values] for values in (info.k, info.d))
    assert (
        unroll(
            bare,
            parameters,
            tmp_path / 'out',
            '--set',
            f'camera_matrix={matrix}',
            '--set',
            f'distortion_coefficients={distortion}',
        )
        == 0
    )
    images, infos = sensor_messages_of(tmp_path / 'out')
    assert 23 <= len(images) <= 28
    assert (
        f'{len(images)} of 30 images derotated, {30 - len(images)} omitted'
        in capsys.readouterr().out
    )
    assert [stamp_ns(m.header) for m in infos] == [stamp_ns(m.header) for m in images]
    assert intrinsics_from_info(infos[0]) == intrinsics_from_info(info)


def test_unknown_types_are_copied_and_other_images_of_the_same_stamps_reported(
    bag, tmp_path, caplog
):
    path, parameters = bag
    payload = b'\x00\x01\x00\x00' + bytes(range(20))
    end_ns = messages_of(path)[-1].bag_time_ns

    def add(writer):
        own = writer.add_connection(
            '/own', 'own_msgs/msg/Thing', msgdef='uint8[20] data', rihs01='RIHS01_' + 'ab' * 32
        )
        writer.write(own, end_ns + 1, payload)
        other = writer.add_connection('/depth', 'sensor_msgs/msg/Image', typestore=build.TYPESTORE)
        for k, m in enumerate(sensor_messages_of(path)[0]):
            writer.write(
                other,
                end_ns + k,
                build.serialized(
                    build.gray_image(
                        build.rosbags_types, np.zeros((4, 4), np.uint8), stamp_ns(m.header)
                    )
                ),
            )

    both = rewritten(path, tmp_path / 'both', lambda m: True, add)
    options = ('--image-topic', '/camera/image_raw/compressed')
    assert unroll(both, parameters, tmp_path / 'out', *options) == 0
    assert '/depth had the stamps of the derotated images and keep them' in caplog.text
    [found] = [m for m in messages_of(tmp_path / 'out') if m.topic == '/own']
    assert (found.msgtype, bytes(found.data)) == ('own_msgs/msg/Thing', payload)
    caplog.clear()
    assert (
        unroll(both, parameters, tmp_path / 'out2', *options, '--set', 'stamp_clock=camera') == 0
    )
    assert '/depth' not in caplog.text


def test_ros1_bags_become_bags_of_ros2(bag, unrolled, tmp_path, caplog):
    path, parameters = bag
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg('uint8 data', 'own_msgs/msg/Thing'))
    old = tmp_path / 'old.bag'
    with Writer1(old) as writer, open_bag(path) as opened:
        connections = {
            topic.name: writer.add_connection(topic.name, topic.msgtype, typestore=store)
            for topic in opened.topics
        }
        latched = writer.add_connection('/own', 'own_msgs/msg/Thing', typestore=store)
        for m in opened.raw_messages(opened.topics):
            data = build.TYPESTORE.cdr_to_ros1(m.data, m.msgtype)
            writer.write(connections[m.topic], m.bag_time_ns, bytes(data))
        writer.write(latched, m.bag_time_ns, b'\x01')
    assert unroll(old, parameters, tmp_path / 'out') == 0
    assert '/own (own_msgs/msg/Thing) is omitted: ROS 2 has no such message type' in caplog.text
    # At the same time, messages come in another order.
    found, expected = (
        sorted((m.bag_time_ns, m.topic, m.msgtype, bytes(m.data)) for m in messages_of(folder))
        for folder in (tmp_path / 'out', unrolled)
    )
    assert found == expected


def test_nothing_is_left_behind_by_a_run_that_fails(bag, tmp_path, monkeypatch, capsys, refused):
    (taken := tmp_path / 'taken').mkdir()
    # No gyro at these times.
    assert unroll(*bag, tmp_path / 'out', '--set', 'time_offset=9.0') == 1
    assert '0 of 30 images derotated, 30 omitted; nothing was written' in capsys.readouterr().out

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr('rs_relpose_ros.bags.writer.BagWriter.write', interrupted)
    assert unroll(*bag, tmp_path / 'out') == 130
    capsys.readouterr()
    assert list(tmp_path.iterdir()) == [taken]
    for options, expected in (
        ((taken, '--params', bag[1]), 'exists already'),
        ((tmp_path / 'out',), f'--params {bag[1]}, the file next to the bag'),
    ):
        refused(expected, 'unroll', bag[0], *options)


@pytest.mark.parametrize(
    ('options', 'expected'),
    [
        (['--set', 'border=white'], 'border must be one of replicate, black'),
        (['--set', 'stamp_clock=ros'], 'stamp_clock must be one of imu, camera'),
        (['--image-topic', '/nothing'], 'has no topic /nothing'),
    ],
)
def test_bad_input_is_one_line(bag, tmp_path, refused, options, expected):
    refused(expected, 'unroll', bag[0], tmp_path / 'out', '--params', bag[1], *options)


# -- the own watch of the rotation ---------------------------------------------------------------


def watched(
    bag: Path, parameters: Parameters, change: Callable[[Any], None], *, is_watched: bool = True
) -> list[Assessment]:
    """States of the calibration with each frame."""
    loop = unrolling_loop(parameters, offline=True, watched=lambda: is_watched)
    intake = Intake(loop.sequencer, parameters)
    found = []
    with open_bag(bag) as opened:
        for role, message in incoming.sensor_messages(opened, opened.find_topics()):
            if role is Role.IMU:
                change(message.message.angular_velocity)
            intake.receive(role, message.message)
            while (frame := loop.step()) is not None:
                found.append(frame.result.health)
    return found


def in_degrees(rate: Any) -> None:
    rate.x, rate.y, rate.z = np.degrees([rate.x, rate.y, rate.z])


def with_a_sign(rate: Any) -> None:
    rate.y = -rate.y


@pytest.mark.parametrize(
    ('turn', 'change', 'quantity'),
    [
        ((0.0, 0.0, np.pi), lambda rate: None, 'axes'),
        ((0.0, 0.0, 0.0), in_degrees, 'gyro_unit'),
        ((0.0, 0.0, 0.0), with_a_sign, 'axes'),
        ((0.0, 0.0, 0.0), lambda rate: None, ''),
    ],
)
def test_gross_errors_are_found_without_relpose_node(bundled_bag, turn, change, quantity):
    parameters = read_parameters(BUNDLED_PARAMETERS)
    parameters = parameters.updated(
        {
            'quat_cam_imu_xyzw': tuple(
                (
                    Rotation.from_rotvec(turn)
                    * Rotation.from_quat(parameters.sensor.quat_cam_imu_xyzw)
                ).as_quat()
            )
        }
    )
    found = watched(bundled_bag, parameters, change)
    named = [health.faults[0].code if health.faults else '' for health in found]
    assert set(named) == {'', quantity} and named[-1] == quantity
    # Within 3 s of the walk.
    assert not quantity or named.index(quantity) < 90


def test_nothing_is_watched_where_relpose_node_does(bundled_bag):
    found = watched(bundled_bag, read_parameters(BUNDLED_PARAMETERS), in_degrees, is_watched=False)
    assert not any(health.faults for health in found)
