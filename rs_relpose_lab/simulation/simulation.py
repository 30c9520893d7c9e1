"""A simulated recording: frames, IMU and truth of one configuration."""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_lab.simulation.config import SimulationConfig
from rs_relpose_lab.simulation.motions import hand_held, Plan
from rs_relpose_lab.simulation.render import Renderer
from rs_relpose_lab.simulation.scene import make_scene, Scene
from rs_relpose_lab.simulation.trajectory import CameraStates, Trajectory
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import seconds_between, to_nanoseconds
from rs_relpose_ros.imu.buffer import ImuSample

# Acceleration of free fall in the world, whose z axis points upwards [m/s^2]. [derived: ISO
# 80000-3]
GRAVITY = np.array([0.0, 0.0, -9.80665])


@dataclass(frozen=True, slots=True, eq=False)
class ImuModel:
    """An IMU fixed to the camera: mounting, biases and noise; ``v_cam = R_cam_imu v_imu``."""

    R_cam_imu: Array
    lever_arm: ArrayLike = (0.0, 0.0, 0.0)  # position of the IMU in the camera frame [m]
    gyro_bias: ArrayLike = (0.0, 0.0, 0.0)  # [rad/s] added to the truth, IMU frame
    accel_bias: ArrayLike = (0.0, 0.0, 0.0)  # [m/s^2] likewise
    gyro_sigma: float = 0.0  # of a sample: density times the square root of the rate
    accel_sigma: float = 0.0  # likewise

    def measure(self, states: CameraStates, rng: np.random.Generator) -> tuple[Array, Array]:
        """Measured angular velocities and specific forces (N, 3) in the IMU frame.

        Specific force is ``R^T (a - g)``: +g upwards at rest.
        """
        w = states.angular_velocity
        dw = states.angular_acceleration
        lever = np.broadcast_to(np.asarray(self.lever_arm, dtype=np.float64), w.shape)
        # a_imu = a + R (dw x l + w x (w x l)), the rigid body's other point.
        rotation = np.cross(dw, lever) + np.cross(w, np.cross(w, lever))
        free_of_gravity = states.acceleration - GRAVITY
        force = np.einsum('nji,nj->ni', states.R_world_cam, free_of_gravity) + rotation
        gyro = w @ self.R_cam_imu + np.asarray(self.gyro_bias)
        accel = force @ self.R_cam_imu + np.asarray(self.accel_bias)
        gyro = gyro + self.gyro_sigma * rng.standard_normal(gyro.shape)
        accel = accel + self.accel_sigma * rng.standard_normal(accel.shape)
        return gyro, accel


# IMU and truth begin and end this long before the first and after the last row [s].
_MARGIN = 0.1
# The trajectory is defined for this long before and after the recording [s]. [chosen: above the
# margin of the IMU and the readout of an image]
_MOTION_MARGIN = 0.5

# Independent random streams of one seed: what one of them draws leaves the others alone.
# [chosen: any five different numbers]
_MOTION = 0  # of the trajectory
_SCENE = 1  # of places and textures
_IMU = 2  # of the noise of samples
_BIAS = 3  # of the error of the calibrated gyro bias
_IMAGE = 4  # of the noise of images


@dataclass(frozen=True, slots=True, eq=False)
class ImuSeries:
    """Samples of the IMU on its clock: rates [rad/s], specific forces [m/s^2] (N, 3), its axes."""

    stamps_ns: NDArray[np.int64]
    angular_velocities: Array
    linear_accelerations: Array

    def samples(self) -> list[ImuSample]:
        """The same as messages."""
        stamps = self.stamps_ns.tolist()
        rates = self.angular_velocities.tolist()
        forces = self.linear_accelerations.tolist()
        return [
            ImuSample(stamp, tuple(rate), tuple(force))
            for stamp, rate, force in zip(stamps, rates, forces, strict=True)
        ]


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """A recording; its images are rendered on request."""

    config: SimulationConfig
    camera: RollingShutterCamera
    trajectory: Trajectory
    renderer: Renderer
    imu: ImuSeries
    calibrated_gyro_bias: Array

    def reference_ns(self, index: int) -> int:
        """Time of frame `index`'s stamped row on the IMU clock [ns]."""
        return self.config.start_ns + round(index * 1e9 / self.config.fps)

    def stamp_ns(self, index: int) -> int:
        """Header stamp of frame `index`, camera clock [ns]."""
        return self.reference_ns(index) - to_nanoseconds(self.config.time_offset)

    def image(self, index: int) -> NDArray[np.uint8]:
        """Render frame `index`: gray values (H, W)."""
        gray = self.renderer.render(self.seconds(self.reference_ns(index)))
        rng = _stream(self.config.seed, _IMAGE, index)
        noise = rng.standard_normal(gray.shape, dtype=np.float32)
        gray = gray + np.float32(self.config.pixel_noise) * noise
        return np.clip(np.rint(gray), 0, 255).astype(np.uint8)

    def seconds(self, time_ns: int) -> float:
        """Time on the trajectory [s] of a time on the IMU clock [ns]."""
        return seconds_between(self.config.start_ns, time_ns)

    def states(self, times_ns: ArrayLike) -> CameraStates:
        """True poses and derivatives at times (N,) on the IMU clock [ns]."""
        offsets = np.atleast_1d(np.asarray(times_ns, dtype=np.int64)) - self.config.start_ns
        return self.trajectory.states(offsets * 1e-9)

    def true_matches(self, index1: int, index2: int, points1: ArrayLike) -> Array:
        """Positions in frame `index2` of the scene points at `points1` (N, 2) [px] of `index1`.

        NaN for a point that is hidden or outside of frame `index2`.
        """
        first, second = (self.seconds(self.reference_ns(i)) for i in (index1, index2))
        world, _ = self.renderer.locate(first, points1)
        points2 = self.renderer.project(second, world)
        inside = np.asarray(np.isfinite(points2).all(axis=1))
        observed, _ = self.renderer.locate(second, np.where(inside[:, None], points2, 0.0))
        apart: Array = np.linalg.norm(observed - world, axis=1)
        points2[~(apart < 1e-3)] = np.nan
        return points2


def simulate(
    config: SimulationConfig | None = None,
    *,
    scene: Scene | None = None,
    trajectory: Trajectory | None = None,
    camera: RollingShutterCamera | None = None,
) -> Simulation:
    """Set up a recording; `scene`, `trajectory`, `camera`: instead of the configuration's."""
    config = SimulationConfig() if config is None else config
    camera = config.camera if camera is None else camera
    margin = _MARGIN + 0.5 * config.exposure_time
    before = -camera.row_time_span[0] + margin
    after = config.frame_count / config.fps + camera.row_time_span[1] + margin
    if trajectory is None:
        rng = _stream(config.seed, _MOTION)
        plan = Plan.parse(config.plan) if config.plan else Plan.drawn(rng, config.duration)
        speed = rng.uniform(1.5, 1.8)
        rotation_rate = math.radians(rng.uniform(25.0, 45.0))
        # Wider than any camera needs: the motion must not depend on readout or stamped row.
        trajectory = hand_held(
            rng,
            -_MOTION_MARGIN,
            config.duration + _MOTION_MARGIN,
            plan,
            speed=config.speed or speed,
            rotation_rate=config.rotation_rate or rotation_rate,
        )
    if scene is None:
        scene = make_scene(config.scene, _stream(config.seed, _SCENE), config.fx)
    renderer = Renderer(scene, camera, trajectory, config.edge_samples, config.exposure_time)
    model = ImuModel(
        config.R_cam_imu,
        config.lever_arm,
        config.gyro_bias,
        config.accel_bias,
        config.gyro_noise_density * math.sqrt(config.imu_rate),
        config.accel_noise_density * math.sqrt(config.imu_rate),
    )
    samples = np.arange(
        math.ceil(-before * config.imu_rate), math.floor(after * config.imu_rate) + 1
    )
    offsets_ns = np.rint(samples * (1e9 / config.imu_rate)).astype(np.int64)
    gyro, accel = model.measure(trajectory.states(offsets_ns * 1e-9), _stream(config.seed, _IMU))
    bias_error = config.gyro_bias_error * _stream(config.seed, _BIAS).standard_normal(3)
    return Simulation(
        config,
        camera,
        trajectory,
        renderer,
        ImuSeries(config.start_ns + offsets_ns, gyro, accel),
        np.array(config.gyro_bias) + bias_error,
    )


def _stream(seed: int, *key: int) -> np.random.Generator:
    return np.random.default_rng((seed, *key))
