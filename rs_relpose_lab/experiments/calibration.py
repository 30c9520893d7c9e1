"""Calibration on simulated tracks against their truth, and on parts of recordings."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from rs_relpose_lab.experiments.calibration_tracks import drawn, record
from rs_relpose_lab.experiments.harness import grouped, markdown_table, write_table
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.calibrate.observations import Tracks
from rs_relpose_ros.calibrate.procedure import calibrate, CalibrationInput, read_recording
from rs_relpose_ros.calibrate.result import CalibrationResult, Estimate
from rs_relpose_ros.calibrate.start import axis_maps
from rs_relpose_ros.config.settings import TRACKED_IN_IMAGES, TrackingConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera

# -- simulated tracks -------------------------------------------------------------------------

@dataclass(frozen=True, slots=True)
class Found:
    """Error of a quantity, its reported 1 sigma, and whether it was reported as observable."""

    error: float
    sigma: float
    observable: bool


@dataclass(frozen=True, slots=True)
class CalibrationRun:
    """One recording; times in ms, angles in degrees, rates in mrad/s, focal length in per cent.

    `focal` is NaN where the intrinsics were given. `rotation_error` is the whole angle; by axis
    it is about the camera's.
    """

    seed: int
    axis_map: int
    readout_time: float
    time_offset: float
    rotation_rate: float
    speed: float
    gyro_rate: float
    readout: Found
    offset: Found
    rotation_error: float
    rotation_x: Found
    rotation_y: Found
    rotation_z: Found
    bias_x: Found
    bias_y: Found
    bias_z: Found
    focal: Found
    axis_map_right: bool
    observable: bool
    shutter: str


# Field of a run, its title, its unit, and the largest error allowed.
QUANTITIES = (
    ('readout', 'readout time', 'ms', 0.5), ('offset', 'time offset', 'ms', 1.0),
    ('rotation_x', 'rotation, x', 'deg', 0.3), ('rotation_y', 'rotation, y', 'deg', 0.3),
    ('rotation_z', 'rotation, z', 'deg', 0.3), ('bias_x', 'gyro bias, x', 'mrad/s', None),
    ('bias_y', 'gyro bias, y', 'mrad/s', None), ('bias_z', 'gyro bias, z', 'mrad/s', None),
    ('focal', 'focal length', '%', 1.0))


def run_calibration(seed: int) -> CalibrationRun:
    """Draw a recording, calibrate it from nothing, and compare.

    The 24 axis maps take turns; every other recording of a map comes without a focal length.
    """
    rng = np.random.default_rng([1, seed])
    number, focal_unknown = seed % 24, seed // 24 % 2 == 1
    truth = drawn(rng, axis_map=number)
    recorded = record(truth, rng)
    # The search for an unknown focal length starts from 0.8 widths.
    focal = 0.8 * truth.width if focal_unknown else truth.focal
    camera = RollingShutterCamera(
        width=truth.width, height=truth.height, fx=focal, fy=focal, cx=0.5 * (truth.width - 1),
        cy=0.5 * (truth.height - 1), readout_time=0.0)
    result = calibrate(recorded.tracks, recorded.gyro, camera, focal_known=not focal_unknown)

    def found(estimate: Estimate | None, true: float, scale: float) -> Found:
        if estimate is None:
            return Found(math.nan, math.nan, False)
        return Found(scale * (estimate.value - true), scale * estimate.sigma, estimate.observable)

    error = np.degrees(Rotation.from_matrix(result.R_cam_imu @ truth.R_cam_imu.T).as_rotvec())
    rotation = [Found(float(angle), math.degrees(sigma), result.rotation.observable)
                for angle, sigma in zip(error, result.rotation_sigma, strict=True)]
    bias = [found(estimate, true, 1e3)
            for estimate, true in zip(result.gyro_bias, truth.gyro_bias, strict=True)]
    return CalibrationRun(
        seed=seed, axis_map=number, readout_time=1e3 * truth.readout_time,
        time_offset=1e3 * truth.time_offset, rotation_rate=math.degrees(truth.rotation_rate),
        speed=truth.speed, gyro_rate=float(truth.gyro_rate),
        readout=found(result.readout_time, truth.readout_time, 1e3),
        offset=found(result.time_offset, truth.time_offset, 1e3),
        rotation_error=float(np.linalg.norm(error)), rotation_x=rotation[0],
        rotation_y=rotation[1], rotation_z=rotation[2], bias_x=bias[0], bias_y=bias[1],
        bias_z=bias[2],
        focal=found(result.lens and result.lens.focal_factor, truth.focal / focal,
                    100.0 * focal / truth.focal),
        axis_map_right=bool((result.axis_map == axis_maps()[number]).all()),
        observable=result.observable, shutter=result.shutter)


def write_tracks_report(folder: Path, runs: Sequence[CalibrationRun]) -> str:
    """Write the runs (CSV) and the table (Markdown), and return the latter."""
    rows = [row for row in (_quantity_row(runs, *quantity) for quantity in QUANTITIES) if row]
    whole = np.array([run.rotation_error for run in runs])
    rows.insert(5, ['rotation, whole angle', str(len(runs)), 'deg', *_statistics(whole, 0.3),
                    '', ''])
    observable = [run for run in runs if run.rotation_x.observable]
    right = sum(run.axis_map_right for run in observable)
    return write_table(folder, 'calibration_runs', runs, markdown_table(
        ['quantity', 'runs', 'unit', 'median', '95 %', 'largest', 'limit', 'within [%]',
         '1 sigma [%]', '2 sigma [%]'], rows) + (
        f'\nAxis map right in {right} of the {len(observable)} runs that report it as observable '
        f'({len({run.axis_map for run in observable})} maps); all quantities observable in '
        f'{sum(run.observable for run in runs)} of {len(runs)} runs; rolling shutter reported in '
        f"{sum(run.shutter == 'rolling' for run in runs)}.\n"))


def _quantity_row(runs: Sequence[CalibrationRun], name: str, title: str, unit: str,
                  limit: float | None) -> list[str]:
    known = [found for run in runs if math.isfinite((found := getattr(run, name)).error)]
    if not known:
        return []
    errors = np.abs([found.error for found in known])
    ratios = errors / [found.sigma for found in known]
    return [title, str(len(known)), unit, *_statistics(errors, limit),
            f'{100 * (ratios <= 1.0).mean():.1f}', f'{100 * (ratios <= 2.0).mean():.1f}']


def _statistics(errors: NDArray[np.float64], limit: float | None) -> list[str]:
    return [f'{np.median(errors):.3f}', f'{np.quantile(errors, 0.95):.3f}', f'{errors.max():.3f}',
            '' if limit is None else f'{limit:g}',
            '' if limit is None else f'{100 * (errors <= limit).mean():.1f}']


# -- parts of recordings ----------------------------------------------------------------------
#
# Whether parts of one camera's recordings agree within their sigmas, those of the parameter file
# (the worst axis of rotation and bias). Each bag is tracked once and cut into parts; each part is
# calibrated from nothing. Where the offset follows the exposure, parts are compared at one
# interval between frames.


@dataclass(frozen=True, slots=True)
class PartQuantity:
    """A quantity of one part, in the unit of its name."""

    bag: str
    begin: float        # of the part, since the first image of the bag [s]
    name: str
    value: float
    sigma: float
    observable: bool


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Calibration of one part of a bag."""

    bag: str
    begin: float
    result: CalibrationResult
    focal: float        # that was assumed [px]


def parts_of(tracks: Tracks, seconds: float) -> Iterator[tuple[float, Tracks]]:
    """Whole parts of so many seconds, with their begin [s]; all of it where it is shorter."""
    times = (tracks.stamps_ns - tracks.stamps_ns[0]) * 1e-9
    for k in range(max(int(times[-1] / seconds + 1e-6), 1)):
        begin = k * seconds
        inside = np.flatnonzero((times >= begin) & (times < begin + seconds))
        if not len(inside):
            continue
        first, last = inside[0], inside[-1]
        kept = (tracks.frames >= first) & (tracks.frames <= last)
        yield begin, Tracks(tracks.stamps_ns[inside], tracks.frames[kept] - first,
                            tracks.ids[kept], tracks.points[kept])


def read_bag(path: Path, rows: tuple[float, float]) -> CalibrationInput:
    """Tracks and gyro of a bag; of its image only these rows are used, all where both are 0."""
    with open_bag(path) as bag:
        return read_recording(bag, bag.find_topics(needs_camera_info=False),
                              TrackingConfig(feature_rows=rows))


def calibrated_parts(name: str, recording: CalibrationInput, seconds: float,
                     refused: Callable[[str], object]) -> Iterator[Part]:
    """Calibration of each part; `refused` gets the reason why one cannot be used."""
    for begin, tracks in parts_of(recording.tracks, seconds):
        try:
            result = calibrate(tracks, recording.gyro, recording.camera,
                               focal_known=recording.focal_known, config=TRACKED_IN_IMAGES)
        except InputError as error:
            refused(f'{name} from {begin:.0f} s: {error}')
            continue
        yield Part(name, begin, result, recording.camera.fx)


def quantities_of(parts: Sequence[Part]) -> list[PartQuantity]:
    """Every quantity of every part; the rotation against that of the first part."""
    interval = float(np.median([part.result.frame_interval for part in parts]))
    slope = _common_slope(parts)
    reference = Rotation.from_matrix(parts[0].result.R_cam_imu)
    return [PartQuantity(part.bag, part.begin, name, scale * estimate.value,
                         scale * estimate.sigma, estimate.observable)
            for part in parts
            for name, estimate, scale in _quantities(part, interval, slope, reference)
            if estimate is not None]


def _common_slope(parts: Sequence[Part]) -> Estimate | None:
    """Weighted mean of the offset's change by the interval; None where no part has one."""
    slopes = [part.result.offset_by_interval for part in parts]
    known = [slope for slope in slopes if slope is not None and slope.observable]
    if not known:
        return None
    weights = np.array([slope.sigma**-2.0 for slope in known])
    mean = float(weights @ [slope.value for slope in known] / weights.sum())
    return Estimate(mean, float(weights.sum() ** -0.5), True)


def _quantities(part: Part, interval: float, slope: Estimate | None, reference: Rotation,
                ) -> Iterator[tuple[str, Estimate | None, float]]:
    """Name, estimate and factor to the unit of the name."""
    result = part.result
    offset, longer = result.time_offset, interval - result.frame_interval
    if slope is not None:
        offset = Estimate(offset.value + slope.value * longer,
                          math.hypot(offset.sigma, slope.sigma * longer), offset.observable)
    rotation = (Rotation.from_matrix(result.R_cam_imu) * reference.inv()).as_rotvec()
    yield 'readout time [ms]', result.readout_time, 1e3
    yield 'time offset [ms]', offset, 1e3
    for axis, angle, bias in zip('xyz', rotation, result.gyro_bias, strict=True):
        yield (f'rotation, {axis} [deg]', replace(result.rotation, value=float(angle)),
               math.degrees(1.0))
        yield f'gyro bias, {axis} [mrad/s]', replace(bias, sigma=result.bias_sigma), 1e3
    yield 'focal length [px]', result.lens and result.lens.focal_factor, part.focal
    yield 'offset by interval [ms/ms]', result.offset_by_interval, 1.0
    yield 'offset by jitter [ms/ms]', result.offset_by_jitter, 1.0


def chi_squared(quantities: Sequence[PartQuantity]) -> NDArray[np.float64]:
    """Sum of squared deviations from the weighted mean, in sigmas, and degrees of freedom."""
    values = np.array([quantity.value for quantity in quantities])
    weights = np.array([quantity.sigma**-2.0 for quantity in quantities])
    mean = weights @ values / weights.sum()
    return np.array([weights @ (values - mean) ** 2, len(quantities) - 1])


def write_parts_report(folder: Path, quantities: Sequence[PartQuantity]) -> str:
    """Write the quantities (CSV) and the table of chi^2 (Markdown), and return the latter."""
    rows = []
    for name in dict.fromkeys(quantity.name for quantity in quantities):
        own = [quantity for quantity in quantities if quantity.name == name]
        rows.append([name, ', '.join(
            f'{q.value:.2f} +- {q.sigma:.2f}{"" if q.observable else " (no)"}' for q in own),
            *_chi_squared_cells([own]), *_chi_squared_cells(
                grouped(own, lambda quantity: quantity.bag).values())])
    return write_table(folder, 'calibration_stretches', quantities, markdown_table(
        ['quantity', 'parts; (no): not observable', 'chi2 / dof about the mean', 'P',
         "about each recording's mean", 'P'], rows))


def _chi_squared_cells(groups: Iterable[Sequence[PartQuantity]]) -> tuple[str, str]:
    """chi^2 over its degrees of freedom, and the probability of more; empty for single parts."""
    square, freedom = np.sum([chi_squared(group) for group in groups], axis=0)
    if not freedom:
        return '', ''
    return f'{square:.1f} / {freedom:.0f}', f'{chi2.sf(square, freedom):.2f}'
