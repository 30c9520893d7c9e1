"""Recordings with images for `rs_relpose benchmark trust`: real ones, and simulated bags."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.trust_rows import Told
from rs_relpose_lab.experiments.trust_runs import (
    Arrival,
    intrinsics_of,
    RECORDING,
    Recording,
    Source,
)
from rs_relpose_ros.bags.layout import IMAGE_DELAY
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.convert import phone_tables, realsense, xiaomi
from rs_relpose_ros.convert.recording import by_stamp
from rs_relpose_ros.convert.recording import Recording as RecordedFiles
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.front_end.frame import sensor_camera
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.messages.incoming import PublishedImage, TruePose
from rs_relpose_ros.messages.sensor_feed import Role, SensorFeed
from rs_relpose_ros.replay.truth import TrueTrajectory

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

# What the folder's README says of the phone: it comes without a calibration.
_PHONE: Mapping[str, Any] = {
    'readout_time': 0.031, 'time_offset': -0.053, 'quat_cam_imu_xyzw': (0.7071, -0.7071, 0.0, 0.0)}
_PHONE_CAMERA = RollingShutterCamera(width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5,
                                     readout_time=0.031)


def _phone(folder: Path) -> RecordedFiles:
    """Gyro and accelerometer, which have a table each, in one series."""
    found = phone_tables.read_conversion(folder).recording
    return replace(found, camera=_PHONE_CAMERA, imu=by_stamp(found.imu + found.accel), accel=())


def _told_by(module: Any) -> dict[str, Any]:
    return {value.name: value.value for value in module.PARAMETERS}


# Folder of a recording -> how it is read, and what is right of it.
REAL: Mapping[str, tuple[Callable[[Path], RecordedFiles], Callable[[], Mapping[str, Any]]]] = {
    'realsense_rgb_rs': (realsense.read_recording, lambda: _told_by(realsense)),
    'realsense_rgb_rs_b': (realsense.read_recording,
                           lambda: {**_told_by(realsense), 'time_offset': -0.064}),
    'xiaomi_cc9_rs': (xiaomi.read_recording, lambda: _told_by(xiaomi)),
    'android_phone_rs': (_phone, lambda: _PHONE),
}


def recording_at(path: Path) -> Recording:
    """A bag with its parameter file beside it, ``BAG.yaml``, or the folder of one of `REAL`."""
    parameter_file = path.with_name(path.name + '.yaml')
    if parameter_file.is_file():
        return bag_recording(path, parameter_file)
    if path.name not in REAL:
        raise InputError(f'{path} has no parameter file {parameter_file.name} beside it, and is '
                         f'none of {", ".join(REAL)}')
    return real_recording(path)


def real_recording(folder: Path) -> Recording:
    """A real recording; what is right of it is as far as known."""
    read, right = REAL[folder.name]
    files, values = read(folder), right()
    if files.camera is None:
        raise MissingInputError(f'{folder} has no calibration of its camera')

    def image(number: int) -> Gray:
        data = np.frombuffer(files.images[number].encoded(), dtype=np.uint8)
        found = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
        if found is None:
            raise MissingInputError(f'{files.images[number].name} is no image')
        return np.asarray(found, dtype=np.uint8)

    return _recording(Source(folder.name, RECORDING), values, intrinsics_of(files.camera),
                      [file.stamp_ns for file in files.images], files.cropped_imu(), image,
                      lambda stamp1_ns, stamp2_ns: None)


def bag_recording(bag_path: Path, parameter_file: Path) -> Recording:
    """A bag, with its truth where it has one, and the parameters that are right."""
    images: list[PublishedImage] = []
    samples: list[ImuSample] = []
    intrinsics: list[Intrinsics] = []
    poses: list[TruePose] = []
    feed = SensorFeed({Role.IMU: samples.append, Role.IMAGE: images.append,
                       Role.CAMERA_INFO: intrinsics.append, Role.TRUTH: poses.append})
    with open_bag(bag_path) as bag:
        for role, message in feed.messages(bag, bag.find_topics()):
            feed.receive(role, message.message)
    parameters = read_parameters(parameter_file)
    truth = None if not poses else TrueTrajectory(
        [pose.stamp_ns for pose in poses], np.array([pose.position for pose in poses]),
        np.array([pose.quat_xyzw for pose in poses]))
    offset_ns = to_nanoseconds(parameters.sensor.time_offset)
    return _recording(
        Source(bag_path.name, RECORDING), parameters.to_mapping(), intrinsics[0],
        [image.stamp_ns for image in images], samples,
        lambda number: images[number].image.decoded(),
        lambda stamp1_ns, stamp2_ns: None if truth is None else truth.relative_pose(
            stamp1_ns + offset_ns, stamp2_ns + offset_ns))


def _recording(source: Source, values: Mapping[str, Any], intrinsics: Intrinsics,
               stamps_ns: Sequence[int], samples: Sequence[ImuSample],
               image: Callable[[int], Gray],
               true_pose: Callable[[int, int], tuple[Array, Array] | None]) -> Recording:
    """A recording of images; its rates are those of the gyro."""
    parameters = Parameters.from_mapping(values)
    camera = sensor_camera(intrinsics, parameters)
    delay_ns = to_nanoseconds(parameters.sensor.time_offset + camera.readout_time + IMAGE_DELAY)
    gyro = [(sample.stamp_ns, sample.angular_velocity) for sample in samples
            if sample.angular_velocity is not None]
    rates = np.array([rate for _, rate in gyro]) - parameters.imu.gyro_bias
    R_cam_imu = Rotation.from_quat(parameters.sensor.quat_cam_imu_xyzw)
    return Recording(
        source, Told(parameters.to_mapping(), intrinsics), camera,
        [Arrival(number, stamp, stamp + delay_ns) for number, stamp in enumerate(stamps_ns)],
        samples, image, None, true_pose, np.array([stamp for stamp, _ in gyro]),
        R_cam_imu.apply(rates))
