"""Pictures of a replay: matches of a pair, errors and residuals over time, orientation."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path

import cv2
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.timing import seconds_between
from rs_relpose_ros.messages.outgoing import draw_pair
from rs_relpose_ros.offline.tables import PairRecord, rotation_sigmas, translation_sigmas
from rs_relpose_ros.offline.truth import PairErrors, rotation_angle, TrueTrajectory
from rs_relpose_ros.output_files import BLUE, GREEN, ORANGE, RED, save_picture, written
from rs_relpose_ros.pipeline.pair import PairResult

# Resolution of pictures [dots per inch]: labels stay readable at full width. [chosen: any value in
# 90..150 would do]
_DPI = 110


def draw_replay(
    paths: Sequence[Path],
    records: Sequence[PairRecord],
    shown: PairResult,
    truth: TrueTrajectory | None,
) -> list[Path]:
    """Draw matches of one pair, errors (with ground truth), residuals and rotation; the files."""
    matches, errors, residuals, rotation = paths
    _, encoded = cv2.imencode('.png', draw_pair(shown))
    with written(matches, 'wb') as file:
        file.write(encoded.tobytes())
    draw_residuals(records, residuals)
    draw_rotation(records, rotation, truth)
    if truth is None:
        return [matches, residuals, rotation]
    draw_errors(records, errors)
    return [matches, errors, residuals, rotation]


def draw_errors(
    records: Sequence[PairRecord],
    path: Path,
    baselines: Mapping[str, Sequence[PairErrors | None]] | None = None,
) -> None:
    """Errors over time, with estimated sigmas; `baselines`: errors of other methods, by name."""
    picture = _over_time(2, 'errors of the relative poses against the ground truth')
    start_ns = records[0].reference_ns1
    known = [record for record in records if record.pose and record.errors is not None]
    begins, ends = _spans(known, start_ns)
    middles = 0.5 * (begins + ends)
    # Root of the mean square length of a 3-vector and a 2-vector with these sigmas.
    series = (
        ('rotation_error', rotation_sigmas, 'rotation error [deg]'),
        ('translation_error', translation_sigmas, 'translation direction\nerror [deg]'),
    )
    for axis, (name, sigmas_of, label) in zip(picture.axes, series, strict=True):
        if known:
            values = [getattr(record.errors, name) for record in known]
            of_records = [sigmas_of(record.pose.covariance) for record in known]
            sigmas = np.degrees([np.linalg.norm(one) for one in of_records])
            axis.hlines(
                sigmas, begins, ends, color=ORANGE, linewidth=2.2, label='1 sigma, as estimated'
            )
            axis.plot(middles, values, 'o', color=BLUE, markersize=5, label='error')
            _median_line(axis, values, f'median error {np.median(values):.2g} deg')
            _draw_others(axis, middles, name, baselines or {})
            axis.set_yscale('log')
            axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
            axis.yaxis.set_minor_formatter(NullFormatter())
        axis.set_ylabel(label)
        _shade_no_pose(axis, records, start_ns)
    _save_over_time(picture, path)


def _draw_others(
    axis: Axes, middles: Array, name: str, baselines: Mapping[str, Sequence[PairErrors | None]]
) -> None:
    """Draw the errors of other methods at the middles [s] of the pairs, and their medians."""
    colors = cycle((RED, GREEN))
    markers = cycle('+x12')
    for (method, errors), color, marker in zip(baselines.items(), colors, markers, strict=False):
        values = [np.nan if one is None else getattr(one, name) for one in errors]
        label = f'{method}:\nmedian {np.nanmedian(values):.2g} deg'
        axis.plot(middles, values, marker, color=color, markersize=6, label=label)


def draw_residuals(records: Sequence[PairRecord], path: Path) -> None:
    """Metrics without ground truth: residuals, inliers, rotation against the gyro."""
    picture = _over_time(3, 'residuals of the relative poses')
    start_ns = records[0].reference_ns1
    known = [record for record in records if record.pose]
    begins, ends = _spans(known, start_ns)
    series = (
        ('residual_rms_px', 1.0, None, 'residual of inliers,\nrms [px]'),
        ('inlier_ratio', 100.0, 105.0, 'inliers [%]'),
        ('rotation_difference_to_gyro_deg', 1.0, None, 'rotation: images\nagainst gyro [deg]'),
    )
    for axis, (metric, factor, top, label) in zip(picture.axes, series, strict=True):
        values = [factor * record.metrics[metric] for record in known]
        finite = [value for value in values if np.isfinite(value)]
        if finite:
            axis.plot(0.5 * (begins + ends), values, 'o', color=BLUE, markersize=4)
            _median_line(axis, finite, f'median {np.median(finite):.3g}')
        axis.set_ylabel(label)
        axis.set_ylim(bottom=0.0, top=top)
        _shade_no_pose(axis, records, start_ns)
    _save_over_time(picture, path)


def draw_rotation(records: Sequence[PairRecord], path: Path, truth: TrueTrajectory | None) -> None:
    """Rotation accumulated over the pairs, against the ground truth or else the gyro."""
    chains = _chains(records, truth)
    against = list(chains)[-1]  # the ground truth, or else the gyro
    start_ns = records[0].reference_ns1
    _, ends = _spans(records, start_ns)
    times = [0.0, *ends]
    picture = _over_time(
        2, 'orientation against the first keyframe: the rotations of the pairs, chained'
    )
    above, below = picture.axes
    estimated = _vectors(chains['estimated']).T
    reference = _vectors(chains[against]).T
    components = ((BLUE, 'x (right)'), (RED, 'y (down)'), (GREEN, 'z (forward)'))
    for (color, name), values in zip(components, estimated, strict=True):
        above.plot(times, values, 'o-', color=color, label=name, markersize=3)
    labels = (None, None, against)  # once for all three
    for label, values in zip(labels, reference, strict=True):
        above.plot(times, values, '--', color='black', linewidth=1.0, label=label)
    above.set_ylabel('rotation vector, axes of\nthe camera [deg]')
    *others, true = chains.values()
    for name, chain, color in zip(chains, others, (BLUE, ORANGE), strict=False):
        differences = [R.T @ R_true for R, R_true in zip(chain, true, strict=True)]
        angles = [rotation_angle(one) for one in differences]
        label = f'{name} against {against}'
        below.plot(times, angles, 'o-', color=color, markersize=3, linewidth=1.4, label=label)
    below.set_ylabel('difference, accumulated\n[deg]')
    title = 'drift of the chain: errors of pairs accumulate, as in any odometry'
    below.set_title(title, fontsize=9, loc='left')
    below.set_ylim(bottom=0.0)
    bridged = [record for record in records if np.isnan(record.pose.R).any()]
    _shade_no_pose(below, bridged, start_ns, 'no rotation: gyro instead')
    _save_over_time(picture, path)


def _chains(records: Sequence[PairRecord], truth: TrueTrajectory | None) -> dict[str, list[Array]]:
    """Orientations of the keyframes by source: the estimate, the gyro, and the truth if known.

    A pair without a rotation is bridged by the gyro.
    """
    unknown = np.full((3, 3), np.nan)
    estimated = []
    gyro = []
    true = []
    for record in records:
        by_gyro = unknown if record.gyro_rotation is None else record.gyro_rotation
        gyro.append(by_gyro)
        estimated.append(by_gyro if np.isnan(record.pose.R).any() else record.pose.R)
        if truth is not None:
            pose = truth.relative_pose(record.reference_ns1, record.reference_ns2)
            true.append(unknown if pose is None else pose[0])
    chains = {'estimated': _accumulated(estimated), 'gyro alone': _accumulated(gyro)}
    if truth is not None:
        chains['ground truth'] = _accumulated(true)
    return chains


def _vectors(chain: Sequence[Array]) -> Array:
    """Rotation vectors (N, 3) [deg]; NaN where a rotation is not known."""
    vectors = np.full((len(chain), 3), np.nan)
    for vector, R in zip(vectors, chain, strict=True):
        if np.isfinite(R).all():
            vector[:] = Rotation.from_matrix(R).as_rotvec(degrees=True)
    return vectors


def _over_time(count: int, title: str) -> Figure:
    picture = Figure(figsize=(10.5, 0.9 + 2.1 * count), dpi=_DPI, layout='constrained')
    for axis in picture.subplots(count, 1, sharex=True):
        axis.grid(True, which='major', color='0.88')
        axis.set_axisbelow(True)
    picture.suptitle(title, fontsize=12)
    return picture


def _save_over_time(picture: Figure, path: Path) -> None:
    for axis in picture.axes:
        axis.legend(loc='upper left', bbox_to_anchor=(1.0, 1.0), fontsize=9)
    picture.axes[-1].set_xlabel('time since the first keyframe [s]')
    save_picture(picture, path)


def _median_line(axis: Axes, values: Sequence[float], label: str) -> None:
    axis.axhline(float(np.median(values)), color=BLUE, linestyle='--', linewidth=1.0, label=label)


def _shade_no_pose(
    axis: Axes, records: Sequence[PairRecord], start_ns: int, label: str = ''
) -> None:
    """Spans of the pairs without a pose, one entry of the legend per status."""
    labelled = set()
    hatches = {Status.PURE_ROTATION: '', Status.LOW_PARALLAX: '..', Status.WITHHELD: 'xx'}
    for record in records:
        if record.pose:
            continue
        text = label or f'no pose: {record.pose.status.value}'
        (begin,), (end,) = _spans([record], start_ns)
        axis.axvspan(
            begin,
            end,
            facecolor='0.6',
            alpha=0.35,
            edgecolor='0.3',
            linewidth=0.0,
            hatch=hatches.get(record.pose.status, '//'),
            label=None if text in labelled else text,
        )
        labelled.add(text)


def _spans(records: Sequence[PairRecord], start_ns: int) -> tuple[Array, Array]:
    """Times (N,) of the reference rows of both frames of the pairs [s]."""
    begins = [seconds_between(start_ns, record.reference_ns1) for record in records]
    ends = [seconds_between(start_ns, record.reference_ns2) for record in records]
    return np.array(begins), np.array(ends)


def _accumulated(rotations: Sequence[Array]) -> list[Array]:
    """Products (3, 3) of the rotations, from the identity; NaN after an unknown one."""
    products = [np.eye(3)]
    for rotation in rotations:
        products.append(products[-1] @ rotation)
    return products
