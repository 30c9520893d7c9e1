"""The matrix of `rs_relpose benchmark trust`: what is told wrong, and what comes of it.

Each bag is simulated once, run told right, and then run through every row of `ROWS`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.trust_information import TellingMotion
from rs_relpose_lab.experiments.trust_rows import RIGHT, ROWS
from rs_relpose_lab.experiments.trust_runs import (
    FLAGGED,
    judged,
    JudgedPair,
    Recording,
    run,
    simulated,
    telling_motion,
)
from rs_relpose_lab.experiments.trust_tracks import TrackNoise
from rs_relpose_lab.simulation.config import SimulationConfig
from rs_relpose_lab.simulation.scene import make_scene, SCENES
from rs_relpose_lab.simulation.simulation import simulate, Simulation
from rs_relpose_lab.simulation.vehicle import vehicle
from rs_relpose_ros.config.estimator import EstimatorConfig
from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.front_end.pair import PairResult

MOTIONS = ('hand-held', 'vehicle')
# Beyond these lie 0.27 % of right poses: three sigmas of one dimension.
LIMIT_T, LIMIT_R = 11.8, 14.2
# Seconds that a run goes on after its error should have been flagged.
_AFTERWARDS = 3.0
# The scene's textures are made for a camera that sees no more than this: tracks need none [px].
_NO_TEXTURE = 20.0

# Streams of a bag's seed: what one draws leaves the others alone.
_DRAW, _SCENE, _MOTION, _TRACKS, _WRONG = range(10, 15)


class BagPlan(NamedTuple):
    """A bag of the matrix; `noise`: of the told one, or 0 for that of a usual camera and IMU.

    `images`: rendered, rather than tracks alone.
    """

    number: int
    seed: int
    seconds: float
    readout_time: float
    noise: float = 0.0
    images: bool = False

    @property
    def motion(self) -> str:
        """Hand-held and vehicle take turns."""
        return MOTIONS[self.number % len(MOTIONS)]

    @property
    def scene(self) -> str:
        """Scenes take turns, each with both motions."""
        return SCENES[self.number // len(MOTIONS) % len(SCENES)]


def plans(bags: int, seconds: float, first_seed: int, *, noises: Sequence[float] = (0.0,),
          images: bool = False) -> list[BagPlan]:
    """Bags whose read-outs are spread from 12 to 35 ms; noises take turns."""
    readouts = np.linspace(0.012, 0.035, max(bags, 2))[:bags]
    # Neighbours in motion and scene get read-outs from all over.
    order = np.random.default_rng(first_seed).permutation(bags)
    return [BagPlan(k, first_seed + k, seconds, round(float(readouts[order[k]]), 4),
                    noises[k // len(MOTIONS) % len(noises)], images) for k in range(bags)]


def simulation_of(plan: BagPlan) -> Simulation:
    """Camera, lens, mounting and offset are drawn; told noises are those of the defaults."""
    rng = np.random.default_rng([plan.seed, _DRAW])
    default = SimulationConfig()
    tilt = Rotation.from_rotvec(np.radians(rng.uniform(-4.0, 4.0, 3)))
    mounting = tilt * Rotation.from_quat(default.quat_cam_imu_xyzw)
    imu = ImuConfig()
    config = SimulationConfig(
        duration=plan.seconds, seed=plan.seed, scene=plan.scene,
        # A sensor cannot be read for longer than a frame takes.
        fps=min(30.0, 0.98 / plan.readout_time), readout_time=plan.readout_time,
        fx=float(rng.uniform(380.0, 540.0)),
        distortion=tuple(float(rng.uniform(0.6, 1.3)) * k for k in default.distortion),
        time_offset=float(rng.uniform(-0.04, 0.04)),
        quat_cam_imu_xyzw=tuple(float(v) for v in mounting.as_quat()),
        gyro_bias=tuple(float(v) for v in rng.uniform(-0.02, 0.02, 3)),
        gyro_noise_density=(plan.noise * imu.gyro_noise_density if plan.noise
                            else default.gyro_noise_density))
    trajectory = None
    if plan.motion == 'vehicle':
        trajectory = vehicle(np.random.default_rng([plan.seed, _MOTION]), -0.5,
                             plan.seconds + 0.5, speed=float(rng.uniform(0.8, 1.6)))
    scene = None if plan.images else make_scene(
        plan.scene, np.random.default_rng([plan.seed, _SCENE]), _NO_TEXTURE)
    return simulate(config, scene=scene, trajectory=trajectory)


def recording_of(plan: BagPlan) -> Recording:
    """The bag, as tracks or as images."""
    noise = None if plan.images else TrackNoise()
    if noise is not None and plan.noise:
        # Told is the noise of either image's points; here only those of the second one have any.
        noise = TrackNoise(white=plan.noise * math.sqrt(2.0) * EstimatorConfig().pixel_sigma)
    return simulated(f'{plan.seed}', simulation_of(plan), noise,
                     np.random.default_rng([plan.seed, _TRACKS]))


@dataclass(frozen=True, slots=True)
class BagRow:
    """One bag told one thing.

    `telling`: seconds of motion that can tell, while the run took; `qualifies`: they are enough.
    `flagged`: within them; `flagged_after`: after so many of them, NaN where never.
    `named`: figures that were named at the end of that time; `named_right`: at most two, with a
        right one among them.
    `poses`, `beyond_t`, `beyond_R`: poses at level ok or unknown after the first of these seconds,
        and those with errors beyond the limits; `all_`: including that second.
    `nees_t`, `nees_R`: mean of the chi squares by their degrees of freedom, of these poses.
    Errors and claimed sigma: medians [deg] of these poses. `frame_ms`: median of frames with a
    pair.
    """

    bag: str
    motion: str
    scene: str
    readout_ms: float
    noise: float
    row: str
    telling: float
    qualifies: bool
    flagged: bool
    flagged_after: float
    named: str
    named_right: bool
    pairs: int
    poses: int
    beyond_t: int
    beyond_R: int
    all_poses: int
    all_beyond_t: int
    all_beyond_R: int
    nees_t: float
    nees_R: float
    error_t: float
    sigma_t: float
    error_R: float
    frame_ms: float


def measure(plan: BagPlan, rows: Sequence[str]) -> list[BagRow]:
    """A simulated bag through the rows; told right first, since that says which seconds tell."""
    return measured_rows(recording_of(plan), plan, rows)


def measured_rows(recording: Recording, plan: BagPlan, rows: Sequence[str]) -> list[BagRow]:
    """The rows that apply to a recording."""
    right = list(run(recording, recording.told))
    motion = telling_motion(recording, [pair for pair, _ in right])
    found = []
    for name in rows:
        row = ROWS[name]
        # Twice the same stream: what is told and what the laboratory knows of it agree.
        told, injected = (draw(recording.told, np.random.default_rng([plan.seed, _WRONG]))
                          for draw in (row.wrong, row.injected))
        if injected is not None and not injected.error.any():
            continue   # e.g. no distortion to leave out
        tells = motion.seconds(injected)
        if name == RIGHT:
            pairs = right
        else:
            pairs = list(run(recording, told, _end(tells, row.within)))
        found.append(_bag_row(recording, plan, name, tells, pairs))
    return found


def _end(tells: NDArray[np.bool_], within: int) -> float:
    """When a run may end: all seconds that count have passed, and some more [s]."""
    passed = np.flatnonzero(np.cumsum(tells) >= within)
    return float(passed[0]) + 1.0 + _AFTERWARDS if len(passed) else math.inf


def _bag_row(recording: Recording, plan: BagPlan, name: str, tells: NDArray[np.bool_],
             results: Sequence[tuple[PairResult, float]]) -> BagRow:
    row = ROWS[name]
    pairs = [judged(recording, pair, seconds) for pair, seconds in results]
    clocks = [_clock(tells, pair.at) for pair in pairs]
    flags = [(clock, pair) for clock, pair in zip(clocks, pairs, strict=True)
             if pair.verdict.state in FLAGGED]
    in_time = [pair for clock, pair in flags if clock <= row.within]
    # What it says when the time is over.
    named = in_time[-1].verdict.named if in_time else ()
    believed = [pair for pair in pairs if pair.has_pose and pair.verdict.state not in FLAGGED]
    later = [pair for clock, pair in zip(clocks, pairs, strict=True)
             if clock > 1.0 and pair.has_pose and pair.verdict.state not in FLAGGED]
    counted = later if name != RIGHT else believed
    telling = _clock(tells, recording.seconds)
    return BagRow(
        bag=recording.name, motion=plan.motion, scene=plan.scene,
        readout_ms=1e3 * plan.readout_time, noise=plan.noise, row=name, telling=telling,
        qualifies=telling >= row.within, flagged=bool(in_time),
        flagged_after=flags[0][0] if flags else math.nan, named=' '.join(named),
        named_right=len(named) <= 2 and bool(set(named) & set(row.named)), pairs=len(pairs),
        poses=len(later), beyond_t=_beyond_t(later), beyond_R=_beyond_R(later),
        all_poses=len(believed), all_beyond_t=_beyond_t(believed),
        all_beyond_R=_beyond_R(believed), nees_t=_mean([p.chi_t / 2 for p in counted]),
        nees_R=_mean([p.chi_R / 3 for p in counted]),
        error_t=_median([p.error_t for p in counted]),
        sigma_t=_median([p.sigma_t for p in counted]),
        error_R=_median([p.error_R for p in counted]),
        frame_ms=1e3 * _median([p.seconds for p in pairs]))


def _clock(tells: NDArray[np.bool_], at: float) -> float:
    """Seconds of motion that can tell up to an instant [s]."""
    full = min(int(at), len(tells))
    running = at - full if full < len(tells) and tells[full] else 0.0
    return float(np.count_nonzero(tells[:full])) + running


def _beyond_t(pairs: Sequence[JudgedPair]) -> int:
    return sum(pair.chi_t > LIMIT_T for pair in pairs)


def _beyond_R(pairs: Sequence[JudgedPair]) -> int:
    return sum(pair.chi_R > LIMIT_R for pair in pairs)


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else math.nan


__all__ = ['BagPlan', 'BagRow', 'TellingMotion', 'fields', 'measure', 'plans']
