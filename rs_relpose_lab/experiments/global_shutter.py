"""`rs_relpose benchmark global-shutter`: images derotated to their middle row, measured.

Three measurements: the map against the truth, OpenCV's 5-point on raw and derotated images, time.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
import shutil
import statistics
import time

import cv2
import numpy as np

from rs_relpose_lab.experiments.comparison import best_opencv_score, Score
from rs_relpose_lab.experiments.consistency import STILL
from rs_relpose_lab.experiments.harness import markdown_table, write_csv
from rs_relpose_lab.experiments.methods import OPENCV_ESTIMATORS
from rs_relpose_lab.simulation import simulate, Simulation, SimulationConfig
from rs_relpose_lab.simulation.bag import intrinsics_of, render_once, right_parameters
from rs_relpose_lab.simulation.render import view_of
from rs_relpose_lab.simulation.rows import observe
from rs_relpose_lab.simulation.scene import SCENES
from rs_relpose_lab.simulation.trajectory import Trajectory
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import Intrinsics, RollingShutterCamera
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.offline.replay import read_truth, Replay
from rs_relpose_ros.offline.unroll import unroll
from rs_relpose_ros.pipeline.global_shutter import GlobalShutterFrame, unrolling_loop
from rs_relpose_ros.pipeline.pair import Frame
from rs_relpose_ros.pipeline.pipeline import FrameLoop
from rs_relpose_ros.tracking.images import RawImage

# -- the map against the truth of a simulation ------------------------------------------------
#
# The truth is that of the renderer, which shares no code with the map: pixels of scene points in
# a camera whose rows are all read at the middle time.

# Pixels from one compared point to the next.
_SPACING = 20.0
# IMU beyond the last row of a frame [s]: a tracked time offset may need it.
_AHEAD = 0.02


@dataclass(frozen=True, slots=True)
class MapErrors:
    """Distances [px] between sources of pixels by the map and by the truth, over a recording.

    Median and 90 %. The map models rotation alone.
    """

    name: str
    readout_ms: float
    rate: float  # [rad/s] largest
    left: float  # from the map to the true sources
    left_p90: float
    predicted: float  # from the true sources to those of rotation alone
    predicted_p90: float
    map: float  # from the latter to the map
    map_p90: float


def swinging(rate: float, seconds: float) -> Trajectory:
    """A camera that swings about a point, mostly about the vertical; largest rate [rad/s]."""
    # Of the rate, about the other axes.
    spacing = 0.02
    frequency = 1.1
    tilt = 0.3
    times = np.arange(-1.0, seconds + 1.0, spacing)
    phase = 2.0 * np.pi * frequency * times
    swing = rate / (2.0 * np.pi * frequency) / np.hypot(1.0, tilt) * np.sin(phase)
    angles = np.stack([swing, tilt * swing * np.cos(0.4 * phase), tilt * swing], axis=1)
    return Trajectory(np.tile([0.0, 0.0, 1.6], (len(times), 1)), angles, times[0], spacing)


def configured(simulation: Simulation) -> Parameters:
    """Parameters of a calibrated node."""
    return Parameters.from_mapping(right_parameters(simulation))


def derotated_frames(
    simulation: Simulation, parameters: Parameters, *, images: bool = False
) -> Iterator[tuple[int, GlobalShutterFrame]]:
    """Number and derotated frame of each image; black images where none are rendered."""
    config = simulation.config
    camera = simulation.camera
    loop = unrolling_loop(parameters, offline=True)
    samples = simulation.imu.samples()
    fed = 0
    black = np.zeros((config.height, config.width), dtype=np.uint8)
    for index in range(config.frame_count):
        until = int(
            np.searchsorted(
                simulation.imu.stamps_ns,
                simulation.reference_ns(index) + to_nanoseconds(camera.row_time_span[1] + _AHEAD),
            )
        )
        for sample in samples[fed:until]:
            loop.sequencer.add_imu(sample)
        fed = until
        pixels = simulation.image(index) if images else black
        yield (
            index,
            _derotated(
                loop, RawImage.of_gray(pixels, simulation.stamp_ns(index)), intrinsics_of(camera)
            ),
        )


def _derotated(
    loop: FrameLoop[GlobalShutterFrame], image: RawImage, intrinsics: Intrinsics
) -> GlobalShutterFrame:
    """The next frame through the loop; the IMU already covers its rows."""
    loop.sequencer.add_frame(image, intrinsics)
    outcome = loop.step()
    assert isinstance(outcome, Frame), outcome
    assert outcome.result is not None
    return outcome.result


def map_errors(
    name: str, config: SimulationConfig, trajectory: Trajectory | None = None
) -> MapErrors:
    """Compare the maps of all frames of a recording with the truth."""
    simulation = simulate(config, trajectory=trajectory)
    camera = simulation.camera
    # The same camera with all rows read at the time of the middle one.
    still = replace(simulation.renderer, camera=replace(camera, readout_time=0.0))
    middle_row = float(camera.row_times(0.5 * (camera.height - 1)))
    across = np.arange(0.0, config.width, _SPACING)
    down = np.arange(0.0, config.height, _SPACING)
    points = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    columns, rows = points.astype(int).T
    distances = []
    rate = 0.0
    for index, derotated in derotated_frames(simulation, configured(simulation)):
        reference = simulation.seconds(simulation.reference_ns(index))
        middle = reference + middle_row
        world, _ = still.locate(middle, points)
        observed = simulation.renderer.project(reference, world)
        by_rotation = _observed_by_rotation(simulation, reference, world, middle)
        sources = np.concatenate([band for _, band in derotated.map.bands()])
        by_map = sources[rows, columns]
        begin_and_end = reference + np.asarray(camera.row_time_span)
        rates = simulation.trajectory.states(begin_and_end).angular_velocity
        rate = max(rate, float(np.linalg.norm(rates, axis=1).max()))
        differences = [observed - by_map, observed - by_rotation, by_rotation - by_map]
        distances.append(np.linalg.norm(differences, axis=2).T)
    all_distances = np.concatenate(distances)
    known = all_distances[np.isfinite(all_distances).all(axis=1)]
    # Median and 90th percentile of each of the three, in the order of the fields.
    errors = np.percentile(known, (50, 90), axis=0).T.ravel()
    return MapErrors(name, 1e3 * config.readout_time, rate, *errors)


def _observed_by_rotation(
    simulation: Simulation, reference: float, world: Array, middle: float
) -> Array:
    """Pixels of world points for a camera that rotates only, at its position of `middle`."""
    centre, _ = simulation.trajectory.poses([middle])

    def motion(directions: Array, times: Array) -> Array:
        _, rotations = simulation.trajectory.poses(reference + times)
        return np.asarray(np.einsum('nji,nj->ni', rotations, directions))

    return observe(world - centre, motion, view_of(simulation.camera), margin=0.5)


# Name, recording, and the motion where it is not that of the recording's seed.
Case = tuple[str, SimulationConfig, Trajectory | None]


def map_cases(walks: int, first_seed: int) -> list[Case]:
    """Swings of 1 and 3 rad/s, read down and up, then walks."""
    cases: list[Case] = []
    for rate, direction in ((1.0, 'down'), (3.0, 'down'), (3.0, 'up')):
        config = SimulationConfig(seed=first_seed, duration=2.0, readout_direction=direction)
        cases.append((f'swing {rate:g} rad/s, read {direction}', config, swinging(rate, 2.0)))
    for seed in range(first_seed, first_seed + walks):
        config = SimulationConfig(
            seed=seed, scene=SCENES[seed % len(SCENES)], duration=2.0, plan='walk:2.0'
        )
        cases.append((f'walk {config.scene} {seed}', config, None))
    return cases


# -- OpenCV's 5-point on raw and derotated images ---------------------------------------------


@dataclass(frozen=True, slots=True)
class FivePoint:
    """Median errors [deg] of OpenCV's 5-point, at its best threshold and estimator.

    Best in the median rotation error against the truth, for raw and derotated images alike.
    """

    name: str
    readout_ms: float
    pairs: int
    raw_rotation: float
    raw_translation: float
    derotated_pairs: int
    derotated_rotation: float
    derotated_translation: float

    @property
    def rotation_ratio(self) -> float:
        """Raw by derotated images."""
        return self.raw_rotation / self.derotated_rotation

    @property
    def translation_ratio(self) -> float:
        """Raw by derotated images."""
        return self.raw_translation / self.derotated_translation


def five_point_on_bag(config: SimulationConfig, folder: Path) -> FivePoint:
    """A walk, rendered and derotated into `folder` unless it exists."""
    path, parameter_file = render_once(config, folder)
    parameters = read_parameters(parameter_file)
    raw = five_point(path, parameters)
    corrected = five_point(_unrolled(path, parameters, folder), as_global_shutter(parameters))
    return FivePoint(
        f'{config.scene} {config.seed}',
        1e3 * config.readout_time,
        raw.answered,
        raw.rotation[0],
        raw.translation[0],
        corrected.answered,
        corrected.rotation[0],
        corrected.translation[0],
    )


def _unrolled(path: Path, parameters: Parameters, folder: Path) -> Path:
    """The derotated bag, written into `folder` unless it exists."""
    derotated = folder / f'{path.name}_derotated'
    if not derotated.exists():
        with open_bag(path) as bag:
            unroll(bag, bag.find_topics(), parameters, derotated)
    return derotated


def as_global_shutter(parameters: Parameters) -> Parameters:
    """Parameters for the derotated images of a camera, stamped on the IMU's clock."""
    return parameters.updated(
        {
            'readout_time': 0.0,
            'time_offset': 0.0,
            'stamp_row': 'first',
            'time_offset_per_interval': 0.0,
            'stamp_exposure': 'middle',
        }
    )


def five_point(path: Path, parameters: Parameters) -> Score:
    """The better of OpenCV's estimators over the pairs of a bag that the pipeline answers."""
    with open_bag(path) as bag:
        topics = bag.find_topics()
        truth = read_truth(bag, topics)
        assert truth is not None
        replay = Replay(bag, topics, parameters)
        pairs = []
        for pair in replay.pairs():
            known = truth.relative_pose(pair.reference_ns1, pair.reference_ns2)
            if pair.pose and known and np.linalg.norm(known[1]) > STILL:
                pairs.append(pair)
        assert replay.intake.intrinsics is not None
    return min(
        (
            best_opencv_score(estimator, pairs, replay.intake.intrinsics, truth)
            for estimator in OPENCV_ESTIMATORS
        ),
        key=lambda found: found.rotation[0],
    )


def five_point_when_derotated(path: Path, parameters: Parameters, folder: Path) -> Score:
    """Score of OpenCV on the derotated images of a bag, which are written into `folder`."""
    shutil.rmtree(folder / f'{path.name}_derotated', ignore_errors=True)
    return replace(
        five_point(_unrolled(path, parameters, folder), as_global_shutter(parameters)),
        name='OpenCV 5-point, derotated',
    )


def bag_configurations(bags: int, first_seed: int) -> list[SimulationConfig]:
    """Walks of 6 s; scenes in rotation, readouts are spread from 15 to 35 ms."""
    return [
        SimulationConfig(
            seed=seed,
            scene=SCENES[seed % len(SCENES)],
            duration=6.0,
            plan='walk:6.0',
            readout_time=round(0.015 + 0.02 * k / max(bags - 1, 1), 4),
        )
        for k, seed in enumerate(range(first_seed, first_seed + bags))
    ]


# -- time and report --------------------------------------------------------------------------

# Sizes of the images whose derotation is timed [px]. [chosen: VGA and HD]
SIZES = ((640, 480), (1280, 720))

# Number of these images. [chosen: 5 s at 30 Hz; the median needs some tens]
_FRAMES = 150
# Interval of these images [ns]. [chosen: 30 Hz]
_FRAME_NS = NANOSECONDS // 30
# Interval of the samples of the IMU [ns]. [chosen: 200 Hz]
_IMU_NS = NANOSECONDS // 200


@dataclass(frozen=True, slots=True)
class Speed:
    """Processor time of a frame of gray pixels [ms]: median and 90 %, of one thread."""

    width: int
    height: int
    median: float
    p90: float


def frame_times(width: int, height: int) -> Speed:
    """Derotate frames of noise, from the mailbox to the pixels, on one core."""
    cv2.setNumThreads(1)
    intrinsics = intrinsics_of(
        RollingShutterCamera(
            width=width,
            height=height,
            fx=0.7 * width,
            fy=0.7 * width,
            cx=0.5 * width,
            cy=0.5 * height,
            distortion=(-0.12, 0.05, 8e-4, -5e-4, 0.0),
            readout_time=0.03,
        )
    )
    loop = unrolling_loop(
        Parameters.from_mapping({'readout_time': 0.03, 'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0]}),
        offline=True,
    )
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, width * height, dtype=np.uint8).reshape(height, width)
    times = []
    stamp_ns = 0
    for frame in range(1, _FRAMES + 1):
        while stamp_ns < frame * _FRAME_NS + NANOSECONDS // 25:
            rate = 2.0 * np.sin(1e-9 * stamp_ns * np.array([7.0, 5.0, 3.0]))
            loop.sequencer.add_imu(
                ImuSample(
                    stamp_ns,
                    tuple((rate + 1e-3 * rng.standard_normal(3)).tolist()),
                    (0.0, -9.81, 0.0),
                )
            )
            stamp_ns += _IMU_NS
        started = time.thread_time()
        _derotated(loop, RawImage.of_gray(image, frame * _FRAME_NS), intrinsics).image()
        times.append(1e3 * (time.thread_time() - started))
    # The first frame loads or compiles the kernels.
    return Speed(width, height, *map(float, np.percentile(times[1:], (50, 90))))


def _table_of_maps(maps: Sequence[MapErrors]) -> str:
    headings = (
        'recording',
        'readout [ms]',
        'largest rate [rad/s]',
        'map to truth',
        'shift by translation',
        'map to rotation alone',
    )
    rows = [
        (
            one.name,
            f'{one.readout_ms:.0f}',
            f'{one.rate:.1f}',
            f'{one.left:.3f} / {one.left_p90:.3f}',
            f'{one.predicted:.3f} / {one.predicted_p90:.3f}',
            f'{one.map:.3f} / {one.map_p90:.3f}',
        )
        for one in maps
    ]
    return markdown_table(headings, rows)


def _table_of_bags(bags: Sequence[FivePoint]) -> str:
    headings = (
        'recording',
        'readout [ms]',
        'raw: R',
        't',
        'derotated: R',
        't',
        'ratio of R',
        'of t',
    )
    rows = [
        (
            one.name,
            f'{one.readout_ms:.0f}',
            f'{one.raw_rotation:.3f}',
            f'{one.raw_translation:.2f}',
            f'{one.derotated_rotation:.3f}',
            f'{one.derotated_translation:.2f}',
            f'{one.rotation_ratio:.1f}',
            f'{one.translation_ratio:.1f}',
        )
        for one in bags
    ]
    return markdown_table(headings, rows)


def write_report(
    folder: Path, maps: Sequence[MapErrors], bags: Sequence[FivePoint], speeds: Sequence[Speed]
) -> str:
    """Write the data (CSV) and the report (Markdown), and return the latter."""
    parts = []
    if maps:
        write_csv(folder / 'map.csv', maps)
        parts.append(f'Sources of pixels [px], median / 90 %\n\n{_table_of_maps(maps)}')
    if bags:
        write_csv(folder / 'five_point.csv', bags)
        parts.append(f"OpenCV's 5-point, median errors [deg]\n\n{_table_of_bags(bags)}")
        rotation = statistics.median(bag.rotation_ratio for bag in bags)
        translation = statistics.median(bag.translation_ratio for bag in bags)
        parts.append(
            f'Median of the ratios: rotation {rotation:.1f}, translation {translation:.1f}\n'
        )
    write_csv(folder / 'speed.csv', speeds)
    rows = [(f'{s.width}x{s.height} mono8', f'{s.median:.1f}', f'{s.p90:.1f}') for s in speeds]
    table = markdown_table(('size', 'median', '90 %'), rows)
    parts.append(f'Processor time of a frame [ms]\n\n{table}')
    text = '\n'.join(parts)
    (folder / 'global_shutter.md').write_text(text, encoding='utf-8')
    return text
