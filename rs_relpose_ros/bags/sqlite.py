"""Read the SQLite files of rosbag2, also after a recorder was killed."""

from collections.abc import Iterator
from contextlib import closing, ExitStack
from pathlib import Path
import sqlite3
from urllib.parse import quote

from rs_relpose_ros.bags.storage import (
    BEGIN_BYTES,
    DamagedError,
    MessageEntry,
    qos_profiles,
    StoredTopic,
    ZSTD_MAGIC,
)

# First bytes of a write-ahead log, in both byte orders. SQLite takes a log that begins otherwise
# for an empty one. [derived: its file format]
_LOG_MAGIC = (0x377F0682, 0x377F0683)
# Bytes of a message up to which it is read as a whole, and not by its begin. [chosen: about a page
# of SQLite; 1 to 16 kB would do]
_SMALL_BYTES = 4096


class SqliteStorage:
    """An open SQLite file; see `Storage`."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        # What a recorder has written last is in another file until it is closed.
        log = path.with_name(f'{path.name}-wal')
        has_log = log.exists() and log.stat().st_size > 0
        if has_log:
            with log.open('rb') as opened:
                begin = int.from_bytes(opened.read(4), 'big')
            if begin not in _LOG_MAGIC:
                raise DamagedError(f'its last messages are in {log.name}, which is damaged')
        # The user's file stays as it is. Without a log nothing is written beside it either.
        mode = 'mode=ro' if has_log else 'mode=ro&immutable=1'
        base = sqlite3.connect(f'file:{quote(str(path.absolute()))}?{mode}', uri=True)
        self._base = stack.enter_context(closing(base))
        try:
            self._read_topics()
        except sqlite3.Error as error:
            if has_log:
                raise DamagedError(
                    f'its last messages are in {log.name}, which cannot be read ({error}): copy '
                    'both files into a folder that can be written, and give the copy'
                ) from error
            raise DamagedError(f'SQLite reports: {error}') from error

    def entries(self) -> Iterator[MessageEntry]:
        """All messages in the order of the file."""
        # Of a large message SQLite reads all pages that a query names.
        query = (
            'SELECT topic_id, timestamp, id, typeof(data), '
            'CASE WHEN length(data) <= ? THEN data END FROM messages ORDER BY id'
        )
        with closing(self._base.execute(query, (_SMALL_BYTES,))) as rows:
            for topic_id, time_ns, row, kind, data in rows:
                if kind != 'blob':
                    raise DamagedError('a message has no bytes')
                begin = self._begin(int(row)) if data is None else data
                yield MessageEntry(int(topic_id), int(time_ns), int(row), 0, begin)

    def _begin(self, row: int) -> bytes:
        """The bytes that a large message begins with; all where they are compressed."""
        with self._base.blobopen('messages', 'data', row, readonly=True) as blob:
            begin = blob.read(BEGIN_BYTES)
            return begin + blob.read() if begin[:4] == ZSTD_MAGIC else begin

    def data(self, place: int, offset: int) -> bytes:
        """Bytes of the message of an entry."""
        (data,) = self._base.execute('SELECT data FROM messages WHERE id = ?', (place,)).fetchone()
        return bytes(data)

    def _read_topics(self) -> None:
        query = self._base.execute
        tables = {name for (name,) in query('SELECT name FROM sqlite_master')}
        if not {'topics', 'messages'} <= tables:
            raise DamagedError('it has no tables of rosbag2')
        counts = dict(query('SELECT topic_id, count(*) FROM messages GROUP BY topic_id'))
        definitions = {}
        if 'message_definitions' in tables:
            definitions = dict(
                query('SELECT topic_type, encoded_message_definition FROM message_definitions')
            )
        rows = query('SELECT * FROM topics')
        names = [column[0] for column in rows.description]
        self.topics = []
        for row in rows:
            found = dict(zip(names, row, strict=True))
            topic = StoredTopic(
                int(found['id']),
                str(found['name']),
                str(found['type']),
                int(counts.get(found['id'], 0)),
                str(found['serialization_format']),
                str(found.get('type_description_hash') or ''),
                str(definitions.get(found['type'], '')),
                qos_profiles(str(found.get('offered_qos_profiles') or '')),
            )
            self.topics.append(topic)
