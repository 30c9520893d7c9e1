"""``rs_relpose check``: what a recording is good for, before anything is estimated from it."""

from __future__ import annotations

import argparse
import json
import shutil
import sys

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.check.check import check_bag, choose_topics
from rs_relpose_ros.cli.options import (
    add_bag_argument,
    add_parameter_arguments,
    add_topic_arguments,
    bag_name,
    progress_bar,
    topic_options,
)
from rs_relpose_ros.config.parameter_file import read_parameters

HELP = ('Look through a bag (rosbag2 or ROS 1) for whatever would spoil relative poses: topics, '
        'rates, gaps, stamps, clocks, encodings, transport, and, from half a minute of it run '
        'through the front end, axes, time offset, read-out, bias, units, focal length and '
        'lens. One line for each, with a verdict (ok, unknown, warning, failure) and the remedy. '
        'Exit code 1 where something would make the estimation fail or its poses wrong.')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_bag_argument(parser)
    add_parameter_arguments(parser)
    parser.add_argument('--json', action='store_true', help='print the report as JSON')
    add_topic_arguments(parser, 'image', 'camera_info', 'imu', 'accel')


def run(args: argparse.Namespace) -> int:
    """Print the report; 1 where something would make the estimation fail."""
    parameters = read_parameters(args.params, args.set)
    with open_bag(args.bag) as bag:
        chosen = choose_topics(bag, topic_options(args))
        messages = sum(topic.count for topic in chosen.all)
        if parameters.sensor.missing() and chosen.image is not None:
            messages += chosen.image.count   # read twice
        with progress_bar(messages, 'message', bag_name(args.bag)) as bar:
            report = check_bag(bag, chosen, parameters, on_message=bar.update)
    if args.json:
        print(json.dumps(report.to_mapping(), indent=2, allow_nan=False))
    else:
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else 100
        for line in report.lines(max(width, 60)):
            print(line)
    return 1 if report.failed else 0
