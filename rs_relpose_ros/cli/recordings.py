"""Commands `calibrate`, `check`, `convert` and `unroll`: recordings before the estimation."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
import logging
from pathlib import Path
import shutil
import sys
from typing import Any, NamedTuple

from rs_relpose_ros.bags.convert import android, apple, FORMATS, phone, video
from rs_relpose_ros.bags.convert.euroc import read_euroc
from rs_relpose_ros.bags.convert.recording import Recording, write_bag
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.bags.sensor_topics import COMPRESSED_IMAGE
from rs_relpose_ros.calibrate import result as calibration
from rs_relpose_ros.calibrate.procedure import calibrate_together, calibrated
from rs_relpose_ros.calibrate.recording import CalibrationInput, read_recording
from rs_relpose_ros.cli import options
from rs_relpose_ros.cli.main import Command, FAILED, LABORATORY
from rs_relpose_ros.config import settings
from rs_relpose_ros.config.files import (
    parameter_text,
    read_calibration,
    read_parameters,
    SourcedValue,
    write_parameters,
)
from rs_relpose_ros.errors import InputError, library, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.lens import DISTORTION_MODELS
from rs_relpose_ros.messages.transforms import bag_frames, BagFrames, extrinsics
from rs_relpose_ros.offline.check import check_bag
from rs_relpose_ros.offline.check_report import CheckReport
from rs_relpose_ros.offline.unroll import unroll
from rs_relpose_ros.output_files import (
    json_text,
    prepare_folder,
    refuse_existing,
    refuse_unwritable,
    written,
)

# File of the calibrated parameters, in the folder of the results. [derived: interface]
CALIBRATION_FILE = 'calibration.yaml'
# All files of the command `calibrate`. [derived: interface]
_CALIBRATION_FILES = (CALIBRATION_FILE, 'calibration.json', 'cost_over_readout.png')

_logger = logging.getLogger(__name__)


def calibrate_bag(
    args: argparse.Namespace,
) -> tuple[calibration.CalibrationResult, RollingShutterCamera]:
    """Calibrate and write the files of the command."""
    tracking, config = _calibration_settings(args)
    folder = options.out_folder(args, 'calibration')
    refuse_unwritable(folder)
    read = [_recording(args, path, tracking) for path in (args.bag, *getattr(args, 'more', ()))]
    first = read[0]
    recording = first.recording
    frames = first.frames
    result, extra = _fitted(read, config)
    prepare_folder(folder, _CALIBRATION_FILES)
    names = ' '.join(one.path.name for one in read)
    text = calibration.parameter_file(
        result,
        f'Parameters of relpose_node from `rs_relpose calibrate {names}`.',
        camera=recording.camera,
        compressed=first.compressed,
        feature_rows=tuple(args.rows),
        placed=_extrinsics(result, frames),
    )
    mapping = calibration.as_mapping(result, recording.camera) | extra
    parameters, metrics, curve = (folder / name for name in _CALIBRATION_FILES)
    contents = {metrics: json_text(mapping, indent=1)}
    if not result.failure:  # else there is no value for use
        contents[parameters] = text
    for path, content in contents.items():
        with written(path) as file:
            file.write(content)
    calibration.draw_curve(result, curve)
    return result, recording.camera


class _Read(NamedTuple):
    """A bag that was read for a calibration."""

    path: Path
    recording: CalibrationInput
    frames: BagFrames
    compressed: bool  # whether its images are


def _fitted(
    read: Sequence[_Read], config: settings.CalibrationConfig
) -> tuple[calibration.CalibrationResult, dict[str, Any]]:
    """The calibration of all bags, and what the JSON file has of several bags besides."""
    frames = read[0].frames
    quat_prior = frames.imu_in_camera and frames.imu_in_camera[3:]
    recordings = [one.recording for one in read]
    with options.progress_bar(100, '%', 'fitting') as bar:

        def progress(share: float) -> None:
            bar.update(round(100 * share) - bar.n)

        if len(read) == 1:
            alone = calibrated(recordings[0], config, quat_prior=quat_prior, progress=progress)
            return alone, {}
        common = calibrate_together(recordings, config, quat_prior=quat_prior, progress=progress)
    of_bags = [
        {'bag': one.path.name, **calibration.as_mapping(own, one.recording.camera)}
        for one, own in zip(read, common.of_recordings, strict=True)
    ]
    return common.result, {'between_recordings': common.between, 'recordings': of_bags}


def _recording(args: argparse.Namespace, path: Path, tracking: settings.TrackingConfig) -> _Read:
    """Read a bag; InputError if the chosen rows are not in its images."""
    with open_bag(path) as bag:
        topics = bag.find_topics(options.topic_options(args), needs_camera_info=False)
        with options.image_progress(bag, topics.image, 'tracking'):
            recording = read_recording(bag, topics, tracking)
        frames = bag_frames(bag, topics)
    if args.lens is not None:
        recording = recording.with_unknown_lens(args.lens)
    first, last = args.rows
    if first >= recording.camera.height:
        raise InputError(
            f'--rows {first:g} {last:g} leave nothing of an image of '
            f'{recording.camera.height} rows: give the first and the last to use'
        )
    options.warn_unused(recording.unused)
    return _Read(path, recording, frames, topics.image.msgtype == COMPRESSED_IMAGE)


def _calibration_settings(
    args: argparse.Namespace,
) -> tuple[settings.TrackingConfig, settings.CalibrationConfig]:
    """Settings from the options; an InputError names the option in place of the setting."""
    try:
        tracking = settings.TrackingConfig(detector=args.detector, feature_rows=tuple(args.rows))
        config = replace(
            settings.TRACKED_IN_IMAGES,
            max_time_offset=args.max_offset or settings.CalibrationConfig().max_time_offset,
            search_overlap=args.max_offset is None,
            exposure_time=args.exposure_time,
            exposure_margin=args.exposure_margin,
        )
    except InputError as error:
        text = str(error).replace('feature_rows', '--rows')
        text = text.replace('max_time_offset', '--max-offset')
        raise InputError(text.replace('exposure_', '--exposure-')) from None
    return tracking, config


def _extrinsics(result: calibration.CalibrationResult, frames: BagFrames) -> dict[str, Any]:
    """Parameters from the transforms of a bag; a contradiction to the result is logged."""
    if frames.imu_in_camera is None:
        return {}
    calibrated = settings.Parameters.from_mapping(
        {
            'quat_cam_imu_xyzw': result.quat_cam_imu_xyzw,
            'axes_sigma': min(result.rotation.sigma, 1.0),
        }
    )
    values, contradiction = extrinsics(calibrated, frames.imu_in_camera, frames.camera, frames.imu)
    if contradiction:
        _logger.warning('%s', contradiction)
    return values


def _calibrate(args: argparse.Namespace) -> int:
    result, camera = calibrate_bag(args)
    for line in calibration.report(result, camera):
        print(line)
    names = _CALIBRATION_FILES[1:] if result.failure else _CALIBRATION_FILES
    print(f'in {options.out_folder(args, "calibration")}: {", ".join(names)}')
    return 0 if result.complete else FAILED


# Distortion model that --lens estimates if none is named. [derived: interface]
_USUAL_LENS = 'plumb_bob'

# The command `rs_relpose calibrate`. [derived: interface]
CALIBRATE = Command(
    'Calibrate a rolling-shutter camera against its IMU from a bag (rosbag2 or ROS 1) alone, '
    'without a target: readout time, camera-IMU time offset, rotation IMU to camera, gyro bias, '
    'and the lens (focal length, first distortion coefficient, principal point) if the CameraInfo '
    'has none (k[0] = 0) or is absent, or with --lens. Record at least '
    '10 s of a static, textured scene with a short exposure; rotate the camera about all three '
    'axes, 20 to 60 deg/s. Writes calibration.yaml (parameters of relpose_node), calibration.json '
    'and cost_over_readout.png. Exit code 1: a parameter is not observable in this recording and '
    'left out; the report describes the motion to record instead.',
    options.adding(
        {
            **options.BAG,
            'more': {
                'metavar': 'BAG',
                'nargs': '*',
                'type': Path,
                'help': 'further bags of the same camera: the values are those of all bags, their '
                'sigmas cover how the bags differ',
            },
            **options.out('calibration'),
            '--rows': {
                'metavar': ('FIRST', 'LAST'),
                'type': float,
                'nargs': 2,
                'default': (0.0, 0.0),
                'help': 'use only these image rows, such as those above a dashboard that moves '
                'with the camera',
            },
            '--detector': {
                'choices': tuple(settings.TRACKERS),
                'default': settings.TrackingConfig().detector,
                'help': 'tracker that follows the points, as the parameter of the node (default: '
                '%(default)s)',
            },
            '--max-offset': {
                'metavar': 'S',
                'type': float,
                'help': 'bound of the clock offset [s] (default: none; the whole overlap of '
                'images and gyro is searched)',
            },
            '--lens': {
                'metavar': 'MODEL',
                'choices': tuple(DISTORTION_MODELS),
                'nargs': '?',
                'const': _USUAL_LENS,
                'help': 'estimate focal length, radial coefficients of the '
                'distortion of this model (default: plumb_bob) and principal point, also if the '
                'CameraInfo has a camera matrix without distortion',
            },
            **{
                f'--exposure-{name}': {
                    'metavar': 'S',
                    'type': float,
                    'default': 0.0,
                    'help': f'{text}, if it is known',
                }
                for name, text in (
                    ('time', 'exposure of a row [s]'),
                    ('margin', 'frame interval less exposure [s]'),
                )
            },
            **{
                name: options.TOPICS[name]
                for name in ('--image-topic', '--camera-info-topic', '--imu-topic')
            },
        }
    ),
    _calibrate,
    {'--lens': (tuple(DISTORTION_MODELS), _USUAL_LENS)},
)


def inspect_bag(args: argparse.Namespace) -> CheckReport:
    """Check a bag, with a progress bar."""
    parameters = read_parameters(args.params, args.set)
    with open_bag(args.bag) as bag:
        chosen = bag.choose_topics(options.topic_options(args))
        found = [topic for topic in chosen if topic is not None]
        messages = sum(topic.count for topic in found)
        if parameters.sensor.missing() and chosen.image is not None:
            messages *= 2  # the bag is read twice
        with options.progress_bar(messages, 'message', options.bag_name(args.bag)) as bar:
            bag.on_message = lambda _: bar.update()
            return check_bag(bag, chosen, parameters)


def _check(args: argparse.Namespace) -> int:
    report = inspect_bag(args)
    if args.json:
        print(json_text(report.to_mapping()), end='')
    else:
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else 100
        for line in report.lines(max(width, 60)):
            print(line)
    return FAILED if report.failed else 0


# The command `rs_relpose check`. [derived: interface]
CHECK = Command(
    'Check a bag (rosbag2 or ROS 1) for defects that degrade relative poses: topics, rates, gaps, '
    'stamps, clocks, encodings, transport; and, by a test run of half a minute of it, axes, time '
    'offset, readout time, bias, units, focal length and lens. Prints a line for each, with a '
    'verdict (ok, unknown, warning, failure) and the suggested fix. Exit code 1: a defect makes '
    'the estimation fail or its poses wrong.',
    options.adding(
        {
            **options.BAG,
            **options.PARAMETERS,
            '--json': {'action': 'store_true', 'help': 'print the report as JSON'},
            **options.SENSOR_TOPICS,
        }
    ),
    _check,
)


class RecordingFormat(NamedTuple):
    """A format of recordings that `convert` reads."""

    help: str
    path: str  # 'FILE' or 'FOLDER'
    read: Callable[[Path, Path | None], Recording]  # reads a path, with a lens profile
    has_lens_profile: bool = False


def _of_laboratory(reader: str) -> Callable[[Path, Path | None], Recording]:
    """Find a reader of the laboratory by name, so that the product does not depend on it."""

    def read(folder: Path, _: Path | None) -> Recording:
        datasets = library('rs_relpose_lab.datasets', f'public recordings need {LABORATORY}')
        recording: Recording = getattr(datasets, reader)(folder)
        return recording

    return read


# Loggers of phones, as named in `FORMATS`, and their readers. [derived: interface]
PHONES: Mapping[str, phone.Reader] = {
    'PoseCam': android.read_posecam,
    'MARS Logger': android.read_mars,
    'OpenCamera Sensors': android.read_opencamera_sensors,
    'VideoIMUCapture': android.read_video_imu_capture,
    'Stray Scanner': apple.read_stray_scanner,
    'ios_logger': apple.read_ios_logger,
    'Sensor Logger': apple.read_sensor_logger,
    'tables': phone.read_tables,
}
# The logger of a phone is recognised by its files. [derived: `FORMATS`]
_PHONE = RecordingFormat(
    "folder of a phone's logger, recognised by its files: "
    + '; '.join(str(one) for one in FORMATS if one.name in PHONES),
    'FOLDER',
    lambda folder, _: phone.read_phone(folder, PHONES),
)

# Formats of recordings by the name that the user types. [derived: interface]
SOURCES: Mapping[str, RecordingFormat] = {
    'video': RecordingFormat(
        'video of a camera that logs its IMU: GoPro, and others that telemetry-parser reads '
        '(pip install telemetry-parser av). Recordings that the camera stabilised are refused.',
        'FILE',
        video.read_video,
        has_lens_profile=True,
    ),
    'phone': _PHONE,
    'android': _PHONE._replace(help='the same as phone'),
    'euroc': RecordingFormat(
        "folder in the format of EuRoC's MAV data set (mav0 with cam0, imu0, sensor.yaml); the "
        'camera may have a rolling shutter, as that of TUM RS-VI',
        'FOLDER',
        lambda folder, _: read_euroc(folder),
    ),
    'realsense_rgb_rs': RecordingFormat(
        'colour camera, gyro and accelerometer of a RealSense, from '
        'github.com/Zoltan3057/DM-VIO-dataset (imu.txt, frames.csv, camera.txt, images/)',
        'FOLDER',
        _of_laboratory('read_realsense'),
    ),
    'xiaomi_cc9_rs': RecordingFormat(
        'phone with gyro, from github.com/lhaippp/gyro-video-stabilization '
        '(gyro.txt, framestamp.txt, images/)',
        'FOLDER',
        _of_laboratory('read_xiaomi'),
    ),
}


def _add_convert_arguments(parser: argparse.ArgumentParser) -> None:
    sources = parser.add_subparsers(dest='source', metavar='SOURCE', required=True)
    for name, source in SOURCES.items():
        one = sources.add_parser(name, help=source.help, description=source.help)
        one.add_argument('path', metavar=source.path, type=Path, help='the recording')
        one.add_argument(
            'out_bag',
            metavar='OUT_BAG',
            type=Path,
            help='bag directory to create; OUT_BAG.yaml is written next to it',
        )
        if source.has_lens_profile:
            one.add_argument(
                '--lens-profile',
                metavar='PATH',
                type=Path,
                help="Gyroflow's profile of the camera's mode (JSON), or a folder of them, such "
                'as a checkout of github.com/gyroflow/lens_profiles: calibration of the lens, and '
                'an initial value of the readout time if the file does not contain it',
            )
        one.set_defaults(lens_profile=None)
    text = (
        'calibration file of another tool as parameters: Kalibr (camchain, imu), OpenVINS, '
        'ORB-SLAM3, sensor.yaml of EuRoC, ost.yaml of camera_calibration. --params accepts these '
        'files, too.'
    )
    calibration_parser = sources.add_parser('calibration', help=text, description=text)
    calibration_parser.add_argument('path', metavar='FILE', type=Path, help='the calibration')
    calibration_parser.add_argument(
        '--out',
        metavar='YAML',
        type=Path,
        help='parameter file to write; without it the parameters are printed',
    )


def _convert_calibration(path: Path, out: Path | None) -> int:
    if out is not None:
        refuse_existing(out)
        refuse_unwritable(out.parent)
    found = read_calibration(path)
    settings.Parameters().updated(found.values)  # InputError for values out of range
    title = f'Parameters of relpose_node from {path.name} (`rs_relpose convert calibration`).'
    source = f'{found.tool}.'
    values = [SourcedValue(name, value, source) for name, value in found.values.items()]
    if out is None:
        print(parameter_text(title, values), end='')
        return 0
    write_parameters(out, title, values)
    size = '' if found.size is None else f' for images of {found.size[0]}x{found.size[1]}'
    print(f'{out}: {found}{size}')
    if 'camera_matrix' in found.values:
        print('the readout time is not in this file: rs_relpose calibrate BAG measures it')
    return 0


def _convert(args: argparse.Namespace) -> int:
    if args.source == 'calibration':
        return _convert_calibration(args.path, args.out)
    parameters = args.out_bag.with_name(args.out_bag.name + '.yaml')
    refuse_existing(args.out_bag, parameters)
    refuse_unwritable(args.out_bag.parent)
    source = SOURCES[args.source]
    if source.path == 'FOLDER' and not args.path.is_dir():
        raise MissingInputError(f'there is no folder {args.path}')
    recording = source.read(args.path, args.lens_profile)
    with options.progress_bar(len(recording.images), 'image', args.out_bag.name) as bar:
        write_bag(recording, args.out_bag, on_image=bar.update)
    write_parameters(parameters, recording.title, recording.parameters)
    size = sum(file.stat().st_size for file in args.out_bag.iterdir())
    samples = len(recording.cropped(recording.imu)) + len(recording.cropped(recording.accel))
    poses = f', {len(recording.truth)} true poses' if recording.truth else ''
    print(
        f'{args.out_bag}: {len(recording.images)} images, {samples} IMU samples{poses}, '
        f'{size / 1e6:.1f} MB; parameters of the node: {parameters}'
    )
    if 'readout_time' not in {value.name for value in recording.parameters}:
        print(f'the readout time is unknown: rs_relpose calibrate {args.out_bag}')
    return 0


# The command `rs_relpose convert`. [derived: interface]
CONVERT = Command(
    'Convert a recording to a rosbag2 directory (MCAP) with /camera/image_raw/compressed, '
    '/imu/data_raw (or /imu/gyro and /imu/accel if they have separate stamps), '
    '/camera/camera_info if the camera is calibrated, and /ground_truth/pose if the recording '
    'contains poses; and write OUT_BAG.yaml next to it: the parameters of relpose_node, each with '
    'its source. Stamps and JPEG images are copied unchanged. "rs_relpose convert SOURCE --help" '
    'describes a source.',
    _add_convert_arguments,
    _convert,
)


def _unroll(args: argparse.Namespace) -> int:
    refuse_existing(args.out_bag)
    refuse_unwritable(args.out_bag.parent)
    parameters = read_parameters(args.params, args.set, node='global_shutter_node')
    with options.opened(args, parameters) as opened:
        report = unroll(*opened, args.out_bag)
    for line in report.warnings:
        _logger.warning('%s', line)
    options.warn_unused(report.reasons.most_common(), 'omitted')
    omitted = report.images_in_bag - report.images
    text = f'{report.images} of {report.images_in_bag} images derotated'
    if omitted:
        text += f', {omitted} omitted'
    if not report.images:
        print(f'{text}; nothing was written')
        return FAILED
    print(f'{text}; the largest displacement of a pixel is {report.largest_shift:.1f} px')
    print(f'{report.copied} messages of {report.topics_copied} other topics copied')
    print(f'in {args.out_bag}')
    return 0


# The command `rs_relpose unroll`. [derived: interface]
UNROLL = Command(
    'Derotate every image of a bag (rosbag2 or ROS 1) by its gyro to the time of its middle row, '
    'and write a bag (MCAP) for SLAM systems without a model of the rolling shutter: images and '
    "CameraInfo on the same topics, stamped with the time of the middle row on the IMU's clock "
    "(the time offset between camera and IMU is then 0), or on the camera's if the parameter "
    'stamp_clock is camera. All other topics are copied bit by bit. Images that the gyro does not '
    'cover are omitted. Exit code 1: no image could be derotated.',
    options.adding(
        {
            **options.BAG,
            'out_bag': {
                'metavar': 'OUT_BAG',
                'type': Path,
                'help': 'directory of the new bag; it must not '
                'exist, and appears when the bag is complete',
            },
            **options.PARAMETERS,
            **options.SENSOR_TOPICS,
        }
    ),
    _unroll,
)
