"""The solvers of the table as Python functions that check what they get."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.solvers import inputs
from rs_relpose_ros.solvers.gravity import gravity_alignment
from rs_relpose_ros.solvers.solver import (
    empty_solutions,
    Knowledge,
    no_knowledge,
    run_solver,
    Sample,
    Solutions,
    Solver,
)


@dataclass(frozen=True, slots=True, eq=False)
class MinimalSolution:
    """One real solution of a minimal problem: ``X_1 = R X_2 + t`` with ``|t| = 1``.

    Attributes
    ----------
    R : (3, 3) ndarray
        ``R_1^T R_2``, between the two frames' reference rows.
    t : (3,) ndarray
        Unit direction of ``R_1^T (p_2 - p_1)``.
    v1, v2 : (3,) ndarray
        Linear velocities, each in its own camera's frame [baselines per second]; zero where the
        solver's model has none.
    """

    R: NDArray[np.float64]
    t: NDArray[np.float64]
    v1: NDArray[np.float64]
    v2: NDArray[np.float64]


class MinimalSolver(Protocol):
    """Signature of the solvers."""

    __name__: str

    def __call__(self, rays1: ArrayLike, rays2: ArrayLike, tau1: ArrayLike, tau2: ArrayLike, *,
                 gravity1: ArrayLike | None = None, gravity2: ArrayLike | None = None,
                 start_rotations: ArrayLike | None = None) -> list[MinimalSolution]:
        """Solve one minimal sample."""


_DOCUMENTATION = """{row.summary}

    Parameters
    ----------
    rays1, rays2 : ({row.sample_size}, 3) array_like
        Rays, {rays}, each in its own camera's frame; any length but zero.
    tau1, tau2 : ({row.sample_size},) array_like
        Row times [s] relative to the reference row{times}.
    gravity1, gravity2 : (3,) array_like{gravity}
    start_rotations : (K, 3, 3) array_like{starts}

    Returns
    -------
    list of MinimalSolution
        {solutions} Of (t, v1, v2) and its negative, which solve the same equations, the one that
        puts more of the points in front of both cameras, each seen from where the cameras were
        at its own rows.

    Raises
    ------
    InputError
        A wrong shape, a value that is not finite, a zero vector, a start that is no rotation, or
        a parameter that is needed and missing.

    Notes
    -----
    {notes}
    """


def documentation(row: Solver) -> str:
    """Docstring of a solver's function."""
    unused = ', optional\n        Not used.'
    return _DOCUMENTATION.format(
        row=row, notes=row.solve.__doc__,
        rays='derotated by the gyro' if row.model.derotated else 'as measured',
        times='' if row.model.velocities else '; checked, not used',
        gravity=("\n        Direction of free fall in each camera's frame at the reference row, "
                 'any length.') if row.needs_gravity else unused,
        starts=("\n        Rotations to start from: the gyro's prediction, or those of "
                '`angular_5pt`.') if row.starts_from_rotation else unused,
        solutions='The distinct solutions reached, at most one from each start.'
        if row.starts_from_rotation else f'All real solutions, at most {row.most_solutions}.')


def as_function(row: Solver) -> MinimalSolver:
    """The solver of a row as a pure function."""
    def solve(rays1: ArrayLike, rays2: ArrayLike, tau1: ArrayLike, tau2: ArrayLike, *,
              gravity1: ArrayLike | None = None, gravity2: ArrayLike | None = None,
              start_rotations: ArrayLike | None = None) -> list[MinimalSolution]:
        size = row.sample_size
        sample = Sample(inputs.rays('rays1', rays1, size), inputs.rays('rays2', rays2, size),
                        inputs.row_times('tau1', tau1, size), inputs.row_times('tau2', tau2, size))
        known = no_knowledge()
        if row.needs_gravity:
            known = known._replace(
                align1=gravity_alignment(inputs.gravity('gravity1', gravity1)),
                align2=gravity_alignment(inputs.gravity('gravity2', gravity2)))
        if not row.starts_from_rotation:
            return list(_solutions(row, sample, known))
        found: list[MinimalSolution] = []
        for start in inputs.rotations('start_rotations', start_rotations):
            found.extend(s for s in _solutions(
                row, sample, known._replace(rotation=start, predicted=True))
                if all(_are_distinct(s.R, other.R) for other in found))
        return found

    solve.__name__ = solve.__qualname__ = row.name
    solve.__doc__ = documentation(row)
    return solve


def _are_distinct(R: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Whether rotations are farther apart than 1e-7 rad, which two starts of one solution are not.

    ``|R - R'| = 2 sqrt(2) |sin(angle / 2)|``
    """
    return bool(np.linalg.norm(R - other) > np.sqrt(2.0) * 1e-7)


def _solutions(row: Solver, sample: Sample, known: Knowledge) -> Iterator[MinimalSolution]:
    out: Solutions = empty_solutions(row.most_solutions)
    count = run_solver(row.address, sample, known, out)
    for R, x in zip(out.R[:count], out.x[:count], strict=True):
        t, d1, d2 = x.reshape(3, 3)
        if row.model.velocities:
            yield MinimalSolution(R, t, d1, R.T @ d2)
        else:
            yield MinimalSolution(R, t, np.zeros(3), np.zeros(3))
