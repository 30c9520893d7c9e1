"""Calibration on parts of recordings."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from rs_relpose_lab.experiments.harness import grouped, markdown_table, write_table
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.calibrate.procedure import calibrated
from rs_relpose_ros.calibrate.recording import CalibrationInput, read_recording
from rs_relpose_ros.calibrate.result import CalibrationResult, Estimate
from rs_relpose_ros.calibration.observations import TrackedPoints
from rs_relpose_ros.config.settings import TRACKED_IN_IMAGES, TrackingConfig
from rs_relpose_ros.errors import InputError

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
    begin: float  # of the part, since the first image of the bag [s]
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
    focal: float  # that was assumed [px]


def parts_of(tracks: TrackedPoints, seconds: float) -> Iterator[tuple[float, TrackedPoints]]:
    """Whole parts of so many seconds, with their begin [s]; all of it where it is shorter."""
    times = (tracks.stamps_ns - tracks.stamps_ns[0]) * 1e-9
    for k in range(max(int(times[-1] / seconds + 1e-6), 1)):
        begin = k * seconds
        inside = np.flatnonzero((times >= begin) & (times < begin + seconds))
        if not len(inside):
            continue
        first = inside[0]
        last = inside[-1]
        kept = (tracks.frames >= first) & (tracks.frames <= last)
        yield (
            begin,
            TrackedPoints(
                tracks.stamps_ns[inside],
                tracks.frames[kept] - first,
                tracks.ids[kept],
                tracks.points[kept],
            ),
        )


def read_bag(path: Path, rows: tuple[float, float]) -> CalibrationInput:
    """Tracks and gyro of a bag; of its image only these rows are used, all where both are 0."""
    with open_bag(path) as bag:
        return read_recording(
            bag, bag.find_topics(needs_camera_info=False), TrackingConfig(feature_rows=rows)
        )


def calibrated_parts(
    name: str, recording: CalibrationInput, seconds: float, refused: Callable[[str], object]
) -> Iterator[Part]:
    """Calibration of each part; `refused` gets the reason why one cannot be used."""
    for begin, tracks in parts_of(recording.tracks, seconds):
        try:
            result = calibrated(replace(recording, tracks=tracks), TRACKED_IN_IMAGES)
        except InputError as error:
            refused(f'{name} from {begin:.0f} s: {error}')
            continue
        yield Part(name, begin, result, recording.camera.fx)


def quantities_of(parts: Sequence[Part]) -> list[PartQuantity]:
    """Every quantity of every part; the rotation against that of the first part."""
    interval = float(np.median([part.result.frame_interval for part in parts]))
    slope = _common_slope(parts)
    reference = Rotation.from_matrix(parts[0].result.R_cam_imu)
    return [
        PartQuantity(
            part.bag,
            part.begin,
            name,
            scale * estimate.value,
            scale * estimate.sigma,
            estimate.observable,
        )
        for part in parts
        for name, estimate, scale in _quantities(part, interval, slope, reference)
        if estimate is not None
    ]


def _common_slope(parts: Sequence[Part]) -> Estimate | None:
    """Weighted mean of the offset's change by the interval; None where no part has one."""
    slopes = [part.result.offset_by_interval for part in parts]
    known = [slope for slope in slopes if slope is not None and slope.observable]
    if not known:
        return None
    weights = np.array([slope.sigma**-2.0 for slope in known])
    mean = float(weights @ [slope.value for slope in known] / weights.sum())
    return Estimate(mean, float(weights.sum() ** -0.5), True)


def _quantities(
    part: Part,
    interval: float,
    slope: Estimate | None,
    reference: Rotation,
) -> Iterator[tuple[str, Estimate | None, float]]:
    """Name, estimate and factor to the unit of the name."""
    result = part.result
    offset = result.time_offset
    longer = interval - result.frame_interval
    if slope is not None:
        offset = Estimate(
            offset.value + slope.value * longer,
            math.hypot(offset.sigma, slope.sigma * longer),
            offset.observable,
        )
    rotation = (Rotation.from_matrix(result.R_cam_imu) * reference.inv()).as_rotvec()
    yield 'readout time [ms]', result.readout_time, 1e3
    yield 'time offset [ms]', offset, 1e3
    for axis, angle, bias in zip('xyz', rotation, result.gyro_bias, strict=True):
        yield (
            f'rotation, {axis} [deg]',
            replace(result.rotation, value=float(angle)),
            math.degrees(1.0),
        )
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
        rows.append(
            [
                name,
                ', '.join(
                    f'{q.value:.2f} +- {q.sigma:.2f}{"" if q.observable else " (no)"}' for q in own
                ),
                *_chi_squared_cells([own]),
                *_chi_squared_cells(grouped(own, lambda quantity: quantity.bag).values()),
            ]
        )
    return write_table(
        folder,
        'calibration_stretches',
        quantities,
        markdown_table(
            [
                'quantity',
                'parts; (no): not observable',
                'chi2 / dof about the mean',
                'P',
                "about each recording's mean",
                'P',
            ],
            rows,
        ),
    )


def _chi_squared_cells(groups: Iterable[Sequence[PartQuantity]]) -> tuple[str, str]:
    """chi^2 over its degrees of freedom, and the probability of more; empty for single parts."""
    square, freedom = np.sum([chi_squared(group) for group in groups], axis=0)
    if not freedom:
        return '', ''
    return f'{square:.1f} / {freedom:.0f}', f'{chi2.sf(square, freedom):.2f}'
