"""Read rosbag2 bags (SQLite3, MCAP, compressed) and ROS 1 bags.

A bag that is damaged, truncated or far too large raises an InputError with one line of text.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack, suppress
import functools
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import QosReliability

from rs_relpose_ros.bags.decoding import as_cdr, known_types, read_cdr
from rs_relpose_ros.bags.files import naming_damage, open_files
from rs_relpose_ros.bags.index import Index, IndexBuilder, times_by_stamp
from rs_relpose_ros.bags.sensor_topics import (
    Chosen,
    GROUND_TRUTH_TOPIC,
    POSE_STAMPED,
    SensorTopics,
    Topic,
    TopicFinder,
)
from rs_relpose_ros.bags.storage import message_data, StoredTopic
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.messages.streams import Timeline

# Rows of the index that become Python's numbers at once. Less is slower, all would take 1 GB of a
# bag of some million messages. [chosen: 1000 to 100 000 would do]
_ROWS = 4096


class BagMessage(NamedTuple):
    """A message with its topic and two times [ns]: of its recording, and of its reading.

    Messages are read in the order of the latter.
    """

    topic: str
    bag_time_ns: int
    message: Any
    read_ns: int = 0


class RawMessage(NamedTuple):
    """A message as CDR bytes, with its topic and the times of a `BagMessage` [ns]."""

    topic: str
    msgtype: str
    bag_time_ns: int
    data: bytes
    read_ns: int = 0


class Bag:
    """An open bag; made by `open_bag`."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self.path = path
        self._files, self._storages, metadata = open_files(path, stack)
        # Gets the topic of each message that is read, for a progress bar.
        self.on_message: Callable[[str], object] = lambda topic: None
        # The clock of the IMU less that of the camera [s], for the order of reading by stamps.
        self.time_offset = 0.0
        # A topic may have messages in several files.
        self._stored: dict[tuple[str, str], StoredTopic] = {}
        for opened in self._storages:
            for topic in opened.topics:
                self._add_topic(topic, metadata.digests)
        self._numbers = {key: number for number, key in enumerate(self._stored)}
        stored = [one for _, one in sorted(self._stored.items())]
        self.topics = tuple(Topic(one.name, one.msgtype, one.messages) for one in stored)

    def _add_topic(self, topic: StoredTopic, digests: Mapping[tuple[str, str], str]) -> None:
        """Add a topic of one file, with its hash of `digests` where the file has none."""
        key = topic.name, topic.msgtype
        if not ''.join(key).isprintable():
            raise InputError(f'{self.path} is damaged: a topic has no printable name or type')
        count = topic.messages
        if key in self._stored:
            self._stored[key] = self._stored[key]._replace(
                messages=self._stored[key].messages + count
            )
            return
        digest = topic.digest or digests.get(key, '')
        self._stored[key] = topic._replace(digest=digest)

    @property
    def duration(self) -> float:
        """Time of recording from the first to the last message [s]."""
        received = self._whole_index.received
        return int(np.ptp(received)) / NANOSECONDS if len(received) else 0.0

    def reliability(self, topic: Topic) -> str:
        """``'reliable'`` or ``'best effort'`` as its publishers offered; empty if not recorded."""
        stored = self._stored[topic.name, topic.msgtype]
        if stored.encoding != 'cdr':
            return ''
        offered = {profile.reliability for profile in stored.qos}
        if QosReliability.BEST_EFFORT in offered:
            return 'best effort'
        return 'reliable' if QosReliability.RELIABLE in offered else ''

    def origin(self, topic: Topic) -> dict[str, Any]:
        """Metadata for a copy of a topic, in ROS 2, as rosbags' `add_connection` takes them."""
        stored = self._stored[topic.name, topic.msgtype]
        if stored.encoding != 'cdr':
            return {'msgdef': '', 'offered_qos_profiles': stored.qos}
        return {
            'msgdef': stored.definition,
            'rihs01': stored.digest,
            'serialization_format': stored.encoding,
            'offered_qos_profiles': stored.qos,
        }

    def can_be_copied(self, topic: Topic) -> bool:
        """Whether `raw_messages` can read it: of ROS 1 only types that ROS 2 has, too."""
        stored = self._stored[topic.name, topic.msgtype]
        return stored.encoding == 'cdr' or topic.msgtype in known_types(of_ros2=True).fielddefs

    def find_topics(
        self, names: Mapping[str, str] | None = None, *, needs_camera_info: bool = True
    ) -> SensorTopics:
        """The sensors' topics: as chosen, or by type if that is unambiguous.

        `names` are the topics that the user has chosen, by field of `SensorTopics`; an empty name
        means that the user has not chosen. Of several CameraInfo topics, the one next to the image
        is used. Of two Imu topics, one with 'gyro' and one with 'accel' in its name make a pair
        (RealSense).
        """
        finder = TopicFinder(self.path, self.topics, names or {}, self._first_message)
        found = finder.find(needs_camera_info)
        assert found.image is not None and found.imu is not None
        truth = finder.one('truth', 'ground truth', POSE_STAMPED, preferred=GROUND_TRUTH_TOPIC)
        return SensorTopics(found.image, found.camera_info, found.imu, found.accel, truth)

    def choose_topics(self, names: Mapping[str, str]) -> Chosen:
        """The sensors' topics, None where one is absent; a rectified image is chosen, too."""
        finder = TopicFinder(self.path, self.topics, names, self._first_message, complete=False)
        return finder.find(False)

    def _first_message(self, topic: Topic) -> Any:
        """The first message of a topic; None if it cannot be read."""
        with suppress(InputError):
            return next((one.message for one in self.messages([topic])), None)
        return None

    def messages(self, topics: Sequence[Topic], *, by_stamp: bool = False) -> Iterator[BagMessage]:
        """Messages of `topics` in the order of `raw_messages`, with arrays that are read-only."""
        for raw in self.raw_messages(topics, by_stamp=by_stamp):
            yield BagMessage(raw.topic, raw.bag_time_ns, self.read(raw), raw.read_ns)

    def raw_messages(
        self, topics: Sequence[Topic], *, by_stamp: bool = False
    ) -> Iterator[RawMessage]:
        """Messages of `topics` in CDR as publishers of ROS 2 expect them.

        They come in the order in which they were received, or `by_stamp` in the order of
        `reading_times`, the first CameraInfo before all others.
        """
        index = self._index(topics)
        times = index.received
        if by_stamp:
            times = times_by_stamp(index, self._numbers, self.time_offset)
        stored = list(self._stored.values())
        # Equal times are read in the order of the topics' names, whatever the file has first.
        names = [topic.name for topic in stored]
        by_name = np.argsort(names)
        rank = np.argsort(by_name)
        order = np.lexsort((rank[index.topic], times))
        columns = (index.topic, index.file, index.place, index.offset, index.received, times)
        for first in range(0, len(order), _ROWS):
            rows = order[first : first + _ROWS]
            chosen = [column[rows].tolist() for column in columns]
            for number, file, place, offset, received_ns, read_ns in zip(*chosen, strict=True):
                topic = stored[number]
                cdr = as_cdr(self.path, topic, self._data(file, place, offset))
                self.on_message(topic.name)
                yield RawMessage(topic.name, topic.msgtype, received_ns, cdr, read_ns)

    def timeline(self, topic: Topic) -> Timeline:
        """Stamps and times of reception of a topic, in the order of the file."""
        index = self._index([topic])
        return Timeline(topic.name, index.stamp, index.received)

    def read(self, raw: RawMessage) -> Any:
        """The ROS 2 message of an item of `raw_messages`; InputError if it cannot be decoded."""
        stored = self._stored[raw.topic, raw.msgtype]
        return read_cdr(self.path, stored, raw.data)

    # -- places and data ---------------------------------------------------------------------

    def _index(self, topics: Sequence[Topic]) -> Index:
        """Places of the messages of `topics`."""
        numbers = [self._numbers[topic.name, topic.msgtype] for topic in topics]
        return self._whole_index.of_topics(numbers)

    @functools.cached_property
    def _whole_index(self) -> Index:
        """Places of all messages, which the first reading collects."""
        builder = IndexBuilder(self._numbers)
        for number, opened in enumerate(self._storages):
            with naming_damage(self.path, self._files[number]):
                builder.add(number, opened.topics, opened.entries())
        return builder.built()

    def _data(self, number: int, place: int, offset: int) -> bytes:
        """Bytes of a message in the file of a number."""
        try:
            return message_data(self._storages[number].data(place, offset))
        except Exception:
            # The context costs more than the reading of a sample of the IMU.
            with naming_damage(self.path, self._files[number]):
                raise


@contextmanager
def open_bag(path: Path | str) -> Iterator[Bag]:
    """Open a rosbag2 directory, or a single ``.mcap``, ``.db3`` or ROS 1 ``.bag`` file."""
    path = Path(path)
    with ExitStack() as stack:
        try:
            bag = Bag(path, stack)
        except PermissionError as error:
            raise InputError(f'{path} cannot be read: {error.strerror}') from error
        yield bag
