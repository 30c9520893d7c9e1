"""Whether an uncalibrated lens ends in poses: calibration, and the pairs with its file."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
import math
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from rs_relpose_lab.experiments import consistency
from rs_relpose_lab.experiments.consistency import QUANTILE, R_FREEDOM, SIMULATED, T_FREEDOM
from rs_relpose_lab.experiments.harness import markdown_table, write_table
from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.bag import made_once, right_parameters, write_bag
from rs_relpose_lab.simulation.scene import SCENES
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.calibrate.live import LiveCalibration
from rs_relpose_ros.calibrate.stored import Calibrated
from rs_relpose_ros.cli.main import main as rs_relpose
from rs_relpose_ros.config.files import read_parameters, SourcedValue, write_parameters
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.messages.incoming import Role, sensor_messages, stamp_ns

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

    Focal length in per cent; principal point: the larger of both errors [px]; the images that
    were used [s].
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
    seconds: float = math.nan


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


def calibrated_live(bag: Path, parameters: Path) -> float:
    """Write the file of a node that calibrates itself on a bag; the images until then [s].

    The bag waits for each fit: not a measurement of its time. NaN: not calibrated.
    """
    calibration = LiveCalibration(Parameters.from_mapping({'image_transport': 'compressed'}),
                                  use_stored=False)
    with closing(calibration), open_bag(bag) as opened:
        first_ns = 0
        for role, message in sensor_messages(opened, opened.find_topics(needs_camera_info=False)):
            calibration.receive(role, message.message)
            found = calibration.step()
            while calibration.fitting and not isinstance(found, Calibrated):
                found = calibration.step(0.02)
            if role is Role.IMAGE:
                first_ns = first_ns or stamp_ns(message.message.header)
            if isinstance(found, Calibrated):
                parameters.write_text(found.parameters, encoding='utf-8')
                return 1e-9 * (stamp_ns(message.message.header) - first_ns)
    return math.nan


def on_lens(seed: int, model: str, seconds: float, folder: Path, *, live: bool) -> LensRun:
    """Render a bag without CameraInfo unless it exists, calibrate, and replay with both lenses.

    live: by the calibration of a running node, which ends as soon as its result suffices.
    """
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
    parameters = folder / 'calibration' / 'calibration.yaml'
    if live:
        parameters = folder / 'live.yaml'
        seconds = calibrated_live(bag, parameters)
        code = int(math.isnan(seconds))
    else:
        code = rs_relpose(['calibrate', str(bag), '--lens', model,
                           '--out', str(parameters.parent)])
    run = LensRun(model, seed, code, camera.fx, camera.distortion[0], truth=_poses(bag, truth),
                  seconds=seconds)
    if code:
        return run
    lens = read_parameters(parameters).intrinsics
    found = lens.of_image(camera.width, camera.height)
    return replace(
        run, focal=100.0 * (found.fx / camera.fx - 1.0),
        focal_sigma=100.0 * lens.focal_length_sigma,
        radial=found.distortion[0] - camera.distortion[0], radial_sigma=lens.distortion_sigma,
        center=max(abs(found.cx - camera.cx), abs(found.cy - camera.cy)),
        center_sigma=lens.principal_point_sigma, calibrated=_poses(bag, parameters))


def _poses(bag: Path, parameters: Path) -> Poses:
    pairs = list(consistency.replayed(bag, read_parameters(parameters), SIMULATED,
                                      bag.parent.name))
    squares = np.array([(T_FREEDOM * pair.translation_nees, R_FREEDOM * pair.rotation_nees)
                        for pair in pairs if not math.isnan(pair.rotation)]).reshape(-1, 2)
    beyond = squares > chi2([T_FREEDOM, R_FREEDOM]).ppf(QUANTILE)
    return Poses(len(pairs), len(squares), *beyond.sum(axis=0) / max(len(squares), 1))


def write_report(folder: Path, runs: Sequence[LensRun]) -> str:
    """Write the runs (CSV) and the table (Markdown), and return the latter."""
    rows = [[f'{run.model} {run.seed}', str(run.exit_code), f'{run.seconds:.1f}',
             f'{run.focal_true:.0f}',
             f'{run.focal:.2f} +- {run.focal_sigma:.2f}', f'{run.radial_true:.3f}',
             f'{run.radial:.3f} +- {run.radial_sigma:.3f}',
             f'{run.center:.1f} +- {run.center_sigma:.1f}', *_cells([run.calibrated]),
             *_cells([run.truth])] for run in runs]
    rows.append(['all', *7 * [''], *_cells([run.calibrated for run in runs]),
                 *_cells([run.truth for run in runs])])
    return write_table(folder, 'lenses', runs, markdown_table(
        ['bag', 'exit code', 'images [s]', 'f [px]', 'error [%]', 'first coefficient', 'error',
         'principal point: error [px]', 'poses of pairs', 'beyond 99.7 %: t / R', 'true lens',
         'beyond'], rows))


def _cells(found: Sequence[Poses]) -> list[str]:
    pairs, count = sum(poses.pairs for poses in found), sum(poses.count for poses in found)
    t, R = (sum(getattr(poses, name) * poses.count for poses in found) / max(count, 1)
            for name in ('beyond_t', 'beyond_r'))
    return [f'{count} of {pairs}', f'{t:.1%} / {R:.1%}']
