"""Estimates of `two_view_scene`; pairs of a camera that flies through points, exact, by SciPy."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments import problems
from rs_relpose_lab.experiments.problems import VIEW
from rs_relpose_lab.simulation.rows import observe, uniform_motion
from rs_relpose_ros import estimate_relative_pose, FrameMotion, RollingShutterCamera
from rs_relpose_ros.estimator.result import Diagnostics, Landmarks, landmarks, RelativePose, Status
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.geometry.matches import Matches
from rs_relpose_ros.geometry.timing import ImageClock, Sensor
from rs_relpose_ros.pipeline.pair import PairResult

SCENE_CAMERA = {
    'width': VIEW.width,
    'height': VIEW.height,
    'fx': problems.FOCAL,
    'fy': problems.FOCAL,
    'cx': problems.CENTRE_U,
    'cy': problems.CENTRE_V,
    'readout_time': VIEW.height * VIEW.line_delay,
}


def estimate_scene(scene, config, gravity=True, camera=(), **arguments):
    """`camera`: what differs from the camera of the scene."""
    return estimate_relative_pose(
        scene.points1,
        scene.points2,
        RollingShutterCamera(**SCENE_CAMERA | dict(camera)),
        FrameMotion(scene.measured_rate1, scene.measured_gravity1 if gravity else None),
        FrameMotion(scene.measured_rate2, scene.measured_gravity2 if gravity else None),
        config=config,
        **arguments,
    )


VELOCITY = np.array([0.8, -0.3, 1.5])  # m/s, in the world
# Of the keyframes [s]: unequal, so that each baseline is of another length.
TIMES = (0.0, 0.2, 0.5, 0.6, 1.0)
# Pinhole of the scene; points outside of the image count as well.
_INTRINSICS = Intrinsics(
    image_width=1920,
    image_height=1080,
    **{key: value for key, value in SCENE_CAMERA.items() if key != 'readout_time'},
)
_CAMERA = _INTRINSICS.global_shutter_camera()
SENSOR = Sensor(_CAMERA, _INTRINSICS, ImageClock(_CAMERA))
START_NS = 1_700_000_000_900_000_000


@dataclass(frozen=True)
class Flight:
    """Consecutive pairs, and where the cameras were [m] in the axes of the first."""

    pairs: list[PairResult]
    positions: NDArray[np.float64]
    R: list[NDArray[np.float64]]
    baselines: NDArray[np.float64]
    # Of the matches of each pair: equivalent global-shutter pixels, points in the reference
    # camera [m].
    true_landmarks: list[Landmarks]


class Keyframe:
    """Pose and motion; of each point pixel, row time, derotated unit ray, place at row time 0."""

    def __init__(self, world: NDArray[np.float64], time: float, rng: np.random.Generator) -> None:
        self.rotation = Rotation.from_rotvec(rng.normal(size=3) * 0.1)
        self.position = time * VELOCITY
        self.rate = rng.normal(size=3)
        self.velocity = self.rotation.inv().apply(VELOCITY)
        motion = uniform_motion(self.rotation, self.position, self.rate, self.velocity)
        self.pixels = observe(world, motion, VIEW, margin=np.inf)
        self.tau = self.pixels[:, 1] * VIEW.line_delay
        local = motion(world, self.tau)
        self.rays = Rotation.from_rotvec(self.tau[:, None] * self.rate).apply(
            local / np.linalg.norm(local, axis=1, keepdims=True)
        )
        self.points = self.rotation.inv().apply(world - self.position)


def simulated_flight(
    seed: int,
    points: int = 120,
    tracks: Iterable[NDArray[np.int64]] | None = None,
    places: Sequence[float] = TIMES,
) -> Flight:
    """`tracks`: which points are matched, for each pair; all of them by default.

    `places`: time of the position of each keyframe [s]; a pair with equal times is a pure
    rotation.
    """
    rng = np.random.default_rng(seed)
    world = rng.uniform([-4.0, -2.0, 6.0], [4.0, 2.0, 20.0], (points, 3))
    frames = [Keyframe(world, time, rng) for time in places]
    chosen = [np.arange(points)] * (len(TIMES) - 1) if tracks is None else list(tracks)
    pairs = []
    true_landmarks = []
    for k, (a, b, use) in enumerate(zip(frames[:-1], frames[1:], chosen, strict=True)):
        # Shuffled: only the ids identify the tracks.
        shuffled = rng.permutation(use)
        pairs.append(_exact_pair(TIMES[k], TIMES[k + 1], a, b, shuffled))
        seen_1 = a.points[shuffled]
        seen_2 = b.points[shuffled]
        true_landmarks.append(Landmarks(VIEW.project(seen_1), VIEW.project(seen_2), seen_1))
    places_m = np.array([frame.position for frame in frames])
    baselines = np.linalg.norm(np.diff(places_m, axis=0), axis=1)
    to_first = frames[0].rotation.inv()
    positions = to_first.apply(places_m - places_m[0])
    rotations = [(to_first * frame.rotation).as_matrix() for frame in frames]
    return Flight(pairs, positions, rotations, baselines, true_landmarks)


def _exact_pair(
    begin: float, end: float, a: Keyframe, b: Keyframe, use: NDArray[np.int64]
) -> PairResult:
    """The pair of two keyframes at times [s], whose pose and matches have no error."""
    t = a.rotation.inv().apply(b.position - a.position)
    length = float(np.linalg.norm(t))
    pose = RelativePose(
        status=Status.OK,
        R=(a.rotation.inv() * b.rotation).as_matrix(),
        angular_velocity2=b.rate,
        inliers=np.ones(len(use), dtype=bool),
        covariance=1e-6 * np.eye(6),
        velocity_covariance=1e-4 * np.eye(6),
        diagnostics=Diagnostics(model='uniform'),
    )
    if length > 0.0:
        pose = replace(
            pose,
            t=t / length,
            linear_velocity1=a.velocity / length,
            linear_velocity2=b.velocity / length,
        )
    else:
        pose = pose.without_translation(Status.PURE_ROTATION, 'no translation')
    matches = Matches(
        use.astype(np.uint32) + 7,
        np.stack([a.pixels[use], b.pixels[use]]),
        np.ones(len(use)),
        np.stack([a.rays[use], b.rays[use]]),
        np.stack([a.tau[use], b.tau[use]]),
    )
    points = cache(partial(landmarks, pose, matches.rays, matches.row_times, SENSOR.camera))
    stamps = [START_NS + round(1e9 * time) for time in (begin, end)]
    parallax = 10.0
    return PairResult(
        *stamps,
        *stamps,
        'camera',
        end - begin,
        pose,
        matches,
        parallax,
        points if pose else None,
    )
