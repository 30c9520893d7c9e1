"""The paper's protocol on PennCOSYVIO's trajectories: its pairs as the methods get them.

Of eight stretches of the sequences 'as' and 'af', every fifth frame makes a pair with the one 30
frames later; angular velocity and gravity are means over 0.1 s. Points and IMU are simulated.

The folder is a checkout of the repository of the data set, in the formats in which it is published
(https://daniilidis-group.github.io/penncosyvio); the rig's axes are those of the GoPro C2::

    data/ground_truth/SEQUENCE/pose.txt   stamp [s], then the 3x4 pose of the rig in the world
    tools/intrinsic_calibration/cc.mat    OCamCalib's models of the wide-angle cameras
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass
import math
from pathlib import Path

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.io import loadmat
from scipy.io.matlab import MatReadError
from scipy.spatial.transform import Rotation, RotationSpline

from rs_relpose_lab.experiments.methods import ContinuousGyro, METHODS, PairProblem, run_method
from rs_relpose_lab.experiments.paper import Record
from rs_relpose_lab.simulation.config import SimulationConfig
from rs_relpose_lab.simulation.render import view_of
from rs_relpose_lab.simulation.rows import in_both_views, in_front, measured, Motion
from rs_relpose_lab.simulation.simulation import ImuModel
from rs_relpose_lab.simulation.trajectory import CameraStates
from rs_relpose_ros.bags.convert.text_files import read_rows
from rs_relpose_ros.config.settings import EstimatorConfig, ImuConfig
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.lens import rays_with_jacobian
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.timing import ImageClock, NANOSECONDS, seconds_between, to_nanoseconds
from rs_relpose_ros.imu.buffer import frame_imu, ImuBuffer, ImuSample
from rs_relpose_ros.imu.filters import mean_gravity

# Name of the experiment on the command line.
EXPERIMENT = 'penncosyvio'

# First and last frame of the stretches, from the paper's table 1; a frame's number is that of its
# row in pose.txt.
STRETCHES: Mapping[str, tuple[tuple[int, int], ...]] = {
    'as': ((206, 567), (1319, 1679), (2581, 2971), (4358, 4599)),
    'af': ((101, 551), (913, 1123), (1604, 1815), (2539, 2810)),
}
# Methods of the experiment, as in `methods.METHODS`.
METHODS_OF_THE_EXPERIMENT = (
    'global_5pt',
    'uniform_9pt',
    'uniform_11pt',
    'auto',
    'auto_gyro',
    'opencv_derotated',
    'opencv_gyro',
)

# Nobody has measured it. What the data set's authors quote for a GoPro Hero 4 [s]:
# https://github.com/daniilidis-group/penncosyvio/issues/3
GOPRO_READOUT = 0.03
# Frames from the first of a pair to the second.
DISTANCE = 30


@dataclass(frozen=True, slots=True)
class PennCosyvioRun:
    """Parameters of the experiment."""

    sequences: tuple[str, ...]  # of `STRETCHES`
    methods: tuple[str, ...]  # of `METHODS`
    readout_time: float = GOPRO_READOUT  # [s]
    every: int = 5  # frames from one pair to the next
    seed: int = 0
    pixel_noise: float = 0.5  # 1 sigma [px]
    outliers: float = 0.3  # share of matches that are random

    def __post_init__(self) -> None:
        for name, low, high in (
            ('every', 1, math.inf),
            ('seed', 0, math.inf),
            ('pixel_noise', 0, 20),
            ('outliers', 0, 0.95),
        ):
            if not low <= getattr(self, name) <= high:
                raise InputError(f'{name} must be in [{low}, {high:g}], got {getattr(self, name)}')

    def pairs(self) -> list[tuple[str, int, int]]:
        """Sequence, stretch and first frame of every pair, both counted from 1."""
        return [
            (sequence, stretch, first)
            for sequence in self.sequences
            for stretch, (start, end) in enumerate(STRETCHES[sequence], start=1)
            for first in range(start, end - DISTANCE + 1, self.every)
        ]


def run_penncosyvio(
    run: PennCosyvioRun, folder: Path, on_pair: Callable[[], object] = lambda: None
) -> list[Record]:
    """Estimate every pair by every method; `on_pair` is called after each pair."""
    sequences = {name: SimulatedSequence(folder, name, run) for name in run.sequences}
    records = []
    for sequence, stretch, first in run.pairs():
        problem = sequences[sequence].problem(first)
        records += [
            Record(
                EXPERIMENT, sequence, str(stretch), name, first, *run_method(name, problem, first)
            )
            for name in run.methods
        ]
        on_pair()
    return records


# Independent random streams of one seed. [chosen: any three different numbers]
_IMU = 0  # of the noise of samples
_POINTS = 1  # of the points of the world
_NOISE = 2  # of the matches


class SimulatedSequence:
    """A sequence whose points and IMU are simulated; frame k is taken at the k-th true pose."""

    def __init__(self, folder: Path, name: str, run: PennCosyvioRun) -> None:
        self._name = name
        self._run = run
        self._camera = read_camera(folder, run.readout_time)
        self._clock = ImageClock(self._camera)
        self._stamps_ns, *poses = read_poses(folder, name)
        self._motion = RecordedMotion(self._stamps_ns, *poses)
        # The IMU is in the camera: axes and place of the real one would cancel.
        self._samples = self._measure()
        self._sample_stamps = [sample.stamp_ns for sample in self._samples]

    def problem(self, number: int) -> PairProblem:
        """Simulate the pair of a first frame; the estimator gets the sigmas of the means."""
        if number + DISTANCE > len(self._stamps_ns):
            raise InputError(
                f'{self._name} must have a pose {number + DISTANCE}, but has '
                f'{len(self._stamps_ns)}'
            )
        stamps = [int(self._stamps_ns[k - 1]) for k in (number, number + DISTANCE)]
        seconds = [self._motion.seconds(stamp) for stamp in stamps]
        (R1, R2), (p1, p2) = self._motion.at(seconds)
        points1, points2 = self._points(number, seconds)
        motions, gravity_sigmas, rate_sigmas = zip(*map(self._mean, stamps), strict=True)
        # The largest sigmas that the estimator accepts are 1.5 rad and 1 rad/s.
        configured = EstimatorConfig(
            pixel_sigma=max(self._run.pixel_noise, 0.01),
            gravity_sigma=min(max(gravity_sigmas), 1.5),
            gyro_sigma=min(math.hypot(EstimatorConfig().gyro_sigma, max(rate_sigmas)), 1.0),
        )
        gyro = None
        if any(METHODS[name].continuous_gyro for name in self._run.methods):
            gyro = self._continuous(stamps)
        return PairProblem(
            points1,
            points2,
            self._camera,
            motions[0],
            motions[1],
            (R1.inv() * R2).as_matrix(),
            R1.inv().apply(p2 - p1),
            configured,
            np.ones(len(points1)),
            gyro,
        )

    def _measure(self) -> tuple[ImuSample, ...]:
        rng = self._stream(_IMU)
        config = SimulationConfig()
        rate = config.imu_rate
        times = (
            np.arange(
                math.ceil(self._motion.span[0] * rate), math.floor(self._motion.span[1] * rate) + 1
            )
            / rate
        )
        # A calibration leaves a bias of 0.1 deg/s, which the paper gives for a low-cost sensor.
        model = ImuModel(
            np.eye(3),
            gyro_bias=math.radians(0.1) * rng.standard_normal(3),
            gyro_sigma=config.gyro_noise_density * math.sqrt(rate),
            accel_sigma=config.accel_noise_density * math.sqrt(rate),
        )
        rates, forces = model.measure(self._motion.states(times), rng)
        start_ns = int(self._stamps_ns[0])
        return tuple(
            ImuSample(start_ns + to_nanoseconds(time), tuple(w), tuple(force))
            for time, w, force in zip(times.tolist(), rates.tolist(), forces.tolist(), strict=True)
        )

    def _mean(self, stamp_ns: int) -> tuple[FrameMotion, float, float]:
        """The paper's motion of a frame at its reference row; sigmas [rad], [rad/s]."""
        start_ns, end_ns = self._clock.exposed_span_ns(stamp_ns)
        # The paper: 'an average of the inertial measurements within 0.1 s near the image frame'.
        # Here it is centred on the middle row.
        middle_ns = (start_ns + end_ns) // 2
        half_ns = to_nanoseconds(0.05)
        window = self._samples[
            bisect_left(self._sample_stamps, middle_ns - half_ns) : bisect_right(
                self._sample_stamps, middle_ns + half_ns
            )
        ]
        rates = [s.angular_velocity for s in window if s.angular_velocity is not None]
        gravity = mean_gravity(np.array([s.linear_acceleration for s in window]))
        assert gravity is not None
        motion = FrameMotion(np.mean(rates, axis=0), gravity.direction)
        delay = seconds_between(middle_ns, self._clock.reference_ns(stamp_ns))
        # The deviation of a row's rate from the mean is that of the rates of the window.
        return (motion.shifted(delay), gravity.sigma, float(np.sqrt(np.var(rates, axis=0).mean())))

    def _continuous(self, stamps: list[int]) -> ContinuousGyro:
        """Motion of two frames by the continuous gyro, as in the node."""
        buffer = ImuBuffer(ImuConfig())
        # Noise may carry a match a few rows out of the image.
        edge_ns = to_nanoseconds(1e-3)
        spans = [
            (start_ns - edge_ns, end_ns + edge_ns)
            for start_ns, end_ns in map(self._clock.exposed_span_ns, stamps)
        ]
        references = [self._clock.reference_ns(stamp) for stamp in stamps]
        # Gravity is filtered from 5 s before the first frame on.
        fed = bisect_left(self._sample_stamps, spans[0][0] - to_nanoseconds(5.0))
        found = []
        for span, reference_ns in zip(spans, references, strict=True):
            # Interpolation needs a sample after the last row.
            until = bisect_right(self._sample_stamps, span[1] + to_nanoseconds(0.1))
            for sample in self._samples[fed:until]:
                buffer.add(sample)
            fed = until
            found.append(frame_imu(buffer, span, reference_ns, np.eye(3)))
        first, second = found
        sigmas = [frame.gravity_sigma for frame in found if frame.gravity_sigma is not None]
        return ContinuousGyro(
            first.motion,
            second.motion,
            *buffer.rotation(*references),
            seconds_between(*references),
            EstimatorConfig().gyro_sigma,
            max(sigmas, default=None),
        )

    def _points(self, number: int, seconds: list[float]) -> tuple[Array, Array]:
        view = view_of(self._camera)
        rng = self._stream(_POINTS, number)
        (start, _), (origin, _) = self._motion.at(seconds)

        def candidates() -> Array:
            return in_front(view, start, origin, 600, (6.0, 34.0), rng)

        exact = in_both_views(
            candidates, self._motion_from(seconds[0]), self._motion_from(seconds[1]), view, 300
        )
        return measured(
            exact, view, self._run.pixel_noise, self._run.outliers, self._stream(_NOISE, number)
        )[:2]

    def _motion_from(self, start: float) -> Motion:
        def to_camera(world: Array, times: Array) -> Array:
            orientations, positions = self._motion.at(start + times)
            return np.asarray(orientations.inv().apply(world - positions))

        return to_camera

    def _stream(self, *key: int) -> np.random.Generator:
        return np.random.default_rng((self._run.seed, list(STRETCHES).index(self._name), *key))


class RecordedMotion:
    """Cubic splines of position and orientation through all poses.

    Times are seconds since the first pose.
    """

    def __init__(
        self,
        stamps_ns: NDArray[np.int64],
        positions: Array,
        rotations: Rotation,
    ) -> None:
        self._start_ns = int(stamps_ns[0])
        seconds = (stamps_ns - self._start_ns) / NANOSECONDS
        self.span = 0.0, float(seconds[-1])
        self._position = CubicSpline(seconds, positions)
        self._rotation = RotationSpline(seconds, rotations)

    def seconds(self, time_ns: int) -> float:
        """Time on this motion of a time on the poses' clock."""
        return (time_ns - self._start_ns) / NANOSECONDS

    def at(self, times: ArrayLike) -> tuple[Rotation, Array]:
        """Orientations in the world and positions (N, 3) [m] at times (N,) [s]."""
        times = np.asarray(times, dtype=np.float64)
        if len(times) and not (self.span[0] <= times.min() and times.max() <= self.span[1]):
            raise InputError(
                f'the poses last {self.span[1]:.3f} s, requested '
                f'{times.min():.3f} to {times.max():.3f} s'
            )
        return self._rotation(times), self._position(times)

    def states(self, times: ArrayLike) -> CameraStates:
        """Poses and derivatives at times (N,) [s]."""
        rotations, positions = self.at(times)
        return CameraStates(
            position=positions,
            R_world_cam=rotations.as_matrix(),
            velocity=self._position(times, 1),
            acceleration=self._position(times, 2),
            angular_velocity=self._rotation(times, 1),
            angular_acceleration=self._rotation(times, 2),
        )


# -- The camera model of the OCamCalib toolbox (Scaramuzza), in which PennCOSYVIO is calibrated ---
#
# With (c, d, e) and the polynomial f(rho) = a0 + a2 rho^2 + a3 rho^3 + ... (negative, its z axis
# points backwards), and m = (x, y) right and down from the centre on an ideal sensor:
#
#     u - cx = x + e y          v - cy = d x + c y          ray ~ (x, y, -f(|m|))

# Most steps of Newton's method in a projection. [chosen: any value in 10..100 would do]
_MAX_STEPS = 50
# Relative step at which it has converged. [chosen: exact to rounding in pixels]
_SETTLED = 1e-10


@dataclass(frozen=True, slots=True, kw_only=True)
class OmnidirectionalCamera(RollingShutterCamera):
    """A wide-angle rolling-shutter camera with a field of view below 180 degrees.

    `polynomial`: a0, a1, a2, ... as OCamCalib prints ``ss``; a1 is 0, as its model demands.
    `affine` (c, d, e): as OCamCalib names them. `fx` and `fy` are -a0, the pixels per radian at
    the centre; `cx` and `cy` its column and row, the first pixel being 0 (OCamCalib, in Matlab,
    counts from 1, and has row, column).
    """

    polynomial: tuple[float, ...]
    affine: tuple[float, float, float]

    @property
    def is_undistorted(self) -> bool:
        """Never a plain pinhole."""
        return False

    def project(self, points: ArrayLike) -> Array:
        """Raw pixels (N, 2) of points (N, 3) in the camera frame; NaN outside of the lens."""
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        across = np.hypot(points[:, 0], points[:, 1])
        # rho of the ray: rho * depth = -f(rho) * across, by Newton's method.
        with np.errstate(all='ignore'):
            angle = np.arctan2(across, points[:, 2])
            rho = -self.polynomial[0] * angle
            for _ in range(_MAX_STEPS):
                depth, by_rho = self._depth(rho)
                residual = rho * points[:, 2] - across * depth
                slope = points[:, 2] - across * rho * by_rho
                step = residual / slope
                rho = rho - step
                if not (np.abs(step) > _SETTLED * np.abs(rho)).any():
                    break
            observed = (
                (np.abs(step) <= 1e-6)
                & (rho >= 0.0)
                & (self._depth(rho)[0] > 0.0)
                & (points[:, 2] > 1e-9)
            )
            off_axis = across > 0.0
            scale = np.where(off_axis, rho / np.where(off_axis, across, 1.0), 0.0)
        pixels = (points[:, :2] * scale[:, None]) @ self._stretch.T + (self.cx, self.cy)
        pixels[~observed] = np.nan
        return pixels

    def unproject_with_jacobian(self, points: ArrayLike) -> tuple[Array, Array]:
        """Unit rays (N, 3) and their derivatives (N, 3, 2) by the raw pixel coordinates u, v."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        inverse = np.linalg.inv(self._stretch)
        plane = (points - (self.cx, self.cy)) @ inverse.T
        rho = np.hypot(plane[:, 0], plane[:, 1])
        depth, by_rho = self._depth(rho)
        depth = np.where(depth > 0.0, depth, np.nan)
        normalized = plane / depth[:, None]
        # d(m / depth)/dm = (I - n (d depth/dm)) / depth, with d depth/dm = by_rho m.
        depth_by_plane = by_rho[:, None] * plane
        by_plane = np.eye(2) - normalized[:, :, None] * depth_by_plane[:, None, :]
        by_pixel = by_plane / depth[:, None, None] @ inverse
        return rays_with_jacobian(normalized, np.ascontiguousarray(by_pixel))

    @property
    def _stretch(self) -> Array:
        c, d, e = self.affine
        return np.array([[1.0, e], [d, c]])

    def _depth(self, rho: Array) -> tuple[Array, Array]:
        """``-f(rho)`` and its derivative over rho (finite at 0, as a1 is 0)."""
        a = np.array(self.polynomial)
        return -polyval(rho, a), -polyval(rho, np.arange(2, len(a)) * a[2:])


# -- files ------------------------------------------------------------------------------------


def read_poses(folder: Path, sequence: str) -> tuple[NDArray[np.int64], Array, Rotation]:
    """Stamps [ns], positions [m] and rotations to the world (z up) of a sequence's rig."""
    inner = f'ground_truth/{sequence}/pose.txt'
    path = _first(folder, f'data/{inner}', inner)
    rows = list(read_rows(path, range(13), separator=None))
    stamps = np.array([row.seconds_as_nanoseconds(0) for row in rows], dtype=np.int64)
    if len(rows) < 4 or not (np.diff(stamps) > 0).all():
        raise InputError(f'{path} must hold at least 4 poses in the order of their stamps')
    values = np.array([[row.real(column) for column in range(1, 13)] for row in rows])
    matrices = values.reshape(-1, 3, 4)
    R = matrices[:, :, :3]
    squared = R @ R.transpose(0, 2, 1)
    off = np.abs(squared - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((off > 1e-3) | (np.linalg.det(R) < 0.0))
    if len(bad):
        raise rows[bad[0]].error('columns 2 to 13 must be a rotation and a position, row by row')
    return stamps, matrices[:, :, 3], Rotation.from_matrix(R)


def read_camera(folder: Path, readout_time: float) -> RollingShutterCamera:
    """Intrinsics of the GoPro C2; its readout time [s] has not been measured."""
    path = _first(folder, 'tools/intrinsic_calibration/cc.mat', 'calibration/cc.mat')
    try:
        model = loadmat(path)['cc'].flat[1]
        polynomial = tuple(map(float, np.ravel(model['ss'].flat[0])))
        xc, yc, c, d, e, width, height = (
            float(model[field].flat[0].item())
            for field in ('xc', 'yc', 'c', 'd', 'e', 'width', 'height')
        )
        if not (
            np.isfinite([*polynomial, xc, yc, c, d, e]).all()
            and abs(c - d * e) > 1e-3
            and polynomial[0] < 0.0
            and polynomial[1] == 0.0
            and len(polynomial) > 2
        ):
            raise ValueError('its values are not those of a lens')
    # Exceptions of SciPy and NumPy for other files and other contents.
    except (
        ValueError,
        KeyError,
        IndexError,
        TypeError,
        NotImplementedError,
        AttributeError,
        MatReadError,
        OSError,
    ) as error:
        raise InputError(f'{path} does not hold the OCamCalib model of C2: {error}') from error
    return OmnidirectionalCamera(
        width=int(width),
        height=int(height),
        fx=-polynomial[0],
        fy=-polynomial[0],
        cx=yc - 1.0,
        cy=xc - 1.0,
        readout_time=readout_time,
        reference_row='first',
        polynomial=polynomial,
        affine=(c, d, e),
    )


def _first(folder: Path, *places: str) -> Path:
    """The first of these places in the folder that is there."""
    for place in places:
        if (folder / place).exists():
            return folder / place
    raise MissingInputError(f'there is no {folder / places[0]}')
