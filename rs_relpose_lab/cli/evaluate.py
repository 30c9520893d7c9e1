"""``rs_relpose evaluate``: the experiments of the paper."""

import argparse
from collections.abc import Mapping, Sequence
import dataclasses
import json
from pathlib import Path
import platform
import sys
from typing import Any

from rs_relpose_lab.experiments import paper, penncosyvio
from rs_relpose_lab.experiments.methods import METHODS
from rs_relpose_lab.experiments.paper import EXACT, PaperRun, Sweep, SWEEPS
from rs_relpose_lab.experiments.penncosyvio import EXPERIMENT, PennCosyvioRun
from rs_relpose_lab.experiments.problems import BASELINES
from rs_relpose_ros.cli.main import package_version
from rs_relpose_ros.cli.options import progress_bar
from rs_relpose_ros.errors import MissingInputError
from rs_relpose_ros.estimator.result import Status

# Summary for the list of commands.
HELP = 'Repeat an experiment of the paper: tables (printed and CSV), box plots (PNG).'

# Description of `evaluate paper`.
_PAPER_HELP = (
    'The synthetic experiments of the paper: two 1920x1080 rolling-shutter images (60 us per row) '
    'of 300 points, projected exactly row by row, 2 m apart in forward or sideways motion, '
    'opposite velocities in the two frames. Writes trials.csv (every estimate), cells.csv (every '
    'box), a picture for each experiment, and run.json. The same arguments give the same errors, '
    'with any number of jobs.'
)

# Description of `evaluate penncosyvio`.
_PENNCOSYVIO_HELP = (
    "The paper's experiment on the trajectories of PennCOSYVIO: of eight stretches of the "
    "sequences 'as' and 'af', every fifth frame and the one 30 frames later, IMU averaged over "
    '0.1 s. FOLDER is a checkout of github.com/daniilidis-group/penncosyvio; its images and IMU '
    'are not needed: points and IMU are simulated. Writes the same files as evaluate paper.'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of both experiments."""
    experiments = parser.add_subparsers(dest='experiment', metavar='EXPERIMENT', required=True)
    synthetic = experiments.add_parser(
        'paper', help='the synthetic experiments', description=_PAPER_HELP
    )
    _add_common(
        synthetic,
        paper.METHODS_OF_THE_PAPER,
        [name for name, method in METHODS.items() if not method.continuous_gyro],
    )
    _option(synthetic, '--trials', 100, 'N', 'scenes of each level of each motion')
    _names(
        synthetic,
        '--figures',
        list(SWEEPS),
        'those of the paper, all but the last',
        [sweep.name for sweep in SWEEPS.values() if sweep.in_paper],
    )
    _names(synthetic, '--motions', list(BASELINES), 'both')
    _option(synthetic, '--jobs', 1, 'N', 'processes to run in')
    noise = synthetic.add_argument_group(
        'noise', 'in the experiments that do not vary it; the paper names none: 0 by default'
    )
    _option(noise, '--pixel-noise', 0.0, 'PX', '1 sigma [px]')
    _option(
        noise, '--gravity-noise', 0.0, 'DEG', 'error about each axis, opposite in the frames [deg]'
    )
    _option(noise, '--gyro-noise', 0.0, 'DEG_S', '1 sigma [deg/s]')
    _option(noise, '--outliers', 0.0, 'SHARE', 'share of random matches, 0 to 0.95')
    _add_penncosyvio(
        experiments.add_parser(
            'penncosyvio',
            help="the paper's experiment on real trajectories",
            description=_PENNCOSYVIO_HELP,
        )
    )


def _add_penncosyvio(parser: argparse.ArgumentParser) -> None:
    defaults = {field.name: field.default for field in dataclasses.fields(PennCosyvioRun)}
    parser.add_argument('folder', type=Path, metavar='FOLDER')
    _add_common(parser, penncosyvio.METHODS_OF_THE_EXPERIMENT, list(METHODS))
    _names(parser, '--sequences', list(penncosyvio.STRETCHES), 'both')
    _option(
        parser,
        '--readout-time',
        defaults['readout_time'],
        'S',
        "of the camera, the GoPro C2; not measured, but the authors' value",
    )
    _option(parser, '--every', defaults['every'], 'N', 'frames from one pair to the next')
    parser.add_argument(
        '--trajectory-only',
        action='store_true',
        help='the only mode; accepted for scripts that name it',
    )
    _option(parser, '--pixel-noise', defaults['pixel_noise'], 'PX', 'of the points, 1 sigma')
    _option(
        parser, '--outliers', defaults['outliers'], 'SHARE', 'share of random matches, 0 to 0.95'
    )


def _option(
    parser: argparse._ActionsContainer, name: str, default: Any, metavar: str, text: str
) -> None:
    """A number of the default's type."""
    parser.add_argument(
        name,
        type=type(default),
        default=default,
        metavar=metavar,
        help=f'{text} (default: %(default)s)',
    )


def _names(
    parser: argparse.ArgumentParser,
    name: str,
    choices: list[str],
    default_text: str,
    default: list[str] | None = None,
) -> None:
    """Any of some names, all of them by default."""
    parser.add_argument(
        name,
        nargs='+',
        choices=choices,
        metavar=name[2:-1].upper(),
        default=choices if default is None else default,
        help=f'any of {", ".join(choices)} (default: {default_text})',
    )


def _add_common(
    parser: argparse.ArgumentParser, default: tuple[str, ...], solvers: list[str]
) -> None:
    parser.add_argument(
        '--output',
        type=Path,
        metavar='DIR',
        default=Path(f'evaluation_{parser.prog.split()[-1]}'),
        help='directory of the results (default: %(default)s); those of an '
        'earlier run are replaced',
    )
    _names(parser, '--solvers', solvers, ' '.join(default), list(default))
    _option(parser, '--seed', 0, 'N', 'of the scenes')
    # Without a default, so that an -v before the experiment is kept.
    parser.add_argument(
        '-v',
        '--verbose',
        action='count',
        default=argparse.SUPPRESS,
        help='log the progress; twice for details',
    )


def run(args: argparse.Namespace) -> int:
    """Run the requested experiment; 1 without any pose."""
    return _run_paper(args) if args.experiment == 'paper' else _run_penncosyvio(args)


def _run_paper(args: argparse.Namespace) -> int:
    run = PaperRun(
        sweeps=_once(args.figures),
        directions=_once(args.motions),
        methods=_once(args.solvers),
        trials=args.trials,
        seed=args.seed,
        base=dataclasses.replace(
            EXACT,
            pixel_noise=args.pixel_noise,
            gravity_noise=args.gravity_noise,
            gyro_noise=args.gyro_noise,
            outliers=args.outliers,
        ),
    )
    args.output.mkdir(parents=True, exist_ok=True)
    with progress_bar(len(run.tasks()), 'scene') as bar:
        records = paper.run_paper(run, args.jobs, on_problem=bar.update)
    titles = {
        (name, motion): f'{SWEEPS[name].title}; {motion} motion, {run.trials} scenes a row'
        for name in run.sweeps
        for motion in run.directions
    }
    pictures = [
        dataclasses.replace(
            SWEEPS[name], title=f'{SWEEPS[name].title} ({run.trials} scenes a box)'
        )
        for name in run.sweeps
    ]
    return _report(
        args.output, records, titles, pictures, {**dataclasses.asdict(run), 'jobs': args.jobs}
    )


def _run_penncosyvio(args: argparse.Namespace) -> int:
    run = PennCosyvioRun(
        sequences=_once(args.sequences),
        methods=_once(args.solvers),
        **{
            name: getattr(args, name)
            for name in ('readout_time', 'every', 'seed', 'pixel_noise', 'outliers')
        },
    )
    if not args.folder.is_dir():
        raise MissingInputError(f'there is no folder {args.folder}')
    with progress_bar(len(run.pairs()), 'pair') as bar:
        records = penncosyvio.run_penncosyvio(run, args.folder, on_pair=bar.update)
    title = 'PennCOSYVIO, camera C2, simulated points'
    titles = {(EXPERIMENT, name): f"{title}; sequence '{name}'" for name in run.sequences}
    args.output.mkdir(parents=True, exist_ok=True)
    return _report(
        args.output,
        records,
        titles,
        [Sweep(EXPERIMENT, title, 'stretch of the sequence', 'part', '', ())],
        dataclasses.asdict(run),
        totals=True,
    )


def _report(
    folder: Path,
    records: list[paper.Record],
    titles: Mapping[tuple[str, str], str],
    sweeps: Sequence[Sweep],
    arguments: Mapping[str, Any],
    *,
    totals: bool = False,
) -> int:
    """Print the tables (`titles`: by experiment and case), write tables and pictures.

    `totals`: a box of all levels together, too.
    """
    cases = paper.by_case(records, totals=totals)
    files = ['trials.csv', 'cells.csv', *(f'{sweep.name}.png' for sweep in sweeps), 'run.json']
    paper.write_trials(records, folder / files[0])
    paper.write_boxes(cases, folder / files[1])
    for sweep in sweeps:
        part = {case: levels for case, levels in cases.items() if case[0] == sweep.name}
        paper.draw_boxes(part, sweep.title, sweep.axis, folder / f'{sweep.name}.png')
        print(paper.tables(part, titles, sweep.unit))
    (folder / files[-1]).write_text(
        json.dumps(
            {
                **arguments,
                'command': sys.argv,
                'rs_relpose_ros': package_version(),
                'python': platform.python_version(),
            },
            indent=2,
        )
        + '\n',
        encoding='utf-8',
    )
    print(f'in {folder}: {", ".join(files)}')
    return 0 if any(record.status is Status.OK for record in records) else 1


def _once(names: list[str]) -> tuple[str, ...]:
    """Each name once, in the order given."""
    return tuple(dict.fromkeys(names))
