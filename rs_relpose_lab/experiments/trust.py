"""The matrix of `rs_relpose benchmark trust`: wrong configurations, and their effect.

Each bag is simulated once, run with the right configuration, and then with every row of `ROWS`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments import trust_runs
from rs_relpose_lab.experiments.harness import grouped, markdown_table, write_csv
from rs_relpose_lab.experiments.trust_rows import RIGHT, ROWS
from rs_relpose_lab.simulation.config import SimulationConfig
from rs_relpose_lab.simulation.motions import vehicle
from rs_relpose_lab.simulation.scene import make_scene, SCENES
from rs_relpose_lab.simulation.simulation import simulate, Simulation
from rs_relpose_ros.config.settings import EstimatorConfig, ImuConfig

# Of simulated bags.
MOTIONS = ('hand-held', 'vehicle')
# Squared error of a direction in sigmas that 0.27 % of right poses exceed, as three sigmas of one
# dimension. [derived: chi squared of 2 degrees of freedom]
LIMIT_T = 11.8
# The same of a rotation. [derived: chi squared of 3 degrees of freedom]
LIMIT_R = 14.2
# Seconds that a run continues after its error should have been flagged.
_AFTERWARDS = 3.0
# Focal length for which the scene's textures are made where tracks need none [px].
_NO_TEXTURE = 20.0

# Independent random streams of a bag's seed.
# [chosen: none is a stream of a simulation]
_DRAW = 10  # of the configuration
_SCENE = 11  # of places and textures
_MOTION = 12  # of the trajectory
_TRACKS = 13  # of the corners and their errors
_WRONG = 14  # of the error of the configuration


class BagPlan(NamedTuple):
    """A bag of the matrix."""

    number: int
    seed: int
    seconds: float
    readout_time: float
    noise: float = 0.0  # by the configured one; 0 for a usual camera and IMU
    images: bool = False  # rendered, rather than tracks alone

    @property
    def motion(self) -> str:
        """Hand-held and vehicle alternate."""
        return MOTIONS[self.number % len(MOTIONS)]

    @property
    def scene(self) -> str:
        """Scenes alternate, each with both motions."""
        return SCENES[self.number // len(MOTIONS) % len(SCENES)]


def plans(
    bags: int,
    seconds: float,
    first_seed: int,
    *,
    noises: Sequence[float] = (0.0,),
    images: bool = False,
) -> list[BagPlan]:
    """Bags whose readouts are spread from 12 to 35 ms; noises alternate."""
    readouts = np.linspace(0.012, 0.035, max(bags, 2))[:bags]
    # Neighbours in motion and scene get readouts from all over.
    order = np.random.default_rng(first_seed).permutation(bags)
    return [
        BagPlan(
            k,
            first_seed + k,
            seconds,
            round(float(readouts[order[k]]), 4),
            noises[k // len(MOTIONS) % len(noises)],
            images,
        )
        for k in range(bags)
    ]


def simulation_of(plan: BagPlan) -> Simulation:
    """Camera, lens, mounting and offset are drawn; configured noises are the defaults."""
    rng = np.random.default_rng([plan.seed, _DRAW])
    default = SimulationConfig()
    tilt = Rotation.from_rotvec(np.radians(rng.uniform(-4.0, 4.0, 3)))
    mounting = tilt * Rotation.from_quat(default.quat_cam_imu_xyzw)
    imu = ImuConfig()
    config = SimulationConfig(
        duration=plan.seconds,
        seed=plan.seed,
        scene=plan.scene,
        # A sensor cannot be read for longer than a frame takes.
        fps=min(30.0, 0.98 / plan.readout_time),
        readout_time=plan.readout_time,
        fx=float(rng.uniform(380.0, 540.0)),
        distortion=tuple(float(rng.uniform(0.6, 1.3)) * k for k in default.distortion),
        time_offset=float(rng.uniform(-0.04, 0.04)),
        quat_cam_imu_xyzw=tuple(float(v) for v in mounting.as_quat()),
        gyro_bias=tuple(float(v) for v in rng.uniform(-0.02, 0.02, 3)),
        gyro_noise_density=(
            plan.noise * imu.gyro_noise_density if plan.noise else default.gyro_noise_density
        ),
    )
    trajectory = None
    if plan.motion == 'vehicle':
        trajectory = vehicle(
            np.random.default_rng([plan.seed, _MOTION]),
            -0.5,
            plan.seconds + 0.5,
            speed=float(rng.uniform(0.8, 1.6)),
        )
    scene = (
        None
        if plan.images
        else make_scene(plan.scene, np.random.default_rng([plan.seed, _SCENE]), _NO_TEXTURE)
    )
    return simulate(config, scene=scene, trajectory=trajectory)


def recording_of(plan: BagPlan) -> trust_runs.Recording:
    """The bag, as tracks or as images."""
    noise = None if plan.images else trust_runs.TrackNoise()
    if noise is not None and plan.noise:
        # Configured is the noise of either image's points; here only the second ones have any.
        noise = trust_runs.TrackNoise(
            white=plan.noise * math.sqrt(2.0) * EstimatorConfig().pixel_sigma
        )
    kind = trust_runs.IMAGES if plan.images else trust_runs.TRACKS
    source = trust_runs.Source(
        f'{plan.seed}', kind, plan.motion, plan.scene, plan.seed, plan.noise
    )
    return trust_runs.simulated(
        source, simulation_of(plan), noise, np.random.default_rng([plan.seed, _TRACKS])
    )


@dataclass(frozen=True, slots=True)
class BagRow:
    """One bag with one row.

    Errors, claimed sigma and chi squares are of `poses`; with the right configuration, of all.
    """

    bag: str
    kind: str
    motion: str
    scene: str
    readout_ms: float
    noise: float
    row: str
    informative: float  # informative seconds of motion
    qualifies: bool  # whether they are enough
    flagged: bool  # within them
    flagged_after: float  # after so many of them; NaN where never
    named: str  # parameters named at the end of that time
    named_right: bool  # at most two, with a right one among them
    pairs: int
    poses: int  # published, at level ok or unknown, after the first of these seconds
    direction_beyond: int  # those of them with an error beyond the limit
    rotation_beyond: int
    all_poses: int  # from the start, as the next two
    all_direction_beyond: int
    all_rotation_beyond: int
    nees_direction: float  # mean of the chi squares by their degrees of freedom
    nees_rotation: float
    direction_error: float  # median [deg], as the next two
    direction_sigma: float
    rotation_error: float
    frame_ms: float  # median, frames with a pair


# A bag to simulate, or the path of a recording, and its rows.
Task = tuple[BagPlan | Path, Sequence[str]]


def tasks(
    rows: Sequence[str],
    bags: int,
    seconds: float,
    first_seed: int,
    *,
    right: int = 0,
    rendered: int = 0,
    recordings: Sequence[Path] = (),
) -> list[Task]:
    """Bags and recordings to measure; arguments as the options of the command."""
    # The same readouts, however many of them are rendered.
    with_images = plans(max(bags, rendered), seconds, first_seed, images=True)[:rendered]
    # Seeds of their own.
    for_alarms = plans(right, seconds, first_seed + 10_000, noises=(1.0, 0.5, 2.0))
    with_rows: list[BagPlan | Path] = [
        *plans(bags, seconds, first_seed),
        *with_images,
        *recordings,
    ]
    return [*((bag, rows) for bag in with_rows), *((plan, (RIGHT,)) for plan in for_alarms)]


def measure(task: Task) -> list[BagRow]:
    """A recording with all rows that apply to it.

    The run with the right configuration comes first: it determines the informative seconds.
    """
    bag, rows = task
    recording = trust_runs.recording_at(bag) if isinstance(bag, Path) else recording_of(bag)
    right = list(trust_runs.run(recording, recording.configured))
    motion = trust_runs.informative_motion(recording, [pair for pair, _ in right])
    found = []
    for name in rows:
        row = ROWS[name]
        # Twice the same stream: the configuration and its error agree.
        drawn = [recording.source.seed, _WRONG]
        configured = row.wrong(recording.configured, np.random.default_rng(drawn))
        injected = row.injected(recording.configured, np.random.default_rng(drawn))
        if injected is not None and not injected.error.any():
            continue  # e.g. no distortion to leave out
        informative = motion.seconds(injected)
        # A run may end some seconds after all those that count.
        passed = np.flatnonzero(np.cumsum(informative) >= row.within)
        end = float(passed[0]) + 1.0 + _AFTERWARDS if len(passed) else math.inf
        results = right if name == RIGHT else trust_runs.run(recording, configured, end)
        found.append(
            bag_row(
                recording,
                name,
                informative,
                [trust_runs.evaluated(recording, *result) for result in results],
            )
        )
    return found


def bag_row(
    recording: trust_runs.Recording,
    name: str,
    informative: NDArray[np.bool_],
    pairs: Sequence[trust_runs.EvaluatedPair],
) -> BagRow:
    """Result of a row; `informative`: which seconds of the recording are, for its error."""
    row = ROWS[name]
    source = recording.source
    clocks = [_clock(informative, pair.at) for pair in pairs]
    flags = [
        (clock, pair)
        for clock, pair in zip(clocks, pairs, strict=True)
        if pair.state in trust_runs.FLAGGED
    ]
    in_time = [pair for clock, pair in flags if clock <= row.within]
    # Its last report within the time.
    named = in_time[-1].named if in_time else ()
    published = [
        (clock, pair)
        for clock, pair in zip(clocks, pairs, strict=True)
        if pair.has_pose and pair.state not in trust_runs.FLAGGED
    ]
    every = [p for _, p in published]
    later = [p for clock, p in published if clock > 1.0]
    counted = later if name != RIGHT else every
    seconds = _clock(informative, recording.seconds)
    return BagRow(
        bag=source.name,
        kind=source.kind,
        motion=source.motion,
        scene=source.scene,
        readout_ms=1e3 * recording.camera.readout_time,
        noise=source.noise,
        row=name,
        informative=seconds,
        qualifies=seconds >= row.within,
        flagged=bool(in_time),
        flagged_after=flags[0][0] if flags else math.nan,
        named=' '.join(named),
        named_right=len(named) <= 2 and bool(set(named) & set(row.named)),
        pairs=len(pairs),
        poses=len(later),
        all_poses=len(every),
        **_beyond(later),
        **_beyond(every, 'all_'),
        nees_direction=_mean([p.chi_direction / 2 for p in counted]),
        nees_rotation=_mean([p.chi_rotation / 3 for p in counted]),
        direction_error=_median([p.direction_error for p in counted]),
        direction_sigma=_median([p.direction_sigma for p in counted]),
        rotation_error=_median([p.rotation_error for p in counted]),
        frame_ms=1e3 * _median([p.seconds for p in pairs]),
    )


def _clock(informative: NDArray[np.bool_], at: float) -> float:
    """Informative seconds up to a time [s]."""
    full = min(int(at), len(informative))
    running = at - full if full < len(informative) and informative[full] else 0.0
    return float(np.count_nonzero(informative[:full])) + running


def _beyond(pairs: Sequence[trust_runs.EvaluatedPair], prefix: str = '') -> dict[str, int]:
    return {
        f'{prefix}direction_beyond': sum(p.chi_direction > LIMIT_T for p in pairs),
        f'{prefix}rotation_beyond': sum(p.chi_rotation > LIMIT_R for p in pairs),
    }


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else math.nan


# -- report -----------------------------------------------------------------------------------

# Columns of the tables: title, name of the value, digits.
_ROW_COLUMNS = (
    ('bags', 'bags', 0),
    ('qualify', 'qualify', 0),
    ('within [s]', 'within', 0),
    ('flagged', 'flagged', 0),
    ('named right', 'named', 0),
    ('after [s]', 'after', 1),
    ('poses', 'poses', 0),
    ('t beyond', 'direction_beyond', 1),
    ('R beyond', 'rotation_beyond', 1),
    ('all poses', 'all_poses', 0),
    ('t beyond', 'all_direction_beyond', 1),
    ('R beyond', 'all_rotation_beyond', 1),
    ('t error [deg]', 'direction_error', 2),
    ('claimed', 'direction_sigma', 2),
)
# Title, value and digits of the columns on right configurations. [derived: the report]
_RIGHT_COLUMNS = (
    ('bags', 'bags', 0),
    ('alarms', 'alarms', 0),
    ('pairs', 'pairs', 0),
    ('poses', 'poses', 0),
    ('NEES t', 'nees_direction', 2),
    ('least', 'nees_direction_least', 2),
    ('largest', 'nees_direction_largest', 2),
    ('NEES R', 'nees_rotation', 2),
    ('least', 'nees_rotation_least', 2),
    ('largest', 'nees_rotation_largest', 2),
    ('t error [deg]', 'direction_error', 2),
    ('R error [deg]', 'rotation_error', 3),
    ('frame with pair [ms]', 'frame_ms', 1),
)
# Titles of the tables by kind of recording. [derived: the report]
_TITLES = {
    trust_runs.TRACKS: 'Simulated, without images',
    trust_runs.IMAGES: 'Simulated, with images',
    trust_runs.RECORDING: 'Recordings with truth',
}


def summary(name: str, bags: Sequence[BagRow]) -> dict[str, Any]:
    """One row's bags, or several rows' as one; shares in per cent, NaN without bags or poses.

    `flagged`, `named`: of the bags that qualify; `after`: median of the informative seconds before
    the flag. `direction_beyond`, `rotation_beyond`: of the poses after the first such second;
    `all_`: of all poses.
    """
    fit = [bag for bag in bags if bag.qualifies]
    poses, all_poses = (sum(getattr(bag, of) for bag in bags) for of in ('poses', 'all_poses'))
    beyond = {
        of: _share(
            sum(getattr(bag, of) for bag in bags), all_poses if of.startswith('all') else poses
        )
        for of in (
            'direction_beyond',
            'rotation_beyond',
            'all_direction_beyond',
            'all_rotation_beyond',
        )
    }
    return {
        'row': name,
        'within': ROWS[bags[0].row].within,
        'bags': len(bags),
        'qualify': _share(len(fit), len(bags)),
        'flagged': _share(sum(bag.flagged for bag in fit), len(fit)),
        'named': _share(sum(bag.named_right for bag in fit), len(fit)),
        'after': _finite_median(fit, 'flagged_after'),
        'poses': poses,
        'all_poses': all_poses,
        'direction_error': _finite_median(bags, 'direction_error'),
        'direction_sigma': _finite_median(bags, 'direction_sigma'),
        **beyond,
    }


def right_summary(kind: str, bags: Sequence[BagRow]) -> dict[str, Any]:
    """Bags of a kind with the right configuration: false alarms, and NEES by freedom.

    NEES over all poses, and the least and the largest mean of a bag; medians over the bags.
    """
    nees: dict[str, float] = {}
    for name in ('nees_direction', 'nees_rotation'):
        known = [(getattr(bag, name), bag.all_poses) for bag in bags if bag.all_poses]
        means, counts = zip(*known, strict=True) if known else ((math.nan,), (1,))
        nees |= {
            name: float(np.average(means, weights=counts)),
            f'{name}_least': min(means),
            f'{name}_largest': max(means),
        }
    return {
        'kind': kind,
        'bags': len(bags),
        **nees,
        'alarms': sum(not math.isnan(bag.flagged_after) for bag in bags),
        'pairs': sum(bag.pairs for bag in bags),
        'poses': sum(bag.all_poses for bag in bags),
        **{
            name: _finite_median(bags, name)
            for name in ('direction_error', 'rotation_error', 'frame_ms')
        },
    }


def write_report(folder: Path, bags: Sequence[BagRow]) -> str:
    """Write every bag and row (CSV) and the tables (Markdown)."""
    write_csv(folder / 'trust_bags.csv', bags)
    parts = []
    # A recording without truth has no poses that can be evaluated.
    with_truth = {bag.bag for bag in bags if bag.kind != trust_runs.RECORDING or bag.all_poses}
    for kind, title in _TITLES.items():
        of_kind = [
            bag for bag in bags if bag.kind == kind and bag.bag in with_truth and not bag.noise
        ]
        rows = [
            summary(name, of_row) for name, of_row in grouped(of_kind, lambda bag: bag.row).items()
        ]
        if len(rows) > 1:
            rows.append(summary('all rows', of_kind))
        if rows:
            parts.append(f'{title} (shares in per cent):\n\n{_table("row", rows, _ROW_COLUMNS)}')
    recorded = [bag for bag in bags if bag.kind == trust_runs.RECORDING]
    if recorded:
        parts.append(
            'Recordings (informative seconds until flagged, of how many; named '
            f'parameters):\n\n{_recordings_table(recorded)}'
        )
    right = [
        right_summary(kind, of_kind)
        for kind, of_kind in grouped([bag for bag in bags if bag.row == RIGHT], _kind).items()
    ]
    if right:
        parts.append(f'Right configuration:\n\n{_table("kind", right, _RIGHT_COLUMNS)}')
    text = '\n'.join(parts)
    (folder / 'trust.md').write_text(text, encoding='utf-8')
    return text


def _table(
    key: str, rows: Sequence[dict[str, Any]], columns: Sequence[tuple[str, str, int]]
) -> str:
    return markdown_table(
        [key, *(title for title, _, _ in columns)],
        [[row[key], *(_text(row[name], digits) for _, name, digits in columns)] for row in rows],
    )


def _recordings_table(bags: Sequence[BagRow]) -> str:
    names = tuple(grouped(bags, lambda bag: bag.bag))
    cells = {
        (bag.row, bag.bag): f'{_text(bag.flagged_after, 1) or "-"} / {bag.informative:.1f} '
        f'{bag.named}'.rstrip()
        for bag in bags
    }
    return markdown_table(
        ['row', *names],
        [
            [row, *(cells.get((row, name), '') for name in names)]
            for row in grouped(bags, lambda bag: bag.row)
        ],
    )


def _kind(bag: BagRow) -> str:
    noise = f', noise {bag.noise:g} of the configured one' if bag.noise else ''
    return bag.bag if bag.kind == trust_runs.RECORDING else f'{bag.motion}, {bag.kind}{noise}'


def _share(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else math.nan


def _finite_median(bags: Sequence[BagRow], name: str) -> float:
    return _median([value for bag in bags if math.isfinite(value := getattr(bag, name))])


def _text(value: float, digits: int) -> str:
    return '' if math.isnan(value) else f'{value:.{digits}f}'
