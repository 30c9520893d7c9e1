"""``rs_relpose pairs``: relative poses of chosen pairs of a bag's images."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.cli.bag_run import add_run_arguments
from rs_relpose_ros.cli.options import (
    bag_name,
    need_sensor_parameters,
    progress_bar,
    topic_options,
)
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.replay.outputs import ERRORS_FILE, POSES_FILE
from rs_relpose_ros.replay.pairs import estimate_pairs, PAIR_COLUMNS, PairRow, read_pairs
from rs_relpose_ros.replay.run import read_truth
from rs_relpose_ros.replay.tables import error_cells, ERROR_COLUMNS, table_writer
from rs_relpose_ros.replay.truth import median_and_p90

HELP = (
    "Estimate the relative poses of chosen pairs of a bag's images, however far apart: loop "
    'closures, wide baselines. Images are matched by descriptors (SIFT, or ORB with --set '
    'detector=orb). The list is a CSV file with the columns reference_stamp_ns (of the earlier '
    'image) and stamp_ns; a relative_poses.csv of replay is one. Writes relative_poses.csv with '
    'a row for each of the list, in its order: the columns of replay and, without a pose, the '
    "reason; and errors.csv where the bag has the camera's true poses. What was told of camera "
    'and IMU is believed: look with check or replay first. Exit code 1: no pair got a pose.')

_NO_POSE = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_run_arguments(parser, 'pairs')
    parser.add_argument('--list', metavar='FILE', type=Path, required=True,
                        help='the pairs (CSV): stamps of their images [ns]')


def run(args: argparse.Namespace) -> int:
    """Poses of the listed pairs; 1 when none has one."""
    parameters = read_parameters(args.params, args.set)
    pairs = read_pairs(args.list)
    name = bag_name(args.bag)
    folder = args.out or Path(f'{name}_pairs')
    if folder.exists() and not folder.is_dir():
        raise InputError(f'{folder} is a file: choose another directory with --out')
    with open_bag(args.bag) as bag:
        topics = bag.find_topics(topic_options(args),
                                 needs_camera_info=not parameters.intrinsics.given)
        need_sensor_parameters(parameters, args)
        truth = read_truth(bag, topics)
        with progress_bar(topics.image.count, 'image', name) as bar:
            rows = estimate_pairs(bag, topics, parameters, pairs, truth=truth,
                                  on_image=bar.update)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / ERRORS_FILE).unlink(missing_ok=True)
    with table_writer(folder / POSES_FILE, PAIR_COLUMNS) as write:
        for row in rows:
            write(row.cells())
    if truth is not None:
        with table_writer(folder / ERRORS_FILE, ERROR_COLUMNS) as write:
            for row in rows:
                if row.record is not None:
                    write(error_cells(row.record))
    for line in _report(rows):
        print(line)
    print(f'in {folder}: {POSES_FILE}' + ('' if truth is None else f', {ERRORS_FILE}'))
    return 0 if any(not row.reason for row in rows) else _NO_POSE


def _report(rows: list[PairRow]) -> list[str]:
    """The outcome in some lines."""
    answered = [row.record for row in rows if row.record is not None and row.record.pose]
    lines = [f'{len(rows)} pairs, {len(answered)} with a pose']
    reasons = Counter(row.reason for row in rows if row.reason)
    lines += [f'no pose, {count} times: {reason}' for reason, count in reasons.most_common(5)]
    errors = [record.errors for record in answered if record.errors is not None]
    if errors:
        rotation = median_and_p90([error.rotation_error for error in errors])
        translation = median_and_p90([error.translation_error for error in errors])
        lines.append(
            'against the truth (median, 90 %): rotation '
            f'{rotation[0]:.3g}, {rotation[1]:.3g} deg; direction of translation '
            f'{translation[0]:.3g}, {translation[1]:.3g} deg')
    return lines
