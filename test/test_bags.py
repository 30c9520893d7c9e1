"""The bag reader: every storage, the choice of topics, and damage of every kind."""

from collections.abc import Callable
from pathlib import Path
import shutil
import sqlite3
import tempfile

import bag_kinds
from bag_kinds import IMAGE, IMU, INFO, JAZZY, NOETIC, POSE, STAMP_NS, storage_file, write_kind
import lz4.frame
import message_builders as build
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
import yaml

from rs_relpose_ros.bags import files, storage
from rs_relpose_ros.bags.reader import Bag, open_bag
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
from rs_relpose_ros.messages.camera_info import intrinsics_from_info
from rs_relpose_ros.messages.incoming import imu_sample_from_message


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
        ('/imu', 1),
        ('/camera/camera_info', 2),
        ('/imu', 3),
        ('/camera/image_raw', 4),
        ('/imu', 5),
        ('/ground_truth/pose', 6),
        ('/imu', 7),
    ]
    for message in read:
        stamp = message.message.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == message.bag_time_ns
    sample = imu_sample_from_message(read[2].message)
    assert sample.angular_velocity == (pytest.approx(0.3), 0.2, 0.3)
    assert sample.linear_acceleration == (0.0, 0.5, 9.8)
    calibration = intrinsics_from_info(read[1].message)
    assert (calibration.fx, calibration.cy, calibration.distortion) == (5.0, 2.5, (0.0,) * 5)
    np.testing.assert_array_equal(read[3].message.data.reshape(6, 8), bag_kinds.PIXELS)
    for array in (read[3].message.data, read[2].message.orientation_covariance):
        assert not array.flags.writeable
    assert read[5].message.pose.position.z == 3.0


# --- storages


@pytest.mark.parametrize('kind', bag_kinds.KINDS)
def test_every_storage_gives_the_same(tmp_path, kind):
    expected = {
        STAMP_NS + time: bytes(JAZZY.serialize_cdr(message, msgtype))
        for _, msgtype, message, time in bag_kinds.camera_messages()
    }
    bag = write_kind(kind, tmp_path)
    with open_bag(bag) as opened:
        check_content(opened)
        raw = list(opened.raw_messages(opened.topics))
    # CDR of ROS 2, from ROS 1, too.
    assert [m.bag_time_ns - STAMP_NS for m in raw] == [1, 2, 3, 4, 5, 6, 7]
    for message in raw:
        assert type(message.data) is bytes
        assert message.data == expected[message.bag_time_ns]
    assert (raw[1].topic, raw[1].msgtype) == ('/camera/camera_info', INFO)
    if kind in ('mcap', 'mcap_zstd_chunks', 'sqlite3'):
        file = storage_file(bag)
        with open_bag(str(shutil.copy(file, tmp_path / f'alone{file.suffix}'))) as opened:
            check_content(opened)


def test_a_type_of_ros_1_alone_cannot_be_published(tmp_path):
    with Ros1Writer(tmp_path / 'a.bag') as writer:
        log = NOETIC.types['rosgraph_msgs/msg/Log']
        stamp = NOETIC.types['builtin_interfaces/msg/Time'](sec=1, nanosec=2)
        message = log(
            header=NOETIC.types['std_msgs/msg/Header'](0, stamp, ''),
            level=1,
            name='n',
            msg='m',
            file='f',
            function='g',
            line=3,
            topics=[],
        )
        writer.write(
            writer.add_connection('/rosout', log.__msgtype__, typestore=NOETIC),
            5,
            NOETIC.serialize_ros1(message, log.__msgtype__),
        )
    with open_bag(tmp_path / 'a.bag') as bag, pytest.raises(InputError, match='leave it out'):
        list(bag.raw_messages(bag.topics))


# --- choice of topics

COMPRESSED = 'sensor_msgs/msg/CompressedImage'
SENSORS = (('/image', IMAGE), ('/info', INFO), ('/imu', IMU))


def topics_bag(folder: Path, *topics: tuple[str, str]) -> Path:
    """A bag with a message on each of `topics` (name, type)."""
    by_type = {msgtype: message for _, msgtype, message, _ in bag_kinds.camera_messages()}
    by_type[COMPRESSED] = build.compressed(build.rosbags_types, b'')
    return write_kind(
        'mcap',
        folder,
        [(name, msgtype, by_type[msgtype], time) for time, (name, msgtype) in enumerate(topics)],
    )


def test_progress_counts_the_messages_that_are_read(tmp_path):
    with open_bag(topics_bag(tmp_path / 'bag', *SENSORS)) as bag:
        names: list[str] = []
        bag.on_message = names.append
        list(bag.messages([bag.find_topics().imu]))
        list(bag.raw_messages(bag.topics))
    assert names == ['/imu', *(name for name, _ in SENSORS)]


def found(path: Path, **options: str) -> dict[str, str]:
    with open_bag(path) as bag:
        topics = bag.find_topics(options)
    return {
        role: topic.name
        for role in ('image', 'camera_info', 'imu', 'accel', 'truth')
        if (topic := getattr(topics, role)) is not None
    }


def check_refusal(
    path: Path, kind: type[RsRelposeError], words: tuple[str, ...], **options: str
) -> None:
    with pytest.raises(RsRelposeError) as caught:
        found(path, **options)
    assert type(caught.value) is kind
    assert '\n' not in str(caught.value)
    assert all(word in str(caught.value) for word in words)


def test_realsense_publishes_gyro_and_accelerometer_separately(tmp_path):
    path = topics_bag(
        tmp_path,
        ('/camera/accel/sample', IMU),
        ('/camera/gyro/sample', IMU),
        ('/camera/color/image_raw/compressed', COMPRESSED),
        ('/camera/color/camera_info', INFO),
        ('/camera/depth/camera_info', INFO),
    )
    assert found(path) == {
        'image': '/camera/color/image_raw/compressed',
        'camera_info': '/camera/color/camera_info',
        'imu': '/camera/gyro/sample',
        'accel': '/camera/accel/sample',
    }
    gyro_only = found(path, imu='/camera/gyro/sample')
    assert gyro_only['imu'] == '/camera/gyro/sample' and 'accel' not in gyro_only
    assert found(path, accel='/camera/accel/sample') == found(path)


SEVERAL = (
    ('/left', IMAGE),
    ('/right', IMAGE),
    ('/a/info', INFO),
    ('/b/info', INFO),
    ('/imu0', IMU),
    ('/imu1', IMU),
)


def test_a_choice_among_several_with_or_without_the_slash(tmp_path):
    path = topics_bag(tmp_path, *SEVERAL)
    chosen = {'image': '/left', 'camera_info': '/b/info', 'imu': '/imu1'}
    assert found(path, **chosen) == chosen
    assert found(path, **{role: name[1:] for role, name in chosen.items()}) == chosen


@pytest.mark.parametrize(
    'topics, options, kind, words',
    [
        (SEVERAL, {}, InputError, ('--image-topic', '/left', '/right', IMAGE)),
        (
            SEVERAL,
            {'image': '/left', 'imu': '/imu0'},
            InputError,
            ('--camera-info-topic', '/a/info', '/b/info'),
        ),
        (
            SEVERAL,
            {'image': '/left', 'camera_info': '/a/info'},
            InputError,
            ('--imu-topic', '--accel-topic', '/imu0', '/imu1'),
        ),
        *(
            (
                SENSORS[:k] + SENSORS[k + 1 :],
                {},
                MissingInputError,
                (
                    f'has no {name} topic',
                    *(
                        f'{other} ({msgtype})'
                        for other, msgtype in (SENSORS[:k] + SENSORS[k + 1 :])
                    ),
                ),
            )
            for k, name in enumerate(('image', 'CameraInfo', 'IMU'))
        ),
        (
            SENSORS,
            {'image': '/picture'},
            MissingInputError,
            ('/picture', '--image-topic', '/image'),
        ),
        (SENSORS, {'imu': '/info'}, InputError, ('/info', '--imu-topic', IMU, INFO)),
        (SENSORS, {'truth': '/imu'}, InputError, (POSE, '--truth-topic')),
        ((('/image_rect', IMAGE), *SENSORS[1:]), {}, InputError, ('rectified',)),
    ],
)
def test_topics_that_cannot_be_used(tmp_path, topics, options, kind, words):
    """Several candidates are listed with their option, and for an absent topic all there are."""
    check_refusal(topics_bag(tmp_path, *topics), kind, words, **options)


def test_ground_truth_is_that_of_the_project_among_several(tmp_path, caplog):
    path = topics_bag(tmp_path, *SENSORS, ('/goal', POSE), ('/ground_truth/pose', POSE))
    assert found(path)['truth'] == '/ground_truth/pose'
    assert found(path, truth='/goal')['truth'] == '/goal'
    shutil.rmtree(path)
    assert 'truth' not in found(topics_bag(tmp_path, *SENSORS, ('/goal', POSE), ('/home', POSE)))
    assert '--truth-topic' in caplog.text


def test_topics_without_messages(tmp_path):
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection('/image', IMAGE, typestore=JAZZY)
    check_refusal(tmp_path / 'bag', MissingInputError, ('has no image topic',))
    check_refusal(tmp_path / 'bag', MissingInputError, ('no messages',), image='/image')
    empty = write_kind('mcap', tmp_path, [])
    check_refusal(empty, MissingInputError, ('no topics at all',))
    assert read_all(empty) == []


# --- what is no bag, or not a complete one


def recorder_killed(folder: Path) -> Path:
    bag = write_kind('mcap', folder)
    (bag / 'metadata.yaml').unlink()
    return bag


def file_of(
    name: str, data: bytes = np.random.default_rng(1).bytes(4096)
) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(data)
        return folder / name

    return make


def truncated(kind: str, keep: float) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        bag = write_kind(kind, folder)
        data = storage_file(bag).read_bytes()
        storage_file(bag).write_bytes(data[: int(keep * len(data))])
        return bag

    return make


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


def aliases_of_aliases(_: str) -> str:
    """Printed in an error they would have no end."""
    laughs = ''.join(f'l{k + 1}: &l{k + 1} [{", ".join([f"*l{k}"] * 9)}]\n' for k in range(12))
    return (
        f'l0: &l0 ha\n{laughs}rosbag2_bagfile_information: {{version: 9, '
        'relative_file_paths: [], storage_identifier: *l12}'
    )


def no_storage(folder: Path) -> Path:
    bag = write_kind('mcap', folder)
    storage_file(bag).unlink()
    return bag


def renamed(folder: Path) -> Path:
    bag = write_kind('mcap', folder)
    storage_file(bag).rename(bag / 'run_3.mcap')
    return bag


def split(folder: Path) -> Path:
    """Three files, of which the second one has one message, and the metadata of all."""
    bag = folder / 'split'
    messages = sorted(bag_kinds.camera_messages(), key=lambda entry: entry[3])
    listed = []
    parts = []
    for number, part in ((1, messages[:3]), (2, messages[3:4]), (10, messages[4:])):
        made = write_kind('mcap', folder, part)
        bag.mkdir(exist_ok=True)
        name = f'part_{number}.mcap'
        storage_file(made).rename(bag / name)
        shutil.rmtree(made)
        listed.append(name)
        parts.append(
            {
                'path': name,
                'starting_time': {'nanoseconds_since_epoch': STAMP_NS + part[0][3]},
                'duration': {'nanoseconds': part[-1][3] - part[0][3]},
                'message_count': len(part),
            }
        )
    information = {'version': 9, 'relative_file_paths': listed, 'files': parts}
    (bag / 'metadata.yaml').write_text(yaml.dump({'rosbag2_bagfile_information': information}))
    return bag


def part_missing(folder: Path) -> Path:
    bag = split(folder)
    (bag / 'part_2.mcap').unlink()
    return bag


def closed_by_nobody(folder: Path) -> Path:
    """As a recorder of ROS 1 leaves a bag that it has not closed: its index is missing."""
    bag = write_kind('ros1', folder)
    data = bytearray(bag.read_bytes())
    at = data.index(b'index_pos=') + len(b'index_pos=')
    data[at : at + 8] = bytes(8)
    (folder / 'ros1.bag.active').write_bytes(data)
    return folder / 'ros1.bag.active'


@pytest.mark.parametrize(
    'make, warning',
    [
        (recorder_killed, 'has no metadata.yaml'),
        (metadata(lambda _: ''), 'metadata.yaml is empty'),
        (metadata(lambda _: 'a: [1'), 'metadata.yaml is no metadata of a bag'),
        (metadata(lambda _: '[1, 2]'), 'metadata.yaml is no metadata of a bag'),
        (metadata(lambda _: 'rosbag2_bagfile_information: {version: 99}'), 'is no metadata'),
        (metadata(aliases_of_aliases), 'YAML aliases'),
        (metadata(lambda _: '#' * (2**24 + 1)), 'more than 16777216 bytes'),
        (metadata_with('message_count: 4', 'message_count: many'), ''),
        (metadata_with('name: /imu', 'name: 17'), ''),
        (metadata_with('storage_identifier: mcap', "storage_identifier: ''"), ''),
        (renamed, 'names mcap.mcap, and run_3.mcap is there: it is read as a renamed file'),
        (split, ''),
    ],
)
def test_files_are_read_without_the_help_of_metadata(tmp_path, caplog, make, warning):
    bag = make(tmp_path)
    with open_bag(bag) as opened:
        check_content(opened)
    assert warning in caplog.text
    assert bool(warning) is bool(caplog.text)
    if warning:
        assert f'"ros2 bag reindex {bag}"' in caplog.text and caplog.text.count('\n') == 1


def test_what_a_killed_recorder_has_not_folded_into_its_database_is_read(tmp_path):
    bag = storage_file(write_kind('sqlite3', tmp_path))
    base = sqlite3.connect(bag)
    base.execute('PRAGMA journal_mode = WAL')
    base.execute('PRAGMA wal_autocheckpoint = 0')
    base.execute('UPDATE messages SET timestamp = timestamp WHERE id = 1')
    base.execute('INSERT INTO messages SELECT id + 100, topic_id, timestamp, data FROM messages')
    base.commit()
    killed = tmp_path / 'killed'
    killed.mkdir()
    for name in (bag.name, f'{bag.name}-wal'):
        shutil.copy(bag.with_name(name), killed / name)
    base.close()
    before = (killed / f'{bag.name}-wal').read_bytes()
    assert before
    assert len(read_all(killed / bag.name)) == 14
    assert len(read_all(killed)) == 14
    assert (killed / f'{bag.name}-wal').read_bytes() == before
    (killed / f'{bag.name}-wal').write_bytes(b'no log')
    with pytest.raises(InputError, match=f'its last messages are in {bag.name}-wal, which is'):
        read_all(killed)


SUFFIXES = 'mcap', 'db3', 'bag'


@pytest.mark.parametrize(
    'make, kind, words',
    [
        (lambda folder: folder / 'absent', MissingInputError, 'there is no bag'),
        (lambda folder: folder, InputError, 'is no bag: it has no metadata.yaml'),
        (file_of('notes.txt'), InputError, 'is no bag: give'),
        *((file_of(f'a.{suffix}', b''), InputError, 'is truncated') for suffix in SUFFIXES),
        *((file_of(f'a.{suffix}'), InputError, 'or no bag') for suffix in SUFFIXES),
        *(
            (truncated(*cut), InputError, 'if it is truncated, copy it again, or "mcap recover ')
            for cut in (('mcap', 0.9), ('mcap', 0.5), ('mcap', 0.01), ('mcap_zstd_chunks', 0.5))
        ),
        *(
            (truncated(kind, 0.5), InputError, 'is damaged')
            for kind in ('mcap_zstd_files', 'sqlite3', 'sqlite3_zstd_files')
        ),
        *(
            (truncated(*cut), InputError, 'is truncated or damaged')
            for cut in (('ros1', 0.7), ('ros1', 0.3), ('ros1_lz4', 0.3))
        ),
        (no_storage, InputError, 'is damaged'),
        (part_missing, InputError, 'of its 3 files part_2.mcap (0.0 s from 0.0 s on, 1 messages)'),
        (closed_by_nobody, InputError, '"rosbag reindex ros1.bag.active"'),
    ],
)
def test_bad_bags_are_refused_in_one_line(tmp_path, make, kind, words):
    path = make(tmp_path)
    with pytest.raises(RsRelposeError) as caught:
        read_all(path)
    text = str(caught.value)
    assert type(caught.value) is kind
    assert words in text
    assert str(path) in text
    assert '\n' not in text


def first_bytes(message: object, msgtype: str) -> bytes:
    return bytes(JAZZY.serialize_cdr(message, msgtype))[:40]


def array_longer_than_its_message(message: object, msgtype: str) -> bytes:
    data = bytearray(JAZZY.serialize_cdr(message, msgtype))
    if msgtype == IMAGE:
        data[-52:-48] = (2**31).to_bytes(4, 'little')
        assert len(data) < 200
    return data


@pytest.mark.parametrize(
    'serialize, text',
    [
        (first_bytes, f'a message of /imu in .* is corrupt, it is no {IMU}'),
        (array_longer_than_its_message, r'a message of /camera/image_raw in .* is corrupt'),
    ],
)
def test_a_corrupt_message_names_its_topic(tmp_path, serialize, text):
    with pytest.raises(InputError, match=text):
        read_all(write_kind('mcap', tmp_path, serialize=serialize))


# --- definitions of types, which are not read

# An expression in IDL: of any size, or with brackets that take the parser any time.
EXPRESSIONS = ['const unsigned long X = 1 << 80000000000;', f'const long X = {"(" * 9}1{")" * 9};']


@pytest.mark.parametrize(
    'definition',
    [
        *(
            f'module a {{ module msg {{ {line} struct B {{ long y; }}; }}; }};'
            for line in EXPRESSIONS
        ),
        '(((',
    ],
)
@pytest.mark.timeout(30)
def test_a_definition_is_not_read(tmp_path, definition):
    """Also that of an unused topic would have made the bag unreadable."""
    bag = write_kind('sqlite3', tmp_path)
    with sqlite3.connect(storage_file(bag)) as base:
        changed = base.execute(
            "UPDATE message_definitions SET encoding = 'ros2idl', encoded_message_definition = ?",
            (definition,),
        ).rowcount
    base.close()
    assert changed == 4
    assert len(read_all(bag)) == 7


def test_a_type_with_other_fields_is_refused(tmp_path):
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
    """An array of messages without fields has no bytes, independently of its length."""
    definition = f'std_msgs/Empty[4000000000] nothing\n{"=" * 80}\nMSG: std_msgs/Empty\n'
    with Ros1Writer(tmp_path / 'bag.bag') as writer:
        connection = writer.add_connection('/imu', IMU, msgdef=definition, md5sum='0' * 32)
        writer.write(connection, STAMP_NS, b'')
    with pytest.raises(InputError, match='is of another sensor_msgs/msg/Imu than that of ROS 1'):
        read_all(tmp_path / 'bag.bag')


# --- bounded sizes


@pytest.mark.parametrize(
    'kind, limit, text',
    [
        ('mcap', 'MAX_MESSAGE_BYTES', 'at most 1048576 are read'),
        ('sqlite3_zstd_messages', 'MAX_MESSAGE_BYTES', 'decompress to more than 1048576'),
        ('mcap_zstd_messages', 'MAX_MESSAGE_BYTES', 'decompress to more than 1048576'),
        ('mcap_zstd_chunks', 'MAX_CHUNK_BYTES', 'decompress to more than 1048576'),
        ('ros1_lz4', 'MAX_CHUNK_BYTES', 'decompress to more than 1048576'),
        ('ros1_bz2', 'MAX_CHUNK_BYTES', 'decompress to more than 1048576'),
        # And 200 times the size of the file, some MB here.
        ('sqlite3_zstd_files', 'MAX_FILE_BYTES', r'decompress to more than \d+;'),
        ('mcap_zstd_files', 'MAX_FILE_BYTES', r'decompress to more than \d+;'),
    ],
)
def test_decompression_is_bounded(tmp_path, monkeypatch, kind, limit, text):
    """A bag of some kB with a compressed message or chunk that has many MB."""
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path / 'temporary'))
    (tmp_path / 'temporary').mkdir()
    zeros = np.zeros((4096, 4096), dtype=np.uint8)
    bag = write_kind(kind, tmp_path, [*bag_kinds.camera_messages(), bag_kinds.image(8, zeros)])
    assert kind == 'mcap' or storage_file(bag).stat().st_size < 200_000
    assert len(read_all(bag)) == 8
    monkeypatch.setattr(files if limit == 'MAX_FILE_BYTES' else storage, limit, 1 << 20)
    with pytest.raises(InputError, match=text):
        read_all(bag)
    assert not list((tmp_path / 'temporary').iterdir())


def test_a_chunk_never_becomes_larger_than_its_head_has_it():
    """The head is checked before, so no larger chunk may follow it."""
    with pytest.raises(InputError, match='decompress to more than 100'):
        storage.chunk_data(storage.zstd.compress(bytes(10**8)), 'zstd', 100)
    for name, data in (
        ('zstd', storage.zstd.compress(bytes(100))),
        ('lz4', lz4.frame.compress(bytes(100))),
    ):
        assert storage.chunk_data(data, name, 100) == bytes(100)
        with pytest.raises(InputError, match='incomplete'):
            storage.chunk_data(data[:-6], name, 100)
        with pytest.raises(InputError, match='has 100 bytes instead of 101'):
            storage.chunk_data(data, name, 101)
