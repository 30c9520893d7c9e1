"""Frames and pairs of them: the camera model, rays, the measurements of a pair, its result.

The same functions serve keyframe pairs, whose corners were tracked (`pipeline.py`), and chosen
frames at any interval (`chosen_pairs.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
import math
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.settings import KeyframeConfig, Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator import velocity
from rs_relpose_ros.estimator.estimate import estimate_relative_pose
from rs_relpose_ros.estimator.frames_between import IntermediateFrame
from rs_relpose_ros.estimator.problem import build_problem
from rs_relpose_ros.estimator.result import Landmarks, landmarks, RelativePose, Status
from rs_relpose_ros.geometry import Array, validate
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.geometry.motion import FrameMotion, InertialMotion
from rs_relpose_ros.geometry.so3 import aligning_rotation, cross, median, norm, rotated
from rs_relpose_ros.geometry.timing import seconds_between, Sensor, to_nanoseconds
from rs_relpose_ros.imu import integration
from rs_relpose_ros.imu.integration import FrameImu, ImuSlice, motions_on_the_way
from rs_relpose_ros.jit import kernel
from rs_relpose_ros.pipeline.findings import Assessment, NOT_EVALUATED
from rs_relpose_ros.pipeline.monitor import Applied, Tracked
from rs_relpose_ros.tracking.features import Matches
from rs_relpose_ros.tracking.images import EncodedImage, is_dark

Result = TypeVar('Result')
Frames = TypeVar('Frames')


# -- Frames ------------------------------------------------------------------------------------


@dataclass(slots=True, eq=False)
class Frame(Generic[Result]):
    """A decoded image with its IMU data, and, once it has been processed, the result.

    Raises InputError if the image does not have the size of the intrinsics.
    """

    stamp_ns: int  # of the header
    image: NDArray[Any]  # (H, W) gray, as published: not rectified, not resized
    frame_id: str
    intrinsics: Intrinsics
    imu_data: FrameImu | None = None
    exposure: float = 0.0  # of a row [s], over which the gyro is averaged
    applied_offset_ns: int = 0  # tracked time offset in its IMU data, beyond the parameter's
    ahead: float = 0.0  # [s] newest stamp of the gyro as the image came, less the stamped row's
    # For derotated images, whose `image` is (H, W) or (H, W, C) in its own encoding.
    encoding: str = 'mono8'
    encoded: EncodedImage | None = None
    restart: bool = False  # time jumped since the frame before: tracks belong to another time
    # On the monotonic clock, 0 offline: arrival of the image or of the IMU sample behind its last
    # row, the later of the two; begin of the decoding.
    ready_ns: int = 0
    taken_ns: int = 0
    seconds: float = 0.0  # wall time of the processing
    result: Result | None = None

    def __post_init__(self) -> None:
        if self.encoded is None and (self.image.dtype != np.uint8 or self.image.ndim != 2):
            raise InputError(
                f'image must be (H, W) of uint8, got {self.image.shape} of {self.image.dtype}'
            )
        height, width = self.image.shape[:2]
        expected = self.intrinsics.image_height, self.intrinsics.image_width
        if (height, width) != expected:
            raise InputError(
                f'image is {width}x{height}, but its CameraInfo is for '
                f'{expected[1]}x{expected[0]}: publish a CameraInfo of the same size (region of '
                'interest and binning included)'
            )

    @property
    def imu(self) -> FrameImu:
        """Its IMU data; InputError if there are none yet."""
        if self.imu_data is None:
            raise InputError('the frame has no IMU data yet: see view_frame')
        return self.imu_data


# -- Pairs ---------------------------------------------------------------------------------


def is_keyframe(
    config: KeyframeConfig,
    *,
    parallax: float,
    interval: float,
    frames: int,
    tracked_fraction: float,
) -> bool:
    """Whether the current frame creates a keyframe pair: enough parallax, or time is up.

    Since the reference keyframe: median parallax of the matches after derotation [px], interval
    [s], number of frames, and share of the keyframe's features that are still tracked.
    """
    return (
        parallax >= config.min_keyframe_parallax
        or tracked_fraction < config.min_tracked_fraction
        or interval >= config.max_keyframe_interval
        or frames >= config.max_keyframe_frames
    )


@dataclass(frozen=True, slots=True, eq=False)
class PairResult:
    """Estimate of one keyframe pair with its matches."""

    # Of the reference keyframe's and the current image's pose rows, on the camera's clock: their
    # header stamps, or those of their middle rows (`pose_row`).
    reference_stamp_ns: int
    stamp_ns: int
    reference_ns1: int  # the same times on the IMU clock
    reference_ns2: int
    frame_id: str  # of the current image
    interval: float  # [s] between the two reference times
    pose: RelativePose  # its inliers are a mask over `matches`
    matches: Matches  # pixels of the published images
    row_times1: Array  # (N,) [s] from the stamped row
    row_times2: Array
    rays1: Array  # (N, 3) unit, derotated by the gyro to the stamped row
    rays2: Array
    parallax: float  # [px] median after derotation
    landmarks_of: Callable[[], Landmarks] | None = None  # None without a pose
    gyro_rotation: Array | None = None  # (3, 3) R_1^T R_2 integrated from the gyro
    # (3,) [rad] rotation by the images alone against the gyro's; None without either
    images_against_gyro: Array | None = None
    health: Assessment = NOT_EVALUATED  # by the pairs before: published before its assessment
    tracked: Tracked | None = None  # this and applied: as after this pair
    applied: Applied = field(default_factory=Applied)
    gyro_bias: Array | None = None  # (3,) [rad/s] that was removed, IMU frame
    image2: NDArray[np.uint8] | None = None  # only if the front end keeps images

    @property
    def landmarks(self) -> Landmarks | None:
        """Landmarks of the matches, made when they are wanted; None without a pose."""
        return None if self.landmarks_of is None else self.landmarks_of()

    @property
    def gyro_difference(self) -> float:
        """Angle between the rotations by gyro and by images alone [deg]; NaN without either."""
        if self.images_against_gyro is None:
            return math.nan
        return math.degrees(float(np.linalg.norm(self.images_against_gyro)))


class PairMetric(NamedTuple):
    """A published field of every pair; NaN is shown as an empty text."""

    name: str  # with the unit; the key on /diagnostics and among the medians of summary.json
    of: Callable[[PairResult], float]
    digits: int  # after the point, on /diagnostics

    def text(self, pair: PairResult | None) -> str:
        """As on /diagnostics."""
        value = math.nan if pair is None else self.of(pair)
        return '' if math.isnan(value) else f'{value:.{self.digits}f}'


# The one list for topics, /diagnostics and files.
PAIR_METRICS = (
    PairMetric('matches', lambda pair: len(pair.matches), 0),
    PairMetric('inliers', lambda pair: int(np.count_nonzero(pair.pose.inliers)), 0),
    PairMetric(
        'inlier_ratio',
        lambda pair: np.count_nonzero(pair.pose.inliers) / max(len(pair.matches), 1),
        3,
    ),
    PairMetric('parallax_px', lambda pair: pair.parallax, 1),
    PairMetric('residual_rms_px', lambda pair: pair.pose.residual_rms, 2),
    PairMetric('pixel_sigma_px', lambda pair: pair.pose.pixel_sigma, 3),
    PairMetric('interval_s', lambda pair: pair.interval, 3),
    PairMetric('rotation_difference_to_gyro_deg', lambda pair: pair.gyro_difference, 3),
)


# -- Rays of tracked points -----------------------------------------------------------------

Ids = NDArray[np.uint32]


@dataclass(frozen=True, slots=True, eq=False)
class DerotatedRays:
    """Points of one image with their derotated rays."""

    track_ids: Ids  # (N,)
    points: Array  # (N, 2) pixels of the published image
    rays: Array  # (N, 3) unit, in the camera frame of the stamped row
    row_times: Array  # (N,) [s] from the stamped row

    @classmethod
    def from_points(
        cls, track_ids: Ids, points: Array, sensor: Sensor, motion: FrameMotion
    ) -> DerotatedRays:
        """Rays of points (N, 2) of a published image."""
        return cls(track_ids, points, *sensor.derotated(points, motion))

    def of(self, track_ids: Ids) -> DerotatedRays | None:
        """Those of some of the tracks, in the same order; None if one is missing."""
        rows = positions(self.track_ids, track_ids)
        if len(rows) < len(track_ids):
            return None
        if len(rows) == len(self.track_ids):
            return self
        return DerotatedRays(
            self.track_ids[rows], self.points[rows], self.rays[rows], self.row_times[rows]
        )


@kernel
def positions(ids: Ids, wanted: Ids) -> NDArray[np.int64]:
    """Positions of `wanted` among the ids, up to the first one that is not there in order."""
    found = np.empty(len(wanted), dtype=np.int64)
    k = 0
    for i in range(len(wanted)):
        while k < len(ids) and ids[k] != wanted[i]:
            k += 1
        if k == len(ids):
            return found[:i]
        found[i] = k
        k += 1
    return found


@kernel
def median_parallax(rays1: Array, rays2: Array, rotation: Array) -> float:
    """Median of ``|f_1 x R f_2|`` [about rad] of unit rays (N, 3), ``R = R_1^T R_2`` (3, 3).

    Rays of NaN do not count; 0 if there are no others.
    """
    values = np.empty(len(rays1))
    count = 0
    for i in range(len(rays1)):
        value = norm(cross(rays1[i], rotated(rotation, rays2[i])))
        if not math.isnan(value):
            values[count] = value
            count += 1
    return median(values[:count]) if count else 0.0


# -- Measurements of a pair, given to the estimator -----------------------------------------

# Largest 1 sigma of the gravity direction that the estimator accepts [rad].
_LARGEST_GRAVITY_SIGMA = 1.5
_LACK_OF_MATCHES = (Status.TOO_FEW_MATCHES, Status.NO_CONSENSUS)


def interval_of(first: FrameImu, second: FrameImu) -> float:
    """Seconds between the stamped rows of two frames."""
    return seconds_between(first.reference_ns, second.reference_ns)


def inertial_of(
    first: FrameImu, second: FrameImu, since: ImuSlice | None, parameters: Parameters
) -> InertialMotion | str:
    """Motion of a pair by the accelerometer, or the reason why it is not known.

    `since` extends from the first frame to the second one.
    """
    if not parameters.pair.use_accelerometer:
        return 'use_accelerometer is false'
    if not parameters.pair.use_gyro_rotation:
        # The gyro rotates the specific force.
        return 'use_gyro_rotation is false'
    if since is None:
        return 'the gyro has a gap'
    return integration.inertial_motion(since, first, second, parameters.imu)


def estimate_pair(
    first: FrameImu,
    second: FrameImu,
    stamps_ns: tuple[int, int],
    matches: Matches,
    sensor: Sensor,
    gyro: ImuSlice | None,
    inertial: InertialMotion | str,
    parameters: Parameters,
    *,
    interval: float | None,
    stamp_sigma: float = 0.0,
    between: Sequence[IntermediateFrame] = (),
) -> RelativePose:
    """The relative pose of two frames from all that is known of them.

    `stamps_ns`: of both; they and the parameter `seed` are that of the samples.
    `interval` [s]: None if it does not constrain the velocities.
    `stamp_sigma` [s]: scatter of the stamps, used if it is larger than the parameter.
    `between`: the frames between the two.
    """
    configured = gyro if parameters.pair.use_gyro_rotation else None
    motion1, motion2, gravity_sigma = _with_gravity(first, second, parameters)
    pose = estimate_relative_pose(
        sensor.intrinsics.to_sensor(matches.points1),
        sensor.intrinsics.to_sensor(matches.points2),
        sensor.camera,
        motion1,
        motion2,
        relative_rotation=None if configured is None else configured.rotation,
        relative_rotation_covariance=None if configured is None else configured.covariance,
        interval=interval,
        config=validate.replaced(
            parameters.estimator,
            gravity_sigma=gravity_sigma,
            stamp_sigma=max(parameters.estimator.stamp_sigma, stamp_sigma),
        ),
        quality=matches.quality,
        inertial=None if isinstance(inertial, str) else inertial,
        between=() if configured is None or interval is None else between,
        rng=np.random.default_rng([parameters.pair.seed, *stamps_ns]),
    )
    if isinstance(inertial, str):
        pose = pose.without_baseline(f'baseline not known: {inertial}')
    return pose


def evidence_without(
    pose: RelativePose,
    first: FrameImu,
    second: FrameImu,
    sensor: Sensor,
    gyro: ImuSlice,
    inertial: InertialMotion,
    parameters: Parameters,
) -> velocity.InertialEvidence | None:
    """Consistency of the images with an acceleration that was not used; None if not known."""
    if pose.images is None:
        return None
    nothing, interval = np.empty((0, 2)), interval_of(first, second)
    problem = build_problem(
        nothing,
        nothing,
        sensor.camera,
        first.motion,
        second.motion,
        gyro.rotation,
        gyro.covariance,
    )
    motion = parameters.estimator.motion
    expected, _ = velocity.expected_velocities(problem, motion, interval, inertial)
    return velocity.inertial_evidence(problem, pose.images, motion, interval, expected)


def parallax_of(
    rays1: DerotatedRays, rays2: DerotatedRays, gyro: ImuSlice | None, sensor: Sensor
) -> float:
    """Median parallax [px] of matched rays after derotation."""
    rotation = aligning_rotation(rays1.rays.T @ rays2.rays) if gyro is None else gyro.rotation
    return sensor.camera.fx * median_parallax(rays1.rays, rays2.rays, rotation)


def pair_result(
    first: Frame[Any],
    second: Frame[Any],
    matches: Matches,
    rays1: DerotatedRays,
    rays2: DerotatedRays,
    pose: RelativePose,
    gyro: ImuSlice | None,
    sensor: Sensor,
    parameters: Parameters,
) -> PairResult:
    """The pair with its pose and the values derived from it."""
    later_ns = to_nanoseconds(sensor.pose_row_delay)
    if pose.status in _LACK_OF_MATCHES and is_dark(second.image):
        pose = replace(pose, reason=f'the image is dark: {pose.reason}')

    @cache
    def points() -> Landmarks:
        found = landmarks(
            pose, rays1.rays, rays2.rays, rays1.row_times, rays2.row_times, sensor.camera
        )
        to_image = sensor.intrinsics.to_image  # pixels of the published images
        return found._replace(pixels1=to_image(found.pixels1), pixels2=to_image(found.pixels2))

    return PairResult(
        reference_stamp_ns=first.stamp_ns + later_ns,
        stamp_ns=second.stamp_ns + later_ns,
        reference_ns1=first.imu.reference_ns,
        reference_ns2=second.imu.reference_ns,
        frame_id=second.frame_id,
        interval=interval_of(first.imu, second.imu),
        pose=pose,
        matches=matches,
        row_times1=rays1.row_times,
        row_times2=rays2.row_times,
        rays1=rays1.rays,
        rays2=rays2.rays,
        parallax=parallax_of(rays1, rays2, gyro, sensor),
        landmarks_of=points if pose else None,
        gyro_rotation=None if gyro is None else gyro.rotation,
        gyro_bias=None if gyro is None else parameters.sensor.R_cam_imu.T @ gyro.bias,
    )


def _with_gravity(
    imu1: FrameImu, imu2: FrameImu, parameters: Parameters
) -> tuple[FrameMotion, FrameMotion, float]:
    """Motions with gravity, both or none, and the sigma of gravity for the estimator."""
    sigma1, sigma2 = imu1.gravity_sigma, imu2.gravity_sigma
    configured = parameters.estimator.gravity_sigma
    if not parameters.pair.use_gravity or sigma1 is None or sigma2 is None:
        return (
            validate.replaced(imu1.motion, gravity=None),
            validate.replaced(imu2.motion, gravity=None),
            configured,
        )
    # One sigma for both frames: that of the filter where it is larger than the parameter.
    return imu1.motion, imu2.motion, min(max(configured, sigma1, sigma2), _LARGEST_GRAVITY_SIGMA)


# -- Frames between the two of a pair ---------------------------------------------------------
#
# Each step of a tracker adds its error, and the windows of a pair's last frame are aligned with
# those of its first one: the drift of a track is known there. In the frames before, it was a part
# of that in proportion to time, which is the mean of a random walk with known ends.

# Frames between that are used, evenly in the pair: more of them add hardly any accuracy.
MOST_FRAMES = 5


def used_frames(between: Sequence[Frames]) -> list[Frames]:
    """Those of the frames between the two of a pair that its estimate uses."""
    places = np.linspace(-1, len(between), min(len(between), MOST_FRAMES) + 2)[1:-1]
    return [between[k] for k in np.round(places).astype(int)]


class _TrackedFrame(NamedTuple):
    """A frame after the reference."""

    imu: FrameImu
    gyro: ImuSlice  # since the reference
    matches: Matches  # as tracked


class TrackHistory:
    """The frames since a reference keyframe."""

    def __init__(self, reference: FrameImu) -> None:
        self._reference = reference
        self._frames: list[_TrackedFrame] = []

    def add(self, imu: FrameImu, gyro: ImuSlice, matches: Matches) -> None:
        """Add the current frame with its tracks."""
        self._frames.append(_TrackedFrame(imu, gyro, matches))

    def between(
        self, matches: Matches, sensor: Sensor, inertial: InertialMotion | str
    ) -> list[IntermediateFrame]:
        """Frames between the reference and the last one, with the tracks of a pair's `matches`.

        `inertial`: motion of the pair.
        """
        *before, last = self._frames
        chosen = used_frames(before)
        motions: list[InertialMotion | None] = [None] * len(chosen)
        if not isinstance(inertial, str):
            motions = list(
                motions_on_the_way(
                    inertial, self._reference, last.gyro, [frame.imu for frame in chosen]
                )
            )
        drift = matches.points2 - _points(last.matches, matches)
        interval = self._interval(last.imu)
        return [
            validate.unchecked(
                IntermediateFrame,
                points=sensor.intrinsics.to_sensor(
                    _points(frame.matches, matches) + self._interval(frame.imu) / interval * drift
                ),
                motion=frame.imu.motion,
                interval=self._interval(frame.imu),
                relative_rotation=frame.gyro.rotation,
                relative_rotation_covariance=frame.gyro.covariance,
                inertial=motion,
            )
            for frame, motion in zip(chosen, motions, strict=True)
        ]

    def _interval(self, imu: FrameImu) -> float:
        """Seconds from the stamped row of the reference to that of a frame."""
        return seconds_between(self._reference.reference_ns, imu.reference_ns)


def _points(tracked: Matches, wanted: Matches) -> Array:
    """Second points (N, 2) of the `wanted` tracks (N); NaN where one was not tracked."""
    rows = positions(tracked.track_ids, wanted.track_ids)
    if len(rows) == len(wanted):  # no track was lost meanwhile, or changed its place
        return tracked.points2[rows]
    points = np.full((len(wanted), 2), np.nan)
    _, here, there = np.intersect1d(
        wanted.track_ids, tracked.track_ids, assume_unique=True, return_indices=True
    )
    points[here] = tracked.points2[there]
    return points
