"""Accuracy and covariance of the estimator against an oracle: see docs/benchmarks.md.

    python benchmarks/accuracy.py --trials 200 --cells all --output DIR
"""

import sys

from rs_relpose_ros.cli.main import main

if __name__ == '__main__':
    sys.exit(main(['benchmark', 'accuracy', *sys.argv[1:]]))
