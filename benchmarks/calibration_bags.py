"""``rs_relpose calibrate`` on rendered bags, end to end, against what they were rendered with.

    python benchmarks/calibration_bags.py --output OUT [--bags 6] [--first-seed 301]

Renders each bag (other scenes, read-outs, offsets and axes; after those walks one of a global
shutter and one whose camera turns about one axis only), runs the command, and writes
OUT/calibration_bags.csv and .md.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
import json
import math
from pathlib import Path
import shutil
import sys

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from rs_relpose_lab.experiments.calibration_tracks import about_one_axis
from rs_relpose_lab.experiments.tables import markdown_table, write_csv
from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.bag import write_bag
from rs_relpose_lab.simulation.config import SCENES
from rs_relpose_ros.calibrate.axis_maps import axis_maps
from rs_relpose_ros.cli.main import main as rs_relpose

DURATION = 6.0


@dataclass(frozen=True, slots=True)
class Row:
    """What one bag gave; ms and degrees."""

    kind: str
    seed: int
    scene: str
    exit_code: int
    shutter: str
    readout_true: float
    readout: float
    readout_sigma: float
    offset_true: float
    offset: float
    offset_sigma: float
    rotation_error: float
    rotation_sigma: float
    rotation_observable: bool


def configuration(seed: int, kind: str) -> SimulationConfig:
    """What a bag is drawn from."""
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    R = (Rotation.from_rotvec(math.radians(2.0) * axis / np.linalg.norm(axis))
         * Rotation.from_matrix(axis_maps()[rng.integers(24)]))
    readout_time = 0.0 if kind == 'global' else float(rng.uniform(0.010, 0.030))
    return SimulationConfig(
        seed=seed, duration=DURATION, scene=SCENES[seed % len(SCENES)], width=480, height=360,
        fx=340.0, edge_samples=1, readout_time=readout_time, plan=f'walk:{DURATION}',
        time_offset=float(rng.uniform(-0.08, 0.08)),
        quat_cam_imu_xyzw=tuple(float(v) for v in R.as_quat()))


def measure(seed: int, kind: str, folder: Path) -> Row:
    """Render a bag into `folder` unless it is there, and calibrate."""
    config = configuration(seed, kind)
    bag = folder / 'bag'
    if not (bag / 'metadata.yaml').exists():
        shutil.rmtree(bag, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        trajectory = about_one_axis(0, DURATION) if kind == 'one axis' else None
        write_bag(simulate(config, trajectory=trajectory), bag)
    code = rs_relpose(['calibrate', str(bag), '--out', str(folder / 'out')])
    told = json.loads((folder / 'out' / 'calibration.json').read_text(encoding='utf-8'))
    R_cam_imu = Rotation.from_quat(told['quat_cam_imu_xyzw'])
    turn = R_cam_imu * Rotation.from_matrix(config.R_cam_imu).inv()
    readout, offset = told['readout_time_s'], told['time_offset_s']
    rotation = told['rotation_from_axis_map_rad']
    return Row(
        kind, seed, config.scene, code, told['shutter'], 1e3 * config.readout_time,
        1e3 * readout['value'], 1e3 * readout['sigma'], 1e3 * config.time_offset,
        1e3 * offset['value'], 1e3 * offset['sigma'], math.degrees(turn.magnitude()),
        math.degrees(rotation['sigma']), rotation['observable'])


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n', 1)[0])
    parser.add_argument('--output', type=Path, required=True, metavar='DIR')
    parser.add_argument('--bags', type=int, default=6, metavar='N',
                        help='bags of a walk (default: 6)')
    parser.add_argument('--first-seed', type=int, default=301, metavar='N')
    args = parser.parse_args()
    kinds = ['walk'] * args.bags + ['global', 'one axis']
    rows = []
    for number, kind in enumerate(tqdm(kinds, unit='bag', disable=not sys.stderr.isatty())):
        seed = args.first_seed + number
        rows.append(measure(seed, kind, args.output / f'{seed}'))
    write_csv(args.output / 'calibration_bags.csv', rows)
    text = markdown_table(
        ['bag', 'scene', 'shutter', 'read-out [ms]', 'found', 'offset [ms]', 'found',
         'rotation off by [deg]', 'observable'],
        [[f'{row.kind} {row.seed}', row.scene, row.shutter, f'{row.readout_true:.2f}',
          f'{row.readout:.2f} +- {row.readout_sigma:.2f}', f'{row.offset_true:.2f}',
          f'{row.offset:.2f} +- {row.offset_sigma:.2f}',
          f'{row.rotation_error:.2f} (sigma {row.rotation_sigma:.2f})',
          'yes' if row.rotation_observable else 'no'] for row in rows])
    (args.output / 'calibration_bags.md').write_text(text, encoding='utf-8')
    print(text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
