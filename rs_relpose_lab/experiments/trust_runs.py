"""A recording through the real front end, told right or wrong, and what its pairs are worth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
import heapq
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.experiments.scoring import chi_squares, pose_error
from rs_relpose_lab.experiments.trust_information import (
    pair_information,
    TellingMotion,
    TruePair,
)
from rs_relpose_lab.experiments.trust_rows import FIGURES, Told
from rs_relpose_lab.experiments.trust_tracks import (
    numbered_image,
    Sightings,
    sightings,
    SimulatedTracker,
    TrackNoise,
)
from rs_relpose_lab.simulation.bag import right_parameters
from rs_relpose_lab.simulation.simulation import Simulation
from rs_relpose_ros.bags.layout import CAMERA_FRAME, IMAGE_DELAY, IMU_DELAY
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.front_end.frame import Frame
from rs_relpose_ros.front_end.front_end import FrameProcessed, FrontEnd
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.timing import NANOSECONDS, seconds_between, to_nanoseconds
from rs_relpose_ros.imu.samples import ImuSample

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

# States of the health at which a run counts as flagged, and those at which poses are believed.
FLAGGED = ('suspect', 'wrong')


class Arrival(NamedTuple):
    """An image on its way: its number, stamp and arrival [ns]."""

    number: int
    stamp_ns: int
    arrives_ns: int


# Kinds of recordings: simulated, without images and with them, and others.
TRACKS, IMAGES, RECORDING = 'tracks', 'images', 'recording'


class Source(NamedTuple):
    """Where a recording comes from; `noise`: of the told one, 0 where nobody chose it."""

    name: str
    kind: str
    motion: str = ''
    scene: str = ''
    seed: int = 0
    noise: float = 0.0


# Time of arrival [ns], and what arrives.
_Event = tuple[int, ImuSample | Arrival]


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """What a run needs, and what is true.

    `told`: what is right. `image`: of a frame's number, as the sensor gives it; `sightings`: where
    there are no images but tracks. `true_pose`: R and t [m] of the stamped rows of two stamps;
    None where it is not known. `rate_stamps_ns` (K,), `rates` (K, 3): true angular rate [rad/s],
    camera frame, on the IMU clock.
    """

    source: Source
    told: Told
    camera: RollingShutterCamera
    arrivals: Sequence[Arrival]
    samples: Sequence[ImuSample]
    image: Callable[[int], Gray]
    sightings: Sightings | None
    true_pose: Callable[[int, int], tuple[Array, Array] | None]
    rate_stamps_ns: NDArray[np.int64]
    rates: Array

    @property
    def seconds(self) -> float:
        """From the first stamp to the last."""
        return seconds_between(self.arrivals[0].stamp_ns, self.arrivals[-1].stamp_ns)


def intrinsics_of(camera: RollingShutterCamera) -> Intrinsics:
    """What the CameraInfo of the whole image tells of a camera."""
    return Intrinsics(
        width=camera.width, height=camera.height, fx=camera.fx, fy=camera.fy, cx=camera.cx,
        cy=camera.cy, distortion_model=camera.distortion_model, distortion=camera.distortion,
        image_width=camera.width, image_height=camera.height)


def simulated(source: Source, simulation: Simulation, noise: TrackNoise | None,
              rng: np.random.Generator) -> Recording:
    """A recording of a simulation: tracks with `noise`, or rendered images where it is None."""
    config, imu = simulation.config, simulation.imu
    stamps = [simulation.stamp_ns(k) for k in range(config.frame_count)]
    instants = dict(zip(stamps, map(simulation.reference_ns, range(config.frame_count)),
                        strict=True))
    shape = (config.height, config.width)
    delay_ns = to_nanoseconds(config.time_offset + config.readout_time + IMAGE_DELAY)

    def true_pose(stamp1_ns: int, stamp2_ns: int) -> tuple[Array, Array]:
        states = simulation.states([instants[stamp1_ns], instants[stamp2_ns]])
        R1, R2 = states.R_world_cam
        return R1.T @ R2, R1.T @ (states.position[1] - states.position[0])

    return Recording(
        source, Told(right_parameters(simulation), intrinsics_of(simulation.camera)),
        simulation.camera, [Arrival(k, stamp, stamp + delay_ns) for k, stamp in enumerate(stamps)],
        [ImuSample(stamp, tuple(rate), tuple(force)) for stamp, rate, force in zip(
            imu.stamps_ns.tolist(), imu.angular_velocities.tolist(),
            imu.linear_accelerations.tolist(), strict=True)],
        (lambda number: numbered_image(number, shape)) if noise is not None else simulation.image,
        None if noise is None else sightings(simulation, noise, rng),
        true_pose, imu.stamps_ns, simulation.states(imu.stamps_ns).angular_velocity)


class Verdict(NamedTuple):
    """What the health says with a pair: its state, and the figures that it names."""

    state: str
    named: tuple[str, ...]


# A product without health says this of every pair.
NO_HEALTH = Verdict('unknown', ())


def verdict_of(pair: PairResult) -> Verdict:
    """The health that came with a pair."""
    health = getattr(pair, 'health', None)
    if health is None:
        return NO_HEALTH
    return Verdict(health.state.value, tuple(
        finding.figure for finding in health.findings if finding.state in FLAGGED))


@dataclass(frozen=True, slots=True)
class JudgedPair:
    """A pair of a run, against the truth.

    `at`: stamp since the recording's first [s]; `seconds`: wall time of its frame. Of a pose, NaN
    without one: errors squared in sigmas, `chi_direction` (2 dof) and `chi_rotation` (3 dof);
    errors and claimed 1 sigma [deg].
    """

    at: float
    status: str
    verdict: Verdict
    seconds: float
    chi_direction: float = math.nan
    chi_rotation: float = math.nan
    direction_error: float = math.nan
    rotation_error: float = math.nan
    direction_sigma: float = math.nan

    @property
    def has_pose(self) -> bool:
        """Whether a pose was published, and its truth is known."""
        return not math.isnan(self.direction_error)


def run(recording: Recording, told: Told, until: float = math.inf,
        ) -> Iterator[tuple[PairResult, float]]:
    """Pairs of a run that is told so, with the wall time of their frames [s].

    `until` [s]: frames after that are not processed.
    """
    parameters = Parameters.from_mapping(told.values)
    camera, known = recording.camera, recording.sightings
    tracker = None if known is None else SimulatedTracker(
        known, lambda points: told.geometry.points(points, camera),
        parameters.tracking.max_features)
    front_end = FrontEnd(parameters, offline=True, tracker=tracker)
    first_ns = recording.arrivals[0].stamp_ns
    samples: Iterator[_Event] = (
        (sample.stamp_ns + to_nanoseconds(IMU_DELAY), sample) for sample in recording.samples)
    frames: Iterator[_Event] = (
        (arrival.arrives_ns, arrival) for arrival in recording.arrivals
        if seconds_between(first_ns, arrival.stamp_ns) <= until)
    for _, arrived in heapq.merge(samples, frames, key=lambda event: event[0]):
        if isinstance(arrived, ImuSample):
            front_end.sequencer.add_imu(told.sample(arrived))
        else:
            image = recording.image(arrived.number)
            if known is None:
                image = told.geometry.image(image, camera)
            front_end.sequencer.add_frame(
                Frame(arrived.stamp_ns, image, CAMERA_FRAME, told.intrinsics))
        yield from _closed(front_end)
    front_end.sequencer.close()
    yield from _closed(front_end)


def _closed(front_end: FrontEnd) -> Iterator[tuple[PairResult, float]]:
    while (outcome := front_end.step()) is not None:
        if isinstance(outcome, FrameProcessed) and outcome.result is not None:
            yield outcome.result, outcome.seconds


def judged(recording: Recording, pair: PairResult, seconds: float) -> JudgedPair:
    """A pair beside the truth."""
    at = seconds_between(recording.arrivals[0].stamp_ns, pair.stamp_ns)
    pose, verdict = pair.pose, verdict_of(pair)
    truth = recording.true_pose(pair.reference_stamp_ns, pair.stamp_ns) if pose else None
    if truth is None or not np.linalg.norm(truth[1]) > 0.0:
        return JudgedPair(at, pose.status.value, verdict, seconds)
    error = pose_error(pose.R, pose.t, *truth)
    chi = chi_squares(pose.R, pose.t, *truth, pose.covariance)
    # Of the two directions across t the mean variance.
    sigma = math.degrees(math.sqrt(0.5 * float(np.trace(pose.covariance[:3, :3]))))
    return JudgedPair(at, pose.status.value, verdict, seconds, chi.translation, chi.rotation,
                      error.translation, error.rotation, sigma)


def telling_motion(recording: Recording, pairs: Sequence[PairResult]) -> TellingMotion:
    """What each second of a recording tells, by the pairs of a run that was told right."""
    count = math.ceil(recording.seconds) + 1
    unknowns = sum(FIGURES.values())
    motion = TellingMotion(np.zeros((count, unknowns, unknowns)), np.zeros((count, 3, 3)))
    for pair in pairs:
        true = _true_pair(recording, pair)
        if true is not None:
            second = int(seconds_between(recording.arrivals[0].stamp_ns, pair.stamp_ns))
            information = pair_information(true, recording.camera)
            motion.figures[second] += information.figures
            motion.turns[second] += information.turn
    return motion


def _true_pair(recording: Recording, pair: PairResult) -> TruePair | None:
    """A pair with the truth, or, where that is not known, as it was estimated."""
    if not pair.pose:
        return None
    truth = recording.true_pose(pair.reference_stamp_ns, pair.stamp_ns)
    R, t = truth or (pair.pose.R, pair.pose.t)
    if not np.linalg.norm(t) > 0.0:
        return None
    camera, inliers = recording.camera, pair.pose.inliers
    middle_ns = to_nanoseconds(float(camera.row_times(0.5 * (camera.height - 1))))
    pixels = [points[inliers] for points in (pair.matches.points1, pair.matches.points2)]
    rates, middles = [], []
    for points, reference_ns in zip(pixels, (pair.reference_ns1, pair.reference_ns2), strict=True):
        row_times = camera.row_times(points[:, 1]) - middle_ns / NANOSECONDS
        # The mean rate between the two rows is about that half way between them.
        rates.append(_rate_at(recording, reference_ns + middle_ns, 0.5 * row_times))
        middles.append(_rate_at(recording, reference_ns + middle_ns, np.zeros(1))[0])
    config = Parameters.from_mapping(recording.told.values).imu
    return TruePair(pixels[0], pixels[1], R, t / np.linalg.norm(t), pair.interval, rates[0],
                    rates[1], middles[0], middles[1], pair.pose.residual_rms,
                    config.gyro_noise_density)


def _rate_at(recording: Recording, instant_ns: int, after: Array) -> Array:
    """True rates (N, 3) [rad/s] at times (N,) [s] after an instant on the IMU clock."""
    seconds = (recording.rate_stamps_ns - instant_ns) / NANOSECONDS
    return np.column_stack([np.interp(after, seconds, rate) for rate in recording.rates.T])
