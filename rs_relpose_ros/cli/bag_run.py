"""What `replay`, `pairs` and `odometry` have in common: a bag's results, into a folder."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
import sys
from typing import Any, Protocol, TypeVar

from rs_relpose_ros.bags.reader import Bag, open_bag
from rs_relpose_ros.bags.topics import SensorTopics
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
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.replay.summary import write_summary
from rs_relpose_ros.result_files import SUMMARY_FILE


class Results(Protocol):
    """What came of a bag; `figures`: for summary.json."""

    @property
    def figures(self) -> dict[str, Any]:
        """As in summary.json, without provenance."""


Made = TypeVar('Made', bound=Results)
# Of a folder, a bag, its topics, the parameters, and what is to be called with each image.
Work = Callable[[Path, Bag, SensorTopics, Parameters, Callable[[], object]], Made]


def add_run_arguments(parser: argparse.ArgumentParser, name: str) -> None:
    """Declare bag, parameters, topics and --out, which is BAGNAME_`name` by default."""
    add_bag_argument(parser)
    add_parameter_arguments(parser)
    parser.add_argument('--out', metavar='DIR', type=Path,
                        help=f'directory of the results (default: BAGNAME_{name} in the current '
                        'one); those of an earlier run are replaced')
    add_topic_arguments(parser, 'image', 'camera_info', 'imu', 'accel', 'truth')


def run_on_bag(args: argparse.Namespace, name: str, work: Work[Made]) -> tuple[Path, Made]:
    """Do the work, and write the summary beside its files; the folder, and what came of it."""
    parameters = read_parameters(args.params, args.set)
    bag_title = bag_name(args.bag)
    folder = args.out or Path(f'{bag_title}_{name}')
    with open_bag(args.bag) as bag:
        topics = bag.find_topics(topic_options(args),
                                 needs_camera_info=not parameters.intrinsics.given)
        need_sensor_parameters(parameters, args)
        with progress_bar(topics.image.count, 'image', bag_title) as bar:
            results = work(folder, bag, topics, parameters, bar.update)
    write_summary(folder / SUMMARY_FILE, results.figures, bag=args.bag, topics=topics,
                  parameters=parameters, command=sys.argv, package_version=package_version())
    return folder, results


def errors_line(errors: Mapping[str, float]) -> str:
    """Errors of pairs against the truth, as in summary.json, in a line."""
    return (f'against the truth (median, 90 %): rotation {errors["rotation_median_deg"]:.3g}, '
            f'{errors["rotation_p90_deg"]:.3g} deg; direction of translation '
            f'{errors["translation_median_deg"]:.3g}, {errors["translation_p90_deg"]:.3g} deg')
