"""A recording through the real front end, with any configuration, and its pairs against the truth.

Recordings are simulated, with rendered images or with tracks alone, or real.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
import heapq
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments import trust_rows
from rs_relpose_lab.experiments.scoring import chi_squares, pose_error
from rs_relpose_lab.simulation.bag import intrinsics_of, right_parameters
from rs_relpose_lab.simulation.render import view_of
from rs_relpose_lab.simulation.rows import observe
from rs_relpose_lab.simulation.simulation import Simulation
from rs_relpose_lab.simulation.trajectory import FinePath
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.bags.sensor_topics import CAMERA_FRAME, IMAGE_DELAY, IMU_DELAY
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import Parameters, sensor_model
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.matches import Matches
from rs_relpose_ros.geometry.timing import NANOSECONDS, seconds_between, to_nanoseconds
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.messages.incoming import PARTS, Role, sensor_messages
from rs_relpose_ros.offline.replay import read_truth
from rs_relpose_ros.pipeline.pair import Frame, PairResult, Result
from rs_relpose_ros.pipeline.pipeline import FrameLoop, FrontEnd
from rs_relpose_ros.tracking.features import keep_apart, TrackIds
from rs_relpose_ros.tracking.images import Image, RawImage

Gray = NDArray[np.uint8]

# -- tracks without images --------------------------------------------------------------------
#
# A rendered image costs 0.2 s, its tracks 20 ms. `SimulatedTracker` provides them like
# `KltTracker`: corners of the reference keyframe, tracked with noise, lost where the prediction is
# far off. Its images contain nothing but their number (`numbered_image`).

Ids = NDArray[np.int64]
# Pixels (N, 2) of the sensor to those of the published image.
PointMap = Callable[[Array], Array]

# Corners in sight, of which a tracker takes its 300. [chosen: some are too near to others]
_IN_SIGHT = 420
# Least distance between new corners [px]. [chosen: as `min_feature_distance`]
_LEAST_DISTANCE = 10.0
# Share of the corners that are lost from frame to frame, though in sight.
_LOST = 0.01
# Corners keep away from the image's border by half a window [px].
_BORDER = 8.0
# Distance [m] of two points at one pixel, from which one hides the other.
_HIDDEN = 5e-3
# KLT finds no corner whose place was predicted worse than this [px]: the reach of its pyramid.
_REACH = 40.0
# Share of lost corners from which on the prediction is not used.
_MOST_LOST = 0.15
# An odd number whose multiples scatter over the integers.
_SCATTER = 2654435761


@dataclass(frozen=True, slots=True)
class TrackNoise:
    """Errors of a track, as those of `KltTracker` in a rendered bag (docs/lab/trust.md).

    As the camera moves on, each corner slips off its place, in a direction of its own.
    """

    white: float = 0.04  # 1 sigma per coordinate of each match [px]
    slip: float = 0.08  # of the corner's place, times Student's t [px]
    freedom: float = 2.5  # degrees of freedom of that
    settled: float = 0.2  # [m] within which it slips
    wrong: float = 0.003  # share of corners that slide on
    slide: float = 10.0  # times a normal number [px/m]


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Where each frame of a recording shows the corners, errors apart."""

    # Of each frame's corners (N,), increasing; one that is lost does not come back.
    ids: tuple[Ids, ...]
    pixels: tuple[Array, ...]  # their places (N, 2) on the sensor
    noise: tuple[Array, ...]  # standard normal (N, 2)
    travelled: Array  # (F,) way of the camera up to each frame [m]
    slips: Array  # (M, 2) by id [px]
    slides: Array  # (M, 2) by id [px/m]
    errors: TrackNoise


def sightings(simulation: Simulation, noise: TrackNoise, rng: np.random.Generator) -> Sightings:
    """Corners on the surfaces of the scene, followed until they leave, hide or are lost."""
    frames = simulation.config.frame_count
    times = [simulation.seconds(simulation.reference_ns(k)) for k in range(frames)]
    camera = simulation.camera
    first, last = camera.row_time_span
    path = FinePath(simulation.trajectory, times[0] + first - 0.02, times[-1] + last + 0.02)
    view = view_of(camera)
    ids: Ids = np.empty(0, dtype=np.int64)
    world = np.empty((0, 3))
    observed_ids = []
    observed_pixels = []
    following = 0
    for time in times:
        pixels = observe(world, path.motion_from(time), view, margin=-_BORDER)
        kept = np.isfinite(pixels).all(axis=1) & (rng.uniform(size=len(ids)) >= _LOST)
        ids = ids[kept]
        world = world[kept]
        pixels = pixels[kept]
        new = _new_corners(rng, pixels, camera.width, camera.height)
        pixels = np.concatenate([pixels, new])
        there, hits = simulation.renderer.locate(time, pixels)
        ids = np.concatenate([ids, following + np.arange(len(new))])
        following += len(new)
        world = np.concatenate([world, there[len(world) :]])
        # Not where another surface hides it, nor where there is no surface.
        kept = (hits >= 0) & (np.linalg.norm(there - world, axis=1) < _HIDDEN)
        ids = ids[kept]
        world = world[kept]
        pixels = pixels[kept]
        observed_ids.append(ids)
        observed_pixels.append(pixels)
    positions = simulation.trajectory.poses(times)[0]
    steps = np.linalg.norm(np.diff(positions, axis=0, prepend=positions[:1]), axis=1)
    # Student's t: a normal number by the root of chi squared over its degrees of freedom.
    sigmas = noise.slip / np.sqrt(rng.chisquare(noise.freedom, following) / noise.freedom)
    slides = noise.slide * (rng.uniform(size=following) < noise.wrong)
    directions = rng.standard_normal((2, following, 2))
    return Sightings(
        tuple(observed_ids),
        tuple(observed_pixels),
        tuple(rng.standard_normal((len(frame), 2)) for frame in observed_ids),
        np.cumsum(steps),
        sigmas[:, None] * directions[0],
        slides[:, None] * directions[1],
        noise,
    )


def _new_corners(rng: np.random.Generator, taken: Array, width: int, height: int) -> Array:
    """As many corners as are missing, away from the border and from those that are taken."""
    missing = _IN_SIGHT - len(taken)
    if missing <= 0:
        return np.empty((0, 2))
    drawn = rng.uniform(_BORDER, (width - 1 - _BORDER, height - 1 - _BORDER), (3 * missing, 2))
    apart = keep_apart(np.concatenate([taken, drawn]), _LEAST_DISTANCE)[len(taken) :]
    return drawn[apart][:missing]


def numbered_image(number: int, shape: tuple[int, int]) -> Image:
    """An image (H, W) that contains the number of its frame."""
    image = np.zeros(shape, dtype=np.uint8)
    image[0, :4] = np.frombuffer(np.uint32(number).tobytes(), dtype=np.uint8)
    return image


def number_of(image: Image) -> int:
    """The frame of a numbered image."""
    return int(np.frombuffer(image[0, :4].tobytes(), dtype=np.uint32)[0])


class SimulatedTracker:
    """A `rs_relpose_ros.tracking.features.Tracker` of numbered images.

    The position of a corner in the reference keyframe is exact by definition, since a tracker
    compares with it. So an error that a track has when its frame becomes the reference stays with
    it, and is no error from then on.

    `published`: from the sensor to the image that is really published.
    """

    def __init__(self, sightings: Sightings, published: PointMap, most: int) -> None:
        self._sightings = sightings
        self._published = published
        self._most = most
        self._ids = TrackIds()
        self.reset()

    def allow(self, allowed: NDArray[np.uint8] | None) -> None:
        """Numbered images have no texture, and nothing in them is excluded."""

    def reset(self) -> None:
        """Forget all images; ids are not used again."""
        self._frame = self._reference = -1
        self._matches = Matches.none()
        self._corners: Ids = np.empty(0, dtype=np.int64)
        # Of each track, on the sensor: error that it had when the reference began, and place now.
        self._offsets = self._places = np.empty((0, 2))
        self._started = 0
        self._shape = (0, 0)

    @property
    def tracked_fraction(self) -> float:
        """Share of the reference's corners that are still tracked."""
        return len(self._matches) / self._started if self._started else 0.0

    @property
    def points(self) -> Array:
        """Corners (N, 2) in the current image [px]."""
        return self._matches.points2

    def start(self, image: Image) -> None:
        """Make `image` the reference keyframe, with new corners only."""
        self.reset()
        self._frame = number_of(image)
        self._shape = (image.shape[0], image.shape[1])
        self.promote()

    def track(
        self, image: Image, predicted: Array | None = None, interval: float = 1.0
    ) -> Matches:
        """Find the corners in `image`, as `Tracker.track` does."""
        self._frame = number_of(image)
        frame = self._frame
        known = self._sightings
        rows = np.searchsorted(known.ids[frame], self._corners)
        rows = np.minimum(rows, len(known.ids[frame]) - 1)
        way = known.travelled[frame] - known.travelled[self._reference]
        white = known.errors.white * known.noise[frame][rows]
        settled = min(way / known.errors.settled, 1.0)
        slip = settled * known.slips[self._corners]
        slide = way * known.slides[self._corners]
        places = known.pixels[frame][rows] + self._offsets + white + slip + slide
        points = self._published(places)
        before = self._matches.points2
        expected = points
        if predicted is not None:
            expected = np.where(np.isfinite(predicted), predicted, before)
        reached = np.linalg.norm(points - expected, axis=1) < _REACH
        if np.count_nonzero(~reached) > _MOST_LOST * len(reached):
            # Then `KltTracker` searches at the previous positions.
            reached |= np.linalg.norm(points - before, axis=1) < _REACH
        is_there = known.ids[frame][rows] == self._corners
        good = is_there & self._inside(points) & reached
        self._matches = self._matches.followed(points).kept(good)
        self._corners = self._corners[good]
        self._offsets = self._offsets[good]
        self._places = places[good]
        return self._matches

    def refined_matches(self) -> Matches:
        """Matches of reference and current image; they are as exact as they get."""
        return self._matches

    def promote(self) -> None:
        """Make the current image the reference; tracks continue, new corners fill the gaps."""
        ids = self._sightings.ids[self._frame]
        pixels = self._sightings.pixels[self._frame]
        kept = keep_apart(self.points, 0.5 * _LEAST_DISTANCE)
        corners = self._corners[kept]
        places = self._places[kept]
        free = ~np.isin(ids, corners) & self._inside(self._published(pixels))
        # Any of them, but the same ones in every run.
        scattered = ids[free] * _SCATTER % 2**32
        wanted = max(self._most - len(corners), 0)
        order = np.argsort(scattered)[:wanted]
        new = ids[free][order]
        new_places = pixels[free][order]
        self._corners = np.concatenate([corners, new])
        self._places = np.concatenate([places, new_places])
        rows = np.searchsorted(ids, self._corners)
        self._offsets = self._places - pixels[rows]
        points = self._published(self._places)
        new_tracks = self._ids.take(len(new))
        tracks = np.concatenate([self._matches.track_ids[kept], new_tracks])
        self._matches = Matches(tracks, np.stack([points, points]), np.ones(len(points)))
        self._started = len(points)
        self._reference = self._frame

    def _inside(self, points: Array) -> NDArray[np.bool_]:
        """Which points (N, 2) of the published image are clear of its border."""
        height, width = self._shape
        last = (width - 1 - _BORDER, height - 1 - _BORDER)
        inside = (points >= _BORDER) & (points <= last)
        return np.asarray(inside.all(axis=1))


# -- runs of a recording ----------------------------------------------------------------------

# States of the consistency monitor at which a run counts as flagged.
FLAGGED = ('suspect', 'wrong')


class Arrival(NamedTuple):
    """An image on its way: its number, stamp and arrival [ns]."""

    number: int
    stamp_ns: int
    arrives_ns: int


# Kind of a simulated recording without images. [derived: the report, as those below]
TRACKS = 'tracks'
# Kind of a simulated recording with images.
IMAGES = 'images'
# Kind of a recording of a camera.
RECORDING = 'recording'


class Source(NamedTuple):
    """Origin of a recording; `noise`: by the configured one, 0 where it was not chosen."""

    name: str
    kind: str
    motion: str = ''
    scene: str = ''
    seed: int = 0
    noise: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Input of a run, and the truth."""

    source: Source
    configured: trust_rows.Configured  # right
    camera: RollingShutterCamera
    arrivals: Sequence[Arrival]
    samples: Sequence[ImuSample]
    image: Callable[[int], Gray]  # of a frame's number, from the sensor
    sightings: Sightings | None  # tracks in place of images
    # R and t [m] of the stamped rows of two stamps; None where it is unknown.
    true_pose: Callable[[int, int], tuple[Array, Array] | None]
    rate_stamps_ns: NDArray[np.int64]  # (K,) on the IMU's clock
    rates: Array  # (K, 3) true angular rate [rad/s], camera frame

    @property
    def seconds(self) -> float:
        """From the first stamp to the last."""
        return seconds_between(self.arrivals[0].stamp_ns, self.arrivals[-1].stamp_ns)


def simulated(
    source: Source, simulation: Simulation, noise: TrackNoise | None, rng: np.random.Generator
) -> Recording:
    """A recording of a simulation: tracks with `noise`, or rendered images where it is None."""
    config = simulation.config
    imu = simulation.imu
    reference_ns = {
        simulation.stamp_ns(k): simulation.reference_ns(k) for k in range(config.frame_count)
    }
    shape = (config.height, config.width)
    delay_ns = to_nanoseconds(config.time_offset + config.readout_time + IMAGE_DELAY)

    def true_pose(stamp1_ns: int, stamp2_ns: int) -> tuple[Array, Array]:
        states = simulation.states([reference_ns[stamp1_ns], reference_ns[stamp2_ns]])
        R1, R2 = states.R_world_cam
        return R1.T @ R2, R1.T @ (states.position[1] - states.position[0])

    return Recording(
        source,
        trust_rows.Configured(right_parameters(simulation), intrinsics_of(simulation.camera)),
        simulation.camera,
        [Arrival(k, stamp, stamp + delay_ns) for k, stamp in enumerate(reference_ns)],
        imu.samples(),
        (lambda number: numbered_image(number, shape)) if noise is not None else simulation.image,
        None if noise is None else sightings(simulation, noise, rng),
        true_pose,
        imu.stamps_ns,
        simulation.states(imu.stamps_ns).angular_velocity,
    )


def walk_of(simulation: Simulation, rng: np.random.Generator, remark: str = '') -> Recording:
    """Tracks of a simulated walk with the usual noise."""
    config = simulation.config
    return simulated(
        Source(f'{config.scene} {config.seed}{remark}', TRACKS), simulation, TrackNoise(), rng
    )


@dataclass(frozen=True, slots=True)
class EvaluatedPair:
    """A pair of a run, against the truth; NaN without a pose."""

    at: float  # stamp since the recording's first [s]
    state: str  # of the consistency monitor
    named: tuple[str, ...]  # parameters that it names
    seconds: float  # wall time of its frame
    chi_direction: float = math.nan  # error squared in sigmas, 2 degrees of freedom
    chi_rotation: float = math.nan  # likewise, 3
    direction_error: float = math.nan  # [deg]
    rotation_error: float = math.nan  # [deg]
    direction_sigma: float = math.nan  # claimed, 1 sigma [deg]

    @property
    def has_pose(self) -> bool:
        """Whether a pose was published, and its truth is known."""
        return not math.isnan(self.direction_error)


def run(
    recording: Recording,
    configured: trust_rows.Configured,
    until: float = math.inf,
) -> Iterator[tuple[PairResult, float]]:
    """Pairs of a run with a configuration, and the wall time of their frames [s].

    `until` [s]: frames after that are not processed.
    """
    parameters = Parameters.from_mapping(configured.values)
    camera = recording.camera
    known = recording.sightings
    tracker = (
        None
        if known is None
        else SimulatedTracker(
            known,
            lambda points: configured.geometry.points(points, camera),
            parameters.tracking.max_features,
        )
    )
    front_end = FrontEnd(parameters, offline=True, tracker=tracker)
    for frame in processed(recording, configured, front_end, until):
        if frame.result is not None:
            yield frame.result, frame.seconds


def processed(
    recording: Recording,
    configured: trust_rows.Configured,
    loop: FrameLoop[Result],
    until: float = math.inf,
) -> Iterator[Frame[Result]]:
    """Frames of a run with a configuration, processed by a loop; `until` as of `run`."""
    camera = recording.camera
    first_ns = recording.arrivals[0].stamp_ns
    imu_delay_ns = to_nanoseconds(IMU_DELAY)
    samples: Sequence[ImuSample | Arrival] = recording.samples
    frames = [
        arrival
        for arrival in recording.arrivals
        if seconds_between(first_ns, arrival.stamp_ns) <= until
    ]

    def arrival_ns(item: ImuSample | Arrival) -> int:
        return item.arrives_ns if isinstance(item, Arrival) else item.stamp_ns + imu_delay_ns

    for arrived in heapq.merge(samples, frames, key=arrival_ns):
        if isinstance(arrived, ImuSample):
            loop.sequencer.add_imu(configured.sample(arrived))
        else:
            image = recording.image(arrived.number)
            if recording.sightings is None:
                image = configured.geometry.image(image, camera)
            loop.sequencer.add_frame(
                RawImage.of_gray(image, arrived.stamp_ns, CAMERA_FRAME), configured.intrinsics
            )
        yield from _taken(loop)
    loop.close()
    yield from _taken(loop)


def _taken(loop: FrameLoop[Result]) -> Iterator[Frame[Result]]:
    while (outcome := loop.step()) is not None:
        if isinstance(outcome, Frame):
            yield outcome


def evaluated(recording: Recording, pair: PairResult, seconds: float) -> EvaluatedPair:
    """A pair against the truth."""
    at = seconds_between(recording.arrivals[0].stamp_ns, pair.stamp_ns)
    pose = pair.pose
    verdict = (
        pair.health.state.value,
        tuple(finding.code.value for finding in pair.health.findings if finding.state in FLAGGED),
    )
    truth = recording.true_pose(pair.reference_stamp_ns, pair.stamp_ns) if pose else None
    if truth is None or not np.linalg.norm(truth[1]) > 0.0:
        return EvaluatedPair(at, *verdict, seconds)
    error = pose_error(pose.R, pose.t, *truth)
    chi = chi_squares(pose.R, pose.t, *truth, pose.covariance)
    # Of the two directions across t the mean variance.
    sigma = math.degrees(math.sqrt(0.5 * float(np.trace(pose.covariance[:3, :3]))))
    return EvaluatedPair(
        at,
        *verdict,
        seconds,
        chi.translation,
        chi.rotation,
        error.translation,
        error.rotation,
        sigma,
    )


def informative_motion(
    recording: Recording, pairs: Sequence[PairResult]
) -> trust_rows.InformativeMotion:
    """Information of each second of a recording, by the pairs of a run, configured right."""
    count = math.ceil(recording.seconds) + 1
    unknowns = sum(trust_rows.QUANTITIES.values())
    motion = trust_rows.InformativeMotion(
        np.zeros((count, unknowns, unknowns)), np.zeros((count, 3, 3))
    )
    for pair in pairs:
        true = _true_pair(recording, pair)
        if true is not None:
            second = int(seconds_between(recording.arrivals[0].stamp_ns, pair.stamp_ns))
            quantities, rotation = trust_rows.pair_information(true, recording.camera)
            motion.quantities[second] += quantities
            motion.rotations[second] += rotation
    return motion


def _true_pair(recording: Recording, pair: PairResult) -> trust_rows.TruePair | None:
    """A pair with the truth, or with its estimate where that is unknown."""
    if not pair.pose:
        return None
    truth = recording.true_pose(pair.reference_stamp_ns, pair.stamp_ns)
    R, t = truth or (pair.pose.R, pair.pose.t)
    if not np.linalg.norm(t) > 0.0:
        return None
    camera = recording.camera
    inliers = pair.pose.inliers
    middle_ns = to_nanoseconds(float(camera.row_times(0.5 * (camera.height - 1))))
    pixels = [points[inliers] for points in (pair.matches.points1, pair.matches.points2)]
    rates = []
    middles = []
    for points, reference_ns in zip(pixels, (pair.reference_ns1, pair.reference_ns2), strict=True):
        row_times = camera.row_times(points[:, 1]) - middle_ns / NANOSECONDS
        # The mean rate between the two rows is about that half way between them.
        rates.append(_rate_at(recording, reference_ns + middle_ns, 0.5 * row_times))
        middles.append(_rate_at(recording, reference_ns + middle_ns, np.zeros(1))[0])
    config = Parameters.from_mapping(recording.configured.values).imu
    return trust_rows.TruePair(
        pixels[0],
        pixels[1],
        R,
        t / np.linalg.norm(t),
        pair.interval,
        rates[0],
        rates[1],
        middles[0],
        middles[1],
        pair.pose.diagnostics.residual_rms,
        config.gyro_noise_density,
    )


def _rate_at(recording: Recording, time_ns: int, after: Array) -> Array:
    """True rates (N, 3) [rad/s] at times (N,) [s] after a time on the IMU clock."""
    seconds = (recording.rate_stamps_ns - time_ns) / NANOSECONDS
    return np.column_stack([np.interp(after, seconds, rate) for rate in recording.rates.T])


# -- bags with images ---------------------------------------------------------------------------


def recording_at(path: Path) -> Recording:
    """A bag with the parameters that are right next to it (``BAG.yaml``), and its truth, if any.

    Its rates are those of the gyro.
    """
    parameters = read_parameters(path.with_name(path.name + '.yaml'))
    found: dict[Role, list[Any]] = {role: [] for role in Role}
    with open_bag(path) as bag:
        topics = bag.find_topics(needs_camera_info=not parameters.intrinsics.given)
        for role, message in sensor_messages(bag, topics, found):
            found[role].append(PARTS[role].read(message.message))
        truth = read_truth(bag, topics)
    images = found[Role.IMAGE]
    samples = sorted(found[Role.IMU] + found[Role.ACCEL], key=lambda sample: sample.stamp_ns)
    first = images[0].decoded()
    intrinsics = (
        found[Role.CAMERA_INFO] or [parameters.intrinsics.of_image(first.shape[1], first.shape[0])]
    )[0]
    camera = sensor_model(intrinsics, parameters.sensor).camera
    offset_ns = to_nanoseconds(parameters.sensor.time_offset)
    delay_ns = to_nanoseconds(parameters.sensor.time_offset + camera.readout_time + IMAGE_DELAY)
    gyro = [
        (sample.stamp_ns, sample.angular_velocity)
        for sample in samples
        if sample.angular_velocity is not None
    ]
    rates = np.array([rate for _, rate in gyro]) - parameters.imu.gyro_bias
    R_cam_imu = Rotation.from_quat(parameters.sensor.quat_cam_imu_xyzw)
    return Recording(
        Source(path.name, RECORDING),
        trust_rows.Configured(parameters.to_mapping(), intrinsics),
        camera,
        [
            Arrival(number, image.stamp_ns, image.stamp_ns + delay_ns)
            for number, image in enumerate(images)
        ],
        samples,
        lambda number: images[number].decoded(),
        None,
        lambda stamp1_ns, stamp2_ns: (
            None
            if truth is None
            else truth.relative_pose(stamp1_ns + offset_ns, stamp2_ns + offset_ns)
        ),
        np.array([stamp for stamp, _ in gyro]),
        R_cam_imu.apply(rates),
    )
