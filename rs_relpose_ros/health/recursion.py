"""Recursive calibration: the pairs of the last seconds, added up and solved.

``(sum S_p + P^-1) c = sum b_p`` with a wide prior P, so that what this motion does not show stays
at what was told, with the sigma that it had. The inverse Hessian is widened by the misfit of the
scores ``g_p = b_p - S_p c`` of the pairs (sandwich; White, Econometrica 1982), axis by axis: about
the solution, since about zero they hold the very deviation that is sought.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.estimator.information import inverse
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.health.deviation import DEVIATIONS
from rs_relpose_ros.health.pair_information import (
    pair_information,
    PairEvidence,
    PairInformation,
)

Array = NDArray[np.float64]

# Pairs that count: those of the last seconds, at most so many.
WINDOW_NS = to_nanoseconds(20.0)
MOST_PAIRS = 100
# Older pairs that are linearised anew with each new one, and distance in sigmas of the prior
# within which that changes nothing.
_ANEW, _NEAR = 3, 0.02
# Sigmas of n pairs are widened by (n + 6) / n: few scores scatter less than they should. Share of
# a pair's sigma that is alike in all pairs, and no mean makes smaller: blur, the tracker's bias, a
# lens that the model does not fit.
_UNSEEN_PAIRS, _SHARED = 6, 0.25
# Deviations before the first pair, 1 sigma: rad, s, s, rad/s, -, -, -.
PRIOR_SIGMA = np.array([0.2] * 3 + [0.05, 0.03] + [0.1] * 3 + [0.2, 0.3, 0.5])
PRIOR_INFORMATION = np.diag(PRIOR_SIGMA**-2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Deviations from what was told, as seen."""

    c: Array   # (11,)
    covariance: Array   # (11, 11)
    undetermined: Array   # (11, 11) the same as if pairs shared no error: what more of them end
    S: Array   # (11, 11) and (11,): sums of the pairs, without a prior
    b: Array
    scatter: float   # variance of the scores over that by S: 1 where residuals are independent
    misfit: float   # the same with what all pairs share
    pairs: int

    @property
    def sigma(self) -> Array:
        """(11,) 1 sigma of each."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


NOTHING_SEEN = Calibration(np.zeros(DEVIATIONS), np.diag(PRIOR_SIGMA**2), np.diag(PRIOR_SIGMA**2),
                           np.zeros((DEVIATIONS, DEVIATIONS)), np.zeros(DEVIATIONS), 1.0, 1.0, 0)


class _Entry(NamedTuple):
    """A pair, and where it was linearised."""

    stamp_ns: int
    evidence: PairEvidence
    in_force: Array   # (11,)
    about: Array   # (11,)
    information: PairInformation


class Recursion:
    """The pairs of the last seconds."""

    def __init__(self) -> None:
        self._pairs: deque[_Entry] = deque(maxlen=MOST_PAIRS)

    def clear(self) -> None:
        """Forget all pairs: they belong to another camera or another time."""
        self._pairs.clear()

    def add(self, stamp_ns: int, evidence: PairEvidence, in_force: Array,
            about: Array) -> PairInformation | None:
        """Take in a pair, in the order of time; a stamp further back starts anew.

        It is linearised about the deviations `about` (11,), which differ from those `in_force`
        once a figure is found off. Some of the older pairs are, too, those first whose
        linearisation is furthest from there: they came before that figure was found, or was
        applied. What the pair says; None where it says nothing.
        """
        if self._pairs and stamp_ns < self._pairs[-1].stamp_ns:
            self.clear()
        information = pair_information(evidence, in_force, about)
        if information is None or not np.isfinite(information.S).all():
            return None
        if self._pairs:
            self._linearise_anew(about)
        self._pairs.append(_Entry(stamp_ns, evidence, in_force, about, information))
        while self._pairs[0].stamp_ns < stamp_ns - WINDOW_NS:
            self._pairs.popleft()
        return information

    def _linearise_anew(self, about: Array) -> None:
        apart = np.linalg.norm(
            (np.array([pair.about for pair in self._pairs]) - about) / PRIOR_SIGMA, axis=1)
        for k in np.argsort(apart, kind='stable')[::-1][:_ANEW]:
            if apart[k] < _NEAR:
                break
            pair = self._pairs[k]
            information = pair_information(pair.evidence, pair.in_force, about)
            if information is not None:
                self._pairs[k] = pair._replace(about=about, information=information)

    def solved(self) -> Calibration:
        """What the pairs show together."""
        n = len(self._pairs)
        if not n:
            return NOTHING_SEEN
        S = np.array([pair.information.S for pair in self._pairs])
        b = np.array([pair.information.b for pair in self._pairs])
        # Scaled by the prior: the deviations have units of their own.
        scale = PRIOR_SIGMA
        hessian = S.sum(axis=0) * np.outer(scale, scale) + np.eye(DEVIATIONS)
        covariance = inverse(hessian) * np.outer(scale, scale)
        c = covariance @ b.sum(axis=0)
        scores = b - S @ c
        sandwich = covariance @ (scores.T @ scores) @ covariance
        ratios = np.maximum(np.diag(sandwich) / np.diag(covariance), 1.0) * (
            (n + _UNSEEN_PAIRS) / n) ** 2
        shared, scatter = 1.0 + _SHARED**2 * n, float(np.median(ratios))
        undetermined = covariance * np.sqrt(np.outer(ratios, ratios))
        return Calibration(c, shared * undetermined, undetermined, S.sum(axis=0), b.sum(axis=0),
                           scatter, shared * scatter, n)
