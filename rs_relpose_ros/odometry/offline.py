"""Metric odometry of a bag: replay's pairs and the bag's IMU, as a live node would get them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
import math
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.bags.reader import Bag
from rs_relpose_ros.bags.topics import SensorTopics
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.timing import seconds_between
from rs_relpose_ros.health.findings import HealthState
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.messages.sensor_feed import Role, SensorFeed
from rs_relpose_ros.odometry.measurement import PairMeasurement
from rs_relpose_ros.odometry.odometry import Odometry, OdometryEstimator
from rs_relpose_ros.odometry.trajectory import against_truth, write_tum
from rs_relpose_ros.picture_files import save_picture
from rs_relpose_ros.replay.run import read_truth, Replay
from rs_relpose_ros.result_files import prepare_folder, SUMMARY_FILE

Array = NDArray[np.float64]

_STYLES: Mapping[str, Mapping[str, Any]] = {
    'truth': {'color': 'black', 'lw': 2.5}, 'live': {'color': '#E69F00', 'lw': 1.2},
    'smoothed': {'color': '#0072B2', 'lw': 1.2}}

LIVE_FILE, SMOOTHED_FILE, PICTURE = 'trajectory.tum', 'trajectory_smoothed.tum', 'path.png'


@dataclass(frozen=True, slots=True, eq=False)
class OdometryOutcome:
    """What came of a bag; `figures`: as in summary.json, without provenance."""

    live: list[Odometry]
    smoothed: list[Odometry]
    figures: dict[str, Any]
    sentences: list[str]
    obstacle: str   # why it did not start, where the accelerometer is the reason


class Drawn(NamedTuple):
    """A path: instants [ns], places (N, 3), and the true ones where they are known."""

    imu_ns: Sequence[int]
    places: Array
    truth: Array | None = None


def odometry_into(folder: Path, bag: Bag, topics: SensorTopics, parameters: Parameters,
                  on_image: Callable[[], object] = lambda: None) -> OdometryOutcome:
    """Run a bag, and write trajectories and a picture into `folder`, which is made as needed.

    Files of an earlier run are replaced.
    """
    prepare_folder(folder, (LIVE_FILE, SMOOTHED_FILE, PICTURE, SUMMARY_FILE))
    estimator = OdometryEstimator(parameters, keep=True)
    replay = Replay(bag, topics, parameters, on_image=on_image)
    health = HealthState.UNKNOWN

    def pairs() -> Iterator[tuple[int, PairMeasurement]]:
        nonlocal health
        for pair in replay.pairs():
            health = pair.result.health.state
            yield pair.bag_time_ns, PairMeasurement.of_result(pair.result)

    live = follow(estimator, pairs(), _samples(bag, topics))
    smoothed = estimator.smoothed()
    sentences = estimator.sentences()
    truth = read_truth(bag, topics)
    figures: dict[str, Any] = {
        'keyframes': len(live), 'pairs': {name: estimator.counts[name] for name in (
            'pairs', 'contradicting', 'late', 'told wrong')},
        'lost': estimator.counts['lost'],
        'starts': [asdict(started) for started in estimator.starts], 'health': health.value,
        'length_m': _length(live)}
    drawn = {}
    for name, trajectory in (('live', live), ('smoothed', smoothed)):
        compared = None if truth is None else against_truth(trajectory, truth)
        figures[name] = None
        drawn[name] = Drawn([pose.imu_ns for pose in trajectory], _places(trajectory))
        if compared is not None:
            figures[name] = {key: value if math.isfinite(value) else None
                             for key, value in asdict(compared.errors).items()}
            drawn[name] = Drawn(*compared[1:])
    write_tum(folder / LIVE_FILE, live)
    write_tum(folder / SMOOTHED_FILE, smoothed)
    draw_paths(drawn, folder / PICTURE)
    return OdometryOutcome(live, smoothed, figures, sentences, estimator.obstacle)


def follow(estimator: OdometryEstimator, pairs: Iterable[tuple[int, PairMeasurement]],
           samples: Sequence[tuple[int, ImuSample]]) -> list[Odometry]:
    """Keyframes that come of pairs and samples, both with their times of arrival [ns]."""
    live, given = [], 0
    for arrives_ns, pair in pairs:
        while given < len(samples) and samples[given][0] <= arrives_ns:
            _add(estimator, samples[given][1])
            given += 1
        estimator.add_pair(pair)
        live += estimator.take()
    for _, sample in samples[given:]:
        if not estimator.waiting:
            break   # that the camera ended before the IMU is no loss
        _add(estimator, sample)
        live += estimator.take()
    return live + estimator.take(end=True)


def _samples(bag: Bag, topics: SensorTopics) -> list[tuple[int, ImuSample]]:
    """IMU samples of a bag with their bag times, in bag order."""
    read: list[ImuSample] = []
    feed = SensorFeed({Role.IMU: read.append, Role.ACCEL: read.append})
    out = []
    for role, message in feed.messages(bag, topics):
        try:
            feed.receive(role, message.message)
        except InputError:
            continue   # the replay counts and tells it
        out.append((message.bag_time_ns, read.pop()))
    return out


def _add(estimator: OdometryEstimator, sample: ImuSample) -> None:
    with suppress(InputError):   # a gyro that hangs: the replay counts and tells it
        estimator.add_imu(sample)


def _places(trajectory: Sequence[Odometry]) -> Array:
    return np.array([pose.position for pose in trajectory]).reshape(-1, 3)


def _length(trajectory: Sequence[Odometry]) -> float:
    return float(np.linalg.norm(np.diff(_places(trajectory), axis=0), axis=1).sum())


def draw_paths(drawn: Mapping[str, Drawn], path: Path) -> Figure:
    """Paths by their names, from above and their heights, beside the truth where it is known."""
    figure = Figure(figsize=(11.0, 5.5), dpi=110, layout='constrained')
    above, height = figure.subplots(1, 2)
    # Live ones begin later: of the truth, what the longer path has of it.
    lines = [('truth', line.imu_ns, line.truth) for line in sorted(
        drawn.values(), key=lambda line: -len(line.imu_ns)) if line.truth is not None][:1]
    lines += [(name, line.imu_ns, line.places) for name, line in drawn.items()
              if len(line.imu_ns)]
    first_ns = min((imu_ns[0] for _, imu_ns, _ in lines), default=0)
    for name, imu_ns, places in lines:
        seconds = [seconds_between(first_ns, at_ns) for at_ns in imu_ns]
        above.plot(places[:, 0], places[:, 1], label=name, **_STYLES[name])
        height.plot(seconds, places[:, 2], label=name, **_STYLES[name])
    above.set_aspect('equal', 'datalim')
    above.set(title='path from above', xlabel='x [m]', ylabel='y [m]')
    height.set(title='height', xlabel='time [s]', ylabel='z [m]')
    for axes in (above, height):
        if lines:
            axes.legend()
        axes.grid(alpha=0.3)
    save_picture(figure, path)
    return figure
