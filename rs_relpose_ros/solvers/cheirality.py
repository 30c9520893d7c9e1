"""Cheirality: which sign of the translation puts the points in front of both cameras."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.vectors import dot, rotated
from rs_relpose_ros.solvers.solver import Sample

Array = NDArray[np.float64]


@kernel
def cheirality_votes(sample: Sample, R: Array, x: Array) -> tuple[int, int]:
    """Points in front of both cameras for ``x = (t, d_1, d_2)`` (9,), and for ``-x``.

    Each point is triangulated from the two positions that the cameras had at its own rows:
    ``lambda_1 f_1 - lambda_2 R f_2 = b = t - tau_1 d_1 + tau_2 d_2`` in the least-squares sense.
    """
    front = 0
    behind = 0
    for k in range(sample.f1.shape[0]):
        f1, h = sample.f1[k], rotated(R, sample.f2[k])
        tau1, tau2 = sample.tau1[k], sample.tau2[k]
        b = (x[0] + (tau2 * x[6] - tau1 * x[3]), x[1] + (tau2 * x[7] - tau1 * x[4]),
             x[2] + (tau2 * x[8] - tau1 * x[5]))
        along1, along2, cosine = dot(f1, b), dot(h, b), dot(f1, h)
        # Both depths times sin^2 of the angle between the rays.
        depth1 = along1 - cosine * along2
        depth2 = cosine * along1 - along2
        if depth1 > 0.0 and depth2 > 0.0:
            front += 1
        elif depth1 < 0.0 and depth2 < 0.0:
            behind += 1
    return front, behind


@kernel
def point_forward(sample: Sample, R: Array, x: Array) -> None:
    """Give `x` (9,) the sign that puts most points in front of both cameras."""
    front, behind = cheirality_votes(sample, R, x)
    if behind > front:
        for i in range(9):
            x[i] = 0.0 - x[i]  # not -x: a velocity of zero stays +0
