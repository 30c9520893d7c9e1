"""Command ``report``: one HTML page about a recording."""

import argparse
from dataclasses import replace
from pathlib import Path
import tempfile

from rs_relpose_ros.bags.files import is_bag, salvaged
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.cli import options
from rs_relpose_ros.cli.main import FAILED, package_version
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.output_files import refuse_unwritable, written
from rs_relpose_ros.report.page import page
from rs_relpose_ros.report.run import is_unusable, nothing_of, Observation, observe

# Description of the command.
HELP = (
    'Write one HTML page about a bag: streams over time (rates, delays, gaps, steps), gyro and '
    'accelerometer, rotation of the images against the gyro, residuals over the image, findings '
    'with remedies, calibration with sigmas, relative poses with their errors, frames with '
    'matches, and the metric path where gtsam is installed. The page is one file without scripts '
    'that loads nothing. The bag runs once through what check, replay and odometry do. A damaged '
    'bag gives a page of what can be read. Exit code 1: the page was written, and the bag is '
    'damaged, or the estimation fails on it or gives wrong poses as configured.'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    options.adding(
        {
            **options.BAG,
            **options.PARAMETERS,
            '--out': {
                'metavar': 'FILE',
                'type': Path,
                'help': 'page to write (default: BAGNAME_report.html in the current directory); '
                'an earlier one is replaced',
            },
            '--no-images': {
                'action': 'store_true',
                'help': 'leave out images, positions, and the names of files, topics and frames',
            },
            **options.SENSOR_TOPICS,
        }
    )(parser)


def report_of(args: argparse.Namespace) -> Observation:
    """Observe a bag, with a progress bar; of a damaged one, what can be read."""
    parameters = read_parameters(args.params, args.set)
    try:
        return _observed(args, args.bag, parameters)
    except InputError as error:
        if not is_bag(args.bag):
            raise
        damage = str(error)
    with tempfile.TemporaryDirectory(prefix='rs_relpose_report_') as folder:
        copy = salvaged(args.bag, Path(folder))
        if copy is None:
            return nothing_of(args.bag, parameters, damage)
        try:
            return replace(_observed(args, copy, parameters), bag=str(args.bag), damage=damage)
        except InputError as error:
            # Nothing that could be read is a recording.
            return nothing_of(args.bag, parameters, f'{damage}; of the rest: {error}')


def _observed(args: argparse.Namespace, path: Path, parameters: Parameters) -> Observation:
    with open_bag(path) as bag:
        chosen = bag.choose_topics(options.topic_options(args))
        total = 0 if chosen.image is None else chosen.image.count
        with options.progress_bar(total, 'image', options.bag_name(args.bag)) as bar:
            name = None if chosen.image is None else chosen.image.name
            bag.on_message = lambda topic: bar.update(topic == name)
            return observe(bag, chosen, parameters)


def run(args: argparse.Namespace) -> int:
    """Write the page; returns the exit code."""
    out = args.out or Path(f'{options.bag_name(args.bag)}_report.html')
    if out.is_dir():
        raise InputError(
            f'{out} is a directory: give the file to write, such as {out}/report.html'
        )
    refuse_unwritable(out.absolute().parent)
    observation = report_of(args)
    out.parent.mkdir(parents=True, exist_ok=True)
    with written(out) as file:
        file.write(page(observation, package_version(), images=not args.no_images))
    print(f'{out}: {out.stat().st_size / 1e6:.1f} MB')
    if observation.damage:
        print(f'the bag is damaged: {observation.damage}')
    return FAILED if is_unusable(observation) else 0
