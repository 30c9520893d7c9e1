"""``rs_relpose odometry``: a metric path from a bag."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
import sys
from typing import Any

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.cli.options import (
    add_bag_argument,
    add_parameter_arguments,
    add_topic_arguments,
    bag_name,
    need_sensor_parameters,
    package_version,
    progress_bar,
    topic_options,
)
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.odometry.library import need_gtsam
from rs_relpose_ros.replay.summary import write_summary

HELP = (
    'Metric odometry from a bag: the relative poses of its keyframe pairs and its IMU in one '
    'graph (gtsam, an extra), as odometry_node does it live. Writes trajectory.tum (live '
    'estimates of the camera, z up, image stamps), trajectory_smoothed.tum (each with all that '
    "came later), summary.json and a picture; with errors where the bag has the camera's true "
    'poses. The parameter imu_position should be told. Exit code 1: odometry did not start.')

SUMMARY_FILE = 'summary.json'
_NOT_STARTED = 1

_logger = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_bag_argument(parser)
    add_parameter_arguments(parser)
    parser.add_argument('--out', metavar='DIR', type=Path,
                        help='directory of the results (default: BAGNAME_odometry in the current '
                        'one); those of an earlier run are replaced')
    add_topic_arguments(parser, 'image', 'camera_info', 'imu', 'accel', 'truth')


def run(args: argparse.Namespace) -> int:
    """Odometry of a bag; 1 where it did not start."""
    need_gtsam()
    from rs_relpose_ros.odometry.offline import LIVE_FILE, odometry_into, PICTURE, SMOOTHED_FILE
    parameters = read_parameters(args.params, args.set)
    name = bag_name(args.bag)
    folder = args.out or Path(f'{name}_odometry')
    with open_bag(args.bag) as bag:
        topics = bag.find_topics(topic_options(args),
                                 needs_camera_info=not parameters.intrinsics.given)
        need_sensor_parameters(parameters, args)
        with progress_bar(topics.image.count, 'image', name) as bar:
            outcome = odometry_into(folder, bag, topics, parameters, on_image=bar.update)
    write_summary(folder / SUMMARY_FILE, outcome.figures, bag=args.bag, topics=topics,
                  parameters=parameters, command=sys.argv, package_version=package_version())
    for sentence in outcome.sentences:
        print(sentence)
    figures = outcome.figures
    pairs = figures['pairs']
    print(f'{figures["keyframes"]} keyframes of {pairs["pairs"]} pairs over '
          f'{figures["length_m"]:.1f} m'
          + (f', {pairs["contradicting"]} pairs left out' if pairs['contradicting'] else '')
          + (f', lost {figures["lost"]} times' if figures['lost'] else ''))
    for trajectory in ('live', 'smoothed'):
        if figures[trajectory]:
            print(f'{trajectory}, against the truth: {_errors(figures[trajectory])}')
    if not outcome.live:
        print('odometry did not start: it needs some seconds of motion, or standing still, and '
              'pairs that tell more than nothing')
        return _NOT_STARTED
    print(f'in {folder}: {LIVE_FILE}, {SMOOTHED_FILE}, {PICTURE}, {SUMMARY_FILE}')
    return 0


def _errors(errors: dict[str, Any]) -> str:
    return (f'ATE {errors["ate_m"]:.3f} m over {errors["length_m"]:.1f} m, scale '
            f'{100.0 * errors["scale_error"]:+.2f} %')
