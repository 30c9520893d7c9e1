"""Findings of the consistency monitor and of `check`, and the table of the quantities they cover.

The vector ``c`` (11,) of small deviations, true minus configured, has these parts:

- `AXES` [rad]: ``R_true = Exp(c) R_cam_imu``, in the camera frame;
- `OFFSET` [s]: of ``time_offset``, of the stamped row;
- `READOUT` [s]: of the signed readout time, negative if row 0 is read last; the stamped row
  keeps its time;
- `BIAS` [rad/s]: of the gyro, in the IMU frame;
- `SCALE`: of the gyro, ``w_true = (1 + c) w``;
- `FOCAL`: of the inverse focal length, ``f_true = f / (1 + c)``;
- `DISTORTION`: of the first coefficient of the lens.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

AXES = slice(0, 3)
OFFSET = 3
READOUT = 4
BIAS = slice(5, 8)
SCALE = 8
FOCAL = 9
DISTORTION = 10
DEVIATIONS = 11

# Largest deviations [s] that tracking applies.
LARGEST_OFFSET, LARGEST_READOUT = 0.05, 0.01


class FindingState(str, Enum):
    """Consistency of a quantity with the data; from good to bad."""

    OK = 'ok'
    UNKNOWN = 'unknown'  # not observable, or not measured
    SUSPECT = 'suspect'  # inconsistent for certain, by enough to matter
    WRONG = 'wrong'  # poses are outside of their covariance, or the estimation fails

    @property
    def verdict(self) -> str:
        """The state as `check` names it."""
        return {'suspect': 'warning', 'wrong': 'failure'}.get(self.value, self.value)


@dataclass(frozen=True, slots=True)
class Finding:
    """State of one quantity: a configured parameter, or a property of a recording."""

    quantity: str  # e.g. 'time_offset' (`QUANTITIES`) or 'image rate'
    state: FindingState
    message: str  # the values, with units
    fix: str = ''  # suggested; empty if nothing needs to be done
    configured: float | None = None  # value of a parameter, as it is applied
    estimated: float | None = None  # None if it is not observable
    sigma: float | None = None  # of `estimated`
    unit: str = ''
    observable: bool = False  # in the motion of the last seconds
    # Numbers of a property of a recording, SI units unless the key names another one.
    measured: Mapping[str, Any] | None = None

    @property
    def description(self) -> str:
        """Message and suggested fix."""
        return self.message + (f': {self.fix}' if self.fix else '')

    @property
    def text(self) -> str:
        """Quantity, state and description, as a line of a log."""
        return f'{self.quantity} is {self.state.value}: {self.description}'

    def as_json(self) -> dict[str, Any]:
        """The finding in summary.json."""
        return {
            'figure': self.quantity,
            'told': self.configured,
            'seen': self.estimated,
            'sigma': self.sigma,
            'unit': self.unit,
            'observable': self.observable,
            'state': self.state.value,
            'sentence': self.description,
        }

    def as_check_json(self) -> dict[str, Any]:
        """The finding in `check --json`."""
        return {
            'name': self.quantity,
            'verdict': self.state.verdict,
            'text': self.message,
            'remedy': self.fix,
            'figures': self.as_json() if self.measured is None else dict(self.measured),
        }


@dataclass(frozen=True, slots=True)
class Assessment:
    """All findings after a pair."""

    findings: tuple[Finding, ...]

    @property
    def state(self) -> FindingState:
        """State of the worst finding."""
        return max(
            (finding.state for finding in self.findings),
            key=tuple(FindingState).index,
            default=FindingState.UNKNOWN,
        )

    @property
    def faults(self) -> tuple[Finding, ...]:
        """Findings that are suspect or wrong, the worst first."""
        return tuple(
            finding
            for state in (FindingState.WRONG, FindingState.SUSPECT)
            for finding in self.findings
            if finding.state is state
        )

    @property
    def is_gross(self) -> bool:
        """Whether the worst finding is a gross error (axes, unit, geometry), without a sigma."""
        return self.state is FindingState.WRONG and self.faults[0].sigma is None

    @property
    def text(self) -> str:
        """Quantity, state and description of each finding, in one line."""
        return '; '.join(
            f'{finding.quantity} {finding.state.value}: {finding.description}'
            for finding in self.findings
        )

    def as_json(self) -> dict[str, Any]:
        """The assessment in summary.json."""
        return {
            'state': self.state.value,
            'findings': [finding.as_json() for finding in self.findings],
        }


NOT_EVALUATED = Assessment(())


def worst_of(before: Assessment, now: Assessment) -> Assessment:
    """The worse or later finding of each quantity; without traces of a gross error found later."""
    traces = now.is_gross and not before.is_gross
    found = {} if traces else {finding.quantity: finding for finding in before.findings}
    # What was observable once is known.
    order = (FindingState.UNKNOWN, FindingState.OK, FindingState.SUSPECT, FindingState.WRONG)
    for one in now.findings:
        if order.index(found.setdefault(one.quantity, one).state) <= order.index(one.state):
            found[one.quantity] = one
    return Assessment(tuple(found.values()))


def rounded(values: ArrayLike, digits: int = 5) -> list[float]:
    """Values (K,) for a message; never -0.0."""
    return [round(float(value), digits) + 0.0 for value in np.atleast_1d(values)]


class Quantity(NamedTuple):
    """A parameter of camera or IMU that images and gyro determine, and how it is reported."""

    name: str
    part: slice  # of the deviations
    observable: float  # largest sigma of an observable deviation
    unit: str  # of a finding; deviations are in rad instead of deg, relative instead of px
    shown: str  # unit of messages, `factor` times smaller
    factor: float
    digits: int
    text: str  # {}: the estimated and the active value
    fix: str  # {}: the value to set
    tracking: str = ''  # parameter that has it tracked
    reach: float = 0.0  # largest deviation that tracking applies

    def unknown(self, reason: str) -> Finding:
        """A finding without values."""
        return Finding(self.name, FindingState.UNKNOWN, reason, unit=self.unit)

    def number(self, values: ArrayLike) -> str:
        """A value, or a list of those of a vector, in the unit of messages but without it."""
        shown = self.factor * np.atleast_1d(values)
        return (
            f'{shown[0]:z.{self.digits}f}' if len(shown) == 1 else str(rounded(shown, self.digits))
        )

    def with_sigma(self, values: ArrayLike, sigma: float) -> str:
        """A value with its sigma, in the unit of messages."""
        return f'{self.number(values)} +- {self.number(sigma)} {self.shown}'.rstrip()

    def compared(self, estimated: ArrayLike, sigma: float, active: ArrayLike) -> str:
        """Estimated and active value, in words."""
        return self.text.format(
            self.with_sigma(estimated, sigma), f'{self.number(active)} {self.shown}'.rstrip()
        )

    def deviation(self, finding: Finding) -> float:
        """Size of the difference between the values of a finding, in units of a deviation."""
        assert finding.estimated is not None and finding.configured is not None
        apart = abs(finding.estimated - finding.configured)
        if self.unit == 'px':
            return apart / finding.configured
        return math.radians(apart) if self.unit == 'deg' else apart


_COMPARED = 'estimated {}, active {}'
QUANTITIES = (
    Quantity(
        'axes',
        AXES,
        math.radians(1.0),
        'deg',
        'deg',
        1.0,
        2,
        'IMU rotated by {} relative to quat_cam_imu_xyzw',
        'set quat_cam_imu_xyzw: {}',
    ),
    Quantity(
        'time_offset',
        slice(OFFSET, OFFSET + 1),
        4e-3,
        's',
        'ms',
        1e3,
        2,
        _COMPARED,
        'set time_offset: {:z.4f}',
        'track_time_offset',
        LARGEST_OFFSET,
    ),
    Quantity(
        'readout_time',
        slice(READOUT, READOUT + 1),
        5e-3,
        's',
        'ms',
        1e3,
        2,
        _COMPARED,
        'set readout_time: {:.4f}',
        'track_readout_time',
        LARGEST_READOUT,
    ),
    Quantity(
        'gyro_bias',
        BIAS,
        0.01,
        'rad/s',
        'rad/s',
        1.0,
        5,
        _COMPARED,
        'set gyro_bias: {}, and keep the camera at rest at the start',
    ),
    Quantity(
        'gyro_scale',
        slice(SCALE, SCALE + 1),
        0.03,
        '',
        '',
        1.0,
        3,
        'factor of the gyro rates: ' + _COMPARED,
        'calibrate the gyro, or correct its driver',
    ),
    Quantity(
        'focal_length',
        slice(FOCAL, FOCAL + 1),
        0.04,
        'px',
        'px',
        1.0,
        1,
        _COMPARED,
        'calibrate the camera at this resolution and focus',
    ),
    Quantity(
        'distortion',
        slice(DISTORTION, DISTORTION + 1),
        0.05,
        '',
        '',
        1.0,
        3,
        'first coefficient: ' + _COMPARED,
        'calibrate the lens',
    ),
)
BY_NAME = {quantity.name: quantity for quantity in QUANTITIES}
