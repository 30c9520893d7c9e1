"""Parameter files of the node, in the format of ROS: read, and written with comments.

A file has ``/**`` or the node's name, below it ``ros__parameters``, and below that the names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
import textwrap
from typing import Any

import yaml

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError, MissingInputError

_NODE = 'relpose_node'
# Parameters of every ROS node, which mean nothing offline.
_ROS_OWN = ('use_sim_time', 'start_type_description_service')
# Bytes of the largest file that is read; that of all parameters has 10,000.
_MAX_BYTES = 1 << 20
# Columns of a comment.
_WIDTH = 95


@dataclass(frozen=True, slots=True)
class SourcedValue:
    """Value of a parameter and where it comes from."""

    name: str
    value: float | str | tuple[float, ...]
    source: str


def read_parameters(path: Path | str | None, assignments: Sequence[str] = (),
                    node: str = _NODE) -> Parameters:
    """Parameters at their defaults, then from a file, then from ``NAME=VALUE`` assignments.

    The file is as ``ros2 run --params-file`` takes it for `node`, the values of assignments are in
    YAML, such as ``gyro_bias=[0.01, 0, 0]``.
    """
    parameters = Parameters()
    if path is not None:
        values = _values(Path(path), node)
        try:
            parameters = parameters.updated(_converted(values))
        except InputError as error:
            raise InputError(f'{path}: {error}') from error
    given = {}
    for assignment in assignments:
        name, separator, text = assignment.partition('=')
        if not separator or not name:
            raise InputError(f'--set takes NAME=VALUE, got {assignment!r}')
        try:
            given[name.strip()] = yaml.safe_load(text)
        except (yaml.YAMLError, RecursionError):
            raise InputError(f'--set {name}: the value {text!r} is no YAML') from None
    return parameters.updated(_converted(given))


def parameter_text(title: str, values: Sequence[SourcedValue]) -> str:
    """Text of a parameter file: each value below its source, `title` at the head."""
    lines = [*comment(title), '/**:', '  ros__parameters:']
    for item in values:
        lines += [*comment(item.source, '    '), f'    {item.name}: {yaml_text(item.value)}']
    return '\n'.join(lines) + '\n'


def write_parameters(path: Path, title: str, values: Sequence[SourcedValue]) -> None:
    """Write `parameter_text` to a new file."""
    try:
        with path.open('x', encoding='utf-8') as file:
            file.write(parameter_text(title, values))
    except FileExistsError:
        raise InputError(f'{path} exists already: remove it or choose another path') from None
    except OSError as error:
        raise InputError(f'cannot write {path}: {error.strerror}') from error


def comment(text: str, indent: str = '') -> list[str]:
    """Lines of a comment; none for an empty text."""
    return textwrap.wrap(text, _WIDTH, initial_indent=f'{indent}# ',
                         subsequent_indent=f'{indent}# ', break_long_words=False,
                         break_on_hyphens=False)


def yaml_text(value: Any) -> str:
    """A bool, number, text without quotes in it, or a tuple of those, in YAML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"'{value}'"
    if isinstance(value, tuple):
        return f'[{", ".join(map(yaml_text, value))}]'
    text = repr(value)
    # YAML 1.1 takes 1e-05 for a text: a float needs its point.
    return text.replace('e', '.0e') if 'e' in text and '.' not in text else text


def _values(path: Path, wanted: str) -> dict[str, Any]:
    """Flat values of a parameter file that are meant for the node `wanted`."""
    if not path.is_file():
        raise MissingInputError(f'there is no parameter file {path}')
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(f'{path} is no parameter file: it has more than {_MAX_BYTES} bytes')
    try:
        text = path.read_text(encoding='utf-8')
        # Aliases of aliases, printed in an error, have no end; ROS does not know them either.
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text)):
            raise InputError(f'{path} has YAML aliases, which parameter files must not have')
        document = yaml.safe_load(text)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f'{path} is no YAML file: {error}') from error
    if not isinstance(document, dict):
        raise InputError(f'{path} is no ROS parameter file: it must begin with "/**:" and '
                         '"ros__parameters:"')
    values: dict[str, Any] = {}
    for node in document:
        if node in ('/**', wanted) or str(node).endswith(f'/{wanted}'):
            section = document[node]
            inner = section.get('ros__parameters') if isinstance(section, dict) else None
            if not isinstance(inner, dict):
                raise InputError(f'{path}: below {node!r} there must be "ros__parameters:" with '
                                 'names and values')
            values |= {str(name): value for name, value in inner.items()
                       if name not in _ROS_OWN and not str(name).startswith('qos_overrides')}
    if not values:
        raise InputError(f'{path} has no parameters for {wanted}: they must stand below "/**:" '
                         f'or "{wanted}:" and "ros__parameters:"')
    return values


def _converted(values: Mapping[str, Any]) -> dict[str, Any]:
    """Lists to tuples, and 1e-5 to a number as in ROS (to PyYAML it is a text)."""
    kinds = {name: declared.kind for name, _, declared in Parameters.declarations()}
    return {name: _convert(value, kinds.get(name)) for name, value in values.items()}


def _convert(value: Any, kind: type | None) -> Any:
    if isinstance(value, list):
        return tuple(_convert(item, kind) for item in value)
    if isinstance(value, str) and kind in (float, tuple):
        try:
            return float(value)
        except ValueError:
            return value
    return value
