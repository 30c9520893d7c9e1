"""Minimal solvers: one function for each row of the table, such as `uniform_9pt`."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from rs_relpose_ros.solvers.api import as_function, MinimalSolution, SOLVERS

if TYPE_CHECKING:

    def __getattr__(name: str) -> Callable[..., list[MinimalSolution]]: ...


globals().update({name: as_function(row) for name, row in SOLVERS.items()})

__all__ = ['MinimalSolution', *SOLVERS]
