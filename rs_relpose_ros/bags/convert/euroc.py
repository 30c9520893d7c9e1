"""Folders of EuRoC's MAV data set and others in its format (ASL): mav0 with cam0 and imu0.

The ground truth is that of the body, which is the IMU; it is moved to the camera.
"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
import yaml

from rs_relpose_ros.bags.convert import recording
from rs_relpose_ros.bags.convert.recording import image_file, Recording
from rs_relpose_ros.bags.convert.text_files import (
    check_file,
    file_inside,
    headless_rows,
    read_rows,
    Row,
)
from rs_relpose_ros.config.calibration_files import calibration_of, plain_yaml, yaml_problem
from rs_relpose_ros.config.files import SourcedValue
from rs_relpose_ros.config.settings import IntrinsicsConfig
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.messages.incoming import TruePose

# A larger sensor.yaml is another file [bytes]. [chosen: they have below 2000 bytes]
_MAX_BYTES = 1 << 20
# Folders of ground truth below mav0, the most accurate first: all have the pose of the IMU.
_TRUTH = ('state_groundtruth_estimate0', 'mocap0')


def read_euroc(folder: Path) -> Recording:
    """Read cam0, imu0 and the ground truth below mav0."""
    root = folder / 'mav0' if (folder / 'mav0').is_dir() else folder
    table = root / 'cam0' / 'data.csv'
    if not table.is_file():
        raise MissingInputError(
            f'{folder} is no EuRoC folder: {table} is missing; it must list the stamp and the '
            'file of each image in cam0/data, and imu0/data.csv the samples of the IMU'
        )
    rows = list(read_rows(table, range(2)))
    if not rows:
        raise MissingInputError(f'{table} has no images')
    images = tuple(
        image_file(row.nanoseconds(0), file_inside(root / 'cam0' / 'data', row, 1)) for row in rows
    )
    camera_yaml = root / 'cam0' / 'sensor.yaml'
    R_body_imu = _body_axes(root / 'imu0' / 'sensor.yaml')
    camera = None
    values = list[SourcedValue]()
    T_cam_body = None
    if camera_yaml.is_file():
        camera, values, T_cam_body = _camera(camera_yaml, R_body_imu)
    values += _noise(root / 'imu0' / 'sensor.yaml')
    values.append(SourcedValue('time_offset', 0.0, 'ASSUMED: the data set has one clock.'))
    truth: tuple[TruePose, ...] = ()
    if T_cam_body is not None:
        truth = _truth(root, np.asarray(np.linalg.inv(T_cam_body)))
    is_png = rows[0].word(1).endswith('.png')
    return Recording(
        camera,
        images,
        _samples(root / 'imu0' / 'data.csv'),
        f'Parameters of relpose_node for {folder.name} (`rs_relpose convert euroc`). The readout '
        'time is not in the data set: 0 for a global shutter, as that of EuRoC; else '
        '`rs_relpose calibrate` measures it.',
        (recording.COMPRESSED, *values),
        truth=truth,
        image_format=recording.GRAY_PNG if is_png else 'jpeg',
    )


def _yaml(path: Path) -> Any:
    text = check_file(path, _MAX_BYTES).read_text(encoding='utf-8', errors='replace')
    try:
        return yaml.safe_load(plain_yaml(text))
    except (yaml.YAMLError, RecursionError) as error:
        raise InputError(f'{path} is not valid YAML: {yaml_problem(error)}') from error


def _camera(
    path: Path, R_body_imu: Array
) -> tuple[RollingShutterCamera, list[SourcedValue], Array]:
    """Return the camera, axes and position of the IMU as parameters, and T_cam_body (4, 4)."""
    found = calibration_of(_yaml(path), str(path))
    if found is None or found.size is None or 'quat_cam_imu_xyzw' not in found.values:
        raise InputError(f'{path} must have T_BS, intrinsics and resolution of a camera')
    values = found.values
    names = ('camera_matrix', 'distortion_model', 'distortion_coefficients')
    intrinsics = IntrinsicsConfig(**{name: values[name] for name in names})
    camera = intrinsics.of_image(*found.size).global_shutter_camera()
    R_cam_body = Rotation.from_quat(values['quat_cam_imu_xyzw']).as_matrix()
    T_cam_body = np.eye(4)
    T_cam_body[:3, :3] = R_cam_body
    T_cam_body[:3, 3] = values['imu_position']
    R_cam_imu = Rotation.from_matrix(R_cam_body @ R_body_imu)
    quaternion = R_cam_imu.as_quat().round(9).tolist()
    source = 'T_BS in cam0/sensor.yaml.'
    parameters = [
        SourcedValue('quat_cam_imu_xyzw', tuple(quaternion), source),
        SourcedValue('imu_position', values['imu_position'], source),
    ]
    return camera, parameters, T_cam_body


def _body_axes(path: Path) -> Array:
    """Return R_body_imu (3, 3); the identity if the file does not say otherwise."""
    document = _yaml(path) if path.is_file() else None
    if not isinstance(document, dict) or 'T_BS' not in document:
        return np.eye(3)
    try:
        T = np.array(document['T_BS']['data'], dtype=np.float64).reshape(4, 4)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f'{path}: T_BS must have 16 numbers as data') from error
    return T[:3, :3]


def _noise(path: Path) -> list[SourcedValue]:
    """Return the noise of the IMU as parameters."""
    found = calibration_of(_yaml(path), str(path)) if path.is_file() else None
    values = {} if found is None else found.values
    return [SourcedValue(name, value, 'imu0/sensor.yaml.') for name, value in values.items()]


def _samples(path: Path) -> list[ImuSample]:
    return [
        ImuSample(row.nanoseconds(0), row.vector(1, 2, 3), row.vector(4, 5, 6))
        for row in read_rows(path, range(7))
    ]


def _truth(root: Path, T_body_cam: Array) -> tuple[TruePose, ...]:
    """Move poses of the body to the camera."""
    path = next((root / name / 'data.csv' for name in _TRUTH if (root / name).is_dir()), None)
    if path is None or not path.is_file():
        return ()
    return tuple(_pose(row, T_body_cam) for row in headless_rows(path, 8))


def _pose(row: Row, T_body_cam: Array) -> TruePose:
    body_quat_xyzw = row.quaternion(5, 6, 7, 4)  # w is the first one
    R_world_body = Rotation.from_quat(body_quat_xyzw)
    R_body_cam = Rotation.from_matrix(T_body_cam[:3, :3])
    R_world_cam = R_world_body * R_body_cam
    to_camera = R_world_body.apply(T_body_cam[:3, 3])
    position = np.array(row.vector(1, 2, 3)) + to_camera
    x, y, z = position.tolist()
    qx, qy, qz, qw = R_world_cam.as_quat().tolist()
    return TruePose(
        row.nanoseconds(0),
        (x, y, z),
        (qx, qy, qz, qw),
    )
