"""The table of minimal solvers, and its solvers as Python functions with checked arguments.

All solve ``(f_1 x R f_2) . (t - tau_1 d_1 + tau_2 d_2) = 0`` (docs/conventions.md, equation 4),
with ``d_1 = v_1`` and ``d_2 = R v_2``. They differ in the rays, in the velocities that they solve
for, and in the known part of R. To add a solver, write its kernel and its row here.

References
----------
C.-R. Lee and K.-J. Yoon, *Inertial-aided Rolling Shutter Relative Pose Estimation*, sections
'Minimal Algorithms' and 'Solver'.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array, validate
from rs_relpose_ros.solvers import angular, common, uniform
from rs_relpose_ros.solvers.common import Knowledge, Model, Sample, Solver

# This model has rays derotated by the gyro, and velocities. [derived: the paper, as all of these]
UNIFORM = Model('uniform', derotated=True, velocities=True)
# This model has rays as measured, and velocities. [derived: the same]
LINEAR = Model('linear', derotated=False, velocities=True)
# This model has rays derotated by the gyro, and no velocities. [derived: the same]
ANGULAR = Model('angular', derotated=True, velocities=False)
# This model has rays as measured, and no velocities. [derived: the same]
GLOBAL = Model('global', derotated=False, velocities=False)

# The public table has the solvers by their names. [derived: the algorithms of the paper]
SOLVERS = {
    solver.name: solver
    for solver in (
        Solver(
            'uniform_9pt',
            9,
            UNIFORM,
            uniform.solve_with_gravity,
            uniform.MAX_9PT,
            'Uniform 9-point algorithm: gravity and angular velocity known.',
            needs_gravity=True,
        ),
        Solver(
            'uniform_11pt',
            11,
            UNIFORM,
            uniform.solve_uniform_11pt,
            uniform.MAX_11PT,
            'Uniform 11-point algorithm: angular velocity known.',
            starts_from_rotation=True,
        ),
        Solver(
            'linear_9pt',
            9,
            LINEAR,
            uniform.solve_with_gravity,
            uniform.MAX_9PT,
            'Linear 9-point algorithm: gravity known, no angular velocity.',
            needs_gravity=True,
        ),
        Solver(
            'angular_5pt',
            5,
            ANGULAR,
            angular.solve_5pt,
            angular.MAX_5PT,
            'Angular 5-point algorithm: angular velocity known, no linear velocity.',
        ),
        Solver(
            'angular_3pt',
            3,
            ANGULAR,
            uniform.solve_with_gravity,
            uniform.MAX_3PT,
            'Angular 3-point algorithm: gravity and angular velocity known, no linear velocity.',
            needs_gravity=True,
        ),
        Solver(
            'global_5pt',
            5,
            GLOBAL,
            angular.solve_5pt,
            angular.MAX_5PT,
            "Global-shutter 5-point algorithm, the paper's baseline.",
        ),
    )
}

# This solver is not in the public table, because it does not estimate the rotation. [derived: two
# epipolar planes determine the direction of translation]
GYRO_2PT = Solver(
    'gyro_2pt',
    2,
    ANGULAR,
    common.solve_gyro_2pt,
    1,
    'Gyro 2-point algorithm: rotation known, no linear velocity.',
    needs_rotation=True,
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
        Linear velocities, each in its own camera's frame [baselines per second]; zero for a model
        without velocities.
    """

    R: Array
    t: Array
    v1: Array
    v2: Array


# The documentation of each solver ends with this text. [derived: the checks of `as_function`]
_ARGUMENTS = """

    Parameters
    ----------
    rays1, rays2 : ({n}, 3) array_like
        Rays, each in its own camera's frame, of any length but zero; {rays}.
    tau1, tau2 : ({n},) array_like
        Row times [s] relative to the reference row.
    gravity1, gravity2 : (3,) array_like
        Direction of free fall in each camera's frame at the reference row, of any length; used by
        `uniform_9pt`, `linear_9pt` and `angular_3pt`.
    start_rotations : (K, 3, 3) array_like
        Rotations from which `uniform_11pt` starts: the gyro's prediction, or the solutions of
        `angular_5pt`.

    Returns
    -------
    list of MinimalSolution
        All real solutions; `uniform_11pt` gives the distinct solutions that it reaches. Both
        (t, v1, v2) and its negative solve the equations. The sign is that with more of the points
        in front of both cameras, at the positions of the cameras at their rows.

    Raises
    ------
    InputError
        A wrong shape, a value that is not finite, a zero vector, a start that is not a rotation,
        or a missing argument that the solver uses.
    """


def as_function(row: Solver) -> Callable[..., list[MinimalSolution]]:
    """Make a pure function of the solver of a row."""
    n = row.sample_size

    def solve(
        rays1: ArrayLike,
        rays2: ArrayLike,
        tau1: ArrayLike,
        tau2: ArrayLike,
        *,
        gravity1: ArrayLike | None = None,
        gravity2: ArrayLike | None = None,
        start_rotations: ArrayLike | None = None,
    ) -> list[MinimalSolution]:
        sample = Sample(
            validate.unit_vectors('rays1', rays1, (n, 3)),
            validate.unit_vectors('rays2', rays2, (n, 3)),
            validate.array('tau1', tau1, (n,)),
            validate.array('tau2', tau2, (n,)),
        )
        known = common.no_knowledge()
        if row.needs_gravity:
            known = known._replace(
                align1=_alignment('gravity1', gravity1), align2=_alignment('gravity2', gravity2)
            )
        if not row.starts_from_rotation:
            return list(_solutions(row, sample, known))
        found: list[MinimalSolution] = []
        for start in validate.rotations('start_rotations', start_rotations, ('K', 3, 3)):
            # |R - R'| = 2 sqrt(2) |sin(angle / 2)|: two starts of one solution agree to 1e-7 rad.
            found.extend(
                s
                for s in _solutions(row, sample, known._replace(rotation=start, predicted=True))
                if all(np.linalg.norm(s.R - other.R) > np.sqrt(2.0) * 1e-7 for other in found)
            )
        return found

    solve.__name__ = solve.__qualname__ = row.name
    rays = 'derotated by the gyro' if row.model.derotated else 'as measured'
    of_kernel = str(row.solve.__doc__).rstrip()
    arguments = _ARGUMENTS.format(n=n, rays=rays)
    solve.__doc__ = f'{row.summary}\n\n    {of_kernel}{arguments}'
    return solve


def _alignment(name: str, gravity: ArrayLike | None) -> Array:
    if gravity is None:
        raise InputError(
            f'{name} must be given to this solver: the direction of free fall (3,) '
            'in the camera frame'
        )
    return common.gravity_alignment(validate.unit_vectors(name, gravity, (3,)))


def _solutions(row: Solver, sample: Sample, known: Knowledge) -> Iterator[MinimalSolution]:
    out = common.empty_solutions(row.most_solutions)
    count = common.run_solver(row.address, sample, known, out)
    for R, x in zip(out.R[:count], out.x, strict=False):
        t, d1, d2 = x.reshape(3, 3)  # d1 and d2 are zero without velocities
        yield MinimalSolution(R, t, d1, R.T @ d2)
