"""Messages of ROS 2 and ROS 1 from their bytes: known types, conversion to CDR, decoding."""

from collections.abc import Callable
import functools
import logging
from pathlib import Path
from typing import Any

from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.store import Typestore

from rs_relpose_ros.bags import storage
from rs_relpose_ros.bags.storage import StoredTopic
from rs_relpose_ros.errors import InputError

_logger = logging.getLogger(__name__)


@functools.cache
def known_types(of_ros2: bool) -> Typestore:
    """Message types of one ROS, by their names alone.

    Definitions in a bag are not used: an expression in IDL can take any time and memory to parse,
    an array of empty messages any memory to read.
    """
    return get_typestore(Stores.ROS2_JAZZY if of_ros2 else Stores.ROS1_NOETIC)


@functools.cache
def _type_hash(msgtype: str, of_ros2: bool) -> str:
    """Hash of the fields of a known type as recorders write it."""
    store = known_types(of_ros2)
    return store.hash_rihs01(msgtype) if of_ros2 else store.generate_msgdef(msgtype)[1]


def begins_with_header(topic: StoredTopic) -> bool:
    """Whether the first field of the messages of a topic is a std_msgs/Header."""
    known = known_types(topic.encoding == 'cdr').fielddefs
    fields = known[topic.msgtype][1] if topic.msgtype in known else []
    return bool(fields) and 'std_msgs/msg/Header' in str(fields[0])


def as_cdr(path: Path, topic: StoredTopic, data: bytes) -> bytes:
    """The data of a message in CDR of ROS 2: headers of ROS 1 have an additional number.

    InputError, with the bag at `path`, for a message that is too large or cannot be converted.
    """
    if len(data) > storage.MAX_MESSAGE_BYTES:
        raise InputError(
            f'a message of {topic.name} has {len(data)} bytes; at most '
            f'{storage.MAX_MESSAGE_BYTES} are read'
        )
    if topic.encoding == 'cdr':
        return data
    known = known_types(of_ros2=True)
    if topic.encoding != 'ros1':
        raise InputError(
            f'topic {topic.name} of {path} is encoded as {topic.encoding[:20]!r}: only '
            'messages of ROS can be read'
        )
    if topic.msgtype not in known.fielddefs:
        raise InputError(
            f'topic {topic.name} of {path} is of type {topic.msgtype}, which ROS 2 does '
            'not have: leave it out'
        )
    return bytes(_decoded(path, topic, known.ros1_to_cdr, data))


def read_cdr(path: Path, topic: StoredTopic, data: bytes) -> Any:
    """The ROS 2 message of data in CDR; InputError if it cannot be decoded."""
    return _decoded(path, topic, known_types(of_ros2=True).deserialize_cdr, data)


def _decoded(path: Path, topic: StoredTopic, decode: Callable[..., Any], data: bytes) -> Any:
    """Decode a message, unless its type had other fields in the ROS of the recorder."""
    of_ros2 = topic.encoding == 'cdr'
    known = topic.digest and topic.msgtype in known_types(of_ros2).fielddefs
    if known and topic.digest != _type_hash(topic.msgtype, of_ros2):
        name = 'ROS 2 Jazzy' if of_ros2 else 'ROS 1 Noetic'
        raise InputError(
            f'topic {topic.name} of {path} is of another {topic.msgtype} than that '
            f'of {name}: its type hash is {topic.digest[:80]!r}'
        )
    try:
        return decode(data, topic.msgtype)
    except Exception as error:
        _logger.debug('raised here', exc_info=True)
        raise InputError(
            f'a message of {topic.name} in {path} is corrupt, it is no {topic.msgtype}'
        ) from error
