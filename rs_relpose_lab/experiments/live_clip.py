"""A short recording without a seam, for the live benchmark: rendered once, played for hours."""

from collections.abc import Callable, Iterator
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.simulation import simulate, Simulation, SimulationConfig
from rs_relpose_lab.simulation.bag import (
    Entry,
    image_entries,
    imu_entries,
    jpeg,
    made_once,
    write_in_order,
    write_parameters,
)
from rs_relpose_lab.simulation.motions import EYE_HEIGHT
from rs_relpose_lab.simulation.trajectory import DEGREE, Trajectory
from rs_relpose_ros.bags.sensor_topics import CAMERA_FRAME, COMPRESSED_TOPIC, IMU_DELAY
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds
from rs_relpose_ros.messages.outgoing import encoded_image_message

# Duration of the motion before it repeats itself [s].
PERIOD = 4.0
# Images per second of a clip. [chosen: usual cameras]
FPS = 30.0
# Samples of the IMU per second. [chosen: usual IMUs]
IMU_RATES = (200, 400)


def imu_topic(rate: int) -> str:
    """Topic of the clip's IMU of so many samples per second."""
    return f'/imu_{rate}/data_raw'


def configuration(width: int, height: int, imu_rate: int = IMU_RATES[0]) -> SimulationConfig:
    """Recording of a clip: 4 s of a hand-held-like walk in a hall, read out in 30 ms."""
    # Field of view of 71 deg across, for any size.
    return SimulationConfig(
        duration=PERIOD,
        fps=FPS,
        width=width,
        height=height,
        fx=0.7 * width,
        imu_rate=float(imu_rate),
    )


def prepare_clip(
    folder: Path, width: int, height: int, on_frame: Callable[[], object] = lambda: None
) -> tuple[Path, Path]:
    """Render a clip into a folder, unless it exists: a bag, and the parameter file of the node.

    Images are JPEG in colour, the IMU has all `IMU_RATES`; `on_frame` is called after each image.
    """

    def render(path: Path, parameters: Path) -> None:
        trajectory = closed_loop(PERIOD)
        first = simulate(configuration(width, height), trajectory=trajectory)
        # The scene, which takes the time, is the same for each rate of the IMU.
        others = [
            simulate(
                configuration(width, height, rate),
                trajectory=trajectory,
                scene=first.renderer.scene,
            )
            for rate in IMU_RATES[1:]
        ]
        with BagWriter(path) as bag:
            write_in_order(
                bag,
                _images(first, bag, on_frame),
                *(_imu_of_one_period(simulation, bag) for simulation in (first, *others)),
            )
        write_parameters(first, parameters)

    return made_once(folder, f'{width}x{height}', render)


def coloured(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A (H, W, 3) image, blue green red, whose channels differ, of about the same brightness."""
    return np.clip(np.rint(gray[..., None] * [0.75, 1.0, 1.15]), 0, 255).astype(np.uint8)


def _images(
    simulation: Simulation, bag: BagWriter, on_frame: Callable[[], object]
) -> Iterator[Entry]:
    def encode(stamp_ns: int, pixels: NDArray[np.uint8]) -> tuple[str, str, Any]:
        return (
            COMPRESSED_TOPIC,
            'sensor_msgs/msg/CompressedImage',
            encoded_image_message(
                stamp_ns,
                CAMERA_FRAME,
                jpeg(coloured(pixels), quality=95),
                bag.type,
                'bgr8; jpeg compressed bgr8',
            ),
        )

    return image_entries(simulation, bag, encode, on_frame)


def _imu_of_one_period(simulation: Simulation, bag: BagWriter) -> Iterator[Entry]:
    start_ns = simulation.config.start_ns + to_nanoseconds(IMU_DELAY)
    for entry in imu_entries(simulation, bag, imu_topic(round(simulation.config.imu_rate))):
        if start_ns <= entry[0] < start_ns + to_nanoseconds(PERIOD):
            yield entry


def seconds_into_loop(stamp_ns: int) -> float:
    """Time on the closed trajectory of a stamp of the endlessly played clip [s]."""
    start_ns = SimulationConfig().start_ns
    return (stamp_ns - start_ns) % to_nanoseconds(PERIOD) / NANOSECONDS


def closed_loop(period: float) -> Trajectory:
    """Trajectory from -2 to `period` + 2 seconds that repeats itself after `period` [s].

    Around an ellipse, half as deep as wide, at a mean speed of 1.5 m/s, with the bob of the steps
    and a hand's rotation about all axes (30 deg/s rms), looking along x. A recording played
    backwards is no substitute: its rows would still be those of the motion forwards.
    """
    # 25 control points a second: quintic splines through them follow steps of 2 Hz.
    count = round(25 * period)
    phase = 2.0 * math.pi * np.arange(count) / count
    steps = max(round(1.8 * period), 2)
    # Ramanujan's perimeter of an ellipse with half axes 1 and 1/2.
    half_width = 1.5 * period / 4.844
    positions = np.stack(
        [
            0.5 * half_width * np.cos(phase),
            half_width * np.sin(phase),
            EYE_HEIGHT + 0.03 * np.cos(steps * phase),
        ],
        axis=1,
    )
    angles = _waves(phase, period, ((1, 0.2), (2, 1.3), (5, 2.1)), 0.45)
    angles = np.stack(
        [
            angles,
            _waves(phase, period, ((1, 2.5), (3, 0.4), (6, 5.0)), 0.3),
            _waves(phase, period, ((2, 4.1), (4, 1.0), (7, 3.0)), 0.2),
        ],
        axis=1,
    )
    spacing = period / count
    before = math.ceil(2.0 / spacing) + DEGREE
    controls = np.arange(-before, count + before) % count
    return Trajectory(positions[controls], angles[controls], -before * spacing, spacing)


def _waves(
    phase: Array, period: float, waves: tuple[tuple[int, float], ...], rate: float
) -> Array:
    """Sum of harmonics (number, phase), each with its share of a rms `rate` [rad/s]."""
    total = np.zeros_like(phase)
    for harmonic, shift in waves:
        amplitude = rate * math.sqrt(2.0 / len(waves)) * period / (2.0 * math.pi * harmonic)
        total += amplitude * np.sin(harmonic * phase + shift)
    return total
