"""``rs_relpose calibrate``: read-out time, clock offset, axes and bias from a bag."""

from __future__ import annotations

import argparse
from dataclasses import replace
import json
import logging
from pathlib import Path

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.bags.topics import COMPRESSED_IMAGE
from rs_relpose_ros.calibrate.bag_streams import read_recording
from rs_relpose_ros.calibrate.procedure import calibrate
from rs_relpose_ros.calibrate.report import as_mapping, draw_curve, parameter_file, report
from rs_relpose_ros.cli.options import (
    add_bag_argument,
    add_topic_arguments,
    bag_name,
    progress_bar,
    topic_options,
)
from rs_relpose_ros.config.calibration import CalibrationConfig, TRACKED_IN_IMAGES
from rs_relpose_ros.config.tracking import TRACKERS, TrackingConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.result_files import prepare_folder, refuse_unwritable

HELP = (
    'Calibrate a rolling-shutter camera against its IMU from a bag (rosbag2 or ROS 1) alone, '
    'without a target: read-out time, camera-IMU time offset, rotation IMU to camera, gyro bias, '
    'and the focal length where the CameraInfo has none (k[0] = 0) or is absent. Record 10 s or '
    'more of a textured scene that stands still, with a short exposure, while you turn the camera '
    'about all three axes, 20 to 60 deg/s. Writes calibration.yaml (parameters of relpose_node), '
    'calibration.json and cost_over_readout.png. Exit code 1: something is not observable in this '
    'recording; it says what to record instead.')

_NOT_OBSERVABLE = 1
_FILES = ('calibration.yaml', 'calibration.json', 'cost_over_readout.png')

_logger = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_bag_argument(parser)
    parser.add_argument('--out', metavar='DIR', type=Path,
                        help='directory of the results (default: BAGNAME_calibration in the '
                        'current one); those of an earlier run are replaced')
    parser.add_argument('--rows', metavar=('FIRST', 'LAST'), type=float, nargs=2,
                        default=(0.0, 0.0), help='use only these image rows, such as those above '
                        'a dashboard that moves with the camera')
    parser.add_argument('--detector', choices=tuple(TRACKERS), default=TrackingConfig().detector,
                        help='tracker that follows the points, as the parameter of the node '
                        '(default: %(default)s)')
    parser.add_argument('--max-offset', metavar='S', type=float,
                        default=CalibrationConfig().max_time_offset,
                        help='largest clock offset that is searched for [s] (default: '
                        '%(default)s)')
    add_topic_arguments(parser, 'image', 'camera_info', 'imu')


def run(args: argparse.Namespace) -> int:
    """Calibrate; 1 when something could not be told."""
    try:
        tracking = TrackingConfig(detector=args.detector, feature_rows=tuple(args.rows))
        config = replace(TRACKED_IN_IMAGES, max_time_offset=args.max_offset)
    except InputError as error:   # which names the settings behind the options
        raise InputError(str(error).replace('feature_rows', '--rows').replace(
            'max_time_offset', '--max-offset')) from None
    folder: Path = args.out or Path(f'{bag_name(args.bag)}_calibration')
    refuse_unwritable(folder)
    with open_bag(args.bag) as bag:
        topics = bag.find_topics(topic_options(args), needs_camera_info=False)
        with progress_bar(topics.image.count, 'image', 'tracking') as bar:
            recording = read_recording(bag, topics, tracking, on_image=bar.update)
    first, last = args.rows
    if first >= recording.camera.height:
        raise InputError(f'--rows {first:g} {last:g} leave nothing of an image of '
                         f'{recording.camera.height} rows: give the first and the last to use')
    for reason, count in recording.unused.items():
        _logger.warning('not used, %d times: %s', count, reason)
    with progress_bar(100, '%', 'fitting') as bar:
        result = calibrate(recording.tracks, recording.gyro, recording.camera,
                           focal_known=recording.focal_known, config=config,
                           progress=lambda share: bar.update(round(100 * share) - bar.n))
    prepare_folder(folder, _FILES)
    text = parameter_file(
        result, f'Parameters of relpose_node from `rs_relpose calibrate {args.bag.name}`.',
        camera=recording.camera, compressed=topics.image.msgtype == COMPRESSED_IMAGE,
        feature_rows=tuple(args.rows))
    parameters, figures, curve = (folder / name for name in _FILES)
    parameters.write_text(text, encoding='utf-8')
    figures.write_text(
        json.dumps(as_mapping(result, recording.camera), indent=1) + '\n', encoding='utf-8')
    draw_curve(result, curve)
    for line in report(result, recording.camera):
        print(line)
    print(f'in {folder}: {", ".join(_FILES)}')
    return 0 if result.observable else _NOT_OBSERVABLE
