"""Frames and pairs of them: rays, the problem of a pair for the estimator, its result.

The same functions serve keyframe pairs, whose corners were tracked (`pipeline.py`), and chosen
frames at any interval (`chosen_pairs.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
import math
import threading
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibration.findings import Assessment, NOT_EVALUATED
from rs_relpose_ros.calibration.residual_maps import PairSums
from rs_relpose_ros.config.settings import ImuConfig, KeyframeConfig, Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.covariance import ImageInformation
from rs_relpose_ros.estimator.pair_problem import PairProblem
from rs_relpose_ros.estimator.result import Landmarks, landmarks, RelativePose, Status
from rs_relpose_ros.geometry import Array, validate
from rs_relpose_ros.geometry.camera import Intrinsics, RollingShutterCamera
from rs_relpose_ros.geometry.matches import Ids, Matches
from rs_relpose_ros.geometry.motion import FrameMotion, InertialMotion
from rs_relpose_ros.geometry.so3 import aligning_rotation, cross, median, norm, rotated
from rs_relpose_ros.geometry.timing import seconds_between, Sensor, to_nanoseconds
from rs_relpose_ros.imu.buffer import EXACT, StampDoubt
from rs_relpose_ros.imu.integration import (
    FrameImu,
    ImuSlice,
    inertial_motions,
)
from rs_relpose_ros.jit import kernel
from rs_relpose_ros.pipeline.monitor import Applied, Tracked
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
    imu_doubt: StampDoubt = EXACT  # of the stamps of the gyro, beyond the parameters
    # Images that are to be derotated have an `image` (H, W) or (H, W, C) in their own encoding.
    encoding: str = 'mono8'
    encoded: EncodedImage | None = None
    restart: bool = False  # time jumped since the frame before: tracks belong to another time
    # On the monotonic clock, 0 offline: arrival of the image or of the IMU sample behind its last
    # row, whichever was later; and the begin of the decoding.
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

    Parameters
    ----------
    config : KeyframeConfig
    parallax : float
        Median parallax of the matches with the reference keyframe, after derotation [px].
    interval : float
        Time since the reference keyframe [s].
    frames : int
        Number of frames since the reference keyframe.
    tracked_fraction : float
        Share of the features of the reference keyframe that are still tracked.
    """
    return (
        parallax >= config.min_keyframe_parallax
        or tracked_fraction < config.min_tracked_fraction
        or interval >= config.max_keyframe_interval
        or frames >= config.max_keyframe_frames
    )


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """What a pair tells of the configuration; its pose is published before."""

    # (11, 9) change of the estimate by the images alone, by deviations of the images
    images_by_deviation: Array | None = None
    # (3,) [rad] rotation by the images alone against the gyro's; None without either
    images_against_gyro: Array | None = None
    # What its residuals add to their maps, also where its pose is withheld; None without a pose
    residual_sums: PairSums | None = None
    # Tracked calibration, and the corrections that follow from it, after this pair.
    tracked: Tracked | None = None
    applied: Applied = field(default_factory=Applied)


class Lesson:
    """Makes what a pair has `Learned`, once: as soon as it is wanted, by any thread."""

    def __init__(self, learn: Callable[[], Learned]) -> None:
        self._learn: Callable[[], Learned] | None = learn
        self._learned = Learned()
        self._lock = threading.Lock()

    def __call__(self) -> Learned:
        """Learn, unless it was done before."""
        with self._lock:
            if self._learn is not None:
                learn = self._learn
                self._learn = None
                self._learned = learn()
        return self._learned


@dataclass(frozen=True, slots=True, eq=False)
class PairResult:
    """Estimate of one keyframe pair with its matches."""

    # Times of the rows of reference keyframe and current image that the pose relates: their header
    # stamps, or the stamps of their middle rows (`pose_row`), on the clock of the camera.
    reference_stamp_ns: int
    stamp_ns: int
    # The same times on the clock of the IMU.
    reference_ns1: int
    reference_ns2: int
    frame_id: str  # of the current image
    interval: float  # [s] between the two reference times
    pose: RelativePose  # its inliers are a mask over `matches`
    matches: Matches  # derotated, in pixels of the published images
    parallax: float  # [px] median after derotation
    landmarks_of: Callable[[], Landmarks] | None = None  # None without a pose
    gyro_rotation: Array | None = None  # (3, 3) R_1^T R_2 integrated from the gyro
    health: Assessment = NOT_EVALUATED  # by the pairs before: published before its assessment
    # What it tells of the configuration: made after its pose has been published.
    lesson: Callable[[], Learned] = Learned
    gyro_bias: Array | None = None  # (3,) [rad/s] that was removed, IMU frame
    image2: NDArray[np.uint8] | None = None  # only if the front end keeps images
    readout_axis: int = 1  # pixel coordinate that is the row: 1 (v), or 0 (u) for turned images

    @property
    def landmarks(self) -> Landmarks | None:
        """Landmarks of the matches, made when they are wanted; None without a pose."""
        return None if self.landmarks_of is None else self.landmarks_of()

    @property
    def inliers(self) -> int:
        """Number of matches that agree with the pose."""
        return int(np.count_nonzero(self.pose.inliers))

    @property
    def images(self) -> ImageInformation | None:
        """Estimate of the images alone, with the effect of deviations; None if there is none."""
        by_deviation = self.lesson().images_by_deviation
        if self.pose.images is None or by_deviation is None:
            return self.pose.images
        return self.pose.images.moved_by(by_deviation)

    @property
    def images_against_gyro(self) -> Array | None:
        """Rotation (3,) [rad] by the images alone against the gyro's; None without either."""
        return self.lesson().images_against_gyro

    @property
    def tracked(self) -> Tracked | None:
        """Tracked calibration after this pair."""
        return self.lesson().tracked

    @property
    def applied(self) -> Applied:
        """Corrections of the next frames, which follow from the tracked calibration."""
        return self.lesson().applied

    @property
    def residual_sums(self) -> PairSums | None:
        """What the pair adds to the maps of residuals; None without a pose."""
        return self.lesson().residual_sums

    @property
    def gyro_difference(self) -> float:
        """Angle between the rotations by gyro and by images alone [deg]; NaN without either."""
        apart = self.images_against_gyro
        return math.nan if apart is None else math.degrees(float(np.linalg.norm(apart)))


class PairMetric(NamedTuple):
    """A published field of every pair; NaN is shown as an empty text."""

    name: str  # with the unit; the key on /diagnostics and among the medians of summary.json
    of: Callable[[PairResult], float]
    digits: int  # after the point, on /diagnostics

    def text(self, pair: PairResult | None) -> str:
        """The value as on /diagnostics."""
        value = math.nan if pair is None else self.of(pair)
        return '' if math.isnan(value) else f'{value:.{self.digits}f}'


# Metrics of a pair, for topics, /diagnostics and files alike. [derived: interface]
PAIR_METRICS = (
    PairMetric('matches', lambda pair: len(pair.matches), 0),
    PairMetric('inliers', lambda pair: pair.inliers, 0),
    PairMetric('inlier_ratio', lambda pair: pair.inliers / max(len(pair.matches), 1), 3),
    PairMetric('parallax_px', lambda pair: pair.parallax, 1),
    PairMetric('residual_rms_px', lambda pair: pair.pose.diagnostics.residual_rms, 2),
    PairMetric('pixel_sigma_px', lambda pair: pair.pose.diagnostics.pixel_sigma, 3),
    PairMetric('interval_s', lambda pair: pair.interval, 3),
    PairMetric('rotation_difference_to_gyro_deg', lambda pair: pair.gyro_difference, 3),
)


# -- Rays of tracked points -----------------------------------------------------------------


def derotated(
    matches: Matches,
    motion1: FrameMotion,
    motion2: FrameMotion,
    sensor: Sensor,
    known: Matches | None = None,
) -> Matches:
    """The matches of two published images with their rays and row times.

    Points of the reference image do not move: their rays are taken from `known`, derotated
    matches with the same reference, if it has all of the tracks.
    """
    reference = None if known is None else _known_rays(known, matches.track_ids)
    rays, row_times = zip(
        reference or sensor.derotated(matches.points1, motion1),
        sensor.derotated(matches.points2, motion2),
        strict=True,
    )
    return replace(matches, rays=np.stack(rays), row_times=np.stack(row_times))


def _known_rays(
    known: Matches,
    track_ids: Ids,
) -> tuple[Array, Array] | None:
    """Rays and row times of tracks in the reference image; None unless all are known."""
    rows = positions(known.track_ids, track_ids)
    if len(rows) < len(track_ids):
        return None
    return known.rays[0][rows], known.row_times[0][rows]


@kernel
def positions(
    ids: Ids,
    wanted: Ids,
) -> NDArray[np.int64]:
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
def median_parallax(
    rays1: Array,
    rays2: Array,
    rotation: Array,
) -> float:
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


def parallax_of(
    matches: Matches,
    since: ImuSlice | None,
    sensor: Sensor,
) -> float:
    """Median parallax [px] of derotated matches, with the gyro's rotation between the frames."""
    if since is None:
        rotation = aligning_rotation(matches.rays[0].T @ matches.rays[1])
    else:
        rotation = since.rotation
    return sensor.camera.fx * median_parallax(*matches.rays, rotation)


def interval_of(
    first: FrameImu,
    second: FrameImu,
) -> float:
    """Seconds between the stamped rows of two frames."""
    return seconds_between(first.reference_ns, second.reference_ns)


# -- From the frames since a reference to the problem of a pair, and to its result ------------

# Largest 1 sigma of the gravity direction that the estimator accepts [rad]. With it, gravity no
# longer has an effect. [derived: the range of the parameter gravity_sigma]
_LARGEST_GRAVITY_SIGMA = 1.5
# Most frames between that are used, evenly in the pair. More of them cost time and add hardly any
# accuracy; with three, the largest errors of long pairs were a quarter larger on recordings.
# [measured: recordings, together with the removal of observations far from a first result]
MOST_FRAMES = 5
# Statuses of pairs whose images may be dark. [derived: both come of too few good matches]
_LACK_OF_MATCHES = (Status.TOO_FEW_MATCHES, Status.NO_CONSENSUS)


def used_frames(between: Sequence[Frames]) -> list[Frames]:
    """Choose the intermediate frames that the estimate of a pair uses."""
    places = np.linspace(-1, len(between), min(len(between), MOST_FRAMES) + 2)[1:-1]
    return [between[k] for k in np.round(places).astype(int)]


class TrackHistory:
    """The frames since a reference keyframe, and the pair that the last one makes with it."""

    def __init__(
        self,
        stamp_ns: int,
        imu: FrameImu,
    ) -> None:
        """Begin at a reference keyframe, with its stamp and IMU data."""
        self.stamp_ns = stamp_ns
        self.imu = imu
        # IMU data of each frame, samples of the IMU since the reference, tracks.
        self._frames: list[tuple[FrameImu, ImuSlice | None, Matches]] = []

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def since(self) -> ImuSlice | None:
        """The IMU from the reference to the last frame; None without a frame, or with a gap."""
        return self._frames[-1][1] if self._frames else None

    def add(
        self,
        imu: FrameImu,
        since: ImuSlice | None,
        matches: Matches,
    ) -> None:
        """Add the current frame with the samples since the reference and with its tracks."""
        self._frames.append((imu, since, matches))

    def problem(
        self,
        stamp_ns: int,
        matches: Matches,
        sensor: Sensor,
        parameters: Parameters,
        *,
        near: bool = True,
        stamp_sigma: float = 0.0,
    ) -> PairProblem:
        """All that is known of the pair of the reference and the last frame, of `stamp_ns`.

        `matches` are refined tracks of the pair. `near`: whether the interval constrains the
        velocities, and frames between are used. `stamp_sigma` [s]: scatter of the stamps, used
        if it is larger than the parameter. The stamps of both frames and the parameter `seed`
        seed the random samples.
        """
        use_gyro = parameters.pair.use_gyro_rotation and self.since is not None
        between = used_frames(self._frames[:-1]) if near and use_gyro else []
        last = self._frames[-1]
        imus = [self.imu, *(imu for imu, _, _ in (*between, last))]
        slices = [since for _, since, _ in (*between, last)] if use_gyro else [None]
        reason, motions = self._accelerations(imus, near, parameters)
        motion1, motion2, gravity_sigma = _with_gravity(imus[0], imus[-1], parameters)
        seconds = np.array([interval_of(self.imu, imu) for imu in imus])
        if not near:
            seconds[-1] = math.nan
        points = [matches.points1, *self._drifted(matches, between), matches.points2]
        on_sensor = sensor.intrinsics.to_sensor(np.concatenate(points))
        seed = parameters.pair.seed, self.stamp_ns, stamp_ns
        configured = parameters.estimator
        rate_doubt = _rate_doubt(slices[-1], parameters.imu, sensor.camera)
        return PairProblem(
            replace(matches, points=on_sensor.reshape(len(imus), -1, 2)),
            sensor.camera,
            (motion1, *(imu.motion for imu in imus[1:-1]), motion2),
            seconds,
            np.stack([np.eye(3), *(_UNKNOWN if one is None else one.rotation for one in slices)]),
            np.stack(
                [
                    np.zeros((3, 3)),
                    *(_UNKNOWN if one is None else one.covariance for one in slices),
                ]
            ),
            motions,
            validate.replaced(
                configured,
                gravity_sigma=gravity_sigma,
                stamp_sigma=max(configured.stamp_sigma, stamp_sigma),
                gyro_sigma=math.hypot(configured.gyro_sigma, rate_doubt),
            ),
            int(np.random.default_rng(seed).integers(2**63)),
            reason,
            None if slices[-1] is None else slices[-1].path,
            parameters.sensor.R_cam_imu,
            rate_doubt,
        )

    def _accelerations(
        self, imus: Sequence[FrameImu], near: bool, parameters: Parameters
    ) -> tuple[str, tuple[InertialMotion | None, ...]]:
        """Why the accelerometer is not used, or empty; and the motion up to each frame."""
        unknown = (None,) * len(imus)
        if not near:
            return 'the frames are further apart than max_keyframe_interval', unknown
        if not parameters.pair.use_accelerometer:
            return 'use_accelerometer is false', unknown
        if not parameters.pair.use_gyro_rotation:
            # The gyro rotates the specific force.
            return 'use_gyro_rotation is false', unknown
        since = self.since
        if since is None:
            return 'the gyro has a gap', unknown
        motions = inertial_motions(since, imus, parameters.imu)
        if isinstance(motions, str):
            return motions, unknown
        return '', tuple(motions)

    # Each step of a tracker adds its error, and the windows of a pair's last frame are aligned
    # with the windows of its first one: the drift of a track is known there. The drift of an
    # earlier frame is interpolated linearly in time: that is the expected value of a random walk
    # whose two ends are known.

    def _drifted(
        self, matches: Matches, between: Sequence[tuple[FrameImu, ImuSlice | None, Matches]]
    ) -> list[Array]:
        """Points (N, 2) of a pair's refined `matches` in frames between the two."""
        last, _, tracked = self._frames[-1]
        drift = matches.points2 - _points(tracked, matches)
        interval = interval_of(self.imu, last)
        return [
            _points(tracks, matches) + interval_of(self.imu, imu) / interval * drift
            for imu, _, tracks in between
        ]

    def result(
        self,
        frame: Frame[Any],
        matches: Matches,
        pose: RelativePose,
        sensor: Sensor,
        parameters: Parameters,
    ) -> PairResult:
        """The pair of the reference and `frame`, the last one, with its pose.

        `matches` are derotated.
        """
        since = self.since
        later_ns = to_nanoseconds(sensor.pose_row_delay)
        if pose.status in _LACK_OF_MATCHES and is_dark(frame.image):
            pose = replace(pose, reason=f'the image is dark: {pose.reason}')

        @cache
        def points() -> Landmarks:
            found = landmarks(
                pose,
                matches.rays,
                matches.row_times,
                sensor.camera,
            )
            to_image = sensor.intrinsics.to_image  # pixels of the published images
            return found._replace(pixels1=to_image(found.pixels1), pixels2=to_image(found.pixels2))

        return PairResult(
            reference_stamp_ns=self.stamp_ns + later_ns,
            stamp_ns=frame.stamp_ns + later_ns,
            reference_ns1=self.imu.reference_ns,
            reference_ns2=frame.imu.reference_ns,
            frame_id=frame.frame_id,
            interval=interval_of(self.imu, frame.imu),
            pose=pose,
            matches=matches,
            parallax=parallax_of(matches, since, sensor),
            landmarks_of=points if pose else None,
            gyro_rotation=None if since is None else since.rotation,
            gyro_bias=None if since is None else parameters.sensor.R_cam_imu.T @ since.bias,
            readout_axis=sensor.camera.readout_axis,
        )


# Rotation of a frame where the gyro does not give it. [derived: NaN is not known]
_UNKNOWN = np.full((3, 3), math.nan)


def _rate_doubt(since: ImuSlice | None, imu: ImuConfig, camera: RollingShutterCamera) -> float:
    """1 sigma [rad/s] of the mean rate of a frame by the noise beyond the configured one.

    The random walk of the readout has a slope of 6 / 5 of the noise by the time. The rotations
    between frames contain half of it already: they begin with the same samples.
    """
    if since is None or since.noise_density <= imu.gyro_noise_density:
        return 0.0
    begin, end = camera.row_time_span
    more = since.noise_density**2 - imu.gyro_noise_density**2
    return math.sqrt(0.6 * more / (end - begin)) if end > begin else 0.0


def _with_gravity(
    imu1: FrameImu, imu2: FrameImu, parameters: Parameters
) -> tuple[FrameMotion, FrameMotion, float]:
    """Motions with gravity, both or none, and the sigma of gravity for the estimator."""
    sigma1 = imu1.gravity_sigma
    sigma2 = imu2.gravity_sigma
    configured = parameters.estimator.gravity_sigma
    if not parameters.pair.use_gravity or sigma1 is None or sigma2 is None:
        return (
            validate.replaced(imu1.motion, gravity=None),
            validate.replaced(imu2.motion, gravity=None),
            configured,
        )
    # One sigma for both frames: the filter's where it is larger than the parameter.
    sigma = min(max(configured, sigma1, sigma2), _LARGEST_GRAVITY_SIGMA)
    return imu1.motion, imu2.motion, sigma


def _points(
    tracked: Matches,
    matches: Matches,
) -> Array:
    """Second points (N, 2) of `tracked` for the tracks of `matches`; NaN where one was lost."""
    rows = positions(tracked.track_ids, matches.track_ids)
    if len(rows) == len(matches):  # no track was lost meanwhile, or changed its place
        return tracked.points2[rows]
    points = np.full((len(matches), 2), np.nan)
    _, here, there = np.intersect1d(
        matches.track_ids, tracked.track_ids, assume_unique=True, return_indices=True
    )
    points[here] = tracked.points2[there]
    return points
