"""Kernels that other kernels call by address, as a linker would bind them.

Numba copies the code of a callee into each of its callers and optimises it there again, with all
that the callee holds itself: a chain of kernels costs the square of its length to compile. Called
by address, a kernel is compiled once; a call then costs some nanoseconds more. There are two uses:

- `link`: for a kernel whose body is dear against that. Its caller looks the address up at the
  first call of a process and keeps it.
- `KernelInterface`: for kernels of one signature, of which one is chosen at run time. The caller
  is compiled once and gets the address as an argument, a kernel is compiled when it is chosen.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
import ctypes
import functools
from inspect import Parameter, Signature
import pickle
from typing import Any, ParamSpec, TypeVar

from llvmlite import binding, ir
import numba
from numba.core import cgutils, types
from numba.core.serialize import dumps
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin

P = ParamSpec('P')
T = TypeVar('T')

_SYMBOL = 'rs_relpose_kernel_address'
# Linked kernels of this process by module and name.
_KERNELS: dict[str, Any] = {}


def _compiled(kernel: Any, arguments: tuple[types.Type, ...]) -> Any:
    kernel.compile(arguments)
    return kernel.overloads[arguments]


def _address(kernel: Any, arguments: tuple[types.Type, ...]) -> int:
    """Machine address of a kernel for these types; it is compiled or loaded if need be."""
    compiled = _compiled(kernel, arguments)
    address: int = compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name)
    return address


@ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_char_p)
def _linked_address(key: bytes) -> int:
    """Address of the linked kernel and argument types in `key`."""
    # Of no other origin than this module: a constant of compiled code.
    name, arguments = pickle.loads(base64.b64decode(key))  # noqa: S301
    return _address(_KERNELS[name], arguments)


binding.add_symbol(_SYMBOL, ctypes.cast(_linked_address, ctypes.c_void_p).value)


def _call(context: Any, builder: Any, call_signature: Any, address: Any, values: Any) -> Any:
    """Code that calls the kernel at `address` and hands its error on."""
    result, arguments = call_signature.return_type, call_signature.args
    status, value = context.call_conv.call_function(builder, address, result, arguments, values)
    with cgutils.if_unlikely(builder, status.is_error):
        context.call_conv.return_status_propagate(builder, status)
    return value


def _code_pointer(context: Any, call_signature: Any) -> Any:
    return context.call_conv.get_function_type(
        call_signature.return_type, call_signature.args).as_pointer()


class KernelInterface:
    """What all kernels of one kind take and return.

    Parameters
    ----------
    result : numba type
    arguments : sequence
        A value of each argument's type.

    Attributes
    ----------
    call : callable
        ``call(address, *arguments)``, for compiled code.
    """

    def __init__(self, result: Any, *arguments: Any) -> None:
        typeof: Callable[[Any], Any] = numba.typeof
        self._signature = result(*map(typeof, arguments))
        self.address = functools.cache(self._address)
        self.call: Callable[..., Any] = intrinsic(self._typed_call(len(arguments)))

    def _address(self, kernel: Callable[..., Any]) -> int:
        """Address of a kernel, which is compiled (or loaded) when first asked for."""
        return _address(kernel, self._signature.args)

    def _typed_call(self, count: int) -> Callable[..., Any]:
        types_of_kernel = self._signature

        def generate(context: Any, builder: Any, _signature: Any, values: Any) -> Any:
            address = builder.inttoptr(values[0], _code_pointer(context, types_of_kernel))
            return _call(context, builder, types_of_kernel, address, values[1:])

        def typed_call(_typing: Any, address: Any, *_arguments: Any) -> Any:
            return types_of_kernel.return_type(address, *types_of_kernel.args), generate

        # Numba asks for the names of all arguments.
        names = ['typing', 'address', *(f'argument{k}' for k in range(count))]
        typed_call.__signature__ = Signature([  # type: ignore[attr-defined]
            Parameter(name, Parameter.POSITIONAL_OR_KEYWORD) for name in names])
        return typed_call


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
        key = base64.b64encode(dumps((name, call_signature.args))).decode()
        address = _bound(builder, _code_pointer(context, call_signature), key)
        return _call(context, builder, call_signature, address, values)

    return call


def _bound(builder: Any, pointer: Any, key: str) -> Any:
    """Address of the kernel, looked up where this variable of the caller does not hold it yet."""
    module = builder.module
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
