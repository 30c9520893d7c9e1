"""``rs_relpose benchmark``: measurements of the package; see benchmarks/README.md."""

import argparse
from collections.abc import Callable, Iterable, Sequence
from fnmatch import fnmatchcase
from functools import partial
from importlib import import_module
from pathlib import Path
import sys
from typing import Any, NamedTuple

from rs_relpose_lab.experiments.harness import in_processes, use_one_thread
from rs_relpose_ros.cli.options import progress_bar
from rs_relpose_ros.config.settings import SOLVER_CHOICES
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError

HELP = ('Measure the package: the estimator on simulated frame pairs, the live node, the '
        'calibration. Writes tables (CSV, Markdown) into a folder.')


class Benchmark(NamedTuple):
    """A benchmark; `seed_of`, `jobs`: help of its options of these names, '' without them."""

    help: str
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
        one = benchmarks.add_parser(name, help=benchmark.help, description=benchmark.help)
        benchmark.add_arguments(one)
        if benchmark.seed_of:
            _number(one, '--seed', benchmark.first_seed, f'seed of the first {benchmark.seed_of}')
        if benchmark.jobs:
            _number(one, '--jobs', 1, benchmark.jobs)
        one.add_argument('--output', type=Path, default=Path('out', benchmark.folder),
                         metavar='DIR', help='folder of the tables (default: %(default)s)')


def run(args: argparse.Namespace) -> int:
    """Run the requested benchmark."""
    if args.benchmark != 'live':
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


def _print_report(report: str, folder: Path) -> int:
    print(report)
    print(f'written to {folder}')
    return 0


def _report_of(items: Sequence[Any], work: Callable[[Any], Any],
               report: Callable[[Path, list[Any]], str], args: argparse.Namespace,
               unit: str) -> int:
    """Work on each item, and report all results so far: an interrupted run leaves a report.

    A list that `work` returns is several results.
    """
    found: list[Any] = []
    text = ''
    with progress_bar(len(items), unit) as bar:
        for result in in_processes(work, items, getattr(args, 'jobs', 1)):
            found += result if isinstance(result, list) else [result]
            if found:
                text = report(args.output, found)
            bar.update()
    if not found:
        raise InputError('there is no result: nothing could be compared with the truth')
    return _print_report(text, args.output)


# -- options of several benchmarks ------------------------------------------------------------

def _number(parser: argparse.ArgumentParser, option: str, default: float, text: str) -> None:
    """Declare an option that is a whole number (N) or seconds (S), as its default."""
    parser.add_argument(option, type=type(default), default=default,
                        metavar='N' if isinstance(default, int) else 'S',
                        help=f'{text} (default: %(default)s)')


def _cells(parser: argparse.ArgumentParser, default: list[str], text: str) -> None:
    parser.add_argument('--cells', nargs='+', default=default, metavar='NAME',
                        help=f'cells by name, with * as in file names; {text}')


def _need_ros() -> None:
    """Report before minutes of rendering that a live benchmark cannot run."""
    try:
        import_module('rs_relpose_lab.live.live_run')
    except ImportError as error:
        raise MissingInputError(f'the live benchmark needs ROS 2 (rclpy, Fast DDS): {error}; '
                                'source its setup.bash, or use the environment of make') from error


def _shipped(name: str) -> Path:
    """A file of `config/`: of the checkout, or of the installation."""
    package = Path(__file__).resolve().parent.parent
    checkout = package.parent / 'config' / name
    if checkout.is_file():
        return checkout
    # PREFIX/lib/pythonX/site-packages/PACKAGE, by pip and by colcon.
    return package.parents[3] / 'share' / 'rs_relpose_ros' / 'config' / name


# -- the benchmarks ---------------------------------------------------------------------------

def _accuracy_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, '--trials', 200, 'problems a cell')
    _cells(parser, ['all'], 'e.g. "forward-*" (default: all)')
    parser.add_argument('--noise', nargs='+', choices=('paper', 'gaussian'),
                        default=['paper', 'gaussian'],
                        help='error of gravity: of fixed size and opposite in the frames, as in '
                             'the paper (accuracy), or Gaussian in each frame (covariance) '
                             '(default: both)')
    parser.add_argument('--sigma-factor', nargs='+', type=float, default=[1.0], metavar='X',
                        help='configured sigmas of the estimator by the true ones (default: 1)')
    parser.add_argument('--solver', choices=SOLVER_CHOICES, default='auto', help='(default: auto)')
    parser.add_argument('--cache', type=Path, metavar='DIR',
                        help="folder that keeps the oracle's results (default: OUTPUT/oracle)")


def _run_accuracy(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import accuracy
    from rs_relpose_lab.experiments.problems import CELLS
    _check_at_least(1, args, 'trials')
    if min(args.sigma_factor) <= 0.0:
        raise InputError(f'--sigma-factor must be positive, got {min(args.sigma_factor)}')
    chosen = accuracy.AccuracyRun(
        matching_cells(args.cells, CELLS), tuple(dict.fromkeys(args.noise)),
        tuple(dict.fromkeys(args.sigma_factor)), args.trials, args.seed, args.solver)
    with progress_bar(chosen.estimates, 'estimate') as bar:
        trials = accuracy.run_accuracy(
            chosen, accuracy.OracleCache(args.cache or args.output / 'oracle'), args.jobs,
            bar.update)
    return _print_report(accuracy.write_report(args.output, chosen, trials), args.output)


def _speed_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, '--trials', 50, 'problems a cell')
    _cells(parser, ['*-base', '*-v0-w0', '*-outliers-60'],
           'default: the base cells, cameras at rest, 60 %% outliers')
    parser.add_argument('--matches', nargs='+', type=int, default=[300, 1000, 3000, 10000],
                        metavar='N', help='numbers of matches over which time is shown (default: '
                        '300 1000 3000 10000)')
    _number(parser, '--repeats', 3, 'the shortest of so many repeats counts')


def _run_speed(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import speed
    from rs_relpose_lab.experiments.problems import Cell, CELLS
    _check_at_least(1, args, 'trials', 'repeats')
    _check_at_least(50, args, 'matches')
    cells = matching_cells(args.cells, CELLS)
    # Large problems need fewer: their times scatter less.
    few = max(args.trials // 5, 1)
    with progress_bar(len(cells) * args.trials + len(args.matches) * few, 'problem') as bar:
        comparison = [timing for cell in cells for timing in speed.compare(
            cell, Cell().matches, args.trials, args.repeats, args.seed, bar.update)]
        scaling = [timing for count in sorted(set(args.matches)) for timing in speed.compare(
            cells[0], count, few, args.repeats, args.seed, bar.update)]
    return _print_report(speed.write_report(args.output, comparison, scaling), args.output)


def _live_arguments(parser: argparse.ArgumentParser) -> None:
    _cells(parser, ['all'], 'e.g. "640x480-*" or 1280x720-mono8-imu400 (default: all)')
    _number(parser, '--duration', 60.0, 'length of each cell')
    parser.add_argument('--soak', type=float, nargs='?', const=10.0, default=0.0,
                        metavar='MINUTES',
                        help='play the cells so long instead (default: 10), and show memory and '
                             'latency over time')
    parser.add_argument('--profile', type=Path, metavar='FILE',
                        help='Fast DDS profile for images above 512 KB (default: the shipped '
                             'config/fastdds.xml)')
    parser.add_argument('--against', type=Path, metavar='PATH',
                        help='instead, compare this checkout with the one at PATH by turns in '
                             'one run: ratios of latency, processor time, memory and errors')
    _number(parser, '--turns', 3, 'turns of --against')


def _run_live(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import live
    from rs_relpose_lab.experiments.live_clip import FPS, PERIOD, prepare_clip
    # Shorter than one period of the motion, hardly anything is measured.
    _check_at_least(5, args, 'duration')
    _check_at_least(0, args, 'soak')
    cells = [live.CELLS[name] for name in matching_cells(args.cells, live.CELLS)]
    _need_ros()
    if args.against is not None:
        return _compare_live(args, [cell.name for cell in cells])
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
                statistics, course = live.run_cell(
                    cell, clips[cell.width, cell.height], duration, args.output / cell.name,
                    profile.resolve(), bar.update)
            except RsRelposeError as error:   # the other cells are still measured
                failed = True
                print(f'{cell.name}: {error}', file=sys.stderr)
                continue
            results.append(statistics)
            if args.soak:
                print(live.write_soak_report(args.output / cell.name, statistics, course))
    if results:
        _print_report(live.write_report(args.output, results), args.output)
    return int(failed)


def _run_cases(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import live_cases
    from rs_relpose_lab.live.live_cases import CASES
    chosen = [CASES[name] for name in matching_cells(args.cells, CASES)]
    return _report_of(chosen, lambda case: live_cases.run_case(case, args.output / 'walk'),
                      live_cases.write_report, args, 'case')


def _compare_live(args: argparse.Namespace, cells: Sequence[str]) -> int:
    from rs_relpose_lab.experiments import live
    _check_at_least(1, args, 'turns')
    if not (args.against / 'rs_relpose_ros' / 'cli' / 'main.py').is_file():
        raise InputError(f'--against {args.against} is no checkout of this package: give the '
                         'folder that contains rs_relpose_ros')
    profile = [] if args.profile is None else ['--profile', str(args.profile.resolve())]
    with progress_bar(2 * args.turns * len(cells), 'run') as bar:
        return _print_report(live.compare_checkouts(
            Path(__file__).resolve().parents[2], args.against, cells,
            ['--duration', str(args.duration), *profile], args.turns, args.output, bar.update),
            args.output)


def _consistency_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, '--bags', 12, 'simulated bags')
    parser.add_argument('--exposure', type=float, default=0.0, metavar='MS',
                        help='exposure of a row in the simulated bags, as motion blur [ms] '
                        '(default: %(default)s)')
    parser.add_argument('--recording', nargs=3, type=Path, action='append', default=[],
                        metavar=('BAG', 'PARAMETERS', 'PAIRS'),
                        help='a recording, its parameter file and a table of true pairs '
                        '(pseudo_truth.csv); may be given several times')
    parser.add_argument('--compare', action='store_true',
                        help='on the pairs of the recordings also this package with a readout '
                        "time of 0, and OpenCV's 5-point (USAC_MAGSAC)")


def _run_consistency(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import consistency
    _check_at_least(0, args, 'bags')
    if not args.bags and not args.recording:
        raise InputError('--bags 0 needs a --recording: there is nothing to measure')
    if args.compare and not args.recording:
        raise InputError('--compare needs a --recording')
    args.output.mkdir(parents=True, exist_ok=True)
    on_recording = partial(consistency.on_recording, compare=args.compare)
    chosen = [partial(on_recording, *recording) for recording in args.recording] + [
        partial(consistency.on_simulated_bag, config,
                args.output / f'seed_{config.seed}_{args.exposure:g}ms')
        for config in consistency.configurations(args.bags, args.seed, 1e-3 * args.exposure)]
    return _report_of(chosen, lambda measure: list(measure()), consistency.write_report, args,
                      'bag')


def _lenses_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, '--bags', 10, 'bags, each with a lens of its own')
    _number(parser, '--seconds', 20.0, 'length of a bag')
    parser.add_argument('--model', choices=('plumb_bob', 'equidistant'), default='plumb_bob',
                        help='distortion model (default: %(default)s)')
    parser.add_argument('--live', action='store_true',
                        help='calibrate as a running node does, from the first seconds that '
                             'suffice (plumb_bob)')
    parser.add_argument('--known', action='store_true',
                        help='bags with a CameraInfo that has the lens')


def _run_lenses(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import lenses
    _check_at_least(1, args, 'bags')
    return _report_of(
        range(args.seed, args.seed + args.bags),
        lambda seed: lenses.on_lens(
            seed, args.model, args.seconds, args.output / '_'.join(
                ['known'] * args.known + [args.model, str(seed), f'{args.seconds:g}s']),
            live=args.live, known=args.known),
        lenses.write_report, args, 'bag')


def _stretches_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('bags', nargs='+', type=Path, metavar='BAG',
                        help='recordings of one camera with one IMU')
    _number(parser, '--seconds', 4.0, 'length of a part')
    parser.add_argument('--rows', metavar=('FIRST', 'LAST'), type=float, nargs=2,
                        default=(0.0, 0.0), help='use only these image rows')


def _run_calibration_stretches(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import calibration
    if args.seconds <= 0.0:
        raise InputError(f'--seconds must be positive, got {args.seconds:g}')
    parts = [part for bag in args.bags for part in calibration.calibrated_parts(
        bag.name, calibration.read_bag(bag, tuple(args.rows)), args.seconds, print)]
    if not parts:
        raise InputError('no part of these bags can be calibrated')
    return _print_report(calibration.write_parts_report(
        args.output, calibration.quantities_of(parts)), args.output)


def _trust_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, '--bags', 20, 'simulated bags, each with all rows')
    parser.add_argument('--rows', nargs='+', default=['all'], metavar='NAME',
                        help='wrong configurations, with * as in file names, e.g. "readout-*" '
                             '(default: all)')
    _number(parser, '--seconds', 30.0, 'length of a simulated bag')
    _number(parser, '--right', 0, 'further bags with the right configuration, for false alarms: '
                                  'noise at the configured level, half of it and twice')
    _number(parser, '--rendered', 0, 'bags with images: the first ones of the others, rendered')
    parser.add_argument('--recordings', type=Path, nargs='+', default=[], metavar='PATH',
                        help='bags with the right parameters next to them (BAG.yaml)')


def _run_trust(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import trust
    from rs_relpose_lab.experiments.trust_rows import ROWS
    _check_at_least(0, args, 'bags', 'right', 'rendered')
    # A shorter bag has not enough information for gross errors.
    _check_at_least(6, args, 'seconds')
    chosen = trust.tasks(matching_cells(args.rows, ROWS), args.bags, args.seconds, args.seed,
                         right=args.right, rendered=args.rendered, recordings=args.recordings)
    if not chosen:
        raise InputError('there is nothing to measure: give --bags, --right, --rendered or '
                         '--recordings')
    return _report_of(chosen, trust.measure, trust.write_report, args, 'recording')


def _suggestions_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--recording', nargs=2, type=Path, action='append', required=True,
                        metavar=('BAG', 'PARAMETERS'), help='a recording and its right parameter '
                        'file; may be given several times')


def _run_suggestions(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import suggestions
    return _report_of(args.recording, lambda one: suggestions.on_recording(*one),
                      suggestions.write_report, args, 'recording')


def _global_shutter_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, '--walks', 6, 'walks of 2 s on which the map is compared with the truth')
    _number(parser, '--bags', 6, "rendered bags for OpenCV's 5-point")


def _run_global_shutter(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import global_shutter
    _check_at_least(0, args, 'bags', 'walks')
    args.output.mkdir(parents=True, exist_ok=True)
    speeds = [global_shutter.frame_times(*size) for size in global_shutter.SIZES]
    cases = global_shutter.map_cases(args.walks, args.seed)
    configs = global_shutter.bag_configurations(args.bags, args.seed)
    with progress_bar(len(cases) + len(configs), 'recording') as bar:
        maps, bags = [], []
        for case in cases:
            maps.append(global_shutter.map_errors(*case))
            bar.update()
        for config in configs:
            bags.append(global_shutter.five_point_on_bag(
                config, args.output / f'seed_{config.seed}'))
            bar.update()
    return _print_report(global_shutter.write_report(args.output, maps, bags, speeds), args.output)


def _odometry_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, '--walks', 10, 'walks of 30 s with standstills and pure rotations')
    _number(parser, '--global-shutter', 4, 'the first ones of these, with a readout of 0')
    _number(parser, '--in-motion', 4, 'walks of 30 s without standstill')
    _number(parser, '--long', 1, 'walks of 5 min, as the first ones')
    parser.add_argument('--euroc', type=Path, metavar='FOLDER',
                        help='also corners of a real recording, euroc_imu_april_corners')
    _number(parser, '--disturbances', 0, 'instead, walks with each disturbance')
    parser.add_argument('--disturbance', metavar='NAME', help='only this one: "object, 3 s"')
    _number(parser, '--loops', 0, 'instead, closed walks of 60 s, with and without loop closures')
    parser.add_argument('--recordings', type=Path, nargs='+', metavar='BAG',
                        help='instead, bags with the right parameters next to them (BAG.yaml), '
                             'whole and in parts')
    _number(parser, '--part', 4.5, 'length of a part of these')


def _run_odometry(args: argparse.Namespace) -> int:
    from rs_relpose_ros.odometry import need_gtsam
    need_gtsam()
    from rs_relpose_lab.experiments import (
        odometry,
        odometry_disturbances,
        odometry_loops,
        odometry_recordings,
    )
    if args.recordings:
        return _report_of(
            args.recordings, lambda bag: list(odometry_recordings.on_recording(bag, args.part)),
            odometry_recordings.write_report, args, 'bag')
    if args.disturbances:
        return _report_of(odometry_disturbances.tasks(args.disturbances, args.seed,
                                                      args.disturbance),
                          odometry_disturbances.measure, odometry_disturbances.write_report,
                          args, 'walk')
    if args.loops:
        return _report_of([args.seed + k for k in range(args.loops)], odometry_loops.on_seed,
                          odometry_loops.write_report, args, 'walk')
    _check_at_least(0, args, 'walks', 'global_shutter', 'in_motion', 'long')
    walks, seed = odometry.walks, args.seed
    chosen = [*walks(args.walks, seed), *walks(args.global_shutter, seed, readout=0.0),
              *walks(args.in_motion, seed + 100, plan=f'walk:{odometry.SHORT:g}'),
              *walks(args.long, seed + 200, odometry.LONG)]
    if not chosen and args.euroc is None:
        raise InputError('there is nothing to measure: give --walks or --euroc')
    args.output.mkdir(parents=True, exist_ok=True)
    known = [] if args.euroc is None else [
        odometry.on_euroc(args.euroc, args.output / 'euroc.png')]
    if not chosen:
        return _print_report(odometry.write_report(args.output, known), args.output)
    return _report_of(chosen, odometry.on_walk, lambda folder, paths: odometry.write_report(
        folder, [*known, *paths]), args, 'recording')


def _reconstruction_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, '--walks', 6, 'walks with standstills and pure rotations')
    parser.add_argument('--seconds', type=float, default=20.0, help='of each (default: 20)')


def _run_reconstruction(args: argparse.Namespace) -> int:
    from rs_relpose_ros.odometry import need_gtsam
    need_gtsam()
    from rs_relpose_lab.experiments import odometry, reconstruction
    return _report_of(odometry.walks(args.walks, args.seed, args.seconds), reconstruction.on_walk,
                      reconstruction.write_report, args, 'walk')


BENCHMARKS = {
    'accuracy': Benchmark(
        'errors, normalised errors and lost poses against an oracle, over many random problems',
        _accuracy_arguments, _run_accuracy, 'accuracy', seed_of='problem of a cell',
        jobs='processes; times are comparable only where each has its own core'),
    'speed': Benchmark(
        'time and errors of this library, OpenCV (USAC_MAGSAC) and PoseLib on the same problems, '
        'and growth of time with matches',
        _speed_arguments, _run_speed, 'speed', seed_of='problem'),
    'live': Benchmark(
        'the node at camera rate: latency, drops, processor time, memory. Needs ROS. A cell is an '
        'image size, a format (mono8, bgr8, jpeg) and a rate of the IMU; its clip is rendered '
        'once into OUTPUT/clips', _live_arguments, _run_live, 'live'),
    'live-cases': Benchmark(
        'faults of drivers and configurations, each with a node of its own: named, or harmless. '
        'Needs ROS', partial(_cells, default=['*'], text='all by default'), _run_cases,
        'live_cases'),
    'consistency': Benchmark(
        'whether covariances hold: squared errors in their units (NEES by degrees of freedom), '
        'over the pairs of rendered walks, and over the true pairs of recordings',
        _consistency_arguments, _run_consistency, 'consistency', first_seed=401, seed_of='bag'),
    'global-shutter': Benchmark(
        "images derotated to their middle row: against a renderer's truth, OpenCV's 5-point on "
        'raw and derotated images, processor time of a frame',
        _global_shutter_arguments, _run_global_shutter, 'global_shutter', first_seed=8101,
        seed_of='recording'),
    'odometry': Benchmark(
        'the metric path of `rs_relpose odometry` against the truth, live and smoothed, over '
        'walks (tracks without images, readouts of 12 to 35 ms). Needs gtsam',
        _odometry_arguments, _run_odometry, 'odometry', first_seed=7101, seed_of='walk',
        jobs='processes'),
    'reconstruction': Benchmark(
        'poses of rows, as exported by `rs_relpose export`, against the truth, and frames '
        'rendered with them. Needs gtsam', _reconstruction_arguments, _run_reconstruction,
        'reconstruction', first_seed=9101, seed_of='walk', jobs='processes'),
    'calibration-lenses': Benchmark(
        '`rs_relpose calibrate` on rendered bags, of unknown lenses if not --known, and the '
        'poses with its file against those with the true calibration',
        _lenses_arguments, _run_lenses, 'calibration_lenses', first_seed=601, seed_of='bag'),
    'calibration-stretches': Benchmark(
        'whether parts of real recordings agree within the sigmas of `rs_relpose calibrate`: '
        'chi^2 of every quantity over the parts',
        _stretches_arguments, _run_calibration_stretches, 'calibration_stretches'),
    'trust': Benchmark(
        'wrong configurations: which the consistency monitor flags, and errors of the published '
        'poses, over simulated bags (tracks without images) and recordings; docs/lab/trust.md',
        _trust_arguments, _run_trust, 'trust', first_seed=1001, seed_of='bag', jobs='processes'),
    'suggestions': Benchmark(
        'one wrong parameter at a time on recordings: which the consistency monitor names, and '
        'errors of its suggested values; docs/lab/trust.md',
        _suggestions_arguments, _run_suggestions, 'suggestions'),
}
