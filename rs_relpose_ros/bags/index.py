"""Where the messages of a bag lie in its files, their stamps, and in which order to read them.

The index is collected from the begins of all messages, before any message is decoded. It has 48
bytes a message: a bag of 20 GB with a million messages needs 50 MB, whatever its order.
"""

from array import array
from collections.abc import Iterable, Mapping, Sequence
import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.bags import storage
from rs_relpose_ros.bags.decoding import begins_with_header
from rs_relpose_ros.bags.order import reading_times
from rs_relpose_ros.bags.sensor_topics import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, IMU
from rs_relpose_ros.bags.storage import MessageEntry, StoredTopic
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds

# Types of images. [derived: interface of ROS]
_IMAGES = (IMAGE, COMPRESSED_IMAGE)
# Smallest offset of the clocks [s] that changes the order of reading: within less the history of
# the IMU has the samples of an image anyhow. [chosen: below its 5 s, above delays of drivers]
_LEAST_OFFSET = 1.0
# Bytes before the stamp of a message with a header: they name the encoding, or hold a number in
# ROS 1. [derived: CDR, and std_msgs/Header of ROS 1]
_BEFORE_STAMP = 4
# A stamp has seconds and nanoseconds. [derived: builtin_interfaces/Time]
_STAMP = struct.Struct('<iI')
# A stamp in the other byte order, which the second byte of CDR names. [derived: CDR]
_BIG_STAMP = struct.Struct('>iI')

# Name and type of a topic.
Key = tuple[str, str]


class Index(NamedTuple):
    """Places of messages in the files of a bag, in their order; arrays of int64 (N,)."""

    topic: NDArray[np.int64]  # number of its name and type in the bag
    file: NDArray[np.int64]
    place: NDArray[np.int64]
    offset: NDArray[np.int64]
    received: NDArray[np.int64]  # [ns]
    stamp: NDArray[np.int64]  # of the header; for types without a header, the time of reception

    def of_topics(self, numbers: Sequence[int]) -> 'Index':
        """The places of the messages of some topics."""
        chosen = np.isin(self.topic, numbers)
        return Index(*(column[chosen] for column in self))


class IndexBuilder:
    """Collects the index of a bag file by file; `numbers` of the topics by name and type."""

    def __init__(self, numbers: Mapping[Key, int]) -> None:
        self._numbers = numbers
        self._columns = [array('q') for _ in Index._fields]

    def add(
        self, file: int, topics: Iterable[StoredTopic], entries: Iterable[MessageEntry]
    ) -> None:
        """Add the messages of the file of a number."""
        of_id = {
            topic.id: (
                self._numbers[topic.name, topic.msgtype],
                topic.encoding if begins_with_header(topic) else '',
            )
            for topic in topics
        }
        append = [column.append for column in self._columns]
        add_topic, add_file, add_place, add_offset, add_received, add_stamp = append
        for entry in entries:
            number, encoding = of_id[entry.topic_id]
            add_topic(number)
            add_file(file)
            add_place(entry.place)
            add_offset(entry.offset)
            add_received(entry.time_ns)
            add_stamp(_stamp_of(entry.begin, encoding) if encoding else entry.time_ns)

    def built(self) -> Index:
        """The index of all files that were added."""
        return Index(*(np.frombuffer(column, np.int64) for column in self._columns))


def times_by_stamp(
    index: Index, numbers: Mapping[Key, int], time_offset: float
) -> NDArray[np.int64]:
    """Times of reading [ns], with a CameraInfo at the beginning where there is one.

    `time_offset` [s]: the clock of the IMU less that of the camera.
    """

    def of_types(*types: str) -> list[int]:
        """Numbers of the topics of some types."""
        return [number for (_, msgtype), number in numbers.items() if msgtype in types]

    stamps = index.stamp
    if abs(time_offset) > _LEAST_OFFSET:
        of_camera = np.isin(index.topic, of_types(*_IMAGES, CAMERA_INFO))
        stamps = stamps + to_nanoseconds(time_offset) * of_camera
    times = reading_times(stamps, index.topic, of_types(*_IMAGES, IMU))
    infos = np.flatnonzero(np.isin(index.topic, of_types(CAMERA_INFO)))
    if len(infos):
        # It serves the images before it, too: drivers publish it late, or once.
        earliest = infos[np.argmin(times[infos])]
        times[earliest] = times.min() - 1
    return times


def _stamp_of(begin: bytes | memoryview, encoding: str) -> int:
    """Stamp [ns] of the header that a message begins with; 0 where it is too short for one."""
    if begin[:4] == storage.ZSTD_MAGIC:
        begin = storage.first_bytes(begin, _BEFORE_STAMP + _STAMP.size)
    if len(begin) < _BEFORE_STAMP + _STAMP.size:
        return 0
    is_big_endian = encoding == 'cdr' and not begin[1] & 1
    layout = _BIG_STAMP if is_big_endian else _STAMP
    seconds, nanoseconds = layout.unpack_from(begin, _BEFORE_STAMP)
    return int(seconds) * NANOSECONDS + int(nanoseconds)
