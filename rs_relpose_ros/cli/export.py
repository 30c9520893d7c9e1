"""Command `export`: a recording for reconstruction and splatting."""

import argparse
import logging
from pathlib import Path

from rs_relpose_ros.bags.writer import refuse_existing
from rs_relpose_ros.cli import options
from rs_relpose_ros.cli.main import Command, FAILED
from rs_relpose_ros.cli.poses import rate_in_hertz, start_failure
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.odometry import export, need_gtsam
from rs_relpose_ros.odometry.formats import FORMATS, IMAGES
from rs_relpose_ros.odometry.rows import camera_poses, ROWS_FILE, RowTrajectory, write_tum
from rs_relpose_ros.output_files import beside, refuse_unwritable

TUM = 'tum'

_logger = logging.getLogger(__name__)


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_bag_argument(parser)
    parser.add_argument('out', metavar='OUT', type=Path,
                        help='directory to create (tum: the file)')
    parser.add_argument('--format', choices=(TUM, *FORMATS), required=True,
                        help='what reads the result (docs/reconstruction.md)')
    parser.add_argument('--rate', metavar='HZ', type=rate_in_hertz, default=0.0,
                        help='images, at most so many a second, or poses (tum); default: those of '
                        'the keyframes, in which points are observed')
    parser.add_argument('--images', choices=export.IMAGE_CHOICES, default='',
                        help='as recorded, derotated to their middle row, or none; default: '
                        'unrolled for colmap, which has one pose per image, else raw')
    parser.add_argument('--trajectory', metavar='DIR', type=Path,
                        help='results of `rs_relpose odometry` of this bag; default: it is run, '
                        'into OUT/odometry')
    parser.add_argument('--link', action='store_true',
                        help='keep raw images once in DIR/images of --trajectory and link them')
    parser.add_argument('--points', metavar='N', type=int, default=export.Options('').most_points,
                        help='at most so many points, the best ones (default: %(default)s)')
    options.add_parameter_arguments(parser)
    options.add_topic_arguments(parser, 'image', 'camera_info', 'imu', 'accel', 'truth')


def _check(args: argparse.Namespace) -> None:
    refuse_existing(args.out)
    refuse_unwritable(args.out.parent)
    if args.points < 0:
        raise InputError(f'--points must be at least 0, got {args.points}')
    if args.format == TUM and (args.images or args.link):
        raise InputError('--format tum has no images: leave out --images and --link')
    if args.link and args.trajectory is None:
        raise InputError('--link needs --trajectory DIR: the images of a bag are no files, so '
                         'they are kept in DIR/images')
    if args.link and (args.images or FORMATS[args.format].images) != export.RAW:
        raise InputError('--link is for raw images: use --images raw')


def _export(args: argparse.Namespace) -> int:
    _check(args)
    with beside(args.out) as part:
        trajectory = args.trajectory or part.with_name('odometry')
        if args.trajectory is None:
            need_gtsam()
            from rs_relpose_ros.odometry.offline import odometry_into
            _, outcome = options.run_on_bag(argparse.Namespace(
                **{**vars(args), 'out': trajectory}), 'odometry', odometry_into)
            for text in outcome.warnings:
                print(text)
            if not outcome.live:
                print(start_failure(outcome.blocking_reason))
                return FAILED
        if args.format == TUM:
            poses = camera_poses(RowTrajectory.load(trajectory / ROWS_FILE), args.rate)
            write_tum(part, poses)
            text = f'{len(poses)} poses of the camera'
        else:
            part.mkdir()
            _print_report(args, _with_images(args, part, trajectory))
            if args.trajectory is None:
                trajectory.rename(part / 'odometry')
            text = ', '.join(sorted(path.name for path in part.iterdir()))
        part.rename(args.out)
    print(f'in {args.out}: {text}')
    return 0


def _with_images(args: argparse.Namespace, part: Path, trajectory: Path) -> export.ExportReport:
    with options.opened(args, read_parameters(args.params, args.set)) as opened:
        return export.export_into(part, *opened, trajectory, export.Options(
            args.format, args.images, args.rate, args.points,
            trajectory / IMAGES if args.link else None))


def _print_report(args: argparse.Namespace, report: export.ExportReport) -> None:
    print(f'{report.images} images, {report.points} points in {report.observations} observations')
    if report.reprojection is None or report.formula is None:
        print('no points: no track over three keyframes with a pose and enough parallax')
    else:
        print(f'points in the images, at the poses of their rows: {report.reprojection.text}')
        print(f'{args.format} has {FORMATS[args.format].poses}: off that by {report.formula.text}')
    options.warn_unused(report.reasons(), f'left out (stamps in {export.REPORT_FILE})')
    for begin_ns, end_ns in report.gaps:
        _logger.warning('no poses from %d to %d ns on the clock of the IMU', begin_ns, end_ns)


EXPORT = Command(
    'Export a bag for reconstruction and splatting: images, cameras with the pose of each row or '
    'what the format has for it, and points, metric with z up. Poses are those of `rs_relpose '
    'odometry`, at the times of the rows: smoothed keyframes with the IMU between. Frames without '
    f'a pose are left out and listed in {export.REPORT_FILE}. Prints how far the points are from '
    'their pixels, and how far the interpolation of the format is from the trajectory. The '
    'directory appears when it is complete. Exit code 1: odometry did not start.', _add_arguments,
    _export)
