"""Minimal solvers: a function for every row of the table, such as `uniform_9pt`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rs_relpose_ros.solvers.public import as_function, MinimalSolution, MinimalSolver
from rs_relpose_ros.solvers.table import SOLVERS

if TYPE_CHECKING:
    def __getattr__(name: str) -> MinimalSolver: ...

globals().update({name: as_function(row) for name, row in SOLVERS.items()})

__all__ = ['MinimalSolution', *SOLVERS]
