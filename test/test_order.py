"""Offline, stamps decide: bags written topic by topic, late, or with clocks that were set back."""

from collections.abc import Callable
from pathlib import Path

import bag_kinds
from bag_kinds import IMAGE, INFO
from conftest import BUNDLED_PARAMETERS
import numpy as np
import pytest
from rosbags.typesys import get_typestore, Stores

from rs_relpose_ros.bags import storage
from rs_relpose_ros.bags.order import clock_runs, reading_times
from rs_relpose_ros.bags.reader import open_bag, RawMessage
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.messages.incoming import stamp_ns
from rs_relpose_ros.offline.replay import Replay

MS = 1_000_000
IMU = 'sensor_msgs/msg/Imu'
IMU_STAMPS = np.arange(400) * 5 * MS
IMAGE_STAMPS = np.arange(60) * 33 * MS


def order_of(imu: np.ndarray, images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and topics in the order of reading of a file that has the IMU first."""
    stamps = np.concatenate((imu, images))
    topics = np.repeat([0, 1], [len(imu), len(images)])
    order = np.argsort(reading_times(stamps, topics, [0, 1]), kind='stable')
    assert sorted(order) == list(range(len(stamps)))
    return stamps[order], topics[order]


def test_topics_are_merged_by_their_stamps():
    stamps, topics = order_of(IMU_STAMPS, IMAGE_STAMPS)
    assert np.all(np.diff(stamps) >= 0)
    assert np.count_nonzero(np.diff(topics)) > 100


def swapped(stamps: np.ndarray) -> np.ndarray:
    """Two neighbours exchanged."""
    return stamps[[*range(20), 21, 20, *range(22, len(stamps))]]


def late(stamps: np.ndarray) -> np.ndarray:
    """Fifty messages that come 300 ms after the others, as through a buffer."""
    return np.concatenate((stamps[:100], stamps[150:210], stamps[100:150], stamps[210:]))


def in_the_future(stamps: np.ndarray) -> np.ndarray:
    """One message has a stamp of an hour later."""
    changed = stamps.copy()
    changed[100] += 3600 * 10**9
    return changed


def shuffled(stamps: np.ndarray) -> np.ndarray:
    """As of processes that write what they have converted."""
    return np.random.default_rng(4).permutation(stamps)


@pytest.mark.parametrize('change', [swapped, late, in_the_future, shuffled])
def test_late_messages_and_wrong_stamps_are_no_clock_that_was_set_back(change):
    changed = change(IMU_STAMPS)
    assert not clock_runs(changed).any()
    stamps, _ = order_of(changed, IMAGE_STAMPS)
    assert np.all(np.diff(stamps) >= 0)


# Set back by less than the recording lasts, and by the range of a counter of 32 bits.
@pytest.mark.parametrize('jump', [120 * MS, 500 * MS, 4_294_967_296_000])
def test_after_a_clock_was_set_back_the_order_of_the_file_counts(jump):
    imu = IMU_STAMPS.copy()
    images = IMAGE_STAMPS.copy()
    imu[200:] -= jump
    images[31:] -= jump
    assert list(np.unique(clock_runs(imu), return_counts=True)[1]) == [200, 200]
    stamps, topics = order_of(imu, images)
    # The stamps of each topic are those of the file.
    assert list(stamps[topics == 0]) == list(imu)
    assert list(stamps[topics == 1]) == list(images)
    # Both topics were set back at the same place.
    at = [np.flatnonzero(np.diff(stamps[topics == k]) < 0)[0] for k in (0, 1)]
    places = [np.flatnonzero(topics == k)[n] for k, n in enumerate(at)]
    assert abs(places[0] - places[1]) < 10


def test_a_sensor_that_was_set_back_alone_keeps_its_order():
    """What it measured after does not come among what it measured before."""
    imu = IMU_STAMPS.copy()
    imu[200:] -= 120 * MS
    stamps, topics = order_of(imu, IMAGE_STAMPS)
    assert list(stamps[topics == 0]) == list(imu)
    assert list(stamps[topics == 1]) == list(IMAGE_STAMPS)


# -- recordings -----------------------------------------------------------------------------------


def rewritten(source: Path, path: Path, key: Callable[[RawMessage], tuple[int, int]]) -> Path:
    """A bag with the same messages, written and received in the order of `key`."""
    with open_bag(source) as bag, BagWriter(path) as out:
        for topic in bag.topics:
            out.announce(topic, bag.origin(topic))
        for raw in sorted(bag.raw_messages(bag.topics), key=key):
            out.copy(raw._replace(bag_time_ns=key(raw)[1]))
    return path


def topic_by_topic(*first: str) -> Callable[[RawMessage], tuple[int, int]]:
    """The types in this order, all received within a second."""

    def key(raw: RawMessage) -> tuple[int, int]:
        number = first.index(raw.msgtype) if raw.msgtype in first else len(first)
        return (
            number,
            1_700_000_000_000_000_000 + number * 1000 * MS + raw.bag_time_ns % 10**10 // 10,
        )

    return key


def images_late(raw: RawMessage) -> tuple[int, int]:
    """Images that reach the recorder 8 s after the IMU's messages of their time."""
    delay = 8000 * MS * (raw.msgtype in (IMAGE, 'sensor_msgs/msg/CompressedImage'))
    return raw.bag_time_ns + delay, raw.bag_time_ns + delay


@pytest.fixture(scope='module')
def ordered(bundled_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first seconds of the bundled bag, with one CameraInfo."""
    infos = 0

    def further_info(message: object) -> bool:
        nonlocal infos
        infos += message.__msgtype__ == INFO
        return message.__msgtype__ == INFO and infos > 1

    path = tmp_path_factory.mktemp('ordered') / 'bag'
    return bag_kinds.copied(bundled_bag, path, further_info, seconds=2.2)


def poses_of(path: Path) -> list[object]:
    with open_bag(path) as bag:
        topics = bag.find_topics()
        replay = Replay(bag, topics, read_parameters(BUNDLED_PARAMETERS))
        return [
            (
                pair.reference_stamp_ns,
                pair.stamp_ns,
                *np.ravel(pair.pose.R),
                *np.ravel(pair.pose.t),
            )
            for pair in replay.pairs()
            if pair.pose.R is not None
        ]


@pytest.fixture(scope='module')
def expected(ordered: Path) -> list[object]:
    return poses_of(ordered)


def reading_of(path: Path) -> list[tuple[str, int]]:
    """Topics of the messages of sensors and their times of reading, by which odometry goes."""
    with open_bag(path) as bag:
        found = bag.find_topics()
        topics = [found.image, found.camera_info, found.imu]
        return [(raw.topic, raw.read_ns) for raw in bag.raw_messages(topics, by_stamp=True)]


@pytest.mark.parametrize(
    'key',
    [
        topic_by_topic(IMU, 'geometry_msgs/msg/PoseStamped', INFO),
        topic_by_topic('sensor_msgs/msg/CompressedImage', INFO, IMU),
        images_late,
    ],
    ids=['IMU first', 'images first', 'images late'],
)
def test_poses_do_not_depend_on_the_order_of_the_file(ordered, expected, tmp_path, key):
    assert len(expected) >= 3
    other = rewritten(ordered, tmp_path / 'bag', key)
    assert poses_of(other) == expected
    times = reading_of(other)
    assert times == reading_of(ordered)
    assert times == sorted(times, key=lambda one: one[1])


def test_messages_in_the_other_byte_order_have_their_stamps(tmp_path):
    big = get_typestore(Stores.ROS2_JAZZY)

    def serialize(message: object, msgtype: str) -> bytes:
        return bytes(big.serialize_cdr(message, msgtype, little_endian=False))

    messages = [bag_kinds.imu(t, (0.1, 0.2, 0.3)) for t in (5, 3, 1)]
    bag = bag_kinds.write_kind('mcap', tmp_path, messages, serialize)
    with open_bag(bag) as opened:
        read = [stamp_ns(m.message.header) for m in opened.messages(opened.topics, by_stamp=True)]
    assert [stamp - bag_kinds.STAMP_NS for stamp in read] == [1, 3, 5]


def test_chunks_are_kept_within_a_bound(monkeypatch):
    monkeypatch.setattr(storage, '_KEPT_BYTES', 100)
    loaded = []

    def load(place: int) -> bytes:
        loaded.append(place)
        return bytes(40)

    chunks = storage.KeptChunks(load)
    for place in (1, 2, 1, 3, 1, 2):
        assert len(chunks[place]) == 40
    assert loaded == [1, 2, 3, 2]
