"""Where a camera that turns while it reads its rows sees rays: each by the row that sees it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.distortion.models import distort_at
from rs_relpose_ros.geometry.vectors import dot

Array = NDArray[np.float64]


@kernel
def project_turning(rays: Array, rows: Array, rotations: Array, height: int,
                    intrinsics: tuple[float, float, float, float], distort: int,
                    k: Array) -> Array:
    """Raw pixels (N, 2) of rays (N, 3); NaN behind the camera, or where no one row sees a ray.

    A ray is seen in row v if it is projected into row v with the orientation of the camera while
    that row is read: a root of ``projected_row(v) - v``, found by secants from `rows` (N,) on.

    Parameters
    ----------
    rotations : (K, 3, 3) ndarray
        From the frame of the rays to that of the camera, at K rows spread evenly from the first to
        the last one; linear in between, and beyond.
    intrinsics : tuple
        fx, fy, cx, cy.
    distort : int
        Address of the distortion model's kernel, `k` its coefficients.
    """
    settled = 0.01   # of the row that was read against the row in which the ray is seen [px]
    most_rounds = 12
    nearest = 1e-9   # depth from which a ray lies before the camera
    fx, fy, cx, cy = intrinsics
    out, turned, values = np.empty((len(rays), 2)), np.empty(3), np.empty(6)
    per_row = (len(rotations) - 1) / max(height - 1.0, 1.0)
    for n in range(len(rays)):
        row, before, ahead, slope = rows[n], rows[n], 0.0, 0.0
        u = v = math.nan
        for step in range(most_rounds):
            place = row * per_row
            i = int(min(max(place, 0.0), len(rotations) - 2.0))
            share = place - i
            for j in range(3):
                first, second = dot(rotations[i, j], rays[n]), dot(rotations[i + 1, j], rays[n])
                turned[j] = first + share * (second - first)
            if not turned[2] > nearest:
                u = v = math.nan
                break
            distort_at(distort, turned[0] / turned[2], turned[1] / turned[2], k, values)
            u, v = cx + fx * values[0], cy + fy * values[1]
            if abs(v - row) < settled:
                break
            if step == most_rounds - 1:
                u = v = math.nan
            # Slope of the projected row by the row that is read.
            if step > 0 and row != before:
                slope = (v - ahead) / (row - before)
            if not abs(slope) < 0.9:
                slope = 0.0
            before, ahead = row, v
            row += (v - row) / (1.0 - slope)
        out[n, 0], out[n, 1] = u, v
    return out
