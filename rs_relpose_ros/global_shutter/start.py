"""Entry of the console script global_shutter_node."""

from __future__ import annotations

from typing import NoReturn

from rs_relpose_ros.node.start import start


def main() -> NoReturn:
    """Run global_shutter_node, and end the process with its exit code."""
    start('rs_relpose_ros.global_shutter.node')


if __name__ == '__main__':
    main()
