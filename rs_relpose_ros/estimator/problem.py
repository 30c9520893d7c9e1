"""The two-view problem at the **middle** rows, common to all steps of the estimator.

Motion and pose refer to the middle row of each frame, which decouples the translation from the
velocities; `to_reference_row` moves the result, with its covariance, to the user's reference row.
"""

from dataclasses import dataclass
import math

import numpy as np

from rs_relpose_ros.core.least_squares import slices
from rs_relpose_ros.estimator.sampson import OBSERVATION, TIMES, VIEW_1, VIEW_2
from rs_relpose_ros.geometry import Array, Flags
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.so3 import add, cross, rotated, skew
from rs_relpose_ros.jit import kernel

# Depth of a unit ray below which it has no point at z = 1. [chosen: any value in 1e-9..1e-3 keeps
# the quotients finite]
_NEAREST = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class TwoViewProblem:
    """Matches and IMU measurements of one pair, frames at their middle rows."""

    observations: Array  # (N, 20) rows of `sampson`; zero if a match cannot be unprojected
    points: Array  # (6, N) columns of `sampling.multi_scale_cost`
    valid: Flags  # (N,) matches with finite rays
    focal: float  # [px] mean focal length: pixels per radian at the image centre
    motion1: FrameMotion
    motion2: FrameMotion
    # Time of the reference row, at which gravity was measured, after the middle row [s]
    reference_row_time: float
    rotation: Array | None  # (3, 3) R_1^T R_2 by the gyro
    rotation_information: Array | None  # (3, 3) inverse covariance of its error in frame 1


def middle_row_delay(camera: RollingShutterCamera) -> float:
    """Row time [s] of the middle row, against the camera's reference row."""
    return float(camera.row_times(camera.middle_row))


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
    motion1 = motion1.shifted(delay)
    motion2 = motion2.shifted(delay)
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
    still = FrameMotion(np.zeros(3))
    rotating = (motion1, motion2) if by_gyro else (still, still)
    observations = np.empty((len(points1), OBSERVATION))
    for image, points in enumerate((points1, points2)):
        motion = rotating[image]
        rays, jacobian = camera.unproject_with_jacobian(points)
        row_times = camera.pixel_times(points) - delay
        derotate(
            rays,
            jacobian,
            motion.rotations(row_times),
            camera.line_delay * motion.angular_velocity,
            camera.readout_axis,
            observations[:, VIEW_2 * image : VIEW_2 * (image + 1)],
        )
        observations[:, TIMES + image] = row_times
    valid, points = _usable(observations)
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
    rays: Array, jacobian: Array, rotations: Array, turn_per_row: Array, axis: int, view: Array
) -> None:
    """Fill the `view` (N, 9) of one camera: derotated ray and its derivatives by u and v.

    `axis`: the pixel coordinate that is the row.
    """
    for i in range(len(rays)):
        R = rotations[i]
        ray = rotated(R, rays[i])
        by_u = rotated(R, jacobian[i, :, 0])
        by_v = rotated(R, jacobian[i, :, 1])
        # One row further, the camera has rotated for one more line delay.
        turn = cross(turn_per_row, ray)
        if axis == 1:
            by_v = add(by_v, turn)
        else:
            by_u = add(by_u, turn)
        for j in range(3):
            view[i, j] = ray[j]
            view[i, 3 + j] = by_u[j]
            view[i, 6 + j] = by_v[j]


@kernel
def _usable(observations: Array) -> tuple[Flags, Array]:
    """Which rows are finite, and the points (6, N) of `sampling.multi_scale_cost`.

    The other rows become zero. Points are NaN there, and behind one of the cameras.
    """
    valid = np.empty(len(observations), dtype=np.bool_)
    points = np.full((6, len(observations)), np.nan)
    for i in range(len(observations)):
        o = observations[i]
        total = 0.0  # is finite if all numbers are
        for number in o:
            total += number
        valid[i] = math.isfinite(total)
        if not valid[i]:
            o[:] = 0.0
        depth1 = o[VIEW_1 + 2]
        depth2 = o[VIEW_2 + 2]
        if depth1 > _NEAREST and depth2 > _NEAREST:
            for k in range(2):
                points[k, i] = o[VIEW_1 + k] / depth1
                points[2 + k, i] = o[VIEW_2 + k] / depth2
                points[4 + k, i] = o[TIMES + k]
    return valid, points


# -- The pose between two rows, with its covariance -----------------------------------------------

# Parts of the deviation of a `PairState`, in the order of its covariance. [derived: its fields]
PARTS = slices(t=3, theta=3, v1=3, v2=3, w1=3, w2=3, log_baseline=1)


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
    v1 = e1.T @ state.v1 / scale
    v2 = e2.T @ state.v2 / scale

    eye = np.eye(3)
    size = len(state.covariance)
    jacobian = np.zeros((size, size))
    T, THETA, V1, V2, W1, W2, LOG_BASELINE = PARTS.values()
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
    along = t @ by
    jacobian[T] = (eye - np.outer(t, t)) @ by
    # th' = E1^T (th - D dw1) + E1^T R E2 (D dw2): errors of the rates rotate the rows.
    jacobian[THETA, THETA] = e1.T
    jacobian[THETA, W1] = -delay * e1.T
    jacobian[THETA, W2] = delay * e1.T @ state.R
    jacobian[V1, V1] = e1.T / scale
    jacobian[V2, V2] = e2.T / scale
    jacobian[V1] -= np.outer(v1, along)
    jacobian[V2] -= np.outer(v2, along)
    jacobian[V1, W1] += delay * skew(v1) @ e1.T
    jacobian[V2, W2] += delay * skew(v2) @ e2.T
    jacobian[W1, W1] = eye
    jacobian[W2, W2] = eye
    jacobian[LOG_BASELINE] = along
    jacobian[LOG_BASELINE, LOG_BASELINE] += 1.0
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
