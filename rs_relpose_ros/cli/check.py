"""``rs_relpose check``: what a recording is good for, before anything is estimated from it."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
import shutil
import sys

from tqdm import tqdm

from rs_relpose_ros.bags.reader import open_bag, TopicOptions
from rs_relpose_ros.check.check import check_bag, choose_topics
from rs_relpose_ros.config.parameter_file import read_parameters

HELP = ('Look through a bag (rosbag2 or ROS 1) for whatever would spoil relative poses: topics, '
        'rates, gaps, stamps, clocks, encodings, calibration, units, axes, bias, transport, and '
        'how strong the rolling-shutter effect is. One line for each, with a verdict (ok, '
        'warning, failure) and the remedy. Exit code 1 where something would make the estimation '
        'fail.')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument('bag', metavar='BAG', type=Path,
                        help='rosbag2 directory, or a .mcap, .db3 or ROS 1 .bag file')
    parser.add_argument('--params', metavar='FILE', type=Path,
                        help='parameter file of the node: checked against the recording')
    parser.add_argument('--set', metavar='NAME=VALUE', action='append', default=[],
                        help='set a parameter, over the file; may be repeated')
    parser.add_argument('--json', action='store_true', help='print the report as JSON')
    for name, what in (('image', 'images'), ('camera-info', 'CameraInfo'),
                       ('imu', 'gyro, and accelerometer where it is not apart'),
                       ('accel', 'accelerometer, where it is apart')):
        parser.add_argument(f'--{name}-topic', metavar='TOPIC', default='',
                            help=f'topic of the {what}; found by its type when only one can be')


def run(args: argparse.Namespace) -> int:
    """Print the report; 1 where something would make the estimation fail."""
    options = TopicOptions(image=args.image_topic, camera_info=args.camera_info_topic,
                           imu=args.imu_topic, accel=args.accel_topic)
    parameters = read_parameters(args.params, args.set)
    with open_bag(args.bag) as bag:
        chosen = choose_topics(bag, options)
        with tqdm(total=sum(topic.count for topic in chosen.all), unit='message', leave=False,
                  desc=args.bag.resolve().name, disable=not sys.stderr.isatty()) as bar:
            report = check_bag(bag, chosen, parameters, on_message=bar.update)
    if args.json:
        print(json.dumps(report.to_mapping(), indent=2, allow_nan=False))
    else:
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else 100
        for line in report.lines(max(width, 60)):
            print(line)
    return 1 if report.failed else 0
