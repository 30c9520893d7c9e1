"""What a minimal solver is: a kernel behind one signature, called by its address.

So the robust loop is compiled once, and a solver only when somebody chooses it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.linked_kernel import KernelInterface

Array = NDArray[np.float64]


class Sample(NamedTuple):
    """A minimal sample of n matches.

    `f1`, `f2` (n, 3): unit rays, each in its own camera's frame, measured or derotated as the
    model says. `tau1`, `tau2` (n,): row times [s] relative to the reference row.
    """

    f1: Array
    f2: Array
    tau1: Array
    tau2: Array


class Knowledge(NamedTuple):
    """What is known besides the matches; a solver reads what its row of the table says.

    `align1`, `align2` (3, 3): rotations that turn each camera's gravity onto +z
    (`gravity.gravity_alignment`). `rotation` (3, 3): a predicted R, where `predicted`.
    """

    align1: Array
    align2: Array
    rotation: Array
    predicted: bool


class Solutions(NamedTuple):
    """Rotations R (K, 3, 3), and x (K, 9): ``t`` (unit), ``d_1, d_2`` in frame 1."""

    R: Array
    x: Array


def empty_solutions(most: int) -> Solutions:
    """Room for as many solutions as a solver returns; velocities are zero where it has none."""
    return Solutions(np.empty((most, 3, 3)), np.zeros((most, 9)))


def no_knowledge() -> Knowledge:
    """Neither gravity nor a predicted rotation."""
    return Knowledge(np.eye(3), np.eye(3), np.eye(3), False)


class Model(NamedTuple):
    """What a solver assumes: rays derotated by the gyro or not, linear velocities or none."""

    name: str
    derotated: bool
    velocities: bool


@dataclass(frozen=True, slots=True)
class Solver:
    """A row of the table of solvers.

    Attributes
    ----------
    name : str
    sample_size : int
        Matches of a minimal sample.
    model : Model
    solve : callable
        Kernel ``solve(sample, known, out) -> count``: writes all solutions to `out`
        (`Solutions`), the sign of t by the majority of the points.
    most_solutions : int
        Room that it needs in `out`.
    summary : str
        First line of its documentation; the rest is that of `solve`.
    needs_gravity : bool
        Both alignments of `Knowledge` must be given.
    needs_rotation : bool
        A predicted rotation must be given.
    starts_from_rotation : bool
        It is iterative and finds what it reaches from `Knowledge.rotation`.
    """

    name: str
    sample_size: int
    model: Model
    solve: Callable[[Sample, Knowledge, Solutions], int]
    most_solutions: int
    summary: str
    needs_gravity: bool = False
    needs_rotation: bool = False
    starts_from_rotation: bool = False

    @property
    def address(self) -> int:
        """Of the compiled kernel, for `solve_at`; it is compiled when first asked for."""
        return _INTERFACE.address(self.solve)


_INTERFACE = KernelInterface(
    numba.int64, Sample(*np.empty((2, 1, 3)), *np.empty((2, 1))), no_knowledge(),
    empty_solutions(1))
# In compiled code: solve_at(address, sample, known, out).
solve_at: Callable[[int, Sample, Knowledge, Solutions], int] = _INTERFACE.call


@kernel
def run_solver(address: int, sample: Sample, known: Knowledge, out: Solutions) -> int:
    """Write the solutions of one sample to `out`; their number."""
    return solve_at(address, sample, known, out)
