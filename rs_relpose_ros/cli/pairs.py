"""``rs_relpose pairs``: relative poses of chosen pairs of a bag's images."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from rs_relpose_ros.bags.reader import Bag
from rs_relpose_ros.bags.topics import SensorTopics
from rs_relpose_ros.cli.bag_run import add_run_arguments, errors_line, run_on_bag
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.replay.outputs import POSES_FILE
from rs_relpose_ros.replay.pairs import pairs_into, PairsOutcome, read_pairs
from rs_relpose_ros.result_files import SUMMARY_FILE

HELP = (
    "Estimate the relative poses of chosen pairs of a bag's images, however far apart: loop "
    'closures, wide baselines. Images are matched by descriptors (SIFT, or ORB with --set '
    'detector=orb). The list is a CSV file with the columns reference_stamp_ns (of the earlier '
    'image) and stamp_ns; a relative_poses.csv of replay is one. Writes relative_poses.csv with '
    'a row for each of the list, in its order: the columns of replay and, without a pose, the '
    "reason; summary.json; and errors.csv where the bag has the camera's true poses. What was "
    'told of camera and IMU is believed: look with check or replay first. Exit code 1: no pair '
    'got a pose.')

_NO_POSE = 1
_MOST_REASONS = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_run_arguments(parser, 'pairs')
    parser.add_argument('--list', metavar='FILE', type=Path, required=True,
                        help='the pairs (CSV): stamps of their images [ns]')


def run(args: argparse.Namespace) -> int:
    """Poses of the listed pairs; 1 when none has one."""
    pairs = read_pairs(args.list)

    def work(folder: Path, bag: Bag, topics: SensorTopics, parameters: Parameters,
             on_image: Callable[[], object]) -> PairsOutcome:
        if args.list.resolve() == (folder / POSES_FILE).resolve():
            raise InputError(f'the results would replace the list {args.list}: choose another '
                             'directory with --out')
        return pairs_into(folder, bag, topics, parameters, pairs, on_image=on_image)

    folder, outcome = run_on_bag(args, 'pairs', work)
    counts, errors = (outcome.figures[name] for name in ('pairs', 'errors_against_truth'))
    print(f'{counts["total"]} pairs, {counts["answered"]} with a pose')
    reasons = Counter(row.reason for row in outcome.rows if row.reason)
    for reason, count in reasons.most_common(_MOST_REASONS):
        print(f'no pose, {count} times: {reason}')
    if len(reasons) > _MOST_REASONS:
        print(f'{len(reasons) - _MOST_REASONS} more reasons: column reason of {POSES_FILE}')
    if errors:
        print(errors_line(errors))
    print(f'in {folder}: {", ".join([*outcome.files, SUMMARY_FILE])}')
    return 0 if counts['answered'] else _NO_POSE
