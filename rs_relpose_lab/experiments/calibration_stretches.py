"""Whether parts of one camera's recordings agree within the sigmas of ``rs_relpose calibrate``.

Each bag is followed once and cut into parts; each part is calibrated from nothing. Where the
offset follows the exposure, parts are compared at one interval between frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from rs_relpose_lab.experiments.tables import markdown_table, write_csv
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.bags.topics import TopicOptions
from rs_relpose_ros.calibrate.bag_streams import CalibrationInput, read_recording
from rs_relpose_ros.calibrate.procedure import calibrate
from rs_relpose_ros.calibrate.result import CalibrationResult, Estimate
from rs_relpose_ros.calibrate.tracks import Tracks
from rs_relpose_ros.config.calibration import TRACKED_IN_IMAGES
from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.errors import InputError


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of one part, in the unit that its name says."""

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
        return read_recording(bag, bag.find_topics(TopicOptions(), needs_camera_info=False),
                              TrackingConfig(feature_rows=rows))


def calibrated_parts(name: str, recording: CalibrationInput, seconds: float,
                     refused: Callable[[str], object]) -> Iterator[Part]:
    """Calibration of each part; why one cannot be used goes to `refused`."""
    for begin, tracks in parts_of(recording.tracks, seconds):
        try:
            result = calibrate(tracks, recording.gyro, recording.camera,
                               focal_known=recording.focal_known, config=TRACKED_IN_IMAGES)
        except InputError as error:
            refused(f'{name} from {begin:.0f} s: {error}')
            continue
        yield Part(name, begin, result, recording.camera.fx)


def figures_of(parts: Sequence[Part]) -> list[Figure]:
    """Every figure of every part; the rotation against that of the first part."""
    interval = float(np.median([part.result.frame_interval for part in parts]))
    slope = _common_slope(parts)
    reference = Rotation.from_matrix(parts[0].result.R_cam_imu)
    return [figure for part in parts for figure in _figures(part, interval, slope, reference)]


def _common_slope(parts: Sequence[Part]) -> Estimate | None:
    """Weighted mean of the offset's change by the interval; None where no part has one."""
    slopes = [part.result.offset_by_interval for part in parts]
    known = [slope for slope in slopes if slope is not None and slope.observable]
    if not known:
        return None
    weights = np.array([slope.sigma**-2.0 for slope in known])
    mean = float(weights @ [slope.value for slope in known] / weights.sum())
    return Estimate(mean, float(weights.sum() ** -0.5), True)


def _figures(part: Part, interval: float, slope: Estimate | None,
             reference: Rotation) -> Iterator[Figure]:
    result = part.result

    def figure(name: str, estimate: Estimate, scale: float) -> Figure:
        return Figure(part.bag, part.begin, name, scale * estimate.value, scale * estimate.sigma,
                      estimate.observable)

    yield figure('read-out time [ms]', result.readout_time, 1e3)
    offset, longer = result.time_offset, interval - result.frame_interval
    if slope is not None:
        offset = Estimate(offset.value + slope.value * longer,
                          math.hypot(offset.sigma, slope.sigma * longer), offset.observable)
    yield figure('time offset [ms]', offset, 1e3)
    turn = (Rotation.from_matrix(result.R_cam_imu) * reference.inv()).as_rotvec()
    for axis, angle, sigma in zip('xyz', turn, result.rotation_sigma, strict=True):
        yield figure(f'rotation, {axis} [deg]',
                     Estimate(float(angle), float(sigma), result.rotation.observable),
                     math.degrees(1.0))
    for axis, bias in zip('xyz', result.gyro_bias, strict=True):
        yield figure(f'gyro bias, {axis} [mrad/s]', bias, 1e3)
    if result.focal_factor is not None:
        yield figure('focal length [px]', result.focal_factor, part.focal)
    if result.offset_by_interval is not None:
        yield figure('offset by interval [ms/ms]', result.offset_by_interval, 1.0)
    if result.offset_by_jitter is not None:
        yield figure('offset by jitter [ms/ms]', result.offset_by_jitter, 1.0)


def chi_squared(figures: Sequence[Figure]) -> tuple[float, int]:
    """Sum of squared deviations from the weighted mean, in sigmas, and degrees of freedom."""
    values = np.array([figure.value for figure in figures])
    weights = np.array([figure.sigma**-2.0 for figure in figures])
    mean = weights @ values / weights.sum()
    return float(weights @ (values - mean) ** 2), len(figures) - 1


def write_report(folder: Path, figures: Sequence[Figure]) -> str:
    """Write the figures (CSV) and the table of chi^2 (Markdown), and return the latter."""
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / 'calibration_stretches.csv', figures)
    rows = []
    for name in dict.fromkeys(figure.name for figure in figures):
        own = [figure for figure in figures if figure.name == name]
        observable = [figure for figure in own if figure.observable]
        rows.append([name, ', '.join(
            f'{figure.value:.2f} +- {figure.sigma:.2f}{"" if figure.observable else " (no)"}'
            for figure in own), *_verdict(observable), *_verdict(own)])
    text = markdown_table(
        ['figure', 'parts; (no): called not observable', 'chi2 / dof of the observable', 'P',
         'chi2 / dof of all', 'P'], rows)
    (folder / 'calibration_stretches.md').write_text(text, encoding='utf-8')
    return text


def _verdict(figures: Sequence[Figure]) -> tuple[str, str]:
    """chi^2 over its degrees of freedom, and the probability of more; empty for one part."""
    if len(figures) < 2:
        return '', ''
    square, freedom = chi_squared(figures)
    return f'{square:.1f} / {freedom}', f'{chi2.sf(square, freedom):.2f}'
