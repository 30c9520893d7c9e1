"""``rs_relpose benchmark``: what the package reaches, measured; see benchmarks/README.md."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from fnmatch import fnmatchcase
from importlib import import_module
from pathlib import Path
import sys
from typing import NamedTuple

from rs_relpose_ros.cli.options import progress_bar
from rs_relpose_ros.config.estimator import SOLVER_CHOICES
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError

HELP = ('Measure what the package reaches: the estimator on simulated frame pairs, the live node, '
        'the calibration. Writes tables (CSV, Markdown) and plots into a folder.')


class Benchmark(NamedTuple):
    """A benchmark; `seed_of`, `jobs`: what its options of these names are for, or ''."""

    help: str
    description: str
    add_arguments: Callable[[argparse.ArgumentParser], object]
    run: Callable[[argparse.Namespace], int]
    folder: str
    first_seed: int = 0
    seed_of: str = ''
    jobs: str = ''


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benchmarks and their arguments."""
    benchmarks = parser.add_subparsers(dest='benchmark', metavar='BENCHMARK', required=True)
    for name, benchmark in BENCHMARKS.items():
        one = benchmarks.add_parser(name, help=benchmark.help, description=benchmark.description)
        benchmark.add_arguments(one)
        if benchmark.seed_of:
            one.add_argument('--seed', type=int, default=benchmark.first_seed, metavar='N',
                             help=f'seed of the first {benchmark.seed_of} (default: %(default)s)')
        if benchmark.jobs:
            one.add_argument('--jobs', type=int, default=1, metavar='N',
                             help=f'{benchmark.jobs} (default: %(default)s)')
        one.add_argument('--output', type=Path, default=Path('out', benchmark.folder),
                         metavar='DIR', help='folder of the tables (default: %(default)s)')


def run(args: argparse.Namespace) -> int:
    """Run the benchmark that was asked for."""
    if args.benchmark not in ('live', 'unseen'):
        from rs_relpose_lab.experiments.workers import use_one_thread
        use_one_thread()
    for name in ('jobs', 'seed'):
        if name in args:
            _check_at_least(int(name == 'jobs'), args, name)
    return BENCHMARKS[args.benchmark].run(args)


def _check_at_least(low: int, args: argparse.Namespace, *names: str) -> None:
    for name in names:
        value = getattr(args, name)
        if min(value) < low if isinstance(value, list) else value < low:
            raise InputError(f'--{name} must be at least {low}, got {value}')


def matching_cells(patterns: Iterable[str], names: Iterable[str]) -> tuple[str, ...]:
    """Names that match any of the patterns: 'all', or with ``*`` as in file names."""
    names, chosen = tuple(names), set[str]()
    for pattern in patterns:
        matching = {name for name in names if pattern == 'all' or fnmatchcase(name, pattern)}
        if not matching:
            raise InputError(f'no cell is named {pattern!r}; there are {", ".join(names)}')
        chosen |= matching
    return tuple(name for name in names if name in chosen)


def _tell(report: str, folder: Path) -> int:
    print(report)
    print(f'written to {folder}')
    return 0


def _number(parser: argparse.ArgumentParser, option: str, default: int, text: str) -> None:
    parser.add_argument(option, type=int, default=default, metavar='N',
                        help=f'{text} (default: %(default)s)')


def _cells(parser: argparse.ArgumentParser, default: list[str], text: str) -> None:
    parser.add_argument('--cells', nargs='+', default=default, metavar='NAME',
                        help=f'cells by name, with * as in file names; {text}')


def _accuracy_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, '--trials', 200, 'problems a cell')
    _cells(parser, ['all'], 'e.g. "forward-*" (default: all)')
    parser.add_argument('--noise', nargs='+', choices=('paper', 'gaussian'),
                        default=['paper', 'gaussian'],
                        help='error of gravity: of fixed size and opposite in the frames, as in '
                             'the paper (accuracy), or Gaussian in each frame (covariance) '
                             '(default: both)')
    parser.add_argument('--sigma-factor', nargs='+', type=float, default=[1.0], metavar='X',
                        help='tell the estimator so many times the true sigmas (default: 1)')
    parser.add_argument('--solver', choices=SOLVER_CHOICES, default='auto', help='(default: auto)')
    parser.add_argument('--cache', type=Path, metavar='DIR',
                        help="folder that keeps the oracle's results (default: OUTPUT/oracle)")


def _run_accuracy(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments.accuracy import AccuracyRun, OracleCache, run_accuracy
    from rs_relpose_lab.experiments.accuracy_report import write_report
    from rs_relpose_lab.experiments.problems import CELLS

    _check_at_least(1, args, 'trials')
    if min(args.sigma_factor) <= 0.0:
        raise InputError(f'--sigma-factor must be positive, got {min(args.sigma_factor)}')
    accuracy = AccuracyRun(
        matching_cells(args.cells, CELLS), tuple(dict.fromkeys(args.noise)),
        tuple(dict.fromkeys(args.sigma_factor)), args.trials, args.seed, args.solver)
    with progress_bar(accuracy.estimates, 'estimate') as bar:
        trials = run_accuracy(accuracy, OracleCache(args.cache or args.output / 'oracle'),
                              args.jobs, bar.update)
    return _tell(write_report(args.output, accuracy, trials), args.output)


def _speed_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, '--trials', 50, 'problems a cell')
    _cells(parser, ['*-base', '*-v0-w0', '*-outliers-60'],
           'default: the base cells, cameras at rest, 60 %% outliers')
    parser.add_argument('--matches', nargs='+', type=int, default=[300, 1000, 3000, 10000],
                        metavar='N', help='numbers of matches over which time is shown (default: '
                        '300 1000 3000 10000)')
    _number(parser, '--repeats', 3, 'the shortest of so many repeats counts')
    _number(parser, '--processes', 3, 'new processes whose first estimate is timed')
    _number(parser, '--soak', 0, 'see whether memory grows over N estimates')


def _run_speed(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments.problems import Cell, CELLS
    from rs_relpose_lab.experiments.speed import compare, first_estimates, soak
    from rs_relpose_lab.experiments.speed_report import write_report

    _check_at_least(1, args, 'trials', 'repeats')
    _check_at_least(0, args, 'processes', 'soak')
    _check_at_least(50, args, 'matches')
    cells = matching_cells(args.cells, CELLS)
    # Large problems need fewer: their times scatter less.
    few = max(args.trials // 5, 1)
    # First, so that nothing else of this process holds the processor's caches.
    first = first_estimates(args.processes)
    with progress_bar(len(cells) * args.trials + len(args.matches) * few, 'problem') as bar:
        comparison = [timing for cell in cells for timing in compare(
            cell, Cell().matches, args.trials, args.repeats, args.seed, bar.update)]
        scaling = [timing for count in sorted(set(args.matches)) for timing in compare(
            cells[0], count, few, args.repeats, args.seed, bar.update)]
    soaked = None
    if args.soak:
        with progress_bar(args.soak + args.soak // 10, 'estimate') as bar:
            soaked = soak(args.soak, bar.update)
    return _tell(write_report(args.output, comparison, scaling, first, soaked), args.output)


def _live_arguments(parser: argparse.ArgumentParser) -> None:
    _cells(parser, ['all'], 'e.g. "640x480-*" or 1280x720-mono8-imu400 (default: all)')
    parser.add_argument('--duration', type=float, default=60.0, metavar='SECONDS',
                        help='how long each cell is played (default: 60)')
    parser.add_argument('--soak', type=float, nargs='?', const=10.0, default=0.0,
                        metavar='MINUTES',
                        help='play the cells so long instead (default: 10), and show memory and '
                             'latency over time')
    parser.add_argument('--profile', type=Path, metavar='FILE',
                        help='Fast DDS profile for images above 512 KB (default: the shipped '
                             'config/fastdds.xml)')


def _need_ros(module: str) -> None:
    """Say before minutes of rendering that a live benchmark cannot run."""
    try:
        import_module(f'rs_relpose_lab.live.{module}')
    except ImportError as error:
        raise MissingInputError(f'the live benchmark needs ROS 2 (rclpy, Fast DDS): {error}; '
                                'source its setup.bash, or use the environment of make') from error


def _run_live(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments.live import CELLS, run_cell
    from rs_relpose_lab.experiments.live_clip import FPS, PERIOD, prepare_clip
    from rs_relpose_lab.experiments.live_report import write_report, write_soak_report

    # Shorter than a turn of the motion, hardly anything is measured.
    _check_at_least(5, args, 'duration')
    _check_at_least(0, args, 'soak')
    cells = [CELLS[name] for name in matching_cells(args.cells, CELLS)]
    _need_ros('measured_run')
    duration = 60.0 * args.soak or args.duration
    profile = args.profile or _shipped('fastdds.xml')
    if not profile.is_file():
        raise InputError(f'there is no Fast DDS profile {profile}: choose one with --profile')
    sizes = sorted({(cell.width, cell.height) for cell in cells})
    with progress_bar(len(sizes) * round(FPS * PERIOD), 'frame', 'rendering') as bar:
        clips = {size: prepare_clip(args.output / 'clips', *size, bar.update) for size in sizes}
    results, failed = [], False
    with progress_bar(round(len(cells) * duration), 's') as bar:
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
        _tell(write_report(args.output, results), args.output)
    return int(failed)


def _shipped(name: str) -> Path:
    """A file of `config/`: of the checkout, or where it was installed."""
    package = Path(__file__).resolve().parent.parent
    checkout = package.parent / 'config' / name
    if checkout.is_file():
        return checkout
    # PREFIX/lib/pythonX/site-packages/PACKAGE, by pip and by colcon.
    return package.parents[3] / 'share' / 'rs_relpose_ros' / 'config' / name


def _run_unseen(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments.unseen_bags import configurations, measure, write_report

    _check_at_least(1, args, 'bags')
    _need_ros('live_run')
    bags = []
    with progress_bar(args.bags, 'bag') as bar:
        for config in configurations(args.bags, args.seed):
            bags.append(measure(config, args.output / f'seed_{config.seed}'))
            bar.update()
    return _tell(write_report(args.output, bags), args.output)


def _consistency_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, '--bags', 12, 'simulated bags')
    parser.add_argument('--recording', nargs=3, type=Path, action='append', default=[],
                        metavar=('BAG', 'PARAMETERS', 'PAIRS'),
                        help='a recording, its parameter file and a table of true pairs '
                        '(pseudo_truth.csv); may be given several times')
    parser.add_argument('--chain', nargs=2, type=Path, action='append', default=[],
                        metavar=('BAG', 'PARAMETERS'),
                        help='a recording and its parameter file: whether baselines of successive '
                        'pairs agree with the scale of their tracks; may be given several times')


def _run_consistency(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import baseline_chain
    from rs_relpose_lab.experiments.consistency import (
        configurations,
        on_recording,
        on_simulated_bag,
        PairConsistency,
        write_report,
    )

    _check_at_least(0, args, 'bags')
    if not args.bags and not args.recording and not args.chain:
        raise InputError('--bags 0 needs a --recording or a --chain: there is nothing to measure')
    args.output.mkdir(parents=True, exist_ok=True)
    pairs: list[PairConsistency] = []
    found: list[baseline_chain.BaselineStep] = []
    with progress_bar(args.bags + len(args.recording) + len(args.chain), 'bag') as bar:
        for chain in args.chain:
            found += baseline_chain.chain_of(*chain)
            bar.update()
        for recording in args.recording:
            pairs += on_recording(*recording)
            bar.update()
        for config in configurations(args.bags, args.seed):
            pairs += on_simulated_bag(config, args.output / f'seed_{config.seed}')
            bar.update()
    if not pairs and not found:
        raise InputError('no pair could be compared with the truth, or with the pair before it')
    reports = ([write_report(args.output, pairs)] if pairs else []) + (
        [baseline_chain.write_report(args.output, found)] if found else [])
    return _tell('\n'.join(reports), args.output)


def _run_calibration(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments.calibration_accuracy import run_calibration, write_report
    from rs_relpose_lab.experiments.workers import in_processes

    _check_at_least(1, args, 'runs')
    runs, report = [], ''
    with progress_bar(args.runs, 'recording') as bar:
        for found in in_processes(run_calibration, range(args.seed, args.seed + args.runs),
                                  args.jobs):
            runs.append(found)
            # A run that is stopped leaves what it has.
            report = write_report(args.output, runs)
            bar.update()
    return _tell(report, args.output)


def _run_calibration_bags(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments.calibration_bags import measure, runs, write_report

    _check_at_least(1, args, 'bags')
    asked = runs(args.bags, args.seed)
    bags = []
    with progress_bar(len(asked), 'bag') as bar:
        for seed, kind in asked:
            bags.append(measure(seed, kind, args.output / f'{seed}'))
            bar.update()
    return _tell(write_report(args.output, bags), args.output)


def _trust_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, '--bags', 20, 'simulated bags that go through all rows')
    parser.add_argument('--rows', nargs='+', default=['all'], metavar='NAME',
                        help='what is told wrong, with * as in file names, e.g. "readout-*" '
                             '(default: all)')
    parser.add_argument('--seconds', type=float, default=30.0, metavar='S',
                        help='length of a simulated bag (default: %(default)s)')
    _number(parser, '--right', 0, 'further bags that are told right, for false alarms: noise at '
                                  'the told level, half of it and twice')
    _number(parser, '--rendered', 0, 'bags with images: the first ones of the others, rendered')
    parser.add_argument('--recordings', type=Path, nargs='+', default=[], metavar='PATH',
                        help='bags with their right parameters beside them (BAG.yaml), or folders '
                             'of real recordings, e.g. "$RS_RELPOSE_DATA"/android_phone_rs')


def _run_trust(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments.trust import measure, tasks, write_report
    from rs_relpose_lab.experiments.trust_rows import ROWS
    from rs_relpose_lab.experiments.workers import in_processes

    _check_at_least(0, args, 'bags', 'right', 'rendered')
    # Shorter than what must be enough to tell a gross error, nothing is measured.
    _check_at_least(6, args, 'seconds')
    asked = tasks(matching_cells(args.rows, ROWS), args.bags, args.seconds, args.seed,
                  right=args.right, rendered=args.rendered, recordings=args.recordings)
    if not asked:
        raise InputError('there is nothing to measure: give --bags, --right, --rendered or '
                         '--recordings')
    bags, report = [], ''
    with progress_bar(len(asked), 'recording') as bar:
        for found in in_processes(measure, asked, args.jobs):
            bags += found
            # A run that is stopped leaves what it has.
            report = write_report(args.output, bags)
            bar.update()
    return _tell(report, args.output)


def _global_shutter_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, '--walks', 6, 'walks of 2 s on which the map is compared with the truth')
    _number(parser, '--bags', 6, "rendered bags for OpenCV's 5-point")
    parser.add_argument('--live', action='store_true', help='also play the first bag to '
                        'global_shutter_node and relpose_node side by side; needs ROS')
    parser.add_argument('--recording', nargs=3, type=Path, action='append', default=[],
                        metavar=('BAG', 'PARAMETERS', 'PAIRS'),
                        help='a recording, its parameter file and a table of true pairs '
                        '(pseudo_truth.csv); may be given several times')


def _run_global_shutter(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments.global_shutter import frame_times, SIZES, write_report
    from rs_relpose_lab.experiments.unrolled_map import map_cases, map_errors
    from rs_relpose_lab.experiments.unrolled_poses import (
        bag_configurations,
        five_point_on_bag,
        five_point_on_recording,
    )

    _check_at_least(int(args.live), args, 'bags')
    _check_at_least(0, args, 'walks')
    if args.live:
        _need_ros('beside')
    args.output.mkdir(parents=True, exist_ok=True)
    speeds = [frame_times(*size) for size in SIZES]
    cases = map_cases(args.walks, args.seed)
    configs = bag_configurations(args.bags, args.seed)
    with progress_bar(len(cases) + len(configs) + len(args.recording), 'recording') as bar:
        maps, bags = [], []
        for case in cases:
            maps.append(map_errors(*case))
            bar.update()
        for bag, parameters, pairs in args.recording:
            bags += five_point_on_recording(bag, parameters, pairs, args.output)
            bar.update()
        for config in configs:
            bags.append(five_point_on_bag(config, args.output / f'seed_{config.seed}'))
            bar.update()
    beside = []
    if args.live:
        from rs_relpose_lab.live.beside import run_beside
        folder = args.output / f'seed_{args.seed}'
        beside = run_beside(folder / 'bag', folder / 'bag.yaml', folder,
                            _shipped('fastdds.xml').resolve())
    return _tell(write_report(args.output, maps, bags, speeds, beside), args.output)


def _odometry_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, '--walks', 10, 'walks of 30 s with standstills and pure rotations')
    _number(parser, '--global-shutter', 4, 'the first ones of these, with a read-out of 0')
    _number(parser, '--in-motion', 4, 'walks of 30 s that never stand')
    _number(parser, '--long', 1, 'walks of 5 min, as the first ones')
    parser.add_argument('--euroc', type=Path, metavar='FOLDER',
                        help='also corners of a real recording, euroc_imu_april_corners')


def _run_odometry(args: argparse.Namespace) -> int:
    from rs_relpose_ros.odometry.library import need_gtsam
    need_gtsam()
    from rs_relpose_lab.experiments.odometry_walks import (
        LONG,
        on_euroc,
        on_walk,
        SHORT,
        walks,
        write_report,
    )
    from rs_relpose_lab.experiments.workers import in_processes

    _check_at_least(0, args, 'walks', 'global_shutter', 'in_motion', 'long')
    count, seed = args.walks, args.seed
    asked = [*walks(count, seed), *walks(args.global_shutter, seed, readout=0.0),
             *walks(args.in_motion, seed + 100, plan=f'walk:{SHORT:g}'),
             *walks(args.long, seed + 200, LONG)]
    if not asked and args.euroc is None:
        raise InputError('there is nothing to measure: give --walks or --euroc')
    args.output.mkdir(parents=True, exist_ok=True)
    paths, report = [], ''
    with progress_bar(len(asked) + (args.euroc is not None), 'recording') as bar:
        if args.euroc is not None:
            paths.append(on_euroc(args.euroc, args.output / 'euroc.png'))
            report = write_report(args.output, paths)
            bar.update()
        for found in in_processes(on_walk, asked, args.jobs):
            paths.append(found)
            # A run that is stopped leaves what it has.
            report = write_report(args.output, paths)
            bar.update()
    return _tell(report, args.output)


def _stretches_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('bags', nargs='+', type=Path, metavar='BAG',
                        help='recordings of one camera with one IMU')
    parser.add_argument('--seconds', type=float, default=4.0, metavar='S',
                        help='length of a part (default: %(default)s)')
    parser.add_argument('--rows', metavar=('FIRST', 'LAST'), type=float, nargs=2,
                        default=(0.0, 0.0), help='use only these image rows')


def _run_calibration_stretches(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments.calibration_stretches import (
        calibrated_parts,
        figures_of,
        read_bag,
        write_report,
    )

    if args.seconds <= 0.0:
        raise InputError(f'--seconds must be positive, got {args.seconds:g}')
    parts = [part for bag in args.bags for part in calibrated_parts(
        bag.name, read_bag(bag, tuple(args.rows)), args.seconds, print)]
    if not parts:
        raise InputError('no part of these bags can be calibrated')
    return _tell(write_report(args.output, figures_of(parts)), args.output)


def _all_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, '--trials', 200, 'problems a cell of the accuracy benchmark')
    _number(parser, '--soak', 100_000, 'see whether memory grows over N estimates')


def _run_all(args: argparse.Namespace) -> int:
    """Each benchmark as its own command line would run it."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    accuracy = ['accuracy', '--trials', str(args.trials), '--jobs', str(args.jobs),
                '--sigma-factor', '1', '0.5', '2', '--output', str(args.output / 'accuracy')]
    speed = ['speed', '--soak', str(args.soak), '--output', str(args.output / 'speed')]
    return max([run(parser.parse_args(words)) for words in (accuracy, speed)])


BENCHMARKS = {
    'accuracy': Benchmark(
        'errors, covariance and lost poses in every cell of the experiment',
        'Errors by those of the oracle, normalised errors and lost poses, over many random '
        'problems (300 matches) in every cell of the experiment.',
        _accuracy_arguments, _run_accuracy, 'accuracy', seed_of='problem of a cell',
        jobs='processes; times are comparable only where each has a core of its own'),
    'speed': Benchmark(
        'time and accuracy beside OpenCV and PoseLib',
        'Time and accuracy of this library, OpenCV (USAC_MAGSAC) and PoseLib on the same '
        'problems, how time grows with matches, and the first estimate of a new process.',
        _speed_arguments, _run_speed, 'speed', seed_of='problem'),
    'live': Benchmark(
        'the node at camera rate: latency, drops, processor time, memory',
        'Plays simulated recordings at 30 Hz to a relpose_node, two processes over Fast DDS. '
        'Needs ROS. A cell is an image size, a format (mono8, bgr8, jpeg) and a rate of the IMU; '
        'each is rendered once into OUTPUT/clips.', _live_arguments, _run_live, 'live'),
    'unseen': Benchmark(
        'the live node on bags that nobody tuned on',
        'Renders bags of other seeds, scenes and read-outs than the demo has, plays each in real '
        'time to a node of its own over Fast DDS, and compares node and OpenCV (at the threshold '
        'that suits it best) with the truth. Needs ROS.',
        lambda parser: _number(parser, '--bags', 10, 'number of bags'), _run_unseen, 'unseen',
        first_seed=201, seed_of='bag'),
    'consistency': Benchmark(
        'whether covariances hold, on simulated bags and on recordings',
        'Squared errors of rotation and direction of translation in units of their covariance '
        '(NEES by degrees of freedom: 1 where it is right), over the pairs of rendered bags of '
        'walks, and over the true pairs of recordings, short and long ones. With --chain: metric '
        'baselines of successive pairs of a recording without truth.',
        _consistency_arguments, _run_consistency, 'consistency', first_seed=401, seed_of='bag'),
    'global-shutter': Benchmark(
        "images turned to their middle row: against the truth, and OpenCV's 5-point on them",
        'Where the map of `rs_relpose unroll` takes pixels from, against a renderer that shares '
        "no code with it, over swings and walks; errors of OpenCV's 5-point on rendered bags and "
        'on recordings, as they were read and turned; processor time of a frame.',
        _global_shutter_arguments, _run_global_shutter, 'global_shutter', first_seed=8101,
        seed_of='recording'),
    'odometry': Benchmark(
        'the metric path of `rs_relpose odometry`, against the truth',
        'Walks (tracks without images, scenes by turns, read-outs of 12 to 35 ms) through the '
        'whole front end and the graph: errors of the path, live and smoothed, of its scale, and '
        'whether its covariances hold. Needs gtsam.', _odometry_arguments, _run_odometry,
        'odometry', first_seed=7101, seed_of='walk', jobs='processes'),
    'calibration': Benchmark(
        '`rs_relpose calibrate` on simulated tracks, against the truth',
        'Errors, sigmas and verdicts of the calibration over many simulated recordings of 300 '
        'frames: read-out time, offset, axes, gyro and motion are drawn, the focal length is '
        'asked for in every other round of the 24 axis maps.',
        lambda parser: _number(parser, '--runs', 240, 'recordings'), _run_calibration,
        'calibration', seed_of='recording', jobs='processes'),
    'calibration-bags': Benchmark(
        '`rs_relpose calibrate` on rendered bags, end to end',
        'Renders bags of walks with other scenes, read-outs, offsets and axes, one of a global '
        'shutter and one whose camera turns about one axis only, and runs the command on each.',
        lambda parser: _number(parser, '--bags', 6, 'bags of a walk'), _run_calibration_bags,
        'calibration_bags', first_seed=301, seed_of='bag'),
    'trust': Benchmark(
        'figures told wrong: which are flagged, and which poses are believed all the same',
        'Runs simulated bags (hand-held and vehicle, three scenes, read-outs of 12 to 35 ms; '
        'tracks without images) and real recordings through the front end, told right and told '
        'wrong in each way of a table, and shows what the health says of it, and errors of the '
        'poses in their own sigmas. docs/lab/trust.md explains the columns.',
        _trust_arguments, _run_trust, 'trust', first_seed=1001, seed_of='bag',
        jobs='processes'),
    'calibration-stretches': Benchmark(
        'whether parts of real recordings agree within the sigmas of `rs_relpose calibrate`',
        'Cuts recordings of one camera into parts, calibrates each from nothing, and prints '
        'chi^2 of every figure over the parts.',
        _stretches_arguments, _run_calibration_stretches, 'calibration_stretches'),
    'all': Benchmark(
        'accuracy and speed, as the project reports them',
        'Both with their defaults, told sigmas also half and twice the true ones, and memory over '
        '100,000 estimates: some hours on one core.',
        _all_arguments, _run_all, 'benchmark', jobs='processes of the accuracy benchmark'),
}
