"""Relative poses of the pairs of a list, a row each."""

from collections.abc import Sequence
import csv
from pathlib import Path

from rs_relpose_ros.bags.convert import check_file, Row
from rs_relpose_ros.bags.reader import Bag, SensorTopics
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.messages.incoming import Intake, sensor_messages
from rs_relpose_ros.offline import replay, tables
from rs_relpose_ros.offline.tables import ERRORS, PairRecord, POSES
from rs_relpose_ros.output_files import prepare_folder, SUMMARY_FILE
from rs_relpose_ros.pipeline.chosen_pairs import ChosenPairs, Stamps
from rs_relpose_ros.pipeline.findings import NOT_EVALUATED
from rs_relpose_ros.pipeline.pair import Frame, PairResult
from rs_relpose_ros.pipeline.pipeline import FrameLoop
from rs_relpose_ros.pipeline.warm_up import warm_up

# Columns of the list, those of the tables of `replay`: these are valid lists.
LIST_COLUMNS = POSES.columns[:2]
# The table of `replay`, and the reason of a pair without a pose.
CHOSEN_POSES = tables.Table(POSES.file, (*POSES.columns, 'reason'), lambda record: [
    *(POSES.row(record) or ()), record.pose.reason])


def read_pairs(path: Path) -> list[Stamps]:
    """Stamps [ns] of the earlier and of the later image of each pair in a list (CSV)."""
    with check_file(path).open(newline='', encoding='utf-8-sig', errors='replace') as file:
        rows = csv.DictReader(file)
        places = (Row(path, rows.line_num, row) for row in rows)
        pairs = [(row.nanoseconds(LIST_COLUMNS[0]), row.nanoseconds(LIST_COLUMNS[1]))
                 for row in places]
    if not pairs:
        raise InputError(f'{path} has no pairs below a line with the column names '
                         f'{" and ".join(LIST_COLUMNS)}')
    return pairs


def pairs_into(folder: Path, bag: Bag, topics: SensorTopics, parameters: Parameters,
               pairs: Sequence[Stamps]) -> replay.ReplayOutcome:
    """Write a row for each of the pairs, in their order, into tables in `folder`.

    Those of an earlier run are replaced.
    """
    prepare_folder(folder, (POSES.file, ERRORS.file, SUMMARY_FILE))
    truth = replay.read_truth(bag, topics)
    results, intrinsics = related(bag, topics, parameters, pairs)
    records = [
        PairRecord.of(result, truth) if isinstance(result, PairResult)
        else PairRecord(*pair, RelativePose(status=Status.BAD_INPUT, reason=result))
        for pair, result in zip(pairs, results, strict=True)]
    written = (CHOSEN_POSES,) if truth is None else (CHOSEN_POSES, ERRORS)
    with tables.table_writer(folder, written) as write:
        for record in records:
            write(record)
    metrics = {'pairs': replay.pair_counts(records),
               'errors_against_truth': tables.errors_against_truth(
                   [record for record in records if record.pose])}
    return replay.ReplayOutcome(records, metrics, NOT_EVALUATED,
                                [folder / table.file for table in written], intrinsics)


def related(bag: Bag, topics: SensorTopics, parameters: Parameters,
            pairs: Sequence[Stamps]) -> tuple[list[PairResult | str], Intrinsics | None]:
    """Results of the pairs, or the reasons why they were not estimated; active intrinsics."""
    warm_up(parameters.estimator)
    wanted = [pair for pair in pairs if pair[0] < pair[1]]
    loop = FrameLoop(parameters, ChosenPairs(wanted), offline=True)
    intake = Intake(loop.sequencer, parameters, {stamp for pair in wanted for stamp in pair})
    results: dict[Stamps, PairResult | str] = {}
    problems: dict[int, str] = {}
    for outcome in replay.outcomes(loop, intake, sensor_messages(bag, topics)):
        if isinstance(outcome, Frame):
            # The first result of a pair, if images are repeated.
            results = {**(outcome.result or {}), **results}
        elif isinstance(outcome, replay.MessageRefused):
            outcome.raise_without_intrinsics()
        elif outcome.stamp_ns is not None:
            problems.setdefault(outcome.stamp_ns, outcome.reason)

    def reason(first: int, second: int) -> str:
        if first >= second:
            return (f'{LIST_COLUMNS[0]} must be before {LIST_COLUMNS[1]}: '
                    + ('give two different images' if first == second else 'exchange them'))
        for stamp in (first, second):
            if stamp not in intake.stamps_found:
                return f'no image on {topics.image.name} has the stamp {stamp}'
            if stamp in problems:
                return f'the image of {stamp} cannot be used: {problems[stamp]}'
        return 'the clock of the images jumped back between the two'

    return [results[pair] if pair in results else reason(*pair)
            for pair in pairs], intake.intrinsics
