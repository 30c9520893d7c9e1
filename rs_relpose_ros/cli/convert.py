"""``rs_relpose convert``: a recording of a camera or phone as a bag."""

from __future__ import annotations

import argparse
from pathlib import Path

from rs_relpose_ros.bags.writer import refuse_existing
from rs_relpose_ros.cli.options import progress_bar
from rs_relpose_ros.config.parameter_file import write_parameters
from rs_relpose_ros.convert.recording import write_bag
from rs_relpose_ros.convert.sources import SOURCES
from rs_relpose_ros.result_files import refuse_unwritable

HELP = ('Turn a recording into a rosbag2 directory (MCAP) with /camera/image_raw/compressed, '
        '/imu/data_raw (or /imu/gyro and /imu/accel, where they are stamped apart), '
        '/camera/camera_info where the camera is calibrated, and /ground_truth/pose where poses '
        'came with it; and write OUT_BAG.yaml beside it: the parameters of relpose_node, each '
        'with its source. Stamps and JPEG images stay as recorded. "rs_relpose convert SOURCE '
        '--help" describes a source.')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    sources = parser.add_subparsers(dest='source', metavar='SOURCE', required=True)
    for name, source in SOURCES.items():
        one = sources.add_parser(name, help=source.help, description=source.help)
        one.add_argument('path', metavar=source.path, type=Path, help='the recording')
        one.add_argument('out_bag', metavar='OUT_BAG', type=Path,
                         help='bag directory to create; OUT_BAG.yaml is written beside it')
        if source.takes_lens_profile:
            one.add_argument(
                '--lens-profile', metavar='PATH', type=Path,
                help="Gyroflow's profile of the camera's mode (JSON), or a folder of them, such "
                'as a checkout of github.com/gyroflow/lens_profiles: calibration of the lens, and '
                'a guess of the read-out time where the file does not tell it')
        one.set_defaults(lens_profile=None)


def run(args: argparse.Namespace) -> int:
    """Write the bag and its parameter file."""
    parameters = args.out_bag.with_name(args.out_bag.name + '.yaml')
    refuse_existing(args.out_bag, parameters)
    refuse_unwritable(args.out_bag.parent)
    conversion = SOURCES[args.source].conversion(args.path, args.lens_profile)
    recording = conversion.recording
    with progress_bar(len(recording.images), 'image', args.out_bag.name) as bar:
        write_bag(recording, args.out_bag, on_image=bar.update)
    write_parameters(parameters, conversion.title, conversion.parameters)
    size = sum(file.stat().st_size for file in args.out_bag.iterdir())
    samples = len(recording.cropped_imu()) + len(recording.cropped_accel())
    print(f'{args.out_bag}: {len(recording.images)} images, {samples} IMU samples'
          + (f', {len(recording.truth)} true poses' if recording.truth else '')
          + f', {size / 1e6:.1f} MB; parameters of the node: {parameters}')
    if 'readout_time' not in {value.name for value in conversion.parameters}:
        print(f'the read-out time is not known: rs_relpose calibrate {args.out_bag}')
    return 0
