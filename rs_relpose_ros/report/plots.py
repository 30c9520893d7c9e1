"""Drawings of a report, as SVG that takes its colours from the page, light or dark."""

from collections.abc import Callable, Iterable, Mapping, Sequence
import io
import math
import re
from typing import Any, NamedTuple

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.messages.incoming import Role
from rs_relpose_ros.messages.streams import Timeline
from rs_relpose_ros.offline.tables import PairRecord, rotation_sigmas, translation_sigmas
from rs_relpose_ros.report.residuals import Cells, map_of, MatchResiduals, Rates, rates_compared
from rs_relpose_ros.report.run import Inertial, Observation

# Width of a drawing [inch]: with its letters of 9 points it is read on a phone of 370 px.
# [derived: 370 px over 5.2 inch of 72 points leave 8.9 px for a letter of 9 points]
_WIDTH = 5.2
# Most points of a line. More make the page larger and nothing clearer. [chosen: twice the pixels
# of the drawing on a large screen; 500 to 3000 would do]
_MOST_POINTS = 1200
# Ink of axes and letters, which the page replaces by its own. [chosen: no other colour is this]
_INK = '#010101'
# The lines of the grid, likewise. [chosen: no other colour is this]
_GRID = '#020202'
# Colours that every kind of colour vision tells apart; the page lightens them on a dark ground.
# [derived: Okabe and Ito]
BLUE = '#0072b2'
RED = '#d55e00'  # likewise
GREEN = '#009e73'  # likewise
ORANGE = '#e69f00'  # likewise
# What stands in the page for each of them.
_VARIABLES: Mapping[str, str] = {_INK: 'currentColor', _GRID: 'var(--grid)'} | {
    color: f'var(--{name})'
    for name, color in (('blue', BLUE), ('red', RED), ('green', GREEN), ('orange', ORANGE))
}
# Small letters without their outlines, axes without a box. [chosen: what is read on a phone]
_STYLE: Any = {
    'svg.fonttype': 'none',
    'font.size': 9.0,
    'axes.labelsize': 9.0,
    'axes.titlesize': 9.0,
    'xtick.labelsize': 8.0,
    'ytick.labelsize': 8.0,
    'legend.fontsize': 8.0,
    'text.color': _INK,
    'axes.labelcolor': _INK,
    'axes.edgecolor': _INK,
    'xtick.color': _INK,
    'ytick.color': _INK,
    'grid.color': _GRID,
    'axes.facecolor': 'none',
    'legend.frameon': False,
    'axes.spines.top': False,
    'axes.spines.right': False,
    'lines.linewidth': 1.0,
}
# Longest step of a stream, in median steps, that is no gap. [chosen: 1.5 to 3 would do]
_GAP = 1.8


# Draws on an empty canvas.
Paint = Callable[[Figure], None]


class Drawing(NamedTuple):
    """A drawing with its caption, and the text for who cannot see it."""

    svg: str
    caption: str


def draw(name: str, caption: str, height: float, paint: Paint) -> Drawing:
    """Let `paint` draw on a new picture; `name` is unique in a page."""
    with mpl.rc_context({**_STYLE, 'svg.hashsalt': name}):
        picture = Figure(figsize=(_WIDTH, height), layout='constrained')
        picture.patch.set_alpha(0.0)
        paint(picture)
        FigureCanvasSVG(picture)
        buffer = io.StringIO()
        picture.savefig(buffer, format='svg', metadata={'Date': None, 'Creator': None})
    return Drawing(_inline(buffer.getvalue(), name, caption), caption)


def _inline(svg: str, name: str, caption: str) -> str:
    """The SVG as a part of a page: its own names, no fixed size, colours of the page."""
    svg = svg[svg.index('<svg') :]
    svg = re.sub(r'<metadata>.*?</metadata>', '', svg, flags=re.DOTALL)
    for fixed, variable in _VARIABLES.items():
        svg = re.sub(fixed, variable, svg, flags=re.IGNORECASE)
    # Names of groups repeat from drawing to drawing, and nothing refers to them.
    svg = re.sub(r' id="[A-Za-z.0-9]+_\d+"', '', svg)
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf'\g<1>{name}-', svg)
    svg = re.sub(r"'DejaVu Sans'[^;\"]*", 'inherit', svg)
    svg = re.sub(r' (?:width|height)="[\d.]+pt"', '', svg, count=2)
    svg = svg.replace('<svg ', f'<svg role="img" aria-label="{caption}" ', 1)
    return re.sub(r'\s*\n\s*', '\n', svg)


def _axes(picture: Figure, count: int = 1, **options: Any) -> list[Axes]:
    axes = list(np.atleast_1d(picture.subplots(count, 1, sharex=True, **options)))
    for axis in axes:
        axis.grid(True, linewidth=0.6)
        axis.set_axisbelow(True)
    return axes


def thinned(times: Array, values: Array) -> tuple[Array, Array]:
    """At most `_MOST_POINTS` points of a line (N,), the extremes of each part among them."""
    if len(times) <= _MOST_POINTS:
        return times, values
    keep: set[int] = set()
    for part in np.array_split(np.arange(len(times)), _MOST_POINTS // 2):
        lowest = part[np.argmin(values[part])]
        highest = part[np.argmax(values[part])]
        keep |= {int(lowest), int(highest)}
    order = sorted(keep)
    return times[order], values[order]


def _seconds(stamps_ns: NDArray[np.int64], origin_ns: int) -> Array:
    return np.asarray(stamps_ns - origin_ns, dtype=np.float64) / NANOSECONDS


def _origin(observation: Observation) -> int:
    """The median of the first stamps, which a single wild one does not move [ns]."""
    firsts = [int(np.median(times.stamps[:9])) for times in observation.times.values()]
    return min(firsts, default=0)


# The streams with their names in drawings, and their colours.
_STREAMS = ((Role.IMAGE, 'images', BLUE), (Role.IMU, 'IMU', ORANGE), (Role.ACCEL, 'accel', GREEN))


def streams(observation: Observation) -> list[Drawing]:
    """Steps and delays of the streams over time."""
    if not observation.times:
        return []
    origin = _origin(observation)
    present = [
        (observation.times[role], name, color)
        for role, name, color in _STREAMS
        if role in observation.times
    ]

    def steps(picture: Figure) -> None:
        for axis, (times, name, color) in zip(_axes(picture, len(present)), present, strict=True):
            _draw_steps(axis, times, name, color, origin)
        picture.axes[-1].set_xlabel('time [s]')

    def delays(picture: Figure) -> None:
        (axis,) = _axes(picture)
        for times, name, color in present:
            late = 1e-6 * np.asarray(times.received - times.stamps, dtype=np.float64)
            first_ns = int(times.received.min())
            at = _seconds(times.received, first_ns)
            axis.plot(*thinned(at, late), '.', color=color, markersize=2.5, label=name)
        axis.set(xlabel='time of recording [s]', ylabel='recorded after stamp [ms]')
        _legend(axis)

    return [
        draw(
            'steps',
            'Step from one stamp to the next. Even steps are a line; gaps and steps back are red.',
            0.7 + 1.0 * len(present),
            steps,
        ),
        draw(
            'delays',
            'How much later than its stamp each message was recorded. Even delays are a line; '
            'teeth are times of arrival or bursts.',
            2.1,
            delays,
        ),
    ]


def _draw_steps(axis: Axes, times: Timeline, name: str, color: str, origin_ns: int) -> None:
    """Steps of one stream [ms], with the odd ones marked."""
    in_order = np.argsort(times.received, kind='stable')
    stamps = times.stamps[in_order]
    at = _seconds(stamps[1:], origin_ns)
    steps = np.diff(stamps) * 1e-6
    forwards = steps[steps > 0.0]
    usual = float(np.median(forwards)) if len(forwards) else math.nan
    odd = (steps <= 0.0) | (steps > _GAP * usual)
    even = ~odd
    # A step of hours must not flatten the others.
    bounded = steps.clip(-5.0 * usual, 20.0 * usual)
    axis.plot(*thinned(at[even], steps[even]), '.', color=color, markersize=2.5)
    axis.plot(*thinned(at[odd], bounded[odd]), 'x', color=RED)
    axis.set_ylabel(f'{name} [ms]')
    rate = 1e3 / usual
    count = int(odd.sum())
    axis.set_title(
        f'{len(stamps)} messages, {rate:.4g} Hz, {count} gaps or steps back', loc='left'
    )
    lowest, _ = axis.get_ylim()
    axis.set_ylim(bottom=min(0.0, float(lowest)))


def _legend(axis: Axes) -> None:
    if axis.get_legend_handles_labels()[1]:
        axis.legend(loc='lower left', bbox_to_anchor=(0.0, 1.0), ncols=4, columnspacing=1.0)


def inertial(observation: Observation) -> list[Drawing]:
    """Rates of the gyro and specific force over time, with rest and saturation."""
    drawings = []
    origin = _origin(observation)
    for name, samples, scale, label in (
        ('gyro', observation.gyro, 180.0 / math.pi, 'rate [deg/s]'),
        ('accelerometer', observation.accelerometer, 1.0, 'specific force [m/s$^2$]'),
    ):
        if not len(samples.values):
            continue
        values = scale * samples.values
        held = _saturated(samples)

        def paint(
            picture: Figure,
            samples: Inertial = samples,
            values: Array = values,
            held: Array = held,
            label: str = label,
        ) -> None:
            (axis,) = _axes(picture)
            at = _seconds(samples.stamps_ns, origin)
            for begin, end in _rests(observation.gyro, origin):
                axis.axvspan(begin, end, color=GREEN, alpha=0.15, linewidth=0.0)
            for column, (letter, color) in enumerate(zip('xyz', (BLUE, RED, GREEN), strict=True)):
                axis.plot(*thinned(at, values[:, column]), color=color, label=letter)
                saturated = held[:, column]
                axis.plot(at[saturated], values[saturated, column], 'x', color=ORANGE)
            axis.set(xlabel='time [s]', ylabel=label)
            _legend(axis)

        largest = float(np.abs(values).max())
        caption = (
            f'{name.capitalize()}, axes of the IMU: largest value {largest:.3g}; '
            f'{int(held.any(axis=1).sum())} samples at a limit (orange); rest is shaded.'
        )
        drawings.append(draw(name, caption, 2.2, paint))
    return drawings


def _saturated(samples: Inertial) -> Array:
    """Samples (K, 3) that repeat the largest or smallest value of their axis exactly."""
    values = samples.values
    limits = (values == values.max(axis=0)) | (values == values.min(axis=0))
    repeated = np.zeros_like(limits)
    repeated[1:] = limits[1:] & (values[1:] == values[:-1])
    moving = np.ptp(values, axis=0) > 0.0
    return repeated & moving


# Largest step of the gyro's rate at rest [rad/s]. More would take slow rotation for rest.
# [chosen: three times the noise of a cheap gyro; 0.01 to 0.05 would do]
_REST_RATE = 0.02
# Least length of a rest [s]. Less would shade moments between two movements.
# [chosen: 0.3 to 1 s would do]
_REST_LENGTH = 0.5


def _rests(gyro: Inertial, origin_ns: int) -> Iterable[tuple[float, float]]:
    """Spans [s] in which the rate hardly changes."""
    if len(gyro.values) < 3:
        return
    at = _seconds(gyro.stamps_ns, origin_ns)
    largest_step = np.abs(np.diff(gyro.values, axis=0)).max(axis=1)
    median = np.median(gyro.values, axis=0)
    from_median = np.linalg.norm(gyro.values[1:] - median, axis=1)
    quiet = (largest_step < _REST_RATE) & (from_median < 3.0 * _REST_RATE)
    enclosed = np.concatenate([[0], quiet, [0]])
    edges = np.flatnonzero(np.diff(enclosed))
    last = len(at) - 1
    for first, after in zip(edges[::2], edges[1::2], strict=True):
        begin = float(at[first])
        end = float(at[min(after, last)])
        if end - begin >= _REST_LENGTH:
            yield begin, end


def rates_of(observation: Observation) -> Rates | None:
    """Rates by images and by gyro as configured; None without a rotation of the images."""
    rotations = observation.rotations
    gyro = observation.gyro
    sensor = observation.parameters.sensor
    intrinsics = observation.intrinsics
    if len(rotations) < 3 or len(gyro.values) < 3 or intrinsics is None or sensor.missing():
        return None
    if not any(len(one.points) for one in observation.residuals):
        return None  # without matches of pairs, their rows are not known
    bias = np.array(observation.parameters.imu.gyro_bias)
    # Images have the rotation between the rows in which their points lie.
    stamped = {'first': 0.0, 'middle': 0.5, 'last': 1.0}[sensor.stamp_row]
    share = _mean_row(observation.residuals) / intrinsics.image_height - stamped
    direction = -1 if sensor.readout_direction in ('up', 'left') else 1
    signed_readout = (sensor.readout_time or 0.0) * direction
    offset_ns = round(NANOSECONDS * (sensor.time_offset + share * signed_readout))
    return rates_compared(
        [one.stamp_ns + offset_ns for one in rotations],
        [one.interval for one in rotations],
        np.array([one.by_images for one in rotations]),
        gyro.stamps_ns,
        (gyro.values - bias) @ sensor.R_cam_imu.T,
    )


def _mean_row(pairs: Sequence[MatchResiduals]) -> float:
    """Mean row of all matches [px]; NaN without any."""
    rows = [one.points[:, 1] for one in pairs if len(one.points)]
    return float(np.concatenate(rows).mean()) if rows else math.nan


def clock(rates: Rates) -> list[Drawing]:
    """Images against gyro: rates, correlation over the offset, the best offset over time."""
    scan = rates.scan()
    middles, offsets = rates.drift()

    def compared(picture: Figure) -> None:
        axes = _axes(picture, 3)
        by_gyro = np.degrees(rates.by_gyro())
        for column, (axis, letter) in enumerate(zip(axes, 'xyz', strict=True)):
            images = np.degrees(rates.by_images[:, column])
            axis.plot(*thinned(rates.ends, by_gyro[:, column]), color=ORANGE, label='gyro')
            axis.plot(
                *thinned(rates.ends, images), '.', color=BLUE, markersize=2.5, label='images'
            )
            axis.set_ylabel(f'{letter} [deg/s]')
        _legend(axes[0])
        axes[-1].set_xlabel('time [s]')

    def correlated(picture: Figure) -> None:
        (axis,) = _axes(picture)
        axis.plot(1e3 * scan.offsets, scan.correlation, color=BLUE)
        axis.axvline(0.0, color=_INK, linewidth=0.8)
        axis.axvline(1e3 * scan.best, color=RED, linestyle='--')
        axis.set(xlabel='offset beyond the configured one [ms]', ylabel='correlation')

    def drifting(picture: Figure) -> None:
        (axis,) = _axes(picture)
        axis.axhline(0.0, color=_INK, linewidth=0.8)
        axis.plot(middles, 1e3 * offsets, 'o-', color=BLUE)
        span = max(5.0, 1.3 * float(np.abs(1e3 * offsets).max()))
        axis.set(xlabel='time [s]', ylabel='best offset [ms]', ylim=(-span, span))

    drawings = [
        draw(
            'rates',
            'Rate of the camera by images alone and by the gyro, axes of the camera: right, down, '
            'forward. The images count all motion as rotation, so both differ while the camera '
            'translates.',
            3.6,
            compared,
        ),
        draw(
            'correlation',
            f'Correlation of both rates over an offset of the clocks. It is largest at '
            f'{1e3 * scan.best:+.1f} ms (dashed); 0 is as configured.',
            2.1,
            correlated,
        ),
    ]
    if len(middles) > 1:
        text = 'The same offset in parts of the recording: a slope is a drift of the clocks.'
        drawings.append(draw('drift', text, 1.9, drifting))
    return drawings


def _heat(name: str, caption: str, cells: Cells, labels: tuple[str, str], down: bool) -> Drawing:
    """Draw a map; `down`: whether its second coordinate grows downwards."""

    def paint(picture: Figure) -> None:
        axis = picture.subplots()
        known = cells.rms[np.isfinite(cells.rms)]
        top = float(np.percentile(known, 98.0))
        shown = axis.pcolormesh(
            cells.x, cells.y, cells.rms, cmap='viridis', vmin=0.0, vmax=max(top, 1e-3)
        )
        axis.set(xlabel=labels[0], ylabel=labels[1])
        if down:
            axis.invert_yaxis()
        picture.colorbar(shown, ax=axis, label='rms [px]')

    return draw(name, caption, 2.7, paint)


def residual_maps(observation: Observation) -> list[Drawing]:
    """Residuals of the inliers over the image, over rows and rate, over rows and time."""
    pairs = observation.residuals
    intrinsics = observation.intrinsics
    if not pairs or intrinsics is None:
        return []
    points = np.concatenate([one.points for one in pairs])
    values = np.concatenate([one.residuals for one in pairs])
    counts = [len(one.residuals) for one in pairs]
    rate = np.degrees(np.repeat([one.rate for one in pairs], counts))
    begin_ns = pairs[0].stamp_ns
    time = np.repeat([(one.stamp_ns - begin_ns) / NANOSECONDS for one in pairs], counts)
    use = np.isfinite(values)
    if not use.any():
        return []
    width = intrinsics.image_width
    height = intrinsics.image_height
    across = np.linspace(0, width, 17)
    down = np.linspace(0, height, 13)
    rows = points[use, 1]
    maps = (
        (
            'cells',
            'Over the image: a pattern is an error of the lens.',
            map_of(points[use, 0], rows, values[use], (across, down)),
            ('column [px]', 'row [px]'),
        ),
        (
            'rows-rate',
            'Over rows and rate: growth with both is an error of readout time or offset.',
            map_of(rate[use], rows, values[use], (_borders(rate[use], 10), down)),
            ('rate of the camera [deg/s]', 'row [px]'),
        ),
        (
            'rows-time',
            'Over rows and time: columns are bad moments, rows are parts of the image.',
            map_of(time[use], rows, values[use], (_borders(time[use], 24), down)),
            ('time [s]', 'row [px]'),
        ),
    )
    return [
        _heat(name, caption, cells, labels, down=True)
        for name, caption, cells, labels in maps
        if np.isfinite(cells.rms).any()
    ]


def _borders(values: Array, count: int) -> Array:
    low = float(values.min())
    high = float(values.max())
    return np.linspace(low, max(high, low + 1e-6), count + 1)


def pairs(records: Sequence[PairRecord]) -> list[Drawing]:
    """Sigmas of the pairs over time, and their errors where there is ground truth."""
    known = [record for record in records if record.pose]
    if not known:
        return []
    begin_ns = records[0].reference_stamp_ns
    at = np.array([(record.stamp_ns - begin_ns) / NANOSECONDS for record in known])
    series = (
        ('rotation [deg]', rotation_sigmas, 'rotation_error'),
        ('direction [deg]', translation_sigmas, 'translation_error'),
    )

    def paint(picture: Figure) -> None:
        for axis, (label, sigmas_of, name) in zip(_axes(picture, 2), series, strict=True):
            lengths = [np.linalg.norm(sigmas_of(one.pose.covariance)) for one in known]
            sigmas = np.degrees(lengths)
            axis.plot(at, sigmas, '_', color=ORANGE, markersize=7, label='1 sigma, as estimated')
            errors = [
                math.nan if one.errors is None else getattr(one.errors, name) for one in known
            ]
            if np.isfinite(errors).any():
                axis.plot(at, errors, '.', color=BLUE, markersize=4, label='error against truth')
            axis.set_yscale('log')
            axis.set_ylabel(label)
        _legend(picture.axes[0])
        picture.axes[-1].set_xlabel('time [s]')

    has_truth = any(one.errors is not None for one in known)
    text = 'Rotation and direction of translation of each pair: ' + (
        'errors against the ground truth and estimated sigmas; both should have one size.'
        if has_truth
        else 'estimated sigmas (the recording has no ground truth).'
    )
    return [draw('pairs', text, 3.2, paint)]


def metric_path(observation: Observation) -> list[Drawing]:
    """The path from above and its height."""
    found = observation.path.path
    if found is None or not len(found.positions):
        return []
    at = (np.array(found.imu_ns) - found.imu_ns[0]) / NANOSECONDS

    def paint(picture: Figure) -> None:
        above, height = picture.subplots(2, 1, height_ratios=(3, 1))
        for axis in (above, height):
            axis.grid(True, linewidth=0.6)
        if found.truth is not None:
            x, y, z = found.truth.T
            above.plot(x, y, color=_INK, linewidth=2.0, label='ground truth')
            height.plot(at, z, color=_INK, linewidth=2.0)
        x, y, z = found.positions.T
        above.plot(x, y, color=ORANGE, label='odometry, live')
        height.plot(at, z, color=ORANGE)
        above.set_aspect('equal', adjustable='datalim')
        above.set(xlabel='x [m]', ylabel='y [m]')
        height.set(xlabel='time [s]', ylabel='z [m]')
        _legend(above)

    return [draw('path', 'The metric path from above, and its height.', 4.2, paint)]
