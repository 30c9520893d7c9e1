"""Declared settings: a dataclass field that carries its unit, its legal range and its meaning.

Configuration dataclasses are the only places of defaults; node parameters, YAML checks, ``--help``
and the parameter table of the documentation are derived from their fields.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import math
from typing import Any

from rs_relpose_ros.errors import InputError

# Legal values of kinds that have no limits, in words.
ANY_VALUE = {bool: 'true or false', str: 'text'}


@dataclass(frozen=True, slots=True)
class Declared:
    """What a setting means: `description`, `unit`, and what is legal."""

    description: str
    unit: str = ''
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    length: int | None = None
    live: bool = False
    kind: type = float

    @property
    def legal(self) -> str:
        """The legal values in words."""
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        if self.kind in ANY_VALUE:
            return ANY_VALUE[self.kind]
        text = 'finite'
        if self.low > -math.inf or self.high < math.inf:
            text = f'in [{self.low:g}, {self.high:g}]'
        if self.unit:
            text += f' {self.unit}'
        return f'{self.length} values, each {text}' if self.length is not None else text

    def check(self, name: str, value: Any) -> None:
        """Raise InputError unless `value` is legal; says the name, what is legal and what came."""
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

    `legal`: other fields of `Declared`. `live`: whether a running node may change it. A tuple
    setting declares its `length`, and one without a default (None), which the user must give, its
    `kind`.
    """
    declared = Declared(description, unit, kind=type(default) if kind is None else kind, **legal)
    return dataclasses.field(default=default, metadata={'declared': declared})


def declared(field: dataclasses.Field[Any]) -> Declared:
    """Declaration of a field that `setting` made."""
    return field.metadata['declared']


def check_settings(config: Any) -> None:
    """Check every declared field of a configuration dataclass; call it in ``__post_init__``."""
    for field in dataclasses.fields(config):
        if 'declared' not in field.metadata:
            continue
        value, kind = getattr(config, field.name), declared(field).kind
        if value is None and field.default is None:
            continue
        if kind is tuple and isinstance(value, list | tuple):
            value = tuple(float(v) if type(v) is int else v for v in value)
        elif kind is float and type(value) is int:
            value = float(value)
        object.__setattr__(config, field.name, value)
        if not isinstance(value, float) if kind is float else type(value) is not kind:
            raise InputError(f'{field.name} must be of type {kind.__name__}, got {value!r}')
        declared(field).check(field.name, value)
