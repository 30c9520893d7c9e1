"""What a run can be told wrong: the rows of `rs_relpose benchmark trust`.

A row changes what is told (parameters, CameraInfo) or what arrives (IMU, images), and says which
figure of the health must find it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
import math
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.imu.samples import ImuSample, Vector

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

# Seconds of motion that can tell, within which an error must be flagged.
GROSS, SMALL = 5, 15
# Figures that the laboratory's information is about, and their number of unknowns.
FIGURES: Mapping[str, int] = {'axes': 3, 'time_offset': 1, 'readout_time': 1, 'gyro_bias': 3,
                              'gyro_scale': 1, 'focal_length': 1, 'distortion': 1}


class Geometry(NamedTuple):
    """How a published image differs from that of the sensor: pixels (N, 2), and the image."""

    points: Callable[[Array, RollingShutterCamera], Array]
    image: Callable[[Gray, RollingShutterCamera], Gray]


AS_IT_IS = Geometry(lambda points, camera: points, lambda image, camera: image)


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """What a run is told, and what arrives.

    `values`: parameters by name; `sample`: an IMU sample as it arrives; `geometry`: of the images.
    """

    values: Mapping[str, Any]
    intrinsics: Intrinsics
    sample: Callable[[ImuSample], ImuSample] = field(default=lambda sample: sample)
    geometry: Geometry = AS_IT_IS

    def with_values(self, **changed: Any) -> Told:
        """With other parameters."""
        return replace(self, values={**self.values, **changed})


class Injected(NamedTuple):
    """An error of a figure of `FIGURES`, as the laboratory's information knows it.

    `error` (its unknowns): rotation vector [rad] in the camera frame, [s], signed [s], [rad/s] in
    the camera frame, share, share, first coefficient.
    """

    figure: str
    error: Array


@dataclass(frozen=True, slots=True)
class Row:
    """A row of the matrix.

    `named`: figures of the health that are right; any of them. `within`: seconds of motion that
    can tell. `wrong`: what is told instead of what is right; `injected`: the error in it, None
    where turning about two axes tells. Both may draw.
    """

    named: tuple[str, ...]
    within: int
    wrong: Callable[[Told, np.random.Generator], Told]
    injected: Callable[[Told, np.random.Generator], Injected | None] = lambda told, rng: None


# -- what is told -----------------------------------------------------------------------------


def _axes_turned(turn: Callable[[np.random.Generator], Rotation]) -> Callable[..., Told]:
    """The IMU's own axes are turned: ``R_told = R_cam_imu T``."""
    def wrong(told: Told, rng: np.random.Generator) -> Told:
        R_cam_imu = Rotation.from_quat(told.values['quat_cam_imu_xyzw'])
        return told.with_values(quat_cam_imu_xyzw=tuple(
            float(v) for v in (R_cam_imu * turn(rng)).as_quat()))
    return wrong


def _slightly(rng: np.random.Generator) -> Rotation:
    axis = rng.standard_normal(3)
    return Rotation.from_rotvec(math.radians(3.0) * axis / np.linalg.norm(axis))


def _slight_turn(told: Told, rng: np.random.Generator) -> Injected:
    R_cam_imu = Rotation.from_quat(told.values['quat_cam_imu_xyzw'])
    return Injected('axes', R_cam_imu.apply(_slightly(rng).as_rotvec()))


def _focal_length(factor: float) -> Callable[..., Told]:
    def wrong(told: Told, rng: np.random.Generator) -> Told:
        intrinsics = told.intrinsics
        return replace(told, intrinsics=replace(
            intrinsics, fx=factor * intrinsics.fx, fy=factor * intrinsics.fy))
    return wrong


def _readout(factor: float) -> Callable[..., Told]:
    return lambda told, rng: told.with_values(readout_time=factor * told.values['readout_time'])


def _readout_error(factor: float) -> Callable[..., Injected]:
    return lambda told, rng: Injected(
        'readout_time', np.array([(factor - 1.0) * told.values['readout_time']]))


def _reversed(told: Told, rng: np.random.Generator) -> Told:
    other = {'down': 'up', 'up': 'down'}[told.values.get('readout_direction', 'down')]
    return told.with_values(readout_direction=other)


def _later(seconds: float) -> Callable[..., Told]:
    def wrong(told: Told, rng: np.random.Generator) -> Told:
        return told.with_values(time_offset=told.values['time_offset'] + seconds)
    return wrong


def _bias_change(rng: np.random.Generator) -> Array:
    axis = rng.standard_normal(3)
    return np.asarray(0.05 * axis / np.linalg.norm(axis))


def _biased(told: Told, rng: np.random.Generator) -> Told:
    bias = np.array(told.values.get('gyro_bias', (0.0, 0.0, 0.0))) + _bias_change(rng)
    return told.with_values(gyro_bias=tuple(float(v) for v in bias))


def _bias_error(told: Told, rng: np.random.Generator) -> Injected:
    R_cam_imu = Rotation.from_quat(told.values['quat_cam_imu_xyzw'])
    return Injected('gyro_bias', R_cam_imu.apply(_bias_change(rng)))


def _without_distortion(told: Told, rng: np.random.Generator) -> Told:
    intrinsics = told.intrinsics
    return replace(told, intrinsics=replace(
        intrinsics, distortion=(0.0,) * len(intrinsics.distortion)))


def _distortion_error(told: Told, rng: np.random.Generator) -> Injected:
    # A pinhole has none to leave out.
    return Injected('distortion', np.array([*told.intrinsics.distortion[:1], 0.0][:1]))


# -- what arrives -----------------------------------------------------------------------------


def _arrives(sample: Callable[[ImuSample], ImuSample]) -> Callable[..., Told]:
    return lambda told, rng: replace(told, sample=sample)


def _gyro_times(factor: float) -> Callable[[ImuSample], ImuSample]:
    def scaled(rate: Vector | None) -> Vector | None:
        return None if rate is None else (factor * rate[0], factor * rate[1], factor * rate[2])
    return lambda sample: replace(sample, angular_velocity=scaled(sample.angular_velocity))


def _felt(turn: Rotation, sign: float) -> Callable[[ImuSample], ImuSample]:
    """Accelerometer whose axes are turned, or that reads the acceleration of free fall."""
    def changed(sample: ImuSample) -> ImuSample:
        if sample.linear_acceleration is None:
            return sample
        x, y, z = sign * turn.apply(sample.linear_acceleration)
        return replace(sample, linear_acceleration=(float(x), float(y), float(z)))
    return changed


def _stamped_late(sample: ImuSample) -> ImuSample:
    return replace(sample, stamp_ns=sample.stamp_ns + 30_000_000)


def _shown(geometry: Geometry) -> Callable[..., Told]:
    return lambda told, rng: replace(told, geometry=geometry)


def _corner(camera: RollingShutterCamera) -> Array:
    return np.array([camera.width - 1.0, camera.height - 1.0])


def _rectified(points: Array, camera: RollingShutterCamera) -> Array:
    rays = camera.unproject(points)
    return np.asarray(rays[:, :2] / rays[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy))


def _rectified_image(image: Gray, camera: RollingShutterCamera) -> Gray:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.column_stack([(u.ravel() - camera.cx) / camera.fx,
                            (v.ravel() - camera.cy) / camera.fy, np.ones(u.size)])
    source = camera.project(rays).astype(np.float32).reshape(camera.height, camera.width, 2)
    return np.asarray(cv2.remap(image, source[..., 0], source[..., 1], cv2.INTER_LINEAR),
                      dtype=np.uint8)


RECTIFIED = Geometry(_rectified, _rectified_image)
UPSIDE_DOWN = Geometry(lambda points, camera: _corner(camera) - points,
                       lambda image, camera: np.ascontiguousarray(image[::-1, ::-1]))
FLIPPED = Geometry(
    lambda points, camera: np.column_stack([points[:, 0], camera.height - 1.0 - points[:, 1]]),
    lambda image, camera: np.ascontiguousarray(image[::-1]))
MIRRORED = Geometry(
    lambda points, camera: np.column_stack([camera.width - 1.0 - points[:, 0], points[:, 1]]),
    lambda image, camera: np.ascontiguousarray(image[:, ::-1]))

_HALF_TURN = Rotation.from_rotvec([0.0, 0.0, math.pi])
_CYCLE = Rotation.from_matrix([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])

RIGHT = 'right'
ROWS: Mapping[str, Row] = {
    RIGHT: Row((), SMALL, lambda told, rng: told),
    'imu-xy-negated': Row(('axes',), GROSS, _axes_turned(lambda rng: _HALF_TURN)),
    'imu-cycled': Row(('axes',), GROSS, _axes_turned(lambda rng: _CYCLE)),
    'gyro-degrees': Row(('gyro_unit',), GROSS, _arrives(_gyro_times(math.degrees(1.0)))),
    'gyro-57th': Row(('gyro_unit',), GROSS, _arrives(_gyro_times(1.0 / math.degrees(1.0)))),
    'K-1.3': Row(('focal_length',), GROSS, _focal_length(1.3),
                 lambda told, rng: Injected('focal_length', np.array([0.3]))),
    'K-1.05': Row(('focal_length',), GROSS, _focal_length(1.05),
                  lambda told, rng: Injected('focal_length', np.array([0.05]))),
    'no-distortion': Row(('distortion',), GROSS, _without_distortion, _distortion_error),
    'rectified': Row(('distortion', 'image_geometry'), GROSS, _shown(RECTIFIED),
                     _distortion_error),
    'upside-down': Row(('image_geometry',), GROSS, _shown(UPSIDE_DOWN)),
    'flipped': Row(('image_geometry',), GROSS, _shown(FLIPPED)),
    'imu-late-30ms': Row(('time_offset',), GROSS, _arrives(_stamped_late),
                         lambda told, rng: Injected('time_offset', np.array([0.03]))),
    'readout-2': Row(('readout_time',), GROSS, _readout(2.0), _readout_error(2.0)),
    'readout-0.5': Row(('readout_time',), GROSS, _readout(0.5), _readout_error(0.5)),
    'readout-0': Row(('readout_time',), GROSS, _readout(0.0), _readout_error(0.0)),
    'accel-cycled': Row(('accel_axes',), SMALL, _arrives(_felt(_CYCLE, 1.0))),
    'accel-opposite': Row(('accel_axes',), SMALL, _arrives(_felt(Rotation.identity(), -1.0))),
    'axes-3deg': Row(('axes',), SMALL, _axes_turned(_slightly), _slight_turn),
    'offset-10ms': Row(('time_offset',), SMALL, _later(0.01),
                       lambda told, rng: Injected('time_offset', np.array([0.01]))),
    'readout-1.2': Row(('readout_time',), SMALL, _readout(1.2), _readout_error(1.2)),
    'readout-0.8': Row(('readout_time',), SMALL, _readout(0.8), _readout_error(0.8)),
    'bias-0.05': Row(('gyro_bias',), SMALL, _biased, _bias_error),
    'gyro-0.95': Row(('gyro_scale',), SMALL, _arrives(_gyro_times(0.95)),
                     lambda told, rng: Injected('gyro_scale', np.array([0.05]))),
    'K-0.97': Row(('focal_length',), SMALL, _focal_length(0.97),
                  lambda told, rng: Injected('focal_length', np.array([0.03]))),
    'mirrored': Row(('image_geometry',), SMALL, _shown(MIRRORED)),
    'direction-reversed': Row(('readout_direction',), SMALL, _reversed,
                              lambda told, rng: Injected('readout_time', np.array(
                                  [2.0 * told.values['readout_time']]))),
}
