"""``rs_relpose simulate``: render a recording of a known motion into a bag."""

import argparse
import dataclasses
import math
from pathlib import Path

from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.bag import write_bag, write_parameters
from rs_relpose_ros.cli.options import progress_bar
from rs_relpose_ros.config.settings import Declared, declared
from rs_relpose_ros.output_files import refuse_existing

# Summary for the list of commands.
HELP = (
    'Render true rolling-shutter images (every row at its own time) of a textured scene '
    'along a hand-held-like walk, with IMU and ground truth, into a rosbag2 directory (MCAP) '
    'with the topics /camera/image_raw/compressed, /camera/camera_info, /imu/data_raw and '
    '/ground_truth/pose. Writes OUT_BAG.yaml as well: the parameters of relpose_node for this '
    'bag. The same arguments give the same bag.'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments; one option per setting of the simulation."""
    parser.add_argument(
        'out_bag',
        metavar='OUT_BAG',
        type=Path,
        help='bag directory to create; OUT_BAG.yaml is written next to it',
    )
    parser.add_argument(
        '--raw', action='store_true', help='raw images on /camera/image_raw instead of JPEG'
    )
    parser.add_argument(
        '--jpeg-quality',
        type=int,
        default=88,
        metavar='Q',
        help='quality of the JPEG images, 1 to 100 (default: 88)',
    )
    group = parser.add_argument_group('recording')
    for field in dataclasses.fields(SimulationConfig):
        declaration = declared(field)
        option = '--' + field.name.replace('_', '-')
        if declaration.kind is tuple:
            group.add_argument(
                option,
                type=float,
                nargs=declaration.length,
                metavar='X',
                default=field.default,
                help=_help(declaration, field.default),
            )
        else:
            group.add_argument(
                option,
                type=declaration.kind,
                default=field.default,
                choices=declaration.choices or None,
                metavar=None if declaration.choices else 'X',
                help=_help(declaration, field.default),
            )


def _help(declaration: Declared, default: object) -> str:
    shown = ' '.join(map(str, default)) if isinstance(default, tuple) else str(default)
    legal = ''
    if math.isfinite(declaration.low) and not declaration.choices:
        legal = f'; {declaration.legal}'
    # A percent sign would be a format to argparse.
    return f'{declaration.description}{legal} (default: {shown or "none"})'.replace('%', '%%')


def configuration(args: argparse.Namespace) -> SimulationConfig:
    """Configuration that the arguments describe."""
    return SimulationConfig(
        **{field.name: getattr(args, field.name) for field in dataclasses.fields(SimulationConfig)}
    )


def run(args: argparse.Namespace) -> int:
    """Write the bag and its parameter file."""
    config = configuration(args)
    parameters = args.out_bag.with_name(args.out_bag.name + '.yaml')
    # Checked before the scene is made, which takes seconds.
    refuse_existing(args.out_bag, parameters)
    simulation = simulate(config)
    with progress_bar(config.frame_count, 'frame', args.out_bag.name) as bar:
        write_bag(
            simulation,
            args.out_bag,
            jpeg_quality=args.jpeg_quality,
            raw=args.raw,
            on_frame=bar.update,
        )
    write_parameters(simulation, parameters, raw=args.raw)
    size = sum(file.stat().st_size for file in args.out_bag.iterdir())
    print(
        f'{args.out_bag}: {config.frame_count} images, {len(simulation.imu.stamps_ns)} IMU '
        f'samples, {size / 1e6:.1f} MB; parameters of the node: {parameters}'
    )
    return 0
