"""``rs_relpose calibrate`` on rendered bags, end to end, against what they were rendered with.

Bags of a walk differ in scene, read-out, offset and axes; after them come one of a global shutter
and one whose camera turns about one axis only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import json
import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.calibration_tracks import about_one_axis
from rs_relpose_lab.experiments.tables import markdown_table, write_csv
from rs_relpose_lab.simulation import SimulationConfig
from rs_relpose_lab.simulation.bag import render_once
from rs_relpose_lab.simulation.scene import SCENES
from rs_relpose_ros.calibrate.axis_maps import axis_maps
from rs_relpose_ros.cli.main import main as rs_relpose

DURATION = 6.0


@dataclass(frozen=True, slots=True)
class CalibratedBag:
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


def measure(seed: int, kind: str, folder: Path) -> CalibratedBag:
    """Render a bag into `folder` unless it is there, and calibrate."""
    config = configuration(seed, kind)
    bag, _ = render_once(config, folder,
                         about_one_axis(0, DURATION) if kind == 'one axis' else None)
    code = rs_relpose(['calibrate', str(bag), '--out', str(folder / 'out')])
    told = json.loads((folder / 'out' / 'calibration.json').read_text(encoding='utf-8'))
    R_cam_imu = Rotation.from_quat(told['quat_cam_imu_xyzw'])
    turn = R_cam_imu * Rotation.from_matrix(config.R_cam_imu).inv()
    readout, offset = told['readout_time_s'], told['time_offset_s']
    rotation = told['rotation_from_axis_map_rad']
    return CalibratedBag(
        kind, seed, config.scene, code, told['shutter'], 1e3 * config.readout_time,
        1e3 * readout['value'], 1e3 * readout['sigma'], 1e3 * config.time_offset,
        1e3 * offset['value'], 1e3 * offset['sigma'], math.degrees(turn.magnitude()),
        math.degrees(rotation['sigma']), rotation['observable'])


def runs(bags: int, first_seed: int) -> list[tuple[int, str]]:
    """Seed and kind of each bag: walks, then a global shutter and a turn about one axis."""
    kinds = ['walk'] * bags + ['global', 'one axis']
    return [(first_seed + number, kind) for number, kind in enumerate(kinds)]


def write_report(folder: Path, bags: Sequence[CalibratedBag]) -> str:
    """Write the figures (CSV) and the table (Markdown), and return the latter."""
    write_csv(folder / 'calibration_bags.csv', bags)
    text = markdown_table(
        ['bag', 'scene', 'shutter', 'read-out [ms]', 'found', 'offset [ms]', 'found',
         'rotation off by [deg]', 'observable'],
        [[f'{bag.kind} {bag.seed}', bag.scene, bag.shutter, f'{bag.readout_true:.2f}',
          f'{bag.readout:.2f} +- {bag.readout_sigma:.2f}', f'{bag.offset_true:.2f}',
          f'{bag.offset:.2f} +- {bag.offset_sigma:.2f}',
          f'{bag.rotation_error:.2f} (sigma {bag.rotation_sigma:.2f})',
          'yes' if bag.rotation_observable else 'no'] for bag in bags])
    (folder / 'calibration_bags.md').write_text(text, encoding='utf-8')
    return text
