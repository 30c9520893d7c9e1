"""Faults of drivers and configurations, live: named by the node, or harmless.

Each case plays a rendered walk with one fault to a node of its own. A fault is named if
/diagnostics or the log has one of the expected words.
"""

from array import array
from collections.abc import Callable, Mapping, Sequence
import math
from pathlib import Path
import re
import time
from types import MappingProxyType
from typing import Any, NamedTuple

import cv2
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, TimeReference

from rs_relpose_lab.live.graph import Graph, private_domain
from rs_relpose_lab.live.processes import node_process
from rs_relpose_lab.simulation import SimulationConfig
from rs_relpose_lab.simulation.bag import render_once
from rs_relpose_ros.bags import reader, sensor_topics
from rs_relpose_ros.config.files import file_values
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.messages.incoming import stamp_ns

# Images per second of the bag, of which a case sends each second one unless it says otherwise.
# [chosen: a fast camera]
FPS = 60
# Length of a case [s]. [chosen: a finding needs some seconds]
SECONDS = 10.0
# Readout time of the camera [s]. [chosen: of usual cameras]
READOUT = 0.02
# Topics below the name of the camera or IMU, by type.
_TOPICS = {
    Image: 'image',
    CompressedImage: 'image/compressed',
    CameraInfo: 'camera_info',
    Imu: 'imu',
}

# Message, its number, and time [s] -> its delays [s], and messages to send.
Edit = Callable[[Any, int, float], list[tuple[float, Any]]]


class Case(NamedTuple):
    """One fault: its words, if it has to be named, and what makes it."""

    name: str
    words: str = ''  # regular expression; empty: harmless
    edits: tuple[Edit, ...] = ()
    parameters: Mapping[str, Any] = MappingProxyType({})
    every: int = 2  # images of the bag
    latched: bool = False  # CameraInfo
    clock: bool = False  # published
    jump_ns: int = 0  # of all stamps, halfway


def of(kind: Any, change: Callable[[Any, int, float], Any], delay: float = 0.0) -> Edit:
    """A message of a kind changed in place, or replaced; False: not sent."""

    def edit(message: Any, number: int, seconds: float) -> list[tuple[float, Any]]:
        if not isinstance(message, kind):
            return [(0.0, message)]
        found = change(message, number, seconds)
        return [] if found is False else [(delay, message if found is None else found)]

    return edit


def shifted(kind: Any, shift: Callable[[int, float], float]) -> Edit:
    """Stamps of a kind, later by so many seconds."""

    def change(message: Any, number: int, seconds: float) -> None:
        later = stamp_ns(message.header) + round(shift(number, seconds) * NANOSECONDS)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(later, NANOSECONDS)

    return of(kind, change)


def scaled(rates: Sequence[float], forces: Sequence[float] = (1.0, 1.0, 1.0)) -> tuple[Edit]:
    """Factors of the axes of the IMU."""

    def change(message: Imu, *_: object) -> None:
        for vector, factors in (
            (message.angular_velocity, rates),
            (message.linear_acceleration, forces),
        ):
            for axis, factor in zip('xyz', factors, strict=True):
                setattr(vector, axis, factor * getattr(vector, axis))

    return (of(Imu, change),)


def pictured(make: Callable[[Any], Any], encoding: str = 'mono8') -> Edit:
    """Other pixels, or another encoding."""
    return of(
        Image, lambda message, *_: gray_image(message.header, make(pixels_of(message)), encoding)
    )


def compressed(message: Image, *_: object) -> CompressedImage:
    """JPEG of an image."""
    return CompressedImage(
        header=message.header,
        format='jpeg',
        data=array('B', cv2.imencode('.jpg', pixels_of(message))[1].tobytes()),
    )


def information(*, focal: float = 1.0, size: int = 1, radial: float = 0.0) -> Edit:
    """CameraInfo with another focal length, a size divided by `size`, or first coefficient."""

    def change(message: CameraInfo, *_: object) -> None:
        message.width = message.width // size
        message.height = message.height // size
        message.k = (
            np.array(message.k) / [*6 * [size], 1, 1, 1] * [focal, 1, 1, 1, focal, 1, 1, 1, 1]
        )
        message.d[0] += radial

    return of(CameraInfo, change)


def _batched(message: Any, number: int, _: float) -> list[tuple[float, Any]]:
    return [((39 - number % 40) / 200.0 if isinstance(message, Imu) else 0.0, message)]


def _jumped(name: str, seconds: float) -> Case:
    return Case(
        name,
        edits=(shifted((Image, CameraInfo, Imu), lambda _, now: seconds * (now > 0.5 * SECONDS)),),
        jump_ns=round(seconds * NANOSECONDS),
    )


def _turned(message: CameraInfo, *_: object) -> None:
    message.width, message.height = message.height, message.width
    message.k = [message.k[i] for i in (4, 1, 5, 3, 0, 2, 6, 7, 8)]


def _zero(message: Image, number: int, _: float) -> None:
    if number % 6 == 0:
        message.header.stamp.sec = message.header.stamp.nanosec = 0


def _jitter(number: int, _: float) -> float:
    return 0.03 + float(np.random.default_rng(number).normal(0.0, 0.005))


def _rotated(degrees: float) -> dict[str, Any]:
    turn = Rotation.from_rotvec([degrees, 0.0, 0.0], degrees=True)
    return {
        'quat_cam_imu_xyzw': (turn * Rotation.from_quat(SimulationConfig().quat_cam_imu_xyzw))
        .as_quat()
        .tolist()
    }


# Types of the messages of the camera.
_IMAGES = (Image, CameraInfo)
# Parameter with the rotation between IMU and camera.
_AXES = 'quat_cam_imu_xyzw'
# Cases in the order of the report. [chosen: what drivers and users do wrong]
_CASES = (
    Case('axes 180 deg', _AXES, parameters=_rotated(180.0)),
    Case('axes 3 deg', _AXES, parameters=_rotated(3.0)),
    Case('gyro in deg/s', 'deg/s', scaled(3 * [57.3])),
    Case('accelerometer in g', 'accel_scale', scaled(3 * [1.0], 3 * [0.102])),
    Case('IMU y flipped', 'left-handed', scaled(*2 * [(1.0, -1.0, 1.0)])),
    Case('IMU x flipped', 'left-handed', scaled(*2 * [(-1.0, 1.0, 1.0)])),
    Case('K +5 %', 'focal_length', (information(focal=1.05),)),
    Case('K x 0.5', 'focal_length', (information(focal=0.5),)),
    Case('CameraInfo of half size', 'CameraInfo is for', (information(size=2),)),
    Case('offset +10 ms', 'time_offset', (shifted(Imu, lambda *_: 0.01),)),
    Case('offset -30 ms', 'time_offset', (shifted(Imu, lambda *_: -0.03),)),
    Case('IMU clock +5 s', 'clock|time_offset', (shifted(Imu, lambda *_: 5.0),)),
    Case('IMU clock -5 s', 'clock|time_offset', (shifted(Imu, lambda *_: -5.0),)),
    Case('readout 0', 'readout_time', parameters={'readout_time': 0.0}),
    Case('readout x 2', 'readout_time', parameters={'readout_time': 2.0 * READOUT}),
    Case('rows reversed', 'readout_direction', parameters={'readout_direction': 'up'}),
    Case(
        'stamp at the end of the frame',
        'stamp_row|time_offset',
        (shifted(_IMAGES, lambda *_: READOUT),),
    ),
    Case('distortion wrong by k1 -0.12', 'distortion', (information(radial=-0.12),)),
    Case('stamps of arrival, 5 ms of jitter', 'jitter', (shifted(_IMAGES, _jitter),)),
    Case('IMU 50 Hz', '', (of(Imu, lambda _, number, *__: None if number % 4 == 0 else False),)),
    Case('IMU 100 ms late', '', (of(Imu, lambda *_: None, 0.1),)),
    Case('IMU in batches of 40', '', (_batched,)),
    Case('mono16', '', (pictured(lambda image: 257 * image.astype(np.uint16), 'mono16'),)),
    Case('16UC1', '', (pictured(lambda image: 257 * image.astype(np.uint16), '16UC1'),)),
    Case('Bayer', '', (pictured(lambda image: image, 'bayer_rggb8'),)),
    Case('JPEG', '', (of(Image, compressed),), {'image_transport': 'compressed'}),
    Case('reliable', '', parameters={'qos_overrides./image.subscription.reliability': 'reliable'}),
    Case('JPEG only, raw configured', 'image_transport', (of(Image, compressed),)),
    Case(
        'QoS that does not match',
        'QoS|qos|reliability',
        parameters={'qos_overrides./image.subscription.durability': 'transient_local'},
    ),
    Case('no CameraInfo', 'CameraInfo|camera_info', (of(CameraInfo, lambda *_: False),)),
    Case(
        'CameraInfo once, latched',
        '',
        (of(CameraInfo, lambda _, number, *__: False if number else None),),
        latched=True,
    ),
    _jumped('clock -50 s', -50.0),
    _jumped('clock +100 s', 100.0),
    _jumped('bag looped', -SECONDS),
    Case('simulated time, with clock', '', (), {'use_sim_time': True}, clock=True),
    Case('simulated time, without clock', '', (), {'use_sim_time': True}),
    Case('5 Hz', '', every=12),
    Case('10 Hz', '', every=6),
    Case('60 Hz', '', every=1),
    Case(
        '30 % of the images dropped',
        '',
        (of(Image, lambda _, number, *__: None if number * 7 % 10 < 7 else False),),
    ),
    Case(
        'image rotated by 90 deg',
        'rotated',
        (pictured(lambda image: np.rot90(image)), of(CameraInfo, _turned)),
    ),
    Case('flipped vertically', 'mirror|upside down', (pictured(lambda image: image[::-1]),)),
    Case('flipped horizontally', 'mirror|upside down', (pictured(lambda image: image[:, ::-1]),)),
    Case('zero stamps, 1 in 6', 'stamp', (of(Image, _zero),)),
    Case(
        'far future, 1 in 3',
        'stamp',
        (shifted(Image, lambda number, _: 0.0 if number % 3 else 1e6),),
    ),
)
# Cases by name.
CASES = {case.name: case for case in _CASES}


def play(
    case: Case, folder: Path
) -> tuple[Path, float, list[PoseWithCovarianceStamped], list[TimeReference], str]:
    """Play a case to a node of its own; the bag is rendered once into `folder`.

    Returns the bag, the first seconds of the words (NaN: never), what was published, and the
    node's last message.
    """
    bag, file = render_once(
        SimulationConfig(
            duration=SECONDS,
            fps=FPS,
            width=480,
            height=360,
            fx=340.0,
            edge_samples=1,
            seed=24,
            plan=f'walk:{SECONDS:g}',
            readout_time=READOUT,
        ),
        folder,
    )
    given = {**file_values(file), 'image_transport': 'raw', **case.parameters}
    values = {
        name: list(value) if isinstance(value, tuple) else value for name, value in given.items()
    }
    named = math.nan
    messages = _messages(bag, case)
    with private_domain(), Graph() as graph, node_process(parameters=values) as node:
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        poses = graph.listen(PoseWithCovarianceStamped, '/relpose_node/relative_pose')
        references = graph.listen(TimeReference, '/relpose_node/reference')
        publishers = _publishers(graph, case, {type(item) for _, item in messages})
        clock = graph.node.create_publisher(Clock, '/clock', 10) if case.clock else None
        node.wait_for('ready: ')
        time.sleep(1.0)
        started = time.monotonic()
        checked = 0.0
        for due, message in [*messages, (SECONDS + 1.5, None)]:
            time.sleep(max(started + due - time.monotonic(), 0.0))
            if message is not None:
                publishers[type(message)].publish(message)
                if clock is not None:
                    clock.publish(Clock(clock=message.header.stamp))
            if case.words and math.isnan(named) and (due > checked + 0.3 or message is None):
                checked = due
                texts = [node.output, *map(str, diagnostics[-2:])]
                if any(re.search(case.words, text) for text in texts):
                    named = due
    last = [status.message for item in diagnostics for status in item.status]
    return bag, named, poses, references, last[-1] if last else ''


def _publishers(graph: Graph, case: Case, kinds: set[type]) -> dict[type, Any]:
    """Publishers of a case by the types of its messages."""
    publishers = {}
    for kind, topic in _TOPICS.items():
        if kind in kinds:
            is_latched = case.latched and kind is CameraInfo
            durability = (
                DurabilityPolicy.TRANSIENT_LOCAL if is_latched else DurabilityPolicy.VOLATILE
            )
            profile = QoSProfile(depth=200, durability=durability)
            publishers[kind] = graph.node.create_publisher(kind, topic, profile)
    return publishers


def _messages(bag: Path, case: Case) -> list[tuple[float, Any]]:
    """Seconds and messages of a case, in their order."""
    sent = []
    counts = dict.fromkeys(_TOPICS, 0)
    with reader.open_bag(bag) as opened:
        first_ns = 0
        image = -1
        for raw in opened.raw_messages(opened.topics):
            kind = {
                sensor_topics.COMPRESSED_IMAGE: CompressedImage,
                sensor_topics.CAMERA_INFO: CameraInfo,
                sensor_topics.IMU: Imu,
            }.get(raw.msgtype)
            if kind is None:
                continue
            first_ns = first_ns or raw.bag_time_ns
            message: Any = deserialize_message(bytes(raw.data), kind)
            image += kind is CameraInfo  # it comes before its image
            if kind is not Imu and image % case.every:
                continue
            if kind is CompressedImage:
                message = gray_image(
                    message.header,
                    np.asarray(
                        cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_GRAYSCALE)
                    ),
                )
            seconds = 1e-9 * (raw.bag_time_ns - first_ns)
            number = counts[type(message)]
            counts[type(message)] += 1
            items = [(seconds, message)]
            for edit in case.edits:
                items = [
                    (at + delay, out)
                    for at, item in items
                    for delay, out in edit(item, number, seconds)
                ]
            sent += items
    return sorted(sent, key=lambda item: item[0])


def pixels_of(message: Image) -> np.ndarray:
    """Of a mono8 image."""
    return np.frombuffer(message.data, np.uint8).reshape(message.height, -1)


def gray_image(header: Any, pixels: np.ndarray, encoding: str = 'mono8') -> Image:
    """An image of pixels."""
    return Image(
        header=header,
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        step=pixels.shape[1] * pixels.itemsize,
        data=array('B', np.ascontiguousarray(pixels).tobytes()),
    )
