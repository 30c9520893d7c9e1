"""Time and accuracy beside OpenCV and PoseLib; `docs/benchmarks.md`, --help."""

import sys

from rs_relpose_ros.cli.main import main

if __name__ == '__main__':
    sys.exit(main(['benchmark', 'speed', *sys.argv[1:]]))
