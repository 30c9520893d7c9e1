"""Findings of a check: verdict, sentence, remedy and figures; as text and as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import Enum
import textwrap
from typing import Any, NamedTuple


class Verdict(str, Enum):
    """`FAILURE` is what would make the estimation fail or its results wrong."""

    OK = 'ok'
    UNKNOWN = 'unknown'   # not measured, or not told by this recording
    WARNING = 'warning'
    FAILURE = 'failure'


# Short, for the tables of cases.
UNKNOWN, WARNING, FAILURE = Verdict.UNKNOWN, Verdict.WARNING, Verdict.FAILURE


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report."""

    name: str            # what was looked at
    verdict: Verdict
    text: str            # what was found, with units
    remedy: str = ''     # what to do about it; empty where nothing need be done
    # The same in numbers, SI units unless the name says otherwise.
    figures: Mapping[str, Any] = field(default_factory=dict)


class Case(NamedTuple):
    """Verdict and remedy where a condition holds; `more` follows the text of the finding."""

    holds: bool
    verdict: Verdict
    remedy: str
    more: str = ''


def judged(name: str, text: str, figures: Mapping[str, Any], *cases: Case) -> Finding:
    """Finding by the first of the `cases` that holds; OK where none does."""
    for case in cases:
        if case.holds:
            return Finding(name, case.verdict, text + case.more, case.remedy, figures)
    return Finding(name, Verdict.OK, text, figures=figures)


@dataclass(frozen=True, slots=True)
class CheckReport:
    """All findings of one bag."""

    bag: str
    findings: tuple[Finding, ...]

    @property
    def failed(self) -> bool:
        """Whether something would make the estimation fail."""
        return any(finding.verdict is Verdict.FAILURE for finding in self.findings)

    def lines(self, width: int = 100) -> list[str]:
        """The report as text of at most `width` columns."""
        names = max(len(finding.name) for finding in self.findings)
        lines = []
        for finding in self.findings:
            head = f'{finding.verdict.value:<8} {finding.name:<{names}}  '
            text = finding.text + (f' -> {finding.remedy}' if finding.remedy else '')
            lines += textwrap.wrap(text, width, initial_indent=head,
                                   subsequent_indent=' ' * len(head), break_on_hyphens=False)
        verdicts = [finding.verdict for finding in self.findings]
        counts = [f'{verdicts.count(verdict)} {verdict.value}' for verdict in Verdict]
        lines.append(f'{self.bag}: {", ".join(counts)}')
        return lines

    def to_mapping(self) -> dict[str, Any]:
        """The report as data for JSON."""
        return {'bag': self.bag, 'failed': self.failed,
                'findings': [asdict(finding) for finding in self.findings]}
