"""Accuracy and covariance of the estimator against an oracle; `docs/benchmarks.md`, --help."""

import sys

from rs_relpose_ros.cli.main import main

if __name__ == '__main__':
    sys.exit(main(['benchmark', 'accuracy', *sys.argv[1:]]))
