"""The two-view problem at the **middle** rows, common to all steps of the estimator.

Motion and pose refer to the middle row of each frame, which decouples the translation from the
velocities; `to_reference_row` moves the result, with its covariance, to the user's reference row.
"""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.so3 import skew
from rs_relpose_ros.jit import kernel


@dataclass(frozen=True, slots=True, eq=False)
class TwoViewProblem:
    """Matches and IMU measurements of one pair, frames at their middle rows."""

    observations: Array  # (N, 20) rows of `sampson`; zero if a match cannot be unprojected
    points: Array  # (6, N) columns of `sampling.multi_scale_cost`
    valid: NDArray[np.bool_]  # (N,) matches with finite rays
    focal: float  # [px] mean focal length: pixels per radian at the image centre
    motion1: FrameMotion
    motion2: FrameMotion
    # [s] of the user's reference row, at which gravity was measured, from the middle row
    reference_row_time: float
    rotation: Array | None  # (3, 3) R_1^T R_2 by the gyro
    rotation_information: Array | None  # (3, 3) inverse covariance of its error in frame 1


def middle_row_delay(camera: RollingShutterCamera) -> float:
    """Row time [s] of the middle row, against the camera's reference row."""
    return float(camera.row_times((camera.height - 1) / 2))


def build_problem(
    points1: Array,
    points2: Array,
    camera: RollingShutterCamera,
    motion1: FrameMotion,
    motion2: FrameMotion,
    relative_rotation: Array | None,
    relative_rotation_covariance: Array | None,
    by_gyro: bool = True,
) -> TwoViewProblem:
    """Unproject, derotate and move to the middle row.

    Without `by_gyro` (models without angular velocity: linear, global) rays are as measured.
    """
    delay = middle_row_delay(camera)
    motion1, motion2 = motion1.shifted(delay), motion2.shifted(delay)
    rotation = information = None
    if relative_rotation is not None and relative_rotation_covariance is not None:
        # R' = Exp(w_1 D)^T R Exp(w_2 D); after the shift, the old reference row lies at -D.
        e1 = motion1.rotations([-delay])[0]
        e2 = motion2.rotations([-delay])[0]
        rotation = e1 @ relative_rotation @ e2.T
        covariance = e1 @ relative_rotation_covariance @ e1.T
        # A floor far below any gyro keeps the information finite.
        information = np.linalg.inv(covariance + 1e-14 * np.eye(3))
        information = 0.5 * (information + information.T)
    observations = np.empty((len(points1), 20))
    for k, (pixels, motion) in enumerate(((points1, motion1), (points2, motion2))):
        rays, jacobian = camera.unproject_with_jacobian(pixels)
        tau = camera.row_times(pixels[:, 1]) - delay
        rotations, rate = (
            (motion.rotations(tau), motion.angular_velocity)
            if by_gyro
            else (np.tile(np.eye(3), (len(tau), 1, 1)), np.zeros(3))
        )
        derotate(
            rays, jacobian, rotations, camera.line_delay * rate, observations[:, 9 * k : 9 * k + 9]
        )
        observations[:, 18 + k] = tau
    valid, points = _checked_columns(observations)
    return TwoViewProblem(
        observations,
        points,
        valid,
        0.5 * (camera.fx + camera.fy),
        motion1,
        motion2,
        -delay,
        rotation,
        information,
    )


@kernel
def derotate(
    rays: Array, jacobian: Array, rotations: Array, row_rotation: Array, block: Array
) -> None:
    """Fill one camera's `block` (N, 9): derotated ray and its derivatives by u and v."""
    for i in range(len(rays)):
        for j in range(3):
            f = u = v = 0.0
            for k in range(3):
                f += rotations[i, j, k] * rays[i, k]
                u += rotations[i, j, k] * jacobian[i, k, 0]
                v += rotations[i, j, k] * jacobian[i, k, 1]
            block[i, j], block[i, 3 + j], block[i, 6 + j] = f, u, v
        # One row further down, the camera has rotated for one more line delay.
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            block[i, 6 + j] += row_rotation[k] * block[i, m] - row_rotation[m] * block[i, k]


@kernel
def _checked_columns(observations: Array) -> tuple[NDArray[np.bool_], Array]:
    """Which rows are finite (the others become zero), and the points for `sampling`."""
    n = len(observations)
    valid, points = np.empty(n, dtype=np.bool_), np.full((6, n), np.nan)
    for i in range(n):
        o = observations[i]
        valid[i] = True
        for k in range(len(o)):
            valid[i] &= math.isfinite(o[k])
        if not valid[i]:
            o[:] = 0.0
        elif o[2] > 1e-6 and o[11] > 1e-6:
            points[0, i], points[1, i] = o[0] / o[2], o[1] / o[2]
            points[2, i], points[3, i] = o[9] / o[11], o[10] / o[11]
            points[4, i], points[5, i] = o[18], o[19]
    return valid, points


@dataclass(frozen=True, slots=True, eq=False)
class PairState:
    """A pose between two rows with its covariance; velocities each in its own camera's frame.

    ``covariance`` (19, 19) is of ``(dt, dtheta, dv_1, dv_2, dw_1, dw_2, dlog b)``: dt, dtheta in
    camera 1 as in `RelativePose`, velocities in their own frames, b the length of the baseline.
    """

    R: Array
    t: Array
    v1: Array
    v2: Array
    w1: Array
    w2: Array
    log_baseline: float
    covariance: Array


def to_reference_row(state: PairState, delay: float, e1: Array, e2: Array) -> PairState:
    """The same motion between rows that are read `delay` seconds later.

    ``R' = E_1^T R E_2``, ``t' = E_1^T (t - D v_1 + D R v_2)``, then ``|t'| = 1`` again: velocities
    and covariance are rescaled. First-order covariance. `e1`, `e2` (3, 3): ``E_i``, the rotation
    of each camera during `delay`; ``Exp(w_i D)`` at a constant rate.
    """
    R = e1.T @ state.R @ e2
    baseline = state.t - delay * state.v1 + delay * state.R @ state.v2
    scale = float(np.linalg.norm(baseline))
    t = e1.T @ baseline / scale
    v1, v2 = e1.T @ state.v1 / scale, e2.T @ state.v2 / scale

    eye = np.eye(3)
    jacobian = np.zeros((19, 19))
    TT, TH, V1, V2, W1, W2 = (slice(3 * k, 3 * k + 3) for k in range(6))
    # t_true = t + dt, R_true = Exp(th) R: baseline' = E1^T (dt - D dv1 + D R dv2 - D [R v2]x th
    #   + D [baseline]x dw1), with rate errors as Exp(D dw_i) E_i.
    by = np.hstack(
        [
            eye,
            -delay * skew(state.R @ state.v2),
            -delay * eye,
            delay * state.R,
            delay * skew(baseline),
            np.zeros((3, 4)),
        ]
    )
    by = e1.T @ by / scale
    jacobian[TT] = (eye - np.outer(t, t)) @ by
    # th' = E1^T (th - D dw1) + E1^T R E2 (D dw2): errors of the rates rotate the rows.
    jacobian[TH, TH] = e1.T
    jacobian[TH, W1] = -delay * e1.T
    jacobian[TH, W2] = delay * e1.T @ state.R
    along = t @ by
    for block, velocity, e in ((V1, v1, e1), (V2, v2, e2)):
        jacobian[block, block] = e.T / scale
        jacobian[block] -= np.outer(velocity, along)
    jacobian[V1, W1] += delay * skew(v1) @ e1.T
    jacobian[V2, W2] += delay * skew(v2) @ e2.T
    jacobian[W1, W1] = jacobian[W2, W2] = eye
    jacobian[18] = along
    jacobian[18, 18] += 1.0
    return PairState(
        R,
        t,
        v1,
        v2,
        state.w1,
        state.w2,
        state.log_baseline + math.log(scale),
        jacobian @ state.covariance @ jacobian.T,
    )
