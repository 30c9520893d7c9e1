"""Whether errors are consistent with the covariances: on simulated bags, and on recordings.

A recording has the relative poses of some pairs from elsewhere (a bundle adjustment over many
frames), whose covariance is added to the estimate's own.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
import itertools
import math
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from rs_relpose_lab.experiments.comparison import opencv_pose
from rs_relpose_lab.experiments.harness import grouped, markdown_table, write_table
from rs_relpose_lab.experiments.methods import Pose
from rs_relpose_lab.experiments.scoring import chi_squares, pose_error
from rs_relpose_lab.experiments.true_pairs import read_truth, TruePair, TruePath
from rs_relpose_lab.simulation import SimulationConfig
from rs_relpose_lab.simulation.bag import render_once
from rs_relpose_lab.simulation.scene import SCENES
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.geometry.timing import seconds_between
from rs_relpose_ros.messages import incoming
from rs_relpose_ros.offline.replay import MessageRefused, outcomes, Replay
from rs_relpose_ros.offline.replay import read_truth as truth_of_bag
from rs_relpose_ros.pipeline.pair import Frame, PairResult
from rs_relpose_ros.pipeline.pipeline import FrontEnd

# Degrees of freedom of a rotation. [derived: three angles]
R_FREEDOM = 3
# Degrees of freedom of a direction. [derived: two angles]
T_FREEDOM = 2
# Share of right errors within the ellipsoid that is counted. [derived: three sigmas]
QUANTILE = 0.997
# Of keyframes [px]: the default's, and one that makes pairs of about twice the interval.
PARALLAXES = (12.0, 30.0)
# Baseline by the truth [m] below which there is no direction of translation.
STILL = 0.03
# Longest interval of a short pair [s].
SHORT = 0.25
# Name of the rows of simulated bags. [derived: the report]
SIMULATED = 'simulated'
# Name of the rows of recordings. [derived: the report]
RECORDED = 'recordings'
# Name of the comparison with the readout ignored. [derived: the report]
NO_READOUT = 'readout ignored'
# Name of the comparison with OpenCV's 5-point solver on the same matches. [derived: the report]
MAGSAC = 'MAGSAC'
# What differs in the parameters of the comparison with the readout ignored.
IGNORE_READOUT = {'readout_time': 0.0, 'withhold_when_wrong': False}
# Threshold of OpenCV on these matches [px]. [chosen: its default]
THRESHOLD = 1.0
# Covariance of the truth of a simulation.
_EXACT = np.zeros((6, 6))

# The pose of a pair by one of these.
Method = Callable[[PairResult, Intrinsics], 'RelativePose | Pose | None']


@dataclass(frozen=True, slots=True)
class PairConsistency:
    """A pair's errors [deg], and their squares in units of the covariance, by freedom.

    NaN where there is no pose.
    """

    source: str
    bag: str
    stamp1_ns: int
    stamp2_ns: int
    interval: float
    rotation: float = math.nan
    translation: float = math.nan
    rotation_nees: float = math.nan
    translation_nees: float = math.nan

    @property
    def span(self) -> str:
        """Whether the pair is a short or a long one."""
        return 'short' if self.interval < SHORT else 'long'


def pair_consistency(
    source: str, bag: str, true: TruePair, pose: RelativePose | Pose | None
) -> PairConsistency:
    """Compare an estimate, if there is one, with the truth and its covariance."""
    found = PairConsistency(
        source,
        bag,
        true.stamp1_ns,
        true.stamp2_ns,
        seconds_between(true.stamp1_ns, true.stamp2_ns),
    )
    if not pose:
        return found
    error = pose_error(pose.R, pose.t, true.R, true.t)
    found = replace(found, rotation=error.rotation, translation=error.translation)
    if pose.covariance is None or true.covariance is None:
        return found
    nees = chi_squares(pose.R, pose.t, true.R, true.t, pose.covariance + true.covariance)
    return replace(
        found,
        rotation_nees=nees.rotation / R_FREEDOM,
        translation_nees=nees.translation / T_FREEDOM,
    )


def configurations(
    bags: int, first_seed: int, exposure_time: float = 0.0
) -> list[SimulationConfig]:
    """Walks of 6 s: scenes alternate, readouts from 12 to 35 ms and noises are drawn."""
    configs = []
    for seed in range(first_seed, first_seed + bags):
        rng = np.random.default_rng(seed)
        configs.append(
            SimulationConfig(
                seed=seed,
                scene=SCENES[seed % len(SCENES)],
                duration=6.0,
                plan='walk:6.0' if seed % 2 else '',
                readout_time=round(rng.uniform(0.012, 0.035), 4),
                exposure_time=exposure_time,
                pixel_noise=float(rng.choice([0.5, 1.0, 2.0, 4.0])),
                gyro_noise_density=float(rng.choice([1e-4, 1.7e-4, 3.4e-4])),
            )
        )
    return configs


def on_simulated_bag(config: SimulationConfig, folder: Path) -> Iterator[PairConsistency]:
    """Pairs of a bag, rendered into `folder` unless it exists; without those at rest."""
    path, parameter_file = render_once(config, folder)
    parameters = read_parameters(parameter_file)
    name = f'{config.scene} {config.seed}, {1e3 * config.readout_time:.0f} ms'
    for parallax in PARALLAXES:
        yield from replayed(
            path, parameters.updated({'min_keyframe_parallax': parallax}), SIMULATED, name
        )


def replayed(
    path: Path, parameters: Parameters, source: str, name: str
) -> Iterator[PairConsistency]:
    """Pairs of a simulated bag, without those at rest."""
    with open_bag(path) as bag:
        topics = bag.find_topics(needs_camera_info=not parameters.intrinsics.given)
        truth = truth_of_bag(bag, topics)
        assert truth is not None
        for result in Replay(bag, topics, parameters).pairs():
            known = truth.relative_pose(result.reference_ns1, result.reference_ns2)
            if known and np.linalg.norm(known[1]) > STILL:
                yield pair_consistency(
                    source,
                    name,
                    TruePair(result.reference_stamp_ns, result.stamp_ns, *known, _EXACT),
                    result.pose,
                )


def on_recording(
    path: Path, parameter_file: Path, truth: Path, *, compare: bool = False
) -> Iterator[PairConsistency]:
    """The true pairs of a recording, as a node publishes them that has run from its begin.

    `truth`: a table of pairs, a path of the camera, or a folder with one of them. With a path, the
    pairs are those of the keyframe policy. `compare`: also with a readout time of 0, and OpenCV's
    5-point on the same matches.
    """
    parameters = read_parameters(parameter_file)
    known = read_truth(truth)
    methods: dict[str, Method] = {RECORDED: lambda pair, _: pair.pose}
    runs = [(parameters, methods)]
    if compare:
        methods[MAGSAC] = lambda pair, lens: opencv_pose(pair, lens, THRESHOLD)
        runs.append((parameters.updated(IGNORE_READOUT), {NO_READOUT: methods[RECORDED]}))
    for configured, methods in runs:
        if isinstance(known, TruePath):
            pairs = policy_pairs(path, configured, known)
        else:
            pairs = _listed_pairs(path, configured, known)
        for true, given in pairs:
            for name, pose_of in methods.items():
                pose = pose_of(*given) if given else None
                yield pair_consistency(name, path.name, true, pose)


# A true pair, with the pair of frames and the lens of its image if there is one.
Given = tuple[TruePair, tuple[PairResult, Intrinsics] | None]


def _listed_pairs(
    path: Path, parameters: Parameters, known: Sequence[TruePair]
) -> Iterator[Given]:
    """Pairs of a table, in as many runs as they overlap."""
    for apart in _passes(known):
        found = {
            (pair.reference_stamp_ns, pair.stamp_ns): (pair, lens)
            for pair, lens in chosen_pairs(path, parameters, [true.ends for true in apart])
        }
        for true in apart:
            yield true, found.get(true.ends)


def policy_pairs(path: Path, parameters: Parameters, known: TruePath) -> Iterator[Given]:
    """Pairs of the keyframe policy whose frames are on a path, without those at rest."""
    for pair, lens in _policy_results(path, parameters):
        true = known.pair(pair.reference_stamp_ns, pair.stamp_ns)
        if true is not None and np.linalg.norm(true.t) > 0.0:
            yield true, (pair, lens)


def _policy_results(path: Path, parameters: Parameters) -> Iterator[tuple[PairResult, Intrinsics]]:
    """Pairs of the keyframe policy over a recording, each with its lens."""
    front_end = FrontEnd(parameters, offline=True)
    intake = incoming.Intake(front_end.sequencer, parameters)
    with open_bag(path) as bag:
        topics = bag.find_topics(needs_camera_info=not parameters.intrinsics.given)
        for outcome in outcomes(front_end, intake, incoming.sensor_messages(bag, topics)):
            if isinstance(outcome, MessageRefused):
                raise outcome.error
            if isinstance(outcome, Frame) and outcome.result is not None:
                yield outcome.result, outcome.intrinsics


def _passes(pairs: Sequence[TruePair]) -> list[list[TruePair]]:
    """Pairs in groups within which none overlaps another, each in the order of time."""
    groups: list[list[TruePair]] = []
    for pair in sorted(pairs, key=lambda pair: pair.stamp1_ns):
        group = next((g for g in groups if g[-1].stamp2_ns <= pair.stamp1_ns), None)
        if group is None:
            groups.append(group := [])
        group.append(pair)
    return groups


def chosen_pairs(
    path: Path, parameters: Parameters, ends: Sequence[tuple[int, int]]
) -> Iterator[tuple[PairResult, Intrinsics]]:
    """Pairs with given ends, amid those of the keyframe policy, of one run over a recording.

    `ends`: stamps of both images [ns], in the order of time and without overlap. A pair in which
    tracks or gyro are lost is left out.
    """
    following = dict(itertools.pairwise([0, *image_stamps(path)]))
    keyframes = frozenset(itertools.chain.from_iterable(ends))
    wanted = set(ends)
    within = {s for s in following if any(begin < s < end for begin, end in ends)}
    at_once, never = (
        parameters.updated(policy)
        for policy in (
            {'max_keyframe_frames': 1},
            {
                'min_keyframe_parallax': 1000.0,
                'max_keyframe_interval': 60.0,
                'min_tracked_fraction': 0.0,
                'max_keyframe_frames': 1000,
            },
        )
    )
    front_end = FrontEnd(parameters, offline=True)
    intake = incoming.Intake(front_end.sequencer, parameters)

    def prepare_for(stamp: int | None) -> None:
        front_end.parameters = (
            at_once if stamp in keyframes else never if stamp in within else parameters
        )

    done = 0  # stamp of the last image that was processed or refused
    prepare_for(following.get(done))
    with open_bag(path) as bag:
        topics = bag.find_topics(needs_camera_info=not parameters.intrinsics.given)
        for outcome in outcomes(front_end, intake, incoming.sensor_messages(bag, topics)):
            if isinstance(outcome, MessageRefused):
                raise outcome.error
            done = outcome.stamp_ns or done
            prepare_for(following.get(done))
            if (
                isinstance(outcome, Frame)
                and outcome.result is not None
                and (outcome.result.reference_stamp_ns, outcome.result.stamp_ns) in wanted
            ):
                yield outcome.result, outcome.intrinsics
            if done >= ends[-1][1]:
                return


def image_stamps(path: Path) -> list[int]:
    """Stamps of all images of a bag [ns]."""
    with open_bag(path) as bag:
        topics = bag.find_topics(needs_camera_info=False)
        return [
            incoming.image_from_message(message.message).stamp_ns
            for _, message in incoming.sensor_messages(bag, topics, (incoming.Role.IMAGE,))
        ]


def write_report(folder: Path, pairs: Sequence[PairConsistency]) -> str:
    """Write the pairs (CSV) and the report (Markdown), and return the latter."""
    keys: list[Callable[[PairConsistency], str]] = [
        lambda p: f'{p.bag}, {p.span}, {p.source}',
        lambda p: f'{p.source}, {p.span}',
        lambda p: p.source,
    ]
    return write_table(
        folder,
        'consistency',
        pairs,
        markdown_table(
            (
                'bag, span',
                'poses of pairs',
                'interval [s]',
                'R [deg]',
                't [deg]',
                'NEES of R: median',
                'mean',
                'beyond 99.7 %',
                'NEES of t: median',
                'mean',
                'beyond 99.7 %',
            ),
            [_line(*group) for key in keys for group in grouped(pairs, key).items()],
        ),
    )


def _line(name: str, pairs: Sequence[PairConsistency]) -> tuple[str, ...]:
    """Errors: median / 90 %; NEES by their expectation: its median by that of chi^2."""
    answered = [p for p in pairs if not math.isnan(p.rotation)]
    cells = [
        name,
        f'{len(answered)} of {len(pairs)}',
        f'{np.median([p.interval for p in pairs]):.2f}',
    ]
    if not answered:
        return (*cells, *8 * ('-',))
    for digits, errors in (
        (3, [p.rotation for p in answered]),
        (2, [p.translation for p in answered]),
    ):
        cells.append(' / '.join(f'{e:.{digits}f}' for e in np.percentile(errors, (50, 90))))
    for freedom, values in (
        (R_FREEDOM, [p.rotation_nees for p in answered]),
        (T_FREEDOM, [p.translation_nees for p in answered]),
    ):
        law = chi2(freedom)
        squares = freedom * np.array(values)
        if np.isnan(squares).all():  # a method without covariance
            cells += 3 * ['-']
            continue
        cells += [
            f'{np.median(squares) / law.median():.2f}',
            f'{squares.mean() / freedom:.2f}',
            f'{np.mean(squares > law.ppf(QUANTILE)):.1%}',
        ]
    return tuple(cells)
