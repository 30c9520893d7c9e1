"""``rs_relpose benchmark`` from a checkout: ``python benchmarks/run.py all``; see README.md."""

import sys

from rs_relpose_ros.cli.main import main

if __name__ == '__main__':
    sys.exit(main(['benchmark', *sys.argv[1:]]))
