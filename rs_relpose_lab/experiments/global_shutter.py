"""`rs_relpose benchmark global-shutter`: images turned to their middle row, measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
import statistics
import time
from typing import TYPE_CHECKING

import cv2
import numpy as np

from rs_relpose_lab.experiments.tables import markdown_table, write_csv
from rs_relpose_lab.experiments.unrolled_map import MapErrors
from rs_relpose_lab.experiments.unrolled_poses import FivePoint
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.front_end.front_end import FrameProcessed
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.global_shutter.frames import EncodedColorFrame
from rs_relpose_ros.global_shutter.unroller import unrolling_loop
from rs_relpose_ros.images.encoded import RawImage
from rs_relpose_ros.imu.samples import ImuSample

if TYPE_CHECKING:   # what is measured without ROS needs none
    from rs_relpose_lab.live.beside import Beside

SIZES = ((640, 480), (1280, 720))

_FRAMES = 150
_FRAME_NS, _IMU_NS = NANOSECONDS // 30, NANOSECONDS // 200


@dataclass(frozen=True, slots=True)
class Speed:
    """Processor time of a frame of gray pixels [ms]: median and 90 %, of one thread."""

    width: int
    height: int
    median: float
    p90: float


def frame_times(width: int, height: int) -> Speed:
    """Turn frames of noise, from the mailbox to the turned pixels, on one core."""
    cv2.setNumThreads(1)
    intrinsics = Intrinsics(
        width=width, height=height, fx=0.7 * width, fy=0.7 * width, cx=0.5 * width,
        cy=0.5 * height, distortion=(-0.12, 0.05, 8e-4, -5e-4, 0.0), image_width=width,
        image_height=height)
    loop = unrolling_loop(Parameters.from_mapping(
        {'readout_time': 0.03, 'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0]}), offline=True)
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, width * height, dtype=np.uint8)
    image = RawImage(pixels, 'mono8', width, height, width, False)
    times, stamp_ns = [], 0
    for frame in range(1, _FRAMES + 1):
        while stamp_ns < frame * _FRAME_NS + NANOSECONDS // 25:
            rate = 2.0 * np.sin(1e-9 * stamp_ns * np.array([7.0, 5.0, 3.0]))
            loop.sequencer.add_imu(ImuSample(
                stamp_ns, tuple((rate + 1e-3 * rng.standard_normal(3)).tolist()),
                (0.0, -9.81, 0.0)))
            stamp_ns += _IMU_NS
        loop.sequencer.add_frame(EncodedColorFrame(frame * _FRAME_NS, image, '', intrinsics))
        started = time.thread_time()
        outcome = loop.step()
        assert isinstance(outcome, FrameProcessed), outcome
        assert outcome.result is not None
        outcome.result.image()
        times.append(1e3 * (time.thread_time() - started))
    # The first one loads or compiles the kernels.
    return Speed(width, height, *map(float, np.percentile(times[1:], (50, 90))))


def write_report(folder: Path, maps: Sequence[MapErrors], bags: Sequence[FivePoint],
                 speeds: Sequence[Speed], beside: Sequence[Beside] = ()) -> str:
    """Write the figures (CSV) and the report (Markdown), and return the latter."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = []
    if maps:
        write_csv(folder / 'map.csv', maps)
        parts.append('Sources of pixels [px], median / 90 %\n\n' + markdown_table(
            ('recording', 'read-out [ms]', 'largest rate [rad/s]', 'map to truth',
             'moved by translation', 'map to rotation alone'),
            [(m.name, f'{m.readout_ms:.0f}', f'{m.rate:.1f}', f'{m.left:.3f} / {m.left_p90:.3f}',
              f'{m.predicted:.3f} / {m.predicted_p90:.3f}', f'{m.map:.3f} / {m.map_p90:.3f}')
             for m in maps]))
    if bags:
        write_csv(folder / 'five_point.csv', bags)
        rows = [(b.name, f'{b.readout_ms:.0f}', f'{b.raw_rotation:.3f}',
                 f'{b.raw_translation:.2f}', f'{b.turned_rotation:.3f}',
                 f'{b.turned_translation:.2f}', f'{b.rotation_ratio:.1f}',
                 f'{b.translation_ratio:.1f}') for b in bags]
        parts.append("OpenCV's 5-point, median errors [deg]\n\n" + markdown_table(
            ('recording', 'read-out [ms]', 'raw: R', 't', 'turned: R', 't', 'ratio of R',
             'of t'), rows))
        walks = [b for b in bags if b.simulated]
        if walks:
            parts.append('Median of the ratios of the simulated ones: rotation '
                         f'{statistics.median(b.rotation_ratio for b in walks):.1f}, translation '
                         f'{statistics.median(b.translation_ratio for b in walks):.1f}\n')
    if speeds:
        write_csv(folder / 'speed.csv', speeds)
        parts.append('Processor time of a frame [ms]\n\n' + markdown_table(
            ('size', *(field.name for field in fields(Speed)[2:])),
            [(f'{s.width}x{s.height} mono8', f'{s.median:.1f}', f'{s.p90:.1f}') for s in speeds]))
    if beside:
        write_csv(folder / 'beside.csv', beside)
        parts.append('Both nodes at once, raw mono8 at 30 Hz\n\n' + markdown_table(
            ('node', 'frames', 'dropped', 'frame [ms]', 'latency 50 % [ms]', '99 %',
             'processor [%]'),
            [(b.node, f'{b.received}', f'{b.refused}', f'{b.frame_time_p50:.1f}',
              f'{b.latency_p50:.1f}', f'{b.latency_p99:.1f}', f'{b.cpu_percent:.0f}')
             for b in beside]))
    text = '\n'.join(parts)
    (folder / 'global_shutter.md').write_text(text, encoding='utf-8')
    return text
