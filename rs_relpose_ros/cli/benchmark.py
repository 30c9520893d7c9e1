"""``rs_relpose benchmark``: accuracy against an oracle."""

from __future__ import annotations

import argparse
from pathlib import Path
import sys

from rs_relpose_ros.config import SOLVERS
from rs_relpose_ros.errors import InputError

HELP = ('Measure the estimator on simulated frame pairs, one thread each: "accuracy" against an '
        'oracle that knows the true matches and starts at the truth. Writes tables (CSV, '
        'Markdown) and plots into a folder.')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benchmarks and their arguments."""
    benchmarks = parser.add_subparsers(dest='benchmark', metavar='BENCHMARK', required=True)
    _add_accuracy_arguments(benchmarks.add_parser(
        'accuracy', help='errors, covariance and lost poses in every cell of the experiment',
        description='Errors by those of the oracle, normalised errors and lost poses, over many '
                    'random problems (300 matches) in every cell of the experiment.'))


def _add_accuracy_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--trials', type=int, default=200, metavar='N',
                        help='problems a cell (default: 200)')
    parser.add_argument('--cells', nargs='+', default=['all'], metavar='NAME',
                        help='cells by name, with * as in file names, e.g. "forward-*" '
                             '(default: all)')
    parser.add_argument('--noise', nargs='+', choices=('paper', 'gaussian'),
                        default=['paper', 'gaussian'],
                        help='error of gravity: of fixed size and opposite in the frames, as in '
                             'the paper (accuracy), or Gaussian in each frame (covariance) '
                             '(default: both)')
    parser.add_argument('--sigma-factor', nargs='+', type=float, default=[1.0], metavar='X',
                        help='tell the estimator so many times the true sigmas (default: 1)')
    parser.add_argument('--solver', choices=SOLVERS, default='auto', help='(default: auto)')
    parser.add_argument('--seed', type=int, default=0, metavar='N',
                        help='seed of the first problem of a cell (default: 0)')
    parser.add_argument('--jobs', type=int, default=1, metavar='N',
                        help='processes; times are comparable only where each has a core of its '
                             'own (default: 1)')
    parser.add_argument('--output', type=Path, default=Path('out/accuracy'), metavar='DIR',
                        help='folder of the tables (default: out/accuracy)')
    parser.add_argument('--cache', type=Path, metavar='DIR',
                        help="folder that keeps the oracle's results (default: OUTPUT/oracle)")


def run(args: argparse.Namespace) -> int:
    """Run the benchmark that was asked for."""
    from rs_relpose_ros.benchmark.threads import use_one_thread
    use_one_thread()
    return _run_accuracy(args)


def _run_accuracy(args: argparse.Namespace) -> int:
    from tqdm import tqdm

    from rs_relpose_ros.benchmark.accuracy import Experiment, run_experiment, select_cells
    from rs_relpose_ros.benchmark.accuracy_report import write_report
    from rs_relpose_ros.benchmark.oracle_cache import OracleCache

    for name in ('trials', 'jobs'):
        if getattr(args, name) < 1:
            raise InputError(f'--{name} must be at least 1, got {getattr(args, name)}')
    if args.seed < 0:
        raise InputError(f'--seed must not be negative, got {args.seed}')
    if min(args.sigma_factor) <= 0.0:
        raise InputError(f'--sigma-factor must be positive, got {min(args.sigma_factor)}')
    experiment = Experiment(
        select_cells(args.cells), tuple(dict.fromkeys(args.noise)),
        tuple(dict.fromkeys(args.sigma_factor)), args.trials, args.seed, args.solver)
    total = (len(experiment.cells) * len(experiment.noises) * len(experiment.sigma_factors)
             * experiment.trials)
    with tqdm(total=total, unit='estimate', disable=not sys.stderr.isatty()) as bar:
        trials = run_experiment(experiment, OracleCache(args.cache or args.output / 'oracle'),
                                args.jobs, bar.update)
    print(write_report(args.output, experiment, trials))
    print(f'written to {args.output}')
    return 0
