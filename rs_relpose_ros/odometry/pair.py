"""A keyframe pair as a measurement of two bodies with a camera: residuals and derivatives.

Free of gtsam, for graphs of other libraries.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.covariance import ImageInformation
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import log_so3, norm, tangent_basis
from rs_relpose_ros.geometry.timing import seconds_between, to_nanoseconds
from rs_relpose_ros.imu.buffer import ImuInterval
from rs_relpose_ros.jit import kernel
from rs_relpose_ros.messages.incoming import stamp_ns
from rs_relpose_ros.messages.published_pair import PairStatus
from rs_relpose_ros.pipeline.findings import Assessment, Code, Finding, FindingState
from rs_relpose_ros.pipeline.pair import PairResult

# Difference of a velocity from the mean one, in units of it, from which its information does not
# hold: it is linearised at the estimated velocity.
_FAR_VELOCITY = 1.5
# Interval that no pair reaches [ns].
_LONGEST_NS = 100_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class KeyframePair:
    """A keyframe pair as a measurement of two camera poses, at the stamped rows."""

    stamp_ns: int  # of the current image, on the clock of the camera
    reference_ns: int  # of both images, on the IMU clock
    current_ns: int
    frame_id: str
    status: str
    images: ImageInformation | None  # of the images alone; None without information
    baseline: float  # [m]; NaN if unknown
    baseline_log_sigma: float
    gyro_bias: Array  # (3,) [rad/s] active, IMU frame; NaN if unknown
    contradiction: Finding | None  # against the calibration: it ends a path

    @classmethod
    def of_result(cls, pair: PairResult) -> KeyframePair:
        """From a pair of the front end."""
        pose = pair.pose
        bias = np.full(3, math.nan) if pair.gyro_bias is None else pair.gyro_bias
        return cls(
            pair.stamp_ns,
            pair.reference_ns1,
            pair.reference_ns2,
            pair.frame_id,
            pose.status.value,
            pose.images,
            pose.baseline,
            pose.baseline_log_sigma,
            bias,
            _contradiction(pair.health),
        )

    @classmethod
    def of_message(cls, pairs: Any) -> KeyframePair:
        """From a message on ``~/pairs``; InputError if it is unusable."""
        status = PairStatus(pairs)
        if not 0 < status['current_imu_ns'] - status['reference_imu_ns'] < _LONGEST_NS:
            raise InputError(
                'current_imu_ns of ~/pairs must be later than reference_imu_ns, by '
                'less than 100 s: the pair is not used'
            )
        return cls(
            stamp_ns(pairs.header),
            status['reference_imu_ns'],
            status['current_imu_ns'],
            status.frame_id,
            status['status'],
            status.images(),
            status['baseline_m'],
            status['baseline_log_sigma'],
            status['gyro_bias_rad_s'],
            _contradiction(status.findings()),
        )

    def later(self, delay_ns: int) -> KeyframePair:
        """The same for rows that are read `delay_ns` later."""
        return replace(
            self,
            stamp_ns=self.stamp_ns + delay_ns,
            reference_ns=self.reference_ns + delay_ns,
            current_ns=self.current_ns + delay_ns,
        )

    @property
    def row_ns(self) -> int:
        """From the stamped to the middle row, at which keyframes are; 0 without information."""
        return 0 if self.images is None else to_nanoseconds(self.images.row_time)

    def without_far_velocities(self) -> KeyframePair:
        """The same, without velocities where one of them is far from the mean velocity."""
        if self.images is None or not self.has_direction:
            return self
        ways = self.images.velocities.reshape(2, 3) * seconds_between(
            self.reference_ns, self.current_ns
        )
        far = np.linalg.norm(ways - self.images.t, axis=1).max() > _FAR_VELOCITY
        return replace(self, images=self.images.without_velocities()) if far else self

    def as_loop(self, inflation: float) -> KeyframePair | None:
        """The same at the middle rows, for frames far apart in time; None without information.

        Without velocities: they are estimated far from the true ones there, and the information
        about them does not hold. `inflation`: of the covariance.
        """
        if self.images is None:
            return None
        images = self.images.without_velocities() if self.has_direction else self.images
        return replace(self, images=images.enlarged(inflation)).later(self.row_ns)

    @property
    def is_pure_rotation(self) -> bool:
        """Whether the images have no translation."""
        return self.status == Status.PURE_ROTATION.value

    @property
    def has_direction(self) -> bool:
        """Whether the images determine the direction of motion."""
        return self.images is not None and bool(np.isfinite(self.images.t).all())


def _contradiction(health: Assessment) -> Finding | None:
    """The finding that ends a path: a parameter is wrong, or the accelerometer is contradicted.

    Pairs continue without the accelerometer, but a path has no other source of scale.
    """
    for finding in health.findings:
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
# as of `rs_relpose_ros.estimator.covariance`, R, t, d_k being the measured ones.

# Shortest baseline [m] with a direction.
_LEAST_BASELINE = 1e-4


@kernel
def _skew(v: Array) -> Array:
    """``_skew(a) @ b = a x b``."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@kernel
def deviations(
    R1: Array,
    p1: Array,
    v1: Array,
    w1: Array,
    R2: Array,
    p2: Array,
    v2: Array,
    w2: Array,
    C: Array,
    c: Array,
    R: Array,
    t: Array,
    velocities: Array,
) -> tuple[Array, Array]:
    """Deviations (11,) of a measured pair (R, t, velocities), and their derivatives (11, 21).

    Of bodies with ``R_k`` to the world, position [m] and velocity [m/s] there, and rate ``w_k``
    [rad/s] in their own axes. With respect to small rotations and translations of the first one
    (in its axes), its velocity, the same of the second one, and c. All arrays are contiguous.
    """
    arm = _skew(c)
    back = C @ R1.T
    R12 = back @ R2 @ C.T
    R12C = R12 @ C
    q = back @ (p2 + R2 @ c - p1 - R1 @ c)
    b = max(norm(q), _LEAST_BASELINE)
    u = q / b
    dq = np.zeros((3, 21))
    dq[:, 0:3], dq[:, 3:6] = _skew(q) @ C + C @ arm, -C
    dq[:, 9:12], dq[:, 12:15], dq[:, 18:21] = -R12C @ arm, R12C, R12C - C
    db = u @ dq
    e, by = np.empty(11), np.zeros((11, 21))
    e[0:3] = log_so3(R12 @ R.T)
    by[0:3, 0:3], by[0:3, 9:12] = -C, R12C
    B, along = tangent_basis(t), t @ u
    # More than 90 deg from the measured direction the tangent is undefined: the sine instead.
    along = along if along > 0.1 else 1.0
    du = (dq - np.outer(u, db)) / b
    e[3:5] = B.T @ u / along
    by[3:5] = (B.T @ du - np.outer(e[3:5], t @ du)) / along
    for k in range(2):
        R_k, v_k, w_k = (R1, v1, w1) if k == 0 else (R2, v2, w2)
        # The lever arm rotates with the body.
        swing = _skew(w_k) @ c
        w = back @ (v_k + R_k @ swing)
        own, rows = 9 * k, slice(5 + 3 * k, 8 + 3 * k)
        e[rows] = w / b - velocities[3 * k : 3 * k + 3]
        by[rows, 0:3] += _skew(w) @ C
        by[rows, own : own + 3] -= (C if k == 0 else R12C) @ _skew(swing)
        by[rows, own + 6 : own + 9] = back
        by[rows, 18:21] = (C if k == 0 else R12C) @ _skew(w_k)
        by[rows] = (by[rows] - np.outer(w / b, db)) / b
    return e, by


def square_root(information: Array, gradient: Array) -> tuple[Array, Array]:
    """A (k, n) and a (k,) with ``|A e + a|^2 = e^T H e + 2 g^T e`` and a constant.

    Directions that H does not observe are left out.
    """
    values, vectors = np.linalg.eigh(information)
    observed = values > 1e-10 * max(values[-1], 1e-300)
    roots = np.sqrt(values[observed])
    return roots[:, None] * vectors[:, observed].T, (vectors[:, observed].T @ gradient) / roots


def warm_up_odometry() -> None:
    """Compile (or load from the cache) the kernels of odometry: a made-up pair, an IMU at rest."""
    eye, z = np.eye(3), np.array([0.0, 0.0, 1.0])
    deviations(eye, 0.0 * z, z, z, eye, z, z, z, eye, z, eye, z, np.zeros(6))
    ImuInterval(np.arange(2.0), np.zeros((2, 3)), np.ones((2, 3))).mean_force(np.zeros(3))
