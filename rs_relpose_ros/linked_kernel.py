"""Kernels that are compiled once: other kernels call them by address, as a linker would bind them.

Numba copies the code of a callee into each of its callers and optimises it there again, with all
that the callee holds itself: a chain of kernels costs the square of its length to compile. A
linked kernel stays outside. Its caller looks its address up at the first call of a process and
keeps it; a call then costs some nanoseconds. For functions whose body is dear against that.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
import ctypes
import functools
import pickle
from typing import Any, ParamSpec, TypeVar

from llvmlite import binding, ir
from numba.core import cgutils, types
from numba.core.serialize import dumps
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin

P = ParamSpec('P')
T = TypeVar('T')

_SYMBOL = 'rs_relpose_kernel_address'
# Linked kernels of this process by module and name.
_KERNELS: dict[str, Any] = {}


@ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_char_p)
def _address(key: bytes) -> int:
    """Machine address of the kernel and argument types in `key`; compiled or loaded if need be."""
    # Of no other origin than this module: a constant of compiled code.
    name, arguments = pickle.loads(base64.b64decode(key))  # noqa: S301
    compiled = _compiled(_KERNELS[name], arguments)
    address: int = compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name)
    return address


binding.add_symbol(_SYMBOL, ctypes.cast(_address, ctypes.c_void_p).value)


def _compiled(dispatcher: Any, arguments: tuple[types.Type, ...]) -> Any:
    dispatcher.compile(arguments)
    return dispatcher.overloads[arguments]


def link(dispatcher: Any, function: Callable[P, T]) -> Callable[P, T]:
    """`function`, compiled by `dispatcher`, to be called by address from other kernels."""
    name = f'{function.__module__}.{function.__qualname__}'
    _KERNELS[name] = dispatcher

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        result: T = dispatcher(*args, **kwargs)
        return result

    class Template(AbstractTemplate):
        key = call

        def generic(self, args: tuple[types.Type, ...], kws: dict[str, types.Type]) -> Any:
            # One compilation for all constants.
            plain = tuple(types.unliteral(a) for a in args)
            return signature(_compiled(dispatcher, plain).signature.return_type, *plain)

    infer_global(call, types.Function(Template))

    @lower_builtin(call, types.VarArg(types.Any))
    def _lower(context: Any, builder: Any, call_signature: Any, values: Any) -> Any:
        result, arguments = call_signature.return_type, call_signature.args
        code = _bound(builder, context.call_conv.get_function_type(result, arguments),
                      base64.b64encode(dumps((name, arguments))).decode())
        status, value = context.call_conv.call_function(builder, code, result, arguments, values)
        with cgutils.if_unlikely(builder, status.is_error):
            context.call_conv.return_status_propagate(builder, status)
        return value

    return call


def _bound(builder: Any, code_type: Any, key: str) -> Any:
    """Address of the kernel, looked up where this variable of the caller does not hold it yet."""
    module, pointer = builder.module, code_type.as_pointer()
    slot = cgutils.add_global_variable(module, pointer, module.get_unique_name('.linked'))
    slot.linkage, slot.initializer = 'internal', ir.Constant(pointer, None)
    with cgutils.if_unlikely(builder, cgutils.is_null(builder, builder.load(slot))):
        resolver = cgutils.get_or_insert_function(
            module, ir.FunctionType(cgutils.voidptr_t, [cgutils.voidptr_t]), _SYMBOL)
        text = cgutils.global_constant(module, '.linked_name',
                                       cgutils.make_bytearray(key.encode() + b'\0'))
        address = builder.call(resolver, [builder.bitcast(text, cgutils.voidptr_t)])
        builder.store(builder.bitcast(address, pointer), slot)
    return builder.load(slot)
