"""The demo: the real node, live over Fast DDS, against the truth of the bundled bag.

    make demo

Starts relpose_node, a recorder and a player as processes of their own, plays bags/hand_held in
real time, replays the same bag offline with several methods, and prints a table.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
import multiprocessing
from pathlib import Path
import sys
import time

from rs_relpose_lab.experiments.comparison import (
    differing_poses,
    is_still,
    PAPER_METHODS,
    replay_records,
    Score,
    score_of_records,
    score_of_table,
    score_table,
)
from rs_relpose_lab.experiments.opencv_baseline import best_opencv_score, METHODS
from rs_relpose_lab.live.live_run import LiveRun, run_live
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.replay.outputs import POSES_FILE, replay_into, ReplayOutcome
from rs_relpose_ros.replay.run import read_truth, ReplayedPair
from rs_relpose_ros.replay.stamps import read_stamps

ROOT = Path(__file__).resolve().parent.parent
BAG = ROOT / 'bags' / 'hand_held'
PARAMETERS = ROOT / 'bags' / 'hand_held.yaml'
OUT = ROOT / 'demo_out'

STARTED = time.monotonic()


class DemoError(Exception):
    """The demo could not be run; the text says why."""


def compare(live: LiveRun) -> list[str]:
    """Replay the bag with all methods; the lines to print."""
    parameters = read_parameters(PARAMETERS)
    with open_bag(BAG) as bag:
        topics = bag.find_topics()
        truth = read_truth(bag, topics)
        if truth is None:
            raise DemoError(f'{BAG} has no ground truth')
        say('replaying it offline: the pipeline of the node ...')
        pairs: list[ReplayedPair] = []
        outcome = replay_into(OUT, bag, topics, parameters, on_pair=pairs.append)
        # Where the live node dropped frames, its pairs are others: compare on the same frames.
        same_frames = replay_into(OUT / 'frames_of_the_live_run', bag, topics, parameters,
                                  stamps=read_stamps(live.stamps), pictures=False)
        scores = [score_of_table('relpose_node, live', live.table, same_frames.records, truth),
                  score_of_records('the same, replayed', outcome.records)]
    say("replaying it offline: the paper's algorithms, OpenCV's 5-point ...")
    answered = [pair for pair in pairs if pair.result.pose]
    assert outcome.intrinsics is not None
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context('spawn')) as pool:
        paper = [pool.submit(score_of_method, name) for name in PAPER_METHODS]
        opencv = [pool.submit(best_opencv_score, method, answered, outcome.intrinsics, truth)
                  for method in METHODS]
        scores += [future.result() for future in paper + opencv]
    return [*score_table(scores), '', *remarks(scores, outcome, live, same_frames)]


def score_of_method(name: str) -> Score:
    """One of `PAPER_METHODS` over the whole bag."""
    parameters = read_parameters(PARAMETERS).updated(PAPER_METHODS[name])
    with open_bag(BAG) as bag:
        topics = bag.find_topics()
        truth = read_truth(bag, topics)
        assert truth is not None
        return score_of_records(name, replay_records(bag, topics, parameters, truth))


def remarks(scores: list[Score], outcome: ReplayOutcome, live: LiveRun,
            same_frames: ReplayOutcome) -> list[str]:
    """What the table does not say."""
    without = [record for record in same_frames.records if record.status is not Status.OK]
    still = sum(map(is_still, without))
    statuses = ', '.join(sorted({record.status.value for record in without}))
    lines = [f'no pose: {len(without)} pairs ({statuses}); in {still} the camera hardly moves']
    differing, compared = differing_poses(live.table, same_frames.files[0])
    processed = len(read_stamps(live.stamps))
    lines.append(f'live: {processed} of {outcome.counts.images} frames processed; {compared} '
                 'poses, ' + ('bit-equal to the replay of the same frames' if not differing else
                              f'{differing} of them not equal to the replay of the same frames'))
    opencv = [s for s in scores if s.name.startswith('OpenCV')]
    best = min(opencv, key=lambda s: s.rotation[0])
    if scores[0].rotation[0] > 0.0 and best.answered:
        lines.append(f'rotation: {best.rotation[0] / scores[0].rotation[0]:.0f} times better than '
                     f'the better OpenCV row, which ignores the rolling shutter and the IMU')
    return lines


def say(text: str) -> None:
    """Progress, with the seconds since the start."""
    print(f'[{time.monotonic() - STARTED:5.1f} s] {text}', flush=True)


def main() -> int:
    """Run the demo; its exit code."""
    OUT.mkdir(exist_ok=True)
    try:
        say(f'playing {BAG.relative_to(ROOT)} to relpose_node over Fast DDS, in real time ...')
        lines = compare(run_live(BAG, PARAMETERS, OUT))
    except (DemoError, RsRelposeError) as error:
        print(f'demo: {error}', file=sys.stderr)
        return 1
    print()
    print('errors against the truth of the bag (simulated, hand-held, read-out 30 ms):')
    print('\n'.join(lines))
    print()
    print('pictures and tables:')
    for name in ('matches.png', 'errors.png', 'residuals.png', 'rotation.png', POSES_FILE,
                 'live.csv'):
        print(f'  {(OUT / name).relative_to(ROOT)}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
