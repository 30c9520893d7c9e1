"""Write rosbag2 directories (MCAP storage) with ROS 2 Jazzy's messages."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

from rs_relpose_ros.bags.reader import RawMessage
from rs_relpose_ros.bags.sensor_topics import Topic
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.output_files import beside, refuse_existing

# Hash of an unknown type in a bag without hashes: players use the name of the type. [chosen: any
# hash that no type has]
_UNKNOWN_HASH = f'RIHS01_{64 * "0"}'


class BagWriter:
    """Writes one bag into a directory that it creates, with parents; use it as a context manager.

    The bag appears, complete, when the block ends normally; after an exception nothing of it is
    left. A path that exists or cannot be created raises InputError.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        refuse_existing(self.path)
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        self._connections: dict[str, Connection] = {}
        self._copied: dict[tuple[str, str], Connection] = {}

    @contextmanager
    def _opened(self) -> Iterator[None]:
        refuse_existing(self.path)  # again: it may have been created since
        with beside(self.path) as part:
            with Writer(part, version=9, storage_plugin=StoragePlugin.MCAP) as self._writer:
                yield
            part.rename(self.path)

    def __enter__(self) -> Self:
        self._context = self._opened()
        self._context.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._context.__exit__(*error)

    def type(self, msgtype: str) -> Any:
        """Message class of a type name such as ``'sensor_msgs/msg/Imu'``."""
        if msgtype not in self._typestore.types:
            raise InputError(f'ROS 2 Jazzy has no message type {msgtype!r}')
        return self._typestore.types[msgtype]

    def write(self, topic: str, msgtype: str, message: Any, bag_time_ns: int) -> None:
        """Append a message, an instance of `type(msgtype)`; `bag_time_ns`: its receive time."""
        self.type(msgtype)
        connection = self._connections.get(topic)
        if connection is None:
            connection = self._writer.add_connection(topic, msgtype, typestore=self._typestore)
            self._connections[topic] = connection
        elif connection.msgtype != msgtype:
            raise InputError(
                f'topic {topic} of the bag {self.path} carries {connection.msgtype}, '
                f'it cannot carry {msgtype} as well'
            )
        self._writer.write(
            connection, bag_time_ns, self._typestore.serialize_cdr(message, msgtype)
        )

    def announce(self, topic: Topic, origin: dict[str, Any]) -> None:
        """Announce a topic whose messages are copied or replaced, with its `Bag.origin`."""
        described = {**origin, 'rihs01': origin.get('rihs01') or _UNKNOWN_HASH}
        if topic.msgtype in self._typestore.fielddefs and not origin['msgdef']:
            # rosbags writes the definition and the hash of a type that it knows.
            del described['msgdef'], described['rihs01']
        connection = self._writer.add_connection(
            topic.name, topic.msgtype, typestore=self._typestore, **described
        )
        self._copied[topic.name, topic.msgtype] = connection
        self._connections.setdefault(topic.name, connection)

    def copy(self, raw: RawMessage) -> None:
        """Append an unchanged message of an announced topic."""
        self._writer.write(self._copied[raw.topic, raw.msgtype], raw.bag_time_ns, raw.data)
