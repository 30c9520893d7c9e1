"""A bag through the pipeline of the live node: the same sequencer, conversion and estimator.

`outcomes` feeds any source to a frame loop; `Replay` makes pairs of a bag, `related` those of a
list, and `replay_into` and `pairs_into` write them into a folder.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
import csv
from dataclasses import dataclass
import logging
from pathlib import Path
import time
from typing import Any, TypeVar

import numpy as np

from rs_relpose_ros.bags.convert.text_files import check_file, read_rows, Row
from rs_relpose_ros.bags.reader import Bag, BagMessage
from rs_relpose_ros.bags.sensor_topics import SensorTopics
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.calibration.findings import Assessment, NOT_EVALUATED, worst_of
from rs_relpose_ros.calibration.findings_text import summary_json, summary_lines
from rs_relpose_ros.calibration.residual_maps import (
    ResidualMap,
    ResidualMaps,
    summary_line,
    with_maps,
)
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.geometry.timing import clocks_apart
from rs_relpose_ros.messages.incoming import Intake, PARTS, ReasonCounts, Role, sensor_messages
from rs_relpose_ros.messages.outgoing import pair_parts, PAIR_TOPICS
from rs_relpose_ros.messages.streams import check_timelines
from rs_relpose_ros.offline import tables
from rs_relpose_ros.offline.tables import ERRORS, median_or_none, PairRecord, POSES
from rs_relpose_ros.offline.truth import TrueTrajectory
from rs_relpose_ros.output_files import prepare_folder, refuse_existing, SUMMARY_FILE
from rs_relpose_ros.pipeline.chosen_pairs import ChosenPairs, PairStamps
from rs_relpose_ros.pipeline.pair import Frame, PAIR_METRICS, PairResult
from rs_relpose_ros.pipeline.pipeline import FrameFailed, FrameLoop, FrontEnd, Outcome
from rs_relpose_ros.pipeline.sequencer import FrameRefused
from rs_relpose_ros.pipeline.warm_up import warm_up

# Folder of the bag of a replay with one. [derived: interface]
BAG_FOLDER = 'relpose_bag'
# Pictures of a replay in the order of `draw_replay`. [derived: interface]
PICTURES = ('matches.png', 'errors.png', 'residuals.png', 'rotation.png')

_logger = logging.getLogger(__name__)

Result = TypeVar('Result')


@dataclass(frozen=True, slots=True)
class MessageRefused:
    """An unusable message."""

    role: Role
    topic: str
    error: RsRelposeError
    stamp_ns: None = None  # it belongs to no frame

    @property
    def reason(self) -> str:
        """Topic and message of the error."""
        return f'{self.topic}: {self.error}'

    def raise_without_intrinsics(self) -> None:
        """Raise the error of a CameraInfo: without intrinsics no frame can be used."""
        if self.role is Role.CAMERA_INFO:
            raise type(self.error)(self.reason) from self.error


def outcomes(
    loop: FrameLoop[Result],
    intake: Intake,
    source: Iterable[tuple[Role, BagMessage]],
) -> Iterator[Outcome[Result] | MessageRefused]:
    """Feed a source to the end, and yield what becomes of each frame, as soon as it is known."""
    for role, message in source:
        error = intake.receive(role, message.message)
        if error is not None:
            yield MessageRefused(role, message.topic, error)
        if not loop.sequencer.has_next():
            continue  # most messages are samples of the IMU, which complete no frame
        while (outcome := loop.step()) is not None:
            yield outcome
    intake.finish()
    while (outcome := loop.step()) is not None:
        yield outcome


def need_sensor_parameters(parameters: Parameters, fix: str = '') -> None:
    """Raise MissingInputError for required parameters that no message contains."""
    if missing := parameters.sensor.missing():
        fix = fix or f'use --params FILE or --set {missing[0]}=...: see config/relpose.yaml'
        raise MissingInputError(f'{" and ".join(missing)} must be given; {fix}')


def unused_reason(outcome: FrameRefused | FrameFailed | MessageRefused) -> str:
    """Reason why a frame or message was not used, with its kind."""
    kind = f'{outcome.refusal.value}: ' if isinstance(outcome, FrameRefused) else ''
    return kind + outcome.reason


class Replay:
    """One run over an open bag; iterate over `pairs`, then read the counts and `reasons`.

    With `stamps` only these frames are handed over, as those that a live node processed.
    `keep_images`: whether pairs have their current image.
    """

    def __init__(
        self,
        bag: Bag,
        topics: SensorTopics,
        parameters: Parameters,
        *,
        stamps: frozenset[int] | None = None,
        keep_images: bool = False,
    ) -> None:
        need_sensor_parameters(parameters)
        self.parameters = parameters
        self._bag = bag
        self._topics = topics
        self._stamps = stamps
        self._front_end = FrontEnd(parameters, offline=True, keep_images=keep_images)
        self.sequencer = self._front_end.sequencer
        self.intake = Intake(self.sequencer, parameters, stamps)
        self.invalid_messages = self.failed_frames = self.pair_count = 0
        # Wall times [s]: of the whole without compilation, and of tracking and estimation.
        self.seconds = self.processing_seconds = 0.0
        self.first_ns = self.last_ns = 0  # bag times of the first and of the last message so far
        self.read_ns = 0  # time of reading of the last message
        # Unused frames and messages, by the first message of each reason.
        self.reasons = ReasonCounts()

    def pairs(self) -> Iterator[PairResult]:
        """Run over the bag, and yield every pair; `last_ns` is then its bag time."""
        warm_up(self._front_end.parameters.estimator)
        started = time.perf_counter()
        for fault in check_timelines(self._bag.timeline, self._topics).values():
            if not fault.withholds:
                _logger.warning('%s', fault)
        for outcome in outcomes(self._front_end, self.intake, self._messages()):
            if isinstance(outcome, Frame):
                self.processing_seconds += outcome.seconds
                if outcome.result is not None:
                    self.pair_count += 1
                    yield outcome.result
                continue
            if isinstance(outcome, MessageRefused):
                if not self.sequencer.counts().frames_taken:
                    outcome.raise_without_intrinsics()
                self.invalid_messages += 1
            self.failed_frames += isinstance(outcome, FrameFailed)
            reason = unused_reason(outcome)
            if self.reasons.add(reason):
                _logger.info('not used: %s', reason)
        self.seconds = time.perf_counter() - started
        if self._stamps is not None:
            absent = len(self._stamps - self.intake.stamps_found)
            if absent == len(self._stamps):
                raise InputError(
                    f'none of the {absent} chosen stamps is the stamp of an image on '
                    f'{self._topics.image.name}'
                )
            if absent:
                _logger.warning(
                    '%d of the %d chosen stamps are not in the bag', absent, len(self._stamps)
                )
        most = next(iter(self.reasons.most_common()), None)
        nothing_taken = not self.sequencer.counts().frames_taken
        all_failed = self.failed_frames and not self.pair_count
        if most is not None and (nothing_taken or all_failed):
            apart = self._clocks_apart()
            raise InputError(
                f'no frame of {self._bag.path} could be used: {most}'
                + (f'; as they were recorded, {apart}: "rs_relpose check" looks for the offset')
                * bool(apart)
            )

    def _clocks_apart(self) -> str:
        """Message on clocks that differ by the times of recording; '' if they do not."""
        images = self._bag.timeline(self._topics.image)
        imu = self._bag.timeline(self._topics.imu)
        ahead = images.delay - imu.delay
        return clocks_apart(ahead + self.parameters.sensor.time_offset)

    @property
    def health(self) -> Assessment:
        """Consistency of the configuration after all pairs so far."""
        return self._front_end.health

    def _messages(self) -> Iterator[tuple[Role, BagMessage]]:
        for role, message in sensor_messages(self._bag, self._topics):
            self.first_ns = self.first_ns or message.bag_time_ns
            self.last_ns = message.bag_time_ns
            self.read_ns = message.read_ns
            yield role, message


@dataclass(frozen=True, slots=True, eq=False)
class ReplayOutcome:
    """Results of a replay, or of a list of pairs."""

    records: list[PairRecord]
    metrics: dict[str, Any]  # content of summary.json without provenance
    health: Assessment  # the worst finding of each configured parameter
    files: list[Path]  # written so far: tables, bag and pictures
    intrinsics: Intrinsics | None  # active at the end
    maps: tuple[ResidualMap, ...] = ()

    def health_lines(self) -> list[str]:
        """Lines on the calibration for the console."""
        return [*summary_lines(self.health), *filter(None, [summary_line(self.maps)])]


def replay_into(
    folder: Path,
    bag: Bag,
    topics: SensorTopics,
    parameters: Parameters,
    *,
    stamps: frozenset[int] | None = None,
    pictures: bool = True,
    with_bag: bool = False,
    on_pair: Callable[[PairResult], object] = lambda pair: None,
) -> ReplayOutcome:
    """Run `bag` through the pipeline and write tables, pictures and a bag into `folder`.

    Files of an earlier run are replaced. `stamps`: as of `Replay`; `with_bag`: of the node's
    topics. `on_pair` is called with each pair, which has its image if `pictures` are drawn.
    """
    run = Replay(bag, topics, parameters, stamps=stamps, keep_images=pictures)
    truth = read_truth(bag, topics)
    out_bag = folder / BAG_FOLDER
    if with_bag:
        refuse_existing(out_bag)
    prepare_folder(folder, (POSES.file, ERRORS.file, SUMMARY_FILE, *PICTURES))
    records: list[PairRecord] = []
    residuals = ResidualMaps()
    shown: PairResult | None = None
    last = None
    health = NOT_EVALUATED
    best = (False, 0.0)
    written = (POSES,) if truth is None else (POSES, ERRORS)
    with ExitStack() as stack:
        write_record = stack.enter_context(tables.table_writer(folder, written))
        writer = stack.enter_context(BagWriter(out_bag)) if with_bag else None
        for pair in run.pairs():
            records.append(PairRecord.of(pair, truth))
            last = pair
            residuals.add(pair.residual_sums)
            health = worst_of(health, pair.health)
            write_record(records[-1])
            if writer is not None:
                parts = pair_parts(pair, writer.type, parameters.pair.reference_frame)
                for topic, make in parts.items():
                    writer.write(f'/relpose_node/{topic}', PAIR_TOPICS[topic], make(), run.last_ns)
            on_pair(pair)
            # The better picture: with a pose, many inliers and much parallax.
            inliers = pair.pose.inliers.sum()
            rank = bool(pair.pose), float(inliers * pair.parallax)
            if pictures and (shown is None or rank > best):
                shown = pair
                best = rank
    maps = residuals.maps()
    health = with_maps(worst_of(health, run.health), maps)
    files = [folder / table.file for table in written] + [out_bag] * with_bag
    if shown is not None:
        # Imports Matplotlib, which takes a second.
        from rs_relpose_ros.offline.pictures import draw_replay

        files += draw_replay([folder / name for name in PICTURES], records, shown, truth)
    summary = _summary(records, run, last, health)
    summary['residual_maps'] = [one.as_json() for one in maps]
    return ReplayOutcome(records, summary, health, files, run.intake.intrinsics, maps)


def _summary(
    records: list[PairRecord], run: Replay, last: PairResult | None, health: Assessment
) -> dict[str, Any]:
    """Content of summary.json; medians are over the pairs with a pose, null without any."""
    answered = [record for record in records if record.pose]
    sequencer = run.sequencer.counts()
    seconds = run.processing_seconds
    taken = sequencer.frames_taken
    return {
        'pairs': pair_counts(records),
        'frames': {
            'in_bag': run.intake.images,
            'not_among_stamps': run.intake.images_skipped,
            'processed': taken,
            'refused': {refusal.value: n for refusal, n in sequencer.refused.items()},
            'failed': run.failed_frames,
        },
        'imu': {
            'samples': sequencer.imu_samples,
            'gaps': sequencer.imu_gaps,
            'repeated': sequencer.imu_repeated,
            'late': sequencer.imu_late,
            'clock_jumps': sequencer.clock_jumps,
        },
        'tracked': _tracked(last),
        'health': summary_json(health),
        'invalid_messages': run.invalid_messages,
        'not_used': run.reasons.most_common(),
        'medians': {
            metric.name: median_or_none([record.metrics[metric.name] for record in answered])
            for metric in PAIR_METRICS
        },
        'baselines': tables.baselines(answered),
        'errors_against_truth': tables.errors_against_truth(answered),
        'timing': {
            'bag_s': (run.last_ns - run.first_ns) * 1e-9,
            'wall_s': run.seconds,
            'frame_rate_hz': taken / seconds if seconds > 0.0 else None,
            'processing_per_frame_ms': 1e3 * seconds / taken if taken else None,
            'estimate_median_ms': median_or_none(
                [1e3 * record.pose.diagnostics.duration for record in records]
            ),
        },
    }


def pair_counts(records: list[PairRecord]) -> dict[str, Any]:
    """Numbers of pairs for summary.json."""
    by_status = Counter(record.pose.status for record in records)
    return {
        'total': len(records),
        'answered': sum(bool(record.pose) for record in records),
        'by_status': {status.value: by_status[status] for status in Status},
    }


def _tracked(last: PairResult | None) -> dict[str, Any] | None:
    if last is None or last.tracked is None or not last.tracked.pairs:
        return None
    tracked = last.tracked
    applied = last.applied
    return {
        'gyro_bias_rad_s': tracked.gyro_bias.tolist(),
        'gyro_bias_sigma_rad_s': tracked.gyro_bias_sigma.tolist(),
        'time_offset_s': tracked.time_offset,
        'time_offset_sigma_s': tracked.time_offset_sigma,
        'applied_s': applied.offset,
        'readout_time_s': tracked.readout_time,
        'readout_time_sigma_s': tracked.readout_time_sigma,
        'applied_readout_time_s': applied.readout_time,
    }


def read_truth(bag: Bag, topics: SensorTopics) -> TrueTrajectory | None:
    """Ground truth of the camera; None if the bag has none."""
    if topics.truth is None:
        return None
    messages = sensor_messages(bag, topics, (Role.TRUTH,))
    poses = [PARTS[role].read(message.message) for role, message in messages]
    stamps_ns = [pose.stamp_ns for pose in poses]
    positions = [pose.position for pose in poses]
    quaternions = [pose.quat_xyzw for pose in poses]
    try:
        return TrueTrajectory(stamps_ns, np.array(positions), np.array(quaternions))
    except InputError as error:
        raise InputError(f'{topics.truth.name}: {error}') from error


def read_stamps(path: Path | str) -> frozenset[int]:
    """Stamps of frames, one integer [ns] per line, as the node's `stamps_file` contains them.

    A table of poses is refused: the frames between keyframes affect the tracks as well.
    """
    stamps = frozenset(row.nanoseconds(0) for row in read_rows(Path(path), range(1)))
    if not stamps:
        raise InputError(f'{path} has no stamps')
    return stamps


# Columns of the list. The tables of `replay` have the same, so that they are valid lists.
# [derived: interface]
LIST_COLUMNS = POSES.columns[:2]
# The table of `replay`, with the reason of a pair without a pose. [derived: interface]
CHOSEN_POSES = tables.Table(
    POSES.file,
    (*POSES.columns, 'reason'),
    lambda record: [*(POSES.row(record) or ()), record.pose.reason],
)


def read_pairs(path: Path) -> list[PairStamps]:
    """Stamps [ns] of the earlier and of the later image of each pair in a list (CSV)."""
    with check_file(path).open(newline='', encoding='utf-8-sig', errors='replace') as file:
        rows = csv.DictReader(file)
        places = (Row(path, rows.line_num, row) for row in rows)
        first, second = LIST_COLUMNS
        pairs = [(row.nanoseconds(first), row.nanoseconds(second)) for row in places]
    if not pairs:
        raise InputError(
            f'{path} has no pairs below a line with the column names {" and ".join(LIST_COLUMNS)}'
        )
    return pairs


def pairs_into(
    folder: Path,
    bag: Bag,
    topics: SensorTopics,
    parameters: Parameters,
    pairs: Sequence[PairStamps],
) -> ReplayOutcome:
    """Write a row for each of the pairs, in their order, into tables in `folder`."""
    prepare_folder(folder, (POSES.file, ERRORS.file, SUMMARY_FILE))
    truth = read_truth(bag, topics)
    results, intrinsics = related(bag, topics, parameters, pairs)
    records = []
    for pair, result in zip(pairs, results, strict=True):
        if isinstance(result, PairResult):
            records.append(PairRecord.of(result, truth))
        else:
            no_pose = RelativePose(status=Status.BAD_INPUT, reason=result)
            records.append(PairRecord(*pair, no_pose))
    written = (CHOSEN_POSES,) if truth is None else (CHOSEN_POSES, ERRORS)
    with tables.table_writer(folder, written) as write:
        for record in records:
            write(record)
    answered = [record for record in records if record.pose]
    metrics = {
        'pairs': pair_counts(records),
        'errors_against_truth': tables.errors_against_truth(answered),
    }
    files = [folder / table.file for table in written]
    return ReplayOutcome(records, metrics, NOT_EVALUATED, files, intrinsics)


def related(
    bag: Bag, topics: SensorTopics, parameters: Parameters, pairs: Sequence[PairStamps]
) -> tuple[list[PairResult | str], Intrinsics | None]:
    """Results of the pairs, or the reasons why they were not estimated; active intrinsics."""
    warm_up(parameters.estimator)
    wanted = [pair for pair in pairs if pair[0] < pair[1]]
    stamps = {stamp for pair in wanted for stamp in pair}
    loop = FrameLoop(parameters, ChosenPairs(wanted), offline=True)
    intake = Intake(loop.sequencer, parameters, stamps)
    results: dict[PairStamps, PairResult | str] = {}
    problems: dict[int, str] = {}
    for outcome in outcomes(loop, intake, sensor_messages(bag, topics)):
        if isinstance(outcome, Frame):
            # The first result of a pair, if images are repeated.
            results = {**(outcome.result or {}), **results}
        elif isinstance(outcome, MessageRefused):
            outcome.raise_without_intrinsics()
        elif outcome.stamp_ns is not None:
            text = f'the image of {outcome.stamp_ns} cannot be used: {outcome.reason}'
            problems.setdefault(outcome.stamp_ns, text)

    for stamp in stamps - intake.stamps_found:
        problems[stamp] = f'no image on {topics.image.name} has the stamp {stamp}'
    found = [
        results[pair] if pair in results else _why_not_estimated(pair, problems) for pair in pairs
    ]
    return found, intake.intrinsics


def _why_not_estimated(pair: PairStamps, problems: Mapping[int, str]) -> str:
    """Why a pair has no result; `problems` are those of its images, by their stamps."""
    first, second = pair
    if first >= second:
        remedy = 'give two different images' if first == second else 'exchange them'
        return f'{LIST_COLUMNS[0]} must be before {LIST_COLUMNS[1]}: {remedy}'
    for stamp in pair:
        if stamp in problems:
            return problems[stamp]
    return 'the clock of the images jumped back between the two'
