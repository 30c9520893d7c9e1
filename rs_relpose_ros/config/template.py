"""The commented parameter file ``config/relpose.yaml``, written from the declared settings.

python -m rs_relpose_ros.config.template config/relpose.yaml
"""

from __future__ import annotations

from pathlib import Path
import sys
import textwrap
from typing import Any

from rs_relpose_ros.config.declarations import Declared
from rs_relpose_ros.config.parameters import Parameters

_HEAD = """\
# Parameters of relpose_node and of `rs_relpose replay --params`, each at its default.
# Written by `python -m rs_relpose_ros.config.template config/relpose.yaml`; copy it and
# change the copy. Those without a value have no default: the node says when one is missing.
# [live] can be changed while the node runs (`ros2 param set`).

/**:
  ros__parameters:
"""


def parameter_template() -> str:
    """Text of the commented parameter file."""
    lines = []
    for name, default, declared in Parameters.declarations():
        lines += ['', *_comment(declared)]
        if default is None:
            lines.append(f'    # {name}:')
        else:
            lines.append(f'    {name}: {_yaml(default)}')
    return _HEAD + '\n'.join(lines[1:]) + '\n'


def _comment(declared: Declared) -> list[str]:
    text = declared.description
    if declared.kind is not bool and declared.legal != 'finite':
        text += f': {declared.legal}'
    if declared.live:
        text += ' [live]'
    return textwrap.wrap(text, 95, initial_indent='    # ', subsequent_indent='    # ')


def _yaml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"'{value}'"
    if isinstance(value, tuple):
        return f'[{", ".join(_yaml(item) for item in value)}]'
    if isinstance(value, float):
        text = repr(value)
        # YAML 1.1 takes 1e-05 for a string: a float needs its point.
        return text if '.' in text or 'e' not in text else text.replace('e', '.0e')
    return str(value)


if __name__ == '__main__':
    Path(sys.argv[1]).write_text(parameter_template(), encoding='utf-8')
