"""What a minimal solver returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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
