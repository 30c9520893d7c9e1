"""Calibration of simulated recordings from nothing: errors, sigmas and verdicts over many runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.calibration_tracks import drawn, record
from rs_relpose_lab.experiments.tables import markdown_table, write_csv
from rs_relpose_ros.calibrate.axis_maps import axis_maps
from rs_relpose_ros.calibrate.procedure import calibrate
from rs_relpose_ros.geometry.camera import RollingShutterCamera


@dataclass(frozen=True, slots=True)
class Found:
    """Error of a figure, its told 1 sigma, and whether it was called observable."""

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


# What a figure of a run is called, its unit, and how far off it may be.
FIGURES = (
    ('readout', 'read-out time', 'ms', 0.5), ('offset', 'time offset', 'ms', 1.0),
    ('rotation_x', 'rotation, x', 'deg', 0.3), ('rotation_y', 'rotation, y', 'deg', 0.3),
    ('rotation_z', 'rotation, z', 'deg', 0.3), ('bias_x', 'gyro bias, x', 'mrad/s', None),
    ('bias_y', 'gyro bias, y', 'mrad/s', None), ('bias_z', 'gyro bias, z', 'mrad/s', None),
    ('focal', 'focal length', '%', 1.0))


def run_calibration(seed: int) -> CalibrationRun:
    """Draw a recording, calibrate it from nothing, and compare.

    The 24 axis maps take turns; every other recording of a map comes without a focal length.
    """
    rng = np.random.default_rng([1, seed])
    number, asked = seed % 24, seed // 24 % 2 == 1
    truth = drawn(rng, axis_map=number)
    recorded = record(truth, rng)
    # Where the focal length is asked for, the search starts from 0.8 widths.
    focal = 0.8 * truth.width if asked else truth.focal
    camera = RollingShutterCamera(
        width=truth.width, height=truth.height, fx=focal, fy=focal, cx=0.5 * (truth.width - 1),
        cy=0.5 * (truth.height - 1), readout_time=0.0)
    result = calibrate(recorded.tracks, recorded.gyro, camera, focal_known=not asked)
    turn = np.degrees(Rotation.from_matrix(result.R_cam_imu @ truth.R_cam_imu.T).as_rotvec())
    rotation = [Found(float(error), math.degrees(sigma), result.rotation.observable)
                for error, sigma in zip(turn, result.rotation_sigma, strict=True)]
    bias = [Found(1e3 * (found.value - true), 1e3 * found.sigma, found.observable)
            for found, true in zip(result.gyro_bias, truth.gyro_bias, strict=True)]
    readout, offset = result.readout_time, result.time_offset
    found_focal = Found(math.nan, math.nan, False)
    if result.focal_factor is not None:
        scale = 100.0 * focal / truth.focal
        found_focal = Found(result.focal_factor.value * scale - 100.0,
                             result.focal_factor.sigma * scale, result.focal_factor.observable)
    return CalibrationRun(
        seed=seed, axis_map=number, readout_time=1e3 * truth.readout_time,
        time_offset=1e3 * truth.time_offset, rotation_rate=math.degrees(truth.rotation_rate),
        speed=truth.speed, gyro_rate=float(truth.gyro_rate),
        readout=Found(1e3 * (readout.value - truth.readout_time), 1e3 * readout.sigma,
                       readout.observable),
        offset=Found(1e3 * (offset.value - truth.time_offset), 1e3 * offset.sigma,
                      offset.observable),
        rotation_error=float(np.linalg.norm(turn)), rotation_x=rotation[0],
        rotation_y=rotation[1], rotation_z=rotation[2], bias_x=bias[0], bias_y=bias[1],
        bias_z=bias[2], focal=found_focal,
        axis_map_right=bool((result.axis_map == axis_maps()[number]).all()),
        observable=result.observable, shutter=result.shutter)


def write_report(folder: Path, runs: Sequence[CalibrationRun]) -> str:
    """Write the runs (CSV) and the table (Markdown), and return the latter."""
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / 'calibration_runs.csv', runs)
    rows = [row for row in (_row(runs, *figure) for figure in FIGURES) if row]
    whole = np.array([run.rotation_error for run in runs])
    rows.insert(5, ['rotation, whole angle', str(len(runs)), 'deg', f'{np.median(whole):.3f}',
                    f'{np.quantile(whole, 0.95):.3f}', f'{whole.max():.3f}', '0.3',
                    f'{100 * (whole <= 0.3).mean():.1f}', '', ''])
    called = [run for run in runs if run.rotation_x.observable]
    right = sum(run.axis_map_right for run in called)
    text = markdown_table(
        ['figure', 'runs', 'unit', 'median', '95 %', 'largest', 'limit', 'within [%]',
         '1 sigma [%]', '2 sigma [%]'], rows)
    text += (f'\nAxis map right in {right} of the {len(called)} runs that call it observable '
             f'({len({run.axis_map for run in called})} maps); all figures called observable in '
             f'{sum(run.observable for run in runs)} of {len(runs)} runs; rolling shutter said in '
             f"{sum(run.shutter == 'rolling' for run in runs)}.\n")
    (folder / 'calibration.md').write_text(text, encoding='utf-8')
    return text


def _row(runs: Sequence[CalibrationRun], name: str, title: str, unit: str,
         limit: float | None) -> list[str]:
    figures = [figure for run in runs if math.isfinite((figure := getattr(run, name)).error)]
    if not figures:
        return []
    errors = np.abs([figure.error for figure in figures])
    ratios = errors / [figure.sigma for figure in figures]
    return [title, str(len(figures)), unit, f'{np.median(errors):.3f}',
            f'{np.quantile(errors, 0.95):.3f}', f'{errors.max():.3f}',
            '' if limit is None else f'{limit:g}',
            '' if limit is None else f'{100 * (errors <= limit).mean():.1f}',
            f'{100 * (ratios <= 1.0).mean():.1f}', f'{100 * (ratios <= 2.0).mean():.1f}']
