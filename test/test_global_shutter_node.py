"""global_shutter_node over DDS: images of a bag; other images; a wrong calibration."""

from collections.abc import Iterator
import itertools
from pathlib import Path
import signal
import time
from types import SimpleNamespace
from typing import Any

from conftest import BUNDLED_PARAMETERS, ROOT
import cv2
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import fault_stream as faults
from fault_stream import BAG_TOPICS, SECOND, stamp_of
import message_builders as build
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from rs_relpose_lab.live.graph import diagnostic_values, Graph
from rs_relpose_lab.live.processes import node_process, wait_until, wait_until_quiet
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.calibration.findings import Assessment
from rs_relpose_ros.calibration.findings_text import message_json
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.messages.incoming import Intake, sensor_messages
from rs_relpose_ros.offline.replay import outcomes
from rs_relpose_ros.pipeline.global_shutter import GlobalShutterFrame, unrolling_loop
from rs_relpose_ros.pipeline.pair import Frame

# The node may have to compile the kernels.
pytestmark = [pytest.mark.live, pytest.mark.timeout(600)]

OWN = '/global_shutter_node'
# Bundled bag: 239.5 of 480 rows that take 30 ms.
DELAY_NS = round(239.5 / 480 * 0.03 * SECOND)
# Images of the bag that are played.
PLAYED = 60


def stamps_of(messages: list[Any]) -> list[int]:
    return [stamp_of(message) for message in messages]


@pytest.fixture(scope='module')
def expected(bundled_bag: Path) -> dict[int, GlobalShutterFrame]:
    """Derotated offline, by the stamps of the images in the bag."""
    parameters = read_parameters(BUNDLED_PARAMETERS)
    loop = unrolling_loop(parameters, offline=True)
    with open_bag(bundled_bag) as bag:
        found = outcomes(
            loop, Intake(loop.sequencer, parameters), sensor_messages(bag, bag.find_topics())
        )
        frames = (item.result for item in found if isinstance(item, Frame) and item.result)
        return {frame.original_stamp_ns: frame for frame in itertools.islice(frames, PLAYED)}


@pytest.fixture(scope='module')
def session(module_ros_domain_id: int, bundled_bag: Path) -> Iterator[SimpleNamespace]:
    """Messages of the first images of the bag."""
    messages = faults.read_messages(bundled_bag, PLAYED / 30.0)
    with (
        Graph() as graph,
        node_process(
            BUNDLED_PARAMETERS,
            remap=BAG_TOPICS,
            node='global_shutter_node',
            parameters={'image_transport': 'raw', **faults.reliable(*BAG_TOPICS.values())},
        ) as node,
    ):
        images, masks = (graph.listen(Image, f'{OWN}/{topic}') for topic in ('image', 'mask'))
        infos = graph.listen(CameraInfo, f'{OWN}/camera_info')
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        node.wait_for('ready')
        publishers = faults.drivers(graph)
        with Graph() as other:
            compressed = other.listen(CompressedImage, f'{OWN}/image/compressed')
            for topic in ('image', 'image/compressed', 'mask', 'camera_info'):
                other.wait_for_publisher(f'{OWN}/{topic}')
            # A publisher knows its subscriptions before each of them knows it: on a busy machine
            # the CameraInfo of the first two seconds was lost.
            time.sleep(3.0)
            faults.play(publishers, messages)
        wait_until_quiet(lambda: len(images), 1.0, node)  # a busy machine is behind
        count = len(diagnostics)
        wait_until(lambda: len(diagnostics) >= count + 2, 'diagnostics', node)
        code, seconds = node.signal(signal.SIGINT)
        assert code == 0 and seconds <= 1.0
        yield SimpleNamespace(
            images=images,
            compressed=compressed,
            masks=masks,
            infos=infos,
            info=next(message for _, message in messages if isinstance(message, CameraInfo)),
            sent=sum(isinstance(message, Image) for _, message in messages),
            diagnostics=diagnostics,
            values=diagnostic_values(diagnostics[-1]),
            output=node.output,
        )


def test_images_are_those_of_the_replay_bit_by_bit(session, expected):
    by_stamp = {frame.stamp_ns: frame for frame in expected.values()}
    stamps = stamps_of(session.images)
    assert len(stamps) > 0.83 * PLAYED
    assert stamps == sorted(set(stamps))
    for message in session.images:
        frame = by_stamp[stamp_of(message)]
        assert (message.encoding, message.width, message.height, message.step) == (
            'mono8',
            640,
            480,
            640,
        )
        assert message.header.frame_id == 'camera_optical_frame'
        assert bytes(message.data) == frame.image().values.tobytes()
    masks = {stamp_of(message): message for message in session.masks}
    for stamp in stamps[::10]:
        assert bytes(masks[stamp].data) == by_stamp[stamp].mask().values.tobytes()
    # Stamped at their middle rows.
    middles = {stamp + DELAY_NS for stamp in expected}
    assert all(min(abs(stamp - middle) for middle in middles) <= 1 for stamp in stamps)


def test_compressed_images_are_the_same(session):
    raw = {stamp_of(message): message for message in session.images}
    pairs = [
        (message, raw[stamp_of(message)])
        for message in session.compressed
        if stamp_of(message) in raw
    ]
    assert len(pairs) > 0.55 * PLAYED
    for compressed, image in pairs[::20]:
        assert compressed.format.startswith('mono8; jpeg compressed')
        pixels = cv2.imdecode(np.frombuffer(compressed.data, np.uint8), cv2.IMREAD_UNCHANGED)
        difference = np.abs(pixels.astype(int) - faults.pixels_of(image))
        assert difference.mean() < 1.5


def test_camera_info_is_as_published(session):
    assert set(stamps_of(session.images)) <= set(stamps_of(session.infos))
    for info in session.infos[::20]:
        for name in ('width', 'height', 'distortion_model', 'binning_x', 'roi'):
            assert getattr(info, name) == getattr(session.info, name)
        for name in 'kdrp':
            assert list(getattr(info, name)) == list(getattr(session.info, name))


def test_diagnostics_count_all_frames(session):
    [status] = session.diagnostics[-1].status
    assert status.name == f'{OWN}: global shutter'
    values = session.values
    refused = sum(int(value) for key, value in values.items() if key.startswith('frames_refused_'))
    assert (
        int(values['frames_received']) == session.sent == int(values['images_published']) + refused
    )
    assert values['images_published'] == values['frames_processed']
    assert abs(int(values['images_published']) - len(session.infos)) <= 2
    documented = ''.join(
        (ROOT / 'docs' / name).read_text(encoding='utf-8')
        for name in ('any_slam.md', 'operation.md')
    )
    assert [
        key
        for key in values
        if f'`{key}`' not in documented and not key.startswith('frames_refused_')
    ] == []
    assert 1.0 < float(values['largest_shift_px']) < 30.0
    assert values['applied_time_offset_ms'] == '0.00'
    assert 0.0 < float(values['latency_p50_ms']) <= float(values['latency_p99_ms'])
    # At most that the machine was busy, and that the player came late.
    assert session.output.count('[WARN]') <= 2 and '[ERROR]' not in session.output


def status_of_relpose(health: Assessment) -> DiagnosticArray:
    return DiagnosticArray(
        status=[
            DiagnosticStatus(
                name='/relpose_node: relative pose',
                hardware_id=BAG_TOPICS['image'],
                values=[
                    KeyValue(key='health', value=health.state.value),
                    KeyValue(key='findings', value=message_json(health)),
                ],
            )
        ]
    )


def test_images_of_a_wrong_calibration_are_suppressed(ros_domain_id, bundled_bag):
    """By the own watch, and by relpose_node while it runs."""
    quaternion = Rotation.from_rotvec([0.0, 0.0, np.pi]) * Rotation.from_quat(
        read_parameters(BUNDLED_PARAMETERS).sensor.quat_cam_imu_xyzw
    )
    messages = faults.read_messages(bundled_bag, 3.0)
    with (
        Graph() as graph,
        node_process(
            BUNDLED_PARAMETERS,
            remap=BAG_TOPICS,
            node='global_shutter_node',
            parameters={
                'image_transport': 'raw',
                'quat_cam_imu_xyzw': quaternion.as_quat().tolist(),
                **faults.reliable(*BAG_TOPICS.values()),
            },
        ) as node,
    ):
        infos = graph.listen(CameraInfo, f'{OWN}/camera_info')
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        node.wait_for('ready')
        publishers = faults.drivers(graph)
        faults.play(publishers, messages)
        node.wait_for('axes is wrong')
        wait_until_quiet(lambda: len(infos), 1.0, node)
        count = len(infos)
        faults.play(publishers, messages, later=10.0)
        wait_until_quiet(lambda: len(infos), 1.0, node)
        assert len(infos) < count + 5  # the window of the watch begins again after a jump
        values = diagnostic_values(diagnostics[-1])
        assert int(values['images_withheld']) > 60
        assert (values['health'], values['health_source']) == ('wrong', 'own watch')
        assert diagnostics[-1].status[0].level == DiagnosticStatus.ERROR
        relpose = graph.node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        relpose.publish(status_of_relpose(Assessment(())))
        count = len(infos)
        faults.play(publishers, messages[:200], later=20.0)
        wait_until(lambda: len(infos) > count + 5, 'images', node)
        relpose.publish(status_of_relpose(Assessment((build.WRONG_AXES,))))
        faults.play(publishers, messages[:200], later=30.0)
        expected = f'axes is wrong: {build.WRONG_AXES_TEXT}'
        wait_until(lambda: diagnostics[-1].status[0].message == expected, expected, node)
