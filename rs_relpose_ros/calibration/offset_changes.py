"""Changes of the time offset within the last seconds: a small step at one time, or a drift.

Each pair of the posterior has normal equations of the deviations. A step adds one unknown that
moves the offset of the pairs after a border, a drift one that moves it with time. Both are solved
for without another linearisation: the columns of the offset are weighted by pair.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.calibration.assessment import offset_hypotheses, Solution
from rs_relpose_ros.calibration.findings import Configured
from rs_relpose_ros.calibration.posterior import Calibration
from rs_relpose_ros.core.deviations import LIVE
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.timing import NANOSECONDS, Stamps

# 1 sigma of a step [s] before anything is measured. [derived: that of the offset]
_STEP_SIGMA = float(LIVE.sigmas[LIVE.index('time_offset')])
# 1 sigma of a drift [s/s] before anything is measured. [chosen: crystals are within 1e-4, clocks
# of a driver's own within 1e-3]
_DRIFT_SIGMA = 5e-4
# Chi-square, as the pairs scatter, from which a change is certain. Less would find one by chance
# among the 100 borders of a window, after each pair. [chosen: 5 sigmas]
_CERTAIN = 25.0
# Lead in chi-square over every other cause. [derived: 5 in the log-likelihood]
_LEAD = 10.0
# Pairs below which nothing is decided. [chosen: 2 to 4 s of keyframes]
_FEWEST = 20
# Pairs that come before a step. Fewer would take the first pairs, which are not linearised about
# the deviations yet, for those before a step. [chosen: 1 to 2 s of keyframes]
_BEFORE = 10
# Pairs that follow a step. Fewer would follow a single pair. [chosen: 3 to 6 would do]
_AFTER = 4
# Shortest time [s] that shows a drift. [chosen: a step or a change of temperature takes less]
_SHORTEST = 6.0
# Place of the offset in the vector of deviations.
_OFFSET = LIVE.index('time_offset')


class Kind(str, Enum):
    """How the offset changes."""

    STEP = 'step'
    DRIFT = 'drift'


class OffsetChange(NamedTuple):
    """A change of the time offset that explains the pairs better than any other cause."""

    kind: Kind
    value: float  # of a step [s], or a rate [s/s]
    sigma: float
    now: float  # [s] deviation of the offset from the active one, at the last pair
    between_ns: tuple[int, int]  # stamps of the pairs about a step, or of the first and last one
    gain: float  # in log-likelihood over all other causes
    pairs: int


class _Change(NamedTuple):
    """One more value, times weights of the pairs."""

    value: float
    sigma: float  # as the pairs scatter
    gain: float  # in chi-square
    certainty: float  # the same as far as the pairs agree
    offset: float  # [s] deviation of the offset that is constant, with this value


def offset_change(
    estimated: Calibration, stamps_ns: Stamps, configured: Configured
) -> OffsetChange | None:
    """The change of the offset that explains N pairs (N,) best, if there is one."""
    count = len(estimated.b)
    if count < _FEWEST:
        return None
    constant, free, other = offset_hypotheses(estimated, configured)
    numbers = np.arange(count)
    borders = np.arange(_BEFORE, count - _AFTER + 1)
    after = (numbers >= borders[:, None]).astype(float)
    seconds = (stamps_ns - stamps_ns[-1]) / NANOSECONDS
    step, border = _best(constant, after, _STEP_SIGMA)
    also_off, _ = _best(free, after, _STEP_SIGMA)
    drift, _ = _best(free, seconds[None], _DRIFT_SIGMA)
    by_offset = free.gain(LIVE.part('time_offset'))
    drifting = by_offset + drift.gain
    lead = drifting - max(by_offset + also_off.gain, other)
    if seconds[0] < -_SHORTEST and min(drift.certainty - _CERTAIN, lead - _LEAD) > 0.0:
        ends = int(stamps_ns[0]), int(stamps_ns[-1])
        return OffsetChange(
            Kind.DRIFT, drift.value, drift.sigma, drift.offset, ends, 0.5 * lead, count
        )
    lead = step.gain - max(drifting, other)
    if min(step.certainty - _CERTAIN, lead - _LEAD) > 0.0:
        last = int(borders[border])
        between = int(stamps_ns[last - 1]), int(stamps_ns[last])
        now = step.value + step.offset
        return OffsetChange(Kind.STEP, step.value, step.sigma, now, between, 0.5 * lead, count)
    return None


def _best(solution: Solution, weights: Array, prior: float) -> tuple[_Change, int]:
    """One more deviation of the offset, with a `prior` sigma, and the number of its weights.

    `weights` (M, N) are M alternatives: the one that gains most is the best.
    """
    estimated = solution.estimated
    misfit = estimated.scatter * estimated.shared
    S, b = estimated.S / misfit, estimated.b / misfit
    columns = S[:, :, _OFFSET]
    scores = b - S @ (solution.active + solution.off)
    mixed = weights @ columns
    moved = mixed @ solution.covariance  # change of the other deviations by the new one, negative
    by_others = (moved * mixed).sum(axis=1)
    information = weights**2 @ columns[:, _OFFSET] - by_others + prior**-2.0
    gradients = weights @ scores[:, _OFFSET]
    gains = gradients**2 / information
    best = int(np.argmax(gains))
    value = float(gradients[best] / information[best])
    # Parts of the pairs in what is left of the gradient, the other deviations eliminated.
    weight, along = weights[best], moved[best]
    explained = weight[:, None] * columns - S @ along
    left = scores - value * explained
    parts = value * (weight * left[:, _OFFSET] - left @ along)
    scattered = max(float((parts**2).sum()), 1e-12)
    gain = value * float(gradients[best])
    agreement = min(gain / scattered, 1.0)
    agreed = information[best] * max(agreement, 1e-6)
    sigma = float(1.0 / np.sqrt(agreed))
    offset = float(solution.off[_OFFSET] - along[_OFFSET] * value)
    return _Change(value, sigma, gain, gain * agreement, offset), best
