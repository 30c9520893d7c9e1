"""Everything that defines a simulated recording; the only place of its defaults."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.simulation.motions import Plan
from rs_relpose_lab.simulation.scene import ALL_SCENES
from rs_relpose_ros.config.settings import setting, Settings
from rs_relpose_ros.geometry import validate
from rs_relpose_ros.geometry.camera import READOUT_DIRECTIONS, REFERENCE_ROWS, RollingShutterCamera


@dataclass(frozen=True, slots=True)
class SimulationConfig(Settings):
    """A recording: camera, IMU, motion and scene.

    Clocks: the IMU's is the world's; ground truth is stamped on it. An image's header stamp is on
    the camera's clock and marks the middle of the exposure of its `stamp_row`:
    ``t_imu = stamp + time_offset``.
    """

    duration: float = setting(6.0, 'length of the recording', 's', low=0.1, high=600.0)
    fps: float = setting(30.0, 'frames per second', 'Hz', low=1.0, high=240.0)
    seed: int = setting(0, 'seed of motion, scene and noise', low=0, high=2**31 - 1)
    scene: str = setting(
        'hall', 'kind of scene; its details come from the seed', choices=ALL_SCENES
    )
    width: int = setting(640, 'image width', 'px', low=16, high=4096)
    height: int = setting(480, 'image height', 'px', low=16, high=4096)
    fx: float = setting(450.0, 'focal length of both axes', 'px', low=10.0, high=10_000.0)
    distortion: tuple[float, ...] = setting(
        (-0.12, 0.05, 0.0008, -0.0005, 0.0),
        'plumb_bob coefficients k1 k2 p1 p2 k3',
        low=-10.0,
        high=10.0,
        length=5,
    )
    readout_time: float = setting(
        0.03, 'number of rows times line delay; 0 for a global shutter', 's', low=0.0, high=0.2
    )
    readout_direction: str = setting(
        'down',
        'whether row 0 is read first (down) or last (up); right or left for a portrait camera, '
        'whose columns are read from that at the left or at the right',
        choices=READOUT_DIRECTIONS,
    )
    exposure_time: float = setting(
        0.0, 'exposure of a row, over which it is averaged (motion blur)', 's', low=0.0, high=0.2
    )
    stamp_row: str = setting('first', 'row that the image stamp marks', choices=REFERENCE_ROWS)
    time_offset: float = setting(
        0.0, 'IMU clock minus camera clock: t_imu = stamp + time_offset', 's', low=-10.0, high=10.0
    )
    pixel_noise: float = setting(1.0, 'image noise, 1 sigma', 'gray values', low=0.0, high=50.0)
    edge_samples: int = setting(
        2, 'pixels on outlines are the mean of this many samples squared', low=1, high=8
    )
    plan: str = setting(
        '',
        'motion as a list such as walk:1.5,constant:0.8,still:0.6,rotate:0.6 [s]; empty: '
        'walks with each of the others once in 6 s, in an order drawn from the seed',
    )
    speed: float = setting(
        0.0, 'walking speed; 0 draws 1.5 to 1.8 from the seed', 'm/s', low=0.0, high=5.0
    )
    rotation_rate: float = setting(
        0.0,
        'rms of the angular velocity while walking; 0 draws 25 to 45 deg/s from the seed',
        'rad/s',
        low=0.0,
        high=5.0,
    )
    imu_rate: float = setting(200.0, 'IMU samples per second', 'Hz', low=10.0, high=4000.0)
    gyro_noise_density: float = setting(
        1.7e-4, 'white noise of the gyro', 'rad/s/sqrt(Hz)', low=0.0, high=1.0
    )
    accel_noise_density: float = setting(
        2.0e-3, 'white noise of the accelerometer', 'm/s^2/sqrt(Hz)', low=0.0, high=1.0
    )
    gyro_bias: tuple[float, ...] = setting(
        (0.011, -0.007, 0.005),
        'true bias of the gyro, IMU frame',
        'rad/s',
        low=-1.0,
        high=1.0,
        length=3,
    )
    gyro_bias_error: float = setting(
        3e-4,
        'error of the bias in the parameter file, 1 sigma, as a calibration leaves it',
        'rad/s',
        low=0.0,
        high=1.0,
    )
    accel_bias: tuple[float, ...] = setting(
        (0.06, -0.04, 0.05),
        'true bias of the accelerometer, IMU frame',
        'm/s^2',
        low=-10.0,
        high=10.0,
        length=3,
    )
    quat_cam_imu_xyzw: tuple[float, ...] = setting(
        # IMU x forward, y left, z up; camera z forward, x right, y down; and 2 deg of tilt.
        (0.502457, -0.504378, 0.507698, 0.485163),
        'rotation IMU to camera, v_cam = R(q) v_imu; x y z w',
        low=-1.0,
        high=1.0,
        length=4,
    )
    lever_arm: tuple[float, ...] = setting(
        (0.03, 0.01, -0.02),
        'position of the IMU in the camera frame',
        'm',
        low=-10.0,
        high=10.0,
        length=3,
    )
    start_ns: int = setting(
        1_700_000_000_000_000_000,
        'time of the first frame on the IMU clock',
        'ns',
        low=0,
        high=2**62,
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        validate.unit_length('quat_cam_imu_xyzw', self.quat_cam_imu_xyzw, 1e-2)
        if self.plan:
            Plan.parse(self.plan)

    @property
    def camera(self) -> RollingShutterCamera:
        """The camera; its reference row is `stamp_row`."""
        return RollingShutterCamera(
            width=self.width,
            height=self.height,
            fx=self.fx,
            fy=self.fx,
            # Off the middle, as real ones are, so that mixing up the two shows.
            cx=0.5 * (self.width - 1) + 0.01 * self.width,
            cy=0.5 * (self.height - 1) - 0.01 * self.height,
            distortion=self.distortion,
            readout_time=self.readout_time,
            readout_direction=self.readout_direction,
            reference_row=self.stamp_row,
        )

    @property
    def R_cam_imu(self) -> NDArray[np.float64]:
        """Rotation matrix of `quat_cam_imu_xyzw`."""
        matrix: NDArray[np.float64] = Rotation.from_quat(self.quat_cam_imu_xyzw).as_matrix()
        return matrix

    @property
    def frame_count(self) -> int:
        """Number of images."""
        return max(1, round(self.duration * self.fps))
