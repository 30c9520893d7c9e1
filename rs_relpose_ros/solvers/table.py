"""The table of solvers: the paper's five minimal algorithms and the global-shutter 5-point.

All solve ``(f_1 x R f_2) . (t - tau_1 d_1 + tau_2 d_2) = 0`` (docs/conventions.md, equation 4),
with ``d_1 = v_1`` and ``d_2 = R v_2``, and differ in the rays, in the velocities that they look
for and in what is known of R. To add a solver: a module with its kernel, and its row here.

References
----------
C.-R. Lee and K.-J. Yoon, *Inertial-aided Rolling Shutter Relative Pose Estimation*, sections
'Minimal Algorithms' and 'Solver'.
"""

from __future__ import annotations

from rs_relpose_ros.solvers import (
    eleven_point,
    five_point,
    nine_point,
    three_point,
    two_point,
)
from rs_relpose_ros.solvers.solver import Model, Solver

UNIFORM = Model('uniform', derotated=True, velocities=True)
LINEAR = Model('linear', derotated=False, velocities=True)
ANGULAR = Model('angular', derotated=True, velocities=False)
GLOBAL = Model('global', derotated=False, velocities=False)

SOLVERS = {solver.name: solver for solver in (
    Solver('uniform_9pt', 9, UNIFORM, nine_point.solve_gravity_9pt, nine_point.MAX_SOLUTIONS,
           'Uniform 9-point algorithm: gravity and angular velocity known.', needs_gravity=True),
    Solver('uniform_11pt', 11, UNIFORM, eleven_point.solve_uniform_11pt,
           eleven_point.MAX_SOLUTIONS,
           'Uniform 11-point algorithm: angular velocity known.', starts_from_rotation=True),
    Solver('linear_9pt', 9, LINEAR, nine_point.solve_gravity_9pt, nine_point.MAX_SOLUTIONS,
           'Linear 9-point algorithm: gravity known, no angular velocity.', needs_gravity=True),
    Solver('angular_5pt', 5, ANGULAR, five_point.solve_5pt, five_point.MAX_SOLUTIONS,
           'Angular 5-point algorithm: angular velocity known, no linear velocity.'),
    Solver('angular_3pt', 3, ANGULAR, three_point.solve_angular_3pt, three_point.MAX_SOLUTIONS,
           'Angular 3-point algorithm: gravity and angular velocity known, no linear velocity.',
           needs_gravity=True),
    Solver('global_5pt', 5, GLOBAL, five_point.solve_5pt, five_point.MAX_SOLUTIONS,
           "Global-shutter 5-point algorithm, the paper's baseline."),
)}

# Not offered by name: it says nothing of the rotation.
GYRO_2PT = Solver('gyro_2pt', 2, ANGULAR, two_point.solve_gyro_2pt, 1,
                  'Gyro 2-point algorithm: rotation known, no linear velocity.',
                  needs_rotation=True)
