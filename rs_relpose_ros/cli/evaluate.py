"""``rs_relpose evaluate``: the experiments of the paper."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
import dataclasses
from importlib.metadata import PackageNotFoundError, version
import json
import math
from pathlib import Path
import platform
import sys
from typing import Any

from tqdm import tqdm

from rs_relpose_ros.evaluation.methods import METHODS, PAPER_METHODS
from rs_relpose_ros.evaluation.paper import EXPERIMENTS, PAPER_EXPERIMENTS, PaperRun, run_paper
from rs_relpose_ros.evaluation.plots import draw_boxes
from rs_relpose_ros.evaluation.results import (
    by_cell,
    Record,
    table_lines,
    write_cells,
    write_trials,
)
from rs_relpose_ros.evaluation.scenes import MOTIONS, SceneSettings

HELP = 'Run an experiment of the paper again: tables (printed and CSV), box plots (PNG).'

_PAPER_HELP = (
    'The synthetic experiments of the paper, one figure each: two 1920x1080 rolling-shutter '
    'images (60 us per row) of 300 points, seen exactly row by row, 2 m apart in forward or '
    'sideways motion, opposite velocities in the two frames. Writes trials.csv (every estimate), '
    'cells.csv (every box), a picture for each figure, and run.json. The same arguments give the '
    'same errors, with any number of jobs.')

_TRIALS_FILE, _CELLS_FILE, _RUN_FILE = 'trials.csv', 'cells.csv', 'run.json'
_FAILED = 1


@dataclasses.dataclass(frozen=True, slots=True)
class Sheet:
    """Picture of an experiment: its title, what its axis shows, and that in a table's column."""

    experiment: str
    title: str
    axis: str
    column: str


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of both experiments."""
    experiments = parser.add_subparsers(dest='experiment', metavar='EXPERIMENT', required=True)
    paper = experiments.add_parser('paper', help='the synthetic experiments',
                                   description=_PAPER_HELP)
    _add_common(paper, PAPER_METHODS, [name for name, method in METHODS.items()
                                       if not method.continuous_gyro])
    paper.add_argument('--trials', type=int, default=100, metavar='N',
                       help='scenes of each level of each motion (default: 100, as in the paper)')
    paper.add_argument('--figures', nargs='+', choices=EXPERIMENTS,
                       default=list(PAPER_EXPERIMENTS), metavar='FIGURE',
                       help=f'any of {", ".join(EXPERIMENTS)} (default: those of the paper, all '
                       'but the last)')
    paper.add_argument('--motions', nargs='+', choices=MOTIONS, default=list(MOTIONS),
                       metavar='MOTION', help=f'any of {", ".join(MOTIONS)} (default: both)')
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
    runs: Mapping[str, Callable[[argparse.Namespace], int]] = {'paper': _run_paper}
    return runs[args.experiment](args)


def _run_paper(args: argparse.Namespace) -> int:
    run = PaperRun(
        experiments=_once(args.figures), motions=_once(args.motions), methods=_once(args.solvers),
        trials=args.trials, seed=args.seed, base=SceneSettings(
            pixel_noise=args.pixel_noise, gravity_noise=math.radians(args.gravity_noise),
            gyro_noise=math.radians(args.gyro_noise), outliers=args.outliers))
    args.output.mkdir(parents=True, exist_ok=True)
    with _progress(len(run.tasks()), 'scene') as bar:
        records = run_paper(run, args.jobs, on_scene=bar.update)
    scenes = f'{run.trials} scenes a row'
    titles = {(name, motion): f'{EXPERIMENTS[name].title}; {motion} motion, {scenes}'
              for name in run.experiments for motion in run.motions}
    sheets = [Sheet(name, f'{EXPERIMENTS[name].title} ({run.trials} scenes a box)',
                    EXPERIMENTS[name].axis, EXPERIMENTS[name].column) for name in run.experiments]
    return _report(args.output, records, titles, sheets,
                   {**dataclasses.asdict(run), 'jobs': args.jobs})


def _report(folder: Path, records: list[Record], titles: Mapping[tuple[str, str], str],
            sheets: Sequence[Sheet], arguments: Mapping[str, Any]) -> int:
    """Print the tables (`titles`: by experiment and case), write tables and pictures."""
    cells = by_cell(records)
    write_trials(records, folder / _TRIALS_FILE)
    write_cells(cells, folder / _CELLS_FILE)
    files = [_TRIALS_FILE, _CELLS_FILE]
    for sheet in sheets:
        files.append(f'{sheet.experiment}.png')
        part = {cell: methods for cell, methods in cells.items()
                if cell.experiment == sheet.experiment}
        draw_boxes(part, sheet.title, sheet.axis, folder / files[-1])
        for line in table_lines(part, titles, sheet.column):
            print(line)
    files.append(_RUN_FILE)
    (folder / _RUN_FILE).write_text(json.dumps(
        {**arguments, 'command': sys.argv, 'rs_relpose_ros': _version(),
         'python': platform.python_version()}, indent=2) + '\n', encoding='utf-8')
    print(f'in {folder}: {", ".join(files)}')
    posed = any(len(errors.rotation) for methods in cells.values() for errors in methods.values())
    return 0 if posed else _FAILED


def _progress(total: int, unit: str) -> tqdm:
    return tqdm(total=total, unit=unit, leave=False, disable=not sys.stderr.isatty())


def _once(names: list[str]) -> tuple[str, ...]:
    """Each name once, in the order given."""
    return tuple(dict.fromkeys(names))


def _version() -> str:
    try:
        return version('rs_relpose_ros')
    except PackageNotFoundError:   # run from a source tree
        return 'not installed'
