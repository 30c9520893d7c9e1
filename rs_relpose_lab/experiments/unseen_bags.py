"""The live node on bags that nobody tuned on: other seeds, scenes and read-outs than the demo's.

Each is rendered, played in real time to a node of its own over Fast DDS, and node and OpenCV (at
the threshold that suits it best) are compared with the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
import statistics

from rs_relpose_lab.experiments.comparison import compare_live, is_still
from rs_relpose_lab.experiments.tables import markdown_table, write_csv
from rs_relpose_lab.simulation import SimulationConfig
from rs_relpose_lab.simulation.bag import render_once
from rs_relpose_lab.simulation.scene import SCENES
from rs_relpose_ros.estimator.result import Status


@dataclass(frozen=True, slots=True)
class UnseenBag:
    """What one bag gave; errors are medians in degrees."""

    seed: int
    scene: str
    readout_ms: float
    frames: int
    processed: int
    pairs: int
    moving: int
    answered: int
    answered_still: int
    unequal_to_replay: int
    rotation: float
    translation: float
    opencv_rotation: float
    opencv_translation: float


def configurations(bags: int, first_seed: int) -> list[SimulationConfig]:
    """Recordings of 6 s; scenes take turns, read-outs are spread from 12 to 35 ms."""
    return [SimulationConfig(seed=first_seed + k, scene=SCENES[k % len(SCENES)], duration=6.0,
                             readout_time=round(0.012 + 0.023 * k / max(bags - 1, 1), 4))
            for k in range(bags)]


def measure(config: SimulationConfig, folder: Path) -> UnseenBag:
    """Render a bag into `folder` unless it is there, and run the node on it."""
    # Here, so that the arguments of the command are known without ROS.
    from rs_relpose_lab.live.live_run import run_live

    bag, parameters = render_once(config, folder)
    live = run_live(bag, parameters, folder)
    replayed = compare_live(live.table, live.stamps, bag, parameters, folder)
    opencv = min(replayed.opencv_scores(), key=lambda s: s.rotation[0])
    node, still = replayed.node, [record for record in replayed.records if is_still(record)]
    return UnseenBag(
        config.seed, config.scene, 1e3 * config.readout_time, replayed.frames, replayed.processed,
        node.pairs, node.pairs - len(still), node.answered,
        sum(r.status is Status.OK for r in still), replayed.unequal, node.rotation[0],
        node.translation[0], opencv.rotation[0], opencv.translation[0])


def write_report(folder: Path, bags: Sequence[UnseenBag]) -> str:
    """Write the figures (CSV) and the report (Markdown), and return the latter."""
    write_csv(folder / 'unseen_bags.csv', bags)
    text = markdown_table(
        ('scene', 'seed', 'read-out [ms]', 'frames used', 'moving pairs', 'poses', 'R [deg]',
         't [deg]', "OpenCV's best: R", 't'),
        [(b.scene, f'{b.seed}', f'{b.readout_ms:.1f}', f'{b.processed}/{b.frames}', f'{b.moving}',
          f'{b.answered}', f'{b.rotation:.3f}', f'{b.translation:.2f}', f'{b.opencv_rotation:.3f}',
          f'{b.opencv_translation:.2f}') for b in bags])
    ratios = [b.opencv_rotation / b.rotation for b in bags]
    text += (
        f'\nMedian over the bags: rotation {statistics.median(b.rotation for b in bags):.3f} deg, '
        f'translation {statistics.median(b.translation for b in bags):.2f} deg; rotation '
        f'{statistics.median(ratios):.0f} times better than OpenCV (least {min(ratios):.0f}); '
        f'{sum(b.answered_still for b in bags)} poses of a still camera; '
        f'{sum(b.unequal_to_replay for b in bags)} poses not bit-equal to the replay.\n')
    (folder / 'unseen_bags.md').write_text(text, encoding='utf-8')
    return text
