"""What the commands share: options, progress bar, version, and a run over a bag."""

import argparse
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
import logging
from pathlib import Path
import platform
import sys
from typing import Any, TypeVar

import cv2
import numba
import numpy as np
import scipy
from tqdm import tqdm

from rs_relpose_ros.bags.reader import Bag, open_bag
from rs_relpose_ros.bags.sensor_topics import SensorTopics, Topic
from rs_relpose_ros.cli.main import package_version
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.messages.transforms import with_extrinsics
from rs_relpose_ros.offline.replay import need_sensor_parameters
from rs_relpose_ros.output_files import json_text, refuse_unwritable, SUMMARY_FILE, written

_logger = logging.getLogger(__name__)

# What a run over a bag makes. Its attribute `metrics` is the content of summary.json without the
# provenance.
Made = TypeVar('Made', bound=Any)
# The work of a run: it gets the folder of the results, a bag, its topics, and the parameters.
Work = Callable[[Path, Bag, SensorTopics, Parameters], Made]

# Arguments of a command by name, with what `ArgumentParser.add_argument` takes.
Arguments = Mapping[str, Mapping[str, Any]]

# The bag that a command reads. [derived: interface]
BAG: Arguments = {
    'bag': {
        'metavar': 'BAG',
        'type': Path,
        'help': 'rosbag2 directory, or a .mcap, .db3 or ROS 1 .bag file',
    }
}
# The parameters of the node. [derived: interface]
PARAMETERS: Arguments = {
    '--params': {
        'metavar': 'FILE',
        'type': Path,
        'help': "the node's parameter file (ROS format)",
    },
    '--set': {
        'metavar': 'NAME=VALUE',
        'action': 'append',
        'default': [],
        'help': 'set a parameter, after --params; may be repeated',
    },
}
# A topic for each field of `SensorTopics`. The help shows them as a group of their own. [derived:
# interface]
TOPICS: Arguments = {
    f'--{role}-topic': {'metavar': 'TOPIC', 'default': '', 'help': text}
    for role, text in {
        'image': 'Image or CompressedImage',
        'camera-info': 'CameraInfo',
        'imu': 'Imu: gyro, and accelerometer unless it is separate',
        'accel': 'Imu of a separate accelerometer',
        'truth': 'PoseStamped: ground truth of the camera',
    }.items()
}
# The topics of a command that has no use for the ground truth. [derived: interface]
SENSOR_TOPICS = {name: values for name, values in TOPICS.items() if name != '--truth-topic'}


def out(suffix: str) -> Arguments:
    """Make the option --out, which is BAGNAME_`suffix` by default."""
    return {
        '--out': {
            'metavar': 'DIR',
            'type': Path,
            'help': f'directory of the results (default: '
            f'BAGNAME_{suffix} in the current one); those of an earlier run are replaced',
        }
    }


def of_run(suffix: str) -> Arguments:
    """Collect the arguments that `run_on_bag` uses."""
    return {**BAG, **PARAMETERS, **out(suffix), **TOPICS}


def adding(arguments: Arguments) -> Callable[[argparse.ArgumentParser], None]:
    """Make the function that adds these arguments to a parser."""

    def add(parser: argparse.ArgumentParser) -> None:
        group = None
        for name, values in arguments.items():
            if name not in TOPICS:
                parser.add_argument(name, **values)
                continue
            group = group or parser.add_argument_group(
                'topics', 'found by type where that is unambiguous'
            )
            group.add_argument(name, **values)

    return add


def run_on_bag(
    args: argparse.Namespace,
    suffix: str,
    work: Work[Made],
    calibration: Mapping[str, Any] | None = None,
) -> tuple[Path, Made]:
    """Run `work` and write summary.json; returns the folder and what the work made.

    `calibration` has parameters that hold where `args` give no others.
    """
    parameters = read_parameters(args.params, args.set)
    parameters = Parameters().updated({**(calibration or {}), **parameters.given()})
    folder = out_folder(args, suffix)
    refuse_unwritable(folder)
    with opened(args, parameters) as (bag, topics, parameters):
        results = work(folder, bag, topics, parameters)
    by_role = {one.name: getattr(topics, one.name) for one in fields(topics)}
    summary = {
        'bag': str(args.bag),
        'topics': {role: topic and topic.name for role, topic in by_role.items()},
        **results.metrics,
        'parameters': parameters.to_mapping(),
        'command': sys.argv,
        'versions': {
            'rs_relpose_ros': package_version(),
            'python': platform.python_version(),
            'numpy': np.__version__,
            'scipy': scipy.__version__,
            'opencv': cv2.__version__,
            'numba': numba.__version__,
        },
    }
    with written(folder / SUMMARY_FILE) as file:
        file.write(json_text(summary))
    return folder, results


def out_folder(args: argparse.Namespace, suffix: str) -> Path:
    """Folder of the results: the option `out`, or its default."""
    return args.out or Path(f'{bag_name(args.bag)}_{suffix}')


def warn_unused(reasons: Mapping[str, int], what: str = 'not used') -> None:
    """Log the reasons why frames and messages were not used, with their counts."""
    for reason, count in reasons.items():
        _logger.warning('%s, %d times: %s', what, count, reason)


def topic_options(args: argparse.Namespace) -> dict[str, str]:
    """Names of topics by role, from the options `TOPICS`."""
    return {
        name.removesuffix('_topic'): value
        for name, value in vars(args).items()
        if name.endswith('_topic')
    }


@contextmanager
def opened(
    args: argparse.Namespace, parameters: Parameters
) -> Iterator[tuple[Bag, SensorTopics, Parameters]]:
    """Open a bag: the bag, its topics, and `parameters` with the extrinsics of its transforms.

    `args` have `bag` and the options of topics and parameters. A progress bar counts the images.
    """
    with open_bag(args.bag) as bag:
        topics = bag.find_topics(
            topic_options(args), needs_camera_info=not parameters.intrinsics.given
        )
        bag.time_offset = parameters.sensor.time_offset
        parameters, contradiction = with_extrinsics(bag, topics, parameters)
        if contradiction:
            _logger.warning('%s', contradiction)
        neighbour = args.bag.resolve().with_name(f'{bag_name(args.bag)}.yaml')
        hint = ''
        if args.params is None and neighbour.is_file():
            hint = f'use --params {neighbour}, the file next to the bag'
        need_sensor_parameters(parameters, hint)
        with image_progress(bag, topics.image, bag_name(args.bag)):
            yield bag, topics, parameters


def bag_name(bag: Path) -> str:
    """Name of a bag without its folder, and without the suffix of a file."""
    bag = bag.resolve()
    return bag.stem if bag.is_file() else bag.name


def progress_bar(total: int, unit: str, description: str | None = None) -> tqdm:
    """Return a progress bar, invisible unless stderr is a terminal."""
    return tqdm(
        total=total, unit=unit, desc=description, leave=False, disable=not sys.stderr.isatty()
    )


def image_progress(bag: Bag, image: Topic, description: str) -> tqdm:
    """Return a progress bar over the images of a bag, which moves as they are read."""
    bar = progress_bar(image.count, 'image', description)
    bag.on_message = lambda topic: bar.update(topic == image.name)
    return bar
