"""OpenCV's rational model (REP-104), of which plumb_bob is a part, with its thin-prism terms."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel

Array = NDArray[np.float64]


@kernel
def distort(x: float, y: float, k: Array, out: Array) -> None:
    """As `DistortionModel.distort`; `k` (12,): k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4."""
    r2 = x * x + y * y
    above = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    below = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    radial = above / below
    # d radial / d(r^2)
    slope = ((k[0] + r2 * (2.0 * k[1] + r2 * 3.0 * k[4]))
             - radial * (k[5] + r2 * (2.0 * k[6] + r2 * 3.0 * k[7]))) / below
    p1, p2 = k[2], k[3]
    out[0] = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (k[8] + r2 * k[9])
    out[1] = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (k[10] + r2 * k[11])
    prism_x, prism_y = k[8] + 2.0 * r2 * k[9], k[10] + 2.0 * r2 * k[11]
    cross = 2.0 * slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    out[2] = radial + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * x * prism_x
    out[3] = cross + 2.0 * y * prism_x
    out[4] = cross + 2.0 * x * prism_y
    out[5] = radial + 2.0 * slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x + 2.0 * y * prism_y


@kernel
def first_guess(u: float, v: float, out: Array) -> None:
    """The distorted point itself."""
    out[0], out[1] = u, v
