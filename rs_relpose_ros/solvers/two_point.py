"""Gyro 2-point solver: rotation predicted by the gyro; translation unknown."""

from __future__ import annotations

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.vectors import cross, norm, rotated
from rs_relpose_ros.solvers.solver import Knowledge, Sample, Solutions


@kernel
def solve_gyro_2pt(sample: Sample, known: Knowledge, out: Solutions) -> int:
    """The translation is perpendicular to the normals ``n = f_1 x R f_2`` of both matches."""
    R = known.rotation
    n1 = cross(sample.f1[0], rotated(R, sample.f2[0]))
    n2 = cross(sample.f1[1], rotated(R, sample.f2[1]))
    t = cross(n1, n2)
    length = norm(t)
    if not length > 1e-14:
        return 0
    out.R[0] = R
    for i in range(3):
        out.x[0, i] = t[i] / length
    return 1
