"""`rs_relpose check`: the verdicts on good bags, and on bags broken in one way each."""

from __future__ import annotations

import json
import math
import re

import cv2
import numpy as np
import pytest
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from test_bag_reader import JAZZY, STAMP_NS, write_ros1

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.bags.topics import TopicOptions
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.check.check import check_bag, choose_topics
from rs_relpose_ros.check.findings import CheckReport, Finding, Verdict
from rs_relpose_ros.check.streams import Stamps, Thinned
from rs_relpose_ros.cli.main import main
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.health.judge import FIGURES

START = 1_700_000_000_000_000_000
MS = 1_000_000
CAMERA = RollingShutterCamera(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5,
                              readout_time=0.02, distortion=(-0.1, 0.0, 0.0, 0.0, 0.0))
GIVEN = {'readout_time': 0.02, 'quat_cam_imu_xyzw': (0.0, 0.0, 0.0, 1.0)}
PIXELS = cv2.resize(np.random.default_rng(0).integers(0, 256, (30, 40), dtype=np.uint8),
                    (160, 120))


def checked(path, parameters=None, **topics):
    """Verdicts and findings by name."""
    with open_bag(path) as bag:
        report = check_bag(bag, choose_topics(bag, TopicOptions(**topics)),
                           parameters or Parameters.from_mapping(GIVEN))
    return {finding.name: finding for finding in report.findings}, report


class Small:
    """A bag of tiny images at 10 Hz and an IMU at 200 Hz; subclasses break one thing."""

    seconds = 4.0
    image_topic, info_topic, imu_topic = '/camera/image_raw', '/camera/camera_info', '/imu'
    pixels = PIXELS
    rng = np.random.default_rng(1)

    def image_stamps(self):
        return START + (100 * MS * np.arange(10 * self.seconds)).astype(np.int64)

    def imu_stamps(self):
        return START + (5 * MS * np.arange(-20, 200 * self.seconds + 20)).astype(np.int64)

    def recorded(self, stamp_ns, index):
        return stamp_ns

    def rate(self, t):
        return 0.002 * np.sin([2.0 * t, 3.0 * t, 4.0 * t]) + 0.002 * self.rng.normal(size=3)

    def force(self, t):
        return np.array([0.0, -9.81, 0.0]) + 0.5 * np.cos([2.0 * t, 3.0 * t, 5.0 * t])

    def imu(self, bag, stamp_ns):
        t = (stamp_ns - START) * 1e-9
        return bag.imu(stamp_ns, 'imu', self.rate(t), self.force(t))

    def info(self, bag, stamp_ns):
        return bag.camera_info(stamp_ns, 'camera', CAMERA)

    def image(self, bag, stamp_ns):
        # No camera sends the same image twice.
        noise = self.rng.integers(0, 4, self.pixels.shape, dtype=np.uint8)
        return 'sensor_msgs/msg/Image', bag.image(stamp_ns, 'camera', self.pixels // 2 + noise)

    def write(self, path):
        with BagWriter(path) as bag:
            for k, stamp in enumerate(list(map(int, self.imu_stamps()))):
                self._write(bag, self.imu_topic, 'sensor_msgs/msg/Imu', self.imu(bag, stamp),
                            self.recorded(stamp, k))
            for stamp in map(int, self.image_stamps()):
                self._write(bag, self.info_topic, 'sensor_msgs/msg/CameraInfo',
                            self.info(bag, stamp), stamp)
                self._write(bag, self.image_topic, *self.image(bag, stamp), stamp)
        return path

    def _write(self, bag, topic, msgtype, message, recorded_ns):
        if topic:
            bag.write(topic, msgtype, message, recorded_ns + 2 * MS)


def broken(**changes):
    return type('Broken', (Small,), changes)()


def test_a_good_bag_has_no_warning(tmp_path):
    findings, report = checked(Small().write(tmp_path / 'bag'))
    # The camera does not move: but for the bias nothing is known, and nothing of that is ok.
    assert {f.name for f in report.findings if f.verdict is not Verdict.OK} == {
        'pairs', 'gyro at rest', *(figure.name for figure in FIGURES)} - {'gyro_bias'}
    assert {f.verdict for f in report.findings} == {Verdict.OK, Verdict.UNKNOWN}
    assert findings['image rate'].figures['rate_hz'] == pytest.approx(10.0)
    assert findings['imu rate'].figures['rate_hz'] == pytest.approx(200.0)
    assert findings['gravity'].figures['mean_length_m_s2'] == pytest.approx(9.81, abs=0.2)
    # 0.02 s, 150 px and the median rate.
    assert findings['rolling shutter'].figures['median_px'] == pytest.approx(
        0.02 * 150.0 * findings['gyro'].figures['median_rad_s'], rel=0.1)
    assert 'global-shutter method would do' in findings['rolling shutter'].text


def gapped(self):
    stamps = Small.imu_stamps(self)
    return stamps[(stamps < START + 1000 * MS) | (stamps > START + 1200 * MS)]


def without_images(self):
    stamps = Small.image_stamps(self)
    return np.delete(stamps, [5, 6, 7, 15, 16, 22])


def swapped(self):
    stamps = Small.imu_stamps(self)
    stamps[300], stamps[301] = stamps[301], stamps[300]
    return stamps


def jumping(self):
    stamps = Small.imu_stamps(self)
    stamps[400:] -= 1500 * MS
    return stamps


def steadily(self, stamp, index):
    return START + 5 * MS * (index - 20)


def jittery(self):
    stamps = Small.image_stamps(self)
    return stamps + np.random.default_rng(2).integers(0, 60 * MS, len(stamps))


def at_rest(self, t):
    return np.array([0.02, -0.03, 0.01]) + 0.002 * self.rng.normal(size=3)


def h264(self, bag, stamp_ns):
    return 'sensor_msgs/msg/CompressedImage', bag.compressed_image(
        stamp_ns, 'camera', b'\x00\x00\x00\x01\x67' * 20, 'h264')


def strange(self, bag, stamp_ns):
    message = bag.image(stamp_ns, 'camera', PIXELS)
    message.encoding = '32FC1'
    return 'sensor_msgs/msg/Image', message


def jpeg(self, bag, stamp_ns):
    data = cv2.imencode('.jpg', PIXELS)[1].tobytes()
    return 'sensor_msgs/msg/CompressedImage', bag.compressed_image(stamp_ns, 'camera', data)


def uncalibrated(self, bag, stamp_ns):
    message = bag.camera_info(stamp_ns, 'camera', CAMERA)
    message.k[:] = 0.0
    return message


def of_another_size(self, bag, stamp_ns):
    return bag.camera_info(stamp_ns, 'camera', RollingShutterCamera(
        width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5, readout_time=0.02))


def without_gyro(self, bag, stamp_ns):
    return bag.imu(stamp_ns, 'imu', None, (0.0, -9.81, 0.0))


def without_force(self, bag, stamp_ns):
    return bag.imu(stamp_ns, 'imu', self.rate((stamp_ns - START) * 1e-9), None)


def frozen(self, bag, stamp_ns):
    return 'sensor_msgs/msg/Image', bag.image(stamp_ns, 'camera', self.pixels)


W, F = Verdict.WARNING, Verdict.FAILURE
BROKEN = {
    'no image topic': ({'image_topic': ''}, 'topics', F, 'record images'),
    'no imu topic': ({'imu_topic': ''}, 'topics', F, 'record images'),
    'no camera info topic': ({'info_topic': ''}, 'topics', F, 'CameraInfo'),
    'rectified': ({'image_topic': '/camera/image_rect'}, 'images', F, 'raw'),
    'unknown encoding': ({'image': strange}, 'images', F, 'known encoding'),
    'video': ({'image': h264, 'image_topic': '/camera/image_raw/h264'}, 'images', F, 'JPEG'),
    'compressed': ({'image': jpeg, 'image_topic': '/camera/image_raw/compressed'}, 'transport', W,
                   'image_transport: compressed'),
    'uncalibrated': ({'info': uncalibrated}, 'calibration', F, 'calibrate'),
    'calibration of another size': ({'info': of_another_size}, 'calibration', F, 'resolution'),
    'lost images': ({'image_stamps': without_images}, 'image rate', W, 'fastdds.xml'),
    'one image': ({'image_stamps': lambda self: [START]}, 'image rate', F, 'record'),
    'slow images': ({'image_stamps': lambda self: Small.image_stamps(self)[::4]}, 'image rate',
                    W, '8 Hz'),
    'stamps of arrival': ({'image_stamps': jittery}, 'image stamps', W, 'hardware'),
    'equal stamps': ({'image_stamps': lambda self: np.repeat(START, 40)}, 'image stamps', F,
                     'driver'),
    'gaps': ({'imu_stamps': gapped}, 'imu rate', W, 'queue'),
    'slow imu': ({'imu_stamps': lambda self: Small.imu_stamps(self)[::4]}, 'imu rate', W, '200'),
    'very slow imu': ({'imu_stamps': lambda self: Small.imu_stamps(self)[::20]}, 'imu rate', F,
                      '100 Hz'),
    'order': ({'imu_stamps': swapped, 'recorded': steadily}, 'imu stamps', W, 'publishers'),
    'repeated': ({'imu_stamps': lambda self: np.repeat(Small.imu_stamps(self), 2)}, 'imu stamps',
                 F, 'own instant'),
    'clock set back': ({'imu_stamps': jumping, 'recorded': steadily}, 'imu stamps', W, 'set back'),
    'other clock': ({'imu_stamps': lambda self: Small.imu_stamps(self) - START + 7 * MS,
                     'recorded': lambda self, stamp, k: stamp + START},
                    'clocks', F, 'one clock'),
    'imu ends early': ({'imu_stamps': lambda self: Small.imu_stamps(self)[:400]}, 'clocks', W,
                       'stop it last'),
    'no gyro': ({'imu': without_gyro}, 'gyro', F, '--imu-topic'),
    'hanging gyro': ({'rate': lambda self, t: [0.1, 0.0, 0.0]}, 'gyro', F, 'hangs'),
    'degrees per second': ({'rate': lambda self, t: 5000.0 * Small.rate(self, t)}, 'gyro', F,
                           'rad/s'),
    'bias': ({'rate': at_rest, 'force': lambda self, t: [0.0, -9.81, 0.0]}, 'gyro at rest', W,
             'gyro_bias: [0.0'),
    'no accelerometer': ({'imu': without_force}, 'gravity', W, '--accel-topic'),
    'in g': ({'force': lambda self, t: [0.0, -1.0, 0.01]}, 'gravity', F, 'm/s^2'),
    'gravity taken out': ({'force': lambda self, t: [0.3, 0.2, 0.01]}, 'gravity', F, 'REP-145'),
    'accelerometer off': ({'force': lambda self, t: [0.0, -11.5, 0.0]}, 'gravity', W,
                          'calibrate'),
    'big images': ({'pixels': np.zeros((800, 800), np.uint8), 'seconds': 0.5}, 'live transport', W,
                   'fastdds.xml'),
    'frozen camera': ({'image': frozen}, 'pairs', F, 'repeats the one before'),
    'no texture': ({'pixels': np.full((120, 160), 90, np.uint8)}, 'texture', F, 'textured'),
}


@pytest.mark.parametrize('case', BROKEN)
def test_what_is_broken_is_said_with_its_remedy(case, tmp_path):
    changes, name, verdict, remedy = BROKEN[case]
    findings, report = checked(broken(**changes).write(tmp_path / 'bag'))
    found = findings[name]
    assert found.verdict is verdict, found
    assert remedy in found.remedy + found.text, found
    assert found.remedy, found
    assert report.failed == any(f.verdict is Verdict.FAILURE for f in report.findings)
    json.dumps(report.to_mapping(), allow_nan=False)
    assert len(report.lines(80)) > len(findings)
    assert max(map(len, report.lines(100)[:-1])) <= 100     # the last one has the path


@pytest.mark.parametrize('changes', [{'info': uncalibrated}, {'info_topic': ''}])
def test_intrinsics_by_parameters(changes, tmp_path):
    """As good as those of a CameraInfo, which comes first where it has some."""
    told = Parameters.from_mapping(GIVEN | {
        'camera_matrix': (151.0, 0.0, 79.5, 0.0, 151.0, 59.5, 0.0, 0.0, 1.0),
        'distortion_coefficients': (-0.1, 0.0, 0.0, 0.0)})
    findings, report = checked(broken(**changes).write(tmp_path / 'bag'), told)
    assert not report.failed
    assert findings['calibration'].text == '160x120, f 151.0 151.0 px, plumb_bob by camera_matrix'
    assert findings['calibration'].figures['fx'] == 151.0
    findings, _ = checked(Small().write(tmp_path / 'calibrated'), told)
    assert findings['calibration'].text == '160x120, f 150.0 150.0 px, plumb_bob'


def test_parameters_that_are_missing_are_a_warning(tmp_path):
    findings, _ = checked(Small().write(tmp_path / 'bag'), Parameters())
    assert findings['parameters'].verdict is Verdict.WARNING
    assert 'readout_time and quat_cam_imu_xyzw' in findings['parameters'].text
    assert 'assumed' in findings['rolling shutter'].text
    # This recording does not tell them, either.
    assert [findings[name].verdict for name in ('axes', 'readout_time', 'rolling shutter')] == [
        Verdict.UNKNOWN] * 3


# -- images against the gyro -----------------------------------------------------------------


def unchanged(message):
    """A message as it is."""


def rewritten(source, path, change, seconds=4.0):
    """The first seconds of a bag with its messages changed in place."""
    with open_bag(source) as bag, BagWriter(path) as out:
        topics = bag.find_topics()
        first_ns = None
        for item in bag.messages([topics.image, topics.camera_info, topics.imu]):
            first_ns = first_ns or item.bag_time_ns
            if item.bag_time_ns > first_ns + seconds * 1e9:
                break
            change(item.message)
            out.write(item.topic, item.message.__msgtype__, item.message, item.bag_time_ns)
    return path


@pytest.fixture(scope='module')
def parameters(bundled_bag):
    return read_parameters(bundled_bag.with_name('hand_held.yaml'))


def test_the_bundled_bag_is_good(bundled_bag, parameters):
    """Against its parameter file, which is the truth."""
    findings, report = checked(bundled_bag, parameters)
    assert {f.verdict for f in report.findings} <= {Verdict.OK, Verdict.UNKNOWN}
    for figure in FIGURES:
        figures = findings[figure.name].figures
        assert (figures['figure'], figures['observable']) == (figure.name, True)
        assert abs(figures['seen'] - figures['told']) < 4.0 * figures['sigma']
    assert findings['time_offset'].figures['sigma'] < 2e-3
    assert findings['parameters'].figures['nearest'] == (
        'cam x = -imu y, cam y = -imu z, cam z = +imu x')
    assert findings['pairs'].figures['poses'] > 20
    assert 'global-shutter method loses' in findings['rolling shutter'].text


WRONG = {
    'read-out doubled': ({'readout_time': 0.06}, 'readout_time', 0.03, 0.006),
    'read-out 8 ms too long': ({'readout_time': 0.038}, 'readout_time', 0.03, 0.003),
    'read-out zero': ({'readout_time': 0.0}, 'readout_time', 0.03, 0.006),
    'read-out upwards': ({'readout_direction': 'up'}, 'readout_direction', -0.03, 0.006),
    'clock': ({'time_offset': 0.02}, 'time_offset', 0.0, 0.003),
    'axes': ({'quat_cam_imu_xyzw': (0.0, 0.0, 0.0, 1.0)}, 'axes', 120.0, 5.0),
}


@pytest.mark.parametrize('case', WRONG)
def test_parameters_that_contradict_the_recording(case, bundled_bag, parameters):
    changes, name, truth, tolerance = WRONG[case]
    # Figures that the node would follow are judged as they were told.
    tracking = {'track_time_offset': True, 'track_readout_time': True}
    findings, report = checked(bundled_bag, parameters.updated(tracking | changes))
    assert findings[name].verdict is F, findings[name]
    assert report.failed
    assert findings[name].figures['seen'] == pytest.approx(truth, abs=tolerance)
    assert [f.name for f in report.findings if f.verdict is F] == [name]
    if 'readout' in name:
        assert 'time_offset:' not in findings['time_offset'].text
        # The effect of the read-out is that of the one that is seen.
        assert findings['rolling shutter'].figures['readout_s'] == pytest.approx(0.03, abs=0.006)


def longer(message):
    if hasattr(message, 'k'):
        message.k = message.k * [1.1, 1.0, 1.0, 1.0, 1.1, 1.0, 1.0, 1.0, 1.0]


def without_distortion(message):
    if hasattr(message, 'd'):
        message.d = 0.0 * message.d


def too_small(message):
    if hasattr(message, 'angular_velocity'):
        rate = message.angular_velocity
        rate.x, rate.y, rate.z = (0.8 * value for value in (rate.x, rate.y, rate.z))


def of_another_body(message):
    """Rates that have nothing to do with the images."""
    if hasattr(message, 'angular_velocity'):
        t = (message.header.stamp.sec % 100) + 1e-9 * message.header.stamp.nanosec
        rate = message.angular_velocity
        rate.x, rate.y, rate.z = map(float, np.sin([3.0 * t, 4.0 * t + 1.0, 5.0 * t + 2.0]))


@pytest.mark.parametrize('change, name, truth, tolerance', [
    (longer, 'focal_length', 450.0, 10.0), (without_distortion, 'distortion', -0.1, 0.03),
    (too_small, 'gyro_scale', 1.25, 0.03)])
def test_messages_that_contradict_each_other(change, name, truth, tolerance, bundled_bag,
                                             parameters, tmp_path):
    path = rewritten(bundled_bag, tmp_path / 'bag', change)
    findings, _ = checked(path, parameters)
    assert findings[name].verdict in (W, F), findings[name]
    # Of the distortion the first coefficient is seen, with the others at zero.
    assert findings[name].figures['seen'] == pytest.approx(truth, abs=tolerance)
    assert Verdict.OK not in {findings[figure.name].verdict for figure in FIGURES}


def left_handed(message):
    if hasattr(message, 'angular_velocity'):
        message.angular_velocity.y *= -1.0


def test_a_sign_of_the_gyro_that_no_rotation_sets_right(bundled_bag, parameters, tmp_path):
    findings, report = checked(rewritten(bundled_bag, tmp_path / 'bag', left_handed, 6.0),
                               parameters)
    assert [f.name for f in report.findings if f.verdict is F] == ['axes']
    assert 'its y has the wrong sign' in findings['axes'].text
    assert 'set quat_cam_imu_xyzw' not in findings['axes'].text


def test_a_gyro_of_another_body(bundled_bag, parameters, tmp_path):
    """Whatever is blamed: the recording fails, and figures that explain nothing are not ok."""
    findings, report = checked(rewritten(bundled_bag, tmp_path / 'bag', of_another_body),
                               parameters)
    assert report.failed
    assert not any(findings[name].verdict is Verdict.OK
                   for name in ('axes', 'time_offset', 'gyro_scale'))


def test_what_is_not_told_is_looked_for(bundled_bag, tmp_path):
    """And the rest is judged with it; never ok without having been told."""
    bag = rewritten(bundled_bag, tmp_path / 'bag', unchanged, 3.0)
    given = Parameters.from_mapping({'gyro_bias': (0.010885, -0.007021, 0.005061)})
    findings, report = checked(bag, given)
    assert not report.failed
    assert findings['axes'].verdict is findings['readout_time'].verdict is Verdict.UNKNOWN
    assert 'cam x = -imu y, cam y = -imu z, cam z = +imu x' in findings['axes'].text
    assert 'gravity is at the bottom' in findings['axes'].text
    assert findings['readout_time'].figures['told'] is None
    assert findings['readout_time'].figures['seen'] == pytest.approx(0.03, abs=2e-3)
    assert abs(findings['time_offset'].figures['seen']) < 3e-3
    assert findings['rolling shutter'].figures['readout_s'] == pytest.approx(0.03, abs=2e-3)


@pytest.fixture(scope='module')
def converted(recordings, tmp_path_factory):
    """Bags of the real recordings by name, converted once."""
    folder = tmp_path_factory.mktemp('recordings')

    def path(name):
        if not (folder / name).exists():
            assert main(['convert', name.removesuffix('_b'), str(recordings / name),
                         str(folder / name)]) == 0
        return folder / name

    return path


# Parameters of the converter, of the second RealSense recording its own offset; what may be warned
# of. Three gaps of up to 0.3 s; no accelerometer, and no bias known; little light.
LITTLE_LIGHT = {'time_offset': -0.064}
REAL = {
    'realsense_rgb_rs': ({}, {'image rate'}),
    'realsense_rgb_rs_b': (LITTLE_LIGHT, {'image rate'}),
    'xiaomi_cc9_rs': ({}, {'gravity', 'gyro_bias'}),
}


@pytest.mark.recordings
@pytest.mark.parametrize('name', REAL)
def test_recordings_of_real_cameras(converted, name):
    path, (changes, warned) = converted(name), REAL[name]
    findings, report = checked(path, read_parameters(f'{path}.yaml').updated(changes))
    assert not report.failed
    assert {f.name for f in report.findings if f.verdict is W} <= warned
    assert findings['axes'].verdict in (Verdict.OK, Verdict.UNKNOWN)
    if 'realsense' in name:
        # Automatic exposure: stamps of varying interval are no times of arrival.
        assert findings['image stamps'].verdict is Verdict.OK
    if name == 'realsense_rgb_rs_b':
        assert 'automatic exposure' in findings['image stamps'].text
        assert 'time_offset_per_interval' in findings['image stamps'].remedy


@pytest.mark.recordings
@pytest.mark.parametrize('changes, name, seen, tolerance', [
    ({'time_offset': -0.0305}, 'time_offset', -0.0635, 6e-3),
    ({'time_offset': -0.0965}, 'time_offset', -0.0635, 6e-3),
    ({'quat_cam_imu_xyzw': (0.0, 0.0, -math.sqrt(0.5), math.sqrt(0.5))}, 'axes', 90.0, 2.0)])
def test_gross_errors_in_a_recording_in_little_light(converted, changes, name, seen, tolerance):
    """Too far off for the pairs to tell: they are measured anew, and nothing else is blamed."""
    path = converted('realsense_rgb_rs_b')
    told = read_parameters(f'{path}.yaml').updated(LITTLE_LIGHT | changes)
    findings, report = checked(path, told)
    # The stamp of another row makes nearly the same offset.
    assert {f.name for f in report.findings if f.verdict is F} - {'stamp_row'} == {name}
    assert findings[name].figures['seen'] == pytest.approx(seen, abs=tolerance)
    if name == 'axes':
        # What is advised is within 2 deg of the file of the recording, the identity nearly.
        advised = re.search(r'quat_cam_imu_xyzw: \[(.*?)\]', findings[name].text)[1]
        assert abs(float(advised.split(',')[3])) > math.cos(math.radians(1.0))


# -- containers, options, output -------------------------------------------------------------


BEST_EFFORT = Qos(QosHistory.KEEP_LAST, 5, QosReliability.BEST_EFFORT, QosDurability.VOLATILE,
                  QosTime(0, 0), QosTime(0, 0), QosLiveliness.AUTOMATIC, QosTime(0, 0), False)


@pytest.mark.parametrize('kind', ['sqlite3', 'mcap', 'ros1'])
def test_every_container(kind, tmp_path):
    with open_bag(broken(seconds=1.0).write(tmp_path / 'source')) as source:
        topics, messages = source.topics, list(source.messages(source.topics))
    path = tmp_path / 'copy.bag'
    if kind == 'ros1':
        write_ros1(path, [(item.topic, item.message.__msgtype__, item.message,
                           item.bag_time_ns - STAMP_NS) for item in messages])
    else:
        with Writer(path, version=9, storage_plugin=StoragePlugin[kind.upper()]) as writer:
            connections = {topic.name: writer.add_connection(
                topic.name, topic.msgtype, typestore=JAZZY, offered_qos_profiles=[BEST_EFFORT])
                for topic in topics}
            for item in messages:
                writer.write(connections[item.topic], item.bag_time_ns,
                             JAZZY.serialize_cdr(item.message, item.message.__msgtype__))
    findings, _ = checked(path)
    assert findings['image rate'].figures['count'] == 10
    assert findings['imu rate'].figures['rate_hz'] == pytest.approx(200.0)
    expected = None if kind == 'ros1' else 'best effort'
    assert findings['live transport'].figures['reliability'] == expected
    assert findings['imu rate'].figures['reliability'] == expected


def test_command_line(tmp_path, capsys):
    good = Small().write(tmp_path / 'good')
    bad = broken(info=uncalibrated).write(tmp_path / 'bad')
    options = ['--set', 'readout_time=0.02', '--set', 'quat_cam_imu_xyzw=[0, 0, 0, 1]']
    assert main(['check', str(good), *options]) == 0
    shown = capsys.readouterr()
    assert shown.err == ''
    assert not re.search('^(warning|failure)', shown.out, re.MULTILINE)
    assert re.search(r'^ok +imu rate +200 Hz', shown.out, re.MULTILINE)
    assert main(['check', str(bad), *options, '--json']) == 1
    report = json.loads(capsys.readouterr().out)
    assert report['failed'] is True
    assert {f['name']: f['verdict'] for f in report['findings']}['calibration'] == 'failure'


@pytest.mark.parametrize('arguments, message', [
    (['nowhere'], 'there is no bag'), (['BAG', '--imu-topic', '/nothing'], '/nothing'),
    (['BAG', '--set', 'readout=1'], 'readout_time'), (['BAG', '--params', 'no.yaml'], 'no.yaml'),
    (['BAG', '--image-topic', '/imu'], 'must be'),
])
def test_bad_usage_is_one_line_and_exit_code_2(arguments, message, tmp_path, capsys):
    bag = str(broken(seconds=0.3).write(tmp_path / 'bag'))
    assert main(['check', *(bag if word == 'BAG' else word for word in arguments)]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count('\n') == 1


def test_a_damaged_bag_is_exit_code_2(tmp_path, capsys):
    path = broken(seconds=0.3).write(tmp_path / 'bag') / 'bag.mcap'
    path.write_bytes(path.read_bytes()[:3000])
    assert main(['check', str(path)]) == 2
    assert capsys.readouterr().err.count('\n') == 1


def test_several_topics_want_a_choice(tmp_path):
    bag_path = Small().write(tmp_path / 'bag')
    with open_bag(bag_path) as bag, BagWriter(tmp_path / 'two') as out:
        for item in bag.messages(bag.topics):
            kind = item.message.__msgtype__
            out.write(item.topic, kind, item.message, item.bag_time_ns)
            if kind.endswith('Imu'):
                out.write('/other_imu', kind, item.message, item.bag_time_ns)
    with pytest.raises(InputError, match='choose one with --imu-topic'):
        checked(tmp_path / 'two')
    assert checked(tmp_path / 'two', imu='/other_imu')[0]['topics'].figures['imu'] == '/other_imu'
    with pytest.raises(MissingInputError):
        checked(tmp_path / 'two', imu='/third_imu')


def test_memory_does_not_grow_with_the_stream():
    thinned, stamps = Thinned(), Stamps()
    for k in range(200_000):
        thinned.add(float(k))
        stamps.add(k * 5 * MS + (100 * MS if k > 100_000 else 0), k * 5 * MS)
    assert len(thinned.values) <= 2 * 8192
    # Still evenly over all of it.
    assert np.abs(np.median(thinned.values) - 100_000) < 200
    assert np.diff(thinned.values[:, 0]).max() < 2 * np.diff(thinned.values[:, 0]).min()
    assert stamps.interval == pytest.approx(0.005) and stamps.count == 200_000
    assert stamps.longer_than(0.05) == (1, pytest.approx(0.105))


def test_lines_hold_verdict_text_and_remedy():
    report = CheckReport('b', (Finding('short', Verdict.OK, 'fine'),
                          Finding('much longer', Verdict.FAILURE, 'x' * 10, 'do this')))
    assert report.lines() == ['ok       short        fine',
                              'failure  much longer  xxxxxxxxxx -> do this',
                              'b: 1 ok, 0 unknown, 0 warning, 1 failure']
