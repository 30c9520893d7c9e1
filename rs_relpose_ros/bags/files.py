"""The files that make a bag, and how they are opened: with metadata.yaml, or without it.

The topics and the number of their messages are read from the files themselves. Of metadata.yaml
only the list of the files, their times and the hashes of the types are used, so that a bag whose
recorder was killed, or whose files were renamed, can be read.
"""

from collections.abc import Iterator
from contextlib import contextmanager, ExitStack, suppress
import logging
from pathlib import Path, PurePath
import re
import tempfile
from typing import Any, NamedTuple

import yaml

from rs_relpose_ros.bags.convert import how_to_convert
from rs_relpose_ros.bags.mcap import intact_records, McapStorage, write_records
from rs_relpose_ros.bags.ros1 import Ros1Storage
from rs_relpose_ros.bags.sqlite import SqliteStorage
from rs_relpose_ros.bags.storage import (
    DamagedError,
    NoBeginError,
    Source,
    Storage,
    UnfinishedError,
    zstd,
)
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.timing import NANOSECONDS

# Suffixes of the files of a bag. [derived: the kinds of `Source`]
SUFFIXES = ('.mcap', '.db3', '.bag')
# What recorders of rosbag2 write beside the files. [derived: rosbag2]
_METADATA = 'metadata.yaml'
# Bytes of the largest metadata.yaml that is parsed. A larger one is ignored; parsing it would take
# minutes. [chosen: thousands of topics need less than a megabyte]
_MAX_METADATA_BYTES = 1 << 24
# A compressed file is decompressed to a temporary one, whose size is bounded by the sum of this
# [bytes] and a multiple of its own. Without a bound a file of some kilobytes would fill the disk.
# [chosen: what any machine has on its disk; 0.1 to 10 GB would do]
MAX_FILE_BYTES = 1 << 30
# The multiple. A smaller one would refuse recordings that compress well. [chosen: images of
# noise-free simulations reach 100 times]
_MAX_FILE_GROWTH = 200
# Bytes that are decompressed at once. [chosen: 64 kB to 64 MB]
_BLOCK = 1 << 20

_logger = logging.getLogger(__name__)


class Metadata(NamedTuple):
    """What metadata.yaml says; all empty where there is none that can be used."""

    files: tuple[str, ...]
    digests: dict[tuple[str, str], str]  # hash of each topic's type, by topic and type
    parts: dict[str, tuple[float, float, int]]  # start [s], duration [s], messages of a file


# What is known of a bag without usable metadata. [derived: nothing]
_NOTHING = Metadata((), {}, {})


def open_files(path: Path, stack: ExitStack) -> tuple[list[Path], list[Storage], Metadata]:
    """Open the file, or the files of the folder in their order; the stack closes them."""
    if not path.exists():
        raise MissingInputError(f'there is no bag at {path}')
    metadata = _NOTHING
    files = [path]
    if path.is_dir():
        metadata = _read_metadata(path / _METADATA)
        files = _files_of(path, metadata)
    storages = []
    for file in files:
        with naming_damage(path, file):
            storages.append(_open(file, path, stack))
    return files, storages, metadata


@contextmanager
def naming_damage(path: Path, file: Path) -> Iterator[None]:
    """Context that reads `file` of the bag at `path`: damage becomes an InputError that names it.

    Damaged bytes can raise anything in the parsers.
    """
    try:
        yield
    except (MissingInputError, PermissionError, MemoryError):
        raise
    except Exception as error:
        if isinstance(error, InputError) and not isinstance(error, DamagedError):
            raise
        raise _damage(path, file, error) from error


def _damage(path: Path, file: Path, error: Exception) -> InputError:
    """The error of a file of the bag at `path`, with what may help."""
    # What the parsers of damaged bytes raise helps nobody: it names places of this code.
    _logger.debug('raised here', exc_info=error)
    reason = str(error) if isinstance(error, DamagedError) else 'its records have no sense'
    if isinstance(error, UnfinishedError):
        return InputError(f'{path}: {reason}')
    kind = 'is truncated or damaged, or no bag' if path == file else f'is damaged: {file.name}'
    remedies = {
        '.mcap': f'if it is truncated, copy it again, or "mcap recover {file.name} -o whole.mcap"',
        '.db3': f'copy it again, or "sqlite3 {file.name} .recover | sqlite3 whole.db3"',
        '.bag': f'copy it again, or "rosbag reindex {file.name}" in ROS 1',
    }
    remedy = remedies.get(file.suffix, 'copy it again')
    if isinstance(error, NoBeginError):
        remedy = 'copy it again, as no tool recovers a bag whose beginning is lost'
    return InputError(f'{path} {kind}: {reason}; {remedy}')


# -- metadata.yaml --------------------------------------------------------------------------------


def _read_metadata(file: Path) -> Metadata:
    """Read what can be used; a warning says why nothing can."""
    if not file.exists():
        return _NOTHING
    found: Any = None
    problem = 'is no metadata of a bag'
    if file.stat().st_size > _MAX_METADATA_BYTES:
        problem = f'has more than {_MAX_METADATA_BYTES} bytes'
    else:
        with suppress(yaml.YAMLError, RecursionError, UnicodeDecodeError):
            text = file.read_text(encoding='utf-8')
            # Aliases of aliases have no end when they are printed or merged.
            if '*' in text and any(isinstance(e, yaml.AliasEvent) for e in yaml.parse(text)):
                problem = 'has YAML aliases, which no recorder writes'
            else:
                found = yaml.safe_load(text)
        problem = problem if file.stat().st_size else 'is empty'
    with suppress(KeyError, TypeError, AttributeError, ValueError):
        return _metadata_of(found['rosbag2_bagfile_information'])
    _logger.warning(
        '%s %s: the bag is read without it; "ros2 bag reindex %s" writes a new one',
        file,
        problem,
        file.parent,
    )
    return _NOTHING


def _metadata_of(information: Any) -> Metadata:
    names = tuple(PurePath(str(name)).name for name in information['relative_file_paths'])
    digests = {}
    for topic in information.get('topics_with_message_count') or ():
        described = topic['topic_metadata']
        digest = str(described.get('type_description_hash') or '')
        digests[str(described['name']), str(described['type'])] = digest
    parts = {}
    for part in information.get('files') or ():
        start = part['starting_time']
        duration = part['duration']
        parts[PurePath(str(part['path'])).name] = (
            start['nanoseconds_since_epoch'] / NANOSECONDS,
            duration['nanoseconds'] / NANOSECONDS,
            int(part['message_count']),
        )
    return Metadata(names, digests, parts)


# -- The files of a folder ------------------------------------------------------------------------


def _files_of(folder: Path, metadata: Metadata) -> list[Path]:
    """The files in the order of recording; InputError where one is missing."""
    there = sorted(_storage_files(folder), key=_natural)
    listed = [folder / name for name in metadata.files]
    missing = [file for file in listed if not file.is_file()]
    if listed and not missing:
        return listed
    if not there:
        if metadata.files:
            raise InputError(
                f'{folder} is damaged: {" and ".join(metadata.files)}, which its {_METADATA} '
                'names, is not there: copy it again'
            )
        raise InputError(
            f'{folder} is no bag: it has no {_METADATA} and no {_or(SUFFIXES)} file'
            f'{how_to_convert(folder)}'
        )
    if not listed:
        if not (folder / _METADATA).exists():
            _logger.warning(
                '%s has no %s, so its recorder was not stopped properly: the bag is read without '
                'it; "ros2 bag reindex %s" writes one',
                folder,
                _METADATA,
                folder,
            )
        return there
    others = [file for file in there if file not in listed]
    if len(others) == len(missing):
        _logger.warning(
            '%s names %s, and %s is there: it is read as a renamed file; "ros2 bag reindex %s" '
            'writes the new name',
            folder / _METADATA,
            _and(file.name for file in missing),
            _and(file.name for file in others),
            folder,
        )
        return there
    raise InputError(
        f'{folder} is not complete: of its {len(listed)} files '
        f'{_and(_described(file, metadata) for file in missing)} is missing: copy it there, or '
        f'go on without it after "ros2 bag reindex {folder}"'
    )


def _storage_files(folder: Path) -> Iterator[Path]:
    for file in folder.iterdir():
        name = file.name.removesuffix('.zstd')
        if file.is_file() and name.endswith(SUFFIXES):
            yield file


def _natural(file: Path) -> list[Any]:
    """Key that sorts run_2 before run_10."""
    return [int(part) if part.isdigit() else part for part in re.split(r'(\d+)', file.name)]


def _described(file: Path, metadata: Metadata) -> str:
    if file.name not in metadata.parts:
        return file.name
    start, duration, count = metadata.parts[file.name]
    begin = min(start for start, _, _ in metadata.parts.values())
    return f'{file.name} ({duration:.1f} s from {start - begin:.1f} s on, {count} messages)'


def _and(names: Any) -> str:
    return ' and '.join(names)


def _or(names: Any) -> str:
    return ' or '.join(names)


# -- One file -------------------------------------------------------------------------------------


def _open(file: Path, path: Path, stack: ExitStack) -> Storage:
    """Open a file of the bag at `path` by what its first bytes say."""
    source = _source(file, path)
    if source is Source.ZSTD:
        file = _unpacked(file, stack)
        source = _source(file, path)
    if source is Source.MCAP:
        return McapStorage(file, stack)
    if source is Source.SQLITE:
        return SqliteStorage(file, stack)
    if source is Source.ROS1:
        return Ros1Storage(file, stack)
    if file.stat().st_size == 0:
        raise NoBeginError('it is empty')
    raise NoBeginError('its first bytes are not those of a bag')


def _source(file: Path, path: Path) -> Source | None:
    with file.open('rb') as opened:
        begin = opened.read(16)
    for source in Source:
        if begin.startswith(source.value):
            return source
    if file == path and file.suffix not in (*SUFFIXES, '.active'):
        raise InputError(
            f'{path} is no bag: give a rosbag2 directory (with {_METADATA}) or '
            f'a .mcap, .db3 or .bag file{how_to_convert(path)}'
        )
    return None


def _unpacked(file: Path, stack: ExitStack) -> Path:
    """Decompress a file to a temporary one of bounded size."""
    folder = stack.enter_context(tempfile.TemporaryDirectory())
    unpacked = Path(folder, file.name.removesuffix('.zstd'))
    size = file.stat().st_size
    limit = MAX_FILE_BYTES + _MAX_FILE_GROWTH * size
    count = 0
    with zstd.open(file, 'rb') as packed, unpacked.open('wb') as out:
        while block := packed.read(_BLOCK):
            count += len(block)
            if count > limit:
                raise DamagedError(f'{size} bytes decompress to more than {limit}')
            out.write(block)
    return unpacked


# -- What is intact of a damaged bag --------------------------------------------------------------
#
# Commands that estimate refuse a damaged bag: what is missing may be what matters. A report shows
# the rest, and says so. Only MCAP files are copied: of others nothing is known but their damage.

# First bytes of a file by which a bag is recognised. [derived: the longest of `Source`]
_BEGIN = 16


def _begin(file: Path) -> bytes:
    """The first bytes of a file; none of what is no file or cannot be read."""
    with suppress(OSError), file.open('rb') as opened:
        return opened.read(_BEGIN)
    return b''


def is_bag(path: Path) -> bool:
    """Whether a file begins as a bag does, or a folder has such a file.

    A path that does not exist, and a file of another kind, are no damaged bag.
    """
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    sources = tuple(source.value for source in Source)
    return any(_begin(file).startswith(sources) for file in files)


def salvaged(path: Path, folder: Path) -> Path | None:
    """Copy the intact records of the MCAP files of a bag; None if there are no such files.

    Parameters
    ----------
    path : Path
        File or directory of the bag.
    folder : Path
        Existing, empty folder for the copy.

    Returns
    -------
    Path or None
        File or directory to open in place of `path`. Each chunk is in it that has its checksum
        and whose place in the file is known: all before the first damage between two records, and
        all behind damage inside of a chunk.
    """
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    magic = Source.MCAP.value
    copies = []
    for file in (one for one in files if _begin(one).startswith(magic)):
        copies.append((folder / file.name).with_suffix('.mcap'))
        with file.open('rb') as source, copies[-1].open('wb') as target:
            source.seek(len(magic))
            write_records(target, intact_records(source))
    if not copies:
        return None
    return folder if path.is_dir() else copies[0]
