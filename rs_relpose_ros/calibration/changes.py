"""Changes of a deviation within the last seconds: a small step at one time, or a drift.

Each pair of the posterior has normal equations of the deviations. A step adds one unknown that
moves a deviation of the pairs after a border, a drift one that moves it with time. Both are solved
for without another linearisation: the columns of the deviation are weighted by pair. A drift is
zero at the last pair, so that the deviations that are solved for with it are those of now.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import Enum
import math
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.calibration.assessment import constant, Hypothesis, Solution
from rs_relpose_ros.calibration.findings import Configured
from rs_relpose_ros.core.deviations import LIVE
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.timing import NANOSECONDS, Stamps, to_nanoseconds

# 1 sigma of a step of the offset [s] before anything is measured. [derived: that of the offset]
_STEP_SIGMA = float(LIVE.sigmas[LIVE.index('time_offset')])
# 1 sigma of a drift of each deviation that may drift, in its unit per second, before anything is
# measured. [chosen: crystals are within 1e-4, clocks of a driver's own within 1e-3; a zoom or a
# focus that follows the distance changes the focal length by a percent in a second]
_DRIFT_SIGMAS = {'time_offset': 5e-4, 'focal_log': 0.01}
# Odds of a drift before anything is measured, over those of a deviation that is constant. More
# would widen covariances of correct recordings, less would widen those of a drift later. [chosen:
# 0.005 to 0.05 would do: pairs multiply them by a power of ten in a second]
_DRIFT_ODDS = 0.02
# Chi-square, as the pairs scatter, from which a change is certain. Less would find one by chance
# among the 100 borders of a window, after each pair. [chosen: 5 sigmas]
_CERTAIN = 25.0
# The same of a drift that was certain at the pair before. Less would keep one that has ended,
# more would let a drift come and go. [chosen: 3 to 4 sigmas]
_STILL_CERTAIN = 12.0
# Lead in chi-square over every other cause. [derived: 5 in the log-likelihood]
_LEAD = 10.0
# Gain in chi-square beyond which there is no doubt; it keeps an exponential finite.
# [chosen: exp(50) is 5e21; 40 to 1000 would do]
_LARGEST_GAIN = 100.0
# Pairs below which nothing is decided. [chosen: 2 to 4 s of keyframes]
_FEWEST = 20
# Pairs that come before a step. Fewer would take the first pairs, which are not linearised about
# the deviations yet, for those before a step. [chosen: 1 to 2 s of keyframes]
_BEFORE = 10
# Pairs that follow a step. Fewer would follow a single pair. [chosen: 3 to 6 would do]
_AFTER = 4
# Least step in sigmas of a single stamp. Less would take the mean of some stamps that jitter, as
# times of arrival do, for a step. [derived: 3 sigmas; measured: with delays of 6 ms in the mean a
# step of 6.7 +- 1.3 ms was named]
BEYOND_JITTER = 3.0
# Shortest time [ns] that shows a drift. [chosen: a step or a change of temperature takes less]
_SHORTEST_NS = to_nanoseconds(6.0)
# The deviation that may step. [derived: a clock that is set]
_OFFSET = 'time_offset'


class Kind(str, Enum):
    """How a deviation changes."""

    STEP = 'step'
    DRIFT = 'drift'


class Change(NamedTuple):
    """A change of a deviation that explains the pairs better than any other cause."""

    entry: str  # name of the deviation in `LIVE`
    kind: Kind
    value: float  # of a step in the unit of the entry, or a rate, the same per second
    sigma: float
    now: float  # deviation from the active value, at the last pair
    now_sigma: float
    between_ns: tuple[int, int]  # stamps of the pairs about a step, or of the first and last one
    gain: float  # in log-likelihood over all other causes
    pairs: int

    def is_drift_of(self, entry: str) -> bool:
        """Whether this is a drift of an entry."""
        return self.kind is Kind.DRIFT and self.entry == entry


class _Changing(NamedTuple):
    """A deviation that changes: one more value, times weights of the pairs."""

    value: float
    sigma: float  # as the pairs scatter
    gain: float  # in chi-square
    certainty: float  # the same as far as the pairs agree
    off: Array  # (K,) deviations of a pair whose weight is 0
    covariance: Array  # (K, K)


def change_of(
    ranked: Sequence[Hypothesis],
    stamps_ns: Stamps,
    configured: Configured,
    before: Change | None = None,
    stamp_sigma: float = 0.0,
) -> Change | None:
    """The change that explains N pairs (N,) best, if there is one.

    `ranked`: hypotheses of constant deviations, the best first; `before`: the change so far;
    `stamp_sigma` [s]: 1 sigma of a single stamp.
    """
    estimated = ranked[0].solution.estimated
    count = len(estimated.b)
    if count < _FEWEST:
        return None
    free = {one.quantity.entry: one for one in ranked}
    others = {entry: _best_other(ranked, entry) for entry in _DRIFT_SIGMAS}
    drifts = {entry: _drift(free[entry].solution, stamps_ns, entry) for entry in _DRIFT_SIGMAS}
    totals = {entry: free[entry].gain + drift.gain for entry, drift in drifts.items()}
    after = _after(count)
    offset = free[_OFFSET]
    also_off, _ = _best(offset.solution, after, _STEP_SIGMA, _OFFSET)
    lasts = stamps_ns[-1] - stamps_ns[0] > _SHORTEST_NS
    for entry, drift in drifts.items():
        rivals = [others[entry], *(total for one, total in totals.items() if one != entry)]
        if entry == _OFFSET:
            rivals.append(offset.gain + also_off.gain)
        lead = totals[entry] - max(rivals)
        is_known = before is not None and before.is_drift_of(entry)
        needed = _STILL_CERTAIN if is_known else _CERTAIN
        if lasts and min(drift.certainty - needed, lead - _LEAD) > 0.0:
            ends = int(stamps_ns[0]), int(stamps_ns[-1])
            return _change(entry, Kind.DRIFT, drift, ends, lead, count)
    step, best = _best(constant(estimated, configured), after, _STEP_SIGMA, _OFFSET)
    lead = step.gain - max(others[_OFFSET], *totals.values())
    is_jitter = abs(step.value) < BEYOND_JITTER * stamp_sigma
    if not is_jitter and min(step.certainty - _CERTAIN, lead - _LEAD) > 0.0:
        last = _BEFORE + best
        between = int(stamps_ns[last - 1]), int(stamps_ns[last])
        return _change(_OFFSET, Kind.STEP, step, between, lead, count)
    return None


def drift_doubts(
    ranked: Sequence[Hypothesis], stamps_ns: Stamps, configured: Configured
) -> Iterator[tuple[float, Array]]:
    """Odds of each drift, and the second moment (K, K) of the deviations of now with it.

    The odds are those of a constant deviation together with its drift, by their Bayes factor.
    """
    if len(stamps_ns) < _BEFORE:  # they agree or not by chance
        return
    for quantity, solution in ranked:
        if quantity.entry not in _DRIFT_SIGMAS:
            continue
        drift = _drift(solution, stamps_ns, quantity.entry)
        k = LIVE.index(quantity.entry)
        narrowed = drift.sigma / _DRIFT_SIGMAS[quantity.entry]
        gain = drift.certainty
        if not configured.sigmas[k]:
            narrowed *= math.sqrt(solution.covariance[k, k]) / LIVE.sigmas[k]
            gain += solution.certainty(quantity.part) ** 2
        odds = _DRIFT_ODDS * narrowed * math.exp(0.5 * min(gain, _LARGEST_GAIN))
        yield odds, drift.covariance + np.outer(drift.off, drift.off)


def _best_other(ranked: Sequence[Hypothesis], entry: str) -> float:
    """Chi-square in favour of the best constant deviation of another entry."""
    best = next(one for one in ranked if one.quantity.entry != entry)
    return best.solution.evidence(best.quantity)


def _drift(solution: Solution, stamps_ns: Stamps, entry: str) -> _Changing:
    seconds = (stamps_ns - stamps_ns[-1]) / NANOSECONDS
    drift, _ = _best(solution, seconds[None], _DRIFT_SIGMAS[entry], entry)
    return drift


def _after(count: int) -> Array:
    """Weights (M, N) of steps at all borders between N pairs."""
    borders = np.arange(_BEFORE, count - _AFTER + 1)
    return np.asarray(np.arange(count) >= borders[:, None], dtype=float)


def _change(
    entry: str,
    kind: Kind,
    found: _Changing,
    between_ns: tuple[int, int],
    lead: float,
    pairs: int,
) -> Change:
    k = LIVE.index(entry)
    now = float(found.off[k])
    sigma = math.sqrt(found.covariance[k, k])
    if kind is Kind.STEP:
        now += found.value
    return Change(entry, kind, found.value, found.sigma, now, sigma, between_ns, 0.5 * lead, pairs)


def _best(solution: Solution, weights: Array, prior: float, entry: str) -> tuple[_Changing, int]:
    """One more deviation of an entry, with a `prior` sigma, and the number of its weights.

    `weights` (M, N) are M alternatives: the one that gains most is the best.
    """
    estimated = solution.estimated
    misfit = estimated.scatter * estimated.shared
    S = estimated.S / misfit
    b = estimated.b / misfit
    k = LIVE.index(entry)
    columns = S[:, :, k]
    scores = b - S @ (solution.active + solution.off)
    mixed = weights @ columns
    moved = mixed @ solution.covariance  # change of the other deviations by the new one, negative
    by_others = (moved * mixed).sum(axis=1)
    information = weights**2 @ columns[:, k] - by_others + prior**-2.0
    gradients = weights @ scores[:, k]
    gains = gradients**2 / information
    best = int(np.argmax(gains))
    value = float(gradients[best] / information[best])
    # Parts of the pairs in what is left of the gradient, the other deviations eliminated.
    weight = weights[best]
    along = moved[best]
    explained = weight[:, None] * columns - S @ along
    left = scores - value * explained
    parts = value * (weight * left[:, k] - left @ along)
    scattered = max(float((parts**2).sum()), 1e-12)
    gain = value * float(gradients[best])
    agreement = min(gain / scattered, 1.0)
    agreed = information[best] * max(agreement, 1e-6)
    sigma = float(1.0 / np.sqrt(agreed))
    off = solution.off - along * value
    covariance = solution.covariance + sigma**2 * np.outer(along, along)
    return _Changing(value, sigma, gain, gain * agreement, off, covariance), best
