"""``summary.json``: counts, medians, errors and timing of a replay, and what it was made with."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import fields
import json
import math
from pathlib import Path
import platform
from typing import Any

import cv2
import numba
import numpy as np
import scipy

from rs_relpose_ros.bags.topics import SensorTopics
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.front_end.pair import PAIR_FIGURES, PairResult
from rs_relpose_ros.health.findings import Health, NOT_JUDGED
from rs_relpose_ros.messages.causes import CauseCounts
from rs_relpose_ros.replay.run import Replay
from rs_relpose_ros.replay.tables import PairRecord
from rs_relpose_ros.replay.truth import median_and_p90


def summarize(records: Sequence[PairRecord], run: Replay,
              last: PairResult | None = None, health: Health = NOT_JUDGED) -> dict[str, Any]:
    """Figures of a run; medians are over the answered pairs, null where there are none.

    `last`: the last pair; `health`: the worst that was found of each figure.
    """
    answered = [record for record in records if record.pose]
    by_status = Counter(record.status for record in records)
    counts, sequencer = run.counts, run.sequencer.counts()
    seconds, taken = counts.processing_seconds, sequencer.frames_taken
    return {
        'pairs': {
            'total': len(records),
            'answered': len(answered),
            'by_status': {status.value: by_status[status] for status in Status},
        },
        'frames': {
            'in_bag': counts.images,
            'not_among_stamps': counts.images_skipped,
            'processed': taken,
            'refused': {cause.value: n for cause, n in sequencer.refused.items()},
            'failed': counts.failed_frames,
        },
        'imu': {
            'samples': sequencer.imu_samples,
            'gaps': sequencer.imu_gaps,
            'repeated': sequencer.imu_repeated,
            'late': sequencer.imu_late,
            'clock_jumps': sequencer.clock_jumps,
        },
        'tracked': _tracked(last),
        'health': health.as_json(),
        'invalid_messages': counts.invalid_messages,
        'not_used': run.reasons.most_common(),
        'medians': {
            figure.name: _median([record.figures[figure.name] for record in answered])
            for figure in PAIR_FIGURES},
        'baselines': _baselines(answered),
        'errors_against_truth': errors_against_truth(answered),
        'timing': {
            'bag_s': (counts.last_ns - counts.first_ns) * 1e-9,
            'wall_s': counts.seconds,
            'frame_rate_hz': taken / seconds if seconds > 0.0 else None,
            'processing_per_frame_ms': 1e3 * seconds / taken if taken else None,
            'estimate_median_ms': _median([1e3 * record.pose.duration for record in records]),
        },
    }


def write_summary(path: Path, figures: dict[str, Any], *, bag: Path, topics: SensorTopics,
                  parameters: Parameters, command: Sequence[str], package_version: str) -> None:
    """Write the figures, and what they were made from, as JSON, which has no NaN."""
    by_role = {field.name: getattr(topics, field.name) for field in fields(topics)}
    summary = {
        'bag': str(bag),
        'topics': {role: topic and topic.name for role, topic in by_role.items()},
        **figures,
        'parameters': parameters.to_mapping(),
        'command': list(command),
        'versions': {'rs_relpose_ros': package_version, 'python': platform.python_version(),
                     'numpy': np.__version__, 'scipy': scipy.__version__,
                     'opencv': cv2.__version__, 'numba': numba.__version__},
    }
    path.write_text(json.dumps(summary, indent=2, allow_nan=False) + '\n', encoding='utf-8')


def _tracked(last: PairResult | None) -> dict[str, Any] | None:
    if last is None or last.tracked is None or not last.tracked.pairs:
        return None
    seen = last.tracked
    return {
        'gyro_bias_rad_s': seen.gyro_bias.tolist(),
        'gyro_bias_sigma_rad_s': seen.gyro_bias_sigma.tolist(),
        'time_offset_s': seen.time_offset,
        'time_offset_sigma_s': seen.time_offset_sigma,
        'applied_s': last.applied.time_offset,
        'readout_time_s': seen.readout_time,
        'readout_time_sigma_s': seen.readout_time_sigma,
        'applied_readout_time_s': last.applied.readout_time,
    }


def _baselines(answered: Sequence[PairRecord]) -> dict[str, Any]:
    """Of how many poses the baseline is known, how well in the median, and why not of others."""
    known = [record.pose.baseline_log_sigma for record in answered
             if not record.pose.baseline_reason]
    reasons = CauseCounts()
    for record in answered:
        if record.pose.baseline_reason:
            reasons.add(record.pose.baseline_reason)
    return {'known': len(known), 'log_sigma_median': _median(known),
            'not_known': reasons.most_common()}


def errors_against_truth(answered: Sequence[PairRecord]) -> dict[str, Any] | None:
    """Medians and 90th percentiles of the errors; None without a truth."""
    errors = [record.errors for record in answered if record.errors is not None]
    if not errors:
        return None
    rotation = [error.rotation_error for error in errors]
    translation = [error.translation_error for error in errors]
    return {
        'pairs': len(errors),
        'rotation_median_deg': _median(rotation),
        'rotation_p90_deg': _finite(median_and_p90(rotation)[1]),
        'translation_median_deg': _median(translation),
        'translation_p90_deg': _finite(median_and_p90(translation)[1]),
        'baseline_median_m': _median([error.baseline for error in errors]),
    }


def _median(values: Sequence[float]) -> float | None:
    return _finite(median_and_p90(values)[0])


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
