"""``rs_relpose odometry``: a metric path from a bag."""

from __future__ import annotations

import argparse
from typing import Any

from rs_relpose_ros.cli.bag_run import add_run_arguments, run_on_bag
from rs_relpose_ros.odometry.library import need_gtsam
from rs_relpose_ros.result_files import SUMMARY_FILE

HELP = (
    'Metric odometry from a bag: the relative poses of its keyframe pairs and its IMU in one '
    'graph (gtsam, an extra), as odometry_node does it live. Writes trajectory.tum (live '
    "estimates of the camera, z up, stamped with the image's middle row on the camera's clock), "
    'trajectory_smoothed.tum (each with all that came later), summary.json and a picture; with '
    "errors where the bag has the camera's true poses. The parameter imu_position should be told. "
    'Exit code 1: odometry did not start.')

_NOT_STARTED = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_run_arguments(parser, 'odometry')


def run(args: argparse.Namespace) -> int:
    """Odometry of a bag; 1 where it did not start."""
    need_gtsam()
    from rs_relpose_ros.odometry.offline import LIVE_FILE, odometry_into, PICTURE, SMOOTHED_FILE
    folder, outcome = run_on_bag(args, 'odometry', odometry_into)
    for sentence in outcome.sentences:
        print(sentence)
    figures = outcome.figures
    pairs = figures['pairs']
    print(f'{figures["keyframes"]} keyframes of {pairs["pairs"]} pairs over '
          f'{figures["length_m"]:.1f} m'
          + (f', {pairs["contradicting"]} pairs left out' if pairs['contradicting'] else '')
          + (f', lost {figures["lost"]} times' if figures['lost'] else ''))
    if figures['health'] in ('suspect', 'wrong'):
        print(f'health: {figures["health"]}: "rs_relpose replay" says of which figure')
    for trajectory in ('live', 'smoothed'):
        if figures[trajectory]:
            print(f'{trajectory}, against the truth: {_errors(figures[trajectory])}')
    if not outcome.live:
        print('odometry did not start: ' + (
            outcome.obstacle or 'it needs some seconds of motion, or standing still, and pairs '
            'that tell more than nothing'))
        return _NOT_STARTED
    print(f'in {folder}: {LIVE_FILE}, {SMOOTHED_FILE}, {PICTURE}, {SUMMARY_FILE}')
    return 0


def _errors(errors: dict[str, Any]) -> str:
    return (f'ATE {errors["ate_m"]:.3f} m over {errors["length_m"]:.1f} m, scale '
            f'{100.0 * errors["scale_error"]:+.2f} %')
