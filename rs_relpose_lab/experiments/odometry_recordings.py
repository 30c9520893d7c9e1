"""`rs_relpose benchmark odometry --recordings BAG...`: real recordings, whole and in parts.

The truth of a part is the smoothed path of the whole recording, which has about a third of the
error of a live one. States are those that odometry_node would publish, at 30 Hz.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
import math
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from rs_relpose_lab.experiments import odometry_disturbances
from rs_relpose_lab.experiments.harness import markdown_table, write_table
from rs_relpose_lab.experiments.odometry import drift
from rs_relpose_lab.experiments.odometry_disturbances import Feed, published, TrueStates
from rs_relpose_lab.experiments.trust_runs import Recording, recording_at
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.geometry.timing import seconds_between, to_nanoseconds
from rs_relpose_ros.odometry.estimator import OdometryEstimator
from rs_relpose_ros.odometry.offline import path_of, row_trajectory
from rs_relpose_ros.odometry.rows import RowTrajectory
from rs_relpose_ros.odometry.states import Base, Odometry, OdometryState

# Quantile of chi squared of 3 degrees of freedom: 3 sigma.
_BEYOND = float(chi2.ppf(0.9973, 3))


@dataclass(frozen=True, slots=True)
class RecordedPart:
    """A recording, or a part of it, against the smoothed path of the whole."""

    name: str
    begin: float
    seconds: float
    start: float  # [s] from the first pair with a direction to the first state; NaN without
    claimed: float  # relative 1 sigma of the scale there
    speed: float  # error of the speed there by its sigma
    scale: float  # of the published path [%]
    drift: float  # likewise
    beyond: float  # share of the states whose position is beyond 3 sigma [%]
    step: float  # largest change of the position's error between states [sigma]
    uncertain: int  # number of intervals
    lost: int  # likewise
    state: str  # at the end
    reason: str  # at the end


def on_recording(path: Path, seconds: float) -> Iterator[RecordedPart]:
    """A bag with its parameters next to it, whole and cut into parts of some seconds."""
    recording = recording_at(path)
    estimator, states, feed = _run(recording)
    paths = estimator.smoothed_paths()
    rows = (
        row_trajectory(
            paths,
            Base(),
            Parameters.from_mapping(feed.values),
            [sample for _, sample in feed.samples],
        )
        if paths
        else None
    )
    yield _metrics(path.name, 0.0, recording, estimator, states, feed, rows)
    first_ns = recording.arrivals[0].stamp_ns
    for k in range(int(recording.seconds / seconds)):
        begin, end = (first_ns + to_nanoseconds(seconds * at) for at in (k, k + 1))
        # The buffer of a node that starts then is empty.
        part = replace(
            recording,
            arrivals=[one for one in recording.arrivals if begin <= one.stamp_ns < end],
            samples=[one for one in recording.samples if begin <= one.stamp_ns < end],
        )
        yield _metrics(path.name, k * seconds, part, *_run(part), rows)


def _run(recording: Recording) -> tuple[OdometryEstimator, list[Odometry], Feed]:
    feed = odometry_disturbances.feed_of(recording)
    estimator = OdometryEstimator(Parameters.from_mapping(feed.values), keep=True)
    return estimator, list(published(estimator, feed)), feed


def _metrics(
    name: str,
    begin: float,
    recording: Recording,
    estimator: OdometryEstimator,
    states: Sequence[Odometry],
    feed: Feed,
    rows: RowTrajectory | None,
) -> RecordedPart:
    """`rows`: of the whole recording; None if it does not start: nothing to compare with."""
    with_direction = [pair.reference_imu_ns for _, pair in feed.pairs if pair.has_direction]
    start = claimed = speed = scale = end = beyond = step = math.nan
    states = [state for state in states if rows is not None and rows.covers(state.imu_ns)]
    if rows is not None and len(states) > 3:
        truth = _true_states(rows, feed)
        first = states[0]
        numbers = np.searchsorted(truth.stamps_ns, [state.imu_ns for state in states])
        start = seconds_between(with_direction[0], first.imu_ns)
        claimed = estimator.starts[0].scale_sigma
        along = first.velocity / np.linalg.norm(first.velocity)
        speed = float(
            (np.linalg.norm(first.velocity) - np.linalg.norm(truth.velocity[numbers[0]]))
            / math.sqrt(along @ first.velocity_covariance[:3, :3] @ along)
        )
        of_path = truth.trajectory
        errors = path_of(states, of_path).errors
        assert errors is not None
        scale = 100.0 * errors.scale_error
        end = drift(states, of_path)
        chi = odometry_disturbances.errors_squared(states, estimator.smoothed()[0], truth)[:, 0]
        beyond = 100.0 * float((chi > _BEYOND).mean())
        step = max(
            _step(one, two, truth, i, j)
            for (one, i), (two, j) in pairwise(zip(states, numbers.tolist(), strict=True))
            if one.path == two.path
        )
    intervals = [one.state for one in estimator.intervals]
    return RecordedPart(
        name,
        begin,
        recording.seconds,
        start,
        100.0 * claimed,
        speed,
        scale,
        end,
        beyond,
        step,
        intervals.count(OdometryState.UNCERTAIN),
        intervals.count(OdometryState.LOST),
        estimator.state.value,
        estimator.reason,
    )


def _true_states(rows: RowTrajectory, feed: Feed) -> TrueStates:
    """The smoothed path at the samples."""
    stamps = np.unique([sample.stamp_ns for _, sample in feed.samples])
    stamps = stamps[rows.covers(stamps)]
    R, position = rows.pose(stamps)
    return TrueStates(stamps, position, R, np.einsum('nij,nj->ni', R, rows.velocity(stamps)[0]))


def _step(one: Odometry, two: Odometry, truth: TrueStates, i: int, j: int) -> float:
    """Step from one state to the next one against the true one, in sigmas of the position."""
    error = one.R.T @ (two.position - one.position) - truth.R[i].T @ (
        truth.position[j] - truth.position[i]
    )
    return float(np.linalg.norm(error) / math.sqrt(np.trace(one.pose_covariance[:3, :3])))


def write_report(folder: Path, parts: Sequence[RecordedPart]) -> str:
    """Write the metrics (CSV) and the report (Markdown), and return the latter."""
    return write_table(
        folder,
        'odometry_recordings',
        parts,
        markdown_table(
            (
                'recording',
                'from [s]',
                'seconds',
                'started after [s]',
                'claimed [%]',
                'speed [sigma]',
                'scale [%]',
                'drift [%]',
                'beyond 3 sigma [%]',
                'largest step [sigma]',
                'uncertain',
                'lost',
                'at the end',
            ),
            [
                (
                    one.name,
                    *(
                        f'{value:.1f}'
                        for value in (
                            one.begin,
                            one.seconds,
                            one.start,
                            one.claimed,
                            one.speed,
                            one.scale,
                            one.drift,
                            one.beyond,
                        )
                    ),
                    f'{one.step:.2f}',
                    str(one.uncertain),
                    str(one.lost),
                    f'{one.state}: {one.reason}',
                )
                for one in parts
            ],
        ),
    )
