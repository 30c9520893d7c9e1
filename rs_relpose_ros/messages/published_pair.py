"""The four messages of a pair, as relpose_node publishes them, back to arrays.

For who consumes the topics, live or from a bag. Messages are read by field name only, and nothing
of them is trusted: what cannot be used raises `InputError` with one sentence.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.messages.incoming import stamp_ns, time_ns
from rs_relpose_ros.messages.outgoing import (
    MATCH_DTYPE,
    MATCH_FIELDS,
    PAIR_TOPICS,
    PairMessages,
)

Array = NDArray[np.float64]

# Largest deviation from 1 of the length of directions, quaternions and rays.
_UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class PublishedPair:
    """A keyframe pair with a pose, as published.

    Pose of the current camera in the reference camera, ``X1 = R X2 + t``, with the covariance of
    ``(dt, dtheta)``: ``t_true = t + dt`` and ``R_true = Exp(dtheta) R``, in camera 1. `matches`
    are the inliers: track ``id``, pixels ``u1 v1 u2 v2``, row times ``tau1 tau2`` [s], rays
    ``x1 y1 z1 x2 y2 z2`` turned to the stamped row.
    """

    reference_stamp_ns: int   # header stamp of the reference keyframe
    stamp_ns: int   # of the current image, as frame_id
    frame_id: str
    R: Array   # (3, 3)
    t: Array   # (3,), of length 1: the scale of two views is not observable
    covariance: Array   # (6, 6)
    linear_velocity: Array   # (3,), of the current camera in its own frame [baselines per second]
    angular_velocity: Array   # (3,), likewise [rad/s]
    velocity_covariance: Array   # (6, 6), of the two
    matches: NDArray[np.void]   # (N,), of MATCH_DTYPE


class PairSynchronizer:
    """Gathers the messages of a pair by their common stamp, in whatever order they come.

    At most `capacity` stamps wait for the rest of their messages; of more, the one that was begun
    first is given up: where messages are lost, nothing piles up. `given_up` counts them.
    """

    def __init__(self, capacity: int = 10) -> None:
        if capacity < 1:
            raise InputError(f'capacity must be at least 1, got {capacity}')
        self._capacity = capacity
        self._waiting: dict[int, dict[str, Any]] = {}
        self.given_up = 0

    def add(self, topic: str, message: Any) -> PublishedPair | None:
        """Take a message; the pair that it completes, if it does.

        `topic` is 'relative_pose', 'reference', 'velocity' or 'matches'. InputError where the pair
        cannot be used, or the stamp is out of range.
        """
        if topic not in PAIR_TOPICS:
            raise InputError(f'topic must be one of {", ".join(PAIR_TOPICS)}, got {topic!r}')
        stamp = stamp_ns(message.header)
        messages = self._waiting.setdefault(stamp, {})
        messages[topic] = message
        if len(messages) == len(PAIR_TOPICS):
            del self._waiting[stamp]
            return published_pair(PairMessages(**messages))
        if len(self._waiting) > self._capacity:
            del self._waiting[next(iter(self._waiting))]
            self.given_up += 1
        return None


def published_pair(messages: PairMessages) -> PublishedPair:
    """Arrays of the four messages of one stamp; InputError where something cannot be used."""
    stamps = {name: stamp_ns(getattr(messages, name).header) for name in PAIR_TOPICS}
    if len(set(stamps.values())) > 1:
        raise InputError(f'messages of one pair must have the same stamp, got {stamps}')
    pose, twist = messages.relative_pose.pose, messages.velocity.twist
    return PublishedPair(
        reference_stamp_ns=time_ns(messages.reference.time_ref),
        stamp_ns=stamps['relative_pose'],
        frame_id=str(messages.velocity.header.frame_id),
        R=np.asarray(Rotation.from_quat(_unit(
            'the orientation of ~/relative_pose', pose.pose.orientation, 'xyzw')).as_matrix()),
        t=_unit('the position of ~/relative_pose', pose.pose.position, 'xyz'),
        covariance=_covariance('~/relative_pose', pose.covariance),
        linear_velocity=_velocity('the linear velocity of ~/velocity', twist.twist.linear),
        angular_velocity=_velocity('the angular velocity of ~/velocity', twist.twist.angular),
        velocity_covariance=_covariance('~/velocity', twist.covariance),
        matches=match_records(messages.matches))


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
    if not all(np.isfinite(records[name]).all() for name in MATCH_DTYPE.names or ()):
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


def _covariance(topic: str, covariance: Any) -> Array:
    values = np.array(covariance, dtype=np.float64)
    if values.shape != (36,) or not np.isfinite(values).all():
        raise InputError(f'the covariance of {topic} must be 36 finite figures')
    return values.reshape(6, 6)
