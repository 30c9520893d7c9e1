"""The matrix of `rs_relpose benchmark trust`: what is told wrong, and what comes of it.

Each bag is simulated once, run told right, and then run through every row of `ROWS`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.tables import grouped, markdown_table, write_csv
from rs_relpose_lab.experiments.trust_recordings import recording_at
from rs_relpose_lab.experiments.trust_rows import RIGHT, ROWS
from rs_relpose_lab.experiments.trust_runs import (
    FLAGGED,
    IMAGES,
    judged,
    JudgedPair,
    RECORDING,
    Recording,
    run,
    simulated,
    Source,
    telling_motion,
    TRACKS,
)
from rs_relpose_lab.experiments.trust_tracks import TrackNoise
from rs_relpose_lab.simulation.config import SimulationConfig
from rs_relpose_lab.simulation.scene import make_scene, SCENES
from rs_relpose_lab.simulation.simulation import simulate, Simulation
from rs_relpose_lab.simulation.vehicle import vehicle
from rs_relpose_ros.config.estimator import EstimatorConfig
from rs_relpose_ros.config.imu import ImuConfig

Array = NDArray[np.float64]

# Of simulated bags.
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
    source = Source(f'{plan.seed}', IMAGES if plan.images else TRACKS, plan.motion, plan.scene,
                    plan.seed, plan.noise)
    return simulated(source, simulation_of(plan), noise,
                     np.random.default_rng([plan.seed, _TRACKS]))


@dataclass(frozen=True, slots=True)
class BagRow:
    """One bag told one thing.

    `telling`: seconds of motion that can tell, while the run took; `qualifies`: they are enough.
    `flagged`: within them; `flagged_after`: after so many of them, NaN where never.
    `named`: figures that were named at the end of that time; `named_right`: at most two, with a
        right one among them.
    `poses`: at level ok or unknown, after the first of these seconds; `direction_beyond`,
        `rotation_beyond`: those of them with errors beyond the limits; `all_`: from the start.
    `nees_`: mean of the chi squares by their degrees of freedom; errors and claimed sigma: medians
        [deg]; of `poses`, and of all where told right. `frame_ms`: median, frames with a pair.
    """

    bag: str
    kind: str
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
    direction_beyond: int
    rotation_beyond: int
    all_poses: int
    all_direction_beyond: int
    all_rotation_beyond: int
    nees_direction: float
    nees_rotation: float
    direction_error: float
    direction_sigma: float
    rotation_error: float
    frame_ms: float


class Task(NamedTuple):
    """A bag to simulate, or the place of a recording, and the rows that it goes through."""

    bag: BagPlan | Path
    rows: tuple[str, ...]


def tasks(rows: Sequence[str], bags: int, seconds: float, first_seed: int, *, right: int = 0,
          rendered: int = 0, recordings: Sequence[Path] = ()) -> list[Task]:
    """All that is to be measured; arguments as the options of the command."""
    wrong = tuple(rows)
    asked = [Task(plan, wrong) for plan in plans(bags, seconds, first_seed)]
    # The same read-outs, however many of them are rendered.
    with_images = plans(max(bags, rendered), seconds, first_seed, images=True)
    asked += [Task(plan, wrong) for plan in with_images[:rendered]]
    asked += [Task(path, wrong) for path in recordings]
    # Seeds of their own.
    asked += [Task(plan, (RIGHT,))
              for plan in plans(right, seconds, first_seed + 10_000, noises=(1.0, 0.5, 2.0))]
    return asked


def measure(task: Task) -> list[BagRow]:
    """A recording through its rows that apply to it.

    Told right first: that run says which seconds tell what.
    """
    recording = (recording_at(task.bag) if isinstance(task.bag, Path)
                 else recording_of(task.bag))
    right = list(run(recording, recording.told))
    motion = telling_motion(recording, [pair for pair, _ in right])
    found = []
    for name in task.rows:
        row = ROWS[name]
        # Twice the same stream: what is told and what the laboratory knows of it agree.
        drawn = [recording.source.seed, _WRONG]
        told = row.wrong(recording.told, np.random.default_rng(drawn))
        injected = row.injected(recording.told, np.random.default_rng(drawn))
        if injected is not None and not injected.error.any():
            continue   # e.g. no distortion to leave out
        tells = motion.seconds(injected)
        results = right if name == RIGHT else run(recording, told, _end(tells, row.within))
        found.append(bag_row(recording, name, tells,
                             [judged(recording, *result) for result in results]))
    return found


def _end(tells: NDArray[np.bool_], within: int) -> float:
    """When a run may end: all seconds that count have passed, and some more [s]."""
    passed = np.flatnonzero(np.cumsum(tells) >= within)
    return float(passed[0]) + 1.0 + _AFTERWARDS if len(passed) else math.inf


def bag_row(recording: Recording, name: str, tells: NDArray[np.bool_],
            pairs: Sequence[JudgedPair]) -> BagRow:
    """What came of a row; `tells`: which seconds of the recording can tell its error."""
    row, source = ROWS[name], recording.source
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
        bag=source.name, kind=source.kind, motion=source.motion, scene=source.scene,
        readout_ms=1e3 * recording.camera.readout_time, noise=source.noise, row=name,
        telling=telling,
        qualifies=telling >= row.within, flagged=bool(in_time),
        flagged_after=flags[0][0] if flags else math.nan, named=' '.join(named),
        named_right=len(named) <= 2 and bool(set(named) & set(row.named)), pairs=len(pairs),
        poses=len(later), direction_beyond=_directions_beyond(later),
        rotation_beyond=_rotations_beyond(later), all_poses=len(believed),
        all_direction_beyond=_directions_beyond(believed),
        all_rotation_beyond=_rotations_beyond(believed),
        nees_direction=_mean([p.chi_direction / 2 for p in counted]),
        nees_rotation=_mean([p.chi_rotation / 3 for p in counted]),
        direction_error=_median([p.direction_error for p in counted]),
        direction_sigma=_median([p.direction_sigma for p in counted]),
        rotation_error=_median([p.rotation_error for p in counted]),
        frame_ms=1e3 * _median([p.seconds for p in pairs]))


def _clock(tells: NDArray[np.bool_], at: float) -> float:
    """Seconds of motion that can tell up to an instant [s]."""
    full = min(int(at), len(tells))
    running = at - full if full < len(tells) and tells[full] else 0.0
    return float(np.count_nonzero(tells[:full])) + running


def _directions_beyond(pairs: Sequence[JudgedPair]) -> int:
    return sum(pair.chi_direction > LIMIT_T for pair in pairs)


def _rotations_beyond(pairs: Sequence[JudgedPair]) -> int:
    return sum(pair.chi_rotation > LIMIT_R for pair in pairs)


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else math.nan



# -- report -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class RowSummary:
    """A row over its bags; shares in per cent, NaN where there is nothing to share.

    `flagged`, `named`: of the bags that qualify; `after`: median of the seconds of motion that can
    tell before the flag. `direction_beyond`, `rotation_beyond`: of the poses after the first such
    second; `all_`: of all poses.
    """

    row: str
    within: int
    bags: int
    qualify: float
    flagged: float
    named: float
    after: float
    poses: int
    direction_beyond: float
    rotation_beyond: float
    all_poses: int
    all_direction_beyond: float
    all_rotation_beyond: float
    direction_error: float
    direction_sigma: float


def summary(name: str, bags: Sequence[BagRow]) -> RowSummary:
    """One row's bags, or several rows' as one."""
    fit = [bag for bag in bags if bag.qualifies]
    poses, all_poses = (sum(getattr(bag, of) for bag in bags) for of in ('poses', 'all_poses'))
    beyond = {of: _share(sum(getattr(bag, of) for bag in bags),
                         all_poses if of.startswith('all') else poses)
              for of in ('direction_beyond', 'rotation_beyond', 'all_direction_beyond',
                         'all_rotation_beyond')}
    return RowSummary(
        row=name, within=ROWS[bags[0].row].within, bags=len(bags),
        qualify=_share(len(fit), len(bags)),
        flagged=_share(sum(bag.flagged for bag in fit), len(fit)),
        named=_share(sum(bag.named_right for bag in fit), len(fit)),
        after=_finite_median([bag.flagged_after for bag in fit]), poses=poses,
        all_poses=all_poses, direction_error=_finite_median([bag.direction_error for bag in bags]),
        direction_sigma=_finite_median([bag.direction_sigma for bag in bags]), **beyond)


@dataclass(frozen=True, slots=True)
class RightSummary:
    """Bags of a kind, told right: false alarms, and errors squared in sigmas by their freedom.

    NEES over all poses, and the least and the largest mean of a bag; medians over the bags.
    """

    kind: str
    bags: int
    alarms: int
    pairs: int
    poses: int
    nees_direction: float
    nees_direction_least: float
    nees_direction_largest: float
    nees_rotation: float
    nees_rotation_least: float
    nees_rotation_largest: float
    direction_error: float
    rotation_error: float
    frame_ms: float


def right_summary(kind: str, bags: Sequence[BagRow]) -> RightSummary:
    """Bags that were told right."""
    nees = {}
    for name in ('nees_direction', 'nees_rotation'):
        known = [(getattr(bag, name), bag.all_poses) for bag in bags if bag.all_poses]
        means = [mean for mean, _ in known]
        poses = sum(count for _, count in known)
        nees[name] = sum(mean * count for mean, count in known) / poses if poses else math.nan
        nees[f'{name}_least'] = min(means, default=math.nan)
        nees[f'{name}_largest'] = max(means, default=math.nan)
    return RightSummary(
        kind=kind, bags=len(bags), alarms=sum(not math.isnan(bag.flagged_after) for bag in bags),
        pairs=sum(bag.pairs for bag in bags), poses=sum(bag.all_poses for bag in bags), **nees,
        direction_error=_finite_median([bag.direction_error for bag in bags]),
        rotation_error=_finite_median([bag.rotation_error for bag in bags]),
        frame_ms=_finite_median([bag.frame_ms for bag in bags]))


_TITLES = {TRACKS: 'Simulated, without images', IMAGES: 'Simulated, with images',
           RECORDING: 'Recordings with truth'}


def write_report(folder: Path, bags: Sequence[BagRow]) -> str:
    """Write every bag and row (CSV), the summaries (JSON) and the tables (Markdown)."""
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / 'trust_bags.csv', bags)
    parts, told = [], {}
    for kind, title in _TITLES.items():
        # A recording without truth has no poses that can be judged.
        judged_bags = {bag.bag for bag in bags if bag.kind != RECORDING or bag.all_poses}
        of_kind = [bag for bag in bags if bag.kind == kind and bag.bag in judged_bags
                   and not bag.noise]
        rows = [summary(name, of_row)
                for name, of_row in grouped(of_kind, lambda bag: bag.row).items()]
        if len(rows) > 1:
            rows.append(summary('all rows', of_kind))
        if rows:
            told[kind] = [_as_json(row) for row in rows]
            parts.append(f'{title} (shares in per cent):\n\n{_matrix_table(rows)}')
    recorded = [bag for bag in bags if bag.kind == RECORDING]
    if recorded:
        parts.append('Recordings (flagged after so many seconds that can tell, of how many; '
                     f'figures):\n\n{_recordings_table(recorded)}')
    right = [right_summary(kind, of_kind) for kind, of_kind in grouped(
        [bag for bag in bags if bag.row == RIGHT], _kind).items()]
    if right:
        parts.append(f'Told right:\n\n{_right_table(right)}')
    text = '\n'.join(parts)
    (folder / 'trust.json').write_text(json.dumps(
        {**told, 'right': [_as_json(row) for row in right]}, indent=1), encoding='utf-8')
    (folder / 'trust.md').write_text(text, encoding='utf-8')
    return text


def _as_json(row: RowSummary | RightSummary) -> dict[str, Any]:
    return {name: None if value != value else value for name, value in asdict(row).items()}


def _matrix_table(rows: Sequence[RowSummary]) -> str:
    return markdown_table(
        ['told', 'bags', 'qualify', 'within [s]', 'flagged', 'named right', 'after [s]', 'poses',
         't beyond', 'R beyond', 'all poses', 't beyond', 'R beyond', 't error [deg]',
         'claimed'],
        [[row.row, f'{row.bags}', _text(row.qualify, 0), f'{row.within}', _text(row.flagged, 0),
          _text(row.named, 0), _text(row.after, 1), f'{row.poses}',
          _text(row.direction_beyond, 1), _text(row.rotation_beyond, 1), f'{row.all_poses}',
          _text(row.all_direction_beyond, 1), _text(row.all_rotation_beyond, 1),
          _text(row.direction_error, 2), _text(row.direction_sigma, 2)]
         for row in rows])


def _recordings_table(bags: Sequence[BagRow]) -> str:
    names = tuple(grouped(bags, lambda bag: bag.bag))
    cells = {(bag.row, bag.bag): f'{_text(bag.flagged_after, 1) or "-"} / {bag.telling:.1f} '
                                 f'{bag.named}'.rstrip() for bag in bags}
    return markdown_table(
        ['told', *names],
        [[row, *(cells.get((row, name), '') for name in names)]
         for row in grouped(bags, lambda bag: bag.row)])


def _kind(bag: BagRow) -> str:
    noise = f', noise {bag.noise:g} of the told one' if bag.noise else ''
    return bag.bag if bag.kind == RECORDING else f'{bag.motion}, {bag.kind}{noise}'


def _right_table(rows: Sequence[RightSummary]) -> str:
    return markdown_table(
        ['recordings', 'bags', 'alarms', 'pairs', 'poses', 'NEES t', 'by bag', 'NEES R', 'by bag',
         't error [deg]', 'R error [deg]', 'frame with pair [ms]'],
        [[row.kind, f'{row.bags}', f'{row.alarms}', f'{row.pairs}', f'{row.poses}',
          _text(row.nees_direction, 2),
          _range(row.nees_direction_least, row.nees_direction_largest),
          _text(row.nees_rotation, 2),
          _range(row.nees_rotation_least, row.nees_rotation_largest),
          _text(row.direction_error, 2), _text(row.rotation_error, 3), _text(row.frame_ms, 1)]
         for row in rows])


def _range(least: float, largest: float) -> str:
    return '' if math.isnan(least) else f'{least:.2f} .. {largest:.2f}'


def _share(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else math.nan


def _finite_median(values: Sequence[float]) -> float:
    return _median([value for value in values if math.isfinite(value)])


def _text(value: float, digits: int) -> str:
    return '' if math.isnan(value) else f'{value:.{digits}f}'
