"""The live node on bags that nobody tuned on: other seeds, scenes and read-outs than the demo's.

    python benchmarks/unseen_bags.py --output OUT [--bags 10] [--first-seed 201]

Renders each bag, plays it in real time to a node of its own over Fast DDS, and compares node and
OpenCV (at the threshold that suits it best) with the truth. Writes OUT/unseen_bags.csv.
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import dataclass
from pathlib import Path
import shutil
import statistics
import sys

from tqdm import tqdm

from rs_relpose_lab.experiments.comparison import differing_poses, is_still, score_of_table
from rs_relpose_lab.experiments.opencv_baseline import best_opencv_score, METHODS
from rs_relpose_lab.live.live_run import run_live
from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.bag import write_bag, write_parameters
from rs_relpose_lab.simulation.config import SCENES
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.replay.outputs import POSES_FILE, replay_into
from rs_relpose_ros.replay.run import read_truth, ReplayedPair
from rs_relpose_ros.replay.stamps import read_stamps

SHORTEST_READOUT, LONGEST_READOUT = 0.012, 0.035
DURATION = 6.0


@dataclass(frozen=True, slots=True)
class Row:
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


def render(seed: int, scene: str, readout_time: float, folder: Path) -> tuple[Path, Path]:
    """The bag and its parameter file, rendered if they are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    path, parameter_file = folder / 'bag', folder / 'bag.yaml'
    if not parameter_file.exists():
        shutil.rmtree(path, ignore_errors=True)  # half written by a run that was stopped
        simulation = simulate(SimulationConfig(seed=seed, scene=scene, readout_time=readout_time,
                                               duration=DURATION))
        write_bag(simulation, path)
        write_parameters(simulation, parameter_file)
    return path, parameter_file


def measure(seed: int, scene: str, readout_time: float, folder: Path) -> Row:
    """Render a bag into `folder`, and run the node on it."""
    path, parameter_file = render(seed, scene, readout_time, folder)
    live = run_live(path, parameter_file, folder)
    pairs: list[ReplayedPair] = []
    with open_bag(path) as bag:
        topics = bag.find_topics()
        truth = read_truth(bag, topics)
        assert truth is not None
        replayed = replay_into(folder, bag, topics, read_parameters(parameter_file),
                               stamps=read_stamps(live.stamps), pictures=False,
                               on_pair=pairs.append)
    answered = [pair for pair in pairs if pair.result.pose]
    assert replayed.intrinsics is not None
    opencv = min((best_opencv_score(method, answered, replayed.intrinsics, truth)
                  for method in METHODS), key=lambda s: s.rotation[0])
    node = score_of_table('', live.table, replayed.records, truth)
    still = [record for record in replayed.records if is_still(record)]
    unequal, _ = differing_poses(live.table, folder / POSES_FILE)
    return Row(seed, scene, 1e3 * readout_time, topics.image.count, len(read_stamps(live.stamps)),
               node.pairs, node.pairs - len(still), node.answered,
               sum(r.status is Status.OK for r in still), unequal, node.rotation[0],
               node.translation[0], opencv.rotation[0], opencv.translation[0])


def main() -> int:
    """Run the command; its exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--output', type=Path, required=True, help='directory for bags and table')
    parser.add_argument('--bags', type=int, default=10, help='number of bags (default: 10)')
    parser.add_argument('--first-seed', type=int, default=201, help='seed of the first bag')
    args = parser.parse_args()
    rows = []
    for k in tqdm(range(args.bags), unit='bag', disable=not sys.stderr.isatty()):
        seed = args.first_seed + k
        readout = SHORTEST_READOUT + (LONGEST_READOUT - SHORTEST_READOUT) * (
            k / max(args.bags - 1, 1))
        try:
            rows.append(measure(seed, SCENES[k % len(SCENES)], round(readout, 4),
                                args.output / f'seed_{seed}'))
        except RsRelposeError as error:
            print(f'seed {seed}: {error}', file=sys.stderr)
            return 1
    with (args.output / 'unseen_bags.csv').open('w', newline='', encoding='ascii') as file:
        writer = csv.writer(file)
        writer.writerow(Row.__slots__)
        writer.writerows([getattr(row, name) for name in Row.__slots__] for row in rows)
    print(table(rows))
    return 0


def table(rows: list[Row]) -> str:
    """Lines to read."""
    head = ('seed  scene    read-out  frames used  moving pairs  poses    rotation  translation  '
            "OpenCV's best: rotation  translation")
    lines = [head, '-' * len(head)]
    lines += [f'{r.seed:4d}  {r.scene:8} {r.readout_ms:5.1f} ms  {r.processed:4d}/{r.frames:4d}  '
              f'{r.moving:12d}  {r.answered:5d}  {r.rotation:8.3f} deg  {r.translation:7.2f} deg'
              f'  {r.opencv_rotation:19.3f} deg  {r.opencv_translation:7.2f} deg' for r in rows]
    ratios = [r.opencv_rotation / r.rotation for r in rows]
    lines.append(
        f'median over the bags: rotation {statistics.median(r.rotation for r in rows):.3f} deg, '
        f'translation {statistics.median(r.translation for r in rows):.2f} deg; rotation '
        f'{statistics.median(ratios):.0f} times better than OpenCV (least {min(ratios):.0f}); '
        f'{sum(r.answered_still for r in rows)} poses of a still camera; '
        f'{sum(r.unequal_to_replay for r in rows)} poses not bit-equal to the replay')
    return '\n'.join(lines)


if __name__ == '__main__':
    sys.exit(main())
