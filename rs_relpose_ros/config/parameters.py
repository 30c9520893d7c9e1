"""Every parameter of the nodes and of the replay, flat by name, from the declared settings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import dataclasses
from dataclasses import dataclass, field
import difflib
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.config.declarations import check_settings, Declared, declared, setting
from rs_relpose_ros.config.estimator import EstimatorConfig
from rs_relpose_ros.config.global_shutter import GlobalShutterConfig
from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.config.intrinsics import IntrinsicsConfig
from rs_relpose_ros.config.keyframes import KeyframeConfig
from rs_relpose_ros.config.odometry import OdometryConfig
from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.camera import READOUT_DIRECTIONS, REFERENCE_ROWS
from rs_relpose_ros.geometry.timing import STAMP_EXPOSURES

POSE_ROWS = ('stamp', 'middle')


@dataclass(frozen=True, slots=True)
class SensorConfig:
    """What no message tells: read-out, clock and axes of this camera and this IMU."""

    readout_time: float | None = setting(
        None, 'image height times line delay; 0 for a global shutter', 's', low=0.0, high=0.5,
        kind=float)
    readout_direction: str = setting(
        'down', 'whether row 0 is read first (down) or last (up)', choices=READOUT_DIRECTIONS)
    stamp_row: str = setting(
        'first', 'row that the image stamp marks', choices=REFERENCE_ROWS)
    pose_row: str = setting(
        'stamp', 'rows that poses relate, and whose instants their stamps are: those of the image '
        'stamps, or the middle ones, between which the translation is known better',
        choices=POSE_ROWS)
    stamp_exposure: str = setting(
        'middle', 'instant of that exposure which the stamp marks', choices=STAMP_EXPOSURES)
    exposure_time: float = setting(
        0.0, 'exposure of a row; used unless stamp_exposure is middle', 's', low=0.0, high=1.0)
    time_offset: float = setting(
        0.0, 'IMU clock minus camera clock: t_imu = stamp + time_offset', 's', low=-10.0,
        high=10.0)
    time_offset_per_interval: float = setting(
        0.0, 'change of time_offset by the interval T between frames (automatic exposure): '
        't_imu = stamp + time_offset + time_offset_per_interval (T - '
        'time_offset_reference_interval)', 's/s', low=-5.0, high=5.0)
    time_offset_reference_interval: float = setting(
        0.0, 'interval between frames at which time_offset holds; used with '
        'time_offset_per_interval', 's', low=0.0, high=10.0)
    track_time_offset: bool = setting(
        False, 'apply the time offset that is tracked while running (it is always reported)',
        live=True)
    track_readout_time: bool = setting(
        False, 'apply the read-out time that is tracked while running (it is always reported)',
        live=True)
    quat_cam_imu_xyzw: tuple[float, ...] | None = setting(
        None, 'rotation IMU to camera, v_cam = R(q) v_imu; x y z w', low=-1.0, high=1.0, length=4,
        kind=tuple)

    def __post_init__(self) -> None:
        check_settings(self)
        if self.quat_cam_imu_xyzw is not None:
            norm = float(np.linalg.norm(self.quat_cam_imu_xyzw))
            if not abs(norm - 1.0) < 1e-2:
                raise InputError(
                    f'quat_cam_imu_xyzw must have length 1, got {list(self.quat_cam_imu_xyzw)} '
                    f'of length {norm:.4f}')

    @property
    def R_cam_imu(self) -> NDArray[np.float64]:
        """Rotation matrix of `quat_cam_imu_xyzw`."""
        if self.quat_cam_imu_xyzw is None:
            raise MissingInputError('parameter quat_cam_imu_xyzw is not set: give the rotation '
                                    'from IMU to camera, v_cam = R(q) v_imu, as [x, y, z, w]')
        return Rotation.from_quat(self.quat_cam_imu_xyzw).as_matrix()

    def offset_at(self, interval: float) -> float:
        """`time_offset` [s] at an interval between frames [s]."""
        return self.time_offset + self.time_offset_per_interval * (
            interval - self.time_offset_reference_interval)

    def missing(self) -> list[str]:
        """Names of the settings that have no default and were not given."""
        return [name for name in ('readout_time', 'quat_cam_imu_xyzw')
                if getattr(self, name) is None]


@dataclass(frozen=True, slots=True)
class PairConfig:
    """How frame pairs are handed to the estimator."""

    use_gyro_rotation: bool = setting(
        True, 'gyro between the frames as rotation prior and hypothesis (else it only derotates '
        'rows)')
    use_gravity: bool = setting(True, 'gravity as prior and for the 3- and 9-point solvers')
    use_accelerometer: bool = setting(
        True, 'accelerometer between the frames for velocities and baseline, with '
        'use_gyro_rotation (else it is asked for gravity alone)')
    withhold_when_wrong: bool = setting(
        True, 'publish no pose while a figure that was told is seen to be wrong (see health in '
        '/diagnostics)', live=True)
    reference_frame: str = setting(
        '', 'frame_id of relative poses; empty for <camera frame>_reference')
    image_transport: str = setting('raw', 'transport of the images', choices=('raw', 'compressed'))
    publish_debug_image: bool = setting(
        True, 'publish ~/debug_image, of every pair, while somebody subscribes to it', live=True)
    publish_tf: bool = setting(
        False, 'broadcast the reference keyframe as a child of the camera on /tf; needs tf2_ros')
    stamps_file: str = setting(
        '', 'file that receives the stamp of every processed frame, for replay --stamps; empty '
        'for none')
    timings_file: str = setting(
        '', 'file that receives, for every processed frame, when it was ready, taken and done '
        '(CSV); empty for none')
    seed: int = setting(0, 'seed; the random state of a pair comes from it and both stamps',
                        low=0, high=2**31 - 1)

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True, slots=True)
class Parameters:
    """All parameters, grouped by the module that they configure; flat names are unique."""

    sensor: SensorConfig = field(default_factory=SensorConfig)
    intrinsics: IntrinsicsConfig = field(default_factory=IntrinsicsConfig)
    pair: PairConfig = field(default_factory=PairConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    imu: ImuConfig = field(default_factory=ImuConfig)
    estimator: EstimatorConfig = field(default_factory=EstimatorConfig)
    global_shutter: GlobalShutterConfig = field(default_factory=GlobalShutterConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)

    @staticmethod
    def declarations() -> Iterator[tuple[str, Any, Declared]]:
        """Name, default (None where the user must give one) and declaration of every parameter."""
        for group in dataclasses.fields(Parameters):
            for item in dataclasses.fields(group.default_factory):  # type: ignore[arg-type]
                yield item.name, item.default, declared(item)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Parameters:
        """Defaults overridden by `values`, by flat name."""
        return cls().updated(values)

    def updated(self, values: Mapping[str, Any]) -> Parameters:
        """A copy with some parameters changed, by flat name.

        An unknown name (named with near matches) or an illegal value raises InputError.
        """
        known = [name for name, _, _ in self.declarations()]
        for name in values:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=3)
                hint = f'; did you mean {" or ".join(near)}?' if near else ''
                raise InputError(f'there is no parameter {name!r}{hint}')
        groups = {}
        for group in dataclasses.fields(self):
            config = getattr(self, group.name)
            changed = {item.name: values[item.name] for item in dataclasses.fields(config)
                       if item.name in values}
            groups[group.name] = dataclasses.replace(config, **changed)
        return Parameters(**groups)

    def to_mapping(self) -> dict[str, Any]:
        """Every parameter by flat name."""
        configs = [getattr(self, group.name) for group in dataclasses.fields(self)]
        return {item.name: getattr(config, item.name)
                for config in configs for item in dataclasses.fields(config)}
