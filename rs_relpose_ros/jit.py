"""How kernels are compiled: once, kept on disk, without the interpreter's lock.

Division by zero gives inf or NaN as in NumPy. No ``fastmath``: each caller compiles its own copy
of a function, and with reordered sums the copies would differ in the last bit.

Numba's own cache belongs to one file; here, to the text of a module and of all that it imports
from the package, so that kernels of the build are valid where it is installed. `_KernelLocator` is
the only use of private parts of Numba, equal in the versions `TRIED`. Without them, or if
RS_RELPOSE_PUBLIC_NUMBA is set, results are the same, but any change or move compiles all again.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
from inspect import Parameter, Signature
import os
from pathlib import Path
import re
import sys
import tempfile
from typing import Any

from llvmlite import ir
import numba
from numba.extending import intrinsic

# Versions of Numba whose private parts were tried. [measured: tests of the cache with each]
TRIED = ('0.58', '0.59', '0.61', '0.68')
# Folder of the package. [derived: place of this file]
_PACKAGE = Path(__file__).parent
# Imports from the package in the text of a module: the module, and the names. [derived: the layout
# of ruff]
_IMPORT = re.compile(rf'^from ({_PACKAGE.name}[\w.]*) import (\([^)]*\)|.*)', re.MULTILINE)


@functools.cache
def source_digest(module: str) -> str:
    """Hash of an imported module's source and of the modules of this package that it imports."""
    source = Path(str(sys.modules[module].__file__)).read_bytes()
    digest = hashlib.sha256(source)
    for package, names in _IMPORT.findall(source.decode()):
        for name in re.findall(r'\w+', names):  # of a function or of a module
            inner = f'{package}.{name}'
            digest.update(source_digest(inner if inner in sys.modules else package).encode())
    return digest.hexdigest()


@functools.cache
def _folder() -> Path:
    """NUMBA_CACHE_DIR, the folder of the build or, if that is read-only, a user's links to it."""
    built = _PACKAGE / '__pycache__' / 'kernels'
    chosen = os.environ.get('NUMBA_CACHE_DIR')
    users = Path(
        os.environ.get('XDG_CACHE_HOME') or '~/.cache',
        _PACKAGE.name,
        hashlib.sha256(str(_PACKAGE).encode()).hexdigest()[:16],
    )
    for place in (Path(chosen, _PACKAGE.name) if chosen else built, users):
        with contextlib.suppress(OSError, RuntimeError):  # read-only, or the user has no home
            (folder := place.expanduser()).mkdir(parents=True, exist_ok=True)
            if os.access(folder, os.W_OK):
                break
    else:
        folder = Path(tempfile.mkdtemp(prefix=_PACKAGE.name))
    for file in () if chosen or folder == built else built.glob('*/*/*'):
        with contextlib.suppress(FileExistsError):
            link = folder / file.relative_to(built)
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(file)
    return folder


try:
    if os.environ.get('RS_RELPOSE_PUBLIC_NUMBA'):
        raise AttributeError

    class _KernelLocator(numba.core.caching.InTreeCacheLocator):
        def __init__(self, function: Any, file: str) -> None:
            super().__init__(function, file)
            self._digest = source_digest(function.__module__)
            # By digest: Numba unpickles an index before it compares the stamp.
            self._cache_path = str(_folder() / function.__module__ / self._digest[:16])

        def get_source_stamp(self) -> str:
            return self._digest

        @classmethod
        def from_function(cls, function: Any, file: str) -> _KernelLocator | None:
            ours = function.__module__.startswith(f'{_PACKAGE.name}.')
            return cls(function, file) if ours else None

    numba.core.caching.CacheImpl._locator_classes.insert(0, _KernelLocator)
except AttributeError:
    _TEXT = b''.join(path.read_bytes() for path in sorted(_PACKAGE.rglob('*.py')))
    vars(numba.config)['CACHE_DIR'] = str(_folder() / hashlib.sha256(_TEXT).hexdigest())

# Options of all kernels. [measured: the wrapper for callers in C takes a tenth of the compilation]
_OPTIONS: dict[str, Any] = {
    'cache': True,
    'nogil': True,
    'error_model': 'numpy',
    'no_cfunc_wrapper': True,
}
kernel = numba.njit(**_OPTIONS)
inlined_kernel = numba.njit(**_OPTIONS, forceinline=True)  # as machine code: innermost loops
small_kernel = numba.njit(**_OPTIONS, inline='always')  # as statements: a few lines, one call


class KernelInterface:
    """Kernels of one type: other kernels ``call(address, *arguments)`` one chosen at run time."""

    def __init__(self, result: Any, *arguments: Any) -> None:
        signature = result(*map(numba.typeof, arguments))
        compiler = numba.cfunc(signature, **_OPTIONS)
        self._compiled: Any = functools.cache(lambda function: compiler(function.py_func))

        def generate(context: Any, builder: Any, _signature: Any, values: Any) -> Any:
            returned = context.get_value_type(signature.return_type)
            given = map(context.get_value_type, signature.args)
            code = ir.FunctionType(returned, given).as_pointer()
            pointer = builder.inttoptr(values[0], code)
            return builder.call(pointer, values[1:])

        def typed_call(_typing: Any, address: Any, *_arguments: Any) -> Any:
            return signature.return_type(address, *signature.args), generate

        # Numba asks for the number of arguments, of which the typing and the address come first.
        count = 2 + len(arguments)
        names = [Parameter(f'a{k}', Parameter.POSITIONAL_ONLY) for k in range(count)]
        typed_call.__signature__ = Signature(names)  # type: ignore[attr-defined]
        self.call: Any = intrinsic(typed_call)

    def address(self, function: Any) -> int:
        """Address of a kernel, which the first call compiles or loads."""
        return self._compiled(function).address
