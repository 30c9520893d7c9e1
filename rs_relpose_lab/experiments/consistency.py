"""Whether errors are as large as the covariances say: on simulated bags, and on recordings.

A recording has the relative poses of some pairs from elsewhere (a bundle adjustment over many
frames), with a sigma of the direction of t that is added to the estimate's own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import csv
from dataclasses import dataclass, replace
import itertools
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.experiments.scoring import chi_squares, pose_error
from rs_relpose_lab.experiments.tables import grouped, markdown_table, write_csv
from rs_relpose_lab.simulation import SimulationConfig
from rs_relpose_lab.simulation.bag import render_once
from rs_relpose_lab.simulation.scene import SCENES
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.front_end.front_end import FrameProcessed, FrontEnd
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.messages.incoming import PublishedImage
from rs_relpose_ros.messages.intake import Intake
from rs_relpose_ros.messages.sensor_feed import Role, SensorFeed
from rs_relpose_ros.replay.run import read_truth, Replay

Array = NDArray[np.float64]

R_FREEDOM, T_FREEDOM = 3, 2
# Of keyframes [px]: the default's, and one that makes pairs of about twice the interval.
PARALLAXES = (12.0, 30.0)
# By the truth, the camera stands still [m]: there is no direction of translation.
STILL = 0.03
# Longest interval of a short pair [s].
SHORT = 0.25
SIMULATED = 'simulated'


@dataclass(frozen=True, slots=True)
class PairConsistency:
    """A pair's errors [deg], and their squares in units of the covariance, by freedom."""

    source: str
    bag: str
    interval: float
    rotation: float
    translation: float
    rotation_nees: float
    translation_nees: float

    @property
    def span(self) -> str:
        """Whether the pair is a short or a long one."""
        return 'short' if self.interval < SHORT else 'long'


class TruePair(NamedTuple):
    """Pose ``X1 = R X2 + t`` of two frames' stamped rows, and 1 sigma of t per axis [rad]."""

    stamp1_ns: int
    stamp2_ns: int
    R: Array
    t: Array
    translation_sigma: float


def pair_consistency(source: str, bag: str, interval: float, pose: RelativePose, R: Array,
                     t: Array, translation_sigma: float = 0.0) -> PairConsistency:
    """Compare an estimate with the truth (R, t), whose t is known to `translation_sigma` [rad]."""
    error = pose_error(pose.R, pose.t, R, t)
    covariance = pose.covariance.copy()
    covariance[:3, :3] += translation_sigma**2 * np.eye(3)
    nees = chi_squares(pose.R, pose.t, R, t, covariance)
    return PairConsistency(source, bag, interval, error.rotation, error.translation,
                           nees.rotation / R_FREEDOM, nees.translation / T_FREEDOM)


def configurations(bags: int, first_seed: int) -> list[SimulationConfig]:
    """Walks of 6 s: scenes take turns, read-outs from 12 to 35 ms and noises are drawn."""
    configs = []
    for seed in range(first_seed, first_seed + bags):
        rng = np.random.default_rng(seed)
        configs.append(SimulationConfig(
            seed=seed, scene=SCENES[seed % len(SCENES)], duration=6.0,
            plan='walk:6.0' if seed % 2 else '', readout_time=round(rng.uniform(0.012, 0.035), 4),
            pixel_noise=float(rng.choice([0.5, 1.0, 2.0, 4.0])),
            gyro_noise_density=float(rng.choice([1e-4, 1.7e-4, 3.4e-4]))))
    return configs


def on_simulated_bag(config: SimulationConfig, folder: Path) -> Iterator[PairConsistency]:
    """Pairs of a bag, rendered into `folder` unless it is there; without those at rest."""
    path, parameter_file = render_once(config, folder)
    parameters = read_parameters(parameter_file)
    name = f'{config.scene} {config.seed}, {1e3 * config.readout_time:.0f} ms'
    for parallax in PARALLAXES:
        keyframes = replace(parameters.keyframes, min_keyframe_parallax=parallax)
        with open_bag(path) as bag:
            topics = bag.find_topics()
            truth = read_truth(bag, topics)
            assert truth is not None
            for pair in Replay(bag, topics, replace(parameters, keyframes=keyframes)).pairs():
                result = pair.result
                known = truth.relative_pose(result.reference_ns1, result.reference_ns2)
                if result.pose and known and np.linalg.norm(known[1]) > STILL:
                    yield pair_consistency(SIMULATED, name, result.interval, result.pose, *known)


def read_true_pairs(path: Path) -> list[TruePair]:
    """Pairs of a table with columns stamp1_ns, stamp2_ns, r11 to r33, tx, ty, tz, sigma_t_deg."""
    if not path.is_file():
        raise MissingInputError(f'there is no table of true pairs {path}')
    with path.open(newline='', encoding='utf-8') as file:
        rows = list(csv.DictReader(file))
    try:
        return [TruePair(
            int(row['stamp1_ns']), int(row['stamp2_ns']),
            np.array([[float(row[f'r{i}{j}']) for j in (1, 2, 3)] for i in (1, 2, 3)]),
            np.array([float(row[f't{axis}']) for axis in 'xyz']),
            float(np.radians(float(row['sigma_t_deg'])))) for row in rows]
    except (KeyError, ValueError) as error:
        raise InputError(f'{path} is no table of true pairs: {error}') from error


def on_recording(path: Path, parameter_file: Path, truth: Path) -> Iterator[PairConsistency]:
    """The true pairs of a recording, as a node publishes them that has run from its begin."""
    parameters = read_parameters(parameter_file)
    for apart in _passes(read_true_pairs(truth)):
        pairs = {(true.stamp1_ns, true.stamp2_ns): true for true in apart}
        for result in chosen_pairs(path, parameters, list(pairs)):
            if result.pose:
                true = pairs[result.reference_stamp_ns, result.stamp_ns]
                yield pair_consistency(path.name, path.name, result.interval, result.pose, true.R,
                                       true.t, true.translation_sigma)


def _passes(pairs: Sequence[TruePair]) -> list[list[TruePair]]:
    """Pairs in groups within which none overlaps another, each in the order of time."""
    groups: list[list[TruePair]] = []
    for pair in sorted(pairs, key=lambda pair: pair.stamp1_ns):
        group = next((g for g in groups if g[-1].stamp2_ns <= pair.stamp1_ns), None)
        if group is None:
            groups.append(group := [])
        group.append(pair)
    return groups


def chosen_pairs(path: Path, parameters: Parameters,
                 ends: Sequence[tuple[int, int]]) -> Iterator[PairResult]:
    """Pairs with given ends, amid those of the keyframe policy, of one run over a recording.

    `ends`: stamps of both images [ns], in the order of time and without overlap. A pair in which
    tracks or gyro are lost is left out.
    """
    following = dict(itertools.pairwise([0, *image_stamps(path)]))
    keyframes, wanted = frozenset(itertools.chain.from_iterable(ends)), set(ends)
    within = {s for s in following if any(begin < s < end for begin, end in ends)}
    at_once, never = (parameters.updated(policy) for policy in (
        {'max_keyframe_frames': 1},
        {'min_keyframe_parallax': 1000.0, 'max_keyframe_interval': 60.0,
         'min_tracked_fraction': 0.0, 'max_keyframe_frames': 1000}))
    front_end = FrontEnd(parameters, offline=True)
    intake = Intake(front_end.sequencer, parameters.imu.stuck_gyro_time, parameters.intrinsics)
    done = 0   # stamp of the last image that was processed or refused

    def closed() -> Iterator[PairResult]:
        nonlocal done
        while True:
            stamp = following.get(done)
            front_end.parameters = (at_once if stamp in keyframes else
                                    never if stamp in within else parameters)
            outcome = front_end.step()
            if outcome is None:
                return
            done = outcome.stamp_ns or done
            if isinstance(outcome, FrameProcessed) and outcome.result is not None and (
                    outcome.result.reference_stamp_ns, outcome.result.stamp_ns) in wanted:
                yield outcome.result

    with open_bag(path) as bag:
        topics = bag.find_topics(needs_camera_info=not parameters.intrinsics.given)
        for role, message in intake.feed.messages(bag, topics):
            intake.receive(role, message.message)
            yield from closed()
    front_end.sequencer.close()
    yield from closed()


def image_stamps(path: Path) -> list[int]:
    """Stamps of all images of a bag [ns]."""
    images: list[PublishedImage] = []
    feed = SensorFeed({Role.IMAGE: images.append})
    with open_bag(path) as bag:
        for role, message in feed.messages(bag, bag.find_topics(needs_camera_info=False)):
            feed.receive(role, message.message)
    return [image.stamp_ns for image in images]


def write_report(folder: Path, pairs: Sequence[PairConsistency]) -> str:
    """Write the figures (CSV) and the report (Markdown), and return the latter."""
    write_csv(folder / 'consistency.csv', pairs)
    bags = [_line(f'{bag}, {span}', of_bag)
            for (bag, span), of_bag in grouped(pairs, lambda p: (p.bag, p.span)).items()]
    sources = [_line(f'{source}: all', of_source)
               for source, of_source in grouped(pairs, lambda p: p.source).items()]
    text = markdown_table(
        ('bag, span', 'pairs', 'interval [s]', 'R [deg]', 't [deg]', 'NEES / 3 of R: median',
         'mean', 'NEES / 2 of t: median', 'mean'), bags + sources)
    (folder / 'consistency.md').write_text(text, encoding='utf-8')
    return text


def _line(name: str, pairs: Sequence[PairConsistency]) -> tuple[str, ...]:
    values = np.array([(p.interval, p.rotation, p.translation, p.rotation_nees,
                        p.translation_nees) for p in pairs])
    interval, rotation, translation, of_rotation, of_translation = np.median(values, axis=0)
    means = values.mean(axis=0)
    return (name, f'{len(pairs)}', f'{interval:.2f}', f'{rotation:.3f}', f'{translation:.2f}',
            f'{of_rotation:.2f}', f'{means[3]:.2f}', f'{of_translation:.2f}', f'{means[4]:.2f}')
