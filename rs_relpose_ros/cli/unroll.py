"""``rs_relpose unroll``: a bag whose images look as if they came from a global shutter."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.bags.writer import refuse_existing
from rs_relpose_ros.cli.options import (
    add_bag_argument,
    add_parameter_arguments,
    add_topic_arguments,
    bag_name,
    need_sensor_parameters,
    progress_bar,
    topic_options,
)
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.global_shutter.unroll import unroll, UnrollReport

HELP = (
    'Turn every image of a bag (rosbag2 or ROS 1) by its gyro as if all rows had been seen at '
    'once, with the middle one, and write a bag (MCAP) for SLAM systems that know no rolling '
    'shutter: '
    'images and CameraInfo on the same topics, stamped with the instant of the middle row, on the '
    "IMU's clock (so that the time offset between camera and IMU is 0) unless the parameter "
    'stamp_clock is camera. All other topics are copied bit by bit. Images that the gyro does not '
    'cover are left out. Exit code 1: no image could be turned.')

_NO_IMAGE = 1

_logger = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_bag_argument(parser)
    parser.add_argument('out_bag', metavar='OUT_BAG', type=Path,
                        help='directory of the new bag; it must not exist, and does not before '
                        'the bag is whole')
    add_parameter_arguments(parser)
    add_topic_arguments(parser, 'image', 'camera_info', 'imu', 'accel')


def run(args: argparse.Namespace) -> int:
    """Unroll a bag; 1 when no image could be turned."""
    refuse_existing(args.out_bag)
    parameters = read_parameters(args.params, args.set, node='global_shutter_node')
    need_sensor_parameters(parameters, args)
    with open_bag(args.bag) as bag:
        topics = bag.find_topics(topic_options(args),
                                 needs_camera_info=not parameters.intrinsics.given)
        with progress_bar(topics.image.count, 'image', bag_name(args.bag)) as bar:
            report = unroll(bag, topics, parameters, args.out_bag, on_image=bar.update)
    for sentence in report.warnings:
        _logger.warning('%s', sentence)
    for reason, count in report.reasons.items():
        _logger.warning('left out, %d times: %s', count, reason)
    for line in _lines(report):
        print(line)
    if not report.images:
        return _NO_IMAGE
    print(f'in {args.out_bag}')
    return 0


def _lines(report: UnrollReport) -> list[str]:
    left_out = report.images_in_bag - report.images
    text = f'{report.images} of {report.images_in_bag} images turned'
    if left_out:
        text += f', {left_out} left out'
    if not report.images:
        return [text + '; nothing was written']
    return [text + f'; the largest shift of a pixel is {report.largest_shift:.1f} px',
            f'{report.copied} messages of {report.topics_copied} other topics copied']
