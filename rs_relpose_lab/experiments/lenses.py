"""Whether an uncalibrated camera ends in poses: calibration, and the pairs with its file."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
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
from rs_relpose_ros.calibration.knowledge import distortion_prior
from rs_relpose_ros.calibration.observations import axis_maps
from rs_relpose_ros.cli.main import main as rs_relpose
from rs_relpose_ros.config.files import read_parameters, SourcedValue, write_parameters
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.core.radial import corner_radius, displacements
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.messages.incoming import Role, sensor_messages, stamp_ns

# First coefficient of each model: least and largest. To it are added k1, k2, k3 drawn from the
# prior of a lens that is given, by which the displacement is 1 % at half of the radius.
MODELS = {'plumb_bob': (-0.2, 0.1), 'equidistant': (-0.05, 0.05)}
# Standard deviations within which the drawn coefficients stay.
# [chosen: 2; a lens beyond 3 is rarer than a wrong calibration]
_WITHIN = 2.0
# Added to the seed of a bag for the motion, scene and noise of the other bag of its camera.
# [chosen: beyond the seeds of all bags of one run]
_OTHER_SEED = 10_000
# Range of the focal length over the one that `calibrate` assumes, 0.8 widths.
# [chosen: 55 to 77 deg of view]
FOCAL = (0.8, 1.2)
# Largest error of the principal point [px]. [chosen: 1.5 % of 640 px]
CENTER = 10.0
# Quantities of the lens in the report. The displacement by k1, k2, k3 is that of the image's
# corner, and the principal point that of the coordinate that is further off.
LENS = ('focal length [%]', 'displacement of the corner [%]', 'principal point [px]')
# Largest rotation of the IMU about each axis, from one of the 24 axis maps [deg].
MISALIGNED = 3.0
# Points across half of the image's diagonal at which a drawn lens must have an inverse.
# [chosen: 5 to 50 would do, as the profile has three coefficients]
_INVERTED_AT = 20


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses of a bag: median errors [deg], and the share beyond the 99.7 % quantile."""

    pairs: int = 0
    count: int = 0
    median_t: float = math.nan
    median_r: float = math.nan
    beyond_t: float = 0.0
    beyond_r: float = 0.0


@dataclass(frozen=True, slots=True)
class LensRun:
    """One bag: errors of the written values, and poses with them and with the true ones."""

    model: str
    seed: int
    exit_code: int
    seconds: float  # of the images that were used
    truth: Poses
    calibrated: Poses = Poses()
    errors: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def in_sigmas(self) -> list[float]:
        """Magnitudes of the errors."""
        return [abs(error) / sigma for error, sigma in self.errors.values()]


def lens_of(seed: int, model: str) -> tuple[SimulationConfig, RollingShutterCamera]:
    """Recording and camera of a bag: lens, readout, offset and axes are drawn."""
    rng = np.random.default_rng([2, seed])
    width = SimulationConfig().width
    config = SimulationConfig(
        seed=seed,
        scene=SCENES[seed % len(SCENES)],
        fx=0.8 * width * rng.uniform(*FOCAL),
        readout_time=round(rng.uniform(0.012, 0.032), 4),
        time_offset=round(rng.uniform(-0.08, 0.08), 4),
    )
    camera = config.camera
    shift = rng.uniform(-CENTER, CENTER, 2)
    camera = replace(
        camera,
        cx=0.5 * (camera.width - 1) + shift[0],
        cy=0.5 * (camera.height - 1) + shift[1],
        distortion_model=model,
        distortion=(),
    )
    camera = _distorted(camera, rng)
    misalignment = rng.uniform(-MISALIGNED, MISALIGNED, 3)
    axis_map = Rotation.from_matrix(axis_maps()[rng.integers(24)])
    axes = Rotation.from_rotvec(misalignment, degrees=True) * axis_map
    return replace(config, quat_cam_imu_xyzw=tuple(axes.as_quat().tolist())), camera


def _distorted(camera: RollingShutterCamera, rng: np.random.Generator) -> RollingShutterCamera:
    """The camera with a lens that is drawn, and drawn again until it has an inverse."""
    root = np.linalg.cholesky(distortion_prior(camera, given=True))
    corners = np.array([[x, y] for x in (0.0, camera.width) for y in (0.0, camera.height)])
    center = np.array([camera.cx, camera.cy])
    shares = np.linspace(0.0, 1.0, _INVERTED_AT)
    to_corners = corners - center
    points = (center + shares[:, None, None] * to_corners).reshape(-1, 2)
    usual = MODELS[camera.distortion_model]
    while True:
        drawn = np.clip(rng.standard_normal(3), -_WITHIN, _WITHIN)
        by_prior = root @ drawn
        first = np.array([rng.uniform(*usual), 0.0, 0.0])
        deviation = np.array([0.0, 0.0, *(first + by_prior), 0.0, 0.0])
        lens = camera.moved_lens(deviation)
        if not np.isnan(lens.unproject(points)).any():
            return lens


def calibrated_live(bag: Path, parameters: Path) -> float:
    """Write the file of a node that calibrates itself on a bag; the images until then [s].

    The bag waits for each fit: not a measurement of its time. NaN: not calibrated.
    """
    calibration = LiveCalibration(
        Parameters.from_mapping({'image_transport': 'compressed'}), use_stored=False
    )
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


def _rendered(
    config: SimulationConfig,
    camera: RollingShutterCamera,
    folder: Path,
    name: str,
    *,
    known: bool,
) -> tuple[Path, Path]:
    """A bag of a camera and its true parameters, rendered unless they exist."""

    def render(bag: Path, parameters: Path) -> None:
        simulation = simulate(config, camera=camera)
        write_bag(simulation, bag, camera_info=known)
        values = {
            **right_parameters(simulation),
            'image_transport': 'compressed',
            'camera_matrix': tuple(camera.camera_matrix.ravel().tolist()),
            'distortion_model': camera.distortion_model,
            'distortion_coefficients': camera.distortion,
        }
        write_parameters(
            parameters,
            'The truth.',
            [SourcedValue(name, value, '') for name, value in values.items()],
        )

    return made_once(folder, name, render)


def on_lens(
    seed: int, model: str, seconds: float, folder: Path, *, live: bool, known: bool
) -> LensRun:
    """Render two bags of a camera unless they exist, calibrate on one, and replay the other.

    The other one is replayed with the calibration and with the true values. live: by the
    calibration of a running node, which ends as soon as its result suffices. known: the lens is
    that of the CameraInfo.
    """
    config, camera = lens_of(seed, model)
    config = replace(config, duration=seconds, plan=f'walk:{seconds}')
    other = replace(config, seed=seed + _OTHER_SEED, scene=SCENES[(seed + 1) % len(SCENES)])
    bag, _ = _rendered(config, camera, folder, 'bag', known=known)
    replayed, truth = _rendered(other, camera, folder, 'other', known=known)
    parameters = folder / 'calibration' / 'calibration.yaml'
    if live:
        parameters = folder / 'live.yaml'
        seconds = calibrated_live(bag, parameters)
        code = int(math.isnan(seconds))
    else:
        code = rs_relpose(
            [
                'calibrate',
                str(bag),
                '--out',
                str(parameters.parent),
                *([] if known else ['--lens', model]),
            ]
        )
    run = LensRun(model, seed, code, seconds, _poses(replayed, truth))
    if code:
        return run
    found = read_parameters(parameters)
    return replace(
        run,
        calibrated=_poses(replayed, parameters),
        errors=_errors(found, config) | ({} if known else _of_lens(found, camera)),
    )


def _errors(found: Parameters, truth: SimulationConfig) -> dict[str, tuple[float, float]]:
    sensor = found.sensor
    imu = found.imu
    assert sensor.readout_time is not None
    turn = Rotation.from_matrix(sensor.R_cam_imu @ truth.R_cam_imu.T).as_rotvec()
    bias = np.array(imu.gyro_bias) - truth.gyro_bias
    return {
        'readout [s]': (sensor.readout_time - truth.readout_time, sensor.readout_time_sigma),
        'offset [s]': (sensor.time_offset - truth.time_offset, sensor.time_offset_sigma),
        **{f'axes {axis} [rad]': (turn[k], sensor.axes_sigma) for k, axis in enumerate('xyz')},
        **{f'bias {axis} [rad/s]': (bias[k], imu.gyro_bias_sigma) for k, axis in enumerate('xyz')},
    }


def _of_lens(found: Parameters, truth: RollingShutterCamera) -> dict[str, tuple[float, float]]:
    sigmas = found.intrinsics
    lens = found.intrinsics.of_image(truth.width, truth.height)
    center = max(abs(lens.cx - truth.cx), abs(lens.cy - truth.cy))
    radius = corner_radius(truth)
    coefficients = lens.global_shutter_camera().radial_coefficients - truth.radial_coefficients
    displaced = float(displacements([radius])[0] @ coefficients)
    return dict(
        zip(
            LENS,
            (
                (100.0 * (lens.fx / truth.fx - 1.0), 100.0 * sigmas.focal_length_sigma),
                (100.0 * displaced, 100.0 * radius**2 * sigmas.distortion_sigma),
                (center, sigmas.principal_point_sigma),
            ),
            strict=True,
        )
    )


def _poses(bag: Path, parameters: Path) -> Poses:
    pairs = list(
        consistency.replayed(bag, read_parameters(parameters), SIMULATED, bag.parent.name)
    )
    squares = np.array(
        [
            (T_FREEDOM * pair.translation_nees, R_FREEDOM * pair.rotation_nees)
            for pair in pairs
            if not math.isnan(pair.rotation)
        ]
    ).reshape(-1, 2)
    beyond = squares > chi2([T_FREEDOM, R_FREEDOM]).ppf(QUANTILE)
    return Poses(
        len(pairs),
        len(squares),
        float(np.nanmedian([pair.translation for pair in pairs])),
        float(np.nanmedian([pair.rotation for pair in pairs])),
        *beyond.sum(axis=0) / max(len(squares), 1),
    )


def write_report(folder: Path, runs: Sequence[LensRun]) -> str:
    """Write the runs (CSV) and the table (Markdown), and return the latter."""
    rows = [
        [
            f'{run.model} {run.seed}',
            str(run.exit_code),
            f'{run.seconds:.1f}',
            *(
                '{:.3f} +- {:.3f}'.format(*run.errors[name]) if name in run.errors else ''
                for name in LENS
            ),
            *_cells([run]),
        ]
        for run in runs
    ]
    rows.append(['all', *5 * [''], *_cells(runs)])
    return write_table(
        folder,
        'lenses',
        runs,
        markdown_table(
            [
                'bag',
                'exit code',
                'images [s]',
                *(f'{name}: error' for name in LENS),
                'values within 3 sigma (largest)',
                'median error over that with the truth: t / R',
                'poses of pairs',
                'beyond 99.7 %: t / R',
                'with the truth',
                'beyond',
            ],
            rows,
        ),
    )


def _cells(runs: Sequence[LensRun]) -> list[str]:
    """Of one or several bags; of several: medians of the ratios, sums of the rest."""
    sizes = np.array([size for run in runs for size in run.in_sigmas])
    ratios = [
        np.nanmedian([getattr(run.calibrated, name) / getattr(run.truth, name) for run in runs])
        for name in ('median_t', 'median_r')
    ]
    cells = [
        f'{np.count_nonzero(sizes <= 3.0)} of {len(sizes)} ({sizes.max(initial=0.0):.1f})',
        ' / '.join(f'{ratio:.2f}' for ratio in ratios),
    ]
    for found in ([run.calibrated for run in runs], [run.truth for run in runs]):
        pairs = sum(poses.pairs for poses in found)
        count = sum(poses.count for poses in found)
        t, R = (
            sum(getattr(poses, name) * poses.count for poses in found) / max(count, 1)
            for name in ('beyond_t', 'beyond_r')
        )
        cells += [f'{count} of {pairs}', f'{t:.1%} / {R:.1%}']
    return cells
