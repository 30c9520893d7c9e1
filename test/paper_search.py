"""The paper's own solver, as a reference: Levenberg-Marquardt on determinants from a start.

Written apart from the kernels, with SciPy and singular value decompositions on the paper's columns
``[n, -tau_1 n, tau_2 n]``. It finds one solution, or none, and takes 20 ms where the kernels
take 0.2: for comparison only. Where it ends in a solution, that is one of the kernels'.
"""

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rs_relpose_ros.solvers.public import MinimalSolution

# Points and columns of each algorithm, and whether gravity leaves only the yaw unknown.
ALGORITHMS = {
    'linear_9pt': (9, 9, True),
    'uniform_9pt': (9, 9, True),
    'angular_3pt': (3, 3, True),
    'angular_5pt': (5, 3, False),
    'uniform_11pt': (11, 9, False),
}


def solve_by_determinants(algorithm, rays1, rays2, tau1, tau2, start_rotation, *, gravity1=None,
                          gravity2=None):
    """Solution of one of the paper's algorithms as the paper finds it, or None.

    ``min |det A(psi)|`` where gravity is known, else ``min |det A_1| + |det A_2| + |det A_3|``
    over three square blocks of consecutive rows of A(R), R by a quaternion, by
    Levenberg-Marquardt (on the sum of squares: the zeros are the same); then x from the singular
    value decomposition (section 'Solver'). The paper starts from the rotation of the
    global-shutter 5-point.

    None where the search ends in a minimum that is no zero, or where the blocks are singular but A
    is not. On 100 exact pairs each of `make_minimal_problems` (seed 21) the truth was reached from
    0.1, 1 and 5 degrees away in 88, 55 and 34 of 'uniform_9pt' and, at 10 m/s, in 66, 11 and 1 of
    'uniform_11pt'. Where velocities are not observable, x is the last right singular vector, an
    arbitrary one of the null space, as in the paper.
    """
    _, width, upright = ALGORITHMS[algorithm]
    unit = max(np.abs(tau1).max(), np.abs(tau2).max(), 1e-12)

    def columns(R):
        n = np.cross(rays1, rays2 @ R.T)
        if width == 3:
            return n
        return np.hstack([n, -tau1[:, None] / unit * n, tau2[:, None] / unit * n])

    if upright:
        up1, up2 = (Rotation.align_vectors([[0.0, 0.0, 1.0]], [gravity])[0].as_matrix()
                    for gravity in (gravity1, gravity2))
        M = up1 @ start_rotation @ up2.T
        unknown = np.array([np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1])])
    else:
        unknown = np.zeros(3)

    def rotation(parameters):
        if upright:
            return up1.T @ Rotation.from_euler('z', parameters[0]).as_matrix() @ up2
        # The paper's local parameters: the half angle, multiplied from the left.
        return Rotation.from_rotvec(2.0 * parameters).as_matrix() @ start_rotation

    # Constant factors, so that no determinant underflows: their zeros stay.
    row_scale = 1.0 / np.maximum(
        np.linalg.norm(columns(rotation(unknown)), axis=1, keepdims=True), 1e-12)
    blocks = [slice(k, k + width) for k in range(1 if upright else 3)]

    def determinants(parameters):
        scaled = row_scale * columns(rotation(parameters))
        # A determinant that underflows to zero is reported as a division by zero.
        with np.errstate(divide='ignore'):
            return np.array([np.linalg.det(scaled[block]) for block in blocks])

    fit = least_squares(determinants, unknown, method='lm', x_scale=0.01, xtol=1e-15, ftol=1e-15,
                        gtol=1e-15, max_nfev=400)
    R = rotation(fit.x)
    _, singular, right = np.linalg.svd(columns(R))
    if not singular[-1] < 1e-9 * singular[0]:
        return None
    x = np.concatenate([right[-1], np.zeros(9 - width)])
    x[3:] /= unit
    norm = np.linalg.norm(x[:3])
    if not norm > 0.0:
        return None
    t, d1, d2 = (x / norm).reshape(3, 3)
    # In front of both cameras: lambda_1 f_1 - lambda_2 R f_2 = b.
    b = t - tau1[:, None] * d1 + tau2[:, None] * d2
    depths = np.array([np.linalg.lstsq(np.stack([f, -R @ g], axis=1), c, rcond=None)[0]
                       for f, g, c in zip(rays1, rays2, b, strict=True)])
    if (depths < 0.0).all(axis=1).sum() > (depths > 0.0).all(axis=1).sum():
        t, d1, d2 = -t, -d1, -d2
    return MinimalSolution(R, t, d1, R.T @ d2)
