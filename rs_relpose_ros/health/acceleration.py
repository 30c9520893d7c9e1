"""Whether the accelerometer agrees with the images, by the pairs of the last seconds."""

from __future__ import annotations

from collections import deque

from rs_relpose_ros.estimator.inertial_evidence import InertialEvidence
from rs_relpose_ros.health.findings import Finding, HealthState
from rs_relpose_ros.health.recursion import MOST_PAIRS, WINDOW_NS

# Most that one pair says: one whose matches mislead it must not decide alone.
_LOUDEST = 3.0
# Logarithm of a Bayes factor that is certain, errors of neighbours being alike.
_CERTAIN = 10.0


class AccelerationSums:
    """Log Bayes factors of the measured acceleration and of its opposite, added up."""

    def __init__(self) -> None:
        self._pairs: deque[tuple[int, float, float]] = deque(maxlen=MOST_PAIRS)

    def clear(self) -> None:
        """Forget all pairs: they belong to other figures or another time."""
        self._pairs.clear()

    def add(self, stamp_ns: int, evidence: InertialEvidence) -> None:
        """Take in a pair, in the order of time; a stamp further back starts anew."""
        if self._pairs and stamp_ns < self._pairs[-1][0]:
            self.clear()
        told, opposite = (max(-_LOUDEST, min(value, _LOUDEST)) for value in evidence)
        self._pairs.append((stamp_ns, told, opposite))
        while self._pairs[0][0] < stamp_ns - WINDOW_NS:
            self._pairs.popleft()

    def believes(self, evidence: InertialEvidence | None) -> bool:
        """Whether a pair of such evidence is to use the accelerometer; None: not known yet."""
        return not self.contradicts and (evidence is None or evidence.told > -_LOUDEST)

    @property
    def contradicts(self) -> bool:
        """Whether no acceleration at all, or the opposite one, explains the images better."""
        told, opposite = self._sums()
        return max(opposite, 0.0) - told > _CERTAIN

    def finding(self) -> Finding | None:
        """On the axes of the accelerometer; None where the pairs do not tell."""
        told, opposite = self._sums()
        if self.contradicts:
            remedy = ('it has the other sign: at rest a specific force of +9.8 m/s^2 points up'
                      if opposite > _CERTAIN else 'its axes are not those of the gyro, or '
                      'another IMU sent it: correct the driver')
            return Finding('accel_axes', None, None, None, '', True, HealthState.SUSPECT,
                           f'images and accelerometer contradict each other (log-likelihood '
                           f'{told:+.0f}); it is not used until they agree; {remedy}')
        if told > _CERTAIN:
            return Finding('accel_axes', None, None, None, '', True, HealthState.OK,
                           f'images show the acceleration that is measured (log-likelihood '
                           f'{told:+.0f})')
        return None

    def _sums(self) -> tuple[float, float]:
        return (sum(told for _, told, _ in self._pairs),
                sum(opposite for _, _, opposite in self._pairs))
