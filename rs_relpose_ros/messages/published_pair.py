"""The messages of a pair, as published by relpose_node, back to arrays; pairs chained to a path.

For subscribers and readers of bags. Messages are read by field name only, and nothing in them is
trusted: an unusable one raises `InputError` with one line.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.calibration.findings import Assessment
from rs_relpose_ros.core.losses import robust_scale
from rs_relpose_ros.core.triangulate import depths_of_rays
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.covariance import ImageInformation, IMAGES, POSE, ROTATION
from rs_relpose_ros.estimator.result import GYRO_CONTRADICTION, Status
from rs_relpose_ros.geometry import Array, validate
from rs_relpose_ros.messages import outgoing
from rs_relpose_ros.messages.incoming import stamp_ns, time_ns
from rs_relpose_ros.messages.outgoing import MATCH_DTYPE, PAIR_TOPICS, PAIR_VALUES
from rs_relpose_ros.pipeline.pair import PairResult

# Largest deviation from 1 of the length of directions, quaternions and rays. Those of our node
# have the rounding of float32; a larger bound would use a vector that is no direction.
# [chosen: 1e-6 to 1e-2 would do]
_UNIT_TOLERANCE = 1e-3
# Most negative eigenvalue of an information, relative to its largest one. It may be negative by
# rounding alone; a smaller bound would refuse messages of our own node, a larger one would pass an
# indefinite matrix to a graph. [chosen: 1e-9, double rounding of 11 x 11, to 1e-3 would do]
_LEAST_INFORMATION = 1e-6
# Largest eigenvalue of an information: a sigma of 1e-7 rad. No camera is that accurate, so that a
# larger value is a damaged message, which would dominate a graph. [chosen: 1e12 to 1e20 would do]
_MOST_INFORMATION = 1e14
# Largest speed [baselines/s, rad/s] of a message: above every camera, and its square is far from
# an overflow. [chosen: 1e4 to 1e100 would do]
_LARGEST_SPEED = 1e9
# Interval that no pair reaches [ns]. [chosen: far above max_keyframe_interval]
_LONGEST_NS = 100_000_000_000


def _unknown_vector() -> Array:
    return np.full(3, math.nan)


def _unknown_covariance() -> Array:
    return np.full((6, 6), math.nan)


@dataclass(frozen=True, slots=True, eq=False)
class PublishedPair:
    """A keyframe pair as published; falsy without a pose, as `RelativePose` is.

    Pose of the current camera in the reference camera, ``X1 = R X2 + t``, with the covariance of
    ``(dt, dtheta)``: ``t_true = t + dt`` and ``R_true = Exp(dtheta) R``, in camera 1. `matches`
    are the inliers, as `outgoing.inlier_records` makes them. Unknown values are NaN; there are no
    matches without a pose. The fields from `has_pose` on come from other topics than ``~/pairs``.
    """

    reference_stamp_ns: int  # header stamp of the reference keyframe
    stamp_ns: int  # of the current image, as frame_id
    frame_id: str
    reference_imu_ns: int  # times of the two stamped rows on the IMU's clock
    current_imu_ns: int
    status: str  # a value of `Status`
    reason: str  # of a pair without a pose; else empty
    baseline: float  # [m]
    baseline_log_sigma: float  # 1 sigma of its logarithm
    gyro_bias: Array  # (3,) [rad/s] that was removed, in the axes of the IMU
    images: ImageInformation | None  # estimate of the images alone
    health: str  # consistency of the calibration, a value of `FindingState`
    findings: Assessment  # the findings on the calibration
    has_pose: bool = False
    R: Array = field(default_factory=lambda: np.full((3, 3), math.nan))  # (3, 3)
    # (3,) of length 1: the scale of two views is not observable.
    t: Array = field(default_factory=_unknown_vector)
    # (6, 6); without a pose the part of R is known.
    covariance: Array = field(default_factory=_unknown_covariance)
    # (3,) of the current camera in its own frame [baselines per second], [rad/s]; (6, 6) of both.
    linear_velocity: Array = field(default_factory=_unknown_vector)
    angular_velocity: Array = field(default_factory=_unknown_vector)
    velocity_covariance: Array = field(default_factory=_unknown_covariance)
    # (N,) of MATCH_DTYPE
    matches: NDArray[np.void] = field(default_factory=lambda: np.empty(0, MATCH_DTYPE))

    @classmethod
    def of_status(cls, message: Any) -> PublishedPair:
        """From a message on ``~/pairs`` alone; InputError if it is unusable."""
        status = PairStatus(message)
        fields = {value.field: status[key] for key, value in PAIR_VALUES.items() if value.field}
        span_ns = fields['current_imu_ns'] - fields['reference_imu_ns']
        if not 0 < span_ns < _LONGEST_NS:
            raise InputError(
                'current_imu_ns of ~/pairs must be later than reference_imu_ns, by '
                'less than 100 s: the pair is not used'
            )
        fields['findings'] = status.findings()
        return cls(
            stamp_ns=stamp_ns(message.header),
            frame_id=status.frame_id,
            images=status.images(),
            **fields,
        )

    @classmethod
    def of_result(cls, pair: PairResult) -> PublishedPair:
        """What ``~/pairs`` has of a pair of the front end, without a message."""
        fields = {value.field: value.of(pair) for value in PAIR_VALUES.values() if value.field}
        if fields['gyro_bias'] is None:
            fields['gyro_bias'] = np.full(3, math.nan)
        return cls(stamp_ns=pair.stamp_ns, frame_id=pair.frame_id, images=pair.images, **fields)

    def __bool__(self) -> bool:
        """Whether there is a pose."""
        return self.has_pose

    @property
    def rotation_known(self) -> bool:
        """Whether `R` is known, as in every pose."""
        return bool(np.isfinite(self.R).all())

    @property
    def contradicts_gyro(self) -> bool:
        """Whether it has no pose because images and gyro contradict each other."""
        return self.images is None and self.reason.startswith(GYRO_CONTRADICTION)

    @property
    def is_pure_rotation(self) -> bool:
        """Whether the images have no translation."""
        return self.status == Status.PURE_ROTATION.value

    @property
    def has_direction(self) -> bool:
        """Whether the images alone determine the direction of motion."""
        return self.images is not None and bool(np.isfinite(self.images.t).all())


class PairStatus:
    """Values by key of the status of ``~/pairs``; InputError if one is absent or malformed."""

    def __init__(self, pairs: Any) -> None:
        if len(pairs.status) != 1:
            raise InputError(f'~/pairs must have one status, got {len(pairs.status)}')
        self.frame_id = str(pairs.status[0].hardware_id)
        self._texts = {str(item.key): str(item.value) for item in pairs.status[0].values}

    def __getitem__(self, key: str) -> Any:
        """A value of `PAIR_VALUES`."""
        return PAIR_VALUES[key].value(self._text(key))

    def _text(self, key: str) -> str:
        if key not in self._texts:
            raise InputError(f'~/pairs must have the key {key}')
        return self._texts[key]

    def findings(self) -> Assessment:
        """The findings on the calibration; InputError if they contradict its state."""
        health: Assessment = self['findings']
        legal = health.state.value
        given = self['health']
        if given != legal:
            raise InputError(
                f'health of ~/pairs must be {legal}, as of its findings, got {given[:40]!r}'
            )
        return health

    def images(self) -> ImageInformation | None:
        """The estimate of the images alone; None if there is none."""
        gradient = self['image_gradient']
        size = len(gradient)
        if size == 0:
            return None
        row_times = self['image_row_s']
        xyzw = self['image_rotation_xyzw']
        t = self['image_direction']
        velocities = self['image_velocities']
        upper = self['image_information']
        has_direction = len(t) == 3 and len(velocities) == 6 and _is_unit(t)
        has_size = size == ROTATION or (size == POSE and has_direction)
        has_rotation = len(xyzw) == 4 and _is_unit(xyzw)
        has_row = len(row_times) == 1 and abs(row_times[0]) < 1.0
        has_all = len(upper) == size * (size + 1) // 2
        if not (has_size and has_rotation and has_row and has_all):
            raise InputError(
                'image_information of ~/pairs and the other keys image_* must be of '
                f'{POSE} or {ROTATION} unknowns, got {size}'
            )
        if size == ROTATION:
            t = np.full(3, math.nan)
            velocities = np.full(6, math.nan)
        H = np.zeros((size, size))
        rows = np.triu_indices(size)
        H[rows] = upper
        H.T[rows] = upper
        _refuse_indefinite(H)
        by_deviation = self['image_by_deviation']
        count = len(by_deviation)
        if count not in (0, size * IMAGES.size):
            raise InputError(
                f'image_by_deviation of ~/pairs must be {size} x {IMAGES.size} numbers, got '
                f'{count}'
            )
        return ImageInformation(
            row_time=float(row_times[0]),
            R=Rotation.from_quat(xyzw).as_matrix(),
            t=t,
            velocities=velocities,
            information=H,
            gradient=gradient,
            by_deviation=by_deviation.reshape(size, -1) if count else None,
        )

    def topics(self) -> set[str]:
        """Topics of the pair, ``~/pairs`` included."""
        text = self._text(outgoing.TOPICS_KEY)
        topics = set(text.split())
        with_rotation = {'relative_rotation'}
        if topics not in (set(), with_rotation, with_rotation.union(outgoing.POSE_TOPICS)):
            raise InputError(
                f'{outgoing.TOPICS_KEY} of ~/pairs must name all others, '
                f'relative_rotation, or none, got {text[:100]!r}'
            )
        return topics | {'pairs'}


class PairSynchronizer:
    """Gathers the messages of a pair by their common stamp, in any order.

    ``~/pairs``, which every pair has, lists its other topics. At most `capacity` stamps wait;
    beyond it the oldest is dropped. `given_up` counts the dropped stamps.
    """

    def __init__(self, capacity: int = 10) -> None:
        self._capacity = validate.number('capacity', capacity, 1)
        self._waiting: dict[int, dict[str, Any]] = {}  # stamp -> messages by topic
        self.given_up = 0

    def add(self, topic: str, message: Any) -> PublishedPair | None:
        """Add a message of one of `PAIR_TOPICS`; return the pair that it completes.

        InputError if the pair is unusable, or the stamp is out of range.
        """
        validate.choice('topic', topic, PAIR_TOPICS)
        stamp = stamp_ns(message.header)
        messages = self._waiting.pop(stamp, {}) | {topic: message}
        if 'pairs' in messages:
            topics = PairStatus(messages['pairs']).topics()
            if topics <= messages.keys():
                return published_pair({name: messages[name] for name in topics})
        self._waiting[stamp] = messages
        if len(self._waiting) > self._capacity:
            del self._waiting[next(iter(self._waiting))]
            self.given_up += 1
        return None


def published_pair(messages: Mapping[str, Any]) -> PublishedPair:
    """Arrays of the messages of one pair by topic; InputError if any of them is unusable."""
    stamps = {topic: stamp_ns(message.header) for topic, message in messages.items()}
    if len(set(stamps.values())) > 1:
        raise InputError(f'messages of one pair must have the same stamp, got {stamps}')
    topics = PairStatus(messages['pairs']).topics()
    if stamps.keys() != topics:
        raise InputError(
            f'~/pairs lists {" ".join(sorted(topics))}, but there are {" ".join(sorted(stamps))}'
        )
    pair = PublishedPair.of_status(messages['pairs'])
    if 'relative_pose' in messages:
        return _with_pose(pair, messages)
    if 'relative_rotation' not in messages:
        return pair
    imu = messages['relative_rotation']
    topic = '~/relative_rotation'
    covariance, velocity_covariance = np.full((2, 6, 6), math.nan)
    covariance[3:, 3:] = _covariance(topic, imu.orientation_covariance, 3)
    velocity_covariance[3:, 3:] = _covariance(topic, imu.angular_velocity_covariance, 3)
    return replace(
        pair,
        R=_rotation(topic, imu.orientation),
        angular_velocity=_velocity(f'the angular velocity of {topic}', imu.angular_velocity),
        covariance=covariance,
        velocity_covariance=velocity_covariance,
    )


def _with_pose(pair: PublishedPair, messages: Mapping[str, Any]) -> PublishedPair:
    """The pair with what the topics of a pose have."""
    if time_ns(messages['reference'].time_ref) != pair.reference_stamp_ns:
        raise InputError('~/reference and ~/pairs must name the same reference keyframe')
    pose = messages['relative_pose'].pose
    twist = messages['velocity'].twist
    linear = twist.twist.linear
    angular = twist.twist.angular
    return replace(
        pair,
        has_pose=True,
        R=_rotation('~/relative_pose', pose.pose.orientation),
        t=_unit('the position of ~/relative_pose', pose.pose.position, 'xyz'),
        covariance=_covariance('~/relative_pose', pose.covariance, 6),
        linear_velocity=_velocity('the linear velocity of ~/velocity', linear),
        angular_velocity=_velocity('the angular velocity of ~/velocity', angular),
        velocity_covariance=_covariance('~/velocity', twist.covariance, 6),
        matches=match_records(messages['matches']),
    )


def match_records(cloud: Any) -> NDArray[np.void]:
    """Records of MATCH_DTYPE (N,) of a sensor_msgs/PointCloud2; a view of the message's memory."""
    found = []
    for column in cloud.fields:
        layout = int(column.offset), int(column.datatype), int(column.count)
        found.append((str(column.name), *layout))
    wanted = [(*column, 1) for column in outgoing.MATCH_FIELDS]
    wanted_size = MATCH_DTYPE.itemsize
    point_size = int(cloud.point_step)
    if found != wanted or point_size != wanted_size or cloud.is_bigendian:
        wanted_names = ' '.join(MATCH_DTYPE.names or ())
        names = ' '.join(name[:20] for name, *_ in found[:20])
        endian = 'big' if cloud.is_bigendian else 'little'
        raise InputError(
            f'~/matches must have the fields {wanted_names}, little endian, {wanted_size} bytes a '
            f'point; got {names or "none"}, {endian} endian, {point_size} bytes'
        )
    data = np.frombuffer(cloud.data, dtype=np.uint8)
    width = int(cloud.width)
    height = int(cloud.height)
    size = width * height * wanted_size
    if len(data) != size:
        raise InputError(
            f'~/matches has {len(data)} bytes of data, but {width}x{height} points need {size}'
        )
    records = data.view(MATCH_DTYPE)
    _refuse_damaged(records)
    return records


def _refuse_damaged(records: NDArray[np.void]) -> None:
    """InputError if matches are not finite, or their rays no directions."""
    landmark = ('x', 'y', 'z')
    # A match without a landmark has NaN in all three of these.
    unknown = [np.isnan(records[name]) for name in landmark]
    is_without = np.logical_and.reduce(unknown)
    for name in MATCH_DTYPE.names or ():
        is_good = np.isfinite(records[name])
        if name in landmark:
            is_good |= is_without
        if not is_good.all():
            raise InputError('~/matches must be finite')
    for view in '12':
        lengths = np.linalg.norm(_rays(records, view), axis=1)
        errors = np.abs(lengths - 1.0)
        if (errors > _UNIT_TOLERANCE).any():
            raise InputError(f'the rays x{view} y{view} z{view} of ~/matches must have length 1')


def _rays(records: NDArray[np.void], view: str) -> Array:
    """Derotated rays (N, 3) in the camera '1' or '2'."""
    return np.stack([records[axis + view].astype(np.float64) for axis in 'xyz'], axis=1)


def _refuse_indefinite(information: Array) -> None:
    """InputError unless an information (K, K) is positive semidefinite, and not absurdly large."""
    values = np.linalg.eigvalsh(information)
    least = values[0]
    most = values[-1]
    # Written so that NaN is refused, too.
    if not (-_LEAST_INFORMATION * most <= least and 0.0 < most < _MOST_INFORMATION):
        raise InputError(
            'image_information of ~/pairs must be positive semidefinite, with eigenvalues below '
            f'{_MOST_INFORMATION:g}, got {least:.3g} to {most:.3g}: the pair is not used'
        )


def _unit(name: str, message: Any, axes: str) -> Array:
    values = np.array([getattr(message, axis) for axis in axes], dtype=np.float64)
    if not _is_unit(values):
        raise InputError(f'{name} must have length 1, got {values.tolist()}')
    return values


def _is_unit(values: Array) -> bool:
    return abs(math.hypot(*values) - 1.0) <= _UNIT_TOLERANCE  # not NaN


def _velocity(name: str, vector: Any) -> Array:
    return validate.array(name, [vector.x, vector.y, vector.z], (3,), largest=_LARGEST_SPEED)


def _covariance(topic: str, covariance: Any, size: int) -> Array:
    values = validate.array(f'the covariance of {topic}', covariance, (size * size,))
    return values.reshape(size, size)


def _rotation(topic: str, quaternion: Any) -> Array:
    unit = _unit(f'the orientation of {topic}', quaternion, 'xyzw')
    return np.asarray(Rotation.from_quat(unit).as_matrix())


# -- relative poses chained to a path --------------------------------------------------------
#
# Two views do not determine the scale. The current camera of a pair is the reference of the next,
# and many tracks are observed in both: the ratio of a point's distances there, in the one baseline
# and in the other, is the ratio of the baselines. Errors accumulate as in any odometry.

# Squared sine of the angle between two rays, below which they count as parallel and have no
# distances. A larger bound would lose far tracks. [chosen: 1e-24, rounding, to 1e-10 would do]
_PARALLEL = 1e-18
# Sigma of the median of n normal deviates, over sigma / sqrt(n). [derived: sqrt(pi / 2)]
_OF_MEDIAN = 1.2533


@dataclass(frozen=True, slots=True, eq=False)
class PathPose:
    """A camera of the path, in the axes of the first camera of the chain."""

    stamp_ns: int
    R: Array  # (3, 3)
    position: Array  # (3,), in baselines of the path's first pair with a pose


@dataclass(frozen=True, slots=True, eq=False)
class PathStep:
    """Extension of the path by a pair: the current camera, if its position is known.

    The first step of a new path also has its first camera; `new_path` is the reason of the new
    path, with position and scale unrelated to the former. `scale_sigma` is from the scatter of the
    tracks, without the errors of the two poses, which are common to all tracks.
    """

    poses: tuple[PathPose, ...] = ()
    new_path: str = ''  # empty if the path continues, or none begins
    new_axes: bool = False  # whether the axes are unrelated to the former, too
    scale: float = math.nan  # the pair's baseline, in baselines of the path's first
    shared_tracks: int = 0  # for the scale relative to the last pair with a pose
    scale_sigma: float = math.nan  # 1 sigma of that ratio, relative


class PoseChain:
    """Chains the pairs of one node, in the order of their stamps.

    A pair with a rotation but no translation:

    - `PURE_ROTATION`: the position is unchanged, and the path continues. The true movement, below
      the noise of the matches, is missing from the path; the distances of the tracks, which
      propagate the scale to the next pair with a pose, are assumed unchanged: the relative error
      of the scale is the ratio of that movement to these distances.
    - `LOW_PARALLAX`: the position is unknown. The path ends, and the next pair with a pose begins
      one at another scale, in the same axes, since the rotation is known.

    Without a rotation the axes end with the path. With fewer than `min_shared_tracks` the scale is
    lost, and a new path begins.
    """

    def __init__(self, min_shared_tracks: int = 8) -> None:
        self._min_shared_tracks = validate.number('min_shared_tracks', min_shared_tracks, 1)
        # Pose of the last camera; None while rotation or position is unknown.
        self._stamp_ns = 0
        self._R: Array | None = None
        self._position: Array | None = None
        # Baseline of the last pair with a pose, None while the path has none; distances of the
        # tracks from its current camera, in these baselines.
        self._scale: float | None = None
        self._distances: dict[int, float] = {}
        # Why the next path begins, and whether its axes are new, too.
        self._reason = 'the first pair: a path begins'
        self._new_axes = True

    def add(self, pair: PublishedPair) -> PathStep:
        """Append a pair, to the path or as the first of a new one."""
        if self._R is not None and pair.reference_stamp_ns != self._stamp_ns:
            self._end('a pair is missing', new_axes=True)
        step = self._rescaled(pair) if pair else PathStep()
        if not pair.rotation_known:
            self._end(f'a pair has no rotation ({pair.status})', new_axes=True)
            return step
        start = np.eye(3) if self._R is None else self._R
        self._stamp_ns = pair.stamp_ns
        self._R = start @ pair.R
        if not pair and pair.status != Status.PURE_ROTATION.value:
            self._end(f'a pair has no translation ({pair.status})')
            return step
        if self._position is None:
            self._position = np.zeros(3)
            first = PathPose(pair.reference_stamp_ns, start, self._position)
            step = replace(step, poses=(first,), new_path=self._reason, new_axes=self._new_axes)
            self._new_axes = False
        if pair:
            moved = step.scale * pair.t
            self._position = self._position + start @ moved
        current = PathPose(pair.stamp_ns, self._R, self._position)
        return replace(step, poses=(*step.poses, current))

    def _rescaled(self, pair: PublishedPair) -> PathStep:
        """Move the scale of the path to a pair with a pose; the step has no poses yet."""
        of_reference, of_current = track_distances(pair)
        shared = of_reference.keys() & self._distances.keys()
        ratios = np.array([self._distances[track] / of_reference[track] for track in shared])
        if self._scale is not None and len(ratios) < self._min_shared_tracks:
            self._end(f'{len(ratios)} shared tracks, the scale needs {self._min_shared_tracks}')
        self._distances = of_current
        if self._scale is None:
            self._scale = 1.0
            return PathStep(scale=1.0)
        count = len(ratios)
        median = float(np.median(ratios))
        self._scale *= median
        scatter = robust_scale(ratios - median, 0.0, 0.0) / median
        sigma = _OF_MEDIAN * scatter / math.sqrt(count)
        return PathStep(scale=self._scale, shared_tracks=count, scale_sigma=sigma)

    def _end(self, reason: str, *, new_axes: bool = False) -> None:
        """End the path, with its axes if these are `new`; the first reason is the next path's."""
        if self._position is not None:
            self._reason = f'{reason}: the path restarts, at another scale'
        self._position = self._scale = None
        self._distances = {}
        if new_axes:
            self._R = None
            self._new_axes = True


def track_distances(pair: PublishedPair) -> tuple[dict[int, float], dict[int, float]]:
    """Distances of the tracks from the reference and from the current camera [baselines], by id.

    By least squares of (4) of ``docs/conventions.md``, with the velocity of the current camera
    for both; without tracks behind a camera or with parallel rays.
    """
    matches = pair.matches
    rays1 = _rays(matches, '1')
    rays2 = _rays(matches, '2') @ pair.R.T
    row_times = matches['tau2'].astype(np.float64) - matches['tau1']
    velocity = pair.R @ pair.linear_velocity  # in the reference camera
    baselines = pair.t + row_times[:, None] * velocity
    distances1, distances2, usable = depths_of_rays(rays1, rays2, baselines, _PARALLEL)
    tracks = matches['id'][usable].tolist()
    of_reference = distances1[usable].tolist()
    of_current = distances2[usable].tolist()
    return (
        dict(zip(tracks, of_reference, strict=True)),
        dict(zip(tracks, of_current, strict=True)),
    )
