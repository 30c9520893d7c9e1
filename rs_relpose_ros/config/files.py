"""Parameter files in the format of ROS: read, and written with comments.

``/**`` or a node's name, below it ``ros__parameters``, and below that the parameters.

    python -m rs_relpose_ros.config.files config/relpose.yaml

writes all parameters at their defaults, with descriptions.
"""

from collections.abc import Mapping, Sequence
import contextlib
from dataclasses import dataclass
import logging
import math
from pathlib import Path
import sys
import textwrap
from typing import Any

import yaml

from rs_relpose_ros.config.calibration_files import (
    calibration_of,
    plain_yaml,
    ToolCalibration,
    yaml_problem,
)
from rs_relpose_ros.config.settings import ANY_VALUE, Parameters
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.output_files import written

_logger = logging.getLogger(__name__)

# Section of a parameter file that is read by default. [derived: name of the node]
_NODE = 'relpose_node'
# Parameters that every ROS node has, without effect offline. [derived: rclpy of Jazzy]
_ROS_OWN = ('use_sim_time', 'start_type_description_service')
# Sigma of each parameter of a calibration. A file that has one of them is a calibration file.
# [derived: the names of the parameters]
_SIGMAS = {
    'readout_time': 'readout_time_sigma',
    'time_offset': 'time_offset_sigma',
    'time_offset_per_interval': 'time_offset_per_interval_sigma',
    'quat_cam_imu_xyzw': 'axes_sigma',
    'camera_matrix': 'focal_length_sigma',
}
# Largest file that is read [bytes]. A larger one is no parameter file, and would fill the memory.
# [chosen: a file of all parameters has 10,000; any value in 1e5..1e8 would do]
_MAX_BYTES = 1 << 20
# Longest comment line of a generated file [characters]. [chosen: any value in 70..120 would do]
_COMMENT_WIDTH = 95


@dataclass(frozen=True, slots=True)
class SourcedValue:
    """Value of a parameter and its source."""

    name: str
    value: float | str | tuple[float, ...]
    source: str


def read_parameters(
    path: Path | str | None, assignments: Sequence[str] = (), node: str = _NODE
) -> Parameters:
    """Parameters at their defaults, then from a file, then from ``NAME=VALUE`` assignments.

    The file is one for ``ros2 run --params-file`` of `node`, or a calibration of another tool
    (`calibration_files`); the values of assignments are YAML,
    such as ``gyro_bias=[0.01, 0, 0]``.

    >>> read_parameters(None, ['readout_time=0.03', 'solver=angular_5pt']).sensor.readout_time
    0.03
    """
    parameters = Parameters()
    if path is not None:
        values = file_values(Path(path), node)
        try:
            if any(values.get(sigma) for sigma in _SIGMAS.values()):
                for name, sigma in _SIGMAS.items():
                    if name in values and sigma not in values:
                        raise InputError(
                            f'{name} is given without {sigma}: a calibration file '
                            'has each parameter with its sigma, 0 if that is not '
                            'known'
                        )
            parameters = parameters.updated(values)
        except InputError as error:
            raise InputError(f'{path}: {error}') from error
    given = {}
    for assignment in assignments:
        name, separator, text = assignment.partition('=')
        if not separator or not name:
            raise InputError(f'--set must be NAME=VALUE, got {assignment!r}')
        try:
            given[name.strip()] = yaml.safe_load(text)
        except (yaml.YAMLError, RecursionError):
            raise InputError(f'--set {name}: the value {text!r} is not valid YAML') from None
    return parameters.updated(_converted(given))


def parameter_text(title: str, values: Sequence[SourcedValue]) -> str:
    """Text of a parameter file with a title; each value has its source as a comment."""
    lines = [*comment(title), '/**:', '  ros__parameters:']
    for item in values:
        lines += [*comment(item.source, '    '), f'    {item.name}: {yaml_text(item.value)}']
    return '\n'.join(lines) + '\n'


def write_parameters(path: Path, title: str, values: Sequence[SourcedValue]) -> None:
    """Write `parameter_text` to a file."""
    with written(path) as file:
        file.write(parameter_text(title, values))


def comment(text: str, indent: str = '') -> list[str]:
    """Lines of a comment; none for an empty text."""
    return textwrap.wrap(
        text,
        _COMMENT_WIDTH,
        initial_indent=f'{indent}# ',
        subsequent_indent=f'{indent}# ',
        break_long_words=False,
        break_on_hyphens=False,
    )


def yaml_text(value: Any) -> str:
    """YAML of a bool, a number, a text, or a tuple of those, in one line."""
    plain = list(value) if isinstance(value, tuple) else value
    return yaml.safe_dump([plain], default_flow_style=True, width=math.inf)[1:-2]


def file_values(path: Path, wanted: str = _NODE) -> dict[str, Any]:
    """Return flat values of a parameter file for the node `wanted`, or of a calibration."""
    return text_values(_text_of(path), str(path), wanted)


def _text_of(path: Path) -> str:
    if not path.is_file():
        raise MissingInputError(f'the parameter file {path} does not exist')
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(f'{path} is not a parameter file: it has more than {_MAX_BYTES} bytes')
    try:
        return path.read_text(encoding='utf-8')
    except UnicodeDecodeError as error:
        raise InputError(
            f'{path} is not a parameter file: it is not text in UTF-8 ({error.reason} at byte '
            f'{error.start})'
        ) from error


def read_calibration(path: Path) -> ToolCalibration:
    """Read the calibration file of another tool; InputError if it is none."""
    found = calibration_of(_document(_text_of(path), str(path)), str(path))
    if found is None:
        raise InputError(
            f'{path} is no calibration of Kalibr (camchain, imu), OpenVINS, ORB-SLAM3, EuRoC '
            '(sensor.yaml) or camera_calibration (ost.yaml)'
        )
    return found


def _document(text: str, path: str) -> Any:
    text = plain_yaml(text)
    try:
        # Nested aliases expand without a limit; ROS does not support them either.
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text)):
            raise InputError(f'{path} has YAML aliases, which are not supported')
        return yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError) as error:
        raise InputError(f'{path} is not valid YAML: {yaml_problem(error)}') from error


def text_values(text: str, path: str, wanted: str = _NODE) -> dict[str, Any]:
    """Return the same from the text of a file."""
    document = _document(text, path)
    calibration = calibration_of(document, path)
    if calibration is not None:
        _logger.warning('%s is a calibration file (%s): these are used', path, calibration)
        return calibration.values
    if not isinstance(document, dict):
        raise InputError(
            f'{path} is not a ROS parameter file: it must begin with "/**:" and "ros__parameters:"'
        )
    values: dict[str, Any] = {}
    for node in document:
        if node in ('/**', wanted) or str(node).endswith(f'/{wanted}'):
            section = document[node]
            inner = section.get('ros__parameters') if isinstance(section, dict) else None
            if not isinstance(inner, dict):
                raise InputError(
                    f'{path}: {node!r} must have a section "ros__parameters:" with '
                    'names and values'
                )
            values |= {
                str(name): value
                for name, value in inner.items()
                if name not in _ROS_OWN and not str(name).startswith('qos_overrides')
            }
    if not values:
        raise InputError(
            f'{path} has no parameters of {wanted}: they must be below "/**:" or '
            f'"{wanted}:" and "ros__parameters:"'
        )
    return _converted(values)


def _converted(values: Mapping[str, Any]) -> dict[str, Any]:
    """Lists to tuples, and 1e-5 to a number, as in ROS (a text in PyYAML)."""
    numbers = {
        name for name, _, declared in Parameters.declarations() if declared.kind in (float, tuple)
    }

    def converted(name: str, value: Any) -> Any:
        if isinstance(value, list):
            return tuple(converted(name, item) for item in value)
        if isinstance(value, str) and name in numbers:
            with contextlib.suppress(ValueError):
                return float(value)
        return value

    return {name: converted(name, value) for name, value in values.items()}


# Head of the generated file. [derived: how the file is made and read]
_HEAD = """\
# Parameters of relpose_node, global_shutter_node and `--params` of the commands, each at its
# default.
# Generated by `python -m rs_relpose_ros.config.files config/relpose.yaml`; copy it and change the
# copy. Parameters without a value have no default; the node reports the ones that it requires.
# [live] can be changed while the node runs (`ros2 param set`).

/**:
  ros__parameters:
"""


def parameter_template() -> str:
    """Text of a parameter file with all parameters at their defaults."""
    lines = []
    for name, default, declared in Parameters.declarations():
        meaning = declared.description
        if declared.legal not in ('finite', *ANY_VALUE.values()):
            meaning += f': {declared.legal}'
        lines += [
            '',
            *comment(meaning + ' [live]' * declared.live, '    '),
            f'    # {name}:' if default is None else f'    {name}: {yaml_text(default)}',
        ]
    return _HEAD + '\n'.join(lines[1:]) + '\n'


if __name__ == '__main__':
    Path(sys.argv[1]).write_text(parameter_template(), encoding='utf-8')
