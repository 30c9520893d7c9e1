"""The messages of a pair, as relpose_node publishes them, back to arrays.

For who consumes the topics, live or from a bag. Messages are read by field name only, and nothing
of them is trusted: what cannot be used raises `InputError` with one sentence.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.image_information import ImageInformation
from rs_relpose_ros.messages.incoming import stamp_ns, time_ns
from rs_relpose_ros.messages.outgoing import (
    MATCH_DTYPE,
    MATCH_FIELDS,
    PAIR_TOPICS,
    PairMessages,
    POSE_TOPICS,
)
from rs_relpose_ros.messages.pair_status import PairStatus, TOPICS_KEY

Array = NDArray[np.float64]

# Fields of the landmark of a match.
LANDMARK = ('x', 'y', 'z')
# Largest deviation from 1 of the length of directions, quaternions and rays.
_UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class PublishedPair:
    """A keyframe pair as published; falsy without a pose, as `RelativePose` is.

    Pose of the current camera in the reference camera, ``X1 = R X2 + t``, with the covariance of
    ``(dt, dtheta)``: ``t_true = t + dt`` and ``R_true = Exp(dtheta) R``, in camera 1. `matches`
    are the inliers: track ``id``, pixels ``u1 v1 u2 v2``, row times ``tau1 tau2`` [s], rays
    ``x1 y1 z1 x2 y2 z2`` turned to the stamped row, landmarks ``x y z`` in the reference camera
    [baselines], pixels ``u1_gs v1_gs u2_gs v2_gs`` as global shutters would see them at the
    stamped rows' instants. What is not known is NaN, and there are no matches without a pose.
    """

    reference_stamp_ns: int   # header stamp of the reference keyframe
    stamp_ns: int   # of the current image, as frame_id
    frame_id: str
    reference_imu_ns: int   # instants of the two stamped rows on the IMU's clock
    current_imu_ns: int
    status: str   # as of `Status`
    reason: str   # why there is no pose; empty where there is one
    has_pose: bool
    R: Array   # (3, 3)
    t: Array   # (3,), of length 1: the scale of two views is not observable
    covariance: Array   # (6, 6); without a pose the part of R is known
    linear_velocity: Array   # (3,), of the current camera in its own frame [baselines per second]
    angular_velocity: Array   # (3,), likewise [rad/s]
    velocity_covariance: Array   # (6, 6), of the two
    baseline: float   # [m]
    baseline_log_sigma: float   # 1 sigma of its logarithm
    gyro_bias: Array   # (3,) [rad/s] that was removed, in the axes of the IMU
    images: ImageInformation | None   # what the images alone say
    health: str   # of what was told of camera and IMU, as of `HealthState`
    matches: NDArray[np.void]   # (N,), of MATCH_DTYPE

    def __bool__(self) -> bool:
        """Whether there is a pose."""
        return self.has_pose

    @property
    def rotation_known(self) -> bool:
        """Whether `R` is known; of every pose it is."""
        return bool(np.isfinite(self.R).all())


@dataclass(slots=True)
class _Waiting:
    """Messages of a stamp, and the topics that its pair has; None until ``~/pairs`` tells."""

    messages: dict[str, Any] = field(default_factory=dict)
    topics: frozenset[str] | None = None


class PairSynchronizer:
    """Gathers the messages of a pair by their common stamp, in whatever order they come.

    ``~/pairs``, which every pair has, tells which other messages there are: all of them, the
    rotation, or none. At most `capacity` stamps wait for the rest of their messages; of more, the
    one that was begun first is given up: where messages are lost, nothing piles up. `given_up`
    counts them.
    """

    def __init__(self, capacity: int = 10) -> None:
        if capacity < 1:
            raise InputError(f'capacity must be at least 1, got {capacity}')
        self._capacity = capacity
        self._waiting: dict[int, _Waiting] = {}
        self.given_up = 0

    def add(self, topic: str, message: Any) -> PublishedPair | None:
        """Take a message; the pair that it completes, if it does: with or without a pose.

        `topic` is one of `PAIR_TOPICS`, without ``~/``. InputError where the pair cannot be used,
        or the stamp is out of range.
        """
        if topic not in PAIR_TOPICS:
            raise InputError(f'topic must be one of {", ".join(PAIR_TOPICS)}, got {topic!r}')
        stamp = stamp_ns(message.header)
        waiting = self._waiting.setdefault(stamp, _Waiting())
        waiting.messages[topic] = message
        if topic == 'pairs':
            try:
                waiting.topics = _topics(pair_status(message))
            except InputError:
                del self._waiting[stamp]
                raise
        topics = waiting.topics
        if topics is not None and topics <= waiting.messages.keys():
            del self._waiting[stamp]
            return published_pair(PairMessages(**{
                name: waiting.messages[name] if name in topics else None
                for name in PAIR_TOPICS}))
        if len(self._waiting) > self._capacity:
            del self._waiting[next(iter(self._waiting))]
            self.given_up += 1
        return None


def published_pair(messages: PairMessages) -> PublishedPair:
    """Arrays of the messages of one pair; InputError where something cannot be used."""
    stamps = {name: stamp_ns(message.header) for name, message in messages.by_topic()}
    if len(set(stamps.values())) > 1:
        raise InputError(f'messages of one pair must have the same stamp, got {stamps}')
    status = pair_status(messages.pairs)
    topics = _topics(status)
    if stamps.keys() != topics:
        raise InputError(f'~/pairs tells of {" ".join(sorted(topics))}, '
                         f'but there are {" ".join(sorted(stamps))}')
    reference = status.nanoseconds('reference_stamp_ns')
    R, t = np.full((3, 3), math.nan), np.full(3, math.nan)
    covariance, velocity_covariance = np.full((2, 6, 6), math.nan)
    linear_velocity = angular_velocity = np.full(3, math.nan)
    matches = np.empty(0, dtype=MATCH_DTYPE)
    if messages.relative_pose is not None:
        if time_ns(messages.reference.time_ref) != reference:
            raise InputError('~/reference and ~/pairs must name the same reference keyframe')
        pose, twist = messages.relative_pose.pose, messages.velocity.twist
        R = _rotation('~/relative_pose', pose.pose.orientation)
        t = _unit('the position of ~/relative_pose', pose.pose.position, 'xyz')
        covariance = _covariance('~/relative_pose', pose.covariance, 6)
        linear_velocity = _velocity('the linear velocity of ~/velocity', twist.twist.linear)
        angular_velocity = _velocity('the angular velocity of ~/velocity', twist.twist.angular)
        velocity_covariance = _covariance('~/velocity', twist.covariance, 6)
        matches = match_records(messages.matches)
    elif messages.relative_rotation is not None:
        imu, topic = messages.relative_rotation, '~/relative_rotation'
        R = _rotation(topic, imu.orientation)
        covariance[3:, 3:] = _covariance(topic, imu.orientation_covariance, 3)
        angular_velocity = _velocity(f'the angular velocity of {topic}', imu.angular_velocity)
        velocity_covariance[3:, 3:] = _covariance(topic, imu.angular_velocity_covariance, 3)
    return PublishedPair(
        reference_stamp_ns=reference, stamp_ns=stamps['pairs'],
        frame_id=str(messages.pairs.status[0].hardware_id),
        reference_imu_ns=status.nanoseconds('reference_imu_ns'),
        current_imu_ns=status.nanoseconds('current_imu_ns'), status=status.text('status'),
        reason=status.text('reason'), has_pose=messages.relative_pose is not None, R=R, t=t,
        covariance=covariance, linear_velocity=linear_velocity, angular_velocity=angular_velocity,
        velocity_covariance=velocity_covariance, baseline=status.real('baseline_m'),
        baseline_log_sigma=status.real('baseline_log_sigma'),
        gyro_bias=status.vector('gyro_bias_rad_s'),
        images=status.images(), health=status.text('health'), matches=matches)


def pair_status(pairs: Any) -> PairStatus:
    """The status of a pair in a diagnostic_msgs/DiagnosticArray of ``~/pairs``."""
    if len(pairs.status) != 1:
        raise InputError(f'~/pairs must have one status, got {len(pairs.status)}')
    return PairStatus({str(item.key): str(item.value) for item in pairs.status[0].values})


def _topics(status: PairStatus) -> frozenset[str]:
    """Topics that a pair has, ``~/pairs`` included."""
    text = status.text(TOPICS_KEY)
    topics = frozenset(text.split())
    with_rotation = {'relative_rotation'}
    if topics not in (set(), with_rotation, with_rotation | set(POSE_TOPICS)):
        raise InputError(f'{TOPICS_KEY} of ~/pairs must name all others, relative_rotation, or '
                         f'none, got {text[:100]!r}')
    return topics | {'pairs'}


def match_records(cloud: Any) -> NDArray[np.void]:
    """Records of MATCH_DTYPE (N,) of a sensor_msgs/PointCloud2; a view of the message's memory."""
    found = [(str(f.name), int(f.offset), int(f.datatype), int(f.count)) for f in cloud.fields]
    wanted = [(name, offset, datatype, 1) for name, offset, datatype in MATCH_FIELDS]
    if found != wanted or int(cloud.point_step) != MATCH_DTYPE.itemsize or cloud.is_bigendian:
        names = ' '.join(name[:20] for name, *_ in found[:20])
        raise InputError(
            f'~/matches must have the fields {" ".join(MATCH_DTYPE.names or ())}, little endian, '
            f'{MATCH_DTYPE.itemsize} bytes a point; got {names or "none"}, '
            f'{"big" if cloud.is_bigendian else "little"} endian, {int(cloud.point_step)} bytes')
    data = np.frombuffer(cloud.data, dtype=np.uint8)
    count = int(cloud.width) * int(cloud.height)
    if len(data) != count * MATCH_DTYPE.itemsize:
        raise InputError(f'~/matches has {len(data)} bytes of data, but {int(cloud.width)}x'
                         f'{int(cloud.height)} points need {count * MATCH_DTYPE.itemsize}')
    records = data.view(MATCH_DTYPE)
    # Of a match without a landmark x, y and z are NaN.
    far = np.isnan(records['x']) & np.isnan(records['y']) & np.isnan(records['z'])
    if not all((np.isfinite(records[name]) | (far & (name in LANDMARK))).all()
               for name in MATCH_DTYPE.names or ()):
        raise InputError('~/matches must be finite')
    for view in '12':
        rays = np.stack([records[axis + view].astype(np.float64) for axis in 'xyz'])
        if (np.abs(np.linalg.norm(rays, axis=0) - 1.0) > _UNIT_TOLERANCE).any():
            raise InputError(f'the rays x{view} y{view} z{view} of ~/matches must have length 1')
    return records


def _unit(name: str, message: Any, axes: str) -> Array:
    values = np.array([getattr(message, axis) for axis in axes], dtype=np.float64)
    # Written so that NaN fails it.
    if not abs(math.hypot(*values) - 1.0) <= _UNIT_TOLERANCE:
        raise InputError(f'{name} must have length 1, got {values.tolist()}')
    return values


def _velocity(name: str, vector: Any) -> Array:
    largest = 1e9   # [baselines/s, rad/s]: far above any camera, far below an overflow
    values = np.array([vector.x, vector.y, vector.z], dtype=np.float64)
    if not (np.abs(values) <= largest).all():
        raise InputError(f'{name} must be at most {largest:g}, got {values.tolist()}')
    return values


def _covariance(topic: str, covariance: Any, size: int) -> Array:
    values = np.array(covariance, dtype=np.float64)
    if values.shape != (size * size,) or not np.isfinite(values).all():
        raise InputError(f'the covariance of {topic} must be {size * size} finite figures')
    return values.reshape(size, size)


def _rotation(topic: str, quaternion: Any) -> Array:
    unit = _unit(f'the orientation of {topic}', quaternion, 'xyzw')
    return np.asarray(Rotation.from_quat(unit).as_matrix())
