"""Declared settings: dataclass fields with unit, legal range and description.

Configuration dataclasses are the only places of defaults; node parameters, YAML checks, ``--help``
and the parameter file with comments are derived from their fields.
"""

import dataclasses
from dataclasses import dataclass
import math
from typing import Any

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.validate import legal_range

# Legal values of kinds without limits, in words.
ANY_VALUE = {bool: 'true or false', str: 'text'}


@dataclass(frozen=True, slots=True)
class Declared:
    """Declaration of a setting.

    `live`: a running node may change it; `restarts`: it may, and begins again with the new value.
    """

    description: str
    unit: str = ''
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    length: int | None = None
    live: bool = False
    restarts: bool = False
    kind: type = float

    @property
    def legal(self) -> str:
        """The legal values in words."""
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        if self.kind in ANY_VALUE:
            return ANY_VALUE[self.kind]
        text = legal_range(self.low, self.high, self.unit)
        return f'{self.length} values, each {text}' if self.length is not None else text

    def check(self, name: str, value: Any) -> None:
        """Raise InputError unless `value` is legal."""
        if isinstance(value, str | bool):
            legal = not self.choices or value in self.choices
        else:
            values = list(value) if isinstance(value, tuple | list) else [value]
            legal = self.length is None or len(values) == self.length
            legal = legal and all(
                isinstance(v, int | float) and math.isfinite(v) and self.low <= v <= self.high
                for v in values)
        if not legal:
            raise InputError(f'{name} must be {self.legal}, got {value!r}')


def setting(default: Any, description: str, unit: str = '', *, kind: type | None = None,
            **legal: Any) -> Any:
    """Field of a configuration dataclass, with its declaration as metadata.

    `legal`: other fields of `Declared`. A tuple setting declares its `length`, and a setting
    without a default (None) its `kind`.
    """
    legal.setdefault('live', legal.get('restarts', False))
    declared = Declared(description, unit, kind=type(default) if kind is None else kind, **legal)
    return dataclasses.field(default=default, metadata={'declared': declared})


def declared(field: dataclasses.Field[Any]) -> Declared:
    """Declaration of a field that `setting` made."""
    return field.metadata['declared']


@dataclass(frozen=True, slots=True)
class Settings:
    """Base of configuration dataclasses: checks every declared field."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if 'declared' not in field.metadata:
                continue
            value, kind = getattr(self, field.name), declared(field).kind
            if value is None and field.default is None:
                continue
            if kind is tuple and isinstance(value, list | tuple):
                value = tuple(float(v) if type(v) is int else v for v in value)
            elif kind is float and type(value) is int:
                value = float(value)
            object.__setattr__(self, field.name, value)
            if not isinstance(value, float) if kind is float else type(value) is not kind:
                raise InputError(f'{field.name} must be of type {kind.__name__}, got {value!r}')
            declared(field).check(field.name, value)
