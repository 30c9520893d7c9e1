"""The demo: the real node, live over Fast DDS, against the truth of the bundled bag.

    make demo

Starts relpose_node and a player as separate processes, plays bags/hand_held in real time and
records the poses, replays the same bag offline with several methods, and prints a table.
"""

from concurrent.futures import ProcessPoolExecutor
import multiprocessing
from pathlib import Path
import sys
import time

import cv2
import numpy as np

from rs_relpose_lab.experiments.comparison import (
    compare_live,
    is_still,
    LiveComparison,
    PAPER_ALGORITHMS,
    Score,
    score_of_records,
    score_of_replay,
    score_table,
)
from rs_relpose_lab.experiments.global_shutter import five_point_when_derotated
from rs_relpose_lab.live.live_run import run_live
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.messages.incoming import Intake, sensor_messages
from rs_relpose_ros.offline.pictures import draw_errors
from rs_relpose_ros.offline.replay import outcomes
from rs_relpose_ros.offline.tables import POSES
from rs_relpose_ros.pipeline.global_shutter import unrolling_loop
from rs_relpose_ros.pipeline.pair import Frame

ROOT = Path(__file__).resolve().parent.parent
BAG = ROOT / 'bags' / 'hand_held'
PARAMETERS = ROOT / 'bags' / 'hand_held.yaml'
OUT = ROOT / 'demo_out'
BEFORE_AND_AFTER = 'global_shutter.png'
PATH = 'path.png'

STARTED = time.monotonic()


def compare(table: Path, stamps: Path) -> list[str]:
    """Replay the bag with all methods in parallel; the lines to print."""
    log(
        "replaying it offline: the node's pipeline, the paper's algorithms, OpenCV's 5-point, a "
        'metric path ...'
    )
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context('spawn')) as pool:
        paper = [pool.submit(score_of_paper, name) for name in PAPER_ALGORITHMS]
        derotated = pool.submit(five_point_when_derotated, BAG, read_parameters(PARAMETERS), OUT)
        path = pool.submit(metric_path)
        replayed = compare_live(table, stamps, BAG, PARAMETERS, OUT, pictures=True)
        opencv = replayed.opencv_scores()
        shift = draw_before_and_after()
        scores = [
            replayed.node,
            score_of_records('the same, replayed', replayed.records),
            *(future.result() for future in paper),
            *opencv,
            derotated.result(),
        ]
        draw_errors(replayed.records, OUT / 'errors.png', {s.name: s.errors for s in opencv})
        largest = f'images derotated to their middle row: pixels move by up to {shift:.1f} px'
        return [*score_table(scores), '', *remarks(replayed, opencv), largest, path.result()]


def score_of_paper(name: str) -> Score:
    """One of `PAPER_ALGORITHMS` over the whole bag."""
    return score_of_replay(name, BAG, read_parameters(PARAMETERS).updated(PAPER_ALGORITHMS[name]))


def draw_before_and_after() -> float:
    """Draw the frame of the bag with the largest shift, raw and derotated; the shift [px]."""
    parameters = read_parameters(PARAMETERS)
    loop = unrolling_loop(parameters, offline=True)
    with open_bag(BAG) as bag:
        messages = sensor_messages(bag, bag.find_topics())
        frame = max(
            (
                outcome.result
                for outcome in outcomes(loop, Intake(loop.sequencer, parameters), messages)
                if isinstance(outcome, Frame) and outcome.result is not None
            ),
            key=lambda found: found.map.shift,
        )
    cv2.imwrite(
        str(OUT / BEFORE_AND_AFTER), np.hstack([frame.original.values, frame.image().values])
    )
    return frame.map.shift


def metric_path() -> str:
    """Odometry of the bag; the line to print."""
    from rs_relpose_ros.odometry.offline import odometry_into

    with open_bag(BAG) as bag:
        found = odometry_into(OUT, bag, bag.find_topics(), read_parameters(PARAMETERS))
    errors = found.metrics['live']
    return (
        f'metric path from pairs and IMU: {100.0 * errors["ate_m"]:.1f} cm off (rms) over '
        f'{errors["length_m"]:.1f} m, scale {100.0 * errors["scale_error"]:+.2f} %'
    )


def remarks(replayed: LiveComparison, opencv: list[Score]) -> list[str]:
    """Lines below the table."""
    without = [record for record in replayed.records if record.pose.status is not Status.OK]
    statuses = ', '.join(sorted({record.pose.status.value for record in without}))
    equal = f'{replayed.unequal} of them not equal' if replayed.unequal else 'bit-equal'
    lines = [
        (
            f'no pose: {len(without)} pairs ({statuses}); in {sum(map(is_still, without))} the '
            'camera hardly moves'
        ),
        (
            f'live: {replayed.processed} of {replayed.frames} frames processed; '
            f'{replayed.poses} poses, {equal} to the replay of the same frames'
        ),
    ]
    best = min(opencv, key=lambda s: s.rotation[0])
    if replayed.node.rotation[0] > 0.0 and best.answered:
        lines.append(
            f'rotation: {best.rotation[0] / replayed.node.rotation[0]:.0f} times better '
            'than the better OpenCV row, which ignores the rolling shutter and the IMU'
        )
    return lines


def log(text: str) -> None:
    """Progress, with the seconds since the start."""
    print(f'[{time.monotonic() - STARTED:5.1f} s] {text}', flush=True)


def main() -> int:
    """Run the demo; its exit code."""
    OUT.mkdir(exist_ok=True)
    try:
        log(f'playing {BAG.relative_to(ROOT)} to relpose_node over Fast DDS, in real time ...')
        lines = compare(*run_live(BAG, PARAMETERS, OUT))
    except RsRelposeError as error:
        print(f'demo: {error}', file=sys.stderr)
        return 1
    print()
    print('errors against the truth of the bag (simulated, hand-held, readout 30 ms):')
    print('\n'.join(lines))
    print()
    print('pictures and tables:')
    for name in (
        'matches.png',
        'errors.png',
        'residuals.png',
        'rotation.png',
        BEFORE_AND_AFTER,
        PATH,
        'trajectory.tum',
        POSES.file,
        'live.csv',
    ):
        print(f'  {(OUT / name).relative_to(ROOT)}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
