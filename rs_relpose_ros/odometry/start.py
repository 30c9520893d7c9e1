"""Entry of the console script odometry_node."""

from __future__ import annotations

from typing import NoReturn

from rs_relpose_ros.node.start import start


def main() -> NoReturn:
    """Run odometry_node, and end the process with its exit code."""
    start('rs_relpose_ros.odometry.node')


if __name__ == '__main__':
    main()
