"""The report of `check`: its lines, which of them follows from which, and the verdict on a bag."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import textwrap
from typing import Any, NamedTuple

from rs_relpose_ros.calibration import findings_text
from rs_relpose_ros.calibration.findings import Code, Evidence, Finding, FindingState, Why
from rs_relpose_ros.calibration.findings_text import Text

# Short names of the states, which each line of a report has.
OK = FindingState.OK
UNKNOWN = FindingState.UNKNOWN  # not observable, or not measured
SUSPECT = FindingState.SUSPECT  # a warning
WRONG = FindingState.WRONG  # a failure


class Line(NamedTuple):
    """A finding in the report, with its text."""

    finding: Finding
    message: str
    fix: str = ''

    @property
    def code(self) -> Code:
        """What the line is about."""
        return self.finding.code

    @property
    def state(self) -> FindingState:
        """State of the finding."""
        return self.finding.state

    @property
    def text(self) -> str:
        """What was found, and what to do."""
        return f'{self.message} -> {self.fix}' if self.fix else self.message

    def as_json(self) -> dict[str, Any]:
        """The line in `check --json`."""
        finding = self.finding
        if finding.code.is_property:
            measured = dict(finding.evidence.measured)
        else:
            measured = findings_text.earlier_keys(finding, Text(self.message, self.fix))
        return {
            'name': finding.code.value,
            'verdict': finding.state.verdict,
            'text': self.message,
            'remedy': self.fix,
            'figures': measured,
            **findings_text.new_keys(finding),
        }


def property_line(
    code: Code, state: FindingState, message: str, fix: str, measured: Mapping[str, Any]
) -> Line:
    """Line on a property of the recording."""
    why = {OK: Why.CONSISTENT, UNKNOWN: Why.NOT_MEASURED}.get(state, Why.OFF)
    finding = Finding(code, state, why, evidence=Evidence(measured=measured))
    return Line(finding, message, fix)


class Case(NamedTuple):
    """State and fix if a condition holds; `more` follows the message of the line."""

    holds: bool
    state: FindingState
    fix: str = ''
    more: str = ''


def by_case(code: Code, message: str, measured: Mapping[str, Any], *cases: Case) -> Line:
    """Line by the first of the `cases` that holds; OK if none does."""
    for case in cases:
        if case.holds:
            return property_line(code, case.state, message + case.more, case.fix, measured)
    return property_line(code, OK, message, '', measured)


# Findings that need images and gyro together, which no fault of one of them spares.
_JOINT = frozenset(
    (
        Code.PAIRS,
        Code.TEXTURE,
        Code.ROLLING_SHUTTER,
        *(code for code in Code if not code.is_property),
    )
)
# The same with the clocks, which both streams have to share.
_JOINT_AND_CLOCKS = _JOINT | {Code.CLOCKS}
# What follows from a failure: its code, and those of the findings that it spoils. The first row
# that applies counts, and a failure follows from those above it alone.
_CONSEQUENCES: tuple[tuple[Code, frozenset[Code]], ...] = (
    (Code.TOPICS, _JOINT_AND_CLOCKS),
    (Code.IMAGES, _JOINT_AND_CLOCKS | {Code.IMAGE_RATE, Code.IMAGE_STAMPS, Code.CALIBRATION}),
    (Code.GYRO, _JOINT_AND_CLOCKS),
    (Code.IMAGE_RATE, _JOINT_AND_CLOCKS | {Code.IMAGE_STAMPS}),
    (Code.IMAGE_STAMPS, _JOINT_AND_CLOCKS),
    (Code.IMU_RATE, _JOINT_AND_CLOCKS | {Code.IMU_STAMPS}),
    (Code.IMU_STAMPS, _JOINT_AND_CLOCKS),
    (Code.CLOCKS, _JOINT),
    (Code.CALIBRATION, _JOINT),
    (Code.GYRO_UNIT, _JOINT),
    (Code.PAIRS, _JOINT),
)


def with_parents(lines: Sequence[Line]) -> tuple[Line, ...]:
    """Return the lines in which each that follows from a failure has it as its parent."""
    failed = {line.code for line in lines if line.state is WRONG}
    return tuple(_with_parent(line, failed) for line in lines)


def _with_parent(line: Line, failed: set[Code]) -> Line:
    if line.state is OK or line.finding.parent is not None:
        return line
    for cause, spoiled in _CONSEQUENCES:
        if cause is line.code:
            break
        if cause in failed and line.code in spoiled:
            return line._replace(finding=replace(line.finding, parent=cause))
    return line


@dataclass(frozen=True, slots=True)
class CheckReport:
    """All findings of one bag."""

    bag: str
    findings: tuple[Line, ...]

    @property
    def failed(self) -> bool:
        """Whether something would make the estimation fail."""
        return any(finding.state is WRONG for finding in self.findings)

    @property
    def verdict(self) -> str:
        """Whether the bag can be used, and what to do, in one line."""
        cause = next(_causes(self.findings, WRONG), None)
        if cause is not None:
            as_configured = '' if cause.code.is_property else ' as configured'
            return f'{self.bag} cannot be used{as_configured}: {cause.text}'
        doubts = list(_causes(self.findings, SUSPECT))
        if not doubts:
            return f'{self.bag} can be used'
        number = f'{len(doubts)} warnings, the first: ' if len(doubts) > 1 else ''
        return f'{self.bag} can be used; {number}{doubts[0].text}'

    def lines(self, width: int) -> list[str]:
        """The report as text of at most `width` columns, but for the first and the last line.

        What follows from a finding is indented below it.
        """
        longest = max(len(finding.code.value) for finding in self.findings)
        names = longest + len(_INDENT)
        lines = [self.verdict]
        for finding, indent in _in_order(self.findings):
            lines += _wrapped(finding, indent, names, width)
        counts = Counter(finding.state for finding in self.findings)
        numbers = ', '.join(f'{counts[state]} {state.verdict}' for state in FindingState)
        lines.append(f'{self.bag}: {numbers}')
        return lines

    def to_mapping(self) -> dict[str, Any]:
        """The report as data for JSON."""
        return {
            'bag': self.bag,
            'failed': self.failed,
            'verdict': self.verdict,
            'findings': [finding.as_json() for finding in self.findings],
        }


# Before the name of a finding that follows from the one above.
_INDENT = '  '


def _causes(lines: Iterable[Line], state: FindingState) -> Iterator[Line]:
    """Lines in a state that follow from no other."""
    return (line for line in lines if line.state is state and line.finding.parent is None)


def _in_order(lines: Sequence[Line]) -> Iterator[tuple[Line, str]]:
    """Return each line with its indentation, below the one that it follows from."""
    codes = {line.code for line in lines}
    for line in lines:
        if line.finding.parent not in codes:
            yield from _with_consequences(line, lines, '')


def _with_consequences(
    line: Line, lines: Sequence[Line], indent: str
) -> Iterator[tuple[Line, str]]:
    yield line, indent
    for other in lines:
        if other.finding.parent is line.code and other is not line:
            yield from _with_consequences(other, lines, indent or _INDENT)


def _wrapped(line: Line, indent: str, names: int, width: int) -> list[str]:
    """The text of a line; `names`: columns of the names."""
    head = f'{line.state.verdict:<8} {indent + line.code.value:<{names}}  '
    return textwrap.wrap(
        line.text,
        width,
        initial_indent=head,
        subsequent_indent=' ' * len(head),
        break_on_hyphens=False,
    )
