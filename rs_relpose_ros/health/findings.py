"""What is said of a figure that the package was told: the state, told and seen value, a remedy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import Enum
from typing import Any


class HealthState(str, Enum):
    """How far a figure, or all of them, can be believed; from good to bad."""

    OK = 'ok'
    UNKNOWN = 'unknown'   # this motion does not tell
    SUSPECT = 'suspect'   # off for certain, by enough to matter
    WRONG = 'wrong'   # poses are outside of their covariance


_ORDER = tuple(HealthState)
# Over a run a figure that was seen once is known.
_BLAME = (HealthState.UNKNOWN, HealthState.OK, HealthState.SUSPECT, HealthState.WRONG)


@dataclass(frozen=True, slots=True)
class Finding:
    """One figure: what was told, what images and IMU show."""

    figure: str   # e.g. 'time_offset'; the names are those of `judge.FIGURES`
    told: float | None
    seen: float | None   # None where it is not observable
    sigma: float | None   # of `seen`
    unit: str
    observable: bool   # in the motion of the last seconds
    state: HealthState
    sentence: str   # told, seen, and what to do; for a person

    @property
    def text(self) -> str:
        """Figure, state and sentence, as a line of a log."""
        return f'{self.figure} is {self.state.value}: {self.sentence}'

    def as_json(self) -> dict[str, Any]:
        """For summary.json and `check --json`."""
        return asdict(self) | {'state': self.state.value}


@dataclass(frozen=True, slots=True)
class Health:
    """All findings after a pair."""

    findings: tuple[Finding, ...]

    @property
    def state(self) -> HealthState:
        """That of the worst finding."""
        return max((finding.state for finding in self.findings), key=_ORDER.index,
                   default=HealthState.UNKNOWN)

    @property
    def faults(self) -> tuple[Finding, ...]:
        """Findings that are suspect or wrong, the worst first."""
        return tuple(finding for state in (HealthState.WRONG, HealthState.SUSPECT)
                     for finding in self.findings if finding.state is state)

    @property
    def is_gross(self) -> bool:
        """Whether axes, unit or geometry are wrong altogether: such a fault has no sigma."""
        return bool(self.faults) and self.faults[0].state is HealthState.WRONG \
            and self.faults[0].sigma is None

    @property
    def text(self) -> str:
        """Figure, state and sentence of each finding, in one line."""
        return '; '.join(f'{finding.figure} {finding.state.value}: {finding.sentence}'
                         for finding in self.findings)

    def as_json(self) -> Mapping[str, Any]:
        """As summary.json has it."""
        return {'state': self.state.value,
                'findings': [finding.as_json() for finding in self.findings]}


NOT_JUDGED = Health(())


def worst_of(before: Health, now: Health) -> Health:
    """Of each figure the worse finding, the later one where both are alike: for a whole run.

    Small deviations that were found before a gross error are traces of it, and left out.
    """
    traces = now.is_gross and not before.is_gross
    found = {} if traces else {finding.figure: finding for finding in before.findings}
    for finding in now.findings:
        known = found.get(finding.figure)
        if known is None or _BLAME.index(finding.state) >= _BLAME.index(known.state):
            found[finding.figure] = finding
    return Health(tuple(found.values()))
