"""global_shutter_node and a player as processes over DDS: what comes out, and after faults."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
import signal
from typing import Any

from conftest import BUNDLED_PARAMETERS, ROOT
import cv2
from diagnostic_msgs.msg import DiagnosticArray
import fault_stream as faults
from fault_stream import BAG_TOPICS, Fault, publish_in_time, SECOND, Stream
import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu

from rs_relpose_lab.experiments.unrolled_poses import frames_of_bag
from rs_relpose_lab.live.graph import diagnostic_values, Graph
from rs_relpose_lab.live.processes import node_process, player_process, wait_until
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.global_shutter.frames import GlobalShutterFrame

# The node may have to compile the kernels.
pytestmark = [pytest.mark.live, pytest.mark.timeout(600)]

OWN = '/global_shutter_node'
# Of the bundled bag: 239.5 of 480 rows that take 30 ms.
DELAY_NS = round(239.5 / 480 * 0.03 * SECOND)


def stamps_of(messages: list[Any]) -> list[int]:
    return [faults.stamp_of(message) for message in messages]


@pytest.fixture(scope='module')
def expected(bundled_bag: Path) -> dict[int, GlobalShutterFrame]:
    """Turned offline, by the stamps of the images as read."""
    return {turned.frame.stamp_ns: turned for turned in frames_of_bag(
        bundled_bag, read_parameters(BUNDLED_PARAMETERS))}


# -- the bundled bag -------------------------------------------------------------------------


@dataclass(frozen=True)
class Published:
    images: list[Image]
    compressed: list[CompressedImage]
    masks: list[Image]
    infos: list[CameraInfo]
    diagnostics: list[DiagnosticArray]
    output: str
    exit_code: int
    seconds_to_end: float


@pytest.fixture(scope='module')
def run(module_ros_domain_id: int, bundled_bag: Path) -> Published:
    # Nothing may be lost on the way, or the bits differ: a busy machine loses best effort.
    reliable = {f'qos_overrides.{topic}.subscription.reliability': 'reliable'
                for topic in (f'{BAG_TOPICS["image"]}/compressed', BAG_TOPICS['imu'])}
    with Graph() as graph, node_process(
            BUNDLED_PARAMETERS, remap=BAG_TOPICS, parameters=reliable,
            folder='global_shutter') as node:
        images = graph.listen(Image, f'{OWN}/image')
        compressed = graph.listen(CompressedImage, f'{OWN}/image/compressed')
        masks = graph.listen(Image, f'{OWN}/mask')
        infos = graph.listen(CameraInfo, f'{OWN}/camera_info')
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        node.wait_for('ready')
        for topic in ('image', 'image/compressed', 'mask', 'camera_info'):
            graph.wait_for_publisher(f'{OWN}/{topic}')
        with player_process(bundled_bag) as playing:
            assert playing.wait() == 0
        count = len(diagnostics)
        wait_until(lambda: len(diagnostics) >= count + 2, 'diagnostics', node)
        code, seconds = node.signal(signal.SIGTERM)
        return Published(images, compressed, masks, infos, diagnostics, node.output, code, seconds)


def test_images_are_those_of_the_replay_bit_by_bit(run, expected):
    assert len(run.images) > 150
    by_stamp = {frame.stamp_ns: frame for frame in expected.values()}
    assert stamps_of(run.images) == sorted(set(stamps_of(run.images)))
    for message in run.images:
        frame = by_stamp[faults.stamp_of(message)]
        assert (message.encoding, message.width, message.height, message.step) == (
            'mono8', 640, 480, 640)
        assert message.header.frame_id == 'camera_optical_frame'
        assert bytes(message.data) == frame.image().values.tobytes()
    for message in run.masks[::10]:
        frame = by_stamp[faults.stamp_of(message)]
        assert bytes(message.data) == frame.mask().values.tobytes()


def test_stamps_are_those_of_the_middle_rows(run, expected):
    middles = {stamp + DELAY_NS for stamp in expected}
    assert all(min(abs(stamp - middle) for middle in middles) <= 1
               for stamp in stamps_of(run.images))


def test_compressed_images_are_the_same(run):
    raw = dict(zip(stamps_of(run.images), run.images, strict=True))
    pairs = [(message, raw[faults.stamp_of(message)]) for message in run.compressed
             if faults.stamp_of(message) in raw]
    assert len(pairs) > 100
    for compressed, image in pairs[::20]:
        assert compressed.format.startswith('mono8; jpeg compressed')
        pixels = cv2.imdecode(np.frombuffer(compressed.data, np.uint8), cv2.IMREAD_UNCHANGED)
        difference = np.abs(pixels.astype(int) - faults.pixels_of(image))
        assert difference.mean() < 1.5


def test_camera_info_is_as_published(run, bundled_bag):
    with open_bag(bundled_bag) as bag:
        topics = bag.find_topics()
        [first, *_] = bag.messages([topics.camera_info])
    assert set(stamps_of(run.images)) <= set(stamps_of(run.infos))
    for info in run.infos[::20]:
        assert (info.width, info.height) == (first.message.width, first.message.height)
        assert info.distortion_model == first.message.distortion_model
        for name in 'kdrp':
            assert list(getattr(info, name)) == getattr(first.message, name).tolist()


def test_diagnostics_tell_what_happened(run):
    [status] = run.diagnostics[-1].status
    assert status.name == f'{OWN}: global shutter'
    values = diagnostic_values(run.diagnostics[-1])
    refused = sum(int(value) for key, value in values.items() if key.startswith('frames_refused_'))
    assert int(values['frames_received']) == 180 == int(values['images_published']) + refused
    # A camera that outruns a busy machine is the only reason to leave a frame out.
    assert refused == int(values['frames_refused_overload'])
    documented = ''.join((ROOT / 'docs' / name).read_text(encoding='utf-8')
                         for name in ('any_slam.md', 'operation.md'))
    assert [key for key in values if f'`{key}`' not in documented
            and not key.startswith('frames_refused_')] == []
    assert 1.0 < float(values['largest_shift_px']) < 30.0
    assert values['applied_time_offset_ms'] == '0.00'
    assert 0.0 < float(values['latency_p50_ms']) <= float(values['latency_p99_ms'])


def test_a_good_run_ends_well_and_says_little(run):
    assert run.exit_code == 0
    assert run.seconds_to_end <= 1.0
    assert run.output.count('ready') == 1
    assert 'ERROR' not in run.output
    # At most that the machine was busy: the player may take its time, too.
    assert [line for line in run.output.splitlines() if line.startswith('[WARN]')
            and '(overload)' not in line and 'no image on' not in line] == []


# -- faults ----------------------------------------------------------------------------------


GAP = 'the gyro does not cover the read-out of the frame'
FAULTS = [
    Fault('start', faults.nothing),
    Fault('IMU gap', faults.without(Imu, 0.3, 0.5), GAP),
    Fault('camera stops', faults.nothing),
    Fault('camera still stands', faults.nothing),
    Fault('camera comes back', faults.nothing),
    Fault('clocks back', faults.nothing, jump=-20.0),
    Fault('clocks ahead', faults.nothing, GAP, jump=20.0),
    Fault('late IMU', faults.delayed(Imu, lambda: 0.3)),
    Fault('uncalibrated', faults.changed(CameraInfo, lambda m: setattr(m, 'k', np.zeros(9))),
          'the camera is uncalibrated'),
    Fault('the end', faults.nothing),
]
# Phases of which no image is sent: 3.4 s.
WITHOUT_CAMERA = ('camera stops', 'camera still stands')


@dataclass(frozen=True)
class Session:
    stream: Stream
    images: list[Image]
    infos: list[CameraInfo]
    diagnostics: list[DiagnosticArray]
    output: str


@pytest.fixture(scope='module')
def session(module_ros_domain_id: int, bundled_bag: Path) -> Iterator[Session]:
    stream = Stream(faults.read_messages(bundled_bag, faults.PHASE + 0.1), FAULTS,
                    10_000 * SECOND)
    with Graph() as graph, node_process(
            BUNDLED_PARAMETERS, remap=BAG_TOPICS, parameters={'image_transport': 'raw'},
            folder='global_shutter') as node:
        images = graph.listen(Image, f'{OWN}/image')
        infos = graph.listen(CameraInfo, f'{OWN}/camera_info')
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        node.wait_for('ready')
        graph.wait_for_publisher(f'{OWN}/image')
        publishers = {kind: graph.publisher(kind, topic) for kind, topic in zip(
            (Image, CameraInfo, Imu), BAG_TOPICS.values(), strict=True)}
        publish_in_time(
            (publishers[type(item.message)], item.time_ns, item.message) for item in stream.sent
            if not (isinstance(item.message, Image)
                    and FAULTS[item.phase].name in WITHOUT_CAMERA))
        count = len(diagnostics)
        wait_until(lambda: len(diagnostics) >= count + 2, 'diagnostics', node)
        assert node.signal(signal.SIGINT)[0] == 0
        yield Session(stream, images, infos, diagnostics, node.output)


def source(stream: Stream, image: Image) -> int | None:
    """Stamp of the image as read that was turned into this one."""
    stamp = faults.stamp_of(image) - DELAY_NS
    return next((near for near in (stamp, stamp - 1, stamp + 1) if near in stream.taken_at), None)


@pytest.mark.parametrize('name', [
    fault.name for fault in FAULTS if fault.name not in WITHOUT_CAMERA])
def test_images_come_within_a_second_of_good_data(session, name):
    number = [fault.name for fault in FAULTS].index(name)
    begin_ns, end_ns = session.stream.good[number]
    found = [stamp for stamp in stamps_of(session.images) if begin_ns <= stamp <= end_ns]
    assert found
    assert found[0] - begin_ns < SECOND
    assert len(found) > 10


def test_no_wrong_image_is_published(session, expected):
    """Each is that of the undisturbed bag: never turned by a gyro of another time, or not at all.

    Where the gyro was interpolated or the bias found later it differs by little.
    """
    checked = 0
    for image in session.images:
        stamp = source(session.stream, image)
        assert stamp is not None, 'an image of no instant'
        taken = session.stream.taken_at[stamp]
        if taken is None:
            continue
        checked += 1
        difference = np.abs(expected[taken].image().values.astype(int) - faults.pixels_of(image))
        assert difference.mean() < 1.0
    assert checked > 200


def test_images_without_gyro_are_counted_and_not_published(session):
    values = diagnostic_values(session.diagnostics[-1])
    assert int(values['images_published']) == int(values['frames_processed'])
    assert abs(int(values['images_published']) - len(session.infos)) <= 2
    assert int(values['frames_refused_imu_gap']) >= 5
    number = [fault.name for fault in FAULTS].index('IMU gap')
    begin_ns = session.stream.good[number][0] - round(faults.FAULT_UNTIL * SECOND)
    # Frames whose rows lie within the gap.
    gap = range(begin_ns + round(0.31 * SECOND), begin_ns + round(0.46 * SECOND))
    assert not [stamp for stamp in stamps_of(session.images) if stamp in gap]


def test_faults_are_told_and_nothing_else(session):
    lines = [line for line in session.output.splitlines()
             if line.startswith(('[WARN]', '[ERROR]', '[FATAL]'))]
    for fault in FAULTS:
        assert not fault.said or any(fault.said in line for line in lines), fault.name
    allowed = [fault.said for fault in FAULTS if fault.said] + [
        'newer frames wait for the gyro', 'no gyro sample that covers', '(overload)',
        'stamps jumped', 'frame is ', 'no image on']
    assert [line for line in lines if not any(text in line for text in allowed)] == []
    assert 'Traceback' not in session.output


# -- parameters and the graph ----------------------------------------------------------------


def test_it_says_what_it_needs(ros_domain_id):
    with node_process(folder='global_shutter') as node:
        node.wait_for('not publishing: readout_time and quat_cam_imu_xyzw must be given')
        assert node.signal(signal.SIGTERM)[0] == 0


def test_it_tells_of_other_images_of_the_same_driver(ros_domain_id):
    with Graph() as graph:
        for topic in ('/camera/image_raw', '/camera/depth'):
            graph.node.create_publisher(Image, topic, 1)
        with node_process(BUNDLED_PARAMETERS, remap=BAG_TOPICS, folder='global_shutter',
                          parameters={'image_transport': 'raw'}) as node:
            node.wait_for('/camera/depth of the same driver keep stamps on the clock of the camer')
        with node_process(BUNDLED_PARAMETERS, remap=BAG_TOPICS, folder='global_shutter',
                          parameters={'image_transport': 'raw', 'stamp_clock': 'camera'}) as node:
            node.wait_for('ready')
            assert 'same driver' not in node.output
