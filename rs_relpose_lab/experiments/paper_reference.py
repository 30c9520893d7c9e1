"""The paper's own solver, as a reference: Levenberg-Marquardt on determinants from a start.

Written apart from the kernels, with SciPy and singular value decompositions on the paper's columns
``[n, -tau_1 n, tau_2 n]``. It finds one solution, or none, and takes 20 ms where the kernels
take 0.2: for comparison only. Where it ends in a solution, that is one of the kernels'.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.solvers import inputs
from rs_relpose_ros.solvers.public import MinimalSolution

Array = NDArray[np.float64]

# Points and columns of each algorithm, and whether gravity leaves only the yaw unknown.
_ALGORITHMS = {
    'linear_9pt': (9, 9, True),
    'uniform_9pt': (9, 9, True),
    'angular_3pt': (3, 3, True),
    'angular_5pt': (5, 3, False),
    'uniform_11pt': (11, 9, False),
}

# Smallest singular value, relative to the largest, at which the determinants count as zero.
_SINGULAR = 1e-9


def solve_by_determinants(algorithm: str, rays1: ArrayLike, rays2: ArrayLike, tau1: ArrayLike,
                          tau2: ArrayLike, start_rotation: ArrayLike, *,
                          gravity1: ArrayLike | None = None,
                          gravity2: ArrayLike | None = None) -> MinimalSolution | None:
    """Solution of one of the paper's algorithms as the paper finds it.

    ``min |det A(psi)|`` where gravity is known, else ``min |det A_1| + |det A_2| + |det A_3|``
    over three square blocks of consecutive rows of A(R), R by a quaternion, by
    Levenberg-Marquardt (on the sum of squares: the zeros are the same); then x from the singular
    value decomposition (section 'Solver').

    Parameters
    ----------
    algorithm : {'linear_9pt', 'uniform_9pt', 'angular_3pt', 'angular_5pt', 'uniform_11pt'}
        Its number of points n follows from the name.
    rays1, rays2 : (n, 3) array_like
        Measured ('linear_9pt') or derotated rays, each in its own camera's frame.
    tau1, tau2 : (n,) array_like
        Row times [s] relative to the reference row.
    start_rotation : (3, 3) array_like
        Where the search starts: the paper takes the global-shutter 5-point's rotation.
    gravity1, gravity2 : (3,) array_like
        Direction of free fall in each camera's frame; for the algorithms that know gravity.

    Returns
    -------
    MinimalSolution or None
        None where the search ends in a minimum that is no zero, or where the blocks are singular
        but A is not.

    Raises
    ------
    InputError
        An unknown algorithm, a wrong shape, a value that is not finite, or no gravity.

    Notes
    -----
    What is found depends on the start. On 100 exact pairs each of `make_minimal_problems` (of the
    tests; seed 21) the truth was reached from 0.1, 1 and 5 degrees away in 88, 55 and 34 of
    'uniform_9pt' and, at 10 m/s, in 66, 11 and 1 of 'uniform_11pt'. Where velocities are not
    observable, x is the last right singular vector, an arbitrary one of the null space, as in
    the paper.
    """
    if algorithm not in _ALGORITHMS:
        raise InputError(f'algorithm must be one of {tuple(_ALGORITHMS)}, got {algorithm!r}')
    points, width, upright = _ALGORITHMS[algorithm]
    f1, f2 = inputs.rays('rays1', rays1, points), inputs.rays('rays2', rays2, points)
    times1 = inputs.row_times('tau1', tau1, points)
    times2 = inputs.row_times('tau2', tau2, points)
    start = inputs.rotations('start_rotation', np.asarray(start_rotation)[None])[0]
    unit = max(np.abs(times1).max(), np.abs(times2).max(), 1e-12)

    def columns(R: Array) -> Array:
        n = np.cross(f1, f2 @ R.T)
        if width == 3:
            return n
        return np.hstack([n, -times1[:, None] / unit * n, times2[:, None] / unit * n])

    rotation: Callable[[Array], Array]
    if upright:
        up1 = _to_vertical(inputs.gravity('gravity1', gravity1))
        up2 = _to_vertical(inputs.gravity('gravity2', gravity2))
        M = up1 @ start @ up2.T
        unknown = np.array([np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1])])

        def rotation(psi: Array) -> Array:
            turned: Array = up1.T @ Rotation.from_euler('z', psi[0]).as_matrix() @ up2
            return turned
    else:
        unknown = np.zeros(3)

        def rotation(dq: Array) -> Array:
            # The paper's local parameters: the half angle, multiplied from the left.
            turned: Array = Rotation.from_rotvec(2.0 * dq).as_matrix() @ start
            return turned

    # Constant factors, so that no determinant underflows: their zeros stay.
    A = columns(rotation(unknown))
    row_scale = 1.0 / np.maximum(np.linalg.norm(A, axis=1, keepdims=True), 1e-12)
    blocks = [slice(k, k + width) for k in range(1 if upright else 3)]

    def determinants(parameters: Array) -> Array:
        scaled = row_scale * columns(rotation(parameters))
        # A determinant that underflows to zero is reported as a division by zero.
        with np.errstate(divide='ignore'):
            return np.array([np.linalg.det(scaled[block]) for block in blocks])

    fit = least_squares(determinants, unknown, method='lm', x_scale=0.01, xtol=1e-15, ftol=1e-15,
                        gtol=1e-15, max_nfev=400)
    R = rotation(fit.x)
    _, singular, right = np.linalg.svd(columns(R))
    if not singular[-1] < _SINGULAR * singular[0]:
        return None
    x = np.concatenate([right[-1], np.zeros(9 - width)])
    x[3:] /= unit
    norm = np.linalg.norm(x[:3])
    if not norm > 0.0:
        return None
    t, d1, d2 = (x / norm).reshape(3, 3)
    # In front of both cameras: lambda_1 f_1 - lambda_2 R f_2 = b.
    b = t - times1[:, None] * d1 + times2[:, None] * d2
    depths = np.array([np.linalg.lstsq(np.stack([f, -R @ g], axis=1), c, rcond=None)[0]
                       for f, g, c in zip(f1, f2, b, strict=True)])
    if (depths < 0.0).all(axis=1).sum() > (depths > 0.0).all(axis=1).sum():
        t, d1, d2 = -t, -d1, -d2
    return MinimalSolution(R, t, d1, R.T @ d2)


def _to_vertical(gravity: Array) -> Array:
    """A rotation that turns a unit `gravity` (3,) onto z."""
    rotation: Array = Rotation.align_vectors([[0.0, 0.0, 1.0]], [gravity])[0].as_matrix()
    return rotation
