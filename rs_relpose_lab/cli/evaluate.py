"""``rs_relpose evaluate``: the experiments of the paper."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
import dataclasses
import json
from pathlib import Path
import platform
import sys
from typing import Any

from rs_relpose_lab.experiments import boxes
from rs_relpose_lab.experiments.methods import METHODS
from rs_relpose_lab.experiments.paper import (
    EXACT,
    METHODS_OF_THE_PAPER,
    PaperRun,
    run_paper,
    Sweep,
    SWEEPS,
)
from rs_relpose_lab.experiments.penncosyvio import (
    EXPERIMENT,
    GOPRO_READOUT,
    METHODS_OF_THE_EXPERIMENT,
    PairSource,
    PennCosyvioRun,
    RecordedSequence,
    run_penncosyvio,
    STRETCHES,
)
from rs_relpose_lab.experiments.penncosyvio_files import CAMERAS, GOPROS, IMUS
from rs_relpose_lab.experiments.penncosyvio_simulated import Simulated, SimulatedSequence
from rs_relpose_lab.experiments.problems import BASELINES
from rs_relpose_lab.simulation.scene import SCENES
from rs_relpose_ros.cli.options import package_version, progress_bar
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.geometry.camera import REFERENCE_ROWS

HELP = 'Run an experiment of the paper again: tables (printed and CSV), box plots (PNG).'

_PAPER_HELP = (
    'The synthetic experiments of the paper, one figure each: two 1920x1080 rolling-shutter '
    'images (60 us per row) of 300 points, seen exactly row by row, 2 m apart in forward or '
    'sideways motion, opposite velocities in the two frames. Writes trials.csv (every estimate), '
    'cells.csv (every box), a picture for each figure, and run.json. The same arguments give the '
    'same errors, with any number of jobs.')

_PENNCOSYVIO_HELP = (
    "The paper's experiment on the data set PennCOSYVIO: of eight stretches of the sequences 'as' "
    "and 'af', every fifth frame and the one 30 frames later, SIFT matches, IMU averaged over "
    '0.1 s. FOLDER is a checkout of github.com/daniilidis-group/penncosyvio with the sensors '
    'downloaded and the frames extracted by its own scripts. With --trajectory-only its images '
    'and IMU are not needed: points, or rendered images, and the IMU are simulated on the '
    'ground-truth trajectories. Writes the same files as evaluate paper.')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of both experiments."""
    experiments = parser.add_subparsers(dest='experiment', metavar='EXPERIMENT', required=True)
    paper = experiments.add_parser('paper', help='the synthetic experiments',
                                   description=_PAPER_HELP)
    _add_common(paper, METHODS_OF_THE_PAPER, [name for name, method in METHODS.items()
                                       if not method.continuous_gyro])
    paper.add_argument('--trials', type=int, default=100, metavar='N',
                       help='scenes of each level of each motion (default: 100, as in the paper)')
    paper.add_argument('--figures', nargs='+', choices=SWEEPS, metavar='FIGURE',
                       default=[sweep.name for sweep in SWEEPS.values() if sweep.in_paper],
                       help=f'any of {", ".join(SWEEPS)} (default: those of the paper, all '
                       'but the last)')
    paper.add_argument('--motions', nargs='+', choices=BASELINES, default=list(BASELINES),
                       metavar='MOTION', help=f'any of {", ".join(BASELINES)} (default: both)')
    paper.add_argument('--jobs', type=int, default=1, metavar='N',
                       help='processes to run in (default: 1)')
    noise = paper.add_argument_group(
        'noise', 'in the figures that do not vary it; the paper names none, so the defaults are 0')
    noise.add_argument('--pixel-noise', type=float, default=0.0, metavar='PX', help='1 sigma [px]')
    noise.add_argument('--gravity-noise', type=float, default=0.0, metavar='DEG',
                       help='error about each axis, opposite in the frames [deg]')
    noise.add_argument('--gyro-noise', type=float, default=0.0, metavar='DEG_S',
                       help='1 sigma [deg/s]')
    noise.add_argument('--outliers', type=float, default=0.0, metavar='SHARE',
                       help='share of the matches that are random, 0 to 0.95')
    cosyvio = experiments.add_parser('penncosyvio', help="the paper's experiment on real images",
                                     description=_PENNCOSYVIO_HELP)
    _add_penncosyvio(cosyvio)


def _add_penncosyvio(parser: argparse.ArgumentParser) -> None:
    defaults = {field.name: field.default for field in dataclasses.fields(PennCosyvioRun)}
    parser.add_argument('folder', type=Path, metavar='FOLDER')
    _add_common(parser, METHODS_OF_THE_EXPERIMENT, list(METHODS))
    parser.add_argument('--sequences', nargs='+', choices=STRETCHES, default=list(STRETCHES),
                        metavar='SEQUENCE', help=f'any of {", ".join(STRETCHES)} (default: both)')
    parser.add_argument('--camera', choices=CAMERAS, default=defaults['camera'],
                        help='default: %(default)s, a GoPro')
    parser.add_argument('--readout-time', type=float, metavar='S',
                        help=f'of the camera; nobody has measured it (default: '
                        f'{GOPRO_READOUT:g} for the GoPros, what the authors quote)')
    parser.add_argument('--stamp-row', choices=REFERENCE_ROWS, default=defaults['stamp_row'],
                        help='row that a stamp marks (default: %(default)s)')
    parser.add_argument('--every', type=int, default=defaults['every'], metavar='N',
                        help='frames from one pair to the next (default: %(default)s)')
    parser.add_argument('--distance', type=int, default=defaults['distance'], metavar='N',
                        help='frames from the first of a pair to the second (default: '
                        '%(default)s)')
    recorded = parser.add_argument_group('the recorded IMU')
    recorded.add_argument('--imu', choices=IMUS, default=defaults['imu'],
                          help='default: %(default)s')
    recorded.add_argument('--time-offset', type=float, metavar='S',
                          default=defaults['time_offset'],
                          help='IMU clock minus camera clock (default: %(default)s)')
    recorded.add_argument('--gyro-bias', type=float, nargs=3, metavar='RAD_S',
                          default=defaults['gyro_bias'],
                          help='subtracted from the gyro, IMU axes (default: none)')
    simulated = parser.add_argument_group('simulation')
    simulated.add_argument('--trajectory-only', action='store_true',
                           help='simulate all but the trajectories and the calibration')
    simulated.add_argument('--rendered', action='store_true',
                           help='with --trajectory-only: match rendered images instead of '
                           'simulating matches; some 3 s a pair')
    simulated.add_argument('--scene', choices=SCENES, default='yard',
                           help='that is rendered (default: %(default)s)')
    simulated.add_argument('--pixel-noise', type=float, default=0.5, metavar='PX',
                           help='of simulated points, 1 sigma (default: %(default)s)')
    simulated.add_argument('--outliers', type=float, default=0.3, metavar='SHARE',
                           help='share of the simulated matches that are random, 0 to 0.95 '
                           '(default: %(default)s)')


def _add_common(parser: argparse.ArgumentParser, default: tuple[str, ...],
                solvers: list[str]) -> None:
    parser.add_argument('--output', type=Path, metavar='DIR',
                        default=Path(f'evaluation_{parser.prog.split()[-1]}'),
                        help='directory of the results (default: %(default)s); those of an '
                        'earlier run are replaced')
    parser.add_argument('--solvers', nargs='+', choices=solvers, default=list(default),
                        metavar='SOLVER', help=f'any of {", ".join(solvers)} '
                        f'(default: {" ".join(default)})')
    parser.add_argument('--seed', type=int, default=0, help='of the scenes (default: 0)')
    # Without a default of its own, so that an -v before the experiment is kept.
    parser.add_argument('-v', '--verbose', action='count', default=argparse.SUPPRESS,
                        help='log what is done; twice for details')


def run(args: argparse.Namespace) -> int:
    """Run the experiment that was asked for; 1 when nothing got a pose."""
    return _run_paper(args) if args.experiment == 'paper' else _run_penncosyvio(args)


def _run_paper(args: argparse.Namespace) -> int:
    run = PaperRun(
        sweeps=_once(args.figures), directions=_once(args.motions), methods=_once(args.solvers),
        trials=args.trials, seed=args.seed, base=dataclasses.replace(
            EXACT, pixel_noise=args.pixel_noise, gravity_noise=args.gravity_noise,
            gyro_noise=args.gyro_noise, outliers=args.outliers))
    args.output.mkdir(parents=True, exist_ok=True)
    with progress_bar(len(run.tasks()), 'scene') as bar:
        records = run_paper(run, args.jobs, on_problem=bar.update)
    titles = {(name, motion): f'{SWEEPS[name].title}; {motion} motion, {run.trials} scenes a row'
              for name in run.sweeps for motion in run.directions}
    pictures = [dataclasses.replace(SWEEPS[name],
                                    title=f'{SWEEPS[name].title} ({run.trials} scenes a box)')
                for name in run.sweeps]
    return _report(args.output, records, titles, pictures,
                   {**dataclasses.asdict(run), 'jobs': args.jobs})


def _run_penncosyvio(args: argparse.Namespace) -> int:
    if args.rendered and not args.trajectory_only:
        raise InputError('--rendered needs --trajectory-only')
    if args.readout_time is None and args.camera not in GOPROS:
        raise InputError(f'--readout-time must be given for {args.camera}: no one has quoted one')
    run = PennCosyvioRun(
        sequences=_once(args.sequences), methods=_once(args.solvers), camera=args.camera,
        imu=args.imu, stamp_row=args.stamp_row, time_offset=args.time_offset,
        readout_time=GOPRO_READOUT if args.readout_time is None else args.readout_time,
        gyro_bias=tuple(args.gyro_bias), every=args.every, distance=args.distance, seed=args.seed)
    simulated = Simulated(args.rendered, args.scene, args.pixel_noise, args.outliers)

    def open_sequence(name: str) -> PairSource:
        if args.trajectory_only:
            return SimulatedSequence(args.folder, name, run, simulated)
        return RecordedSequence(args.folder, name, run)

    if not args.folder.is_dir():
        raise MissingInputError(f'there is no folder {args.folder}')
    with progress_bar(len(run.pairs()), 'pair') as bar:
        records = run_penncosyvio(run, open_sequence, on_pair=bar.update)
    source = 'recorded images' if not args.trajectory_only else \
        f'images rendered of a {args.scene}' if args.rendered else 'simulated points'
    title = f'PennCOSYVIO, camera {run.camera}, {source}'
    titles = {(EXPERIMENT, name): f"{title}; sequence '{name}'" for name in run.sequences}
    args.output.mkdir(parents=True, exist_ok=True)
    return _report(args.output, records, titles,
                   [Sweep(EXPERIMENT, title, 'stretch of the sequence', 'part', '', ())],
                   {**dataclasses.asdict(run), 'trajectory_only': args.trajectory_only,
                    'simulated': dataclasses.asdict(simulated)}, totals=True)


def _report(folder: Path, records: list[boxes.Record], titles: Mapping[tuple[str, str], str],
            sweeps: Sequence[Sweep], arguments: Mapping[str, Any], *,
            totals: bool = False) -> int:
    """Print the tables (`titles`: by experiment and case), write tables and pictures.

    `totals`: a box of all levels together, too.
    """
    cases = boxes.by_case(records, totals=totals)
    files = ['trials.csv', 'cells.csv', *(f'{sweep.name}.png' for sweep in sweeps), 'run.json']
    boxes.write_trials(records, folder / files[0])
    boxes.write_boxes(cases, folder / files[1])
    for sweep in sweeps:
        part = {case: levels for case, levels in cases.items() if case[0] == sweep.name}
        boxes.draw_boxes(part, sweep.title, sweep.axis, folder / f'{sweep.name}.png')
        print(boxes.tables(part, titles, sweep.unit))
    (folder / files[-1]).write_text(json.dumps(
        {**arguments, 'command': sys.argv, 'rs_relpose_ros': package_version(),
         'python': platform.python_version()}, indent=2) + '\n', encoding='utf-8')
    print(f'in {folder}: {", ".join(files)}')
    return 0 if any(record.status is Status.OK for record in records) else 1


def _once(names: list[str]) -> tuple[str, ...]:
    """Each name once, in the order given."""
    return tuple(dict.fromkeys(names))
