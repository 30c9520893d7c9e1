"""How kernels are compiled: once, kept on disk, without the interpreter's lock.

Division by zero gives inf or NaN as in NumPy. There is no ``fastmath``: a function is compiled
anew into each of its callers, and with reordered sums the copies would differ in the last bit, so
that a process's results would depend on which caller it ran first.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numba

from rs_relpose_ros import kernel_cache
from rs_relpose_ros.linked_kernel import link

P = ParamSpec('P')
T = TypeVar('T')

kernel_cache.install()
# Nothing calls a kernel as a C function: a wrapper for that costs a tenth of the compilation.
_OPTIONS: dict[str, Any] = {
    'cache': True, 'nogil': True, 'error_model': 'numpy', 'no_cfunc_wrapper': True}
kernel = numba.njit(**_OPTIONS)
# Put into its callers by Numba: for the innermost loops, whose arrays' shapes must be known there.
inlined_kernel = numba.njit(**_OPTIONS, forceinline=True)
# Copied into its callers before types are inferred, so that it costs them no compilation of its
# own: for functions of a few lines, such as a cross product.
small_kernel = numba.njit(**_OPTIONS, inline='always')


def linked_kernel(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a function whose code other kernels call by address, never as a copy of it."""
    return link(kernel(function), function)
