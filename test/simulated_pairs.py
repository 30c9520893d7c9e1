"""Pairs of a camera that flies through points, exact: SciPy, none of the package's geometry."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
import two_view_scene

from rs_relpose_ros.estimator.landmarks import Landmarks, landmarks
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.front_end.derotated_rays import Sensor
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.tracking.matches import Matches

VELOCITY = np.array([0.8, -0.3, 1.5])   # m/s, in the world
# Of the keyframes [s]: unequal, so that each baseline is of another length.
TIMES = (0.0, 0.2, 0.5, 0.6, 1.0)
# Pinhole of the scene; what is seen outside of the image counts as well.
_INTRINSICS = Intrinsics(
    width=1920, height=1080, image_width=1920, image_height=1080, fx=two_view_scene.FOCAL,
    fy=two_view_scene.FOCAL, cx=two_view_scene.CENTRE[0], cy=two_view_scene.CENTRE[1])
SENSOR = Sensor(_INTRINSICS.global_shutter_camera(), _INTRINSICS)
START_NS = 1_700_000_000_900_000_000


@dataclass(frozen=True)
class Flight:
    """Consecutive pairs, and where the cameras were [m] in the axes of the first."""

    pairs: list[PairResult]
    positions: NDArray[np.float64]
    R: list[NDArray[np.float64]]
    baselines: NDArray[np.float64]
    # Of the matches of each pair: pixels that global shutters would see, points in the reference
    # camera [m].
    true_landmarks: list[Landmarks]


@dataclass(frozen=True)
class View:
    """What a keyframe sees of each point: its row time, distance [m], and derotated unit ray."""

    rotation: Rotation
    position: NDArray[np.float64]
    angular_velocity: NDArray[np.float64]
    pixels: NDArray[np.float64]
    tau: NDArray[np.float64]
    distances: NDArray[np.float64]
    rays: NDArray[np.float64]
    points: NDArray[np.float64]   # in the camera as it is at row time 0 [m]

    @property
    def pixels_at_once(self) -> NDArray[np.float64]:
        """Where a global shutter would see the points at row time 0."""
        return (two_view_scene.FOCAL * self.points[:, :2] / self.points[:, 2:]
                + two_view_scene.CENTRE)


def view(world: NDArray[np.float64], time: float, rng: np.random.Generator) -> View:
    rotation = Rotation.from_rotvec(rng.normal(size=3) * 0.1)
    position, w = time * VELOCITY, rng.normal(size=3)
    v = rotation.inv().apply(VELOCITY)
    local, tau, settled = two_view_scene.expose(world, rotation, position, w, v, 0.0, 60)
    assert settled.all()
    distances = np.linalg.norm(local, axis=1)
    rays = Rotation.from_rotvec(tau[:, None] * w).apply(local / distances[:, None])
    pixels = two_view_scene.FOCAL * local[:, :2] / local[:, 2:] + two_view_scene.CENTRE
    return View(rotation, position, w, pixels, tau, distances, rays,
                rotation.inv().apply(world - position))


def simulated_flight(seed: int, points: int = 120,
                     tracks: Iterable[NDArray[np.int64]] | None = None,
                     places: Sequence[float] = TIMES) -> Flight:
    """`tracks`: which points are matched, for each pair; all of them by default.

    `places`: at which time's place each keyframe is [s]; where it is that of the keyframe before,
    the pair is a pure rotation.
    """
    rng = np.random.default_rng(seed)
    world = rng.uniform([-4.0, -2.0, 6.0], [4.0, 2.0, 20.0], (points, 3))
    views = [view(world, time, rng) for time in places]
    chosen = [np.arange(points)] * (len(TIMES) - 1) if tracks is None else list(tracks)
    first, pairs, baselines, true_landmarks = views[0], [], [], []
    for k, (a, b, use) in enumerate(zip(views[:-1], views[1:], chosen, strict=True)):
        t = a.rotation.inv().apply(b.position - a.position)
        length = float(np.linalg.norm(t))
        baselines.append(length)
        # Shuffled: only the ids tell what belongs together.
        use = rng.permutation(use)
        pose = RelativePose(
            status=Status.OK, R=(a.rotation.inv() * b.rotation).as_matrix(),
            angular_velocity2=b.angular_velocity, inliers=np.ones(len(use), dtype=bool),
            covariance=1e-6 * np.eye(6), velocity_covariance=1e-4 * np.eye(6), model='uniform')
        if length > 0.0:
            pose = replace(pose, t=t / length,
                           linear_velocity1=a.rotation.inv().apply(VELOCITY) / length,
                           linear_velocity2=b.rotation.inv().apply(VELOCITY) / length)
        else:
            pose = pose.without_translation(Status.PURE_ROTATION, 'no translation')
        matches = Matches(use.astype(np.uint32) + 7, a.pixels[use], b.pixels[use],
                          np.ones(len(use)))
        true_landmarks.append(Landmarks(a.pixels_at_once[use], b.pixels_at_once[use],
                                        a.points[use]))
        pairs.append(PairResult(
            reference_stamp_ns=START_NS + round(1e9 * TIMES[k]),
            stamp_ns=START_NS + round(1e9 * TIMES[k + 1]),
            reference_ns1=START_NS + round(1e9 * TIMES[k]),
            reference_ns2=START_NS + round(1e9 * TIMES[k + 1]), frame_id='camera',
            interval=TIMES[k + 1] - TIMES[k], pose=pose,
            matches=matches, landmarks=landmarks(
                pose, a.rays[use], b.rays[use], a.tau[use], b.tau[use],
                SENSOR.camera) if pose else None,
            row_times1=a.tau[use], row_times2=b.tau[use], rays1=a.rays[use], rays2=b.rays[use],
            parallax=10.0))
    positions = np.array([first.rotation.inv().apply(v.position - first.position) for v in views])
    return Flight(pairs, positions, [(first.rotation.inv() * v.rotation).as_matrix()
                                     for v in views], np.array(baselines), true_landmarks)
