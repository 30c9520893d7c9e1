"""What is done with one bag, and what came of it; sent to workers and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
import hashlib
import json
from pathlib import Path
from typing import Any


class State(Enum):
    """How the work on a bag ended."""

    DONE = 'done'
    FINDINGS = 'findings'   # it ran, and found something wrong or not observable: exit code 1
    REFUSED = 'refused'     # bad input, with its sentence: exit code 2
    FAILED = 'failed'       # an error that was not expected
    LOST = 'lost'           # its worker died, again and again


# What running again would not change.
LASTING = frozenset({State.DONE, State.FINDINGS, State.REFUSED})


@dataclass(frozen=True, slots=True)
class Bag:
    """A bag as a worker sees it."""

    path: str
    size: int   # of all its files [bytes]; -1 where there is none
    changed_ns: int   # when the last of them changed
    parameters: str   # text of the parameter file beside it, '' without one


@dataclass(frozen=True, slots=True)
class Job:
    """A command of `rs_relpose`, one bag, and its options."""

    command: str
    bag: Bag
    name: str   # of the folder of its results
    parameters: str   # text of the parameter file that is used, '' for none
    options: tuple[str, ...]
    version: str   # of this package

    @property
    def fingerprint(self) -> str:
        """Changes where bag, parameters, options or the package do."""
        values = [self.command, self.bag.path, self.bag.size, self.bag.changed_ns,
                  self.parameters, *self.options, self.version]
        return hashlib.sha256(json.dumps(values).encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a worker gives back."""

    state: State
    message: str   # what was refused or failed; '' otherwise
    seconds: float   # wall time
    files: Mapping[str, bytes]   # results by file name


def look_at(paths: list[str]) -> list[Bag]:
    """Bags at paths and globs, in the order of the paths; a path without a bag has size -1."""
    found: dict[str, Bag] = {}
    for pattern in paths:
        matching = sorted(_matching(pattern))
        for path in matching or [Path(pattern)]:
            found.setdefault(str(path), _bag(path))
    return list(found.values())


def _matching(pattern: str) -> list[Path]:
    """Paths that a pattern with wildcards means; the path itself where it has none."""
    path = Path(pattern)
    if not any(sign in pattern for sign in '*?['):
        return [path]
    return [match for match in Path(path.anchor or '.').glob(
        str(path.relative_to(path.anchor) if path.anchor else path)) if _is_bag(match)]


def _is_bag(path: Path) -> bool:
    """Whether a glob means it: globs match parameter files and other folders, too."""
    return (path / 'metadata.yaml').is_file() or path.suffix in ('.mcap', '.db3', '.bag')


def _bag(path: Path) -> Bag:
    files = [file for file in path.iterdir() if file.is_file()] if path.is_dir() else [path]
    files = [file for file in files if file.is_file()]
    if not files:
        return Bag(str(path), -1, 0, '')
    states = [file.stat() for file in files]
    name = path.name if path.is_dir() else path.stem
    beside = path.with_name(f'{name}.yaml')
    return Bag(str(path), sum(state.st_size for state in states),
               max(state.st_mtime_ns for state in states),
               beside.read_text(encoding='utf-8', errors='replace') if beside.is_file() else '')


def unique_names(paths: list[str]) -> list[str]:
    """A name for the results of each bag: its own, with as many folders as tell it from others."""
    def name(path: str, folders: int) -> str:
        stem = Path(path).with_suffix('') if Path(path).suffix in (
            '.mcap', '.db3', '.bag') else Path(path)
        parts = [part for part in stem.parts if part not in ('/', '.', '..')]
        return '__'.join(parts[-1 - folders:])

    names = []
    for path in paths:
        depth = next((depth for depth in range(len(Path(path).parts))
                      if sum(name(other, depth) == name(path, depth) for other in paths) == 1),
                     None)
        names.append(name(path, len(Path(path).parts)) if depth is None else name(path, depth))
    if len(set(names)) < len(names):   # the same path in two spellings
        names = [f'{name}_{number}' for number, name in enumerate(names)]
    return names


def as_mapping(outcome: Outcome) -> dict[str, Any]:
    """An outcome without its files, for JSON."""
    return {'state': outcome.state.value, 'message': outcome.message, 'seconds': outcome.seconds,
            'files': sorted(outcome.files)}
