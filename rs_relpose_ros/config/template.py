"""The commented parameter file ``config/relpose.yaml``, written from the declared settings.

python -m rs_relpose_ros.config.template config/relpose.yaml
"""

from __future__ import annotations

from pathlib import Path
import sys

from rs_relpose_ros.config.declarations import ANY_VALUE, Declared
from rs_relpose_ros.config.parameter_file import comment, yaml_text
from rs_relpose_ros.config.parameters import Parameters

_HEAD = """\
# Parameters of relpose_node, global_shutter_node and `--params` of the commands, each at its
# default.
# Written by `python -m rs_relpose_ros.config.template config/relpose.yaml`; copy it and
# change the copy. Those without a value have no default: the node says when it needs one.
# [live] can be changed while the node runs (`ros2 param set`).

/**:
  ros__parameters:
"""


def parameter_template() -> str:
    """Text of the commented parameter file."""
    lines = []
    for name, default, declared in Parameters.declarations():
        lines += ['', *comment(_meaning(declared), '    ')]
        if default is None:
            lines.append(f'    # {name}:')
        else:
            lines.append(f'    {name}: {yaml_text(default)}')
    return _HEAD + '\n'.join(lines[1:]) + '\n'


def _meaning(declared: Declared) -> str:
    text = declared.description
    if declared.legal not in ('finite', *ANY_VALUE.values()):
        text += f': {declared.legal}'
    return f'{text} [live]' if declared.live else text


if __name__ == '__main__':
    Path(sys.argv[1]).write_text(parameter_template(), encoding='utf-8')
