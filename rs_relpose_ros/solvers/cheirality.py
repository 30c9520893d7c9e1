"""Cheirality: which sign of the translation puts the points in front of both cameras."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel

Array = NDArray[np.float64]


@kernel
def cheirality_votes(f1: Array, f2: Array, tau1: Array, tau2: Array, R: Array,
                     x: Array) -> tuple[int, int]:
    """Points in front of both cameras for ``x = (t, d_1, d_2)``, and for ``-x``.

    Each point is triangulated from the two positions that the cameras had at its own rows:
    ``lambda_1 f_1 - lambda_2 R f_2 = t - tau_1 d_1 + tau_2 d_2`` in the least-squares sense.

    Parameters
    ----------
    f1, f2 : (n, 3) ndarray
        Unit rays in their own camera's frame.
    tau1, tau2 : (n,) ndarray
        Row times [s]; not read when `x` has only the three elements of t.
    x : (3,) or (9,) ndarray
        In frame 1.
    """
    front = 0
    behind = 0
    moving = x.shape[0] == 9
    for k in range(f1.shape[0]):
        along1 = 0.0  # f_1 . b
        along2 = 0.0  # R f_2 . b
        cosine = 0.0
        for i in range(3):
            h = R[i, 0] * f2[k, 0] + R[i, 1] * f2[k, 1] + R[i, 2] * f2[k, 2]
            b = x[i]
            if moving:
                b += tau2[k] * x[6 + i] - tau1[k] * x[3 + i]
            along1 += f1[k, i] * b
            along2 += h * b
            cosine += f1[k, i] * h
        # Both depths times sin^2 of the angle between the rays.
        depth1 = along1 - cosine * along2
        depth2 = cosine * along1 - along2
        if depth1 > 0.0 and depth2 > 0.0:
            front += 1
        elif depth1 < 0.0 and depth2 < 0.0:
            behind += 1
    return front, behind
