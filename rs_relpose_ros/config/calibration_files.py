"""Calibration files of other tools as parameters: Kalibr, OpenVINS, ORB-SLAM3, EuRoC, ROS.

| tool | keys | transform | its meaning |
|---|---|---|---|
| Kalibr | cam0: intrinsics, distortion_coeffs | T_cam_imu | p_cam = T p_imu |
| OpenVINS | as Kalibr | T_imu_cam | p_imu = T p_cam |
| ORB-SLAM3 | Camera1.fx, ... | IMU.T_b_c1 (before: Tbc) | p_imu = T p_cam |
| EuRoC sensor.yaml | intrinsics, distortion_coefficients | T_BS | p_body = T p_sensor |
| camera_calibration | camera_matrix: data | - | - |

Files of an IMU have its noise. A `timeshift_cam_imu` is ``t_imu = t_cam + shift``: time_offset.
"""

from collections.abc import Callable, Mapping, Sequence
import re
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
import yaml

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array

# A transform whose rotation deviates by more from an orthonormal matrix is no transform. [chosen:
# files have three digits at least; any value from 1e-3 to 1e-1 would do]
_ORTHONORMAL = 1e-2

# The models of files have these values of `distortion_model`. [derived: the documentation of the
# tools]
_MODELS = {
    'radtan': 'plumb_bob',
    'radial-tangential': 'plumb_bob',
    'plumb_bob': 'plumb_bob',
    'equidistant': 'equidistant',
    'equi': 'equidistant',
    'fisheye': 'equidistant',
    'kannalabrandt8': 'equidistant',
    'rational_polynomial': 'rational_polynomial',
    'none': 'plumb_bob',
    '': 'plumb_bob',
}
# Densities of noise and random walks in the files of an IMU are these parameters. [derived: the
# same]
_NOISE = {
    'gyroscope_noise_density': 'gyro_noise_density',
    'accelerometer_noise_density': 'accel_noise_density',
    'gyroscope_random_walk': 'gyro_bias_walk',
    'accelerometer_random_walk': 'accel_bias_walk',
    'IMU.NoiseGyro': 'gyro_noise_density',
    'IMU.NoiseAcc': 'accel_noise_density',
    'IMU.GyroWalk': 'gyro_bias_walk',
    'IMU.AccWalk': 'accel_bias_walk',
}


class ToolCalibration(NamedTuple):
    """Parameters from the file of another tool."""

    tool: str
    values: dict[str, Any]
    size: tuple[int, int] | None = None  # of the images [px]

    def __str__(self) -> str:
        return f'{self.tool}: {", ".join(self.values)}'


def plain_yaml(text: str) -> str:
    """Return a text without the directive and the tags that OpenCV writes, which is then YAML."""
    text = text.removeprefix('\ufeff')
    text = re.sub(r'\A%YAML:[^\n]*\n(?:---[^\n]*\n)?', '', text)
    return text.replace('!!opencv-matrix', '')


def yaml_problem(error: Exception) -> str:
    """Say in one line why a text is no YAML, and where."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem and error.problem_mark:
        mark = error.problem_mark
        return f'line {mark.line + 1}, column {mark.column + 1}: {error.problem}'
    return ' '.join(str(error).split())


def calibration_of(document: Any, path: str) -> ToolCalibration | None:
    """Return the parameters in the document of a YAML file; None if it is of no known tool."""
    if not isinstance(document, dict):
        return None
    for belongs, read in _TOOLS:
        if belongs(document):
            try:
                found = read(document)
            except InputError as error:
                raise InputError(f'{path}: {error}') from error
            except (TypeError, ValueError, LookupError) as error:
                raise InputError(f'{path} is incomplete or damaged: {error}') from error
            if not found.values:
                raise InputError(f'{path} ({found.tool}) has nothing that is a parameter')
            return found
    return None


# -- Parts that files share -----------------------------------------------------------------------


def _lens(model: object, pinhole: Sequence[Any], coefficients: Sequence[Any]) -> dict[str, Any]:
    """Return the parameters of a pinhole fx, fy, cx, cy [px] with a distortion."""
    name = str(model).lower()
    if name not in _MODELS:
        raise InputError(
            f'the distortion model {model} is not supported: it must be one of '
            f'{", ".join(filter(None, _MODELS))}'
        )
    fx, fy, cx, cy = map(float, pinhole)
    distortion = tuple(float(value) for value in coefficients)
    return {
        'camera_matrix': (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0),
        'distortion_model': _MODELS[name],
        'distortion_coefficients': () if name in ('none', '') else distortion,
    }


def _extrinsics(T_cam_imu: Array) -> dict[str, Any]:
    """Return the parameters of a transform (4, 4), ``p_cam = T p_imu``."""
    R = T_cam_imu[:3, :3]
    position = T_cam_imu[:3, 3]
    deviation = np.abs(R @ R.T - np.eye(3)).max()
    if deviation > _ORTHONORMAL or np.linalg.det(R) < 0.0:
        raise InputError('the rotation between camera and IMU is not orthonormal')
    quaternion = Rotation.from_matrix(R).as_quat()
    return {
        'quat_cam_imu_xyzw': tuple(quaternion.round(9).tolist()),
        'imu_position': tuple(position.round(9).tolist()),
    }


def _matrix(value: Any) -> Array:
    """Return a transform (4, 4) that is written as rows, or as the data of a matrix."""
    data = value['data'] if isinstance(value, Mapping) else value
    T = np.array(data, dtype=np.float64).reshape(4, 4)
    if not np.isfinite(T).all():
        raise InputError('a transform must be finite')
    return T


def _inverse(T: Array) -> Array:
    return np.asarray(np.linalg.inv(T))


def _noise(section: Mapping[str, Any]) -> dict[str, Any]:
    """Return the noise of an IMU; 0 is not known."""
    noise = {}
    for key, name in _NOISE.items():
        value = float(section.get(key, 0.0))
        if value > 0.0:
            noise[name] = value
    return noise


def _size(value: Any) -> tuple[int, int] | None:
    return None if value is None else (int(value[0]), int(value[1]))


# -- Tools ----------------------------------------------------------------------------------------


def _is_chain(document: Mapping[str, Any]) -> bool:
    camera = document.get('cam0')
    return isinstance(camera, Mapping) and 'intrinsics' in camera


def _pinhole(camera: Mapping[str, Any], coefficients: str) -> dict[str, Any]:
    """Read the lens of a camera of Kalibr, OpenVINS or EuRoC, with the key of its distortion."""
    model = str(camera.get('camera_model', 'pinhole'))
    if model != 'pinhole':
        raise InputError(f'the camera model {model} is not supported')
    distortion = camera.get('distortion_model', 'none')
    return _lens(distortion, camera['intrinsics'], camera.get(coefficients) or ())


def _chain(document: Mapping[str, Any]) -> ToolCalibration:
    """Read the first camera of a chain of Kalibr or OpenVINS."""
    camera = document['cam0']
    values = _pinhole(camera, 'distortion_coeffs')
    tool = 'camchain of Kalibr'
    if 'T_imu_cam' in camera:
        tool = 'camera chain of OpenVINS'
        values |= _extrinsics(_inverse(_matrix(camera['T_imu_cam'])))
    elif 'T_cam_imu' in camera:
        values |= _extrinsics(_matrix(camera['T_cam_imu']))
    if 'timeshift_cam_imu' in camera:
        values['time_offset'] = float(camera['timeshift_cam_imu'])
    return ToolCalibration(f'{tool}, cam0', values, _size(camera.get('resolution')))


def _is_imu(document: Mapping[str, Any]) -> bool:
    return 'gyroscope_noise_density' in document or (
        isinstance(document.get('imu0'), Mapping) and 'gyroscope_noise_density' in document['imu0']
    )


def _imu(document: Mapping[str, Any]) -> ToolCalibration:
    """Read the noise of an IMU as Kalibr, OpenVINS and EuRoC write it."""
    return ToolCalibration('noise of the IMU', _noise(document.get('imu0', document)))


def _is_orbslam(document: Mapping[str, Any]) -> bool:
    return 'Camera1.fx' in document or 'Camera.fx' in document


def _orbslam(document: Mapping[str, Any]) -> ToolCalibration:
    """Read the settings of ORB-SLAM3, of its first or its second format."""
    camera = 'Camera1' if 'Camera1.fx' in document else 'Camera'
    kind = str(document.get('Camera.type', 'PinHole'))
    if kind not in ('PinHole', 'KannalaBrandt8'):
        raise InputError(f'Camera.type {kind} is not supported: PinHole or KannalaBrandt8')
    model = 'radtan'
    names: tuple[str, ...] = ('k1', 'k2', 'p1', 'p2', 'k3')
    if kind == 'KannalaBrandt8':
        model = 'equidistant'
        names = ('k1', 'k2', 'k3', 'k4')
    coefficients = [float(document.get(f'{camera}.{name}', 0.0)) for name in names]
    if model == 'radtan' and coefficients[4] == 0.0:
        coefficients.pop()
    pinhole = [document[f'{camera}.{name}'] for name in ('fx', 'fy', 'cx', 'cy')]
    values = _lens(model, pinhole, coefficients)
    transform = document.get('IMU.T_b_c1', document.get('Tbc'))
    if transform is not None:
        values |= _extrinsics(_inverse(_matrix(transform)))
    size = document.get('Camera.width'), document.get('Camera.height')
    return ToolCalibration(
        'settings of ORB-SLAM3',
        values | _noise(document),
        None if None in size else _size(size),
    )


def _is_sensor(document: Mapping[str, Any]) -> bool:
    return 'intrinsics' in document and 'T_BS' in document


def _sensor(document: Mapping[str, Any]) -> ToolCalibration:
    """Read sensor.yaml of a camera in a folder of EuRoC; the body is the IMU."""
    values = _pinhole(document, 'distortion_coefficients')
    values |= _extrinsics(_inverse(_matrix(document['T_BS'])))
    return ToolCalibration('sensor.yaml of EuRoC', values, _size(document.get('resolution')))


def _is_ros(document: Mapping[str, Any]) -> bool:
    matrix = document.get('camera_matrix')
    return isinstance(matrix, Mapping) and 'data' in matrix


def _ros(document: Mapping[str, Any]) -> ToolCalibration:
    """Read ost.yaml of camera_calibration, which has no IMU."""
    fx, _, cx, _, fy, cy, *_ = document['camera_matrix']['data']
    distortion = document.get('distortion_coefficients', {})
    model = document.get('distortion_model', 'plumb_bob')
    values = _lens(model, (fx, fy, cx, cy), distortion.get('data') or ())
    size = document['image_width'], document['image_height']
    return ToolCalibration('camera_calibration of ROS', values, _size(size))


# Each tool has a test whether a document is its own, and a reader. [derived: the keys of the
# table above]
_TOOLS: tuple[
    tuple[
        Callable[[Mapping[str, Any]], bool],
        Callable[[Mapping[str, Any]], ToolCalibration],
    ],
    ...,
] = (
    (_is_chain, _chain),
    (_is_sensor, _sensor),
    (_is_imu, _imu),
    (_is_orbslam, _orbslam),
    (_is_ros, _ros),
)
