"""PennCOSYVIO without its images: simulated ones, or points, on its ground-truth trajectories."""

from __future__ import annotations

from dataclasses import dataclass
import math
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from rs_relpose_lab.experiments.methods import PairProblem
from rs_relpose_lab.experiments.pair_imu import PairImu
from rs_relpose_lab.experiments.penncosyvio import (
    camera_poses,
    Pair,
    pair_problem,
    PennCosyvioRun,
    sift_matches,
    STRETCHES,
    with_gyro,
)
from rs_relpose_lab.experiments.penncosyvio_files import Poses, read_camera
from rs_relpose_lab.simulation.config import SimulationConfig
from rs_relpose_lab.simulation.hand_held import EYE_HEIGHT
from rs_relpose_lab.simulation.inertial import ImuModel
from rs_relpose_lab.simulation.render import Renderer, view_of
from rs_relpose_lab.simulation.rows import in_front, measured, Motion, seen_by_both
from rs_relpose_lab.simulation.scene import make_scene, Scene, SCENES
from rs_relpose_lab.simulation.trajectory import CameraStates, Trajectory
from rs_relpose_ros.config.estimator import EstimatorConfig
from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.timing import ImageClock, NANOSECONDS, to_nanoseconds
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.tracking.matches import Matches

Array = NDArray[np.float64]

# Independent random streams of one seed.
_IMU, _POINTS, _NOISE, _SCENE, _IMAGE = range(5)


@dataclass(frozen=True, slots=True)
class Simulated:
    """What is put in place of the recorded images.

    `rendered`: images of a `scene`, of which SIFT features are matched, instead of points.
    `pixel_noise`, `outliers`: of points, 1 sigma [px]; share of their matches that are random.
    """

    rendered: bool = False
    scene: str = 'yard'
    pixel_noise: float = 0.5
    outliers: float = 0.3

    def __post_init__(self) -> None:
        for name, high in (('pixel_noise', 20.0), ('outliers', 0.95)):
            if not 0.0 <= getattr(self, name) <= high:
                raise InputError(f'{name} must be in [0, {high:g}], got {getattr(self, name):g}')
        if self.scene not in SCENES:
            raise InputError(f'scene must be one of {SCENES}, got {self.scene!r}')


class SimulatedSequence:
    """A sequence whose camera and IMU are simulated; frame k is taken at the k-th true pose."""

    def __init__(self, folder: Path, name: str, run: PennCosyvioRun,
                 simulated: Simulated) -> None:
        self._name, self._run, self._simulated = name, run, simulated
        self._camera = read_camera(folder, run.camera, run.readout_time, run.stamp_row)
        poses = camera_poses(folder, name, run.camera)
        self._stamps_ns = poses.stamps_ns
        self._motion = RecordedMotion(poses)
        # The IMU is in the camera: axes and place of the real one would cancel.
        self._imu = PairImu(self._measure(), np.eye(3), ImageClock(self._camera), ImuConfig())
        self._scene: Scene | None = None
        if simulated.rendered:
            self._scene = make_scene(simulated.scene, self._stream(_SCENE), self._camera.fx)

    def problem(self, pair: Pair) -> PairProblem:
        """Simulate the pair."""
        if pair.second > len(self._stamps_ns):
            raise InputError(f'{self._name} must have a pose {pair.second}, but has '
                             f'{len(self._stamps_ns)}')
        stamps = [int(self._stamps_ns[number - 1]) for number in (pair.first, pair.second)]
        seconds = [self._motion.seconds(stamp) for stamp in stamps]
        (R1, R2), (p1, p2) = self._motion.at(seconds)
        truth = (R1.inv() * R2).as_matrix(), R1.inv().apply(p2 - p1)
        told = EstimatorConfig()
        if self._scene is None:
            matches = self._points(pair, seconds)
            told = EstimatorConfig(pixel_sigma=max(self._simulated.pixel_noise, 0.01))
        else:
            matches = self._rendered(self._scene, pair, seconds)
        return pair_problem(matches, self._camera, self._imu, stamps, truth, told,
                            with_gyro(self._run))

    def _measure(self) -> tuple[ImuSample, ...]:
        rng = self._stream(_IMU)
        config = SimulationConfig()
        rate = config.imu_rate
        times = np.arange(math.ceil(self._motion.span[0] * rate),
                          math.floor(self._motion.span[1] * rate) + 1) / rate
        # A calibration leaves a bias of 0.1 deg/s, which the paper gives for a low-cost sensor.
        model = ImuModel(np.eye(3), gyro_bias=math.radians(0.1) * rng.standard_normal(3),
                         gyro_sigma=config.gyro_noise_density * math.sqrt(rate),
                         accel_sigma=config.accel_noise_density * math.sqrt(rate))
        rates, forces = model.measure(self._motion.states(times), rng)
        start_ns = int(self._stamps_ns[0])
        return tuple(ImuSample(start_ns + to_nanoseconds(time), tuple(w), tuple(force))
                     for time, w, force in zip(times.tolist(), rates.tolist(), forces.tolist(),
                                               strict=True))

    def _points(self, pair: Pair, seconds: list[float]) -> Matches:
        view, rng = view_of(self._camera), self._stream(_POINTS, pair.first)
        (start, _), (origin, _) = self._motion.at(seconds)

        def candidates() -> Array:
            return in_front(view, start, origin, 600, (6.0, 34.0), rng)

        exact = seen_by_both(candidates, self._motion_from(seconds[0]),
                             self._motion_from(seconds[1]), view, 300)
        points1, points2, _ = measured(exact, view, self._simulated.pixel_noise,
                                       self._simulated.outliers, self._stream(_NOISE, pair.first))
        return Matches(np.arange(len(points1), dtype=np.uint32), points1, points2,
                       np.ones(len(points1)))

    def _motion_from(self, start: float) -> Motion:
        def to_camera(world: Array, times: Array) -> Array:
            orientations, positions = self._motion.at(start + times)
            return np.asarray(orientations.inv().apply(world - positions))
        return to_camera

    def _rendered(self, scene: Scene, pair: Pair, seconds: list[float]) -> Matches:
        placed = PlacedMotion(self._motion, seconds[0])
        # It asks a trajectory for nothing but its poses.
        renderer = Renderer(scene, self._camera, cast('Trajectory', placed))
        images = []
        for number, second in zip((pair.first, pair.second), seconds, strict=True):
            gray = renderer.render(second)
            noise = self._stream(_IMAGE, number).standard_normal(gray.shape, dtype=np.float32)
            # White noise of 2 gray values.
            images.append(np.clip(np.rint(gray + 2.0 * noise), 0, 255).astype(np.uint8))
        return sift_matches(*images)

    def _stream(self, *key: int) -> np.random.Generator:
        return np.random.default_rng((self._run.seed, list(STRETCHES).index(self._name), *key))


class RecordedMotion:
    """Cubic splines of position and orientation through all poses.

    Instants are seconds since the first pose. It offers what the renderer and the IMU model ask of
    `rs_relpose_lab.simulation.trajectory.Trajectory`.
    """

    def __init__(self, poses: Poses) -> None:
        self._start_ns = int(poses.stamps_ns[0])
        seconds = (poses.stamps_ns - self._start_ns) / NANOSECONDS
        self.span = 0.0, float(seconds[-1])
        self._position = CubicSpline(seconds, poses.positions)
        self._rotation = RotationSpline(seconds, poses.rotations)

    def seconds(self, instant_ns: int) -> float:
        """Time on this motion of an instant of the poses' clock."""
        return (instant_ns - self._start_ns) / NANOSECONDS

    def at(self, times: ArrayLike) -> tuple[Rotation, Array]:
        """Orientations in the world and positions (N, 3) [m] at times (N,) [s]."""
        times = np.asarray(times, dtype=np.float64)
        if len(times) and not (self.span[0] <= times.min() and times.max() <= self.span[1]):
            raise InputError(f'the poses last {self.span[1]:.3f} s, asked for '
                             f'{times.min():.3f} to {times.max():.3f} s')
        return self._rotation(times), self._position(times)

    def poses(self, times: ArrayLike) -> tuple[Array, Array]:
        """Positions (N, 3) [m] and orientations (N, 3, 3) at times (N,) [s]."""
        rotations, positions = self.at(times)
        return positions, rotations.as_matrix()

    def states(self, times: ArrayLike) -> CameraStates:
        """Poses and derivatives at times (N,) [s]."""
        positions, rotations = self.poses(times)
        return CameraStates(
            position=positions, R_world_cam=rotations, velocity=self._position(times, 1),
            acceleration=self._position(times, 2), angular_velocity=self._rotation(times, 1),
            angular_acceleration=self._rotation(times, 2))


class PlacedMotion:
    """Recorded motion that begins at the simulator's eye height at the origin, heading for x.

    Its scenes have one place to look from; turning the world about the vertical changes nothing.
    """

    def __init__(self, motion: RecordedMotion, start: float) -> None:
        self._motion = motion
        orientation, position = motion.at([start])
        forward = orientation.apply([0.0, 0.0, 1.0])[0]
        self._turn = Rotation.from_euler('z', -math.atan2(forward[1], forward[0]))
        self._origin = position[0]

    def poses(self, times: ArrayLike) -> tuple[Array, Array]:
        """Positions (N, 3) [m] and orientations (N, 3, 3) at times (N,) [s]."""
        orientations, positions = self._motion.at(times)
        moved = self._turn.apply(positions - self._origin)
        moved[:, 2] += EYE_HEIGHT
        return moved, (self._turn * orientations).as_matrix()
