"""What several commands have in common: options, progress bars, the version."""

from __future__ import annotations

import argparse
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
import sys

from tqdm import tqdm

from rs_relpose_ros.bags.topics import TopicOptions
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import MissingInputError

# Role of a topic -> what it holds.
_ROLES = {
    'image': 'Image or CompressedImage',
    'camera_info': 'CameraInfo',
    'imu': 'Imu: gyro, and accelerometer where it is not apart',
    'accel': 'Imu of the accelerometer, where it is apart',
    'truth': "PoseStamped of the camera's true poses",
}


def add_bag_argument(parser: argparse.ArgumentParser) -> None:
    """Declare BAG, the recording that is read."""
    parser.add_argument('bag', metavar='BAG', type=Path,
                        help='rosbag2 directory, or a .mcap, .db3 or ROS 1 .bag file')


def add_parameter_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare --params and --set, the node's parameters."""
    parser.add_argument('--params', metavar='FILE', type=Path,
                        help="the node's parameter file (ROS format)")
    parser.add_argument('--set', metavar='NAME=VALUE', action='append', default=[],
                        help='set a parameter, after --params; may be repeated')


def add_topic_arguments(parser: argparse.ArgumentParser, *roles: str) -> None:
    """Declare --ROLE-topic for each role: a field of `TopicOptions`."""
    group = parser.add_argument_group(
        'topics', 'found by their types where only one can be meant')
    for role in roles:
        group.add_argument(f'--{role.replace("_", "-")}-topic', metavar='TOPIC', default='',
                           help=_ROLES[role])


def topic_options(args: argparse.Namespace) -> TopicOptions:
    """Topics that `add_topic_arguments` declared, as given."""
    return TopicOptions(**{name.removesuffix('_topic'): value for name, value in vars(args).items()
                           if name.endswith('_topic')})


def need_sensor_parameters(parameters: Parameters, args: argparse.Namespace) -> None:
    """Raise MissingInputError where one is missing that no message tells, and say how to give it.

    `args` have `bag` and what `add_parameter_arguments` declares.
    """
    missing = parameters.sensor.missing()
    if not missing:
        return
    beside = args.bag.resolve().with_name(f'{bag_name(args.bag)}.yaml')
    if args.params is None and beside.is_file():
        raise MissingInputError(f'parameter {" and ".join(missing)} must be given; use '
                                f'--params {beside}, which lies beside the bag')
    raise MissingInputError(
        f'parameter {" and ".join(missing)} must be given, by --params FILE or --set '
        f'{missing[0]}=...: see config/relpose.yaml')


def bag_name(bag: Path) -> str:
    """Name of a bag without its folder, and without the suffix where it is a file."""
    bag = bag.resolve()
    return bag.stem if bag.is_file() else bag.name


def progress_bar(total: int, unit: str, description: str | None = None) -> tqdm:
    """Return a bar that a terminal shows while work lasts; a pipe gets none."""
    return tqdm(total=total, unit=unit, desc=description, leave=False,
                disable=not sys.stderr.isatty())


def package_version() -> str:
    """Version of the installed package."""
    try:
        return version('rs_relpose_ros')
    except PackageNotFoundError:   # run from a source tree
        return 'not installed'
