"""Parameter files of the node for a recording: every figure with its source."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import json
from pathlib import Path
import textwrap

from rs_relpose_ros.errors import InputError

_WIDTH = 95

ParameterValue = float | str | tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Figure:
    """A parameter of the node and where its value comes from."""

    name: str
    value: ParameterValue
    source: str


def parameter_text(title: str, figures: Sequence[Figure]) -> str:
    """Commented ROS parameter file.

    Parameters
    ----------
    title : str
        What the parameters are for.
    figures : sequence of Figure
    """
    lines = [*_comment(title, '# '), '/**:', '  ros__parameters:']
    for figure in figures:
        lines += [*_comment(figure.source, '    # '), f'    {figure.name}: {_yaml(figure.value)}']
    return '\n'.join(lines) + '\n'


def write_parameters(path: Path, title: str, figures: Sequence[Figure]) -> None:
    """Write `parameter_text` to a new file.

    Raises
    ------
    InputError
        The file exists already or cannot be written.
    """
    try:
        with path.open('x', encoding='utf-8') as file:
            file.write(parameter_text(title, figures))
    except FileExistsError:
        raise InputError(
            f'{path} exists already: remove it or choose another path') from None
    except OSError as error:
        raise InputError(f'cannot write {path}: {error.strerror}') from error


def _comment(text: str, prefix: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent=prefix, subsequent_indent=prefix,
                         break_long_words=False, break_on_hyphens=False)


def _yaml(value: ParameterValue) -> str:
    # JSON is YAML as long as no float is written with an exponent, which none of these is.
    return json.dumps(value)
