"""``rs_relpose benchmark``: accuracy against an oracle, speed beside others, the live node."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path
import sys

from rs_relpose_ros.config.estimator import SOLVER_CHOICES
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError

HELP = ('Measure the estimator on simulated frame pairs, one thread each: "accuracy" against an '
        'oracle that knows the true matches and starts at the truth, "speed" beside OpenCV and '
        'PoseLib, "all" both as the project reports them. "live" measures the node: latency, '
        'dropped frames, processor time and memory at camera rate. "calibration" compares that of '
        'simulated recordings with the truth. Writes tables (CSV, Markdown) and plots into a '
        'folder.')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benchmarks and their arguments."""
    benchmarks = parser.add_subparsers(dest='benchmark', metavar='BENCHMARK', required=True)
    _add_accuracy_arguments(benchmarks.add_parser(
        'accuracy', help='errors, covariance and lost poses in every cell of the experiment',
        description='Errors by those of the oracle, normalised errors and lost poses, over many '
                    'random problems (300 matches) in every cell of the experiment.'))
    _add_speed_arguments(benchmarks.add_parser(
        'speed', help='time and accuracy beside OpenCV and PoseLib',
        description='Time and accuracy of this library, OpenCV (USAC_MAGSAC) and PoseLib on the '
                    'same problems, how time grows with matches, and the first estimate of a new '
                    'process.'))
    _add_live_arguments(benchmarks.add_parser(
        'live', help='the node at camera rate: latency, drops, processor time, memory',
        description='Plays simulated recordings at 30 Hz to a relpose_node, two processes over '
                    'Fast DDS. Needs ROS. A cell is an image size, a format (mono8, bgr8, jpeg) '
                    'and a rate of the IMU; each is rendered once into OUTPUT/clips.'))
    _add_calibration_arguments(benchmarks.add_parser(
        'calibration', help='`rs_relpose calibrate` on simulated tracks, against the truth',
        description='Errors, sigmas and verdicts of the calibration over many simulated '
                    'recordings of 300 frames: read-out time, offset, axes, gyro and motion are '
                    'drawn, the focal length is asked for in every other round of the 24 axis '
                    'maps.'))
    _add_all_arguments(benchmarks.add_parser(
        'all', help='accuracy and speed, as the project reports them',
        description='Both with their defaults, told sigmas also half and twice the '
                    'true ones, and memory over 100,000 estimates: some hours on one core.'))


def _add_common_arguments(parser: argparse.ArgumentParser, folder: str, *, seed_of: str = '',
                          jobs: str = '') -> None:
    """``--output``, and what a benchmark has of ``--seed`` and ``--jobs``."""
    if seed_of:
        parser.add_argument('--seed', type=int, default=0, metavar='N',
                            help=f'seed of the first {seed_of} (default: %(default)s)')
    if jobs:
        parser.add_argument('--jobs', type=int, default=1, metavar='N',
                            help=f'{jobs} (default: %(default)s)')
    parser.add_argument('--output', type=Path, default=Path(folder), metavar='DIR',
                        help='folder of the tables (default: %(default)s)')


def _add_all_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--trials', type=int, default=200, metavar='N',
                        help='problems a cell of the accuracy benchmark (default: 200)')
    parser.add_argument('--soak', type=int, default=100_000, metavar='N',
                        help='see whether memory grows over N estimates (default: 100000)')
    _add_common_arguments(parser, 'out/benchmark', jobs='processes of the accuracy benchmark')


def _add_calibration_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--runs', type=int, default=240, metavar='N',
                        help='recordings (default: 240)')
    _add_common_arguments(parser, 'out/calibration', seed_of='recording', jobs='processes')


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
    parser.add_argument('--solver', choices=SOLVER_CHOICES, default='auto', help='(default: auto)')
    _add_common_arguments(
        parser, 'out/accuracy', seed_of='problem of a cell', jobs='processes; times are '
        'comparable only where each has a core of its own')
    parser.add_argument('--cache', type=Path, metavar='DIR',
                        help="folder that keeps the oracle's results (default: OUTPUT/oracle)")


def _add_speed_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--trials', type=int, default=50, metavar='N',
                        help='problems a cell (default: 50)')
    parser.add_argument('--cells', nargs='+', metavar='NAME',
                        default=['*-base', '*-v0-w0', '*-outliers-60'],
                        help='cells by name, with * as in file names (default: the base cells, '
                             'cameras at rest, 60 %% outliers)')
    parser.add_argument('--matches', nargs='+', type=int, default=[300, 1000, 3000, 10000],
                        metavar='N',
                        help='numbers of matches over which time is shown (default: 300 1000 '
                             '3000 10000)')
    parser.add_argument('--repeats', type=int, default=3, metavar='N',
                        help='the shortest of so many repeats counts (default: 3)')
    parser.add_argument('--processes', type=int, default=3, metavar='N',
                        help='new processes whose first estimate is timed (default: 3)')
    parser.add_argument('--soak', type=int, default=0, metavar='N',
                        help='see whether memory grows over N estimates (default: 0, do not)')
    _add_common_arguments(parser, 'out/speed', seed_of='problem')


def _add_live_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--cells', nargs='+', default=['all'], metavar='NAME',
                        help='cells by name, with * as in file names, e.g. "640x480-*" or '
                             '1280x720-mono8-imu400 (default: all)')
    parser.add_argument('--duration', type=float, default=60.0, metavar='SECONDS',
                        help='how long each cell is played (default: 60)')
    parser.add_argument('--soak', type=float, nargs='?', const=10.0, default=0.0,
                        metavar='MINUTES',
                        help='play the cells so long instead (default: 10), and show memory and '
                             'latency over time')
    parser.add_argument('--profile', type=Path, metavar='FILE',
                        help='Fast DDS profile for images above 512 KB (default: the shipped '
                             'config/fastdds.xml)')
    _add_common_arguments(parser, 'out/live')


def run(args: argparse.Namespace) -> int:
    """Run the benchmark that was asked for."""
    if args.benchmark == 'live':
        return _run_live(args)
    from rs_relpose_lab.experiments.threads import use_one_thread
    use_one_thread()
    return {'accuracy': _run_accuracy, 'speed': _run_speed, 'calibration': _run_calibration,
            'all': _run_all}[args.benchmark](args)


def _run_all(args: argparse.Namespace) -> int:
    """Each benchmark as its own command line would run it."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    accuracy = ['--trials', str(args.trials), '--jobs', str(args.jobs), '--sigma-factor', '1',
                '0.5', '2', '--output', str(args.output / 'accuracy')]
    speed = ['--soak', str(args.soak), '--output', str(args.output / 'speed')]
    parsed = [parser.parse_args(['accuracy', *accuracy]), parser.parse_args(['speed', *speed])]
    return max(run(one) for one in parsed)


def _check_at_least(low: int, args: argparse.Namespace, *names: str) -> None:
    for name in names:
        value = getattr(args, name)
        if min(value) < low if isinstance(value, list) else value < low:
            raise InputError(f'--{name} must be at least {low}, got {value}')


def _run_accuracy(args: argparse.Namespace) -> int:
    from tqdm import tqdm

    from rs_relpose_lab.experiments.accuracy import Experiment, run_experiment
    from rs_relpose_lab.experiments.accuracy_report import write_report
    from rs_relpose_lab.experiments.cell_names import matching_cells
    from rs_relpose_lab.experiments.oracle_cache import OracleCache
    from rs_relpose_lab.experiments.problems import CELLS

    _check_at_least(1, args, 'trials', 'jobs')
    _check_at_least(0, args, 'seed')
    if min(args.sigma_factor) <= 0.0:
        raise InputError(f'--sigma-factor must be positive, got {min(args.sigma_factor)}')
    experiment = Experiment(
        matching_cells(args.cells, CELLS), tuple(dict.fromkeys(args.noise)),
        tuple(dict.fromkeys(args.sigma_factor)), args.trials, args.seed, args.solver)
    total = (len(experiment.cells) * len(experiment.noises) * len(experiment.sigma_factors)
             * experiment.trials)
    with tqdm(total=total, unit='estimate', disable=not sys.stderr.isatty()) as bar:
        trials = run_experiment(experiment, OracleCache(args.cache or args.output / 'oracle'),
                                args.jobs, bar.update)
    print(write_report(args.output, experiment, trials))
    print(f'written to {args.output}')
    return 0


def _run_calibration(args: argparse.Namespace) -> int:
    from tqdm import tqdm

    from rs_relpose_lab.experiments.calibration_accuracy import run_calibrations, write_report

    _check_at_least(1, args, 'runs', 'jobs')
    _check_at_least(0, args, 'seed')
    seeds = range(args.seed, args.seed + args.runs)
    runs = []
    for run in tqdm(run_calibrations(seeds, args.jobs), total=args.runs, unit='recording',
                    disable=not sys.stderr.isatty()):
        runs.append(run)
        # A run that is stopped leaves what it has.
        text = write_report(args.output, runs)
    print(text)
    print(f'written to {args.output}')
    return 0


def _run_speed(args: argparse.Namespace) -> int:
    from tqdm import tqdm

    from rs_relpose_lab.experiments.cell_names import matching_cells
    from rs_relpose_lab.experiments.problems import Cell, CELLS
    from rs_relpose_lab.experiments.speed import compare, first_estimates, soak
    from rs_relpose_lab.experiments.speed_report import write_report

    _check_at_least(1, args, 'trials', 'repeats')
    _check_at_least(0, args, 'processes', 'soak', 'seed')
    _check_at_least(50, args, 'matches')
    cells = matching_cells(args.cells, CELLS)
    # Large problems need fewer: their times scatter less.
    few = max(args.trials // 5, 1)
    quiet = not sys.stderr.isatty()
    # First, so that nothing else of this process holds the processor's caches.
    first = first_estimates(args.processes)
    with tqdm(total=len(cells) * args.trials + len(args.matches) * few, unit='problem',
              disable=quiet) as bar:
        comparison = [run for cell in cells for run in compare(
            cell, Cell().matches, args.trials, args.repeats, args.seed, bar.update)]
        scaling = [run for count in sorted(set(args.matches)) for run in compare(
            cells[0], count, few, args.repeats, args.seed, bar.update)]
    soaked = None
    if args.soak:
        with tqdm(total=args.soak + args.soak // 10, unit='estimate', disable=quiet) as bar:
            soaked = soak(args.soak, bar.update)
    print(write_report(args.output, comparison, scaling, first, soaked))
    print(f'written to {args.output}')
    return 0


def _run_live(args: argparse.Namespace) -> int:
    from tqdm import tqdm

    from rs_relpose_lab.experiments.live import run_cell, select_cells
    from rs_relpose_lab.experiments.live_clip import FPS, PERIOD, prepare_clip
    from rs_relpose_lab.experiments.live_report import write_report, write_soak_report

    # Shorter than a turn of the motion, hardly anything is measured.
    _check_at_least(5, args, 'duration')
    _check_at_least(0, args, 'soak')
    cells = select_cells(args.cells)
    # Said before minutes of rendering.
    try:
        import_module('rs_relpose_lab.live.measured_run')
    except ImportError as error:
        raise MissingInputError(f'the live benchmark needs ROS 2 (rclpy, Fast DDS): {error}; '
                                'source its setup.bash, or use the environment of make') from error
    duration = 60.0 * args.soak or args.duration
    profile = args.profile or _shipped('fastdds.xml')
    if not profile.is_file():
        raise InputError(f'there is no Fast DDS profile {profile}: choose one with --profile')
    quiet = not sys.stderr.isatty()
    sizes = sorted({(cell.width, cell.height) for cell in cells})
    with tqdm(total=len(sizes) * round(FPS * PERIOD), unit='frame', desc='rendering',
              disable=quiet) as bar:
        clips = {size: prepare_clip(args.output / 'clips', *size, bar.update) for size in sizes}
    results, failed = [], False
    with tqdm(total=round(len(cells) * duration), unit='s', disable=quiet) as bar:
        for cell in cells:
            bar.set_description(cell.name)
            try:
                statistics, course = run_cell(
                    cell, clips[cell.width, cell.height], duration, args.output / cell.name,
                    profile.resolve(), bar.update)
            except RsRelposeError as error:   # the others are worth their time all the same
                failed = True
                print(f'{cell.name}: {error}', file=sys.stderr)
                continue
            results.append(statistics)
            if args.soak:
                print(write_soak_report(args.output / cell.name, statistics, course))
    if results:
        print(write_report(args.output, results))
        print(f'written to {args.output}')
    return int(failed)


def _shipped(name: str) -> Path:
    """A file of `config/`: of the checkout, or where it was installed."""
    package = Path(__file__).resolve().parent.parent
    checkout = package.parent / 'config' / name
    if checkout.is_file():
        return checkout
    # PREFIX/lib/pythonX/site-packages/PACKAGE, by pip and by colcon.
    return package.parents[3] / 'share' / package.name / 'config' / name
