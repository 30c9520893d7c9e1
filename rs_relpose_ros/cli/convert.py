"""``rs_relpose convert``: a public recording as a bag."""

from __future__ import annotations

import argparse
from pathlib import Path

from rs_relpose_ros.bags.writer import refuse_existing
from rs_relpose_ros.cli.options import progress_bar
from rs_relpose_ros.config.parameter_file import write_parameters
from rs_relpose_ros.convert import realsense, xiaomi
from rs_relpose_ros.convert.recording import Recording, write_bag
from rs_relpose_ros.errors import MissingInputError

HELP = ('Turn a public recording into a rosbag2 directory (MCAP) with the topics '
        '/camera/image_raw/compressed, /camera/camera_info and /imu/data_raw, and write '
        'OUT_BAG.yaml beside it: the parameters of relpose_node, each with its source. Stamps and '
        'JPEG images stay as recorded; the IMU keeps its own axes. realsense_rgb_rs: colour '
        'camera, gyro and accelerometer of a RealSense, from github.com/Zoltan3057/DM-VIO-dataset '
        '(imu.txt, frames.csv, camera.txt, images/). xiaomi_cc9_rs: phone with gyro, from '
        'github.com/lhaippp/gyro-video-stabilization (gyro.txt, framestamp.txt, images/).')


# Source -> module: how its recordings are read, and what the node must know of them.
DATASETS = {'realsense_rgb_rs': realsense, 'xiaomi_cc9_rs': xiaomi}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument('dataset', choices=DATASETS, help='source of the recording')
    parser.add_argument('folder', metavar='FOLDER', type=Path, help='folder of the recording')
    parser.add_argument('out_bag', metavar='OUT_BAG', type=Path,
                        help='bag directory to create; OUT_BAG.yaml is written beside it')


def run(args: argparse.Namespace) -> int:
    """Write the bag and its parameter file."""
    dataset = DATASETS[args.dataset]
    folder: Path = args.folder
    parameters = args.out_bag.with_name(args.out_bag.name + '.yaml')
    if not folder.is_dir():
        raise MissingInputError(f'there is no folder {folder}')
    refuse_existing(args.out_bag, parameters)
    recording: Recording = dataset.read_recording(folder)
    with progress_bar(len(recording.images), 'image', args.out_bag.name) as bar:
        write_bag(recording, args.out_bag, on_image=bar.update)
    write_parameters(parameters, dataset.TITLE, dataset.PARAMETERS)
    size = sum(file.stat().st_size for file in args.out_bag.iterdir())
    print(f'{args.out_bag}: {len(recording.images)} images, {len(recording.cropped_imu())} IMU '
          f'samples, {size / 1e6:.1f} MB; parameters of the node: {parameters}')
    return 0
