"""`rs_relpose benchmark odometry --disturbances N`: live states through disturbances.

Each walk has 6 s before and 6 s after its disturbance; states are those that odometry_node would
publish, at 30 Hz.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from rs_relpose_lab.experiments import trust_runs
from rs_relpose_lab.experiments.harness import grouped, markdown_table, write_table
from rs_relpose_lab.experiments.trust_runs import Recording
from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.scene import SCENES
from rs_relpose_lab.simulation.simulation import Simulation
from rs_relpose_ros.bags.sensor_topics import IMU_DELAY
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import log_so3
from rs_relpose_ros.geometry.timing import seconds_between, to_nanoseconds
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.messages.published_pair import PublishedPair
from rs_relpose_ros.odometry.estimator import OdometryEstimator
from rs_relpose_ros.odometry.states import ContinuousPath, Odometry, OdometryState
from rs_relpose_ros.offline.truth import TrueTrajectory

# Time of undisturbed motion before and after a disturbance [s]. [chosen: odometry has started]
_MARGIN = 6.0
# Time after a disturbance at which sigmas are to be as before [s]. [chosen: some keyframes]
NORMAL_AGAIN = 2.0
# Period of the published states [ns]. [derived: 30 Hz]
_PERIOD_NS = 33_333_333
# Square of an error in sigmas that 0.3 % of right states exceed. [derived: quantile of chi
# squared of 3 degrees of freedom]
BEYOND = float(chi2.ppf(0.997, 3))
# Time without a sample after which odometry_node reports it [ns].
_SILENT_NS = 250_000_000


class Disturbance(NamedTuple):
    """What happens from `_MARGIN` on for some seconds."""

    seconds: float
    images: bool = True  # whether they arrive
    samples: bool = True  # likewise
    corners: float = 1.0  # share of the corners in sight
    white: float = 1.0  # factor of their noise
    lost: float = 0.0  # share of them that is lost from frame to frame
    object_speed: float = 0.0  # [px/s] of an object that covers half of the image
    plan: str = 'walk'  # of the motion


# Disturbances by name. [chosen: what happens to a camera and an IMU, once short and once longer
# than odometry bridges]
DISTURBANCES = {
    'none': Disturbance(2.0),
    **{
        f'no images, {seconds:g} s': Disturbance(seconds, images=False)
        for seconds in (0.8, 2.0, 5.0)
    },
    **{f'no texture, {seconds:g} s': Disturbance(seconds, corners=0.0) for seconds in (2.0, 5.0)},
    'blur, 2 s': Disturbance(2.0, white=12.0, lost=0.2),
    'darkness, 4 s': Disturbance(4.0, corners=0.06, white=8.0, lost=0.05),
    **{f'no IMU, {seconds:g} s': Disturbance(seconds, samples=False) for seconds in (0.3, 2.0)},
    'standstill, 4 s': Disturbance(4.0, plan='still'),
    'pure rotation, 3 s': Disturbance(3.0, plan='rotate'),
    'object, 3 s': Disturbance(3.0, object_speed=60.0),
}


def disturbed(
    recording: Recording, simulation: Simulation, what: Disturbance, rng: np.random.Generator
) -> Recording:
    """The recording with a disturbance."""
    first_ns = simulation.config.start_ns
    begin_ns, end_ns = (first_ns + to_nanoseconds(at) for at in (_MARGIN, _MARGIN + what.seconds))
    assert recording.sightings is not None
    within = [
        begin_ns <= simulation.reference_ns(arrival.number) < end_ns
        for arrival in recording.arrivals
    ]
    arrivals = [
        arrival
        for arrival, there in zip(recording.arrivals, within, strict=True)
        if what.images or not there
    ]
    samples = [
        sample
        for sample in recording.samples
        if what.samples or not begin_ns <= sample.stamp_ns < end_ns
    ]
    return replace(
        recording,
        arrivals=arrivals,
        samples=samples,
        sightings=_other_sightings(
            recording.sightings,
            np.flatnonzero(within) / simulation.config.fps,
            int(np.argmax(within)),
            what,
            0.5 * simulation.config.width,
            rng,
        ),
    )


def _other_sightings(
    known: trust_runs.Sightings,
    seconds: Array,
    first: int,
    what: Disturbance,
    half: float,
    rng: np.random.Generator,
) -> trust_runs.Sightings:
    """Sightings with those of a disturbance from frame `first` on, at `seconds` (K,).

    Its corners, and those after it, are other ones than before.
    """
    count = len(known.slips)
    last = first + len(seconds)
    if (what.corners, what.white, what.lost, what.object_speed) == (1.0, 1.0, 0.0, 0.0):
        return known
    ids = list(known.ids)
    pixels = list(known.pixels)
    noise = list(known.noise)
    in_sight = rng.uniform(size=count) < what.corners
    # Time at which an object's corner appears; NaN for corners of the scene.
    appeared = np.full(count, np.nan)
    known_until = np.zeros(count, dtype=bool)
    for k, at in zip(range(first, last), seconds, strict=True):
        kept = in_sight[ids[k]] & (rng.uniform(size=len(ids[k])) >= what.lost)
        kept[:1] = True  # a tracker of nothing has no image
        new = ~known_until[ids[k]]
        known_until[ids[k]] = True
        if what.object_speed:
            appeared[ids[k][new & (pixels[k][:, 0] < half)]] = at
        moved = what.object_speed * np.nan_to_num(at - appeared[ids[k]])
        pixels[k] = (pixels[k] + moved[:, None] * np.array([1.0, 0.0]))[kept]
        ids[k], noise[k] = ids[k][kept] + count, what.white * noise[k][kept]
    for k in range(last, len(ids)):
        ids[k] = ids[k] + 2 * count
    return replace(
        known,
        ids=tuple(ids),
        pixels=tuple(pixels),
        noise=tuple(noise),
        slips=np.tile(known.slips, (3, 1)),
        slides=np.tile(known.slides, (3, 1)),
    )


# -- states as the node publishes them --------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class TrueStates:
    """The camera at the stamps (K,) of the samples: position, R to the world, velocity in it."""

    stamps_ns: NDArray[np.int64]
    position: Array
    R: Array
    velocity: Array

    @property
    def trajectory(self) -> TrueTrajectory:
        """Its poses."""
        return TrueTrajectory(
            self.stamps_ns, self.position, Rotation.from_matrix(self.R).as_quat()
        )


class Feed(NamedTuple):
    """Input of the odometry, with arrivals [ns]: pairs, samples, stamps of frames."""

    values: Mapping[str, Any]  # of the parameters
    pairs: list[tuple[int, PublishedPair]]
    samples: list[tuple[int, ImuSample]]
    frames: list[tuple[int, int]]


def feed_of(recording: Recording) -> Feed:
    """Pairs of the front end on a recording, and its samples."""
    arrives = {arrival.stamp_ns: arrival.arrives_ns for arrival in recording.arrivals}
    pairs = [
        (arrives[pair.stamp_ns], PublishedPair.of_result(pair))
        for pair, _ in trust_runs.run(recording, recording.configured)
    ]
    delay_ns = to_nanoseconds(IMU_DELAY)
    return Feed(
        recording.configured.values,
        pairs,
        [(sample.stamp_ns + delay_ns, sample) for sample in recording.samples],
        [(arrives_ns, stamp_ns) for stamp_ns, arrives_ns in arrives.items()],
    )


def true_states(simulation: Simulation) -> TrueStates:
    """The camera of a simulation."""
    states = simulation.states(simulation.imu.stamps_ns)
    return TrueStates(
        simulation.imu.stamps_ns, states.position, states.R_world_cam, states.velocity
    )


def published(estimator: OdometryEstimator, feed: Feed) -> Iterator[Odometry]:
    """States that odometry_node publishes: at 30 Hz, each pair being processed when it arrives."""
    path = ContinuousPath(estimator.propagated)
    waiting = list(feed.pairs[::-1])
    next_ns = 0
    frames = feed.frames[::-1]
    last_ns = feed.samples[0][0]
    for arrives_ns, sample in feed.samples:
        if arrives_ns - last_ns > _SILENT_NS:
            estimator.imu_is_silent(seconds_between(last_ns, arrives_ns))
        last_ns = arrives_ns
        while frames and frames[-1][0] <= arrives_ns:
            estimator.add_frame(frames.pop()[1])
        while waiting and waiting[-1][0] <= arrives_ns:
            estimator.add_pair(waiting.pop()[1])
            estimator.take(most=1)
        estimator.add_imu(sample)
        if arrives_ns >= next_ns:
            next_ns = arrives_ns + _PERIOD_NS
            if (state := path.at(estimator.newest_ns)) is not None:
                yield state
            estimator.take(most=1)


def errors_squared(states: Sequence[Odometry], first: Odometry, truth: TrueStates) -> Array:
    """Squared errors (N, 3) of position, rotation and velocity in units of their covariances.

    `first`: the first smoothed state, whose position and heading are those of the world.
    """
    rows = np.searchsorted(truth.stamps_ns, [state.imu_ns for state in states])
    origin = _interpolated(truth, first.imu_ns)
    M = first.R @ origin[1].T
    angle = np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1])
    turn = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    found = []
    for state, row in zip(states, rows, strict=True):
        R = turn @ truth.R[row]
        errors = (
            state.position - first.position - turn @ (truth.position[row] - origin[0]),
            log_so3(state.R @ R.T),
            state.velocity - truth.R[row].T @ truth.velocity[row],
        )
        blocks = (
            state.pose_covariance[:3, :3],
            state.pose_covariance[3:, 3:],
            state.velocity_covariance[:3, :3],
        )
        found.append(
            [
                error @ np.linalg.solve(block, error)
                for error, block in zip(errors, blocks, strict=True)
            ]
        )
    return np.reshape(found, (-1, 3))


def _interpolated(truth: TrueStates, at_ns: int) -> tuple[Array, Array]:
    """Position and rotation at a time between two samples."""
    k = int(np.searchsorted(truth.stamps_ns, at_ns))
    begin_ns, end_ns = truth.stamps_ns[k - 1 : k + 1]
    part = (at_ns - begin_ns) / (end_ns - begin_ns)
    begin, end = truth.position[k - 1 : k + 1]
    R_begin, R_end = truth.R[k - 1 : k + 1]
    turn = Rotation.from_matrix(R_begin.T @ R_end).as_rotvec()
    turned = Rotation.from_rotvec(part * turn).as_matrix()
    return begin + part * (end - begin), R_begin @ turned


# -- results ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class DisturbedRun:
    """A disturbance on one walk."""

    name: str
    seed: int
    states: int  # from its begin on
    beyond_position: int  # states whose error is beyond the 99.7 % quantile
    beyond_rotation: int
    beyond_velocity: int
    velocity_ratio: float  # of the sigmas 2 s after it and before it; NaN without a state
    tilt_ratio: float  # likewise
    uncertain_after: float  # [s] from the last usable pair before it; NaN if never
    lost: int
    largest_step: float  # between published states, in sigmas of the position


def tasks(seeds: int, first_seed: int) -> list[tuple[str, int]]:
    """All disturbances on as many walks."""
    return [(name, first_seed + k) for name in DISTURBANCES for k in range(seeds)]


def measure(task: tuple[str, int]) -> DisturbedRun:
    """A disturbance on the walk of a seed."""
    name, seed = task
    what = DISTURBANCES[name]
    simulation = simulate(configuration(what, seed))
    rng = np.random.default_rng(seed)
    feed = feed_of(disturbed(trust_runs.walk_of(simulation, rng), simulation, what, rng))
    return on_feed(name, seed, feed, true_states(simulation))


def configuration(what: Disturbance, seed: int) -> SimulationConfig:
    """The walk of a seed, with the motion of a disturbance."""
    return SimulationConfig(
        seed=seed,
        scene=SCENES[seed % len(SCENES)],
        readout_time=0.02,
        duration=2.0 * _MARGIN + what.seconds,
        plan=f'walk:{_MARGIN:g},{what.plan}:{what.seconds:g},walk:{_MARGIN:g}',
    )


def on_feed(name: str, seed: int, feed: Feed, truth: TrueStates) -> DisturbedRun:
    """The odometry of a disturbed walk."""
    estimator = OdometryEstimator(Parameters.from_mapping(feed.values), keep=True)
    states = list(published(estimator, feed))
    smoothed = estimator.smoothed()
    if not states or not smoothed:
        raise InputError(f'{name}, seed {seed}: odometry did not start')
    beyond = errors_squared(states, smoothed[0], truth) > BEYOND
    at = np.array([_seconds(state.imu_ns) for state in states])
    begin = _MARGIN
    end = _MARGIN + DISTURBANCES[name].seconds
    before = _sigmas(states, at, begin - 0.5)
    after = _sigmas(states, at, end + NORMAL_AGAIN)
    used = max(
        _seconds(pair.current_imu_ns)
        for _, pair in feed.pairs
        if pair.images is not None and _seconds(pair.current_imu_ns) < begin
    )
    uncertain = [
        _seconds(one.begin_ns) - used
        for one in estimator.intervals
        if one.state in (OdometryState.UNCERTAIN, OdometryState.LOST)
        and begin - 0.1 < _seconds(one.begin_ns) < end + 0.3
    ]
    counted = at > begin
    position, rotation, velocity = beyond[counted].sum(axis=0).tolist()
    of_velocity, of_tilt = (after / before).tolist()
    return DisturbedRun(
        name,
        seed,
        int(counted.sum()),
        position,
        rotation,
        velocity,
        of_velocity,
        of_tilt,
        min(uncertain, default=math.nan),
        estimator.counts['lost'],
        max(_step(one, two) for one, two in pairwise(states) if one.path == two.path),
    )


def _seconds(at_ns: int) -> float:
    return seconds_between(SimulationConfig().start_ns, at_ns)


def _sigmas(states: Sequence[Odometry], at: Array, seconds: float) -> Array:
    """Sigmas of velocity and tilt in the half second before a time; NaN without a state."""
    found = [
        (np.trace(state.velocity_covariance[:3, :3]), np.trace(state.pose_covariance[3:5, 3:5]))
        for state, when in zip(states, at, strict=True)
        if seconds - 0.5 < when <= seconds
    ]
    return np.sqrt(np.mean(found, axis=0)) if found else np.full(2, math.nan)


def _step(one: Odometry, two: Odometry) -> float:
    """Difference of two positions and the way between them, in sigmas of the former."""
    mean = 0.5 * (one.R @ one.velocity + two.R @ two.velocity)
    moved = two.position - one.position - seconds_between(one.imu_ns, two.imu_ns) * mean
    return float(np.linalg.norm(moved) / math.sqrt(np.trace(one.pose_covariance[:3, :3])))


def _largest(values: Iterable[float]) -> str:
    """As a text; NaN does not count."""
    known = [value for value in values if not math.isnan(value)]
    return f'{max(known):.2f}' if known else '-'


def write_report(folder: Path, runs: Sequence[DisturbedRun]) -> str:
    """Write the runs (CSV) and a table of the disturbances (Markdown), and return the latter."""
    rows = []
    for name, of_one in [*grouped(runs, lambda one: one.name).items(), ('all', list(runs))]:
        states = sum(one.states for one in of_one)
        rows.append(
            (
                name,
                str(len(of_one)),
                *(
                    f'{100.0 * sum(getattr(one, f"beyond_{key}") for one in of_one) / states:.1f}'
                    for key in ('position', 'rotation', 'velocity')
                ),
                *(
                    _largest(getattr(one, key) for one in of_one)
                    for key in ('velocity_ratio', 'tilt_ratio', 'uncertain_after')
                ),
                str(sum(one.lost for one in of_one)),
                f'{max(one.largest_step for one in of_one):.2f}',
            )
        )
    return write_table(
        folder,
        'odometry_disturbances',
        runs,
        markdown_table(
            (
                'disturbance',
                'walks',
                'beyond 99.7 %: position [%]',
                'rotation',
                'velocity',
                'sigma after by before: velocity',
                'tilt',
                'uncertain after [s]',
                'lost',
                'largest step [sigma]',
            ),
            rows,
        ),
    )
