"""The bag reader: every storage, the choice of topics, and damage of every kind."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import shutil
import sqlite3
import tempfile

import lz4.frame
import message_builders as build
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, storage_mcap, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

from rs_relpose_ros.bags import limits, reader
from rs_relpose_ros.bags.reader import Bag, open_bag
from rs_relpose_ros.bags.topics import TopicOptions
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.messages.incoming import imu_sample_from_message, intrinsics_from_info

STAMP_NS = 1_700_000_000_123_456_789
IMAGE, INFO, IMU, POSE = (
    'sensor_msgs/msg/Image', 'sensor_msgs/msg/CameraInfo', 'sensor_msgs/msg/Imu',
    'geometry_msgs/msg/PoseStamped')
CAMERA = RollingShutterCamera(width=8, height=6, fx=5.0, fy=5.5, cx=3.5, cy=2.5,
                              readout_time=0.03)
PIXELS = np.arange(48, dtype=np.uint8).reshape(6, 8)
JAZZY = get_typestore(Stores.ROS2_JAZZY)
NOETIC = get_typestore(Stores.ROS1_NOETIC)

SQLITE3, MCAP = StoragePlugin.SQLITE3, StoragePlugin.MCAP
ROSBAG2_KINDS = {
    'sqlite3': (SQLITE3, CompressionMode.NONE),
    'sqlite3_zstd_files': (SQLITE3, CompressionMode.FILE),
    'sqlite3_zstd_messages': (SQLITE3, CompressionMode.MESSAGE),
    'mcap': (MCAP, CompressionMode.NONE),
    'mcap_zstd_files': (MCAP, CompressionMode.FILE),
    'mcap_zstd_messages': (MCAP, CompressionMode.MESSAGE),
    'mcap_zstd_chunks': (MCAP, CompressionMode.STORAGE),
}
ROS1_KINDS = {'ros1': None, 'ros1_lz4': Ros1Writer.CompressionFormat.LZ4,
              'ros1_bz2': Ros1Writer.CompressionFormat.BZ2}


def camera_messages(tmp_path: Path) -> list[tuple[str, str, object, int]]:
    """Topic, type, message and time after STAMP_NS of a short recording, not in order of time."""
    bag = BagWriter(tmp_path / 'never_opened')
    imu = [('/imu', IMU, bag.imu(STAMP_NS + t, 'imu', (0.1 * t, 0.2, 0.3), (0.0, 0.5, 9.8)), t)
           for t in (1, 3, 5, 7)]
    return [
        *imu,
        ('/camera/image_raw', IMAGE, bag.image(STAMP_NS + 4, 'camera', PIXELS), 4),
        ('/camera/camera_info', INFO, bag.camera_info(STAMP_NS + 2, 'camera', CAMERA), 2),
        ('/ground_truth/pose', POSE,
         bag.pose(STAMP_NS + 6, 'world', (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)), 6),
    ]


def write_rosbag2(path: Path, messages: list[tuple[str, str, object, int]],
                  storage: StoragePlugin = MCAP,
                  mode: CompressionMode = CompressionMode.NONE,
                  serialize: Callable[..., bytes] = JAZZY.serialize_cdr) -> Path:
    writer = Writer(path, version=9, storage_plugin=storage)
    if mode is not CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, msgtype, message, time in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=JAZZY)
            writer.write(connections[topic], STAMP_NS + time, serialize(message, msgtype))
    return path


def write_ros1(path: Path, messages: list[tuple[str, str, object, int]],
               compression: Ros1Writer.CompressionFormat | None = None) -> Path:
    writer = Ros1Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connections = {}
        for topic, msgtype, message, time in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=NOETIC)
            writer.write(connections[topic], STAMP_NS + time,
                         NOETIC.serialize_ros1(as_ros1(message), msgtype))
    return path


def as_ros1(message: object) -> object:
    """The message of ROS 1: headers have a number, calibrations capitals."""
    values = {}
    for name, value in vars(message).items():
        if name == '__msgtype__':
            continue
        capital = name.upper() if message.__msgtype__ == INFO and name in 'dkrp' else name
        values[capital] = as_ros1(value) if hasattr(value, '__msgtype__') else value
    if message.__msgtype__ == 'std_msgs/msg/Header':
        values['seq'] = 17
    return NOETIC.types[message.__msgtype__](**values)


def write_kind(kind: str, folder: Path,
               messages: list[tuple[str, str, object, int]] | None = None) -> Path:
    messages = camera_messages(folder) if messages is None else messages
    if kind in ROS1_KINDS:
        return write_ros1(folder / f'{kind}.bag', messages, ROS1_KINDS[kind])
    return write_rosbag2(folder / kind, messages, *ROSBAG2_KINDS[kind])


def read_all(path: Path) -> list[object]:
    with open_bag(path) as bag:
        return list(bag.messages(bag.topics))


def check_content(bag: Bag) -> None:
    topics = bag.find_topics()
    assert (topics.image.name, topics.image.count) == ('/camera/image_raw', 1)
    assert (topics.imu.name, topics.imu.count, topics.accel) == ('/imu', 4, None)
    assert topics.truth is not None and topics.truth.msgtype == POSE
    read = list(bag.messages([topics.image, topics.camera_info, topics.imu, topics.truth]))
    assert [(m.topic, m.bag_time_ns - STAMP_NS) for m in read] == [
        ('/imu', 1), ('/camera/camera_info', 2), ('/imu', 3), ('/camera/image_raw', 4),
        ('/imu', 5), ('/ground_truth/pose', 6), ('/imu', 7)]
    for message in read:
        stamp = message.message.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == message.bag_time_ns
    sample = imu_sample_from_message(read[2].message)
    assert sample.angular_velocity == (pytest.approx(0.3), 0.2, 0.3)
    assert sample.linear_acceleration == (0.0, 0.5, 9.8)
    calibration = intrinsics_from_info(read[1].message)
    assert (calibration.fx, calibration.cy, calibration.distortion) == (5.0, 2.5, (0.0,) * 5)
    np.testing.assert_array_equal(read[3].message.data.reshape(6, 8), PIXELS)
    for array in (read[3].message.data, read[2].message.orientation_covariance):
        assert not array.flags.writeable
    assert read[5].message.pose.position.z == 3.0


# --- storages


@pytest.mark.parametrize('kind', [*ROSBAG2_KINDS, *ROS1_KINDS])
def test_every_storage_gives_the_same(tmp_path, kind):
    with open_bag(write_kind(kind, tmp_path)) as bag:
        check_content(bag)


@pytest.mark.parametrize('kind, suffix', [
    ('mcap', 'mcap'), ('mcap_zstd_chunks', 'mcap'), ('sqlite3', 'db3')])
def test_a_storage_file_alone(tmp_path, kind, suffix):
    file, = write_kind(kind, tmp_path).glob(f'*.{suffix}')
    alone = shutil.copy(file, tmp_path / f'alone.{suffix}')
    with open_bag(str(alone)) as bag:
        check_content(bag)


@pytest.mark.parametrize('kind', ['sqlite3', 'mcap', 'mcap_zstd_messages', 'ros1_lz4'])
def test_raw_messages_are_cdr_of_ros_2(tmp_path, kind):
    expected = {STAMP_NS + time: bytes(JAZZY.serialize_cdr(message, msgtype))
                for _, msgtype, message, time in camera_messages(tmp_path)}
    with open_bag(write_kind(kind, tmp_path)) as bag:
        raw = list(bag.raw_messages(bag.topics))
    assert [m.bag_time_ns - STAMP_NS for m in raw] == [1, 2, 3, 4, 5, 6, 7]
    for message in raw:
        assert type(message.data) is bytes
        assert message.data == expected[message.bag_time_ns]
    assert (raw[1].topic, raw[1].msgtype) == ('/camera/camera_info', INFO)


def test_a_type_of_ros_1_alone_cannot_be_published(tmp_path):
    with Ros1Writer(tmp_path / 'a.bag') as writer:
        log = NOETIC.types['rosgraph_msgs/msg/Log']
        stamp = NOETIC.types['builtin_interfaces/msg/Time'](sec=1, nanosec=2)
        message = log(header=NOETIC.types['std_msgs/msg/Header'](0, stamp, ''), level=1, name='n',
                      msg='m', file='f', function='g', line=3, topics=[])
        writer.write(writer.add_connection('/rosout', log.__msgtype__, typestore=NOETIC), 5,
                     NOETIC.serialize_ros1(message, log.__msgtype__))
    with open_bag(tmp_path / 'a.bag') as bag, pytest.raises(InputError, match='leave it out'):
        list(bag.raw_messages(bag.topics))


def test_no_topics_no_messages(tmp_path):
    with open_bag(write_kind('mcap', tmp_path)) as bag:
        assert list(bag.messages([])) == []


# --- choice of topics


def topics_bag(tmp_path: Path, *topics: tuple[str, str]) -> Path:
    """A bag with a message on each of `topics` (name, type)."""
    by_type = {msgtype: message for _, msgtype, message, _ in camera_messages(tmp_path)}
    by_type['sensor_msgs/msg/CompressedImage'] = build.compressed(build.rosbags_types, b'')
    return write_rosbag2(tmp_path / 'topics', [
        (name, msgtype, by_type[msgtype], time) for time, (name, msgtype) in enumerate(topics)])


def found(path: Path, **options: str) -> dict[str, str]:
    with open_bag(path) as bag:
        topics = bag.find_topics(TopicOptions(**options))
    return {role: topic.name for role in ('image', 'camera_info', 'imu', 'accel', 'truth')
            if (topic := getattr(topics, role)) is not None}


def refusal(path: Path, kind: type[RsRelposeError], **options: str) -> str:
    with pytest.raises(RsRelposeError) as caught:
        found(path, **options)
    assert type(caught.value) is kind
    assert '\n' not in str(caught.value)
    return str(caught.value)


def test_realsense_publishes_gyro_and_accelerometer_apart(tmp_path):
    path = topics_bag(
        tmp_path, ('/camera/accel/sample', IMU), ('/camera/gyro/sample', IMU),
        ('/camera/color/image_raw/compressed', 'sensor_msgs/msg/CompressedImage'),
        ('/camera/color/camera_info', INFO), ('/camera/depth/camera_info', INFO))
    assert found(path) == {
        'image': '/camera/color/image_raw/compressed', 'camera_info': '/camera/color/camera_info',
        'imu': '/camera/gyro/sample', 'accel': '/camera/accel/sample'}
    gyro_only = found(path, imu='/camera/gyro/sample')
    assert gyro_only['imu'] == '/camera/gyro/sample' and 'accel' not in gyro_only
    assert found(path, accel='/camera/accel/sample') == found(path)


def test_several_candidates_are_listed_with_the_option(tmp_path):
    path = topics_bag(tmp_path, ('/left', IMAGE), ('/right', IMAGE), ('/a/info', INFO),
                      ('/b/info', INFO), ('/imu0', IMU), ('/imu1', IMU))
    text = refusal(path, InputError)
    assert all(word in text for word in ('--image-topic', '/left', '/right', IMAGE))
    text = refusal(path, InputError, image='/left', imu='/imu0')
    assert all(word in text for word in ('--camera-info-topic', '/a/info', '/b/info'))
    text = refusal(path, InputError, image='/left', camera_info='/a/info')
    assert all(word in text for word in ('--imu-topic', '--accel-topic', '/imu0', '/imu1'))
    chosen = {'image': '/left', 'camera_info': '/b/info', 'imu': '/imu1'}
    assert found(path, **chosen) == chosen
    # As people type it.
    assert found(path, **{role: name[1:] for role, name in chosen.items()}) == chosen


@pytest.mark.parametrize('absent, named', [
    ('/image', 'image topic'), ('/info', 'CameraInfo topic'), ('/imu', 'IMU topic')])
def test_an_absent_topic_is_named_with_those_there_are(tmp_path, absent, named):
    there = [(name, msgtype) for name, msgtype in (
        ('/image', IMAGE), ('/info', INFO), ('/imu', IMU)) if name != absent]
    text = refusal(topics_bag(tmp_path, *there), MissingInputError)
    assert f'has no {named}' in text
    assert all(f'{name} ({msgtype})' in text for name, msgtype in there)


def test_wrong_choices(tmp_path):
    path = topics_bag(tmp_path, ('/image', IMAGE), ('/info', INFO), ('/imu', IMU))
    text = refusal(path, MissingInputError, image='/picture')
    assert all(word in text for word in ('/picture', '--image-topic', '/image'))
    text = refusal(path, InputError, imu='/info')
    assert all(word in text for word in ('/info', '--imu-topic', IMU, INFO))
    text = refusal(path, InputError, truth='/imu')
    assert POSE in text and '--truth-topic' in text


def test_rectified_images_are_refused(tmp_path):
    path = topics_bag(tmp_path, ('/camera/image_rect', IMAGE), ('/info', INFO), ('/imu', IMU))
    assert 'rectified' in refusal(path, InputError)


def test_truth_is_that_of_the_project_among_several(tmp_path, caplog):
    sensors = ('/image', IMAGE), ('/info', INFO), ('/imu', IMU)
    path = topics_bag(tmp_path, *sensors, ('/goal', POSE), ('/ground_truth/pose', POSE))
    assert found(path)['truth'] == '/ground_truth/pose'
    assert found(path, truth='/goal')['truth'] == '/goal'
    shutil.rmtree(path)
    assert 'truth' not in found(topics_bag(tmp_path, *sensors, ('/goal', POSE), ('/home', POSE)))
    assert '--truth-topic' in caplog.text


def test_an_announced_topic_without_messages_is_none(tmp_path):
    with Writer(tmp_path / 'bag', version=9, storage_plugin=MCAP) as writer:
        writer.add_connection('/image', IMAGE, typestore=JAZZY)
    assert 'has no image topic' in refusal(tmp_path / 'bag', MissingInputError)
    assert 'no messages' in refusal(tmp_path / 'bag', MissingInputError, image='/image')


def test_an_empty_bag(tmp_path):
    with Writer(tmp_path / 'bag', version=9, storage_plugin=MCAP):
        pass
    assert 'no topics at all' in refusal(tmp_path / 'bag', MissingInputError)


# --- what is no bag, or not a whole one


def storage_file(bag: Path) -> Path:
    return next(file for file in sorted(bag.iterdir()) if file.name != 'metadata.yaml')


def recorder_killed(folder: Path) -> Path:
    bag = write_kind('mcap', folder)
    (bag / 'metadata.yaml').unlink()
    return bag


def file_of(name: str, data: bytes = np.random.default_rng(1).bytes(4096)
            ) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(data)
        return folder / name
    return make


def truncated(kind: str, keep: float) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        bag = write_kind(kind, folder)
        file = storage_file(bag) if bag.is_dir() else bag
        data = file.read_bytes()
        file.write_bytes(data[:int(keep * len(data))])
        return bag
    return make


def impossible_chunk(folder: Path) -> Path:
    file = storage_file(write_kind('mcap_zstd_chunks', folder))
    data = bytearray(file.read_bytes())
    # After the magic and the header record: opcode, length, start and end time, then the size.
    at = 8 + 9 + int.from_bytes(data[9:17], 'little')
    assert data[at] == 0x06
    data[at + 25:at + 33] = (1 << 50).to_bytes(8, 'little')
    file.write_bytes(data)
    return file


def metadata(change: Callable[[str], str]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        bag = write_kind('mcap', folder)
        text = (bag / 'metadata.yaml').read_text()
        assert change(text) != text
        (bag / 'metadata.yaml').write_text(change(text))
        return bag
    return make


def metadata_with(old: str, new: str) -> Callable[[Path], Path]:
    return metadata(lambda text: text.replace(old, new, 1))


def no_storage(folder: Path) -> Path:
    bag = write_kind('mcap', folder)
    storage_file(bag).unlink()
    return bag


@pytest.mark.parametrize('make, kind, words', [
    (lambda folder: folder / 'absent', MissingInputError, 'there is no bag'),
    (lambda folder: folder, InputError, 'is no bag: it has no metadata.yaml'),
    (recorder_killed, InputError, 'not stopped properly'),
    (file_of('notes.txt'), InputError, 'is no bag: give'),
    (file_of('a.mcap', b''), InputError, 'is empty'),
    (file_of('a.db3', b''), InputError, 'is empty'),
    (file_of('a.bag', b''), InputError, 'is empty'),
    (file_of('a.mcap'), InputError, 'is no MCAP file'),
    (file_of('a.db3'), InputError, 'no bag'),
    (file_of('a.bag'), InputError, 'is no ROS 1 bag'),
    (truncated('mcap', 0.9), InputError, 'is truncated at byte'),
    (truncated('mcap', 0.5), InputError, 'is truncated at byte'),
    (truncated('mcap', 0.01), InputError, 'is truncated at byte'),
    (truncated('mcap_zstd_chunks', 0.5), InputError, 'is truncated at byte'),
    (truncated('mcap_zstd_files', 0.5), InputError, 'is damaged'),
    (truncated('sqlite3', 0.5), InputError, 'is damaged'),
    (truncated('sqlite3_zstd_files', 0.5), InputError, 'is damaged'),
    (truncated('ros1', 0.7), InputError, 'is truncated or damaged'),
    (truncated('ros1', 0.3), InputError, 'is truncated or damaged'),
    (truncated('ros1_lz4', 0.3), InputError, 'is truncated or damaged'),
    (impossible_chunk, InputError, 'impossible size'),
    (metadata(lambda _: ''), InputError, 'is damaged'),
    (metadata(lambda _: 'a: [1'), InputError, 'is damaged'),
    (metadata(lambda _: 'rosbag2_bagfile_information: {version: 99}'), InputError, 'is damaged'),
    (metadata_with('message_count: 4', 'message_count: many'), InputError, 'is damaged'),
    (metadata_with('name: /imu', 'name: 17'), InputError, 'is damaged'),
    (metadata_with('name: /imu', 'name: "/im\\nu"'), InputError, 'is damaged'),
    (no_storage, InputError, 'is damaged'),
])
def test_bad_bags_are_told_in_one_sentence(tmp_path, make, kind, words):
    path = make(tmp_path)
    with pytest.raises(RsRelposeError) as caught:
        read_all(path)
    text = str(caught.value)
    assert type(caught.value) is kind
    assert words in text
    assert str(path) in text
    assert '\n' not in text


@pytest.mark.parametrize('kind', ['mcap', 'mcap_zstd_chunks', 'sqlite3', 'sqlite3_zstd_messages',
                                  'mcap_zstd_files', 'ros1', 'ros1_lz4'])
def test_random_damage_is_never_a_traceback(tmp_path, kind):
    bag = write_kind(kind, tmp_path)
    file = storage_file(bag) if bag.is_dir() else bag
    whole = file.read_bytes()
    rng = np.random.default_rng(7)
    refused = 0
    for trial in range(30):
        data = bytearray(whole)
        if trial % 2:
            at = int(rng.integers(len(data)))
            data[at:at + 8] = rng.bytes(8)
        else:
            del data[int(rng.integers(len(data))):]
        file.write_bytes(data)
        try:
            read_all(bag)
        except InputError:
            refused += 1
    # A cut is always seen; a change only where there is structure or a checksum.
    assert refused >= 15


def test_a_corrupt_message_names_its_topic(tmp_path):
    bag = write_rosbag2(tmp_path / 'bag', camera_messages(tmp_path),
                        serialize=lambda *given: bytes(JAZZY.serialize_cdr(*given))[:40])
    with pytest.raises(InputError, match=f'a message of /imu in .* is corrupt, it is no {IMU}'):
        read_all(bag)


def test_an_array_longer_than_its_message(tmp_path):
    def boast(message, msgtype):
        data = bytearray(JAZZY.serialize_cdr(message, msgtype))
        if msgtype == IMAGE:
            data[-52:-48] = (2**31).to_bytes(4, 'little')
            assert len(data) < 200
        return data

    bag = write_rosbag2(tmp_path / 'bag', camera_messages(tmp_path), serialize=boast)
    with pytest.raises(InputError, match=r'a message of /camera/image_raw in .* is corrupt'):
        read_all(bag)


def test_a_message_beyond_any_image_is_not_decoded(tmp_path, monkeypatch):
    bag = write_kind('mcap', tmp_path)
    monkeypatch.setattr(reader, 'MAX_MESSAGE_BYTES', 200)
    with pytest.raises(InputError, match='at most 200 are read'):
        read_all(bag)


# --- definitions of types, which are not read

# An expression in IDL: of any size, or with brackets that take the parser any time.
EXPRESSIONS = ['const unsigned long X = 1 << 80000000000;', f'const long X = {"(" * 9}1{")" * 9};']


@pytest.mark.parametrize('definition', [
    *(f'module a {{ module msg {{ {line} struct B {{ long y; }}; }}; }};' for line in EXPRESSIONS),
    '((('])
@pytest.mark.timeout(30)
def test_a_definition_is_not_read(tmp_path, definition):
    """Also that of a topic which is not asked for would have kept the bag shut."""
    bag = write_kind('sqlite3', tmp_path)
    [file] = bag.glob('*.db3')
    with sqlite3.connect(file) as base:
        changed = base.execute(
            "UPDATE message_definitions SET encoding = 'ros2idl', encoded_message_definition = ?",
            (definition,)).rowcount
    base.close()
    assert changed == 4
    assert len(read_all(bag)) == 7


def test_a_type_with_other_fields_is_told(tmp_path):
    """By its hash, which recorders write from Iron on."""
    bag = write_kind('mcap', tmp_path)
    text = (bag / 'metadata.yaml').read_text()
    known = JAZZY.hash_rihs01(IMU)
    assert known in text
    storage = storage_file(bag)
    other = known[:-4] + 'beef'
    storage.write_bytes(storage.read_bytes().replace(known.encode(), other.encode()))
    (bag / 'metadata.yaml').write_text(text.replace(known, other))
    with pytest.raises(InputError, match=f"topic /imu of .* is of another {IMU} .*beef'$"):
        read_all(bag)


def test_a_definition_of_ros_1_that_takes_any_time_or_memory(tmp_path):
    """An array of messages without fields has no bytes, whatever its length."""
    writer = Ros1Writer(tmp_path / 'bag.bag')
    definition = f'std_msgs/Empty[4000000000] nothing\n{"=" * 80}\nMSG: std_msgs/Empty\n'
    with writer:
        connection = writer.add_connection('/imu', IMU, msgdef=definition, md5sum='0' * 32)
        writer.write(connection, STAMP_NS, b'')
    with pytest.raises(InputError, match='is of another sensor_msgs/msg/Imu than that of ROS 1'):
        read_all(tmp_path / 'bag.bag')


# --- sizes that a bag makes of itself


def bomb(kind: str, folder: Path) -> Path:
    """A bag of some kB with a compressed message or chunk that has many MB."""
    zeros = np.zeros((4096, 4096), dtype=np.uint8)
    bag = write_kind(kind, folder, [*camera_messages(folder), (
        '/camera/image_raw', IMAGE, BagWriter(folder / 'no_bag').image(STAMP_NS, 'c', zeros), 8)])
    files = [bag] if bag.is_file() else bag.iterdir()
    assert sum(file.stat().st_size for file in files) < 200_000
    return bag


@pytest.mark.parametrize('kind, limit', [
    ('sqlite3_zstd_messages', 'MAX_MESSAGE_BYTES'), ('mcap_zstd_messages', 'MAX_MESSAGE_BYTES'),
    ('mcap_zstd_chunks', 'MAX_CHUNK_BYTES'), ('ros1_lz4', 'MAX_CHUNK_BYTES'),
    ('ros1_bz2', 'MAX_CHUNK_BYTES')])
def test_decompression_is_bounded(tmp_path, monkeypatch, kind, limit):
    bag = bomb(kind, tmp_path)
    assert len(read_all(bag)) == 8
    monkeypatch.setattr(limits, limit, 1 << 20)
    with pytest.raises(InputError, match='bytes decompress to more than 1048576'):
        read_all(bag)


@pytest.mark.parametrize('kind', ['sqlite3_zstd_files', 'mcap_zstd_files'])
def test_decompression_of_files_is_bounded(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path / 'temporary'))
    (tmp_path / 'temporary').mkdir()
    bag = bomb(kind, tmp_path)
    assert len(read_all(bag)) == 8
    # And 200 times what the file has, some MB here.
    monkeypatch.setattr(limits, 'MAX_FILE_BYTES', 1 << 20)
    with pytest.raises(InputError, match=r'bytes decompress to more than \d+$'):
        read_all(bag)
    assert not list((tmp_path / 'temporary').iterdir())


def test_a_chunk_never_becomes_larger_than_it_says(tmp_path):
    """What its head says is checked before, so no bigger one may hide behind it."""
    with pytest.raises(InputError, match='decompress to more than 100'):
        storage_mcap.DECOMPRESSORS['zstd'](storage_mcap.zstd.compress(bytes(10**8)), 100)
    for name, data in (('zstd', storage_mcap.zstd.compress(bytes(100))),
                       ('lz4', lz4.frame.compress(bytes(100)))):
        assert storage_mcap.DECOMPRESSORS[name](data, 100) == bytes(100)
        with pytest.raises(InputError, match='incomplete'):
            storage_mcap.DECOMPRESSORS[name](data[:-6], 100)


def test_metadata_with_aliases_of_aliases(tmp_path):
    """Printed in an error they would have no end."""
    bag = write_kind('mcap', tmp_path)
    laughs = ''.join(f'l{k + 1}: &l{k + 1} [{", ".join([f"*l{k}"] * 9)}]\n' for k in range(12))
    (bag / 'metadata.yaml').write_text(
        f'l0: &l0 ha\n{laughs}rosbag2_bagfile_information: {{version: 9, '
        'relative_file_paths: [], storage_identifier: *l12}')
    with pytest.raises(InputError, match='YAML aliases'):
        read_all(bag)
    (bag / 'metadata.yaml').write_text('#' * (2**24 + 1))
    with pytest.raises(InputError, match='more than 16777216 bytes'):
        read_all(bag)
