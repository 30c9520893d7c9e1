"""``rs_relpose replay``: relative poses from a bag."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

from rs_relpose_ros.cli.bag_run import add_run_arguments, errors_line, run_on_bag
from rs_relpose_ros.replay.outputs import replay_into, ReplayOutcome
from rs_relpose_ros.replay.run import read_stamps
from rs_relpose_ros.result_files import SUMMARY_FILE

HELP = (
    'Estimate relative poses from a bag (rosbag2 with SQLite3 or MCAP, compressed or not, or ROS '
    '1) with the pipeline of relpose_node. Topics are found by their types where only one can be '
    'meant. Writes relative_poses.csv, summary.json and pictures, and errors.csv where the bag '
    "has the camera's true poses (geometry_msgs/PoseStamped of the optical frame, IMU clock). "
    'Translations are unit vectors. Tells which figures that were given (axes, time_offset, ...) '
    'images and IMU contradict, if any. Exit code 1: the bag was processed, but no pair got a '
    'pose, or one of these figures is wrong.')

_NO_POSE_OR_WRONG = 1

_logger = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_run_arguments(parser, 'relpose')
    parser.add_argument('--stamps', metavar='FILE', type=Path,
                        help='use only the frames whose stamps [ns] are in FILE, one per line, as '
                        'the parameter stamps_file of a live node wrote them: the poses are then '
                        'equal to its poses, bit by bit')
    parser.add_argument('--no-pictures', action='store_true', help='tables and summary only')
    parser.add_argument('--bag', dest='with_bag', action='store_true',
                        help="write the node's topics as an MCAP bag, too")


def run(args: argparse.Namespace) -> int:
    """Replay a bag; 1 when no pair got a pose or what was told is wrong."""
    stamps = None if args.stamps is None else read_stamps(args.stamps)
    folder, outcome = run_on_bag(
        args, 'relpose', lambda folder, bag, topics, parameters, on_image: replay_into(
            folder, bag, topics, parameters, stamps=stamps, pictures=not args.no_pictures,
            with_bag=args.with_bag, on_image=on_image))
    for reason, count in outcome.figures['not_used'].items():
        _logger.warning('not used, %d times: %s', count, reason)
    for line in report(outcome, folder):
        print(line)
    figures = outcome.figures
    good = figures['pairs']['answered'] and figures['health']['state'] != 'wrong'
    return 0 if good else _NO_POSE_OR_WRONG


def report(outcome: ReplayOutcome, folder: Path) -> list[str]:
    """The outcome in some lines."""
    figures = outcome.figures
    pairs, frames = figures['pairs'], figures['frames']
    refused = sum(frames['refused'].values()) + frames['failed']
    lines = [f'{frames["processed"]} of {frames["in_bag"]} images processed'
             + (f', {refused} refused' if refused else '')
             + f' ({_text(figures["timing"]["processing_per_frame_ms"], "ms per image")})',
             f'{pairs["total"]} pairs, {pairs["answered"]} with a pose'
             + ''.join(f', {count} {status}' for status, count in pairs['by_status'].items()
                       if count and status != 'OK')]
    if not pairs['total']:
        lines.append('no pair was closed: the bag is shorter than a keyframe interval, or too few '
                     'frames could be used')
    elif not pairs['answered']:
        # Why poses are withheld, the health tells below.
        reasons = sorted({record.pose.reason for record in outcome.records
                          if record.status.value != 'WITHHELD'})
        lines += [f'no pose: {reason}' for reason in reasons[:5]]
    errors, medians = figures['errors_against_truth'], figures['medians']
    if errors:
        lines.append(errors_line(errors))
    if pairs['answered']:
        lines.append(
            f'medians: {_text(medians["inliers"], "inliers")}, residual '
            f'{_text(medians["residual_rms_px"], "px")}, rotation against the gyro '
            f'{_text(medians["rotation_difference_to_gyro_deg"], "deg")}')
        lines += _baseline_lines(figures['baselines'], pairs['answered'])
    lines += _health_lines(outcome)
    names = [*(path.name for path in outcome.files), SUMMARY_FILE]
    lines.append(f'in {folder}: {", ".join(names)}')
    return lines


def _baseline_lines(baselines: dict[str, Any], poses: int) -> list[str]:
    """How many poses have a baseline in metres, and the reasons of the others."""
    known = baselines['known']
    line = f'baseline in metres: of {known} of {poses} poses'
    if known:
        line += f', known to {100.0 * baselines["log_sigma_median"]:.0f} % in the median'
    return [line, *(f'{reason} ({count} poses)'
                    for reason, count in baselines['not_known'].items())]


def _health_lines(outcome: ReplayOutcome) -> list[str]:
    """A line for each figure that is suspect or wrong; else one that says what was seen."""
    health = outcome.health
    if health.faults:
        return [fault.text for fault in health.faults]
    if not health.findings:
        return ['health: unknown: there was no pair to judge by']
    seen, unseen = (', '.join(finding.figure for finding in health.findings
                              if finding.observable is observable) for observable in (True, False))
    if not unseen:
        return [f'health: ok ({seen} seen)']
    return [f'health: unknown: {unseen} not seen by this motion'
            + (f' ({seen} ok)' if seen else '')]


def _text(value: Any, unit: str) -> str:
    return f'no {unit}' if value is None else f'{value:.3g} {unit}'
