"""Angular 3-point solver: derotated rays and gravity; yaw and translation unknown."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.vectors import rotated_back
from rs_relpose_ros.solvers.cheirality import point_forward
from rs_relpose_ros.solvers.gravity import align_rays, normals_at_yaw, rotation_from_yaw
from rs_relpose_ros.solvers.linear_algebra import null_direction
from rs_relpose_ros.solvers.solver import Knowledge, Sample, Solutions
from rs_relpose_ros.solvers.trigonometric import (
    angles_of_zeros,
    half_angle_matrix,
    half_angle_nodes,
    sample_angle,
)

Array = NDArray[np.float64]

MAX_SOLUTIONS = 4
DEGREE = 2
HALF_ANGLE, NODES = half_angle_matrix(DEGREE), half_angle_nodes(DEGREE)


@kernel
def _triple(a: Array, b: Array, c: Array) -> float:
    """``a . (b x c)``."""
    return (a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2])
            + a[2] * (b[0] * c[1] - b[1] * c[0]))


@kernel
def _newton_step(n: Array, dn: Array) -> float:
    """``det / (d det / d psi)`` of the three normals."""
    slope = (_triple(dn[0], n[1], n[2]) + _triple(n[0], dn[1], n[2])
             + _triple(n[0], n[1], dn[2]))
    return _triple(n[0], n[1], n[2]) / slope


@kernel
def solve_angular_3pt(sample: Sample, known: Knowledge, out: Solutions) -> int:
    """The normals ``n = f_1 x R f_2`` of three matches lie in one plane, perpendicular to t.

    With gravity on z in both frames ``R = A_1^T Rz(psi) A_2``, and the determinant of the 3x3
    matrix of normals (section 'Angular 3-point algorithm') is a trigonometric polynomial of degree
    2 in psi: five samples give a polynomial of degree 4 in the tangent of the half angle. For the
    global shutter this is the upright 3-point problem of Fraundorfer et al. (ECCV 2010).

    The model is exact for a global shutter and on a flight of constant velocity.
    """
    rays = align_rays(sample, known)
    n, dn = np.empty((3, 3)), np.empty((3, 3))
    samples = np.empty(NODES.shape[0])
    for k in range(NODES.shape[0]):
        c, s, weight = sample_angle(NODES[k], rays.zoom)
        normals_at_yaw(rays, c, s, n, dn)
        samples[k] = _triple(n[0], n[1], n[2]) * weight**DEGREE
    angles, half_gaps = np.empty(MAX_SOLUTIONS), np.empty(MAX_SOLUTIONS)
    found = angles_of_zeros(samples, HALF_ANGLE, rays.zoom, angles, half_gaps)
    count = 0
    for k in range(found):
        psi = angles[k]
        normals_at_yaw(rays, math.cos(psi), math.sin(psi), n, dn)
        if half_gaps[k] == 0.0:
            # The step is taken on the determinant itself: free of the polynomial's rounding.
            step = _newton_step(n, dn)
            if abs(step) < 1e-4:
                psi -= step
                normals_at_yaw(rays, math.cos(psi), math.sin(psi), n, dn)
        direction, length2 = null_direction(n)
        if not length2 > 1e-28:
            continue
        t, scale = rotated_back(known.align1, direction), 1.0 / math.sqrt(length2)
        for i in range(3):
            out.x[count, i] = scale * t[i]
        rotation_from_yaw(rays.centre + psi, known, out.R[count])
        point_forward(sample, out.R[count], out.x[count])
        count += 1
    return count
