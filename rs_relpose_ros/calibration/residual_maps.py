"""Residuals of matches in cells: tests of a configuration that presuppose no cause.

Each inlier of a pair has a signed residual of the epipolar constraint, over its sigma. Its sum
over the inliers of a cell is zero on the average if all parameters are right, whatever the scene.
Matches of one pair share its pose and its light, and tracks last for several pairs: the pairs of
half a second are one observation of a cell, and their scatter gives the variance of the sum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
import sys
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtr

from rs_relpose_ros.calibration.findings import (
    Assessment,
    Code,
    Evidence,
    Finding,
    FindingState,
    Why,
)
from rs_relpose_ros.calibration.posterior import LastSeconds, WINDOW_NS
from rs_relpose_ros.core.losses import SIGMA_PER_MEDIAN
from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.matches import Matches
from rs_relpose_ros.geometry.so3 import skew
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds

# Probability below which a map fails. A larger one would doubt correct recordings, a smaller one
# would miss errors of 20 s. [derived: four maps a minute are below it once in 400 hours by chance]
FAILS_BELOW = 1e-5
# Columns of cells of the image. More have too few matches, fewer average the lens out.
# [chosen: 4 to 8 would do]
COLUMNS = 6
# Rows of cells of the image, likewise. [chosen: 3 to 6 would do]
ROWS = 4
# Parts of the readout over which rows are summed. More have too few matches, fewer average an
# error of the readout out. [chosen: 4 to 10 would do]
_BANDS = 6
# Borders of the change of the angular rate over a pair [rad/s]. Other ones would leave classes
# without pairs. [chosen: about quarters of the pairs of hand-held walks]
_CHANGES = (0.1, 0.25, 0.6)
# Change of the rate [rad/s] beyond which the rotation of a pair has no more weight for the time
# offset. Without a bound few fast pairs would decide. [chosen: 0.3 to 1 rad/s would do]
_LARGEST_CHANGE = 0.5
# Length of the blocks of time [s]. Shorter ones have few pairs, longer ones average a step out.
# [chosen: 1 to 4 s would do]
_BLOCK = 2.0
# Time of the pairs that make one observation [s]. Without it, tracks that last for several pairs
# count as independent, and a bias of one of them is taken for one of the camera; longer groups
# are few. [measured: with pairs alone a recording of a RealSense has 1e-9 where half a second has
# 3e-4]
_GROUP = 0.5
# Bias of all residuals of a cell that a tracker makes [sigmas of a residual], as 1 sigma. Without
# it correct recordings would fail that are long, or of a plane; a larger one would hide errors of
# the readout. [measured: of halves of a correct plane that fills the view the mean is 0.041, and
# p is 3e-6 without and 4e-3 with it; with 0.03 a readout that is off by 2 ms hardly fails]
_TRACKER_BIAS = 0.02
# Fewest observations of a cell. With fewer the scatter itself is noise. [chosen: 6 to 12 would do]
_FEWEST_GROUPS = 8
# Fewest pairs of a block of time, whose scatter is that of all blocks. [chosen: 2 to 6 would do]
_FEWEST_PAIRS = 3
# Fewest pairs beyond the number of blocks that give that scatter. [chosen: 10 to 40 would do]
_FEWEST_FREE = 20
# Bound of a residual in sigmas. Without one few mismatches among the inliers would be the scatter.
# [chosen: inliers lie within four sigmas by definition]
_BOUND = 4.0
# Bound of the rotation of images against the gyro, in robust sigmas of all pairs, likewise.
# [chosen: 2.5 to 4 would do]
_BOUND_OF_ROTATION = 3.0
# Least length of a direction that is divided by. [derived: no division by zero]
_TINY = 1e-12
# Components of a residual, in the order of `PairSums.cells`. [derived: text for people]
_COMPONENTS = ('along the motion', 'across the motion', 'along the change of the rotation')
# Pairs of the last seconds that are kept. It bounds the time of a test; with fewer, keyframes at
# 10 Hz would not fill the window. [chosen: 150 to 400 would do]
_MOST_LIVE = 200
# Time from one test of the last seconds to the next [ns]. More tests cost time and find a pattern
# hardly earlier, as each pair is in many of them. [chosen: a block of time]
_TEST_EVERY_NS = to_nanoseconds(_BLOCK)
# Least probability that is given: smaller ones are not those of a Student distribution.
_LEAST_P = 1e-300

# Causes that a map shows, by its name. [derived: what moves residuals alike in these cells]
CANDIDATES: dict[str, tuple[Code, ...]] = {
    'cells': (Code.PRINCIPAL_POINT, Code.DISTORTION, Code.STATIC_REGION),
    'rows_rate': (Code.READOUT_TIME, Code.READOUT_DIRECTION),
    'time': (Code.OFFSET_STEP, Code.OFFSET_DRIFT, Code.FOCAL_DRIFT),
    'halves': (),
}


class View(NamedTuple):
    """The image in which the cells lie."""

    width: int  # [px]
    height: int  # [px]
    readout_axis: int = 1  # pixel coordinate that is the row


class SignedResiduals(NamedTuple):
    """Residuals of N matches, and where each of them would move its point."""

    values: Array  # (N,) [rad] of the first order (Sampson)
    directions: Array  # (N, 3) unit, perpendicular to the ray in camera 2


def signed_residuals(pose: RelativePose, matches: Matches) -> SignedResiduals:
    """Distances of matches from the epipolar constraint of their rows.

    With the baseline ``b = t + tau_2 R v_2 - tau_1 v_1`` between the places of the camera at both
    rows, ``f_1 . (b x R f_2)`` over the length of its gradient by both images.
    """
    first = matches.rays[0]
    second = matches.rays[-1] @ pose.R.T
    velocity_2 = pose.R @ pose.linear_velocity2
    moved_1 = np.outer(matches.row_times[0], pose.linear_velocity1)
    moved_2 = np.outer(matches.row_times[-1], velocity_2)
    baselines = pose.t + moved_2 - moved_1
    normals = _crossed(baselines, second)
    values = np.einsum('ij,ij->i', first, normals)
    by_first = normals - values[:, None] * first
    by_second = _crossed(first, baselines)
    radial = np.einsum('ij,ij->i', by_second, second)
    by_second = by_second - radial[:, None] * second
    length_1 = _lengths(by_first)
    length_2 = _lengths(by_second)
    length = np.maximum(np.hypot(length_1, length_2), _TINY)
    directions = by_second / np.maximum(length_2, _TINY)[:, None]
    return SignedResiduals(values / length, directions @ pose.R)


def _crossed(a: Array, b: Array) -> Array:
    """Cross products (N, 3) of vectors (N, 3), in a third of the time of `np.cross`."""
    ahead = [1, 2, 0]
    behind = [2, 0, 1]
    return np.asarray(a[:, ahead] * b[:, behind] - a[:, behind] * b[:, ahead])


@dataclass(frozen=True, slots=True, eq=False)
class PairSums:
    """What a pair adds to the maps."""

    stamp_ns: int  # of the current image
    cells: Array  # (3, 24) sums of the components of residuals over sigma
    counts: Array  # (24,) matches of the cells
    bands: Array  # (6,) sums of the third component over parts of the readout
    band_counts: Array  # (6,)
    change: float  # of the angular rate over the pair [rad/s]
    against_gyro: float  # [rad] rotation of images by the gyro's, about that change; NaN

    @classmethod
    def of(
        cls,
        stamp_ns: int,
        matches: Matches,
        pose: RelativePose,
        focal_length: float,
        view: View,
        images_against_gyro: Array | None,
    ) -> PairSums | None:
        """The sums of the inliers; `focal_length` [px]. None without a pose and its rates."""
        if not pose:
            return None
        change = pose.angular_velocity2 - pose.R.T @ pose.angular_velocity1
        sigma = pose.diagnostics.pixel_sigma / focal_length
        if not np.isfinite(change).all() or not sigma > 0.0:
            return None
        found = signed_residuals(pose, matches)
        use = pose.inliers & np.isfinite(found.values)
        bounded = np.clip(found.values[use] / sigma, -_BOUND, _BOUND)
        points2 = matches.points2[use]
        turning = matches.rays[-1][use] @ skew(-change).T  # times the change of the rotation
        motions = points2 - matches.points1[use]
        values = bounded * _components(found.directions[use], motions, turning)
        share = points2 / (view.width, view.height)
        place = _parts(share, np.array([COLUMNS, ROWS]))
        band = _parts(share[:, view.readout_axis], np.array(_BANDS))
        cell = place @ (1, COLUMNS)
        size = ROWS * COLUMNS
        rate = float(np.linalg.norm(change))
        axis = pose.R @ change / max(rate, _TINY)
        return cls(
            stamp_ns,
            np.array([_summed(cell, one, size) for one in values]),
            _summed(cell, None, size),
            _summed(band, values[2], _BANDS),
            _summed(band, None, _BANDS),
            rate,
            math.nan if images_against_gyro is None else float(images_against_gyro @ axis),
        )


def _parts(share: Array, parts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Which of equal parts of [0, 1] shares (N, ...) lie in, for each coordinate."""
    return np.clip((share * parts).astype(np.int64), 0, parts - 1)


def _summed(cells: NDArray[np.int64], values: Array | None, size: int) -> Array:
    """Sums (size,) of values (N,) by their cells (N,), or their numbers."""
    return np.asarray(np.bincount(cells, values, size), dtype=float)


def _components(directions: Array, motions: Array, turning: Array) -> Array:
    """Shares (3, N) of residuals in the directions of `_COMPONENTS`.

    `motions` (N, 2) are those of the points in the image, `turning` (N, 3) what a change of the
    rotation moves, in camera 2.
    """
    flat = _of_length_1(directions[:, :2])
    moved = _of_length_1(motions)
    along = (flat * moved).sum(axis=1)
    across = moved[:, 0] * flat[:, 1] - moved[:, 1] * flat[:, 0]
    turned = (directions * _of_length_1(turning)).sum(axis=1)
    return np.stack([along, across, turned])


def _of_length_1(vectors: Array) -> Array:
    """Vectors (N, K) over their lengths; zero where they have none."""
    lengths = _lengths(vectors)
    return np.asarray(vectors / np.maximum(lengths, _TINY)[:, None])


def _lengths(vectors: Array) -> Array:
    """Lengths (N,) of vectors (N, K)."""
    return np.asarray(np.sqrt(np.einsum('ij,ij->i', vectors, vectors)))


@dataclass(frozen=True, slots=True, eq=False)
class ResidualMap:
    """Sums over M cells with their expectation; a cell of which little is known does not count."""

    name: str  # a key of `CANDIDATES`
    labels: tuple[str, ...]  # of the cells
    sums: Array  # (M,)
    counts: Array  # (M,) of what was summed
    expectation: Array  # (M,) of the sums
    sigmas: Array  # (M,) of the sums; NaN of cells that do not count
    probabilities: Array  # (M,) of a sum that is farther from its expectation; 1 there

    @property
    def tested(self) -> int:
        """Number of cells that count."""
        return int(np.isfinite(self.sigmas).sum())

    @property
    def chi_square(self) -> float:
        """Sum of the squares of normal deviates as improbable as the sums; `tested` of freedom.

        Cells that share pairs are not independent: the test is that of `worst`.
        """
        return float((ndtri(0.5 * self.probabilities) ** 2).sum())

    @property
    def worst(self) -> int:
        """Index of the least probable cell."""
        return int(np.argmin(self.probabilities))

    @property
    def p(self) -> float:
        """Probability of its worst cell among all that count; 1 without any."""
        return min(1.0, max(self.tested, 1) * float(self.probabilities[self.worst]))

    @property
    def fails(self) -> bool:
        """Whether its residuals have a pattern."""
        return self.p < FAILS_BELOW

    @property
    def mean(self) -> float:
        """Mean in the worst cell, in the unit of the sums."""
        return float(self.sums[self.worst] / max(self.counts[self.worst], 1.0))

    def as_json(self) -> dict[str, Any]:
        """The map in summary.json."""
        return {
            'map': self.name,
            'p': self.p,
            'chi_square': self.chi_square,
            'cells': self.tested,
            'worst': self.labels[self.worst] if self.tested else None,
            'mean': self.mean if self.tested else None,
        }


def map_by_groups(
    name: str,
    labels: tuple[str, ...],
    sums: Array,
    counts: Array,
    groups: NDArray[np.int64],
) -> ResidualMap:
    """The map of sums (P, M) over P pairs, each in one of the `groups` (P,), from 0 on.

    A group is one observation of a cell, and their scatter about its mean the variance, together
    with the bias of a tracker.
    """
    total = sums.sum(axis=0)
    number = counts.sum(axis=0)
    left = sums - counts * (total / np.maximum(number, 1.0))
    shape = (int(groups.max(initial=-1)) + 1, len(labels))
    by_group = np.zeros(shape)
    present = np.zeros(shape)
    np.add.at(by_group, groups, left)
    np.add.at(present, groups, counts)
    observed = (present > 0.0).sum(axis=0)
    variance = (by_group**2).sum(axis=0) * observed / np.maximum(observed - 1, 1)
    known = (observed >= _FEWEST_GROUPS) & (variance > 0.0)
    with_bias = np.sqrt(variance + (_TRACKER_BIAS * number) ** 2)
    sigmas = np.where(known, with_bias, math.nan)
    return _assessed(name, labels, (total, number), sigmas, observed - 1)


def _assessed(
    name: str,
    labels: tuple[str, ...],
    totals: tuple[Array, Array],
    sigmas: Array,
    freedom: NDArray[np.int64],
) -> ResidualMap:
    """The map of sums and counts that are zero on the average, with their sigmas."""
    total, number = totals
    known = np.isfinite(sigmas)
    deviates = np.abs(total) / np.where(known, sigmas, 1.0)
    outside = 2.0 * stdtr(np.maximum(freedom, 1), -deviates)
    probabilities = np.where(known, np.maximum(outside, _LEAST_P), 1.0)
    expected = np.zeros(len(labels))
    return ResidualMap(name, labels, total, number, expected, sigmas, probabilities)


def maps_of(pairs: Sequence[PairSums]) -> tuple[ResidualMap, ...]:
    """All maps of pairs in the order of time; none without pairs."""
    if not pairs:
        return ()
    stamps_ns = np.array([pair.stamp_ns for pair in pairs])
    seconds = (stamps_ns - stamps_ns.min()) / NANOSECONDS
    groups = np.asarray(np.unique(seconds // _GROUP, return_inverse=True)[1], dtype=np.int64)
    cells = np.array([pair.cells for pair in pairs])
    counts = np.array([pair.counts for pair in pairs])
    return (
        _of_image(cells, counts, groups),
        _of_rows(pairs, groups),
        _of_time(pairs, seconds),
        _of_halves(cells, counts, seconds, groups),
    )


def _of_image(cells: Array, counts: Array, groups: NDArray[np.int64]) -> ResidualMap:
    """Cells of the image, along and across the motion."""
    labels = tuple(
        f'column {column + 1} of {COLUMNS}, row {row + 1} of {ROWS}, {component}'
        for component in _COMPONENTS[:2]
        for row in range(ROWS)
        for column in range(COLUMNS)
    )
    sums = cells[:, :2].reshape(len(cells), -1)
    return map_by_groups('cells', labels, sums, np.tile(counts, 2), groups)


def _of_rows(pairs: Sequence[PairSums], groups: NDArray[np.int64]) -> ResidualMap:
    """Parts of the readout by the change of the angular rate.

    At a constant rate a wrong readout time moves the points of both images nearly alike.
    """
    classes = len(_CHANGES) + 1
    at = np.searchsorted(_CHANGES, [pair.change for pair in pairs])
    rows = np.arange(len(pairs))
    sums, counts = np.zeros((2, len(pairs), classes, _BANDS))
    sums[rows, at] = [pair.bands for pair in pairs]
    counts[rows, at] = [pair.band_counts for pair in pairs]
    borders = ('0', *(f'{one:g}' for one in _CHANGES))
    labels = tuple(
        f'part {band + 1} of {_BANDS} of the readout, change of the rate from {low} rad/s'
        for low in borders
        for band in range(_BANDS)
    )
    flat = (len(pairs), classes * _BANDS)
    return map_by_groups('rows_rate', labels, sums.reshape(flat), counts.reshape(flat), groups)


def _of_time(pairs: Sequence[PairSums], seconds: Array) -> ResidualMap:
    """Rotation of images against the gyro in blocks of time, about the change of the rate.

    There a wrong time offset shows. Blocks have few pairs: the scatter is that of all of them.
    """
    all_blocks = (seconds // _BLOCK).astype(np.int64)
    size = int(all_blocks.max()) + 1
    borders = _BLOCK * np.arange(size + 1)
    labels = tuple(f'{borders[k]:g} to {borders[k + 1]:g} s' for k in range(size))
    rotations = _weighted_rotations(pairs)
    known = np.isfinite(rotations)
    blocks = all_blocks[known]
    values = rotations[known]
    total = _summed(blocks, values, size)
    number = _summed(blocks, None, size)
    means = total / np.maximum(number, 1.0)
    left = values - means[blocks]
    free = len(values) - int((number > 0.0).sum())
    variance = float((left**2).sum()) / max(free, 1)
    is_scatter_known = free >= _FEWEST_FREE and variance > 0.0
    counts = (number >= _FEWEST_PAIRS) & is_scatter_known
    sigmas = np.where(counts, np.sqrt(number * variance), math.nan)
    return _assessed('time', labels, (total, number), sigmas, np.full(size, free))


def _weighted_rotations(pairs: Sequence[PairSums]) -> Array:
    """Rotations (P,) of images against the gyro, bounded, times the change of the rate."""
    apart = np.array([pair.against_gyro for pair in pairs])
    weights = np.minimum([pair.change for pair in pairs], _LARGEST_CHANGE)
    sizes = np.abs(apart[np.isfinite(apart)])
    scale = SIGMA_PER_MEDIAN * float(np.median(sizes)) if len(sizes) else 0.0
    bound = _BOUND_OF_ROTATION * scale
    return np.asarray(weights * np.clip(apart, -bound, bound))


def _of_halves(
    cells: Array, counts: Array, seconds: Array, groups: NDArray[np.int64]
) -> ResidualMap:
    """Halves of the image, of the pairs and of the time."""
    column = np.arange(COLUMNS * ROWS) % COLUMNS
    row = np.arange(COLUMNS * ROWS) // COLUMNS
    number = np.arange(len(cells))
    in_cells = np.ones(COLUMNS * ROWS, dtype=bool)
    in_pairs = np.ones(len(cells), dtype=bool)
    middle = float(np.median(seconds))
    halves = (
        ('left half', in_pairs, 2 * column < COLUMNS),
        ('right half', in_pairs, 2 * column >= COLUMNS),
        ('upper half', in_pairs, 2 * row < ROWS),
        ('lower half', in_pairs, 2 * row >= ROWS),
        ('even pairs', number % 2 == 0, in_cells),
        ('odd pairs', number % 2 == 1, in_cells),
        ('first half of the time', seconds <= middle, in_cells),
        ('second half of the time', seconds > middle, in_cells),
    )
    sums = [(cells @ of_cells) * of_pairs[:, None] for _, of_pairs, of_cells in halves]
    numbers = [(counts @ of_cells) * of_pairs for _, of_pairs, of_cells in halves]
    labels = tuple(f'{name}, {component}' for name, *_ in halves for component in _COMPONENTS)
    per_component = np.repeat(np.stack(numbers, axis=1), len(_COMPONENTS), axis=1)
    return map_by_groups('halves', labels, np.concatenate(sums, axis=1), per_component, groups)


class ResidualMaps:
    """Sums of pairs in the order of time, and what their maps show.

    Offline they are of all pairs of a recording, live of the last seconds (`of_last_seconds`).
    """

    def __init__(self, most: int = sys.maxsize, window_ns: int = sys.maxsize) -> None:
        self._pairs = LastSeconds(most, window_ns)
        self._tested_ns: int | None = None  # stamp of the last pair of the last test
        self._maps: tuple[ResidualMap, ...] = ()

    @classmethod
    def of_last_seconds(cls) -> Self:
        """The maps of a recording that goes on."""
        return cls(_MOST_LIVE, WINDOW_NS)

    def add(self, sums: PairSums | None) -> None:
        """Add a pair; None: it has no residuals."""
        if sums is not None:
            self._pairs.keep((sums.stamp_ns, sums))

    def clear(self) -> None:
        """Forget the pairs: those that come have another configuration."""
        self._pairs.clear()
        self._tested_ns = None
        self._maps = ()

    def maps(self) -> tuple[ResidualMap, ...]:
        """The maps of the pairs so far."""
        return maps_of([sums for _, sums in self._pairs])

    def test_in_turn(self) -> None:
        """Test the pairs, unless it was done a short time ago."""
        if not self._pairs:
            return
        newest_ns = self._pairs[-1][0]
        if self._tested_ns is None or newest_ns - self._tested_ns >= _TEST_EVERY_NS:
            self._tested_ns, self._maps = newest_ns, self.maps()

    def added_to(self, health: Assessment) -> Assessment:
        """The assessment with a finding by the last test, if nothing else is found."""
        return with_maps(health, self._maps)


def with_maps(health: Assessment, maps: Sequence[ResidualMap]) -> Assessment:
    """The assessment with a finding on the first map that fails, if nothing else is found."""
    failed = next((one for one in maps if one.fails), None)
    if failed is None or health.faults:
        return health
    unknown = Finding(
        Code.UNKNOWN_CAUSE,
        FindingState.SUSPECT,
        Why.RESIDUALS,
        evidence=Evidence(measured=failed.as_json()),
        candidates=CANDIDATES[failed.name],
    )
    others = (one for one in health.findings if one.code is not unknown.code)
    return Assessment((unknown, *others))


def summary_line(maps: Sequence[ResidualMap]) -> str:
    """The maps in one line for the console; empty without any."""
    known = [one for one in maps if one.tested]
    if not known:
        return ''
    worst = min(known, key=lambda one: one.p)
    least = f'{worst.name}, p {worst.p:.1g}: {worst.labels[worst.worst]}'
    return f'residuals: {"a pattern" if worst.fails else "no pattern"} (least probable {least})'
