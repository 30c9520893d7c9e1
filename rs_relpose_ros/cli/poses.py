"""Commands `replay`, `pairs`, `odometry` and `export`: poses from a bag into a folder."""

import argparse
from collections import Counter
from collections.abc import Mapping
from functools import partial
import logging
from pathlib import Path
from typing import Any

from rs_relpose_ros.bags.reader import Bag
from rs_relpose_ros.bags.sensor_topics import option_of, SensorTopics
from rs_relpose_ros.cli import options
from rs_relpose_ros.cli.main import Command, FAILED, make_parser
from rs_relpose_ros.config.files import file_values, read_parameters
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.odometry import export, need_gtsam
from rs_relpose_ros.odometry.formats import FORMATS, IMAGES
from rs_relpose_ros.odometry.rows import camera_poses, ROWS_FILE, RowTrajectory, write_tum
from rs_relpose_ros.offline import replay
from rs_relpose_ros.offline.tables import POSES
from rs_relpose_ros.output_files import beside, refuse_existing, refuse_unwritable, SUMMARY_FILE

# Name of the export format that has poses alone. [derived: interface]
TUM = 'tum'

# Reasons for missing poses that are printed; a longer list would hide the lines after it.
# [chosen: any value in 3..10 would do]
_MOST_REASONS = 5

_logger = logging.getLogger(__name__)


def replay_bag(args: argparse.Namespace) -> tuple[Path, replay.ReplayOutcome]:
    """Replay, and write the files of the command into the folder that is returned."""
    stamps = None if args.stamps is None else replay.read_stamps(args.stamps)
    work = partial(
        replay.replay_into,
        stamps=stamps,
        pictures=not args.no_pictures,
        with_bag=args.with_bag,
    )
    calibration = _calibration(args) if args.calibrate else {}
    return options.run_on_bag(args, 'relpose', work, calibration)


def _calibration(args: argparse.Namespace) -> dict[str, Any]:
    """Calibrate from the bag of `args`; returns the parameters.

    InputError if the bag does not determine one of them.
    """
    from rs_relpose_ros.cli.recordings import calibrate_bag, CALIBRATION_FILE

    folder = options.out_folder(args, 'relpose') / 'calibration'
    words = ['calibrate', str(args.bag), '--out', str(folder)]
    for role, topic in options.topic_options(args).items():
        if topic and role in ('image', 'camera_info', 'imu'):
            words += [option_of(role), topic]
    arguments = make_parser('calibrate').parse_args(words)
    result, _ = calibrate_bag(arguments)
    if not result.complete:
        unknown = [part for part in result.needed if not part.determined]
        reasons = dict.fromkeys(part.remark for part in unknown)
        raise InputError(f'the bag does not determine its calibration: {"; ".join(reasons)}')
    return file_values(folder / CALIBRATION_FILE)


def _replay(args: argparse.Namespace) -> int:
    folder, outcome = replay_bag(args)
    metrics = outcome.metrics
    options.warn_unused(metrics['not_used'])
    _print_replay(outcome)
    _print_files(folder, outcome)
    good = metrics['pairs']['answered'] and metrics['health']['state'] != 'wrong'
    return 0 if good else FAILED


def _print_files(folder: Path, outcome: replay.ReplayOutcome) -> None:
    names = [path.name for path in outcome.files]
    print(f'in {folder}: {", ".join([*names, SUMMARY_FILE])}')


def _print_replay(outcome: replay.ReplayOutcome) -> None:
    metrics = outcome.metrics
    pairs = metrics['pairs']
    frames = metrics['frames']
    refused = sum(frames['refused'].values()) + frames['failed']
    without = f', {refused} refused' if refused else ''
    time = _text(metrics['timing']['processing_per_frame_ms'], 'ms per image')
    print(f'{frames["processed"]} of {frames["in_bag"]} images processed{without} ({time})')
    by_status = ''.join(
        f', {count} {status}'
        for status, count in pairs['by_status'].items()
        if count and status != 'OK'
    )
    print(f'{pairs["total"]} pairs, {pairs["answered"]} with a pose{by_status}')
    if not pairs['total']:
        print(
            'no keyframe pair: the bag is shorter than a keyframe interval, or too few frames '
            'could be used'
        )
    elif not pairs['answered']:
        # The reason of suppressed poses follows with the findings.
        poses = [record.pose for record in outcome.records]
        reasons = {pose.reason for pose in poses if pose.status.value != 'WITHHELD'}
        for reason in sorted(reasons)[:_MOST_REASONS]:
            print(f'no pose: {reason}')
    _print_errors(metrics['errors_against_truth'])
    if pairs['answered']:
        _print_medians(metrics)
    print(*outcome.health_lines(), sep='\n')


def _print_medians(metrics: Mapping[str, Any]) -> None:
    medians = metrics['medians']
    print(
        f'medians: {_text(medians["inliers"], "inliers")}, residual '
        f'{_text(medians["residual_rms_px"], "px")}, rotation against the gyro '
        f'{_text(medians["rotation_difference_to_gyro_deg"], "deg")}'
    )
    baselines = metrics['baselines']
    known = baselines['known']
    text = f'baseline in metres: of {known} of {metrics["pairs"]["answered"]} poses'
    if known:
        text += f', with a median sigma of {100.0 * baselines["log_sigma_median"]:.0f} %'
    print(text)
    for reason, count in baselines['not_known'].items():
        print(f'{reason} ({count} poses)')


def _print_errors(errors: Mapping[str, float] | None) -> None:
    if errors:
        print(
            f'against the ground truth (median, 90 %): rotation '
            f'{errors["rotation_median_deg"]:.3g}, {errors["rotation_p90_deg"]:.3g} deg; '
            f'direction of translation {errors["translation_median_deg"]:.3g}, '
            f'{errors["translation_p90_deg"]:.3g} deg'
        )


def _text(value: Any, unit: str) -> str:
    return f'no {unit}' if value is None else f'{value:.3g} {unit}'


# The command `rs_relpose replay`. [derived: interface]
REPLAY = Command(
    'Estimate relative poses from a bag (rosbag2 with SQLite3 or MCAP, compressed or not, or ROS '
    '1) with the pipeline of relpose_node. Topics are found by type where that is unambiguous. '
    'Writes relative_poses.csv, summary.json and pictures, and errors.csv if the bag contains '
    "ground truth of the camera (geometry_msgs/PoseStamped of the optical frame, IMU's clock). "
    'Translations are unit vectors. Reports configured parameters (axes, time_offset, ...) that '
    'contradict images and IMU. Exit code 1: the bag was processed, but no pair has a pose, or '
    'one of these parameters is wrong.',
    options.adding(
        {
            **options.of_run('relpose'),
            '--stamps': {
                'metavar': 'FILE',
                'type': Path,
                'help': 'use only the frames whose stamps [ns] are in FILE, one per line, as the '
                'parameter stamps_file of a live node wrote them: the poses are then equal to its '
                'poses, bit by bit',
            },
            '--calibrate': {
                'action': 'store_true',
                'help': 'first calibrate from the bag into OUT/calibration, '
                'as `rs_relpose calibrate` does; parameters that are given stay',
            },
            '--no-pictures': {'action': 'store_true', 'help': 'tables and summary only'},
            '--bag': {
                'dest': 'with_bag',
                'action': 'store_true',
                'help': "write the node's topics as an MCAP bag, too",
            },
        }
    ),
    _replay,
)


def _pairs(args: argparse.Namespace) -> int:
    pairs = replay.read_pairs(args.list)

    def work(
        folder: Path, bag: Bag, topics: SensorTopics, parameters: Parameters
    ) -> replay.ReplayOutcome:
        if args.list.resolve() == (folder / POSES.file).resolve():
            raise InputError(
                f'the results would replace the list {args.list}: choose another '
                'directory with --out'
            )
        return replay.pairs_into(folder, bag, topics, parameters, pairs)

    folder, outcome = options.run_on_bag(args, 'pairs', work)
    counts = outcome.metrics['pairs']
    print(f'{counts["total"]} pairs, {counts["answered"]} with a pose')
    reasons = Counter(record.pose.reason for record in outcome.records if not record.pose)
    for reason, count in reasons.most_common(_MOST_REASONS):
        print(f'no pose, {count} times: {reason}')
    if len(reasons) > _MOST_REASONS:
        print(f'{len(reasons) - _MOST_REASONS} more reasons: column reason of {POSES.file}')
    _print_errors(outcome.metrics['errors_against_truth'])
    _print_files(folder, outcome)
    return 0 if counts['answered'] else FAILED


# The command `rs_relpose pairs`. [derived: interface]
PAIRS = Command(
    "Estimate the relative poses of chosen pairs of a bag's images, any distance apart: loop "
    'closures, wide baselines. Images are matched by descriptors (SIFT, or ORB with --set '
    'detector=orb). The list is a CSV file with the columns reference_stamp_ns (of the earlier '
    'image) and stamp_ns; a relative_poses.csv of replay is one. Writes relative_poses.csv with '
    'a row for each row of the list, in its order: the columns of replay and the reason of a pair '
    'without a pose; summary.json; and errors.csv if the bag contains ground truth of the camera. '
    'The configured parameters are used as they are: run check or replay first. Exit code 1: no '
    'pair has a pose.',
    options.adding(
        {
            **options.of_run('pairs'),
            '--list': {
                'metavar': 'FILE',
                'type': Path,
                'required': True,
                'help': 'the pairs (CSV): stamps of their images [ns]',
            },
        }
    ),
    _pairs,
)


def rate_in_hertz(text: str) -> float:
    """Convert the text of an option."""
    rate = float(text)
    if not 1e-3 <= rate <= 1e5:
        raise argparse.ArgumentTypeError(f'must be from 0.001 to 100000 Hz, got {text}')
    return rate


def _odometry_of(args: argparse.Namespace, **how: Any) -> tuple[Path, Any]:
    """Run the odometry; prints its warnings, and why it did not start."""
    need_gtsam()
    from rs_relpose_ros.odometry.offline import odometry_into

    folder, outcome = options.run_on_bag(args, 'odometry', partial(odometry_into, **how))
    for text in outcome.warnings:
        print(text)
    if not outcome.live:
        print(
            'odometry did not start:',
            outcome.blocking_reason
            or 'it needs some seconds of motion, or standstill, and informative pairs',
        )
    return folder, outcome


def _odometry(args: argparse.Namespace) -> int:
    folder, outcome = _odometry_of(args, rate=args.rate, loops=args.loops)
    from rs_relpose_ros.odometry import map_points, offline, rows

    metrics = outcome.metrics
    pairs = metrics['pairs']
    print(
        f'{metrics["keyframes"]} keyframes of {pairs["pairs"]} pairs over '
        f'{metrics["length_m"]:.1f} m'
        + (f', {pairs["contradicting"]} pairs rejected' if pairs['contradicting'] else '')
        + (f', lost {len(metrics["lost"])} times' if metrics['lost'] else '')
    )
    if metrics['health'] in ('suspect', 'wrong'):
        print(f'health: {metrics["health"]}: "rs_relpose replay" reports the parameter')
    if loops := metrics['loops']:
        print(
            f'loops: {loops["offered"]} offered, {loops["related"]} related, {loops["taken"]} '
            f'taken; keyframes shift by {loops["shift_m"]:.3f} m (rms), at most '
            f'{loops["largest_shift_m"]:.3f} m; from the end to the start '
            f'{loops["end_to_start_without_m"]:.3f} m without, {loops["end_to_start_m"]:.3f} m '
            'with loops'
        )
    for trajectory in ('live', 'smoothed'):
        if errors := metrics[trajectory]:
            print(
                f'{trajectory}, against the ground truth: ATE {errors["ate_m"]:.3f} m over '
                f'{errors["length_m"]:.1f} m, scale {100.0 * errors["scale_error"]:+.2f} %'
            )
    if not outcome.live:
        return FAILED
    if outcome.unsolved:
        print(f'no smoothed path: {outcome.unsolved} of its graphs could not be solved')
        return FAILED
    print(
        f'in {folder}: {offline.LIVE_FILE}, {offline.SMOOTHED_FILE}, {offline.STATES_FILE}, '
        f'{rows.ROWS_FILE}, {map_points.TRACKS_FILE}, {offline.PICTURE}, {SUMMARY_FILE}'
    )
    return 0


# The command `rs_relpose odometry`. [derived: interface]
ODOMETRY = Command(
    'Metric odometry from a bag: the relative poses of its keyframe pairs and its IMU in one '
    'graph (gtsam, an extra), as in odometry_node. Writes trajectory.tum (live estimates of the '
    "camera, z up, stamped with the image's middle row on the camera's clock), "
    'trajectory_smoothed.tum (estimates from all data), odometry.csv (every state as published '
    'live, with velocity and covariance), trajectory_rows.npz (poses at any time, RowTrajectory '
    'in Python), tracks.npz (for export), summary.json and a picture; with errors, NEES and the '
    'share of states beyond 99.7 % if the bag contains ground truth of the camera. The parameter '
    'imu_position should be configured. Exit code 1: odometry did not start, or a graph could not '
    'be solved.',
    options.adding(
        {
            **options.of_run('odometry'),
            '--loops': {
                'action': 'store_true',
                'help': 'add loop closures to the smoothed path: keyframes '
                'far apart in time with a common view, related as by `rs_relpose pairs`',
            },
            '--rate': {
                'metavar': 'HZ',
                'type': rate_in_hertz,
                'default': 0.0,
                'help': 'also write trajectory_rows.tum: smoothed poses at this rate',
            },
        }
    ),
    _odometry,
)


def _export(args: argparse.Namespace) -> int:
    refuse_existing(args.out)
    refuse_unwritable(args.out.parent)
    if args.points < 0:
        raise InputError(f'--points must be at least 0, got {args.points}')
    if args.format == TUM and (args.images or args.link):
        raise InputError('--format tum has no images: leave out --images and --link')
    if args.link and args.trajectory is None:
        raise InputError(
            '--link needs --trajectory DIR: the images of a bag are no files, so '
            'they are kept in DIR/images'
        )
    if args.link and (args.images or FORMATS[args.format].images) != export.RAW:
        raise InputError('--link is for raw images: use --images raw')
    with beside(args.out) as part:
        trajectory = args.trajectory or part.with_name('odometry')
        if args.trajectory is None:
            _, outcome = _odometry_of(argparse.Namespace(**vars(args) | {'out': trajectory}))
            if not outcome.live:
                return FAILED
        if args.format == TUM:
            poses = camera_poses(RowTrajectory.load(trajectory / ROWS_FILE), args.rate)
            write_tum(part, poses)
            text = f'{len(poses)} poses of the camera'
        else:
            part.mkdir()
            with options.opened(args, read_parameters(args.params, args.set)) as opened:
                choice = export.Choice(
                    args.format,
                    args.images,
                    args.rate,
                    args.points,
                    trajectory / IMAGES if args.link else None,
                )
                report = export.export_into(part, *opened, trajectory, choice)
            _print_report(args, report)
            if args.trajectory is None:
                trajectory.rename(part / 'odometry')
            text = ', '.join(sorted(path.name for path in part.iterdir()))
        part.rename(args.out)
    print(f'in {args.out}: {text}')
    return 0


def _print_report(args: argparse.Namespace, report: dict[str, Any]) -> None:
    print('{images} images, {points} points in {observations} observations'.format(**report))
    if report['formula_px'] is None:
        print('no points: no track over three keyframes with a pose and enough parallax')
    else:
        reprojection, formula = (
            'mean {mean:.2f} px, median {median:.2f}, 95 % {most:.2f}, largest '
            '{largest:.2f}'.format(**report[name])
            for name in ('reprojection_px', 'formula_px')
        )
        print(f'points in the images, at the poses of their rows: {reprojection}')
        print(f'{args.format} has {FORMATS[args.format].poses}: off that by {formula}')
    for reason, count in Counter(one['reason'] for one in report['left_out']).most_common():
        _logger.warning(
            '%d images are left out (stamps in %s): %s', count, export.REPORT_FILE, reason
        )
    for begin_ns, end_ns in report['trajectory_gaps_ns']:
        _logger.warning('no poses from %d to %d ns on the clock of the IMU', begin_ns, end_ns)


# The command `rs_relpose export`. [derived: interface]
EXPORT = Command(
    'Export a bag for reconstruction and splatting: images, cameras with the pose of each row or '
    'what the format has for it, and points, metric with z up. Poses are those of `rs_relpose '
    'odometry`, at the times of the rows: smoothed keyframes with the IMU between. Frames without '
    f'a pose are left out and listed in {export.REPORT_FILE}. Prints how far the points are from '
    'their pixels, and how far the interpolation of the format is from the trajectory. The '
    'directory appears when it is complete. Exit code 1: odometry did not start.',
    options.adding(
        {
            **options.BAG,
            'out': {'metavar': 'OUT', 'type': Path, 'help': 'directory to create (tum: the file)'},
            '--format': {
                'choices': (TUM, *FORMATS),
                'required': True,
                'help': 'what reads the result (docs/reconstruction.md)',
            },
            '--rate': {
                'metavar': 'HZ',
                'type': rate_in_hertz,
                'default': 0.0,
                'help': 'images, at most so many a second, or poses (tum); default: those of the '
                'keyframes, in which points are observed',
            },
            '--images': {
                'choices': export.IMAGE_CHOICES,
                'default': '',
                'help': 'as recorded, derotated to '
                'their middle row, or none; default: unrolled for colmap, which has one pose per '
                'image, else raw',
            },
            '--trajectory': {
                'metavar': 'DIR',
                'type': Path,
                'help': 'results of `rs_relpose odometry` of this '
                'bag; default: it is run, into OUT/odometry',
            },
            '--link': {
                'action': 'store_true',
                'help': 'keep raw images once in DIR/images of --trajectory and link them',
            },
            '--points': {
                'metavar': 'N',
                'type': int,
                'default': export.MOST_POINTS,
                'help': 'at most so many points, the best ones (default: %(default)s)',
            },
            **options.PARAMETERS,
            **options.TOPICS,
        }
    ),
    _export,
)
