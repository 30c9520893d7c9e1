"""A keyframe pair as a measurement of two bodies with a camera: residuals and derivatives.

Free of gtsam, for graphs of other libraries.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.calibration.findings import Code, Finding, FindingState
from rs_relpose_ros.core.deviations import slices
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import (
    add,
    column,
    cross,
    dot,
    exp_so3,
    log_so3,
    norm,
    product,
    product_transposed,
    rotated,
    rotated_back,
    scale,
    skew,
    STANDARD_GRAVITY,
    subtract,
    tangent_basis,
    Vector,
    write_column,
)
from rs_relpose_ros.geometry.timing import seconds_between, to_nanoseconds
from rs_relpose_ros.imu.buffer import ImuInterval
from rs_relpose_ros.jit import kernel, small_kernel
from rs_relpose_ros.messages.published_pair import PublishedPair

# Difference of a velocity from the mean one, in units of it, from which its information does not
# hold: it is linearised at the estimated velocity. A smaller limit drops velocities of turns, a
# larger one keeps wrong ones. [measured: docs/lab/odometry.md, "Starts", far velocities: two such
# pairs have a chi squared of 35 and 5 per degree of freedom, the others 0.5 in the median]
_FAR_VELOCITY = 1.5


def row_ns(pair: PublishedPair) -> int:
    """From the stamped to the middle row, at which keyframes are; 0 without information."""
    return 0 if pair.images is None else to_nanoseconds(pair.images.row_time)


def later(pair: PublishedPair, delay_ns: int) -> PublishedPair:
    """The same for rows that are read `delay_ns` later."""
    return replace(
        pair,
        stamp_ns=pair.stamp_ns + delay_ns,
        reference_imu_ns=pair.reference_imu_ns + delay_ns,
        current_imu_ns=pair.current_imu_ns + delay_ns,
    )


def without_far_velocities(pair: PublishedPair) -> PublishedPair:
    """The same, without velocities where one of them is far from the mean velocity."""
    images = pair.images
    if images is None or not pair.has_direction:
        return pair
    seconds = seconds_between(pair.reference_imu_ns, pair.current_imu_ns)
    ways = images.velocities.reshape(2, 3) * seconds
    apart = np.linalg.norm(ways - images.t, axis=1)
    if apart.max() <= _FAR_VELOCITY:
        return pair
    return replace(pair, images=images.without_velocities())


def as_loop(pair: PublishedPair, inflation: float) -> PublishedPair | None:
    """The same at the middle rows, for frames far apart in time; None without information.

    Without velocities: they are estimated far from the true ones there, and the information
    about them does not hold. `inflation`: of the covariance.
    """
    images = pair.images
    if images is None:
        return None
    if pair.has_direction:
        images = images.without_velocities()
    return later(replace(pair, images=images.enlarged(inflation)), row_ns(pair))


def contradiction(pair: PublishedPair) -> Finding | None:
    """The finding that ends a path: a parameter is wrong, or the accelerometer is contradicted.

    Pairs continue without the accelerometer, but a path has no other source of scale.
    """
    for finding in pair.findings.findings:
        suspect = finding.state is FindingState.SUSPECT
        if finding.state is FindingState.WRONG or (suspect and finding.code is Code.ACCEL_AXES):
            return finding
    return None


# Residuals of a pair and their derivatives. Unknowns are pose and velocity of the body (the IMU)
# at both times; the camera has the rotation ``v_cam = C v_body`` and the position c in the body.
# With camera poses (R_k, p_k), ``u`` the direction and b the length of ``q = R_1^T (p_2 - p_1)``,
# the deviations are::
#
#     theta = Log(R_1^T R_2 R^T),  s = B^T u / (t . u),  R_1^T v_k / b - d_k
#
# as of `rs_relpose_ros.estimator.covariance`, R, t, d_k being the measured ones. Where the images
# are `delay` later than the times of the bodies, R_k, p_k and v_k are those then::
#
#     R_k Exp(w_k delay),  p_k + v_k delay,  v_k + a_k delay


class Body(NamedTuple):
    """The body at a keyframe; all arrays are contiguous."""

    R: Array  # (3, 3) to the world
    position: Array  # (3,) [m]
    velocity: Array  # (3,) [m/s] in the world
    rate: Array  # (3,) [rad/s] in its own axes
    acceleration: Array  # (3,) [m/s^2] in the world

    @classmethod
    def of(
        cls,
        pose: Array,
        velocity: Array,
        rate: Array,
        force: Array,
    ) -> Body:
        """From a pose as a matrix (4, 4), and the specific force (3,) in the body's axes."""
        R = pose[:3, :3].copy()
        return cls(R, pose[:3, 3].copy(), velocity, rate, R @ force + _GRAVITY)


class Mount(NamedTuple):
    """The camera on the body; both arrays are contiguous."""

    R: Array  # (3, 3) C as configured
    arm: Array  # (3,) c [m]
    axes: Array  # (3,) rotation of the camera from C, in its axes [rad]
    delay: float  # of the images after the times of the bodies [s]


class Measured(NamedTuple):
    """The estimate of the images; all arrays are contiguous."""

    R: Array  # (3, 3)
    t: Array  # (3,)
    velocities: Array  # (6,)

    @classmethod
    def of(cls, pair: PublishedPair) -> Measured:
        """From a pair with information; a rotation alone has no other deviations."""
        images = pair.images
        assert images is not None
        if pair.has_direction:
            return cls(images.R, images.t, images.velocities)
        return cls(images.R, np.array([0.0, 0.0, 1.0]), np.zeros(6))


# Acceleration of free fall, z up [m/s^2]. [derived: standard gravity]
_GRAVITY = np.array([0.0, 0.0, -STANDARD_GRAVITY])
# Shortest baseline [m] with a direction: against a division by zero.
_LEAST_BASELINE = 1e-4
# Least cosine between the measured and the predicted direction for which the tangent is used.
_LEAST_COSINE = 0.1
# Columns of the derivatives: small rotation and translation of a body in its own axes, its
# velocity, position of the camera, and its axes with the delay.
COLUMNS = slices({'X1': 6, 'V1': 3, 'X2': 6, 'V2': 3, 'arm': 3, 'mount': 4})
# Number of these columns. [derived: sum of the sizes]
_WIDTH = 25
# The column of the delay, which is the last one. [derived: the order]
_DELAY = _WIDTH - 1


@kernel
def _moved(body: Body, delay: float) -> Body:
    """The body after a delay, at its rate and acceleration."""
    return Body(
        product(body.R, exp_so3(delay * body.rate)),
        body.position + delay * body.velocity,
        body.velocity + delay * body.acceleration,
        body.rate,
        body.acceleration,
    )


@small_kernel
def _add_column(v: Vector, rows: Array, first: int, i: int) -> None:
    """Add a vector to column i of `rows` (n, m), from row `first` on."""
    rows[first, i] += v[0]
    rows[first + 1, i] += v[1]
    rows[first + 2, i] += v[2]


@kernel
def _by_earlier(by: Array, own: int, body: Body, later: Body, delay: float) -> None:
    """Turn derivatives (25, 11) by a body after the delay into those by the body before it.

    `own`: its first row. The derivative by the delay is added to the last row.
    """
    turn = exp_so3(delay * body.rate)
    moving = rotated_back(later.R, body.velocity)
    for i in range(by.shape[1]):
        rotation = column(by, own, i)
        place = column(by, own + 3, i)
        velocity = column(by, own + 6, i)
        write_column(rotated(turn, rotation), by, own, i)
        write_column(rotated(turn, place), by, own + 3, i)
        by_delay = dot(rotation, body.rate) + dot(place, moving)
        by[_DELAY, i] += by_delay + dot(velocity, body.acceleration)
        further = rotated(later.R, place)
        _add_column(scale(delay, further), by, own + 6, i)


@kernel
def _by_bodies(arm: Array, C: Array, R12C: Array, q: Vector) -> Array:
    """Derivatives (25, 3) of the baseline q in the axes of camera 1.

    `C` and `R12C` turn from the axes of both bodies to those of camera 1.
    """
    by = np.zeros((_WIDTH, 3))
    for i in range(3):
        across = skew(q)[i]
        write_column(add(rotated_back(C, across), cross(C[i], arm)), by, 0, i)
        write_column(scale(-1.0, C[i]), by, 3, i)
        write_column(cross(arm, R12C[i]), by, 9, i)
        write_column(scale(1.0, R12C[i]), by, 12, i)
        write_column(subtract(R12C[i], C[i]), by, 18, i)
        write_column(scale(-1.0, across), by, 21, i)
    return by


@kernel
def deviations(
    first: Body,
    second: Body,
    mount: Mount,
    measured: Measured,
) -> tuple[Array, Array]:
    """Deviations (11,) of a measured pair from two bodies, and their derivatives (11, 25)."""
    body1, body2 = _moved(first, mount.delay), _moved(second, mount.delay)
    arm, C = mount.arm, product(exp_so3(mount.axes), mount.R)
    back = product_transposed(C, body1.R)
    R12C = product(back, body2.R)
    R12 = product_transposed(R12C, C)
    place1 = add(body1.position, rotated(body1.R, arm))
    place2 = add(body2.position, rotated(body2.R, arm))
    q = rotated(back, subtract(place2, place1))
    b = max(norm(q), _LEAST_BASELINE)
    u = scale(1.0 / b, q)
    e, by = np.empty(11), np.zeros((_WIDTH, 11))
    turn = log_so3(product_transposed(R12, measured.R))
    B, along = tangent_basis(measured.t), dot(measured.t, u)
    # More than 90 deg from the measured direction the tangent is undefined: the sine instead.
    along = along if along > _LEAST_COSINE else 1.0
    for i in range(3):
        e[i] = turn[i]
        write_column(scale(-1.0, C[i]), by, 0, i)
        write_column(scale(1.0, R12C[i]), by, 9, i)
        write_column(scale(-1.0, R12[i]), by, 21, i)
        by[21 + i, i] += 1.0
    for k in range(2):
        e[3 + k] = dot(B[:, k], u) / along
        body, to_camera = (body1, C) if k == 0 else (body2, R12C)
        # The lever arm rotates with the body.
        swing = cross(body.rate, arm)
        w = rotated(back, add(body.velocity, rotated(body.R, swing)))
        for i in range(3):
            deviation = 5 + 3 * k + i
            across = skew(w)[i]
            e[deviation] = w[i] / b - measured.velocities[3 * k + i]
            _add_column(rotated_back(C, across), by, 0, deviation)
            _add_column(cross(swing, to_camera[i]), by, 9 * k, deviation)
            _add_column(scale(1.0, back[i]), by, 9 * k + 6, deviation)
            _add_column(cross(to_camera[i], body.rate), by, 18, deviation)
            _add_column(scale(-1.0, across), by, 21, deviation)
    # What is divided by the length of the baseline changes with it.
    by_bodies = _by_bodies(arm, C, R12C, q)
    for row in range(_WIDTH):
        dq = by_bodies[row]
        db = dot(u, dq)
        du = scale(1.0 / b, subtract(dq, scale(db, u)))
        for k in range(2):
            by[row, 3 + k] = (dot(B[:, k], du) - e[3 + k] * dot(measured.t, du)) / along
        for i in range(6):
            velocity = e[5 + i] + measured.velocities[i]
            by[row, 5 + i] = (by[row, 5 + i] - velocity * db) / b
    for k in range(2):
        body, later_body = (first, body1) if k == 0 else (second, body2)
        _by_earlier(by, 9 * k, body, later_body, mount.delay)
    return e, np.ascontiguousarray(by.T)


def square_root(information: Array, gradient: Array) -> tuple[Array, Array]:
    """A (k, n) and a (k,) with ``|A e + a|^2 = e^T H e + 2 g^T e`` and a constant.

    Directions that H does not observe are left out.
    """
    values, vectors = np.linalg.eigh(information)
    observed = values > _OBSERVED * max(values[-1], _TINY)
    roots, axes = np.sqrt(values[observed]), vectors[:, observed].T
    return roots[:, None] * axes, (axes @ gradient) / roots


# Least eigenvalue of a direction that an information observes, relative to the largest one: below
# it are rounding errors. [chosen: 1e-12 to 1e-8 would do]
_OBSERVED = 1e-10
# Against a division by zero.
_TINY = 1e-300


def warm_up_odometry() -> None:
    """Compile (or load from the cache) the kernels of odometry: a made-up pair, an IMU at rest."""
    eye, z = np.eye(3), np.array([0.0, 0.0, 1.0])
    bodies = [Body(eye, shift * z, z, z, z) for shift in (0.0, 1.0)]
    deviations(*bodies, Mount(eye, z, z, 0.0), Measured(eye, z, np.zeros(6)))
    still = ImuInterval(np.arange(2.0), np.zeros((2, 3)), np.ones((2, 3)))
    still.mean_force(np.zeros(3))
