"""Run the situations and report them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
import shutil
import time
from typing import NamedTuple

from rs_relpose_lab.experiments.harness import markdown_table, write_table
from rs_relpose_lab.field.cases import BASES, BY_NAME, Case
from rs_relpose_lab.field.evidence import Evidence
from rs_relpose_lab.field.offline import answers, evidence_of, replayed_poses, run_command
from rs_relpose_lab.field.recording import base_recording, FieldRecording, write_recording
from rs_relpose_lab.field.truth import pose_distances
from rs_relpose_lab.field.verdict import judge, Verdict


class Task(NamedTuple):
    """The name of a case, which processes can send each other, and the folder of all cases."""

    name: str
    output: Path
    live: bool = False  # played to running nodes, in place of the commands


def prepare_bases(tasks: Sequence[Task]) -> None:
    """Render the base recordings, and replay those that poses are counted against, each once.

    Processes that work on cases of one base would write its files at the same time.
    """
    for task in tasks:
        case = BY_NAME[task.name]
        base_recording(BASES[case.base], task.output / 'bases' / case.base)
        if not task.live:
            _undisturbed_poses(case, task.output)


def run_case(task: Task) -> Verdict:
    """Make the recording of a case, have it answered, and judge the answers."""
    case, output = BY_NAME[task.name], task.output
    base = base_recording(BASES[case.base], output / 'bases' / case.base)
    recording = case.change(base)
    folder = (output / ('live' if task.live else 'cases') / case.name).resolve()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    bag = folder / 'bag'
    parameters = write_recording(recording, bag)
    started = time.monotonic()
    answered = _by_nodes if task.live else _by_commands
    evidence = answered(case, recording, bag, parameters)
    seconds = time.monotonic() - started
    # Live, all pairs of images that are no repetition would have a pose.
    undisturbed = evidence.pairs if task.live else _undisturbed_poses(case, output)
    verdict = judge(case, evidence, undisturbed, seconds)
    # Bags are large, and they can be made again.
    shutil.rmtree(bag, ignore_errors=True)
    return replace(verdict, case=f'{case.name} live') if task.live else verdict


def _by_commands(case: Case, recording: FieldRecording, bag: Path, parameters: Path) -> Evidence:
    folder = bag.parent
    found = answers(case, folder, bag, parameters)
    for name, answer in found.items():
        text = f'exit code {answer.code}\n{answer.text}'
        (folder / f'{name}.txt').write_text(text, encoding='utf-8')
    return evidence_of(recording, folder, found)


def _by_nodes(_: Case, recording: FieldRecording, bag: Path, parameters: Path) -> Evidence:
    from rs_relpose_lab.field.live import play  # it needs ROS

    return play(recording, bag, parameters, bag.parent)


def _undisturbed_poses(case: Case, output: Path) -> int | None:
    """Number of poses of the base recording, replayed once; None where they do not count."""
    if not case.solvable:
        return None
    folder = (output / 'bases' / case.base).resolve()
    base = base_recording(BASES[case.base], folder)
    replayed = folder / 'replay'
    if not (replayed / 'summary.json').exists():
        words = ('replay', str(folder / 'bag'), '--params', str(folder / 'bag.yaml'))
        run_command(folder, *words, '--out', str(replayed), '--bag', '--no-pictures')
    return len(pose_distances(base, replayed_poses(replayed)))


def report(output: Path, verdicts: Sequence[Verdict]) -> str:
    """Write the table of verdicts, and return it."""
    header = (
        *('case', 'verdict', 'poses of pairs', 'beyond', 'worst', 'calibrate', 'odometry beyond'),
        *('named', 'findings', 'reason'),
    )
    rows = [
        (
            one.case,
            one.verdict,
            f'{one.poses} of {one.pairs}',
            f'{100.0 * one.beyond:.1f} %',
            f'{one.worst:.1f}',
            f'{one.calibration:.1f}',
            f'{100.0 * one.states_beyond:.0f} % of {one.states}',
            one.named[:24],
            one.faults,
            one.reason,
        )
        for one in verdicts
    ]
    count = {
        kind: sum(one.verdict == kind for one in verdicts) for kind in ('good', 'poor', 'failure')
    }
    summary = ', '.join(f'{number} {kind}' for kind, number in count.items())
    text = f'{markdown_table(header, rows)}\n{len(verdicts)} cases: {summary}\n'
    return write_table(output, 'field', verdicts, text)
