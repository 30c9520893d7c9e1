"""Kernels behind one signature, which other kernels call by their address.

A kernel that is called by name is compiled into its caller. Called by address, any of several
kernels can be chosen at run time: the caller is compiled once, and a kernel when it is chosen.
A call costs some nanoseconds more.
"""

from __future__ import annotations

from collections.abc import Callable
import functools
from inspect import Parameter, Signature
from typing import Any

from llvmlite import ir
import numba
from numba.extending import intrinsic


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
        self._compiled = functools.cache(self._compile)
        self.call: Callable[..., Any] = intrinsic(self._typed_call(len(arguments)))

    def address(self, kernel: Callable[..., Any]) -> int:
        """Address of a kernel, which is compiled (or loaded) when first asked for."""
        address: int = self._compiled(kernel).address
        return address

    def _compile(self, kernel: Any) -> Any:
        return numba.cfunc(self._signature, cache=True, error_model='numpy')(kernel.py_func)

    def _typed_call(self, count: int) -> Callable[..., Any]:
        types = self._signature

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            result, *arguments = (context.get_value_type(t) for t in (
                signature.return_type, *signature.args[1:]))
            function = ir.FunctionType(result, arguments).as_pointer()
            return builder.call(builder.inttoptr(values[0], function), values[1:])

        def typed_call(_typing: Any, address: Any, *_arguments: Any) -> Any:
            return types.return_type(address, *types.args), generate

        # Numba asks for the names of all arguments.
        names = ['typing', 'address', *(f'argument{k}' for k in range(count))]
        typed_call.__signature__ = Signature([  # type: ignore[attr-defined]
            Parameter(name, Parameter.POSITIONAL_OR_KEYWORD) for name in names])
        return typed_call
