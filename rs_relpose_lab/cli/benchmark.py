"""``rs_relpose benchmark``: measurements of the package; see benchmarks/README.md."""

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
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

# Summary for the list of commands.
HELP = (
    'Measure the package: the estimator on simulated frame pairs, the live node, the '
    'calibration. Writes tables (CSV, Markdown) into a folder.'
)

_Run = Callable[[argparse.Namespace], int]


class Argument(NamedTuple):
    """An argument, as of `argparse`, and its least value."""

    name: str
    keywords: dict[str, Any]
    low: float | None = None


class Benchmark(NamedTuple):
    """A benchmark; its tables go into ``out/NAME`` unless --output is given."""

    help: str
    arguments: tuple[Argument, ...]
    run: _Run


# Benchmarks by name; `_benchmark` adds them.
BENCHMARKS: dict[str, Benchmark] = {}


def _benchmark(name: str, text: str, *arguments: Argument) -> Callable[[_Run], _Run]:
    """Add a function to the benchmarks."""

    def add(run: _Run) -> _Run:
        BENCHMARKS[name] = Benchmark(text, arguments, run)
        return run

    return add


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benchmarks and their arguments."""
    benchmarks = parser.add_subparsers(dest='benchmark', metavar='BENCHMARK', required=True)
    for name, benchmark in BENCHMARKS.items():
        one = benchmarks.add_parser(name, help=benchmark.help, description=benchmark.help)
        for argument in benchmark.arguments:
            one.add_argument(argument.name, **argument.keywords)
        one.add_argument(
            '--output',
            type=Path,
            default=Path('out', name.replace('-', '_')),
            metavar='DIR',
            help='folder of the tables (default: %(default)s)',
        )


def run(args: argparse.Namespace) -> int:
    """Run the requested benchmark."""
    if args.benchmark != 'live':
        use_one_thread()
    benchmark = BENCHMARKS[args.benchmark]
    for name, _, low in benchmark.arguments:
        value = getattr(args, name.strip('-').replace('-', '_'))
        if low is None or value is None:
            continue
        if (min(value) if isinstance(value, list) else value) < low:
            raise InputError(f'{name} must be at least {low:g}, got {value}')
    return benchmark.run(args)


def matching_cells(patterns: Iterable[str], names: Iterable[str]) -> tuple[str, ...]:
    """Names that match any of the patterns: 'all', or with ``*`` as in file names."""
    names = tuple(names)
    chosen = set[str]()
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


def _report_of(
    items: Sequence[Any],
    work: Callable[[Any], Any],
    report: Callable[[Path, list[Any]], str],
    args: argparse.Namespace,
    unit: str,
) -> int:
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


# -- arguments of several benchmarks ----------------------------------------------------------


def _number(option: str, default: float, text: str, low: float = 0, metavar: str = '') -> Argument:
    """A whole number (N) or seconds (S), as its default, if no other unit is given."""
    return Argument(
        option,
        {
            'type': type(default),
            'default': default,
            'help': f'{text} (default: %(default)s)',
            'metavar': metavar or ('N' if isinstance(default, int) else 'S'),
        },
        low,
    )


def _cells(default: Sequence[str], text: str) -> Argument:
    return Argument(
        '--cells',
        {
            'nargs': '+',
            'default': default,
            'metavar': 'NAME',
            'help': f'cells by name, with * as in file names; {text}',
        },
    )


def _seed(first: int, of: str) -> Argument:
    return _number('--seed', first, f'seed of the first {of}')


def _paths(option: str, metavar: str | tuple[str, ...], text: str, **keywords: Any) -> Argument:
    return Argument(option, {'type': Path, 'metavar': metavar, 'help': text, **keywords})


def _flag(option: str, text: str) -> Argument:
    return Argument(option, {'action': 'store_true', 'help': text})


# Number of processes, for benchmarks whose work can be divided.
_JOBS = _number('--jobs', 1, 'processes', low=1)


def _need_ros() -> None:
    """Report before minutes of rendering that a live benchmark cannot run."""
    try:
        import_module('rs_relpose_lab.live.live_run')
    except ImportError as error:
        raise MissingInputError(
            f'the live benchmark needs ROS 2 (rclpy, Fast DDS): {error}; '
            'source its setup.bash, or use the environment of make'
        ) from error


def _shipped(name: str) -> Path:
    """A file of `config/`: of the checkout, or of the installation."""
    package = Path(__file__).resolve().parent.parent
    checkout = package.parent / 'config' / name
    if checkout.is_file():
        return checkout
    # PREFIX/lib/pythonX/site-packages/PACKAGE, by pip and by colcon.
    return package.parents[3] / 'share' / 'rs_relpose_ros' / 'config' / name


# -- the benchmarks ---------------------------------------------------------------------------


@_benchmark(
    'accuracy',
    'errors, normalised errors and lost poses against an oracle, over many random problems',
    _number('--trials', 200, 'problems a cell', low=1),
    _cells(['all'], 'e.g. "forward-*" (default: all)'),
    Argument(
        '--noise',
        {
            'nargs': '+',
            'choices': ('paper', 'gaussian'),
            'default': ['paper', 'gaussian'],
            'help': 'error of gravity: of fixed size and opposite in the frames, as in the paper '
            '(accuracy), or Gaussian in each frame (covariance) (default: both)',
        },
    ),
    Argument(
        '--sigma-factor',
        {
            'nargs': '+',
            'type': float,
            'default': [1.0],
            'metavar': 'X',
            'help': 'configured sigmas of the estimator by the true ones (default: 1)',
        },
    ),
    Argument(
        '--solver', {'choices': SOLVER_CHOICES, 'default': 'auto', 'help': '(default: auto)'}
    ),
    _paths('--cache', 'DIR', "folder that keeps the oracle's results (default: OUTPUT/oracle)"),
    _seed(0, 'problem of a cell'),
    _number(
        '--jobs', 1, 'processes; times are comparable only where each has its own core', low=1
    ),
)
def _run_accuracy(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import accuracy
    from rs_relpose_lab.experiments.problems import CELLS

    if min(args.sigma_factor) <= 0.0:
        raise InputError(f'--sigma-factor must be positive, got {min(args.sigma_factor)}')
    chosen = accuracy.AccuracyRun(
        matching_cells(args.cells, CELLS),
        tuple(dict.fromkeys(args.noise)),
        tuple(dict.fromkeys(args.sigma_factor)),
        args.trials,
        args.seed,
        args.solver,
    )
    with progress_bar(chosen.estimates, 'estimate') as bar:
        trials = accuracy.run_accuracy(
            chosen, args.cache or args.output / 'oracle', args.jobs, bar.update
        )
    return _print_report(accuracy.write_report(args.output, chosen, trials), args.output)


@_benchmark(
    'speed',
    'time and errors of this library, OpenCV (USAC_MAGSAC) and PoseLib on the same problems, and '
    'growth of time with matches',
    _number('--trials', 50, 'problems a cell', low=1),
    _cells(
        ['*-base', '*-v0-w0', '*-outliers-60'],
        'default: the base cells, cameras at rest, 60 %% outliers',
    ),
    Argument(
        '--matches',
        {
            'nargs': '+',
            'type': int,
            'default': [300, 1000, 3000, 10000],
            'metavar': 'N',
            'help': 'numbers of matches over which time is shown (default: 300 1000 3000 10000)',
        },
        50,
    ),
    _seed(0, 'problem'),
)
def _run_speed(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import speed
    from rs_relpose_lab.experiments.problems import Cell, CELLS

    cells = matching_cells(args.cells, CELLS)
    # Large problems need fewer: their times scatter less.
    few = max(args.trials // 5, 1)
    with progress_bar(len(cells) * args.trials + len(args.matches) * few, 'problem') as bar:
        comparison = [
            timing
            for cell in cells
            for timing in speed.compare(cell, Cell().matches, args.trials, args.seed, bar.update)
        ]
        scaling = [
            timing
            for count in sorted(set(args.matches))
            for timing in speed.compare(cells[0], count, few, args.seed, bar.update)
        ]
    return _print_report(speed.write_report(args.output, comparison, scaling), args.output)


@_benchmark(
    'live',
    'the node at camera rate: latency, drops, processor time, memory. Needs ROS. A cell is an '
    'image size, a format (mono8, bgr8, jpeg) and a rate of the IMU; its clip is rendered once '
    'into OUTPUT/clips',
    _cells(['all'], 'e.g. "640x480-*" or 1280x720-mono8-imu400 (default: all)'),
    # Shorter than one period of the motion, hardly anything is measured.
    _number('--duration', 60.0, 'length of each cell', low=5),
    Argument(
        '--soak',
        {
            'type': float,
            'nargs': '?',
            'const': 10.0,
            'default': 0.0,
            'metavar': 'MINUTES',
            'help': 'play the cells so long instead (default: 10), and show memory and latency '
            'over time, and in the first against the last quarter',
        },
        0,
    ),
    _number('--every', 1, 'send each Nth image of the 30 a second only: 2 is 15 Hz', low=1),
    Argument(
        '--neighbours',
        {
            'type': int,
            'metavar': 'N',
            'help': 'run the node on one core, with so many busy processes of the same priority: '
            '2 leave it a third, as on a small board (default: all cores, no such process)',
        },
        0,
    ),
    _paths(
        '--against',
        'PATH',
        'instead, compare this checkout with the one at PATH by turns in one run: ratios of '
        'latency, processor time, memory and errors',
    ),
)
def _run_live(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import live

    names = matching_cells(args.cells, live.CELLS)
    cells = [live.CELLS[name] for name in names]
    _need_ros()
    load = live.Load(60.0 * args.soak or args.duration, args.every, args.neighbours)
    if args.against is not None:
        if load != live.Load(args.duration):
            raise InputError(
                '--against plays the cells as every release can: without --soak, --every and '
                '--neighbours'
            )
        return _compare_checkouts(names, args)
    results = list(_measured_live(cells, load, args))
    if results:
        _print_report(live.write_report(args.output, results), args.output)
    return int(len(results) < len(cells))


def _measured_live(cells: Sequence[Any], load: Any, args: argparse.Namespace) -> Iterator[Any]:
    """Statistics of each cell that can be measured; the reason of another one is printed."""
    from rs_relpose_lab.experiments import live
    from rs_relpose_lab.experiments.live_clip import FPS, PERIOD, prepare_clip

    sizes = sorted({(cell.width, cell.height) for cell in cells})
    with progress_bar(len(sizes) * round(FPS * PERIOD), 'frame', 'rendering') as bar:
        clips = {size: prepare_clip(args.output / 'clips', *size, bar.update) for size in sizes}
    with progress_bar(round(len(cells) * load.duration), 's') as bar:
        for cell in cells:
            bar.set_description(cell.name)
            folder = args.output / cell.name
            clip = clips[cell.width, cell.height]
            profile = _shipped('fastdds.xml')
            try:
                statistics, course = live.run_cell(cell, clip, load, folder, profile, bar.update)
            except RsRelposeError as error:  # the other cells are still measured
                print(f'{cell.name}: {error}', file=sys.stderr)
                continue
            if args.soak:
                print(live.write_soak_report(folder, statistics, course))
            yield statistics


def _compare_checkouts(names: Sequence[str], args: argparse.Namespace) -> int:
    """Play the cells to this checkout and to the one of ``--against``, by turns."""
    from rs_relpose_lab.experiments import live

    if not (args.against / 'rs_relpose_ros' / 'cli' / 'main.py').is_file():
        raise InputError(
            f'--against {args.against} is no checkout of this package: give the '
            'folder that contains rs_relpose_ros'
        )
    own = Path(__file__).resolve().parents[2]
    with progress_bar(2 * live.TURNS * len(names), 'run') as bar:
        report = live.compare_checkouts(
            own, args.against, names, args.duration, args.output, bar.update
        )
    return _print_report(report, args.output)


@_benchmark(
    'live-cases',
    'faults of drivers and configurations, each with a node of its own: named, or harmless. '
    'Needs ROS',
    _cells(['*'], 'all by default'),
)
def _run_cases(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import live_cases
    from rs_relpose_lab.live.live_cases import CASES

    chosen = [CASES[name] for name in matching_cells(args.cells, CASES)]
    return _report_of(
        chosen,
        lambda case: live_cases.run_case(case, args.output / 'walk'),
        live_cases.write_report,
        args,
        'case',
    )


@_benchmark(
    'consistency',
    'whether covariances hold: squared errors in their units (NEES by degrees of freedom), over '
    'the pairs of rendered walks, and over the true pairs of recordings',
    _number('--bags', 12, 'simulated bags'),
    _number(
        '--exposure',
        0.0,
        'exposure of a row in the simulated bags, as motion blur [ms]',
        metavar='MS',
    ),
    _paths(
        '--recording',
        ('BAG', 'PARAMETERS', 'TRUTH'),
        'a recording, its parameter file and its truth: a table of true pairs (pseudo_truth.csv), '
        'a true path with covariances (global_truth.csv), or the folder of either, the path if '
        'there is one; may be given several times',
        nargs=3,
        action='append',
        default=[],
    ),
    _flag(
        '--compare',
        'on the pairs of the recordings also this package with a readout time of '
        "0, and OpenCV's 5-point (USAC_MAGSAC)",
    ),
    _seed(401, 'bag'),
)
def _run_consistency(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import consistency

    if not args.bags and not args.recording:
        raise InputError('--bags 0 needs a --recording: there is nothing to measure')
    if args.compare and not args.recording:
        raise InputError('--compare needs a --recording')
    args.output.mkdir(parents=True, exist_ok=True)
    on_recording = partial(consistency.on_recording, compare=args.compare)
    chosen = [partial(on_recording, *recording) for recording in args.recording] + [
        partial(
            consistency.on_simulated_bag,
            config,
            args.output / f'seed_{config.seed}_{args.exposure:g}ms',
        )
        for config in consistency.configurations(args.bags, args.seed, 1e-3 * args.exposure)
    ]
    return _report_of(
        chosen, lambda measure: list(measure()), consistency.write_report, args, 'bag'
    )


@_benchmark(
    'carried-over',
    'calibrate a camera on one recording, score the poses of another one: errors, and squared '
    'errors in units of the covariances',
    _paths(
        '--scored',
        ('BAG', 'TRUTH'),
        'the recording that is scored, and its true path (global_truth.csv) or folder',
        nargs=2,
        required=True,
    ),
    _paths(
        '--calibrated',
        'BAG',
        'recordings of the same camera that it is calibrated on, several of them together '
        '(default: the first half of the scored one, whose second half is then scored)',
        nargs='+',
        default=[],
    ),
    _flag('--lens-known', 'keep the lens of the CameraInfo (default: estimate it)'),
)
def _run_carried_over(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import carried_over, consistency

    args.output.mkdir(parents=True, exist_ok=True)
    scored, truth = args.scored
    protocol = carried_over.Protocol(scored, truth, tuple(args.calibrated))

    def measure(one: carried_over.Protocol) -> list[consistency.PairConsistency]:
        return list(carried_over.carried_over(one, args.output, lens_known=args.lens_known))

    return _report_of([protocol], measure, consistency.write_report, args, 'recording')


@_benchmark(
    'field',
    'situations that users report (clocks that step, cropped images, repeated frames, vibration '
    '...), rebuilt from simulated recordings: check, calibrate, replay and odometry on each, and '
    'the verdict from the truth',
    Argument(
        '--only',
        {
            'nargs': '+',
            'metavar': 'ID',
            'help': 'some of them, with all their variants: G8 is G8-left and G8-bottom '
            '(default: all; with --live C1, C12, G8, O1 and O3)',
        },
    ),
    _flag(
        '--live',
        'in place of the commands play each to a running relpose_node and odometry_node, and '
        'compare what they publish. Needs ROS',
    ),
    _JOBS,
)
def _run_field(args: argparse.Namespace) -> int:
    from rs_relpose_lab.field.cases import BY_NAME, LIVE, with_variants
    from rs_relpose_lab.field.run import prepare_bases, report, run_case, Task

    if args.live:
        _need_ros()
    names = args.only or (LIVE if args.live else ['all'])
    chosen = matching_cells(with_variants(names), BY_NAME)
    args.output.mkdir(parents=True, exist_ok=True)
    tasks = [Task(name, args.output, args.live) for name in chosen]
    if args.jobs > 1:
        prepare_bases(tasks)
    return _report_of(tasks, run_case, report, args, 'case')


@_benchmark(
    'global-shutter',
    "images derotated to their middle row: against a renderer's truth, OpenCV's 5-point on raw "
    'and derotated images, processor time of a frame',
    _number('--walks', 6, 'walks of 2 s on which the map is compared with the truth'),
    _number('--bags', 6, "rendered bags for OpenCV's 5-point"),
    _seed(8101, 'recording'),
)
def _run_global_shutter(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import global_shutter

    args.output.mkdir(parents=True, exist_ok=True)
    speeds = [global_shutter.frame_times(*size) for size in global_shutter.SIZES]
    cases = global_shutter.map_cases(args.walks, args.seed)
    configs = global_shutter.bag_configurations(args.bags, args.seed)
    with progress_bar(len(cases) + len(configs), 'recording') as bar:
        maps = []
        bags = []
        for case in cases:
            maps.append(global_shutter.map_errors(*case))
            bar.update()
        for config in configs:
            bags.append(
                global_shutter.five_point_on_bag(config, args.output / f'seed_{config.seed}')
            )
            bar.update()
    return _print_report(global_shutter.write_report(args.output, maps, bags, speeds), args.output)


@_benchmark(
    'odometry',
    'the metric path of `rs_relpose odometry` against the truth, live and smoothed, over walks '
    '(tracks without images, readouts of 12 to 35 ms). Needs gtsam',
    _number('--walks', 10, 'walks of 30 s with standstills and pure rotations'),
    _number('--global-shutter', 4, 'the first ones of these, with a readout of 0'),
    _number('--in-motion', 4, 'walks of 30 s without standstill'),
    _number('--long', 1, 'walks of 5 min, as the first ones'),
    _paths('--euroc', 'FOLDER', 'also corners of a real recording, euroc_imu_april_corners'),
    _number('--disturbances', 0, 'instead, walks with each disturbance'),
    _number('--loops', 0, 'instead, closed walks of 60 s, with and without loop closures'),
    _paths(
        '--recordings',
        'BAG',
        'instead, bags with the right parameters next to them (BAG.yaml), whole and in parts',
        nargs='+',
    ),
    _number('--part', 4.5, 'length of a part of these'),
    _seed(7101, 'walk'),
    _JOBS,
)
def _run_odometry(args: argparse.Namespace) -> int:
    from rs_relpose_ros.odometry import need_gtsam

    need_gtsam()
    from rs_relpose_lab.experiments import (
        odometry_disturbances,
        odometry_loops,
        odometry_recordings,
    )

    if args.recordings:
        return _report_of(
            args.recordings,
            lambda bag: list(odometry_recordings.on_recording(bag, args.part)),
            odometry_recordings.write_report,
            args,
            'bag',
        )
    if args.disturbances:
        return _report_of(
            odometry_disturbances.tasks(args.disturbances, args.seed),
            odometry_disturbances.measure,
            odometry_disturbances.write_report,
            args,
            'walk',
        )
    if args.loops:
        return _report_of(
            [args.seed + k for k in range(args.loops)],
            odometry_loops.on_seed,
            odometry_loops.write_report,
            args,
            'walk',
        )
    return _run_walks(args)


def _run_walks(args: argparse.Namespace) -> int:
    """Undisturbed walks, and the corners of EuRoC."""
    from rs_relpose_lab.experiments import odometry

    walks = odometry.walks
    seed = args.seed
    chosen = [
        *walks(args.walks, seed),
        *walks(args.global_shutter, seed, readout=0.0),
        *walks(args.in_motion, seed + 100, plan=f'walk:{odometry.SHORT:g}'),
        *walks(args.long, seed + 200, odometry.LONG),
    ]
    if not chosen and args.euroc is None:
        raise InputError('there is nothing to measure: give --walks or --euroc')
    args.output.mkdir(parents=True, exist_ok=True)
    known = []
    if args.euroc is not None:
        known.append(odometry.on_euroc(args.euroc, args.output / 'euroc.png'))
    if not chosen:
        return _print_report(odometry.write_report(args.output, known), args.output)
    return _report_of(
        chosen,
        odometry.on_walk,
        lambda folder, paths: odometry.write_report(folder, [*known, *paths]),
        args,
        'recording',
    )


@_benchmark(
    'reconstruction',
    'poses of rows, as exported by `rs_relpose export`, against the truth, and frames rendered '
    'with them. Needs gtsam',
    _number('--walks', 6, 'walks with standstills and pure rotations'),
    _number('--seconds', 20.0, 'of each'),
    _seed(9101, 'walk'),
    _JOBS,
)
def _run_reconstruction(args: argparse.Namespace) -> int:
    from rs_relpose_ros.odometry import need_gtsam

    need_gtsam()
    from rs_relpose_lab.experiments import odometry, reconstruction

    return _report_of(
        odometry.walks(args.walks, args.seed, args.seconds),
        reconstruction.on_walk,
        reconstruction.write_report,
        args,
        'walk',
    )


@_benchmark(
    'calibration-lenses',
    '`rs_relpose calibrate` on rendered bags, of unknown lenses if not --known, and the poses of '
    'another bag of each camera with its file against those with the true calibration',
    _number('--bags', 10, 'bags, each with a lens of its own', low=1),
    _number('--seconds', 20.0, 'length of a bag'),
    Argument(
        '--model',
        {
            'choices': ('plumb_bob', 'equidistant'),
            'default': 'plumb_bob',
            'help': 'distortion model (default: %(default)s)',
        },
    ),
    _flag(
        '--live',
        'calibrate as a running node does, from the first seconds that suffice (plumb_bob)',
    ),
    _flag('--known', 'bags with a CameraInfo that has the lens'),
    _seed(601, 'bag'),
)
def _run_lenses(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import lenses

    return _report_of(
        range(args.seed, args.seed + args.bags),
        lambda seed: lenses.on_lens(
            seed,
            args.model,
            args.seconds,
            args.output
            / '_'.join(['known'] * args.known + [args.model, str(seed), f'{args.seconds:g}s']),
            live=args.live,
            known=args.known,
        ),
        lenses.write_report,
        args,
        'bag',
    )


@_benchmark(
    'calibration-stretches',
    'whether parts of real recordings agree within the sigmas of `rs_relpose calibrate`: chi^2 of '
    'every quantity over the parts',
    _paths('bags', 'BAG', 'recordings of one camera with one IMU', nargs='+'),
    _number('--seconds', 4.0, 'length of a part', low=0.1),
    Argument(
        '--rows',
        {
            'metavar': ('FIRST', 'LAST'),
            'type': float,
            'nargs': 2,
            'default': (0.0, 0.0),
            'help': 'use only these image rows',
        },
    ),
)
def _run_calibration_stretches(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import calibration

    parts = [
        part
        for bag in args.bags
        for part in calibration.calibrated_parts(
            bag.name, calibration.read_bag(bag, tuple(args.rows)), args.seconds, print
        )
    ]
    if not parts:
        raise InputError('no part of these bags can be calibrated')
    return _print_report(
        calibration.write_parts_report(args.output, calibration.quantities_of(parts)), args.output
    )


@_benchmark(
    'trust',
    'wrong configurations: which the consistency monitor flags, and errors of the published '
    'poses, over simulated bags (tracks without images) and recordings; docs/lab/trust.md',
    _number('--bags', 20, 'simulated bags, each with all rows'),
    Argument(
        '--rows',
        {
            'nargs': '+',
            'default': ['all'],
            'metavar': 'NAME',
            'help': 'wrong configurations, with '
            '* as in file names, e.g. "readout-*" (default: all)',
        },
    ),
    # A shorter bag has not enough information for gross errors.
    _number('--seconds', 30.0, 'length of a simulated bag', low=6),
    _number(
        '--right',
        0,
        'further bags with the right configuration, for false alarms: noise at '
        'the configured level, half of it and twice',
    ),
    _number('--rendered', 0, 'bags with images: the first ones of the others, rendered'),
    _paths(
        '--recordings',
        'PATH',
        'bags with the right parameters next to them (BAG.yaml)',
        nargs='+',
        default=[],
    ),
    _seed(1001, 'bag'),
    _JOBS,
)
def _run_trust(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import trust
    from rs_relpose_lab.experiments.trust_rows import ROWS

    chosen = trust.tasks(
        matching_cells(args.rows, ROWS),
        args.bags,
        args.seconds,
        args.seed,
        right=args.right,
        rendered=args.rendered,
        recordings=args.recordings,
    )
    if not chosen:
        raise InputError(
            'there is nothing to measure: give --bags, --right, --rendered or --recordings'
        )
    return _report_of(chosen, trust.measure, trust.write_report, args, 'recording')


@_benchmark(
    'suggestions',
    'one wrong parameter at a time on recordings: which the consistency monitor names, and errors '
    'of its suggested values; docs/lab/trust.md',
    _paths(
        '--recording',
        ('BAG', 'PARAMETERS'),
        'a recording and its right parameter file; may be given several times',
        nargs=2,
        action='append',
        required=True,
    ),
)
def _run_suggestions(args: argparse.Namespace) -> int:
    from rs_relpose_lab.experiments import suggestions

    return _report_of(
        args.recording,
        lambda one: suggestions.on_recording(*one),
        suggestions.write_report,
        args,
        'recording',
    )
