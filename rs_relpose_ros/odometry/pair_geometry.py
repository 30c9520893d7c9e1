"""Residuals of a pair between two bodies that carry a camera, with derivatives.

Unknowns are pose and velocity of the body (the IMU) at both instants; the camera hangs on it by
``v_cam = C v_body`` and its position c in the body. With camera poses (R_k, p_k), ``u`` the
direction and b the length of ``q = R_1^T (p_2 - p_1)``, the deviations are::

    theta = Log(R_1^T R_2 R^T),  s = B^T u / (t . u),  R_1^T v_k / b - d_k

as of `rs_relpose_ros.estimator.image_information`, R, t, d_k being the measured ones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.so3 import log_so3
from rs_relpose_ros.geometry.vectors import norm, tangent_basis

Array = NDArray[np.float64]

# Shortest baseline [m]: below it, a direction has no meaning.
_LEAST_BASELINE = 1e-4


class Mounting(NamedTuple):
    """Camera on a body: ``v_cam = R v_body``, `position` of the camera in the body [m]."""

    R: Array
    position: Array


class BodyState(NamedTuple):
    """Body in the world: ``R`` (3, 3) from its axes, position [m], velocity [m/s], rate [rad/s].

    The rate is in the axes of the body.
    """

    R: Array
    position: Array
    velocity: Array
    rate: Array


@kernel
def _skew(v: Array) -> Array:
    """``_skew(a) @ b = a x b``."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@kernel
def deviations(first: BodyState, second: BodyState, mounting: Mounting, R: Array, t: Array,
               velocities: Array) -> tuple[Array, Array]:
    """Deviations (11,) of a measured pair, and their derivatives (11, 18).

    By small turns and steps of the first body (in its axes), a change of its velocity (in the
    world), and the same of the second. All arrays are contiguous.
    """
    C, c = mounting.R, mounting.position
    arm = _skew(c)
    back = C @ first.R.T
    R12 = back @ second.R @ C.T
    R12C = R12 @ C
    q = back @ (second.position + second.R @ c - first.position - first.R @ c)
    b = max(norm(q), _LEAST_BASELINE)
    u = q / b
    dq = np.zeros((3, 18))
    dq[:, 0:3], dq[:, 3:6] = _skew(q) @ C + C @ arm, -C
    dq[:, 9:12], dq[:, 12:15] = -R12C @ arm, R12C
    db = u @ dq
    e, by = np.empty(11), np.zeros((11, 18))
    e[0:3] = log_so3(R12 @ R.T)
    by[0:3, 0:3], by[0:3, 9:12] = -C, R12C
    B, along = tangent_basis(t), t @ u
    # Behind the measured direction it has no tangent: the sine instead.
    along = along if along > 0.1 else 1.0
    du = (dq - np.outer(u, db)) / b
    e[3:5] = B.T @ u / along
    by[3:5] = (B.T @ du - np.outer(e[3:5], t @ du)) / along
    for k in range(2):
        body = first if k == 0 else second
        # The camera's place turns with the body.
        swing = _skew(body.rate) @ c
        w = back @ (body.velocity + body.R @ swing)
        own, rows = 9 * k, slice(5 + 3 * k, 8 + 3 * k)
        e[rows] = w / b - velocities[3 * k:3 * k + 3]
        by[rows, 0:3] += _skew(w) @ C
        by[rows, own:own + 3] -= (C if k == 0 else R12C) @ _skew(swing)
        by[rows, own + 6:own + 9] = back
        by[rows] = (by[rows] - np.outer(w / b, db)) / b
    return e, by


def square_root(information: Array, gradient: Array) -> tuple[Array, Array]:
    """A (k, n) and a (k,) with ``|A e + a|^2 = e^T H e + 2 g^T e`` and a constant.

    What H does not observe is left out.
    """
    values, vectors = np.linalg.eigh(information)
    seen = values > 1e-10 * max(values[-1], 1e-300)
    roots = np.sqrt(values[seen])
    return roots[:, None] * vectors[:, seen].T, (vectors[:, seen].T @ gradient) / roots
