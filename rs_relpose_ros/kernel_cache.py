"""Where compiled kernels are kept, and which source they belong to.

Numba keeps a kernel with the hash of the one file that defines it, in the folder of that file or,
where this is read-only, in a folder whose name depends on the file's path. So kernels that were
compiled when the package was built would not be found where it is installed, and a kernel would
be kept though one that it calls has changed. Therefore, for the modules of this package:

- A kernel belongs to the text of its module and of all that this one imports from the package.
- The package has its kernels beside it, from the build on; they may be moved and copied. Where
  this folder is read-only, a user has a copy of his own, for those that must be compiled anew.
- NUMBA_CACHE_DIR names another place, as ever.
"""

from __future__ import annotations

from collections.abc import Callable
import functools
import hashlib
import os
from pathlib import Path
import re
import shutil
import sys
import tempfile
from typing import Any

from numba.core import caching

_PACKAGE = __name__.partition('.')[0]
_BESIDE = Path(__file__).with_name('__pycache__') / 'kernels'
# "from PACKAGE.module import name, ...": a name may be a module, too.
_IMPORT = re.compile(rf'^from ({_PACKAGE}[\w.]*) import (\([^)]*\)|.*)', re.MULTILINE)


class KernelLocator:
    """Answers Numba's questions about the kernels of one module of this package."""

    def __init__(self, kernel: Callable[..., Any], file: str) -> None:
        self._py_file = file   # Numba names it in its warnings
        self._line = kernel.__code__.co_firstlineno
        self._digest = source_digest(kernel.__module__)
        self._folder = _folder(kernel.__module__, self._digest)

    @classmethod
    def from_function(cls, kernel: Callable[..., Any], file: str) -> KernelLocator | None:
        """Return the locator of a kernel; None for those of other packages."""
        return cls(kernel, file) if kernel.__module__.startswith(f'{_PACKAGE}.') else None

    def ensure_cache_path(self) -> None:
        """Make the folder before a kernel is saved."""
        self._folder.mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        """Folder of the kernels."""
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """What must be equal for a kernel to be used."""
        return self._digest

    def get_disambiguator(self) -> str:
        """What tells functions of one name apart."""
        return str(self._line)


def install() -> None:
    """Let Numba ask `KernelLocator` first, for every kernel that is declared from here on.

    The list is private to Numba but has been the same since 2015; without it, Numba's own
    places are used.
    """
    locators = getattr(caching.CacheImpl, '_locator_classes', None)
    if isinstance(locators, list) and KernelLocator not in locators:
        locators.insert(0, KernelLocator)


@functools.cache
def source_digest(module: str) -> str:
    """Hash of an imported module's source and of what it imports from this package."""
    source = Path(str(sys.modules[module].__file__)).read_bytes()
    digest = hashlib.sha256(source)
    for package, names in _IMPORT.findall(source.decode()):
        for name in re.findall(r'\w+', names):
            inner = f'{package}.{name}'
            digest.update(source_digest(inner if inner in sys.modules else package).encode())
    return digest.hexdigest()


def _folder(module: str, digest: str) -> Path:
    """Folder of a module's kernels: beside the package, or the user's where that is read-only."""
    beside, chosen = _BESIDE / module, 'NUMBA_CACHE_DIR' in os.environ
    if _beside_is_writable() and not chosen:
        return beside
    own = _users_folder() / f'{module}-{digest[:16]}'
    # Who chooses another folder has it to himself.
    if beside.is_dir() and not own.exists() and not chosen:
        own.parent.mkdir(parents=True, exist_ok=True)
        # Complete at once for other processes; the slower of two that start together gives way.
        with tempfile.TemporaryDirectory(dir=own.parent) as there:
            shutil.copytree(beside, Path(there) / module, copy_function=shutil.copyfile)
            try:
                (Path(there) / module).rename(own)
            except OSError:
                if not own.is_dir():
                    raise
    return own


@functools.cache
def _beside_is_writable() -> bool:
    try:
        _BESIDE.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(_BESIDE, os.W_OK)


@functools.cache
def _users_folder() -> Path:
    """NUMBA_CACHE_DIR, the user's cache directory, or for who has none one of this process."""
    chosen = os.environ.get('NUMBA_CACHE_DIR') or os.environ.get('XDG_CACHE_HOME')
    try:
        folder = Path(chosen or Path.home() / '.cache') / _PACKAGE
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except (OSError, RuntimeError):   # read-only, or the user has no home
        return Path(tempfile.mkdtemp(prefix=f'{_PACKAGE}-'))
    return folder
