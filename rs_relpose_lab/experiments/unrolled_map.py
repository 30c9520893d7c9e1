"""The map of images turned to their middle row, against the truth of a simulation.

It is compared with where the renderer, which shares no code with it, sees the points of the scene
that a camera shows all of whose rows are read at the middle instant.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
import tempfile

import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.simulation import simulate, Simulation, SimulationConfig
from rs_relpose_lab.simulation.bag import write_parameters
from rs_relpose_lab.simulation.render import Renderer, view_of
from rs_relpose_lab.simulation.rows import see
from rs_relpose_lab.simulation.scene import SCENES
from rs_relpose_lab.simulation.trajectory import Trajectory
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.front_end.front_end import FrameProcessed
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.global_shutter.frames import EncodedColorFrame, GlobalShutterFrame
from rs_relpose_ros.global_shutter.unroller import unrolling_loop
from rs_relpose_ros.images.encoded import RawImage
from rs_relpose_ros.imu.samples import ImuSample

Array = NDArray[np.float64]

# Pixels from one compared point to the next.
_SPACING = 20.0
# IMU that comes before a frame is asked for, beyond its last row [s]: a tracked time offset may
# need it.
_AHEAD = 0.02


@dataclass(frozen=True, slots=True)
class MapErrors:
    """Distances [px] between sources of pixels by the map and by the truth, over a recording.

    `left`: to where the scene's points really are; `predicted`: of these to where rotation alone
    would put them; `map`: of the latter to the map, which knows rotation alone. Median and 90 %.
    """

    name: str
    readout_ms: float
    rate: float   # [rad/s] largest
    left: float
    left_p90: float
    predicted: float
    predicted_p90: float
    map: float
    map_p90: float


def swinging(rate: float, seconds: float, tilt: float = 0.3) -> Trajectory:
    """A camera that swings about a fixed centre, mostly about the vertical; largest rate [rad/s].

    `tilt`: share of the rate about the other axes.
    """
    spacing, frequency = 0.02, 1.1
    times = np.arange(-1.0, seconds + 1.0, spacing)
    phase = 2.0 * np.pi * frequency * times
    swing = rate / (2.0 * np.pi * frequency) / np.hypot(1.0, tilt) * np.sin(phase)
    angles = np.stack([swing, tilt * swing * np.cos(0.4 * phase), tilt * swing], axis=1)
    return Trajectory(np.tile([0.0, 0.0, 1.6], (len(times), 1)), angles, times[0], spacing)


def told(simulation: Simulation) -> Parameters:
    """Parameters as a calibration would tell them."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'parameters.yaml'
        write_parameters(simulation, path)
        return read_parameters(path)


def turned_frames(simulation: Simulation, parameters: Parameters, *,
                  images: bool = False) -> Iterator[tuple[int, GlobalShutterFrame]]:
    """Number of each frame, and what it is turned to; black images where none are rendered."""
    config, camera = simulation.config, simulation.camera
    intrinsics = Intrinsics(
        width=config.width, height=config.height, fx=camera.fx, fy=camera.fy, cx=camera.cx,
        cy=camera.cy, distortion_model=camera.distortion_model, distortion=camera.distortion,
        image_width=config.width, image_height=config.height)
    loop = unrolling_loop(parameters, offline=True)
    imu, fed = simulation.imu, 0
    black = np.zeros((config.height, config.width), dtype=np.uint8)
    for index in range(config.frame_count):
        until = int(np.searchsorted(imu.stamps_ns, simulation.reference_ns(index)
                                    + to_nanoseconds(camera.row_time_span[1] + _AHEAD)))
        for k in range(fed, until):
            loop.sequencer.add_imu(ImuSample(
                int(imu.stamps_ns[k]), tuple(imu.angular_velocities[k].tolist()),
                tuple(imu.linear_accelerations[k].tolist())))
        fed = until
        pixels = simulation.image(index) if images else black
        loop.sequencer.add_frame(EncodedColorFrame(simulation.stamp_ns(index), RawImage(
            pixels.ravel(), 'mono8', config.width, config.height, config.width, False), '',
            intrinsics))
        outcome = loop.step()
        assert isinstance(outcome, FrameProcessed), outcome
        assert outcome.result is not None
        yield index, outcome.result


def middle_renderer(simulation: Simulation) -> Renderer:
    """The same camera with all rows read at one instant."""
    return Renderer(simulation.renderer.scene, replace(simulation.camera, readout_time=0.0),
                    simulation.trajectory, simulation.config.edge_samples)


def middle_seconds(simulation: Simulation, index: int) -> float:
    """Instant of the middle row of a frame on the trajectory [s]."""
    camera = simulation.camera
    return simulation.seconds(simulation.reference_ns(index)) + float(
        camera.row_times(0.5 * (camera.height - 1)))


def map_errors(name: str, config: SimulationConfig,
               trajectory: Trajectory | None = None) -> MapErrors:
    """Compare the maps of all frames of a recording with the truth."""
    simulation = simulate(config, trajectory=trajectory)
    still, camera = middle_renderer(simulation), simulation.camera
    points = np.stack(np.meshgrid(np.arange(0.0, config.width, _SPACING),
                                  np.arange(0.0, config.height, _SPACING)), -1).reshape(-1, 2)
    columns, rows = points.astype(int).T
    distances, rate = [], 0.0
    for index, turned in turned_frames(simulation, told(simulation)):
        middle = middle_seconds(simulation, index)
        reference = simulation.seconds(simulation.reference_ns(index))
        world, _ = still.locate(middle, points)
        seen = simulation.renderer.project(reference, world)
        by_rotation = _seen_by_rotation(simulation, reference, world, middle)
        sources = np.concatenate([band for _, band in turned.map.bands()])
        by_map = sources[rows, columns]
        rate = max(rate, float(np.linalg.norm(simulation.trajectory.states(
            reference + np.asarray(camera.row_time_span)).angular_velocity, axis=1).max()))
        distances.append(np.stack([np.linalg.norm(difference, axis=1) for difference in (
            seen - by_map, seen - by_rotation, by_rotation - by_map)], axis=1))
    all_distances = np.concatenate(distances)
    known = all_distances[np.isfinite(all_distances).all(axis=1)]
    (left, predicted, of_map), (left90, predicted90, of_map90) = np.percentile(
        known, (50, 90), axis=0)
    return MapErrors(name, 1e3 * config.readout_time, rate, left, left90, predicted, predicted90,
                     of_map, of_map90)


def _seen_by_rotation(simulation: Simulation, reference: float, world: Array,
                      middle: float) -> Array:
    """Where a camera would see world points that only turned, from where it is at `middle`."""
    centre, _ = simulation.trajectory.poses([middle])

    def motion(directions: Array, times: Array) -> Array:
        _, rotations = simulation.trajectory.poses(reference + times)
        return np.asarray(np.einsum('nji,nj->ni', rotations, directions))

    return see(world - centre, motion, view_of(simulation.camera), margin=0.5)


# Name, recording, and the motion where it is not that of the recording's seed.
Case = tuple[str, SimulationConfig, Trajectory | None]


def map_cases(walks: int, first_seed: int) -> list[Case]:
    """Swings of 1 and 3 rad/s, read down and up, then walks."""
    cases: list[Case] = []
    for rate, direction in ((1.0, 'down'), (3.0, 'down'), (3.0, 'up')):
        config = SimulationConfig(seed=first_seed, duration=2.0, readout_direction=direction)
        cases.append((f'swing {rate:g} rad/s, read {direction}', config, swinging(rate, 2.0)))
    for seed in range(first_seed, first_seed + walks):
        config = SimulationConfig(seed=seed, scene=SCENES[seed % len(SCENES)], duration=2.0,
                                  plan='walk:2.0')
        cases.append((f'walk {config.scene} {seed}', config, None))
    return cases
