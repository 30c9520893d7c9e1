"""Images turned to their middle row: map, pixels, stamps, and bags, against independent truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import subprocess
import sys
from typing import Any

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

from rs_relpose_lab.experiments.unrolled_map import (
    map_errors,
    middle_renderer,
    middle_seconds,
    swinging,
    told,
    turned_frames,
)
from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.bag import write_bag, write_parameters
from rs_relpose_ros.bags.reader import open_bag, RawMessage
from rs_relpose_ros.cli.main import main as command_line
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.front_end.derotated_rays import Sensor
from rs_relpose_ros.front_end.front_end import FrameProcessed
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.global_shutter.frames import EncodedColorFrame
from rs_relpose_ros.global_shutter.row_map import MiddleRow
from rs_relpose_ros.global_shutter.unroller import unrolling_loop
from rs_relpose_ros.images.encoded import CompressedImage, RawImage
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.messages.incoming import image_from_message, intrinsics_from_info, stamp_ns

# Whoever comes first compiles the kernels.
pytestmark = pytest.mark.timeout(600)

MS = 10**6
LENSES = {
    'plumb_bob': (-0.12, 0.05, 0.0008, -0.0005, 0.0),
    'rational_polynomial': (0.3, 0.05, 4e-4, -3e-4, 0.01, 0.5, 0.1, 0.02),
    'equidistant': (0.01, -0.01, 0.002, 0.0),
}
# Part of the sensor that is published: offset x, y; binning x, y; size of the image.
REGIONS = {'whole': (0, 0, 1, 1, 640, 480), 'region': (64, 120, 1, 1, 512, 240),
           'binning': (0, 0, 2, 2, 320, 240), 'both': (40, 80, 2, 4, 200, 80)}
RATE = np.array([1.2, -2.4, 1.3])   # 3.0 rad/s


def sensor(lens: str = 'plumb_bob', region: str = 'whole', direction: str = 'down',
           stamp_row: str = 'first') -> Sensor:
    x, y, binning_x, binning_y, width, height = REGIONS[region]
    intrinsics = Intrinsics(
        width=640, height=480, fx=450.0, fy=452.0, cx=322.0, cy=236.0, distortion_model=lens,
        distortion=LENSES[lens], x_offset=x, y_offset=y, binning_x=binning_x,
        binning_y=binning_y, image_width=width, image_height=height)
    return Sensor(replace(intrinsics.global_shutter_camera(), readout_time=0.03,
                          readout_direction=direction, reference_row=stamp_row), intrinsics)


def opencv_pixels(rays: np.ndarray, camera: RollingShutterCamera) -> np.ndarray:
    """Projection by OpenCV, which shares no code with ours."""
    if camera.distortion_model == 'equidistant':
        points = (rays[:, :2] / rays[:, 2:])[:, None]
        return cv2.fisheye.distortPoints(points, camera.camera_matrix,
                                         np.array(camera.distortion))[:, 0]
    points, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.camera_matrix,
                                  np.array(camera.distortion))
    return points[:, 0]


@pytest.mark.parametrize('stamp_row', ['first', 'last'])
@pytest.mark.parametrize('direction', ['down', 'up'])
@pytest.mark.parametrize('region', REGIONS)
@pytest.mark.parametrize('lens', LENSES)
def test_a_ray_is_where_its_own_row_saw_it(lens, region, direction, stamp_row):
    """Of a ray in the middle row's frame the pixel as read, by OpenCV, SciPy and bisection."""
    camera, intrinsics = sensor(lens, region, direction, stamp_row)
    middle = MiddleRow(Sensor(camera, intrinsics))
    found = np.concatenate([band for _, band in middle.map(FrameMotion(RATE)).bands()])
    assert found.shape == (intrinsics.image_height, intrinsics.image_width, 2)
    rng = np.random.default_rng(0)
    rays = rng.uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 1.0], (3000, 3))
    in_image = intrinsics.to_image(opencv_pixels(rays, camera))
    delay = camera.line_delay * (intrinsics.to_sensor(
        [[0.0, 0.5 * (intrinsics.image_height - 1)]])[0, 1] - camera.reference_row_index)
    assert middle.delay == pytest.approx(delay, abs=1e-12)

    def seen_from(rows: np.ndarray) -> np.ndarray:
        times = (rows - camera.reference_row_index) * camera.line_delay
        turned = Rotation.from_rotvec((delay - times)[:, None] * RATE).apply(rays)
        return opencv_pixels(turned, camera)

    low, high = np.full(len(rays), -100.0), np.full(len(rays), 600.0)
    for _ in range(60):
        rows = 0.5 * (low + high)
        below = seen_from(rows)[:, 1] > rows
        low, high = np.where(below, rows, low), np.where(below, high, rows)
    as_read = intrinsics.to_image(seen_from(rows))
    # What lies within both images, where the map can be interpolated at the destination.
    size = np.array([intrinsics.image_width - 1, intrinsics.image_height - 1])
    both = (((in_image >= 0) & (in_image < size) & (as_read >= 0) & (as_read <= size)).all(1))
    assert both.sum() > 200
    by_map = np.stack([map_coordinates(found[..., axis], in_image[both].T[::-1], order=1)
                       for axis in range(2)], axis=1)
    errors = np.linalg.norm(by_map - as_read[both], axis=1)
    assert errors.max() <= 0.02
    assert np.median(errors) <= 0.01


def test_pixels_that_the_lens_does_not_see_are_black_whatever_the_border():
    """Corners of a fisheye beyond 90 degrees; the others are turned as always."""
    intrinsics = Intrinsics(width=640, height=480, fx=200.0, fy=200.0, cx=319.5, cy=239.5,
                            image_width=640, image_height=480, distortion_model='equidistant',
                            distortion=(0.0, 0.0, 0.0, 0.0))
    camera = replace(intrinsics.global_shutter_camera(), readout_time=0.03)
    found = MiddleRow(Sensor(camera, intrinsics)).map(FrameMotion(RATE))
    assert not found.complete
    sources = np.concatenate([band for _, band in found.bands()])
    assert np.isnan(sources[0, 0]).all()
    assert np.isfinite(sources[200:280, 200:440]).all()


# -- pixels and stamps -----------------------------------------------------------------------


def turned(image: Any, *, told: dict[str, Any] | None = None, rate: Any = RATE,
           stamp: int = 100 * MS) -> Any:
    """What the loop makes of an image of the usual sensor."""
    parameters = Parameters.from_mapping({
        'readout_time': 0.03, 'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0], 'stuck_gyro_time': 0.0,
        'track_gyro_bias': False, **(told or {})})
    loop = unrolling_loop(parameters, offline=True)
    for ms in range(0, 400, 5):
        loop.sequencer.add_imu(ImuSample(ms * MS, tuple(rate), (0.0, -9.81, 0.0)))
    loop.sequencer.add_frame(EncodedColorFrame(stamp, image, 'camera', sensor().intrinsics))
    outcome = loop.step()
    assert isinstance(outcome, FrameProcessed), outcome
    return outcome.result


def smooth(channels: int, dtype: Any = np.uint8) -> np.ndarray:
    rng = np.random.default_rng(1)
    image = cv2.GaussianBlur(rng.integers(0, 256, (480, 640, channels)).astype(np.float32),
                             (0, 0), 3.0)
    return (cv2.normalize(image, None, 0, 1, cv2.NORM_MINMAX).reshape(480, 640, channels)
            * np.iinfo(dtype).max).astype(dtype)


def raw(values: np.ndarray, encoding: str, *, big: bool = False) -> RawImage:
    data = values.byteswap() if big else values
    return RawImage(np.frombuffer(data.tobytes(), np.uint8), encoding, 640, 480,
                    values[0].nbytes, big)


def bilinear(values: np.ndarray, sources: np.ndarray) -> np.ndarray:
    """Bilinear interpolation in NumPy, border replicated."""
    u, v = np.clip(sources[..., 0], 0, 639), np.clip(sources[..., 1], 0, 479)
    i, j = np.minimum(v.astype(int), 478), np.minimum(u.astype(int), 638)
    a, b = (u - j)[..., None], (v - i)[..., None]
    f = values.astype(float)
    return ((f[i, j] * (1 - a) + f[i, j + 1] * a) * (1 - b)
            + (f[i + 1, j] * (1 - a) + f[i + 1, j + 1] * a) * b)


@pytest.mark.parametrize(('encoding', 'channels', 'dtype'), [
    ('mono8', 1, np.uint8), ('bgr8', 3, np.uint8), ('rgb8', 3, np.uint8), ('bgra8', 4, np.uint8),
    ('mono16', 1, np.uint16)])
def test_pixels_are_interpolated_in_their_encoding(encoding, channels, dtype):
    values = smooth(channels, dtype)
    frame = turned(raw(values, encoding, big=dtype is np.uint16))
    found = frame.image()
    assert found.encoding == encoding
    assert found.values.dtype == dtype
    sources = np.concatenate([band for _, band in frame.map.bands()])
    expected = bilinear(values, sources)
    # Places are rounded to 1/32 px by some versions of OpenCV.
    tolerance = 0.02 * np.iinfo(dtype).max
    difference = np.abs(found.values.reshape(480, 640, channels) - expected)
    assert difference.max() <= tolerance
    assert frame.map.shift > 15.0
    assert difference.mean() < 0.2 * np.abs(values - expected).mean()


@pytest.mark.parametrize(('suffix', 'channels', 'dtype', 'encoding'), [
    ('.png', 1, np.uint8, 'mono8'), ('.png', 3, np.uint8, 'bgr8'),
    ('.png', 1, np.uint16, 'mono16'), ('.jpg', 1, np.uint8, 'mono8'),
    ('.jpg', 3, np.uint8, 'bgr8')])
def test_compressed_images_are_turned_as_raw_ones(suffix, channels, dtype, encoding):
    values = smooth(channels, dtype)
    data = cv2.imencode(suffix, values)[1]
    frame = turned(CompressedImage(data, 'whatever'))
    decoded = cv2.imdecode(data, cv2.IMREAD_UNCHANGED).reshape(480, 640, channels)
    assert frame.frame.is_png == (suffix == '.png')
    assert frame.image().encoding == encoding
    np.testing.assert_array_equal(frame.image().values, turned(
        raw(decoded, encoding)).image().values)


def test_other_encodings_become_gray():
    values = smooth(1)
    for encoding in ('bayer_rggb8', 'nv12'):
        frame = turned(RawImage(values.ravel(), encoding, 640, 480, 640, False))
        assert frame.image().encoding == 'mono8'


def test_border_is_replicated_or_black_and_the_mask_tells_where():
    white = np.full((480, 640, 1), 255, dtype=np.uint8)
    replicated, black = (turned(raw(white, 'mono8'), told={'border': border})
                         for border in ('replicate', 'black'))
    assert (replicated.image().values == 255).all()
    pixels, mask = black.image().values, black.mask()
    assert mask.encoding == 'mono8'
    assert set(np.unique(mask.values)) == {0, 255}
    assert 0.02 < (mask.values == 0).mean() < 0.2
    # At the border itself black is mixed in.
    assert (pixels[mask.values == 255] == 255).all()
    assert (pixels[cv2.dilate(mask.values, np.ones((5, 5))) == 0] == 0).all()


STAMPS = {
    'first row': ({}, 14.96875), 'last row': ({'stamp_row': 'last'}, -14.96875),
    'middle row': ({'stamp_row': 'middle'}, 0.0),
    'read up': ({'readout_direction': 'up'}, -14.96875),
    'start of exposure': ({'stamp_exposure': 'start', 'exposure_time': 0.01}, 19.96875),
}


@pytest.mark.parametrize('name', STAMPS)
def test_stamps_are_those_of_the_middle_row(name):
    changed, expected_ms = STAMPS[name]
    image = raw(smooth(1), 'mono8')
    frame = turned(image, told={**changed, 'time_offset': 0.02})
    assert frame.stamp_ns == pytest.approx((100.0 + 20.0 + expected_ms) * MS, abs=2)
    frame = turned(image, told={**changed, 'time_offset': 0.02, 'stamp_clock': 'camera'})
    assert frame.stamp_ns == pytest.approx((100.0 + expected_ms) * MS, abs=2)


def test_without_a_turn_or_a_read_out_the_image_stays():
    values = smooth(1)
    for changed, rate in (({}, np.zeros(3)), ({'readout_time': 0.0}, RATE)):
        frame = turned(raw(values, 'mono8'), told=changed, rate=rate)
        assert frame.map.shift < 1e-6
        np.testing.assert_array_equal(frame.image().values, values[..., 0])


# -- against frames that are rendered with all rows at the middle instant --------------------


@pytest.mark.parametrize('direction', ['down', 'up'])
def test_a_swinging_camera_against_the_truth(direction):
    """Measured IMU, its bias and noise included; the aim of the project."""
    config = SimulationConfig(seed=9301, duration=0.5, readout_direction=direction)
    errors = map_errors('swing', config, swinging(3.0, 0.5))
    assert errors.rate > 2.5
    assert errors.left <= 0.05
    assert errors.left_p90 <= 0.15


def test_on_a_walk_the_translation_is_left_and_nothing_else():
    errors = map_errors('walk', SimulationConfig(seed=9302, duration=0.5, plan='walk:0.5'))
    assert errors.left > 0.1
    assert errors.map_p90 <= 0.1


def test_images_are_those_of_a_camera_that_reads_all_rows_at_once():
    config = SimulationConfig(seed=9303, duration=0.4, pixel_noise=0.0)
    simulation = simulate(config, trajectory=swinging(3.0, 0.4))
    still, ratios = middle_renderer(simulation), []
    for index, frame in turned_frames(simulation, told(simulation), images=True):
        truth = still.render(middle_seconds(simulation, index))
        seen = frame.mask().values > 0
        before = np.abs(simulation.image(index) - truth)[seen].mean()
        ratios.append(np.abs(frame.image().values - truth)[seen].mean() / before)
    # What remains is the smoothing of the interpolation.
    assert np.median(ratios) < 0.25


def test_a_tracked_time_offset_is_applied():
    """The pairs show it, as to relpose_node, and the stamps move by it."""
    config = SimulationConfig(seed=9304, duration=5.0, plan='walk:5.0', time_offset=0.008)
    simulation = simulate(config)
    parameters = told(simulation).updated({'time_offset': 0.0, 'track_time_offset': True})
    *_, (index, last) = turned_frames(simulation, parameters, images=True)
    assert last.applied_offset_ns == pytest.approx(8 * MS, abs=1.5 * MS)
    middle = simulation.reference_ns(index) + round(239.5 / 480 * 30 * MS)
    assert last.stamp_ns == pytest.approx(middle, abs=1.5 * MS)


def test_the_command_needs_no_ros():
    ended = subprocess.run(
        [sys.executable, '-c', ('import sys, rs_relpose_ros.cli.unroll; '
                                'print("rclpy" in sys.modules, "rosbags" in sys.modules)')],
        capture_output=True, text=True, timeout=100, check=True)
    assert ended.stdout.split() == ['False', 'True']


# -- bags ------------------------------------------------------------------------------------


@pytest.fixture(scope='module')
def bag(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp('bag')
    simulation = simulate(SimulationConfig(seed=9305, duration=1.0, width=320, height=240,
                                           fx=225.0, time_offset=0.004))
    write_bag(simulation, folder / 'walk')
    write_parameters(simulation, folder / 'walk.yaml')
    return folder / 'walk', folder / 'walk.yaml'


def messages_of(path: Path) -> list[RawMessage]:
    with open_bag(path) as opened:
        return list(opened.raw_messages(opened.topics))


def unroll(bag: Path, parameters: Path, out: Path, *options: str) -> int:
    return command_line(['unroll', str(bag), str(out), '--params', str(parameters), *options])


def test_everything_else_is_copied_bit_by_bit(bag, tmp_path, capsys):
    path, parameters = bag
    out = tmp_path / 'out'
    assert unroll(path, parameters, out) == 0
    assert '30 of 30 images turned' in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == [out]
    before, after = messages_of(path), messages_of(out)
    times = [message.bag_time_ns for message in after]
    assert times == sorted(times)
    own = ('/camera/image_raw/compressed', '/camera/camera_info')

    def others(messages):
        return [(m.topic, m.msgtype, m.bag_time_ns, bytes(m.data)) for m in messages
                if m.topic not in own]

    assert others(after) == others(before)
    assert len(others(after)) > 200
    for topic in own:
        assert [m.bag_time_ns for m in after if m.topic == topic] == [
            m.bag_time_ns for m in before if m.topic == topic]
    with open_bag(path) as opened, open_bag(out) as copied:
        assert {topic: opened.origin(topic) for topic in opened.topics} == {
            topic: copied.origin(topic) for topic in copied.topics}


def test_images_and_infos_have_the_stamp_of_the_middle_row(bag, tmp_path):
    path, parameters = bag
    assert unroll(path, parameters, tmp_path / 'out') == 0
    found = {}
    for name, folder in (('before', path), ('after', tmp_path / 'out')):
        with open_bag(folder) as opened:
            topics = opened.find_topics()
            images = [m.message for m in opened.messages([topics.image])]
            infos = [m.message for m in opened.messages([topics.camera_info])]
            found[name] = images, infos
    stamps = [stamp_ns(image.header) for image in found['before'][0]]
    delay = round(4 * MS + 119.5 / 240 * 30 * MS)
    for k in range(2):
        assert [stamp_ns(m.header) for m in found['after'][k]] == pytest.approx(
            [stamp + delay for stamp in stamps], abs=1)
    intrinsics = [intrinsics_from_info(infos[0]) for _, infos in found.values()]
    assert intrinsics[0] == intrinsics[1]
    assert found['after'][0][0].format.startswith('mono8; jpeg')
    before, after = (image_from_message(images[20]).image.decoded().astype(int)
                     for images, _ in found.values())
    assert 1.0 < np.abs(after - before).mean() < 40.0


def rewritten(path: Path, out: Path, change: Any, extra: Any = None) -> Path:
    """A copy of a bag; `change` gets each raw message, and may leave it out by None."""
    with open_bag(path) as opened, Writer2(out, version=9,
                                           storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {topic.name: writer.add_connection(
            topic.name, topic.msgtype, typestore=build.TYPESTORE) for topic in opened.topics}
        for raw_message in opened.raw_messages(opened.topics):
            kept = change(raw_message)
            if kept is not None:
                writer.write(connections[kept.topic], kept.bag_time_ns, kept.data)
        if extra is not None:
            extra(writer)
    return out


def test_images_without_gyro_are_left_out(bag, tmp_path, capsys):
    path, parameters = bag
    first = messages_of(path)[0].bag_time_ns
    cut = rewritten(path, tmp_path / 'cut', lambda m: None if m.topic == '/imu/data_raw'
                    and 500 * MS < m.bag_time_ns - first < 600 * MS else m)
    assert unroll(cut, parameters, tmp_path / 'out') == 0
    text = capsys.readouterr().out
    assert 'left out' in text
    images = [m for m in messages_of(tmp_path / 'out') if m.topic.endswith('compressed')]
    infos = [m for m in messages_of(tmp_path / 'out') if m.topic.endswith('camera_info')]
    assert 23 <= len(images) == len(infos) <= 28
    assert f'{len(images)} of 30 images turned, {30 - len(images)} left out' in text


def test_told_intrinsics_become_a_camera_info(bag, tmp_path):
    """Of a bag without one."""
    path, parameters = bag
    with open_bag(path) as opened:
        [first, *_] = opened.messages([opened.find_topics().camera_info])
    bare = rewritten(path, tmp_path / 'bare',
                     lambda m: None if m.topic == '/camera/camera_info' else m)
    matrix, distortion = ([float(v) for v in values] for values in (
        first.message.k, first.message.d))
    assert unroll(bare, parameters, tmp_path / 'out', '--set', f'camera_matrix={matrix}',
                  '--set', f'distortion_coefficients={distortion}') == 0
    with open_bag(tmp_path / 'out') as opened:
        topics = opened.find_topics()
        infos = [m.message for m in opened.messages([topics.camera_info])]
        images = [m.message for m in opened.messages([topics.image])]
    assert topics.camera_info.name == '/camera/camera_info'
    assert [stamp_ns(m.header) for m in infos] == [stamp_ns(m.header) for m in images]
    assert len(infos) == 30
    assert intrinsics_from_info(infos[0]) == intrinsics_from_info(first.message)


def test_unknown_types_are_copied_and_other_images_of_the_same_stamps_told(bag, tmp_path, capsys,
                                                                           caplog):
    path, parameters = bag
    depth = [build.gray_image(build.rosbags_types, np.zeros((4, 4), np.uint8), stamp_ns(m.header))
             for m in decoded_images(path)]
    payload = b'\x00\x01\x00\x00' + bytes(range(20))

    def add(writer):
        own = writer.add_connection('/own', 'own_msgs/msg/Thing', msgdef='uint8[20] data',
                                    rihs01='RIHS01_' + 'ab' * 32)
        writer.write(own, messages_of(path)[-1].bag_time_ns + 1, payload)
        other = writer.add_connection('/depth', 'sensor_msgs/msg/Image',
                                      typestore=build.TYPESTORE)
        for k, message in enumerate(depth):
            writer.write(other, messages_of(path)[-1].bag_time_ns + k,
                         build.TYPESTORE.serialize_cdr(message, 'sensor_msgs/msg/Image'))

    both = rewritten(path, tmp_path / 'both', lambda m: m, add)
    options = ('--image-topic', '/camera/image_raw/compressed')
    assert unroll(both, parameters, tmp_path / 'out', *options) == 0
    assert '/depth had the stamps of the turned images and keep them' in caplog.text
    [found] = [m for m in messages_of(tmp_path / 'out') if m.topic == '/own']
    assert (found.msgtype, bytes(found.data)) == ('own_msgs/msg/Thing', payload)
    caplog.clear()
    assert unroll(both, parameters, tmp_path / 'out2', *options, '--set',
                  'stamp_clock=camera') == 0
    assert '/depth' not in caplog.text


def decoded_images(path: Path) -> list[Any]:
    with open_bag(path) as opened:
        return [m.message for m in opened.messages([opened.find_topics().image])]


def test_ros1_bags_become_bags_of_ros2(bag, tmp_path, caplog):
    path, parameters = bag
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg('uint8 data', 'own_msgs/msg/Thing'))
    old = tmp_path / 'old.bag'
    with Writer1(old) as writer, open_bag(path) as opened:
        connections = {topic.name: writer.add_connection(topic.name, topic.msgtype,
                                                         typestore=store)
                       for topic in opened.topics}
        latched = writer.add_connection('/own', 'own_msgs/msg/Thing', typestore=store)
        for m in opened.raw_messages(opened.topics):
            data = build.TYPESTORE.cdr_to_ros1(m.data, m.msgtype)
            writer.write(connections[m.topic], m.bag_time_ns, bytes(data))
        writer.write(latched, m.bag_time_ns, b'\x01')
    assert unroll(old, parameters, tmp_path / 'out') == 0
    assert '/own (own_msgs/msg/Thing) is left out: ROS 2 has no such message type' in caplog.text
    assert unroll(path, parameters, tmp_path / 'same') == 0
    # Of the same instant, messages come in another order.
    found, expected = (sorted((m.bag_time_ns, m.topic, m.msgtype, bytes(m.data))
                              for m in messages_of(tmp_path / name)) for name in ('out', 'same'))
    assert found == expected


def test_nothing_is_left_behind_by_a_run_that_fails(bag, tmp_path, monkeypatch, capsys):
    path, parameters = bag
    taken = tmp_path / 'taken'
    taken.mkdir()
    assert unroll(path, parameters, taken) == 2
    assert 'exists already' in capsys.readouterr().err

    def interrupted(*_):
        raise KeyboardInterrupt
    monkeypatch.setattr('rs_relpose_ros.bags.writer.BagWriter.write', interrupted)
    assert unroll(path, parameters, tmp_path / 'out') == 130
    assert list(tmp_path.iterdir()) == [taken]


def test_no_image_is_no_bag(bag, tmp_path, capsys):
    path, parameters = bag
    # No gyro at these instants.
    assert unroll(path, parameters, tmp_path / 'out', '--set', 'time_offset=9.0') == 1
    assert '0 of 30 images turned, 30 left out; nothing was written' in capsys.readouterr().out
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(('options', 'sentence'), [
    (['--set', 'border=white'], 'border must be one of replicate, black'),
    (['--set', 'stamp_clock=ros'], 'stamp_clock must be one of imu, camera'),
    (['--image-topic', '/nothing'], 'has no topic /nothing'),
])
def test_bad_input_is_one_line(bag, tmp_path, capsys, options, sentence):
    assert unroll(*bag, tmp_path / 'out', *options) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert said.count('\n') == 1


def test_parameters_are_asked_for(bag, tmp_path, capsys):
    assert command_line(['unroll', str(bag[0]), str(tmp_path / 'out')]) == 2
    assert f'--params {bag[1]}, which lies beside the bag' in capsys.readouterr().err
