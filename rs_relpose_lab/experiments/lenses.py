"""Whether an uncalibrated lens ends in poses: `calibrate`, and the pairs with its file."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from rs_relpose_lab.experiments.consistency import (
    QUANTILE,
    R_FREEDOM,
    replayed,
    SIMULATED,
    T_FREEDOM,
)
from rs_relpose_lab.experiments.harness import markdown_table, write_table
from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.bag import made_once, right_parameters, write_bag
from rs_relpose_lab.simulation.scene import SCENES
from rs_relpose_ros.cli.main import main as rs_relpose
from rs_relpose_ros.config.files import read_parameters, SourcedValue, write_parameters
from rs_relpose_ros.geometry.camera import RollingShutterCamera

# First coefficient of each model: least and largest.
MODELS = {'plumb_bob': (-0.2, 0.1), 'equidistant': (-0.05, 0.05)}
# Focal length over that assumed by `calibrate`, 0.8 widths; error of the principal point [px].
FOCAL, CENTER = (0.8, 1.2), 10.0


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses of a bag, and the share of them beyond the 99.7 % quantile."""

    pairs: int = 0
    count: int = 0
    beyond_t: float = 0.0
    beyond_r: float = 0.0


@dataclass(frozen=True, slots=True)
class LensRun:
    """One bag: errors of the lens with their 1 sigma, and poses with it and with the true one.

    Focal length in per cent; principal point: the larger of both errors [px].
    """

    model: str
    seed: int
    exit_code: int
    focal_true: float
    radial_true: float
    focal: float = math.nan
    focal_sigma: float = math.nan
    radial: float = math.nan
    radial_sigma: float = math.nan
    center: float = math.nan
    center_sigma: float = math.nan
    calibrated: Poses = Poses()
    truth: Poses = Poses()


def lens_of(seed: int, model: str) -> tuple[SimulationConfig, RollingShutterCamera]:
    """Recording and camera of a bag: lens, readout and offset are drawn."""
    rng = np.random.default_rng([2, seed])
    width = SimulationConfig().width
    config = SimulationConfig(
        seed=seed, scene=SCENES[seed % len(SCENES)], fx=0.8 * width * rng.uniform(*FOCAL),
        readout_time=round(rng.uniform(0.012, 0.032), 4),
        time_offset=round(rng.uniform(-0.08, 0.08), 4))
    camera, shift = config.camera, rng.uniform(-CENTER, CENTER, 2)
    others = (0.0,) * (3 if model == 'equidistant' else 4)
    return config, replace(
        camera, cx=0.5 * (camera.width - 1) + shift[0], cy=0.5 * (camera.height - 1) + shift[1],
        distortion_model=model, distortion=(float(rng.uniform(*MODELS[model])), *others))


def on_lens(seed: int, model: str, seconds: float, folder: Path) -> LensRun:
    """Render a bag without CameraInfo unless it exists, calibrate, and replay with both lenses."""
    config, camera = lens_of(seed, model)
    config = replace(config, duration=seconds, plan=f'walk:{seconds}')

    def render(bag: Path, parameters: Path) -> None:
        simulation = simulate(config, camera=camera)
        write_bag(simulation, bag, camera_info=False)
        values = {**right_parameters(simulation), 'image_transport': 'compressed',
                  'camera_matrix': tuple(camera.camera_matrix.ravel().tolist()),
                  'distortion_model': camera.distortion_model,
                  'distortion_coefficients': camera.distortion}
        write_parameters(parameters, 'The truth.',
                         [SourcedValue(name, value, '') for name, value in values.items()])

    bag, truth = made_once(folder, 'bag', render)
    out = folder / 'calibration'
    code = rs_relpose(['calibrate', str(bag), '--lens', model, '--out', str(out)])
    run = LensRun(model, seed, code, camera.fx, camera.distortion[0], truth=_poses(bag, truth))
    if code:
        return run
    parameters = out / 'calibration.yaml'
    lens = read_parameters(parameters).intrinsics
    found = lens.of_image(camera.width, camera.height)
    return replace(
        run, focal=100.0 * (found.fx / camera.fx - 1.0),
        focal_sigma=100.0 * lens.focal_length_sigma,
        radial=found.distortion[0] - camera.distortion[0], radial_sigma=lens.distortion_sigma,
        center=max(abs(found.cx - camera.cx), abs(found.cy - camera.cy)),
        center_sigma=lens.principal_point_sigma, calibrated=_poses(bag, parameters))


def _poses(bag: Path, parameters: Path) -> Poses:
    pairs = list(replayed(bag, read_parameters(parameters), SIMULATED, bag.parent.name))
    squares = np.array([(T_FREEDOM * pair.translation_nees, R_FREEDOM * pair.rotation_nees)
                        for pair in pairs if not math.isnan(pair.rotation)]).reshape(-1, 2)
    beyond = squares > chi2([T_FREEDOM, R_FREEDOM]).ppf(QUANTILE)
    return Poses(len(pairs), len(squares), *beyond.sum(axis=0) / max(len(squares), 1))


def write_report(folder: Path, runs: Sequence[LensRun]) -> str:
    """Write the runs (CSV) and the table (Markdown), and return the latter."""
    rows = [[f'{run.model} {run.seed}', str(run.exit_code), f'{run.focal_true:.0f}',
             f'{run.focal:.2f} +- {run.focal_sigma:.2f}', f'{run.radial_true:.3f}',
             f'{run.radial:.3f} +- {run.radial_sigma:.3f}',
             f'{run.center:.1f} +- {run.center_sigma:.1f}', *_cells([run.calibrated]),
             *_cells([run.truth])] for run in runs]
    rows.append(['all', *6 * [''], *_cells([run.calibrated for run in runs]),
                 *_cells([run.truth for run in runs])])
    return write_table(folder, 'lenses', runs, markdown_table(
        ['bag', 'exit code', 'f [px]', 'error [%]', 'first coefficient', 'error',
         'principal point: error [px]', 'poses of pairs', 'beyond 99.7 %: t / R', 'true lens',
         'beyond'], rows))


def _cells(found: Sequence[Poses]) -> list[str]:
    pairs, count = sum(poses.pairs for poses in found), sum(poses.count for poses in found)
    t, R = (sum(getattr(poses, name) * poses.count for poses in found) / max(count, 1)
            for name in ('beyond_t', 'beyond_r'))
    return [f'{count} of {pairs}', f'{t:.1%} / {R:.1%}']
