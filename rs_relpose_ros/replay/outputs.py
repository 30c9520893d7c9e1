"""Runs a replay into a directory: tables while it runs, then the summary and the pictures."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rs_relpose_ros.bags.reader import Bag
from rs_relpose_ros.bags.topics import SensorTopics
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.health.findings import Health, NOT_JUDGED, worst_of
from rs_relpose_ros.messages.outgoing import pair_messages, PAIR_TOPICS
from rs_relpose_ros.replay.run import read_truth, Replay, ReplayedPair
from rs_relpose_ros.replay.summary import summarize
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

POSES_FILE, ERRORS_FILE = 'relative_poses.csv', 'errors.csv'
BAG_FOLDER = 'relpose_bag'
_PICTURES = ('matches.png', 'errors.png', 'residuals.png', 'rotation.png')


@dataclass(frozen=True, slots=True, eq=False)
class ReplayOutcome:
    """What a replay gave.

    `figures`: as in summary.json, without provenance; `health`: the worst that was found of each
    figure that was told; `intrinsics`: in force at the end; `files`: written so far (tables, bag
    and pictures).
    """

    records: list[PairRecord]
    intrinsics: Intrinsics | None
    figures: dict[str, Any]
    health: Health
    files: list[Path]


def replay_into(folder: Path, bag: Bag, topics: SensorTopics, parameters: Parameters, *,
                stamps: frozenset[int] | None = None, pictures: bool = True,
                with_bag: bool = False, on_image: Callable[[], object] = lambda: None,
                on_pair: Callable[[ReplayedPair], object] = lambda pair: None) -> ReplayOutcome:
    """Run `bag` through the pipeline and write tables, pictures and a bag into `folder`.

    Files of an earlier run in `folder` are replaced; it is created as needed. `stamps` and
    `on_image` are as of `Replay`; `with_bag`: whether to write the node's topics as a bag.
    `on_pair` is called with each pair, which carries images where `pictures` are drawn.
    """
    run = Replay(bag, topics, parameters, stamps=stamps, keep_images=pictures, on_image=on_image)
    truth = read_truth(bag, topics)
    if with_bag and (folder / BAG_FOLDER).exists():
        raise InputError(f'{folder / BAG_FOLDER} exists already: remove it or choose another '
                         'directory with --out')
    prepare_folder(folder, (POSES_FILE, ERRORS_FILE, SUMMARY_FILE, *_PICTURES))
    records: list[PairRecord] = []
    shown: PairResult | None = None
    last, health = None, NOT_JUDGED
    files = [folder / POSES_FILE]
    with ExitStack() as stack:
        write_pose = stack.enter_context(
            table_writer(folder / POSES_FILE, RELATIVE_POSE_COLUMNS))
        write_error = None
        if truth is not None:
            write_error = stack.enter_context(table_writer(folder / ERRORS_FILE, ERROR_COLUMNS))
            files.append(folder / ERRORS_FILE)
        out_bag = stack.enter_context(BagWriter(folder / BAG_FOLDER)) if with_bag else None
        for pair in run.pairs():
            record = pair_record(pair.result, truth)
            records.append(record)
            last, health = pair.result, worst_of(health, pair.result.health)
            write_pose(relative_pose_cells(record))
            if write_error is not None:
                write_error(error_cells(record))
            if out_bag is not None:
                _write_messages(out_bag, pair, parameters.pair.reference_frame)
            on_pair(pair)
            if pictures and (shown is None or _picture_rank(pair.result) > _picture_rank(shown)):
                shown = pair.result
    if with_bag:
        files.append(folder / BAG_FOLDER)
    if shown is not None:
        files += _draw(folder, records, shown, truth)
    return ReplayOutcome(records, run.intrinsics, summarize(records, run, last, health), health,
                         files)


def _write_messages(bag: BagWriter, pair: ReplayedPair, reference_frame: str) -> None:
    messages = pair_messages(pair.result, bag.type, reference_frame)
    for topic, message in messages.by_topic():
        bag.write(f'/relpose_node/{topic}', PAIR_TOPICS[topic], message, pair.bag_time_ns)


def _picture_rank(pair: PairResult) -> tuple[bool, float]:
    """Larger for the better picture: with a pose, many inliers and much parallax."""
    return bool(pair.pose), float(pair.pose.inliers.sum() * pair.parallax)


def _draw(folder: Path, records: list[PairRecord], shown: PairResult,
          truth: TrueTrajectory | None) -> list[Path]:
    # Matplotlib takes a second to import; not for those who want no pictures.
    from rs_relpose_ros.replay import pictures
    matches, errors, residuals, rotation = (folder / name for name in _PICTURES)
    pictures.draw_matches(shown, matches)
    pictures.draw_residuals(records, residuals)
    pictures.draw_rotation(records, rotation, truth)
    if truth is None:
        return [matches, residuals, rotation]
    pictures.draw_errors(records, errors)
    return [matches, errors, residuals, rotation]
