"""Whether the consistency monitor names one wrong parameter of a recording, and its right value.

All other parameters of the recording are right, as in `rs_relpose_lab/recordings/`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.harness import grouped, markdown_table, write_table
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.calibration.findings import Finding
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.messages.incoming import PARTS, Role, sensor_messages
from rs_relpose_ros.offline.replay import Replay

# An error is large if it is as many sigmas of the correctly configured run.
LARGE = 6.0
# A suggested value is right within so many of its sigmas.
RIGHT = 2.0
# Axis of the wrong rotation.
_AXIS = np.array([2.0, -1.7, 1.5]) / math.sqrt(9.14)


class Wrong(NamedTuple):
    """A wrong value: the error of a quantity, in its unit, by that of `quantity` in `findings`."""

    quantity: str
    error: Callable[[float], float]  # by the right value
    values: Callable[[Parameters], Mapping[str, Any]]


def _offset(milliseconds: float) -> Wrong:
    return Wrong(
        'time_offset',
        lambda right: 1e-3 * milliseconds,
        lambda parameters: {'time_offset': parameters.sensor.time_offset + 1e-3 * milliseconds},
    )


def _readout(factor: float) -> Wrong:
    return Wrong(
        'readout_time',
        lambda right: (factor - 1.0) * right,
        lambda parameters: {'readout_time': factor * (parameters.sensor.readout_time or 0.0)},
    )


def _axes(degrees: float) -> Wrong:
    return Wrong(
        'axes',
        lambda right: degrees,
        lambda parameters: {
            'quat_cam_imu_xyzw': tuple(
                (
                    Rotation.from_rotvec(math.radians(degrees) * _AXIS)
                    * Rotation.from_quat(parameters.sensor.quat_cam_imu_xyzw)
                ).as_quat()
            )
        },
    )


def _focal(factor: float) -> Wrong:
    scale = np.array([factor, 1.0, 1.0, 1.0, factor, 1.0, 1.0, 1.0, 1.0])
    return Wrong(
        'focal_length',
        lambda right: (factor - 1.0) * right,
        lambda parameters: {'camera_matrix': tuple(scale * parameters.intrinsics.camera_matrix)},
    )


# Wrong parameters by name. [chosen: of the size that users report]
ROWS: Mapping[str, Wrong] = {
    'offset +10 ms': _offset(10.0),
    'offset -10 ms': _offset(-10.0),
    'offset +30 ms': _offset(30.0),
    'offset -30 ms': _offset(-30.0),
    'readout x0.5': _readout(0.5),
    'readout x2': _readout(2.0),
    'axes 3 deg': _axes(3.0),
    'focal x0.95': _focal(0.95),
    'focal x1.05': _focal(1.05),
}


@dataclass(frozen=True, slots=True)
class Suggestion:
    """A wrong value on a recording, in the unit of its quantity."""

    bag: str
    row: str
    size: float  # its error in sigmas of the right run; 0 where that does not observe it
    right: float
    estimated: float = math.nan  # by the last finding; NaN without one
    sigma: float = math.nan  # likewise
    others: str = ''  # parameters named, too

    @property
    def off(self) -> float:
        """Error of the suggested value in its sigmas; NaN without one."""
        return (self.estimated - self.right) / self.sigma


def on_recording(path: Path, parameter_file: Path) -> list[Suggestion]:
    """All rows on a recording, and a first one with the right parameters."""
    parameters = _with_lens(path, read_parameters(parameter_file))
    assert parameters.intrinsics.camera_matrix is not None
    found, correct = _findings(path, parameters)
    results = [Suggestion(path.name, 'right', 0.0, 0.0, others=' '.join(found))]
    for name, wrong in ROWS.items():
        named, _ = _findings(path, parameters.updated(wrong.values(parameters)))
        reference = correct.get(wrong.quantity)
        last = named.pop(wrong.quantity, None)
        # An angle has the error itself as its estimate.
        right = {
            'axes': wrong.error(0.0),
            'focal_length': parameters.intrinsics.camera_matrix[0],
            'time_offset': parameters.sensor.time_offset,
            'readout_time': parameters.sensor.readout_time or 0.0,
        }[wrong.quantity]
        size = abs(wrong.error(right)) / reference.sigma if reference and reference.sigma else 0.0
        estimated, sigma = (
            (math.nan, math.nan)
            if last is None
            else (last.estimate or 0.0, last.sigma or math.nan)
        )
        results.append(Suggestion(path.name, name, size, right, estimated, sigma, ' '.join(named)))
    return results


def _with_lens(path: Path, parameters: Parameters) -> Parameters:
    """Parameters with the intrinsics of the bag's CameraInfo, unless they have some."""
    if parameters.intrinsics.given:
        return parameters
    with open_bag(path) as bag:
        topics = bag.find_topics()
        message = next(message for _, message in sensor_messages(bag, topics, (Role.CAMERA_INFO,)))
        lens = PARTS[Role.CAMERA_INFO].read(message.message)
    return parameters.updated(
        {
            'camera_matrix': (lens.fx, 0.0, lens.cx, 0.0, lens.fy, lens.cy, 0.0, 0.0, 1.0),
            'distortion_model': lens.distortion_model,
            'distortion_coefficients': lens.distortion,
        }
    )


def _findings(path: Path, parameters: Parameters) -> tuple[dict[str, Finding], dict[str, Finding]]:
    """The last inconsistent finding of each quantity in a replay, and the consistent ones."""
    named: dict[str, Finding] = {}
    with open_bag(path) as bag:
        run = Replay(bag, bag.find_topics(needs_camera_info=False), parameters)
        for assessment in (*(pair.health for pair in run.pairs()), run.health):
            named.update({finding.code.value: finding for finding in assessment.faults})
    return named, {
        finding.code.value: finding
        for finding in run.health.findings
        if finding.code.value not in named
    }


def write_report(folder: Path, results: Sequence[Suggestion]) -> str:
    """Write the rows (CSV) and the report (Markdown), and return the latter."""
    bags = grouped(results, lambda one: one.bag)
    cells = {(one.bag, one.row): _cell(one) for one in results}
    large = [one for one in results if one.size > LARGE]
    named = [one for one in large if not math.isnan(one.estimated)]
    right = sum(abs(one.off) < RIGHT for one in named)
    alarms = sum(one.row == 'right' and bool(one.others) for one in results)
    table = markdown_table(
        ('row', *bags),
        [(row, *(cells.get((bag, row), '') for bag in bags)) for row in ('right', *ROWS)],
    )
    return write_table(
        folder,
        'suggestions',
        results,
        (
            f'{table}\n{len(named)} of {len(large)} errors of over {LARGE:g} sigmas named, '
            f'{right} of '
            f'their values within {RIGHT:g} sigmas; {alarms} right runs with a finding\n'
        ),
    )


def _cell(one: Suggestion) -> str:
    """Error of the estimate in its sigmas, and the size of the error in brackets."""
    text = '-' if math.isnan(one.estimated) else f'{one.off:+.1f}'
    return (f'{text} ({one.size:.0f})' if one.row != 'right' else 'ok' * (not one.others)) + (
        f' also {one.others}' if one.others else ''
    )
