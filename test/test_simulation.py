"""The simulator, against equations that are written out here again."""

import argparse
import functools
from pathlib import Path
import re
import shlex

from conftest import run_command
import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation
import yaml

from rs_relpose_lab.cli import simulate as command
from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.bag import write_parameters
from rs_relpose_lab.simulation.motions import hand_held, Plan
from rs_relpose_lab.simulation.rows import observe, View
from rs_relpose_lab.simulation.scene import Scene, Surface
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError

TINY = {'width': 32, 'height': 24, 'fx': 25.0}
BAGS = Path(__file__).parent.parent / 'bags'
NOISE_FREE = {
    'pixel_noise': 0.0,
    'gyro_noise_density': 0.0,
    'accel_noise_density': 0.0,
    'gyro_bias': (0.0, 0.0, 0.0),
    'accel_bias': (0.0, 0.0, 0.0),
}


def on_wall(**changes):
    """A simulation of tiny images in front of the wall."""
    return simulate(SimulationConfig(**{**TINY, **changes}), scene=blob_wall()[0])


@functools.cache
def blob_wall():
    """A wall 7 m ahead with a grid of blobs, and the blobs' centres in the world."""
    texel = 0.02
    spacing = 0.8
    sigma = 0.055
    x, y = np.meshgrid((np.arange(1000) + 0.5) * texel, (np.arange(600) + 0.5) * texel)
    away = [(c + spacing / 2) % spacing - spacing / 2 for c in (x, y)]
    gray = 40.0 + 190.0 * np.exp(-(away[0] ** 2 + away[1] ** 2) / (2 * sigma**2))
    wall = Surface(
        np.array([7.0, 10.0, 7.6]),
        np.array([0.0, -1.0, 0.0]),
        np.array([0.0, 0.0, -1.0]),
        20.0,
        12.0,
        np.rint(gray).astype(np.uint8),
    )
    i, j = np.meshgrid(np.arange(1, 25), np.arange(1, 15))
    centres = np.stack(
        [np.full(i.size, 7.0), 10.0 - spacing * i.ravel(), 7.6 - spacing * j.ravel()], axis=1
    )
    return Scene.of(wall), centres


def pixels_by_rows(points, trajectory, time, config, sign=1.0):
    """Pixels of world points (N, 3), NaN outside: of each the row whose time projects it there."""
    k = np.array(
        [
            [config.fx, 0.0, (config.width - 1) / 2 + 0.01 * config.width],
            [0.0, config.fx, (config.height - 1) / 2 - 0.01 * config.height],
            [0.0, 0.0, 1.0],
        ]
    )
    origin = {'first': 0.0, 'middle': (config.height - 1) / 2, 'last': config.height - 1.0}
    direction = {'down': 1.0, 'up': -1.0}[config.readout_direction]

    def motion(world, times):
        positions, R = trajectory.poses(time + times)
        return np.einsum('nji,nj->ni', R, world - positions)

    def project(local):
        return cv2.projectPoints(local, np.zeros(3), np.zeros(3), k, np.array(config.distortion))[
            0
        ][:, 0]

    return observe(
        points,
        motion,
        View(
            project,
            None,
            config.width,
            config.height,
            sign * direction * config.readout_time / config.height,
            origin[config.stamp_row],
        ),
    )


def blob_centre(image, near, half=13):
    """Centroid of a bright blob around a pixel; the window follows it."""
    at = np.asarray(near)
    for _ in range(5):
        u, v = np.rint(at).astype(int)
        window = image[v - half : v + half + 1, u - half : u + half + 1]
        bright = np.maximum(window.astype(np.float64) - 60.0, 0.0)
        moments = cv2.moments(bright)
        at = np.array(
            [
                u - half + moments['m10'] / moments['m00'],
                v - half + moments['m01'] / moments['m00'],
            ]
        )
    return at


@pytest.mark.parametrize(
    ('direction', 'stamp_row'),
    [('down', 'first'), ('down', 'middle'), ('up', 'first'), ('up', 'last')],
)
def test_rendered_rows_are_those_of_their_times(direction, stamp_row):
    scene, centres = blob_wall()
    config = SimulationConfig(
        duration=1.0,
        plan='walk:2',
        speed=1.8,
        rotation_rate=1.3,
        seed=4,
        readout_time=0.03,
        readout_direction=direction,
        stamp_row=stamp_row,
        **NOISE_FREE,
    )
    simulation = simulate(config, scene=scene)
    errors = []
    wrong_sign = []
    for index in (3, 17):
        image = simulation.image(index)
        time = (simulation.reference_ns(index) - config.start_ns) * 1e-9
        expected, mirrored = (
            pixels_by_rows(centres, simulation.trajectory, time, config, sign)
            for sign in (1.0, -1.0)
        )
        whole = ((expected > 30) & (expected < [610, 450])).all(axis=1)
        found = [blob_centre(image, pixel) for pixel in expected[whole]]
        errors += [*np.linalg.norm(found - expected[whole], axis=1)]
        wrong_sign += [*np.linalg.norm(found - mirrored[whole], axis=1)]
    assert len(errors) > 60
    assert np.median(errors) < 0.05
    assert np.max(errors) < 0.2
    # The same measurement determines the readout's sign.
    assert np.nanmedian(wrong_sign) > 3.0


@pytest.mark.parametrize(('direction', 'stamp_row'), [('down', 'first'), ('up', 'middle')])
def test_exposed_row_is_the_mean_of_its_times(direction, stamp_row):
    """Against sharp rows at times of its exposure, whose middle is the row's own time."""
    changes = {
        'duration': 1.0,
        'plan': 'walk:2',
        'speed': 1.8,
        'rotation_rate': 1.3,
        'seed': 4,
        'readout_direction': direction,
        'stamp_row': stamp_row,
        'width': 160,
        'height': 120,
        'fx': 450.0,
        **NOISE_FREE,
    }
    sharp, exposed = (
        simulate(
            SimulationConfig(exposure_time=exposure, **changes), scene=blob_wall()[0]
        ).renderer
        for exposure in (0.0, 0.012)
    )
    count = 48
    mean = np.zeros((120, 160))
    for k in range(count):
        moved = sharp.render(0.5 - 0.006 + (k + 0.5) * 0.012 / count)
        for row in range(120):
            mean[row] += moved[row] / count
    blurred = exposed.render(0.5)
    assert np.abs(blurred - mean).max() < 2.0
    assert np.abs(sharp.render(0.5) - mean).max() > 30.0  # it moves
    assert np.abs(exposed.render(0.502) - mean).max() > 10.0  # by the exposure's middle


def walk(seed, seconds, rotation_rate):
    return hand_held(
        np.random.default_rng(seed),
        -0.2,
        seconds + 0.2,
        Plan.drawn(np.random.default_rng(1), seconds),
        speed=1.5,
        rotation_rate=rotation_rate,
    )


def test_trajectory_derivatives_are_exact():
    trajectory = walk(3, 6.0, rotation_rate=0.6)
    times = np.linspace(0.0, 6.0, 300)
    h = 1e-4
    here, before, after = (trajectory.states(times + d) for d in (0.0, -h, h))
    for name, of, tolerance in (
        ('velocity', 'position', 2e-6),
        ('acceleration', 'velocity', 1e-4),
        ('angular_acceleration', 'angular_velocity', 1e-3),
    ):
        np.testing.assert_allclose(
            getattr(here, name),
            (getattr(after, of) - getattr(before, of)) / (2 * h),
            atol=tolerance,
        )
    steps = np.swapaxes(before.R_world_cam, 1, 2) @ after.R_world_cam
    rate = Rotation.from_matrix(steps).as_rotvec() / (2 * h)
    np.testing.assert_allclose(here.angular_velocity, rate, atol=1e-5)
    positions, rotations = trajectory.poses(times)
    np.testing.assert_array_equal(positions, here.position)
    np.testing.assert_array_equal(rotations, here.R_world_cam)
    with pytest.raises(InputError, match='defined from'):
        trajectory.poses([100.0])


def test_imu_noise_and_bias_are_as_configured():
    exact, noisy = (on_wall(seed=1, duration=20.0, **changes) for changes in (NOISE_FREE, {}))
    config = noisy.config
    for name, bias, density in (
        ('angular_velocities', config.gyro_bias, config.gyro_noise_density),
        ('linear_accelerations', config.accel_bias, config.accel_noise_density),
    ):
        error = getattr(noisy.imu, name) - getattr(exact.imu, name)
        sigma = density * np.sqrt(200.0)
        np.testing.assert_allclose(error.std(axis=0), sigma, rtol=0.06)
        np.testing.assert_allclose(error.mean(axis=0), bias, atol=5 * sigma / np.sqrt(len(error)))
    calibration = noisy.calibrated_gyro_bias - config.gyro_bias
    assert 0.0 < np.abs(calibration).max() < 4 * config.gyro_bias_error


def test_clocks_and_coverage():
    simulation = on_wall(
        duration=0.2, time_offset=0.0123, stamp_row='last', seed=1, exposure_time=0.15
    )
    config = simulation.config
    for index in (0, 5):
        assert (
            simulation.stamp_ns(index) + 12_300_000
            == simulation.reference_ns(index)
            == config.start_ns + round(index / 30 * 1e9)
        )
    imu_ns = simulation.imu.stamps_ns
    assert set(np.diff(imu_ns)) == {5_000_000}
    # Exposures from the first row of the first frame to the last row of the last one, and more.
    assert imu_ns[0] < config.start_ns - 30_000_000 - 75_000_000 - 50_000_000
    assert imu_ns[-1] > simulation.reference_ns(5) + 75_000_000 + 50_000_000


@pytest.fixture(scope='module')
def bundled():
    """Arguments in bags/README.md and the simulation that they describe."""
    readme = (BAGS / 'README.md').read_text().replace('\\\n', ' ')
    line = re.search(r'^ +rs_relpose simulate (.*)$', readme, re.M)
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    args = parser.parse_args(shlex.split(line.group(1)))
    return args, simulate(command.configuration(args))


# -- bags ------------------------------------------------------------------------------------

SMALL = [
    '--duration',
    '0.2',
    '--width',
    '160',
    '--height',
    '120',
    '--fx',
    '110',
    '--readout-time',
    '0.02',
    '--seed',
    '7',
]


IMAGES = '/camera/image_raw/compressed'


def values_of(path):
    return yaml.safe_load(path.read_text())['/**']['ros__parameters']


def messages(path):
    """Messages of a bag by topic, each with its bag time."""
    found = {}
    with AnyReader([path]) as reader:
        for connection, time_ns, data in reader.messages():
            found.setdefault(connection.topic, []).append(
                (time_ns, reader.deserialize(data, connection.msgtype))
            )
    return found


def stamp_ns(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


@pytest.mark.parametrize(('raw', 'topic'), [([], IMAGES), (['--raw'], '/camera/image_raw')])
def test_command_writes_a_bag_and_its_parameters(raw, topic, tmp_path, capsys):
    run_command(
        'simulate',
        tmp_path / 'bag',
        *SMALL,
        '--time-offset',
        '0.004',
        '--exposure-time',
        '0.01',
        *raw,
    )
    captured = capsys.readouterr()
    assert '6 images' in captured.out
    assert captured.err == ''  # no progress bar unless on a terminal
    found = messages(tmp_path / 'bag')
    stamps = {name: [stamp_ns(m) for _, m in found[name]] for name in found}
    assert len(stamps[topic]) == 6 and stamps[topic] == stamps['/camera/camera_info']
    delays = {
        topic: ('camera_optical_frame', 25_000_000),
        '/camera/camera_info': ('camera_optical_frame', 25_000_000),
        '/imu/data_raw': ('imu_link', 2_000_000),
        '/ground_truth/pose': ('world', 2_000_000),
    }
    assert delays == {
        name: (series[0][1].header.frame_id, series[0][0] - stamps[name][0])
        for name, series in found.items()
    }
    assert set(np.diff(stamps['/imu/data_raw'])) == {5_000_000}
    simulation = simulate(
        SimulationConfig(
            duration=0.2,
            width=160,
            height=120,
            fx=110.0,
            readout_time=0.02,
            seed=7,
            time_offset=0.004,
            exposure_time=0.01,
        )
    )
    message = found[topic][2][1]
    image = (
        message.data.reshape(120, 160) if raw else cv2.imdecode(message.data, cv2.IMREAD_UNCHANGED)
    )
    assert np.abs(image.astype(float) - simulation.image(2)).mean() < (1e-9 if raw else 4.0)
    assert stamps[topic][2] == simulation.stamp_ns(2)
    assert not raw or message.step == 160
    pose = found['/ground_truth/pose'][30][1].pose
    state = simulation.states([stamps['/ground_truth/pose'][30]])
    np.testing.assert_allclose(
        (pose.position.x, pose.position.y, pose.position.z), state.position[0]
    )
    q = pose.orientation
    np.testing.assert_allclose(
        Rotation.from_quat((q.x, q.y, q.z, q.w)).as_matrix(), state.R_world_cam[0], atol=1e-12
    )
    parameters = Parameters.from_mapping(values_of(tmp_path / 'bag.yaml'))
    assert (parameters.sensor.readout_time, parameters.sensor.time_offset) == (0.02, 0.004)
    assert (parameters.sensor.exposure_time, parameters.sensor.stamp_exposure) == (0.01, 'middle')
    assert parameters.pair.image_transport == ('raw' if raw else 'compressed')
    np.testing.assert_allclose(
        parameters.sensor.R_cam_imu, simulation.config.R_cam_imu, atol=1e-12
    )
    np.testing.assert_allclose(
        parameters.imu.gyro_bias, simulation.calibrated_gyro_bias, atol=1e-6
    )


def test_command_refuses_what_exists_and_what_is_impossible(tmp_path, refused):
    (tmp_path / 'bag.yaml').write_text('mine')
    for words, name, *options in (
        ('bag.yaml exists already', 'bag'),
        ('exists already', '.'),
        ('fps must be', 'new', '--fps', '0'),
        ('jpeg_quality', 'new', '--jpeg-quality', '0'),
    ):
        refused(words, 'simulate', tmp_path / name, *options, *SMALL)
    assert (tmp_path / 'bag.yaml').read_text() == 'mine'
    assert not (tmp_path / 'new').exists()


def test_bundled_bag_is_that_of_its_command(bundled, tmp_path):
    args, simulation = bundled
    assert args.out_bag == Path('bags/hand_held')
    assert sum(file.stat().st_size for file in (BAGS / 'hand_held').iterdir()) < 10e6
    found = messages(BAGS / 'hand_held')
    assert {topic: len(series) for topic, series in found.items()} == {
        IMAGES: 180,
        '/camera/camera_info': 180,
        '/imu/data_raw': len(simulation.imu.stamps_ns),
        '/ground_truth/pose': len(simulation.imu.stamps_ns),
    }
    for index in (0, 100):
        _, message = found[IMAGES][index]
        assert stamp_ns(message) == simulation.stamp_ns(index)
        jpeg = cv2.imencode(
            '.jpg', simulation.image(index), [cv2.IMWRITE_JPEG_QUALITY, args.jpeg_quality]
        )[1]
        again, bundled_image = (
            cv2.imdecode(data, cv2.IMREAD_UNCHANGED).astype(float) for data in (jpeg, message.data)
        )
        # Other versions of NumPy and OpenCV may round differently, no more.
        assert np.abs(again - bundled_image).mean() < 0.5
    imu = [message for _, message in found['/imu/data_raw']]
    assert [stamp_ns(message) for message in imu] == simulation.imu.stamps_ns.tolist()
    positions = [m.pose.position for _, m in found['/ground_truth/pose']]
    for vectors, values in (
        ([m.angular_velocity for m in imu], simulation.imu.angular_velocities),
        (positions, simulation.states(simulation.imu.stamps_ns).position),
    ):
        np.testing.assert_allclose([(v.x, v.y, v.z) for v in vectors], values, atol=1e-9)
    write_parameters(simulation, tmp_path / 'made.yaml', raw=args.raw)
    assert values_of(tmp_path / 'made.yaml') == values_of(BAGS / 'hand_held.yaml')
