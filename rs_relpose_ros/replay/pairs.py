"""Relative poses of chosen pairs of a bag's images: what stands in a list, row by row."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rs_relpose_ros.bags.reader import Bag, BagMessage
from rs_relpose_ros.bags.topics import SensorTopics
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.estimator.warm_up import warm_up
from rs_relpose_ros.front_end.chosen_pairs import ChosenPair, ChosenPairs
from rs_relpose_ros.front_end.frame import Frame
from rs_relpose_ros.front_end.front_end import FrameFailed, FrameLoop
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.front_end.sequencer import FrameRefused
from rs_relpose_ros.messages.incoming import stamp_ns
from rs_relpose_ros.messages.intake import Intake
from rs_relpose_ros.messages.sensor_feed import Role
from rs_relpose_ros.replay.outputs import ERRORS_FILE, POSES_FILE
from rs_relpose_ros.replay.run import read_truth
from rs_relpose_ros.replay.summary import errors_against_truth
from rs_relpose_ros.replay.tables import (
    error_cells,
    ERROR_COLUMNS,
    pair_record,
    PairRecord,
    relative_pose_cells,
    RELATIVE_POSE_COLUMNS,
    table_writer,
)
from rs_relpose_ros.replay.truth import TrueTrajectory
from rs_relpose_ros.result_files import prepare_folder, SUMMARY_FILE

# Of the list: those of the tables of `replay`, which can be lists as they are.
LIST_COLUMNS = RELATIVE_POSE_COLUMNS[:2]
PAIR_COLUMNS = (*RELATIVE_POSE_COLUMNS, 'reason')

Stamps = tuple[int, int]


def read_pairs(path: Path) -> list[Stamps]:
    """Stamps [ns] of the earlier and of the later image of each pair in a list (CSV)."""
    if not path.is_file():
        raise MissingInputError(f'there is no list of pairs {path}')
    with path.open(newline='', encoding='utf-8-sig', errors='replace') as file:
        rows = csv.DictReader(file)
        if missing := set(LIST_COLUMNS) - set(rows.fieldnames or ()):
            raise InputError(f'{path} must begin with a line of column names that has '
                             f'{" and ".join(LIST_COLUMNS)}; missing: '
                             f'{", ".join(sorted(missing))}')
        pairs = [_stamps(row, f'{path}, line {rows.line_num}') for row in rows]
    if not pairs:
        raise InputError(f'{path} has no pairs')
    return pairs


def _stamps(row: dict[str, str | None], place: str) -> Stamps:
    texts = [(row[name] or '').strip() for name in LIST_COLUMNS]
    for name, text in zip(LIST_COLUMNS, texts, strict=True):
        if not (text.isascii() and text.isdigit()):
            raise InputError(f'{place}: {name} must be the stamp of an image, an integer [ns], '
                             f'got {text[:40]!r}')
    return int(texts[0]), int(texts[1])


@dataclass(frozen=True, slots=True, eq=False)
class PairRow:
    """A row of the list with what came of it: a record, or the reason why there is none."""

    stamps_ns: Stamps
    record: PairRecord | None
    reason: str   # empty where there is a pose

    def cells(self) -> list[str]:
        """Row of `PAIR_COLUMNS`; stamps as in the list."""
        stamps = [str(stamp) for stamp in self.stamps_ns]
        if self.record is None:
            empty = [''] * (len(RELATIVE_POSE_COLUMNS) - len(stamps))
            empty[RELATIVE_POSE_COLUMNS.index('status') - len(stamps)] = Status.BAD_INPUT.value
            return [*stamps, *empty, self.reason]
        return [*stamps, *relative_pose_cells(self.record)[len(stamps):], self.reason]


@dataclass(frozen=True, slots=True, eq=False)
class PairsOutcome:
    """What came of a list; `figures`: as in summary.json; `files`: names of the tables."""

    rows: list[PairRow]
    figures: dict[str, Any]
    files: list[str]


def pairs_into(folder: Path, bag: Bag, topics: SensorTopics, parameters: Parameters,
               pairs: Sequence[Stamps], *,
               on_image: Callable[[], object] = lambda: None) -> PairsOutcome:
    """Write a row for each of the pairs, in their order, into tables in `folder`.

    Those of an earlier run are replaced. `on_image` is called after each image.
    """
    prepare_folder(folder, (POSES_FILE, ERRORS_FILE, SUMMARY_FILE))
    truth = read_truth(bag, topics)
    run = _Run(bag, topics, parameters, [pair for pair in pairs if pair[0] < pair[1]], on_image)
    run.run()
    rows = [run.row(pair, truth) for pair in pairs]
    records = [row.record for row in rows if row.record is not None]
    files = [POSES_FILE]
    with table_writer(folder / POSES_FILE, PAIR_COLUMNS) as write:
        for row in rows:
            write(row.cells())
    if truth is not None:
        files.append(ERRORS_FILE)
        with table_writer(folder / ERRORS_FILE, ERROR_COLUMNS) as write:
            for record in records:
                write(error_cells(record))
    answered = [record for record in records if record.pose]
    by_status = Counter(record.status for record in records)
    by_status[Status.BAD_INPUT] += len(rows) - len(records)
    return PairsOutcome(rows, {
        'pairs': {'total': len(rows), 'answered': len(answered),
                  'by_status': {status.value: by_status[status] for status in Status}},
        'errors_against_truth': errors_against_truth(answered)}, files)


class _Run:
    """One run over a bag: results of pairs, and why images were not used."""

    def __init__(self, bag: Bag, topics: SensorTopics, parameters: Parameters,
                 wanted: Sequence[Stamps], on_image: Callable[[], object]) -> None:
        self._bag, self._topics, self._on_image = bag, topics, on_image
        self._wanted = frozenset(stamp for pair in wanted for stamp in pair)
        self._loop: FrameLoop[Frame, tuple[ChosenPair, ...]] = FrameLoop(
            parameters, ChosenPairs(wanted), offline=True)
        self._intake = Intake(self._loop.sequencer, parameters.imu.stuck_gyro_time,
                              parameters.intrinsics)
        self._results: dict[Stamps, PairResult | str] = {}
        self._problems: dict[int, str] = {}
        self._seen: set[int] = set()

    def run(self) -> None:
        warm_up(self._loop.parameters.estimator)
        for role, message in self._intake.feed.messages(self._bag, self._topics):
            self._hand_over(role, message)
            self._drain()
        self._intake.release_held()
        self._loop.sequencer.close()
        self._drain()

    def row(self, pair: Stamps, truth: TrueTrajectory | None) -> PairRow:
        result = self._results.get(pair)
        if isinstance(result, PairResult):
            return PairRow(pair, pair_record(result, truth), result.pose.reason)
        return PairRow(pair, None, self._reason(pair) if result is None else result)

    def _hand_over(self, role: Role, message: BagMessage) -> None:
        stamp = None
        try:
            if role is Role.IMAGE:
                self._on_image()
                stamp = stamp_ns(message.message.header)
                if stamp not in self._wanted:
                    self._loop.sequencer.pass_over(stamp)
                    return
                self._seen.add(stamp)
            self._intake.receive(role, message.message)
        except RsRelposeError as error:
            if role is Role.CAMERA_INFO:
                # Without intrinsics no pair can be estimated.
                raise type(error)(f'{message.topic}: {error}') from error
            if stamp is not None:
                self._problems[stamp] = str(error)

    def _drain(self) -> None:
        while (outcome := self._loop.step()) is not None:
            if isinstance(outcome, (FrameRefused, FrameFailed)):
                if outcome.stamp_ns is not None:
                    reason = (outcome.reason if isinstance(outcome, FrameRefused)
                              else str(outcome.error))
                    self._problems.setdefault(outcome.stamp_ns, reason)
            else:
                for pair in outcome.result or ():
                    self._results.setdefault(pair.stamps_ns, pair.result)

    def _reason(self, pair: Stamps) -> str:
        """Why a pair was not even estimated, in a sentence."""
        if pair[0] >= pair[1]:
            return (f'{LIST_COLUMNS[0]} must be before {LIST_COLUMNS[1]}: '
                    + ('give two different images' if pair[0] == pair[1] else 'exchange them'))
        for stamp in pair:
            if stamp not in self._seen:
                return f'no image on {self._topics.image.name} has the stamp {stamp}'
            if stamp in self._problems:
                return f'the image of {stamp} cannot be used: {self._problems[stamp]}'
        return 'the clock of the images jumped back between the two'
