"""`rs_relpose check`: findings on good bags, and on bags broken in one way each."""

import itertools
import json
import re
from types import SimpleNamespace

from bag_kinds import copied, STAMP_NS, write_kind
from conftest import run_command
import cv2
import message_builders as build
import numpy as np
import pytest
from rosbags import interfaces as ros
from scipy.spatial.transform import Rotation

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.calibrate.result import Estimate
from rs_relpose_ros.calibration.findings import (
    Assessment,
    Code,
    Evidence,
    Finding,
    FindingState,
    QUANTITIES,
    Why,
)
from rs_relpose_ros.calibration.findings_text import text_of
from rs_relpose_ros.cli.main import main
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import Parameters, sensor_model
from rs_relpose_ros.geometry.camera import Intrinsics, RollingShutterCamera
from rs_relpose_ros.messages import outgoing
from rs_relpose_ros.offline import check_recording
from rs_relpose_ros.offline.check import check_bag, quantity_findings
from rs_relpose_ros.offline.check_recording import StampStatistics
from rs_relpose_ros.tracking.images import Pixels

START = 1_700_000_000_000_000_000
TYPES = build.rosbags_types
MS = 1_000_000
CAMERA = RollingShutterCamera(
    width=160,
    height=120,
    fx=150.0,
    fy=150.0,
    cx=79.5,
    cy=59.5,
    readout_time=0.02,
    distortion=(-0.1, 0.0, 0.0, 0.0, 0.0),
)
GIVEN = {'readout_time': 0.02, 'quat_cam_imu_xyzw': (0.0, 0.0, 0.0, 1.0)}
PIXELS = cv2.resize(
    np.random.default_rng(0).integers(0, 256, (30, 40), dtype=np.uint8), (160, 120)
)


def checked(path, parameters=None, **topics):
    """Findings by name, and the report."""
    with open_bag(path) as bag:
        report = check_bag(
            bag, bag.choose_topics(topics), parameters or Parameters.from_mapping(GIVEN)
        )
    return {finding.code: finding for finding in report.findings}, report


class Small:
    """A bag of tiny images at 10 Hz and an IMU at 200 Hz; subclasses break one thing."""

    seconds = 4.0
    image_topic = '/camera/image_raw'
    info_topic = '/camera/camera_info'
    imu_topic = '/imu'
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

    def imu(self, stamp_ns):
        t = (stamp_ns - START) * 1e-9
        return outgoing.imu_message(stamp_ns, 'imu', self.rate(t), self.force(t), TYPES)

    def info(self, stamp_ns):
        return outgoing.camera_info_message(stamp_ns, 'camera', CAMERA, None, TYPES)

    def image(self, stamp_ns):
        # No camera sends the same image twice.
        noise = self.rng.integers(0, 4, self.pixels.shape, dtype=np.uint8)
        return mono8(stamp_ns, self.pixels // 2 + noise)

    def messages(self):
        """Topic, type, message and bag time [ns]."""
        out = [
            (self.imu_topic, self.imu(stamp), self.recorded(stamp, k))
            for k, stamp in enumerate(map(int, self.imu_stamps()))
        ]
        for stamp in map(int, self.image_stamps()):
            out += [
                (self.info_topic, self.info(stamp), stamp),
                (self.image_topic, self.image(stamp), stamp),
            ]
        return [
            (topic, message.__msgtype__, message, at + 2 * MS)
            for topic, message, at in out
            if topic
        ]

    def write(self, path):
        with BagWriter(path) as bag:
            for message in self.messages():
                bag.write(*message)
        return path


def mono8(stamp_ns, pixels):
    return outgoing.image_message(stamp_ns, 'camera', Pixels(pixels, 'mono8'), TYPES)


def broken(**changes):
    return type('Broken', (Small,), changes)()


def test_a_good_bag_has_no_warning(tmp_path):
    findings, report = checked(Small().write(tmp_path / 'bag'))
    # The camera does not move: but for the bias nothing is known, and nothing of that is ok.
    assert {f.code for f in report.findings if f.state is not FindingState.OK} == {
        'pairs',
        'gyro at rest',
        *(quantity.code for quantity in QUANTITIES),
    } - {'gyro_bias'}
    assert {f.state for f in report.findings} == {FindingState.OK, FindingState.UNKNOWN}
    assert findings['image rate'].finding.evidence.measured['rate_hz'] == pytest.approx(10.0)
    assert findings['imu rate'].finding.evidence.measured['rate_hz'] == pytest.approx(200.0)
    assert findings['gravity'].finding.evidence.measured['mean_length_m_s2'] == pytest.approx(
        9.81, abs=0.2
    )
    # 0.02 s, 150 px and the median rate.
    assert findings['rolling shutter'].finding.evidence.measured['median_px'] == pytest.approx(
        0.02 * 150.0 * findings['gyro'].finding.evidence.measured['median_rad_s'], rel=0.1
    )


def imu_stamps(change, **more):
    return {'imu_stamps': lambda self: change(Small.imu_stamps(self)), **more}


def image_stamps(change):
    return {'image_stamps': lambda self: change(Small.image_stamps(self))}


def regularly(self, stamp, index):
    return START + 5 * MS * (index - 20)


def at_rest(self, t):
    return np.array([0.02, -0.03, 0.01]) + 0.002 * self.rng.normal(size=3)


def encoded(data, *more):
    return lambda self, stamp_ns: outgoing.encoded_image_message(
        stamp_ns, 'camera', data, TYPES, *more
    )


def strange(self, stamp_ns):
    message = mono8(stamp_ns, PIXELS)
    message.encoding = '32FC1'
    return message


def uncalibrated(self, stamp_ns):
    message = Small.info(self, stamp_ns)
    message.k[:] = 0.0
    return message


def of_another_size(self, stamp_ns):
    camera = RollingShutterCamera(
        width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5, readout_time=0.02
    )
    return outgoing.camera_info_message(stamp_ns, 'camera', camera, None, TYPES)


W = FindingState.SUSPECT
F = FindingState.WRONG
CLOSE = pytest.approx
# What is broken, the finding, its state, and what distinguishes it: a literal of the fix, or
# measured values.
BROKEN = {
    'no image topic': ({'image_topic': ''}, 'topics', F, {'image': None}),
    'no camera info topic': ({'info_topic': ''}, 'topics', F, {'camera_info': None}),
    'rectified': ({'image_topic': '/camera/image_rect'}, 'images', F, '(raw)'),
    'unknown encoding': ({'image': strange}, 'images', F, {'bad_images': 40, 'sizes': []}),
    'video': ({'image': encoded(b'\x00\x00\x00\x01\x67' * 20, 'h264')}, 'images', F, 'JPEG'),
    'compressed': (
        {'image': encoded(build.jpeg(PIXELS))},
        'transport',
        W,
        'image_transport: compressed',
    ),
    'uncalibrated': ({'info': uncalibrated}, 'calibration', F, 'camera_matrix'),
    'calibration of another size': ({'info': of_another_size}, 'calibration', F, {'fx': 300.0}),
    'lost images': (
        image_stamps(lambda t: np.delete(t, [5, 6, 7, 15, 16, 22])),
        'image rate',
        W,
        {'missed': 6, 'gaps': 3},
    ),
    'one image': (image_stamps(lambda t: t[:1]), 'image rate', F, {'count': 1}),
    'stamps of arrival': (
        image_stamps(lambda t: t + np.random.default_rng(2).integers(0, 60 * MS, len(t))),
        'image stamps',
        W,
        {'jitter_s': CLOSE(0.027, abs=0.01)},
    ),
    'equal stamps': (
        image_stamps(lambda t: np.repeat(START, 40)),
        'image stamps',
        F,
        {'repeated': 39},
    ),
    'gaps': (
        imu_stamps(lambda t: t[np.abs(t - START - 1100 * MS) >= 101 * MS]),
        'imu rate',
        W,
        {'gaps': 1, 'longest_step_s': CLOSE(0.21)},
    ),
    'slow imu': (imu_stamps(lambda t: t[::4]), 'imu rate', W, {'rate_hz': CLOSE(50.0)}),
    'very slow imu': (imu_stamps(lambda t: t[::20]), 'imu rate', F, {'rate_hz': CLOSE(10.0)}),
    'slow images': (image_stamps(lambda t: t[::4]), 'image rate', W, {'rate_hz': CLOSE(2.5)}),
    'no accelerometer': ({'force': lambda self, t: None}, 'gravity', W, '--accel-topic'),
    'order': (
        imu_stamps(lambda t: t[[*range(300), 301, 300, *range(302, len(t))]], recorded=regularly),
        'imu stamps',
        W,
        {'backwards': 1},
    ),
    'repeated': (imu_stamps(lambda t: np.repeat(t, 2)), 'imu stamps', F, {'repeated': 840}),
    'clock set back': (
        imu_stamps(lambda t: np.concatenate([t[:400], t[400:] - 1500 * MS]), recorded=regularly),
        'imu stamps',
        W,
        {'furthest_back_s': CLOSE(1.495)},
    ),
    'other clock': (
        imu_stamps(lambda t: t - START + 7 * MS, recorded=lambda self, stamp, k: stamp + START),
        'clocks',
        F,
        'stamp with one clock',
    ),
    'imu ends early': (
        imu_stamps(lambda t: t[:400]),
        'clocks',
        W,
        {'common_s': CLOSE(1.9, abs=0.01)},
    ),
    'no gyro': (
        {
            'imu': lambda self, stamp_ns: outgoing.imu_message(
                stamp_ns, 'imu', None, (0.0, -9.81, 0.0), TYPES
            )
        },
        'gyro',
        F,
        '--imu-topic',
    ),
    'stuck gyro': (
        {'rate': lambda self, t: [0.1, 0.0, 0.0]},
        'gyro',
        F,
        {'median_rad_s': CLOSE(0.1)},
    ),
    'degrees per second': (
        {'rate': lambda self, t: 5000.0 * Small.rate(self, t)},
        'gyro',
        F,
        'rad/s',
    ),
    'bias': (
        {'rate': at_rest, 'force': lambda self, t: [0.0, -9.81, 0.0]},
        'gyro at rest',
        W,
        'gyro_bias: [0.0',
    ),
    'in g': ({'force': lambda self, t: [0.0, -1.0, 0.01]}, 'gravity', F, 'm/s^2'),
    'gravity removed': ({'force': lambda self, t: [0.3, 0.2, 0.01]}, 'gravity', F, 'REP-145'),
    'accelerometer off': (
        {'force': lambda self, t: [0.0, -11.5, 0.0]},
        'gravity',
        W,
        {'mean_length_m_s2': CLOSE(11.5)},
    ),
    'large images': (
        {'pixels': np.zeros((800, 800), np.uint8), 'seconds': 0.5},
        'live transport',
        W,
        'fastdds.xml',
    ),
    'frozen camera': (
        {'image': lambda self, stamp_ns: mono8(stamp_ns, PIXELS)},
        'pairs',
        F,
        {'images': 1, 'pairs': 0},
    ),
    'no texture': (
        {'pixels': np.full((120, 160), 90, np.uint8)},
        'texture',
        F,
        {'median_matches': CLOSE(0.0, abs=14.0)},
    ),
}


@pytest.mark.parametrize('case', BROKEN)
def test_a_broken_recording_has_its_finding(case, tmp_path):
    changes, name, state, expected = BROKEN[case]
    findings, report = checked(broken(**changes).write(tmp_path / 'bag'))
    found = findings[name]
    assert found.state is state, found
    assert found.fix, found
    if isinstance(expected, str):
        assert expected in found.fix
    else:
        assert {key: found.finding.evidence.measured[key] for key in expected} == expected
    assert report.failed == any(f.state is F for f in report.findings)
    json.dumps(report.to_mapping(), allow_nan=False)
    assert len(report.lines(80)) > len(findings)
    first = report.lines(80)[0]
    assert first == report.to_mapping()['verdict']
    assert ('cannot be used' in first) == report.failed
    causes = [one for one in report.findings if one.finding.parent is None]
    assert found.finding.parent is None or found.finding.parent in {one.code for one in causes}
    if report.failed:
        assert first.endswith(next(one.text for one in causes if one.state is F))
    assert max(map(len, report.lines(100)[1:-1])) <= 100  # the first and the last have the path


@pytest.mark.parametrize('changes', [{'info': uncalibrated}, {'info_topic': ''}])
def test_intrinsics_by_parameters(changes, tmp_path):
    """As good as those of a CameraInfo, in whose place they are used."""
    configured = Parameters.from_mapping(
        GIVEN
        | {
            'camera_matrix': (151.0, 0.0, 79.5, 0.0, 151.0, 59.5, 0.0, 0.0, 1.0),
            'distortion_coefficients': (-0.1, 0.0, 0.0, 0.0),
        }
    )
    findings, report = checked(broken(**changes).write(tmp_path / 'bag'), configured)
    assert not report.failed
    assert findings['calibration'].finding.evidence.measured['fx'] == 151.0
    assert 'camera_matrix' in findings['calibration'].message
    findings, _ = checked(broken(seconds=1.0).write(tmp_path / 'calibrated'), configured)
    assert findings['calibration'].finding.evidence.measured['fx'] == 151.0


def test_missing_parameters_are_a_warning(tmp_path):
    findings, _ = checked(Small().write(tmp_path / 'bag'), Parameters())
    assert findings['parameters'].state is W
    assert findings['parameters'].finding.evidence.measured['missing'] == [
        'readout_time',
        'quat_cam_imu_xyzw',
    ]
    # They are not observable in this recording, either.
    assert [findings[name].state for name in ('axes', 'readout_time', 'rolling shutter')] == [
        FindingState.UNKNOWN
    ] * 3


# -- images against the gyro -----------------------------------------------------------------


@pytest.fixture(scope='module')
def parameters(bundled_bag):
    return read_parameters(bundled_bag.with_name('hand_held.yaml'))


@pytest.fixture(scope='module')
def short_bag(bundled_bag, tmp_path_factory):
    return copied(bundled_bag, tmp_path_factory.mktemp('short') / 'bag', seconds=3.5)


def test_the_bundled_bag_is_good(bundled_bag, parameters):
    """Its parameter file is the ground truth."""
    findings, report = checked(bundled_bag, parameters)
    assert {f.state for f in report.findings} <= {FindingState.OK, FindingState.UNKNOWN}
    for quantity in QUANTITIES:
        finding = findings[quantity.code]
        assert finding.as_json()['figures']['figure'] == quantity.code
        found = finding.finding
        assert found.observable
        assert abs(found.estimate - found.active) < 4.0 * found.sigma
    assert findings['time_offset'].finding.sigma < 2e-3
    assert findings['parameters'].finding.evidence.measured['nearest'] == (
        'cam x = -imu y, cam y = -imu z, cam z = +imu x'
    )
    assert findings['pairs'].finding.evidence.measured['poses'] > 20
    assert findings['rolling shutter'].finding.evidence.measured['p95_px'] > 1.0


@pytest.mark.parametrize(
    'changes, name, truth, tolerance',
    [
        ({'readout_time': 0.06}, 'readout_time', 0.03, 0.006),
        ({'quat_cam_imu_xyzw': (0.0, 0.0, 0.0, 1.0)}, 'axes', 120.0, 5.0),
    ],
)
def test_parameters_that_contradict_the_recording(
    changes, name, truth, tolerance, short_bag, parameters
):
    # Parameters that the node would track are evaluated as configured.
    tracking = {'track_time_offset': True, 'track_readout_time': True}
    findings, report = checked(short_bag, parameters.updated(tracking | changes))
    assert [f.code for f in report.findings if f.state is F] == [name]
    assert report.failed
    assert findings[name].finding.estimate == pytest.approx(truth, abs=tolerance)
    if 'readout' in name:
        assert findings['time_offset'].state is FindingState.UNKNOWN
        # The rolling-shutter effect is that of the estimate.
        assert findings['rolling shutter'].finding.evidence.measured['readout_s'] == pytest.approx(
            0.03, abs=0.006
        )


def longer(message):
    if hasattr(message, 'k'):
        message.k = message.k * [1.1, 1.0, 1.0, 1.0, 1.1, 1.0, 1.0, 1.0, 1.0]


def test_messages_that_contradict_each_other(bundled_bag, parameters, tmp_path):
    path = copied(bundled_bag, tmp_path / 'bag', longer, 4.0)
    findings, _ = checked(path, parameters)
    assert findings['focal_length'].state in (W, F), findings['focal_length']
    assert findings['focal_length'].finding.estimate == pytest.approx(450.0, abs=10.0)
    assert FindingState.OK not in {findings[quantity.code].state for quantity in QUANTITIES}


def test_missing_parameters_are_estimated(short_bag):
    """And the rest is evaluated with them; never ok without having been configured."""
    given = Parameters.from_mapping({'gyro_bias': (0.010885, -0.007021, 0.005061)})
    findings, report = checked(short_bag, given)
    assert not report.failed
    assert findings['axes'].state is findings['readout_time'].state is FindingState.UNKNOWN
    assert 'cam x = -imu y, cam y = -imu z, cam z = +imu x' in findings['axes'].message
    assert 'bottom' in findings['axes'].message  # direction of gravity
    readout = findings['readout_time']
    assert (readout.finding.active, readout.finding.estimate) == (
        None,
        pytest.approx(0.03, abs=2e-3),
    )
    assert abs(findings['time_offset'].finding.estimate) < 3e-3
    assert findings['rolling shutter'].finding.evidence.measured['readout_s'] == pytest.approx(
        0.03, abs=2e-3
    )


@pytest.mark.parametrize(
    'state, estimated, expected',
    [
        ('ok', 4.5e-3, 'ok'),
        ('ok', 9e-3, 'warning'),
        ('suspect', 9e-3, 'warning'),
        ('wrong', 9e-3, 'failure'),
        ('suspect', 0.018, 'failure'),
        ('unknown', None, 'unknown'),
    ],
)
def test_a_certain_deviation_counts_though_no_pose_suffers(state, estimated, expected):
    """By its sigma (1 ms) and its limit of 12 ms."""
    finding = Finding(
        Code.TIME_OFFSET,
        FindingState(state),
        {'ok': Why.CONSISTENT, 'unknown': Why.NOT_OBSERVABLE}.get(state, Why.OFF),
        (4e-3,),
        () if estimated is None else (estimated,),
        1e-3,
        's',
        evidence=Evidence(shift=2.0),
        settings={'time_offset': estimated},
    )
    (found,) = quantity_findings(Assessment((finding,)), '')
    assert found.state.verdict == expected
    further = found.fix.removeprefix(text_of(finding).fix)
    raised = state == 'ok' and expected != 'ok'
    assert bool(further) is (raised or expected == 'failure')


@pytest.mark.parametrize(
    ('estimated', 'state'), [((404.0, 404.4), FindingState.OK), ((400.5, 404.4), W)]
)
def test_a_longer_focal_length_is_no_squeezed_image(estimated, state):
    """Both values are five sigmas off, which says nothing of their ratio."""
    found = Finding(
        Code.ASPECT, FindingState.OK, Why.CONSISTENT, (400.0, 400.0), estimated, 0.8, 'px', 1
    )
    assert next(quantity_findings(Assessment((found,)), '')).state is state


def test_a_deviation_that_does_no_harm_is_none_beside_one_that_does():
    harmless = Finding(
        Code.READOUT_TIME, FindingState.OK, Why.CONSISTENT, (0.03,), (0.0368,), 1e-3, 's'
    )
    (alone,) = quantity_findings(Assessment((harmless,)), '')
    assert alone.state is W
    harm = Finding(
        Code.FOCAL_LENGTH, F, Why.OFF, (450.0,), (462.0,), 1.0, 'px', evidence=Evidence(shift=9.0)
    )
    beside, named = quantity_findings(Assessment((harmless, harm)), '')
    assert (beside.state, named.state) == (FindingState.OK, F)


@pytest.mark.parametrize(
    'name, configured, estimated, state',
    [
        ('axes', 0.0, 2.9, W),
        ('axes', 0.0, 3.1, F),
        ('focal_length', 100.0, 111.0, W),
        ('focal_length', 100.0, 113.0, F),
        ('readout_direction', 0.03, -0.03, F),
    ],
)
def test_limits_are_in_the_units_of_the_quantity(name, configured, estimated, state):
    finding = Finding(
        Code(name),
        W,
        Why.OFF,
        (configured,),
        (estimated,),
        0.01 * configured + 1e-3,
        {'axes': 'deg', 'focal_length': 'px'}.get(name, 's'),
        evidence=Evidence(shift=2.0),
        settings={
            'axes': {'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0]},
            'readout_direction': {'readout_direction': 'up'},
        }.get(name, {}),
    )
    assert next(quantity_findings(Assessment((finding,)), '')).state is state


# -- contradictions by a calibration: conventions of rows, signs and exposures -----------------

INTRINSICS = Intrinsics(
    width=640,
    height=480,
    fx=500.0,
    fy=500.0,
    cx=319.5,
    cy=239.5,
    image_width=640,
    image_height=480,
)
INTERVAL = 0.05
TRUE = {
    'readout_time': 0.024,
    'time_offset': -0.03,
    'exposure_time': 0.012,
    'quat_cam_imu_xyzw': (0.5, -0.5, 0.5, -0.5),
    'time_offset_per_interval': -0.5,
    'time_offset_reference_interval': 0.04,
}


def contradictions(found, row, direction, exposure, **changes):
    """Findings on parameters of a convention, by a calibration."""
    configured = Parameters.from_mapping(
        TRUE
        | {'stamp_row': row, 'readout_direction': direction, 'stamp_exposure': exposure}
        | changes
    )
    return check_recording.contradicted(
        found, configured.sensor, sensor_model(INTRINSICS, configured.sensor)
    )


def found_by(row, direction, exposure, offset_observable=True):
    """A calibration equal to the truth of these conventions, by their definition."""
    stamped = {'first': 0.0, 'middle': 239.5, 'last': 479.0}[row]
    signed = {'down': 1.0, 'up': -1.0}[direction] * TRUE['readout_time']
    middle_of_exposure = {'start': 0.006, 'middle': 0.0, 'end': -0.006}[exposure]
    at_interval = TRUE['time_offset'] - 0.5 * (INTERVAL - 0.04)
    row_0 = at_interval + middle_of_exposure - stamped / 480.0 * signed
    R = Rotation.from_quat(TRUE['quat_cam_imu_xyzw']).as_matrix()
    return SimpleNamespace(
        R_cam_imu=R,
        rotation_sigma=np.full(3, 1e-3),
        frame_interval=INTERVAL,
        quat_cam_imu_xyzw=TRUE['quat_cam_imu_xyzw'],
        readout_time=Estimate(signed, 3e-4, True),
        readout_direction=direction,
        time_offset=Estimate(row_0, 2e-4, offset_observable),
    )


@pytest.mark.parametrize(
    'convention',
    [*itertools.product(('first', 'middle', 'last'), ('down', 'up'), ('start', 'middle', 'end'))],
)
def test_a_calibration_contradicts_wrong_parameters_in_every_convention(convention):
    found = found_by(*convention)
    assert contradictions(found, *convention) == ()
    assert contradictions(found, *convention, time_offset=-0.025) == ()  # a small difference
    unknown = found_by(*convention, offset_observable=False)
    assert contradictions(unknown, *convention, time_offset=0.2) == ()
    (offset,) = contradictions(found, *convention, time_offset=0.01)
    assert (offset.code, offset.active) == ('time_offset', 0.01)
    assert offset.estimate == pytest.approx(-0.03, abs=1e-6)
    assert text_of(offset).fix == 'set time_offset: -0.0300'
    (readout,) = contradictions(found, *convention, readout_time=0.05)
    assert (readout.code, readout.active) == ('readout_time', pytest.approx(0.05))
    assert readout.estimate == pytest.approx(0.024, abs=1e-9)
    (axes,) = contradictions(found, *convention, quat_cam_imu_xyzw=(0.0, 0.0, 0.0, 1.0))
    assert axes.code == 'axes' and axes.estimate == pytest.approx(120.0)
    assert text_of(axes).fix == 'set quat_cam_imu_xyzw: [0.5, -0.5, 0.5, -0.5]'
    row, direction, exposure = convention
    if row == 'middle':  # which keeps its time
        (reverse,) = contradictions(found, row, {'down': 'up', 'up': 'down'}[direction], exposure)
        assert reverse.code == 'readout_direction'
        assert text_of(reverse).fix == f'set readout_direction: {direction}'


# -- recordings ------------------------------------------------------------------------------

# Permitted warnings: three gaps of up to 0.3 s; no accelerometer, and no bias known; little light.
REAL = {
    'realsense_rgb_rs': {'image rate'},
    'realsense_rgb_rs_b': {'image rate'},
    'xiaomi_cc9_rs': {'gravity', 'gyro_bias'},
}


# The lens of the RealSense by a joint adjustment of four stretches (docs/lab/calibration.md), in
# place of its CameraInfo, which says that it has no distortion.
TRUE_LENS = {
    'camera_matrix': (905.9, 0.0, 636.5, 0.0, 905.9, 356.9, 0.0, 0.0, 1.0),
    'distortion_coefficients': (0.163, -0.520, 0.0, 0.0, 0.474),
}


@pytest.mark.recordings
@pytest.mark.parametrize('name', REAL)
def test_recordings_of_real_cameras(converted, name):
    path = converted(name)
    parameters = read_parameters(f'{path}.yaml')
    if name.startswith('realsense'):
        parameters = parameters.updated(TRUE_LENS)
    findings, report = checked(path, parameters)
    assert not report.failed
    assert {f.code for f in report.findings if f.state is W} <= REAL[name]
    assert findings['axes'].state in (FindingState.OK, FindingState.UNKNOWN)
    if 'realsense' in name:
        # Automatic exposure: stamps of varying interval are no times of arrival.
        assert findings['image stamps'].state is FindingState.OK
    if name == 'realsense_rgb_rs_b':
        assert 'time_offset_per_interval' in findings['image stamps'].fix


@pytest.mark.recordings
def test_distortion_that_a_camera_info_denies_is_found(converted):
    path = converted('realsense_rgb_rs_b')
    findings, report = checked(path, read_parameters(f'{path}.yaml'))
    assert {f.code for f in report.findings if f.state is F} == {'distortion'}
    lens = findings['distortion'].finding.estimated
    np.testing.assert_allclose(lens, (0.163, -0.520, 0.474), atol=0.12)
    assert findings['distortion'].fix.startswith('set distortion_coefficients')


@pytest.mark.recordings
def test_gross_errors_in_little_light(converted):
    """Too far off for pairs: a calibration estimates it, and nothing else is blamed."""
    path = converted('realsense_rgb_rs_b')
    findings, report = checked(path, read_parameters(f'{path}.yaml', ['time_offset=-0.0305']))
    # The stamp of another row makes nearly the same offset.
    assert {f.code for f in report.findings if f.state is F} - {'stamp_row'} == {'time_offset'}
    assert findings['time_offset'].finding.estimate == pytest.approx(-0.0635, abs=6e-3)


# -- containers, options, output -------------------------------------------------------------

NO_TIME = ros.QosTime(0, 0)
BEST_EFFORT = ros.Qos(
    ros.QosHistory.KEEP_LAST,
    5,
    ros.QosReliability.BEST_EFFORT,
    ros.QosDurability.VOLATILE,
    NO_TIME,
    NO_TIME,
    ros.QosLiveliness.AUTOMATIC,
    NO_TIME,
    False,
)


@pytest.mark.parametrize(
    'kind, offered, reliability',
    [
        ('sqlite3', {'offered_qos_profiles': [BEST_EFFORT]}, 'best effort'),
        ('mcap', {'offered_qos_profiles': [BEST_EFFORT]}, 'best effort'),
        ('ros1', {}, None),
    ],
)
def test_every_container(kind, offered, reliability, tmp_path):
    findings, _ = checked(
        write_kind(
            kind,
            tmp_path,
            [
                (topic, msgtype, message, at - STAMP_NS)
                for topic, msgtype, message, at in broken(seconds=1.0).messages()
            ],
            **offered,
        )
    )
    assert findings['image rate'].finding.evidence.measured['count'] == 10
    assert findings['imu rate'].finding.evidence.measured['rate_hz'] == pytest.approx(200.0)
    assert findings['live transport'].finding.evidence.measured['reliability'] == reliability
    assert findings['imu rate'].finding.evidence.measured['reliability'] == reliability


def test_the_command_prints_ok_lines_and_fails_for_a_bad_bag(tmp_path, capsys):
    good = Small().write(tmp_path / 'good')
    bad = broken(info=uncalibrated).write(tmp_path / 'bad')
    options = ['--set', 'readout_time=0.02', '--set', 'quat_cam_imu_xyzw=[0, 0, 0, 1]']
    run_command('check', good, *options)
    shown = capsys.readouterr()
    assert shown.err == ''
    assert not re.search('^(warning|failure)', shown.out, re.MULTILINE)
    assert re.search(r'^ok +imu rate +200 Hz', shown.out, re.MULTILINE)
    assert main(['check', str(bad), *options, '--json']) == 1
    report = json.loads(capsys.readouterr().out)
    assert report['failed'] is True
    assert {f['name']: f['verdict'] for f in report['findings']}['calibration'] == 'failure'


@pytest.mark.parametrize(
    'arguments, message',
    [
        (['nowhere'], 'there is no bag'),
        (['BAG', '--imu-topic', '/nothing'], '/nothing'),
        (['BAG', '--set', 'readout=1'], 'readout_time'),
        (['BAG', '--params', 'no.yaml'], 'no.yaml'),
        (['BAG', '--image-topic', '/imu'], 'must be'),
        (['DAMAGED'], 'mcap'),
    ],
)
def test_bad_usage_is_refused(arguments, message, tmp_path, refused):
    for name in ('BAG', 'DAMAGED'):
        broken(seconds=0.3).write(tmp_path / name)
    damaged = tmp_path / 'DAMAGED' / 'DAMAGED.mcap'
    damaged.write_bytes(damaged.read_bytes()[:3000])
    refused(message, 'check', *(tmp_path / word if word.isupper() else word for word in arguments))


def test_steps_between_stamps():
    times = [k * 5 * MS + (100 * MS if k > 10_000 else 0) for k in range(20_000)]
    stamps = StampStatistics(times, times)
    assert stamps.interval == pytest.approx(0.005) and stamps.count == 20_000
    assert (stamps.forwards > 0.05).sum() == 1 and stamps.longest == pytest.approx(0.105)
