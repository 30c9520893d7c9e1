"""Simulated tracks and gyro of a rolling-shutter camera with a known calibration."""

from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.simulation.motions import hand_held, Plan
from rs_relpose_lab.simulation.rows import observe, View
from rs_relpose_lab.simulation.trajectory import FinePath, Trajectory
from rs_relpose_ros.calibration.observations import axis_maps, GyroSeries, TrackedPoints
from rs_relpose_ros.geometry import Array

# Time of the first image [ns]. [chosen: a usual time since 1970]
START_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Truth of a recording; rotation as ``v_cam = R_cam_imu v_imu``.

    Times [s], noise of the pixels [px] and of the gyro [rad/s/sqrt(Hz)], bias [rad/s], speed
    [m/s], rms of the rotation [rad/s].
    """

    readout_time: float = 0.025  # negative: read upwards
    time_offset: float = 0.02  # t_imu = stamp + time_offset + row / height * readout
    R_cam_imu: Array = field(default_factory=lambda: np.eye(3))
    gyro_bias: tuple[float, float, float] = (0.01, -0.02, 0.015)
    focal: float = 640.0
    width: int = 1280
    height: int = 720
    fps: float = 30.0
    frames: int = 300
    pixel_noise: float = 0.3
    outliers: float = 0.1
    gyro_rate: float = 200.0
    gyro_noise: float = 2e-4
    features: int = 200
    speed: float = 1.0
    rotation_rate: float = math.radians(30.0)
    exposure_slope: float = 0.0  # of the offset, by the interval to the frame before
    long_interval: float = 1.0  # intervals of the second half, relative to the first
    stamp_jitter: float = 0.0  # 1 sigma of each stamp [s]


def drawn(rng: np.random.Generator, axis_map: int | None = None, **given: Any) -> Truth:
    """Truth within the ranges that calibration must master.

    `axis_map` is a number below 24, else drawn; `given` are fields of `Truth` that are not drawn.
    """
    axis = rng.standard_normal(3)
    misalignment = Rotation.from_rotvec(math.radians(2.0) * axis / np.linalg.norm(axis))
    number = rng.integers(24) if axis_map is None else axis_map
    values: dict[str, Any] = {
        'readout_time': rng.uniform(0.008, 0.040),
        'time_offset': rng.uniform(-0.08, 0.08),
        'R_cam_imu': misalignment.as_matrix() @ axis_maps()[number],
        'gyro_bias': tuple(rng.uniform(-0.05, 0.05, 3)),
        'focal': rng.uniform(500.0, 1000.0),
        'gyro_rate': rng.choice([100.0, 200.0, 400.0]),
        'gyro_noise': 10.0 ** rng.uniform(-4.0, -3.4),
        'speed': rng.uniform(0.3, 1.6),
        'rotation_rate': np.radians(rng.uniform(20.0, 45.0)),
    } | given
    if values['readout_time'] > 0.9 / values.get('fps', 30.0):
        values['fps'] = 0.9 / values['readout_time']
    return Truth(**values)


def about_one_axis(axis: int, duration: float) -> Trajectory:
    """Camera that sways about one axis (0 yaw, 1 pitch, 2 roll) and is carried sideways."""
    spacing = 0.03
    times = -1.0 + spacing * np.arange(math.ceil((duration + 2.0) / spacing))
    x = 0.3 * np.sin(times)
    y = 0.5 * np.cos(0.7 * times)
    positions = np.column_stack([x, y, np.full(len(times), 1.6)])
    angles = np.zeros((len(times), 3))
    angles[:, axis] = 0.4 * np.sin(1.9 * times) + 0.1 * np.sin(5.0 * times)
    return Trajectory(positions, angles, float(times[0]), spacing, ())


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """Input of `calibrate`, and the truth."""

    tracks: TrackedPoints
    gyro: GyroSeries
    truth: Truth
    trajectory: Trajectory


def record(
    truth: Truth, rng: np.random.Generator, trajectory: Trajectory | None = None
) -> Recorded:
    """Tracks and gyro along a hand-held walk (or `trajectory`) among points of many depths."""
    intervals = np.full(truth.frames, 1.0 / truth.fps)
    intervals[truth.frames // 2 :] *= truth.long_interval
    # Instants of the first row on the IMU clock, which is the trajectory's.
    times = np.concatenate([[0.0], np.cumsum(intervals[:-1])])
    before = np.concatenate([intervals[:1], intervals[:-1]])
    offsets = truth.time_offset + truth.exposure_slope * (before - np.median(before))
    end = times[-1] + 0.2
    if trajectory is None:
        trajectory = hand_held(
            rng,
            -0.7,
            end + 0.5,
            Plan.parse(f'walk:{end + 1.0}'),
            speed=truth.speed,
            rotation_rate=truth.rotation_rate,
        )
    frames = _frames(truth, trajectory, times, _world(rng), rng)
    if truth.stamp_jitter:
        offsets = offsets + truth.stamp_jitter * rng.standard_normal(truth.frames)
    stamps = START_NS + np.rint((times - offsets) * 1e9).astype(np.int64)
    return Recorded(
        TrackedPoints(stamps, *frames), _gyro(truth, trajectory, end, rng), truth, trajectory
    )


def _gyro(
    truth: Truth, trajectory: Trajectory, end: float, rng: np.random.Generator
) -> GyroSeries:
    count = int((end + 0.5) * truth.gyro_rate)
    times = -0.5 + (np.arange(count) + rng.uniform()) / truth.gyro_rate
    rates = trajectory.states(times).angular_velocity @ truth.R_cam_imu
    sigma = truth.gyro_noise * math.sqrt(truth.gyro_rate)
    noise = sigma * rng.standard_normal(rates.shape)
    stamps = START_NS + np.rint(times * 1e9).astype(np.int64)
    return GyroSeries(stamps, rates + np.array(truth.gyro_bias) + noise)


def _world(rng: np.random.Generator) -> Array:
    """Points (N, 3) around the walk, 2.5 to 25 m away, on a floor, on walls and between them."""
    count = 4000
    azimuth = rng.uniform(-1.9, 1.9, count)
    elevation = rng.uniform(-1.0, 0.9, count)
    distance = 2.5 * 10.0 ** rng.uniform(0.0, 1.0, count)
    level = np.cos(elevation)
    x = level * np.cos(azimuth)
    y = level * np.sin(azimuth)
    direction = np.stack([x, y, np.sin(elevation)], axis=1)
    points = np.array([0.0, 0.0, 1.6]) + direction * distance[:, None]
    points[:, 2] = np.maximum(points[:, 2], 0.0)
    return points


def _frames(
    truth: Truth, trajectory: Trajectory, times: Array, world: Array, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    center = 0.5 * (np.array([truth.width, truth.height]) - 1.0)

    def project(local: Array) -> Array:
        return np.asarray(center + truth.focal * local[:, :2] / local[:, 2:])

    def unproject(pixels: Array) -> Array:
        normalized = (pixels - center) / truth.focal
        return np.column_stack([normalized, np.ones(len(pixels))])

    line_delay = truth.readout_time / truth.height
    view = View(project, unproject, truth.width, truth.height, line_delay, reference_row=0.0)
    path = FinePath(trajectory, times[0] - 0.1, times[-1] + 0.15)
    count = len(world)
    ids = np.full(count, -1, dtype=np.int64)  # track of a point that is followed
    drift = np.zeros((count, 2))
    start = np.zeros(count)
    next_id = 0
    frame = []
    track = []
    pixels = []
    for index, time in enumerate(times):
        points = observe(world, path.motion_from(time), view, margin=-2.0)
        visible = np.isfinite(points).all(axis=1)
        # A track is lost now and then, even in sight.
        lost = rng.uniform(size=count) < 0.02
        ids[~visible | lost] = -1
        free = truth.features - int((ids >= 0).sum())
        candidates = np.flatnonzero(visible & (ids < 0))
        new = rng.permutation(candidates)[: max(free, 0)]
        ids[new] = next_id + np.arange(len(new))
        next_id += len(new)
        # Half of the outliers slide over the scene, the others jump from frame to frame.
        slides = rng.uniform(size=len(new)) < 0.5 * truth.outliers
        drift[new] = slides[:, None] * rng.normal(0.0, 80.0, (len(new), 2))
        start[new] = time
        followed = np.flatnonzero(ids >= 0)
        age = (time - start[followed])[:, None]
        noise = truth.pixel_noise * rng.standard_normal((len(followed), 2))
        measured = points[followed] + drift[followed] * age + noise
        jumps = rng.uniform(size=len(followed)) < 0.25 * truth.outliers
        measured[jumps] += rng.uniform(-50.0, 50.0, (int(jumps.sum()), 2))
        frame.append(np.full(len(followed), index))
        track.append(ids[followed])
        pixels.append(measured)
    return np.concatenate(frame), np.concatenate(track), np.concatenate(pixels)
