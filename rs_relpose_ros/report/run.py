"""One run over a recording, for its report: all that a page shows is kept from this pass.

The messages pass the statistics of `check`, the front end of `replay` and the odometry at once. A
recording that ends in damage gives what came before, and the reason.
"""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.bags.reader import Bag, BagMessage
from rs_relpose_ros.bags.sensor_topics import Chosen, SensorTopics
from rs_relpose_ros.calibration.findings import Assessment, FindingState, NOT_EVALUATED, worst_of
from rs_relpose_ros.calibration.residual_maps import (
    ResidualMap,
    ResidualMaps,
    with_maps,
)
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.messages.incoming import (
    Intake,
    PARTS,
    ReasonCounts,
    Role,
    sensor_messages,
    stamp_ns,
)
from rs_relpose_ros.messages.published_pair import PublishedPair
from rs_relpose_ros.messages.streams import check_timelines, Timeline
from rs_relpose_ros.messages.transforms import with_extrinsics
from rs_relpose_ros.offline import check, check_recording
from rs_relpose_ros.offline.check_recording import Completion, FrontEndSample, Scan
from rs_relpose_ros.offline.check_report import Line, with_parents
from rs_relpose_ros.offline.replay import MessageRefused, outcomes, read_truth, unused_reason
from rs_relpose_ros.offline.tables import PairRecord
from rs_relpose_ros.offline.truth import TrueTrajectory
from rs_relpose_ros.pipeline.monitor import suppressed
from rs_relpose_ros.pipeline.pair import Frame, PairResult
from rs_relpose_ros.pipeline.pipeline import FrontEnd
from rs_relpose_ros.pipeline.warm_up import warm_up
from rs_relpose_ros.report.residuals import MatchResiduals

# Number of frames that a page shows: one of each part of the recording. More make the page larger.
# [chosen: 2 to 8 would do]
SHOWN_FRAMES = 4
# Share of the images below which hardly any was used. [chosen: as in `check`]
_FEW_USED = 0.1


class CameraRotation(NamedTuple):
    """Rotation of the camera over some frames, as images show it."""

    stamp_ns: int  # of the last frame
    interval: float  # [s] since the first one
    by_images: Array  # (3,) rotation vector [rad] of R_1^T R_2, camera frame


class Inertial(NamedTuple):
    """Samples of one sensor of the IMU, in its frame."""

    stamps_ns: NDArray[np.int64]  # (K,)
    values: Array  # (K, 3) [rad/s] or [m/s^2]


class MetricPath(NamedTuple):
    """The path of the odometry, or the reason why there is none."""

    reason: str = ''
    path: Any = None  # `ComparedPath` of odometry.offline
    sigma: float = float('nan')  # of the last position [m]


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """All that a page shows of a recording."""

    bag: str
    names: tuple[str, ...]  # of topics and frames, which a page may have to leave out
    times: dict[Role, Timeline]
    gyro: Inertial
    accelerometer: Inertial
    lines: tuple[Line, ...]
    parameters: Parameters  # as used: with estimates of what was not configured
    completion: Completion
    intrinsics: Intrinsics | None
    path: MetricPath
    damage: str  # why the reading ended early; empty if it did not
    frames: int = 0  # images that the front end used
    pairs: tuple[PairRecord, ...] = ()
    withheld: int = 0  # pairs with a pose that a node would not publish
    residuals: tuple[MatchResiduals, ...] = ()  # of the pairs with a pose
    rotations: tuple[CameraRotation, ...] = ()
    shown: tuple[PairResult, ...] = ()
    health: Assessment = NOT_EVALUATED
    maps: tuple[ResidualMap, ...] = ()  # of their signed residuals
    unused: dict[str, int] = field(default_factory=dict)  # frames and messages by reason


def nothing_of(bag: Path, parameters: Parameters, damage: str) -> Observation:
    """The observation of a bag of which nothing can be read."""
    nothing = _Readings()
    return Observation(
        bag=str(bag),
        names=(),
        times={},
        gyro=nothing.gyro,
        accelerometer=nothing.accelerometer,
        lines=(),
        parameters=parameters,
        completion=Completion(parameters, None, damage),
        intrinsics=None,
        path=MetricPath(damage),
        damage=damage,
    )


class _Readings:
    """Stamps and samples of the streams, as they are read."""

    def __init__(self) -> None:
        # Stamps and times of reception.
        self._times: dict[Role, tuple[list[int], list[int]]] = {
            Role.IMAGE: ([], []),
            Role.IMU: ([], []),
            Role.ACCEL: ([], []),
        }
        self._gyro: list[tuple[int, Any]] = []
        self._accelerometer: list[tuple[int, Any]] = []
        self.frame_ids: set[str] = set()
        # What the odometry gets, with the times of reading.
        self.samples: list[tuple[int, ImuSample | int]] = []

    def add(self, role: Role, message: BagMessage) -> None:
        """Add a message; one that cannot be read is counted by others."""
        with suppress(RsRelposeError):
            stamp = stamp_ns(message.message.header)
            self.frame_ids.add(message.message.header.frame_id)
            if role in self._times:
                stamps, received = self._times[role]
                stamps.append(stamp)
                received.append(message.bag_time_ns)
            if role is Role.CAMERA_INFO:
                self.samples.append((message.read_ns, stamp))
            elif role in (Role.IMU, Role.ACCEL):
                self._add_sample(message.read_ns, PARTS[role].read(message.message))

    def _add_sample(self, read_ns: int, sample: ImuSample) -> None:
        self.samples.append((read_ns, sample))
        if sample.angular_velocity is not None:
            self._gyro.append((sample.stamp_ns, sample.angular_velocity))
        if sample.linear_acceleration is not None:
            self._accelerometer.append((sample.stamp_ns, sample.linear_acceleration))

    def times(self) -> dict[Role, Timeline]:
        """Times of the streams that have messages."""
        timelines = {}
        for role, columns in self._times.items():
            stamps, received = np.array(columns, dtype=np.int64)
            if len(stamps):
                timelines[role] = Timeline(role.value, stamps, received)
        return timelines

    @property
    def gyro(self) -> Inertial:
        """All samples of the gyro, by stamp."""
        return _inertial(self._gyro)

    @property
    def accelerometer(self) -> Inertial:
        """All samples of the accelerometer, by stamp."""
        return _inertial(self._accelerometer)


def _inertial(samples: list[tuple[int, Any]]) -> Inertial:
    in_order = sorted(samples, key=lambda one: one[0])
    stamps = [stamp for stamp, _ in in_order]
    values = [value for _, value in in_order]
    return Inertial(np.array(stamps, dtype=np.int64), np.array(values, dtype=float).reshape(-1, 3))


class _Run:
    """The front end on a source of messages; iterate over `pairs`, then read the rest."""

    def __init__(self, parameters: Parameters, images: int, truth: TrueTrajectory | None) -> None:
        self._parameters = parameters
        self.truth = truth
        # Wrong parameters must not hide the pairs that show what is wrong.
        unsuppressed = parameters.updated({'withhold_when_wrong': False})
        self._front_end = FrontEnd(unsuppressed, offline=True, keep_images=True)
        self.intake = Intake(self._front_end.sequencer, parameters)
        self._part = max(images // SHOWN_FRAMES, 1)
        self._best: dict[int, PairResult] = {}
        self._rotations: dict[int, CameraRotation] = {}
        self.records: list[PairRecord] = []
        self.residuals: list[MatchResiduals] = []
        self._residual_maps = ResidualMaps()
        self.maps: tuple[ResidualMap, ...] = ()
        self.withheld = self.frames = 0
        self.health = NOT_EVALUATED
        self.unused = ReasonCounts()
        self._poseless = ReasonCounts()
        self.read_ns = 0

    def pairs(self, source: Iterable[tuple[Role, BagMessage]]) -> Iterator[PairResult]:
        """Run, and yield each pair as a node would publish it."""
        warm_up(self._parameters.estimator)
        for outcome in outcomes(self._front_end, self.intake, self._noted(source)):
            if isinstance(outcome, MessageRefused):
                self.unused.add(str(outcome.error))
                continue
            if not isinstance(outcome, Frame):
                self.unused.add(unused_reason(outcome))
                continue
            self.frames += 1
            if outcome.result is not None:
                yield self._kept(outcome.result)
        self._note_health(self._front_end.health)
        self.maps = self._residual_maps.maps()
        self.health = with_maps(self.health, self.maps)

    def _noted(
        self, source: Iterable[tuple[Role, BagMessage]]
    ) -> Iterator[tuple[Role, BagMessage]]:
        for role, message in source:
            self.read_ns = message.read_ns
            yield role, message

    def _kept(self, pair: PairResult) -> PairResult:
        """Keep what the page shows of a pair; the pair as a node publishes it."""
        published = replace(pair, pose=suppressed(pair.pose, pair.health), image2=None)
        self.withheld += published.pose.status is Status.WITHHELD
        record = PairRecord.of(replace(pair, image2=None), self.truth)
        self.records.append(record)
        if pair.pose:
            residuals = MatchResiduals.of(pair, self._focal_length)
            self.residuals.append(residuals)
            self._residual_maps.add(pair.residual_sums)
        else:
            self._poseless.add(pair.pose.reason)
        self._note_health(pair.health)
        for stamp, interval, by_images, _ in self._front_end.rotations:
            self._rotations[stamp] = CameraRotation(stamp, interval, by_images)
        self._keep_best(pair)
        return published if self._parameters.pair.withhold_when_wrong else pair

    def _keep_best(self, pair: PairResult) -> None:
        """Keep the pair for the page if it is the best one of its part of the recording."""
        part = min(self.frames // self._part, SHOWN_FRAMES - 1)
        best = self._best.get(part)
        if best is None or _rank(pair) > _rank(best):
            self._best[part] = pair

    def _note_health(self, health: Assessment) -> None:
        self.health = worst_of(self.health, health)

    @property
    def _focal_length(self) -> float:
        """Of the images in use [px]."""
        assert self.intake.intrinsics is not None  # there is a pair
        return self.intake.intrinsics.fx

    @property
    def shown(self) -> tuple[PairResult, ...]:
        """The pairs with their images that a page shows."""
        return tuple(self._best[part] for part in sorted(self._best))

    @property
    def rotations(self) -> tuple[CameraRotation, ...]:
        """All rotations by images, in the order of time."""
        return tuple(self._rotations[stamp] for stamp in sorted(self._rotations))

    def added_to(self, observation: Observation) -> Observation:
        """The observation with what the run has made."""
        return replace(
            observation,
            frames=self.frames,
            pairs=tuple(self.records),
            withheld=self.withheld,
            residuals=tuple(self.residuals),
            rotations=self.rotations,
            shown=self.shown,
            health=self.health,
            maps=self.maps,
            unused=dict(self.unused.most_common()),
        )

    def sample(self, images: int) -> FrontEndSample:
        """The run, as `check` makes its findings of it."""
        poses = sum(bool(record.pose) for record in self.records)
        return FrontEndSample(
            self.frames,
            [int(record.metrics['matches']) for record in self.records],
            poses,
            self._poseless if self.records else self.unused,
            self.health,
            self.frames < _FEW_USED * images,
        )


def _rank(pair: PairResult) -> tuple[bool, float]:
    """How well a pair shows what the front end does: with a pose, many matches that move far."""
    return bool(pair.pose), float(pair.inliers * pair.parallax)


def observe(bag: Bag, chosen: Chosen, parameters: Parameters) -> Observation:
    """Read an open bag once, and return all that its report shows.

    A parameter that is not configured is estimated first, by a calibration of a part of the bag.
    Damage of the bag ends the reading; the observation has its reason.
    """
    damage: list[str] = []
    readings = _Readings()
    images = chosen.image.count if chosen.image else 0
    parameters, contradiction = with_extrinsics(bag, chosen, parameters)
    scan = Scan(images, parameters.intrinsics)
    source = _until_damage(bag, chosen, scan, readings, damage)
    completion = Completion(parameters)
    run = None
    path = MetricPath('not run')
    topics = chosen.sensors
    if topics is not None:
        completion = _completed(bag, topics, parameters, damage)
        if not completion.parameters.sensor.missing():
            truth = _truth_of(bag, topics, damage)
            run = _Run(completion.parameters, images, truth)
            path = _follow(run, source, readings, completion.parameters)
    for _ in source:  # the rest of it without a run
        pass
    lines = check.stream_findings(bag, chosen, parameters, contradiction, scan)
    if topics is not None:
        faults = check_timelines(bag.timeline, chosen)
        sample = None if run is None else run.sample(images)
        lines += check.joint_findings(scan, sample, completion, parameters, faults)
    observation = Observation(
        bag=str(bag.path),
        names=tuple({*(topic.name for topic in bag.topics), *readings.frame_ids}),
        times=readings.times(),
        gyro=readings.gyro,
        accelerometer=readings.accelerometer,
        lines=with_parents(lines),
        parameters=completion.parameters,
        completion=completion,
        intrinsics=scan.intrinsics,
        path=path,
        damage='; '.join(dict.fromkeys(damage)),
    )
    return observation if run is None else run.added_to(observation)


def _until_damage(
    bag: Bag, chosen: Chosen, scan: Scan, readings: _Readings, damage: list[str]
) -> Iterator[tuple[Role, BagMessage]]:
    """The messages of the sensors, each added to the statistics; damage ends them."""
    try:
        for role, message in scan.added(sensor_messages(bag, chosen, faulty=True)):
            readings.add(role, message)
            yield role, message
    except RsRelposeError as error:
        damage.append(str(error))


def _completed(
    bag: Bag, topics: SensorTopics, parameters: Parameters, damage: list[str]
) -> Completion:
    """`parameters` with estimates of what is missing, if the bag permits them."""
    try:
        return check_recording.completed(bag, topics, parameters)
    except RsRelposeError as error:
        damage.append(str(error))
        return Completion(parameters, None, str(error))


def _truth_of(bag: Bag, topics: SensorTopics, damage: list[str]) -> TrueTrajectory | None:
    """Ground truth of the camera; None if the bag has none that can be read."""
    try:
        found = bag.find_topics({}, needs_camera_info=False)
        return read_truth(bag, replace(topics, truth=found.truth))
    except RsRelposeError as error:
        damage.append(f'ground truth: {error}')
        return None


def _follow(
    run: _Run,
    source: Iterator[tuple[Role, BagMessage]],
    readings: _Readings,
    parameters: Parameters,
) -> MetricPath:
    """Run to the end, with the odometry where it is installed and can start."""
    pairs = run.pairs(source)
    try:
        from rs_relpose_ros.odometry.estimator import OdometryEstimator
        from rs_relpose_ros.odometry.offline import follow, path_of
        from rs_relpose_ros.odometry.states import Base

        estimator = OdometryEstimator(parameters)
        published = ((run.read_ns, PublishedPair.of_result(pair)) for pair in pairs)
        live = follow(estimator, published, readings.samples)
        if not live:
            return MetricPath(estimator.blocking_reason or 'it did not start')
        base = estimator.base or Base()
        covariance = live[-1].pose_covariance[:3, :3]
        path = path_of([base.camera(pose) for pose in live], run.truth)
        return MetricPath('', path, float(np.sqrt(np.trace(covariance))))
    except ImportError:
        return MetricPath("gtsam is not installed: pip install 'gtsam>=4.3,<4.4'")
    except RsRelposeError as error:
        return MetricPath(str(error))
    finally:
        for _ in pairs:  # without the odometry
            pass


def is_unusable(observation: Observation) -> bool:
    """Whether the recording is damaged, or no good pose comes from it as it is configured."""
    wrong = any(line.state is FindingState.WRONG for line in observation.lines)
    return bool(observation.damage) or wrong or not any(one.pose for one in observation.pairs)
