"""Whether rows of the sensor are columns of the image, in a recording and in a running node.

Where a driver or a phone has turned the images by 90 degrees, the rows of the sensor are columns
of the image, which is no small deviation of the configuration. The rotation of the camera during
the readout tells the two apart: the same pairs are fitted with either, and the losses are
compared. A calibration has all pairs of a recording (`along_other_axis`), a node those of the last
seconds (`ReadoutDirections`). In a node both directions are compared with the configuration and
with the deviations that fit the pairs best; nothing is computed while it is consistent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import math
from typing import NamedTuple, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibration import fit, model
from rs_relpose_ros.calibration.findings import Code, Evidence, Finding, FindingState, Why
from rs_relpose_ros.calibration.posterior import (
    CAUCHY_SIGMAS,
    LastSeconds,
    LEAST_SIGMA,
    misfit_of,
    PairData,
    WINDOW_NS,
)
from rs_relpose_ros.core.deviations import LIVE
from rs_relpose_ros.core.losses import cauchy_cost, robust_scale
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import readout_direction, RollingShutterCamera

if TYPE_CHECKING:  # it reads recordings, which no node needs
    from rs_relpose_ros.calibration.observations import Observations, Pair

# Gain in log-likelihood beyond which columns are certain. Turned images are rare: a smaller value
# would take noise of a global shutter for them, a larger one would miss them where the camera
# hardly rotates. [chosen: odds of exp(5) = 150 to 1; 3 to 10 would do]
_CERTAIN = 5.0
# Errors of the sum of the gains, 1 sigma each by the scatter of the pairs, that must be exceeded
# as well: a few pairs with an outlier decide nothing. [chosen: 2 to 4 would do]
_SIGMAS = 3.0


def _is_certain(gains: Array) -> bool:
    """Whether gains in log-likelihood (P,) of P > 1 pairs by another hypothesis are no chance."""
    error_of_sum = math.sqrt(len(gains)) * float(np.std(gains, ddof=1))
    return bool(float(gains.sum()) > _CERTAIN + _SIGMAS * error_of_sum)


def along_other_axis(
    data: Observations, pairs: Sequence[Pair], found: fit.Fit, free: NDArray[np.bool_]
) -> tuple[Observations, model.Unknowns] | None:
    """The observations with rows along the other axis of the image, and their calibration.

    `found` is the fit to `pairs` with the axis of `data`. None unless the other axis fits better
    for certain.
    """
    turned = data.along(1 - data.camera.readout_axis)
    known = found.unknowns
    problem = turned.problem(pairs, float(known.parameters[model.OFFSET]))
    without_readout = known._replace(parameters=known.parameters.copy())
    without_readout.parameters[model.READOUT] = 0.0
    begin = fit.restarted(problem, without_readout, 2.0)
    other = fit.minimised(problem, begin, free, rounds=20, tolerance=0.3)
    noise = np.minimum(known.noise, other.unknowns.noise)
    losses, others = (
        fit.evaluate(one.problem, one.unknowns._replace(noise=noise)).losses
        for one in (found, other)
    )
    return (turned, other.unknowns) if _is_certain(losses - others) else None


# -- In a running node ---------------------------------------------------------------------------

# Latest pairs that are compared. More would remember a motion that showed nothing, fewer would
# decide later. [chosen: some seconds of keyframes; 20 to 60 would do]
_MOST_PAIRS = 40
# Pairs below which nothing is decided. [chosen: the scatter of fewer gains is no error of their
# sum; 4 to 10 would do]
_LEAST_PAIRS = 5
# Row that is stamped if rows have their numbers in the opposite order of their times.
_REVERSED = {'first': 'last', 'middle': 'middle', 'last': 'first'}


class _Losses(NamedTuple):
    """Negative log-likelihoods of a pair: as configured, with deviations, and by columns."""

    stamp_ns: int
    configured: float
    deviating: float
    columns: Array  # (2,) read to the right and to the left


def turned_cameras(camera: RollingShutterCamera) -> tuple[RollingShutterCamera, ...]:
    """The camera if it is read along the other axis of the image, forwards and backwards.

    The stamped row keeps its place in the order of time, and the rows their span of times.
    """
    cameras = []
    for seconds in (1.0, -1.0):
        direction = readout_direction(1 - camera.readout_axis, seconds)
        turned = replace(camera, readout_direction=direction)
        if turned.reads_forward != camera.reads_forward:
            turned = replace(turned, reference_row=_REVERSED[camera.reference_row])
        span = (camera.row_count - 1) / camera.row_count
        of_turned = (turned.row_count - 1) / turned.row_count
        cameras.append(replace(turned, readout_time=camera.readout_time * span / of_turned))
    return tuple(cameras)


class ReadoutDirections:
    """Pairs of the last seconds during which the configuration was inconsistent."""

    def __init__(self) -> None:
        self._losses = LastSeconds(_MOST_PAIRS, WINDOW_NS)

    def clear(self) -> None:
        """Forget the pairs: the configuration is consistent."""
        self._losses.clear()

    def add(self, stamp_ns: int, pair: PairData, deviation: Array) -> None:
        """Add a pair; `deviation` (K,) from the active values fits the pairs so far."""
        if not pair.camera.readout_time:
            return
        consistent = np.zeros(LIVE.size)
        within = np.clip(deviation, -LIVE.largest, LIVE.largest)
        misfits = [misfit_of(pair, consistent), misfit_of(pair, within)]
        for camera in turned_cameras(pair.camera):
            misfits.append(misfit_of(replace(pair, camera=camera), consistent))
        known = [misfit for misfit in misfits if misfit is not None]
        if len(known) < len(misfits):
            return
        # The noise of the hypothesis that fits best: a wrong one adds to it.
        sigma = min(robust_scale(misfit.residuals, LEAST_SIGMA, 0.0) for misfit in known)
        scale = CAUCHY_SIGMAS * sigma
        losses = np.array(
            [
                0.5 * CAUCHY_SIGMAS**2 * float(cauchy_cost((one.residuals / scale) ** 2).sum())
                + one.of_gyro
                for one in known
            ]
        )
        self._losses.keep(_Losses(stamp_ns, float(losses[0]), float(losses[1]), losses[2:]))

    def findings(self, camera: RollingShutterCamera) -> tuple[Finding, ...]:
        """The direction that fits far better than all others, if there is one."""
        if len(self._losses) < _LEAST_PAIRS:
            return ()
        columns = np.array([one.columns for one in self._losses])
        best = int(np.argmin(columns.sum(axis=0)))
        others = (
            np.array([one.configured for one in self._losses]),
            np.array([one.deviating for one in self._losses]),
            columns[:, 1 - best],
        )
        gains = [other - columns[:, best] for other in others]
        if not all(_is_certain(gain) for gain in gains):
            return ()
        turned = turned_cameras(camera)[best]
        evidence = Evidence(
            pairs=len(columns), log_likelihood=min(float(gain.sum()) for gain in gains)
        )
        settings = {
            'readout_direction': turned.readout_direction,
            'stamp_row': turned.reference_row,
        }
        return (
            Finding(
                Code.READOUT_DIRECTION,
                FindingState.WRONG,
                Why.SIDEWAYS,
                evidence=evidence,
                settings=settings,
            ),
        )
