"""Loads compiled kernels without what only the compilation of further kernels needs.

Numba keeps a kernel as machine code and, for kernels that call it, as bitcode. When it loads a
kernel, it parses the bitcode and lists the symbols in it. That is four fifths of the time of
loading, which no run with compiled kernels needs. Here the bitcode is parsed when another kernel
is linked with it, and a symbol is looked up when Numba asks for it: for one of each kernel.

The parts of Numba that this replaces are private, and equal in the versions `jit.TRIED`. Without
them, in another version, or if RS_RELPOSE_PUBLIC_NUMBA is set, Numba loads kernels its own way,
with the same results.
"""

import os
from typing import Any

from llvmlite.binding import parse_bitcode
import numba

from rs_relpose_ros.jit import TRIED


class LateModule:
    """Attribute of a library: the module that others are linked with, parsed for the first one."""

    def __get__(self, library: Any, owner: Any = None) -> Any:
        """The module, or None while there is none."""
        # A library that was loaded before the classes changed has it under the name of Numba.
        module = vars(library).get('late_module', vars(library).get('_shared_module'))
        if isinstance(module, bytes):
            module = vars(library)['late_module'] = parse_bitcode(module)
        return module

    def __set__(self, library: Any, module: Any) -> None:
        """Keep a module or its bitcode."""
        vars(library)['late_module'] = module


def load_late(library: Any, engine: Any) -> bool:
    """Change the classes of Numba: its library of machine code, and the engine that has symbols.

    Returns whether they have the private parts that this replaces; else they stay as they are.
    """
    try:
        usual_load = library._unserialize.__func__
        usual_answer = engine.is_symbol_defined
        _ = engine._load_defined_symbols, library.enable_object_caching
        _ = library._set_compiled_object, library._finalize_final_module
    except AttributeError:
        return False

    def load(cls: Any, codegen: Any, state: Any) -> Any:
        name, kind, data = state
        if kind != 'object':
            return usual_load(cls, codegen, state)
        code, bitcode = data
        loaded = codegen.create_library(name)
        loaded.enable_object_caching()
        loaded._set_compiled_object(code)
        loaded._shared_module = bitcode
        loaded._finalize_final_module()
        _kept(codegen._engine).append(code)
        return loaded

    def keep(self: Any, module: Any) -> None:
        _kept(self).append(module)

    def is_symbol_defined(self: Any, name: str) -> bool:
        # The newest first: Numba asks for what it has just added.
        return usual_answer(self, name) or any(_has(part, name) for part in reversed(_kept(self)))

    library._unserialize = classmethod(load)
    library._shared_module = LateModule()
    engine._load_defined_symbols = keep
    engine.is_symbol_defined = is_symbol_defined
    return True


def _kept(engine: Any) -> list[Any]:
    """Modules and machine code in which symbols are looked up."""
    kept: list[Any] = vars(engine).setdefault('late_symbols', [])
    return kept


def _has(part: Any, name: str) -> bool:
    """Whether a module defines a symbol for others, or machine code has it in its names."""
    if isinstance(part, bytes):
        # Names end with a zero byte. A name that is only used there is defined elsewhere, as the
        # code could not be loaded otherwise.
        return name.encode() + b'\0' in part
    for get in (part.get_function, part.get_global_variable):
        try:
            if not get(name).is_declaration:
                return True
        except NameError:
            continue
    return False


_codegen: Any = getattr(numba.core, 'codegen', None)
_tried = '.'.join(numba.__version__.split('.')[:2]) in TRIED
# Whether kernels are loaded this way. [derived: the version of Numba, and the environment]
LATE = (
    _tried
    and not os.environ.get('RS_RELPOSE_PUBLIC_NUMBA')
    and load_late(getattr(_codegen, 'JITCodeLibrary', None), getattr(_codegen, 'JitEngine', None))
)
