"""The paper's protocol on PennCOSYVIO's trajectories: its pairs as the methods get them.

Of eight stretches of the sequences 'as' and 'af', every fifth frame makes a pair with the one 30
frames later; angular velocity and gravity are means over 0.1 s. Points and IMU are simulated.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import math
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from rs_relpose_lab.experiments import penncosyvio_files as files
from rs_relpose_lab.experiments.methods import ContinuousGyro, METHODS, PairProblem, run_method
from rs_relpose_lab.experiments.paper import Record
from rs_relpose_lab.simulation.config import SimulationConfig
from rs_relpose_lab.simulation.render import view_of
from rs_relpose_lab.simulation.rows import in_both_views, in_front, measured, Motion
from rs_relpose_lab.simulation.simulation import ImuModel
from rs_relpose_lab.simulation.trajectory import CameraStates
from rs_relpose_ros.config.settings import EstimatorConfig, ImuConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.timing import ImageClock, NANOSECONDS, seconds_between, to_nanoseconds
from rs_relpose_ros.imu.buffer import frame_imu, ImuBuffer, ImuSample
from rs_relpose_ros.imu.filters import mean_gravity

# -- motion of a pair by an IMU: the paper's means, and the continuous gyro -------------------

@dataclass(frozen=True, slots=True, eq=False)
class MeanMotion:
    """Motion of a frame by the paper's means, at its reference row; sigmas [rad], [rad/s]."""

    motion: FrameMotion
    gravity_sigma: float
    rate_sigma: float


class PairImu:
    """Motion of the frames of a camera by the samples of an IMU in its axes, which cover them."""

    def __init__(self, samples: Sequence[ImuSample], clock: ImageClock) -> None:
        self._samples = samples
        self._stamps = [sample.stamp_ns for sample in samples]
        self._clock = clock

    def mean(self, stamp_ns: int) -> MeanMotion:
        """The paper's motion of a frame."""
        start_ns, end_ns = self._clock.exposed_span_ns(stamp_ns)
        # The paper: 'an average of the inertial measurements within 0.1 s near the image frame'.
        # Here it is centred on the middle row.
        middle_ns, half_ns = (start_ns + end_ns) // 2, to_nanoseconds(0.05)
        window = self._samples[bisect_left(self._stamps, middle_ns - half_ns):
                               bisect_right(self._stamps, middle_ns + half_ns)]
        rates = [s.angular_velocity for s in window if s.angular_velocity is not None]
        gravity = mean_gravity(np.array([s.linear_acceleration for s in window]))
        assert gravity is not None
        motion = FrameMotion(np.mean(rates, axis=0), gravity.direction)
        delay = seconds_between(middle_ns, self._clock.reference_ns(stamp_ns))
        # The deviation of a row's rate from the mean is that of the rates of the window.
        spread = float(np.sqrt(np.var(rates, axis=0).mean()))
        return MeanMotion(motion.shifted(delay), gravity.sigma, spread)

    def continuous(self, stamp1_ns: int, stamp2_ns: int) -> ContinuousGyro:
        """Motion of two frames by the continuous gyro, as in the node."""
        buffer = ImuBuffer(ImuConfig())
        # Noise may carry a match a few rows out of the image.
        edge_ns = to_nanoseconds(1e-3)
        spans = [(start_ns - edge_ns, end_ns + edge_ns) for start_ns, end_ns in
                 (self._clock.exposed_span_ns(stamp) for stamp in (stamp1_ns, stamp2_ns))]
        references = [self._clock.reference_ns(stamp) for stamp in (stamp1_ns, stamp2_ns)]
        # Gravity is filtered from 5 s before the first frame on.
        fed = bisect_left(self._stamps, spans[0][0] - to_nanoseconds(5.0))
        found = []
        for span, reference_ns in zip(spans, references, strict=True):
            # Interpolation needs a sample after the last row.
            until = bisect_right(self._stamps, span[1] + to_nanoseconds(0.1))
            for sample in self._samples[fed:until]:
                buffer.add(sample)
            fed = until
            found.append(frame_imu(buffer, span, reference_ns, np.eye(3)))
        first, second = found
        sigmas = [frame.gravity_sigma for frame in found if frame.gravity_sigma is not None]
        return ContinuousGyro(
            first.motion, second.motion, *buffer.rotation(*references),
            seconds_between(*references), EstimatorConfig().gyro_sigma, max(sigmas, default=None))


EXPERIMENT = 'penncosyvio'

# First and last frame of the stretches, from the paper's table 1; a frame's number is that of its
# row in pose.txt.
STRETCHES: Mapping[str, tuple[tuple[int, int], ...]] = {
    'as': ((206, 567), (1319, 1679), (2581, 2971), (4358, 4599)),
    'af': ((101, 551), (913, 1123), (1604, 1815), (2539, 2810)),
}
METHODS_OF_THE_EXPERIMENT = ('global_5pt', 'uniform_9pt', 'uniform_11pt', 'auto', 'auto_gyro',
                             'opencv_derotated', 'opencv_gyro')

# Nobody has measured it. What the data set's authors quote for a GoPro Hero 4 [s]:
# https://github.com/daniilidis-group/penncosyvio/issues/3
GOPRO_READOUT = 0.03


@dataclass(frozen=True, slots=True)
class Pair:
    """Two frames of a sequence, counted from 1; `stretch` is counted from 1, too."""

    sequence: str
    stretch: int
    first: int
    second: int


@dataclass(frozen=True, slots=True)
class PennCosyvioRun:
    """Parameters of the experiment."""

    sequences: tuple[str, ...]   # of `STRETCHES`
    methods: tuple[str, ...]   # of `METHODS`
    readout_time: float = GOPRO_READOUT   # [s]
    stamp_row: str = 'first'   # that a frame's stamp marks
    every: int = 5   # frames from one pair to the next
    distance: int = 30   # frames between the two of a pair
    seed: int = 0
    pixel_noise: float = 0.5   # 1 sigma [px]
    outliers: float = 0.3   # share of matches that are random

    def __post_init__(self) -> None:
        for name, least in (('every', 1), ('distance', 1), ('seed', 0)):
            if getattr(self, name) < least:
                raise InputError(f'{name} must be at least {least}, got {getattr(self, name)}')
        for name, high in (('pixel_noise', 20.0), ('outliers', 0.95)):
            if not 0.0 <= getattr(self, name) <= high:
                raise InputError(f'{name} must be in [0, {high:g}], got {getattr(self, name):g}')

    def pairs(self) -> list[Pair]:
        """Every pair, in the order of the tables."""
        return [Pair(sequence, stretch, first, first + self.distance)
                for sequence in self.sequences
                for stretch, (start, end) in enumerate(STRETCHES[sequence], start=1)
                for first in range(start, end - self.distance + 1, self.every)]


def run_penncosyvio(run: PennCosyvioRun, folder: Path,
                    on_pair: Callable[[], object] = lambda: None) -> list[Record]:
    """Estimate every pair by every method; `on_pair` is called after each pair."""
    sequences = {name: SimulatedSequence(folder, name, run) for name in run.sequences}
    records = []
    for pair in run.pairs():
        problem = sequences[pair.sequence].problem(pair)
        records += [Record(EXPERIMENT, pair.sequence, str(pair.stretch), name, pair.first,
                           *run_method(name, problem, pair.first)) for name in run.methods]
        on_pair()
    return records


# Independent random streams of one seed.
_IMU, _POINTS, _NOISE = range(3)


class SimulatedSequence:
    """A sequence whose points and IMU are simulated; frame k is taken at the k-th true pose."""

    def __init__(self, folder: Path, name: str, run: PennCosyvioRun) -> None:
        self._name, self._run = name, run
        self._camera = files.read_camera(folder, run.readout_time, run.stamp_row)
        poses = files.read_poses(folder, name)
        self._stamps_ns = poses.stamps_ns
        self._motion = RecordedMotion(poses)
        # The IMU is in the camera: axes and place of the real one would cancel.
        self._imu = PairImu(self._measure(), ImageClock(self._camera))

    def problem(self, pair: Pair) -> PairProblem:
        """Simulate the pair; the estimator gets the sigmas of the means."""
        if pair.second > len(self._stamps_ns):
            raise InputError(f'{self._name} must have a pose {pair.second}, but has '
                             f'{len(self._stamps_ns)}')
        stamps = [int(self._stamps_ns[number - 1]) for number in (pair.first, pair.second)]
        seconds = [self._motion.seconds(stamp) for stamp in stamps]
        (R1, R2), (p1, p2) = self._motion.at(seconds)
        points1, points2 = self._points(pair, seconds)
        first, second = (self._imu.mean(stamp) for stamp in stamps)
        # The largest sigmas that the estimator accepts are 1.5 rad and 1 rad/s.
        configured = EstimatorConfig(
            pixel_sigma=max(self._run.pixel_noise, 0.01),
            gravity_sigma=min(max(first.gravity_sigma, second.gravity_sigma), 1.5),
            gyro_sigma=min(math.hypot(EstimatorConfig().gyro_sigma,
                                      max(first.rate_sigma, second.rate_sigma)), 1.0))
        gyro = None
        if any(METHODS[name].continuous_gyro for name in self._run.methods):
            gyro = self._imu.continuous(*stamps)
        return PairProblem(
            points1, points2, self._camera, first.motion, second.motion,
            (R1.inv() * R2).as_matrix(), R1.inv().apply(p2 - p1), configured,
            np.ones(len(points1)), gyro)

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

    def _points(self, pair: Pair, seconds: list[float]) -> tuple[Array, Array]:
        view, rng = view_of(self._camera), self._stream(_POINTS, pair.first)
        (start, _), (origin, _) = self._motion.at(seconds)

        def candidates() -> Array:
            return in_front(view, start, origin, 600, (6.0, 34.0), rng)

        exact = in_both_views(candidates, self._motion_from(seconds[0]),
                              self._motion_from(seconds[1]), view, 300)
        return measured(exact, view, self._run.pixel_noise, self._run.outliers,
                        self._stream(_NOISE, pair.first))[:2]

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

    def __init__(self, poses: files.Poses) -> None:
        self._start_ns = int(poses.stamps_ns[0])
        seconds = (poses.stamps_ns - self._start_ns) / NANOSECONDS
        self.span = 0.0, float(seconds[-1])
        self._position = CubicSpline(seconds, poses.positions)
        self._rotation = RotationSpline(seconds, poses.rotations)

    def seconds(self, time_ns: int) -> float:
        """Time on this motion of a time on the poses' clock."""
        return (time_ns - self._start_ns) / NANOSECONDS

    def at(self, times: ArrayLike) -> tuple[Rotation, Array]:
        """Orientations in the world and positions (N, 3) [m] at times (N,) [s]."""
        times = np.asarray(times, dtype=np.float64)
        if len(times) and not (self.span[0] <= times.min() and times.max() <= self.span[1]):
            raise InputError(f'the poses last {self.span[1]:.3f} s, requested '
                             f'{times.min():.3f} to {times.max():.3f} s')
        return self._rotation(times), self._position(times)

    def states(self, times: ArrayLike) -> CameraStates:
        """Poses and derivatives at times (N,) [s]."""
        rotations, positions = self.at(times)
        return CameraStates(
            position=positions, R_world_cam=rotations.as_matrix(),
            velocity=self._position(times, 1), acceleration=self._position(times, 2),
            angular_velocity=self._rotation(times, 1),
            angular_acceleration=self._rotation(times, 2))
