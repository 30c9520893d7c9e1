"""The robust fit: Levenberg-Marquardt over the calibration, everything of the pairs eliminated."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.calibration.gyro_path import GyroPath
from rs_relpose_ros.calibration.normal_equations import (
    accumulate, BIAS, FOCAL, GLOBAL, LOCAL, OFFSET, READOUT, ROTATION, SLOPE,
)

Array = NDArray[np.float64]

# Distance [sigma] at which the Geman-McClure loss levels off.
ROBUST = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Data of a fit: what `accumulate` takes of the gyro's samples and of the pairs."""

    gyro_times: Array
    gyro_rates: Array
    begin: NDArray[np.int64]
    first: NDArray[np.int64]
    times1: Array
    times2: Array
    covariates1: Array
    covariates2: Array
    points1: Array
    points2: Array
    rows1: Array
    rows2: Array
    scales: Array

    @property
    def pairs(self) -> int:
        return len(self.times1)


@dataclass(frozen=True, slots=True)
class Scatter:
    """1 sigma of what the fit does not solve for globally; learned from the data.

    `pixel`: a match [px]; `depth`: inverse depth of a point relative to its pair; `velocity`: of the
    camera [depths/s]; `acceleration` [depths/s^2]; `turn`: error of the gyro's rotation
    [rad/sqrt(s)].
    """

    pixel: float = 5.0
    depth: float = 0.5
    velocity: float = 0.5
    acceleration: float = 1.0
    turn: float = 1e-3

    def as_array(self) -> Array:
        return np.array([self.pixel, self.depth, self.velocity, self.acceleration, self.turn])


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """A calibration: values of the parameters, and the rotation from camera to IMU.

    `parameters` (GLOBAL,): read-out, offset of the middle row, slope, three unused, bias, log of the
    focal length's factor.
    """

    parameters: Array
    R_imu_cam: Array
    local: Array
    rho: Array
    scatter: Scatter = field(default_factory=Scatter)

    @classmethod
    def start(cls, problem: Problem, R_imu_cam: Array, offset: float, readout: float = 0.0,
              bias: Array | None = None, log_focal: float = 0.0) -> State:
        parameters = np.zeros(GLOBAL)
        parameters[READOUT], parameters[OFFSET], parameters[FOCAL] = readout, offset, log_focal
        if bias is not None:
            parameters[BIAS:BIAS + 3] = bias
        return cls(parameters, R_imu_cam, np.zeros((problem.pairs, LOCAL)),
                   np.ones(len(problem.points1)))

    def moved(self, step: Array, local: Array) -> State:
        parameters = self.parameters + step
        parameters[ROTATION:ROTATION + 3] = 0.0
        turn = Rotation.from_rotvec(step[ROTATION:ROTATION + 3]).as_matrix()
        return replace(self, parameters=parameters, R_imu_cam=turn @ self.R_imu_cam, local=local)


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """What a pass over all matches gives; see `accumulate`."""

    losses: Array
    weights: Array
    across: Array
    sharpness: Array
    rho: Array
    score: Array
    reduced: Array
    back: Array
    spread: Array

    @property
    def cost(self) -> float:
        return float(self.losses.sum())


def evaluate(problem: Problem, state: State, derivatives: bool = True) -> Evaluation:
    """Residuals at `state`; the inverse depths are improved on the way."""
    path = GyroPath.integrated(problem.gyro_times, problem.gyro_rates,
                               state.parameters[BIAS:BIAS + 3])
    pairs, matches = problem.pairs, len(problem.points1)
    size = pairs if derivatives else 0
    out = Evaluation(np.empty(pairs), np.empty(matches), np.empty(matches), np.empty(matches),
                     state.rho.copy(), np.empty((size, GLOBAL)), np.empty((size, GLOBAL, GLOBAL)),
                     np.empty((size, LOCAL, GLOBAL + 1)), np.empty((size, LOCAL)))
    accumulate(path.times, path.rates, path.rotations, path.turned, problem.begin, problem.times1,
               problem.times2, problem.covariates1, problem.covariates2, problem.points1,
               problem.points2, problem.rows1, problem.rows2, problem.scales, state.parameters,
               state.R_imu_cam, state.scatter.as_array(), state.local, out.rho, derivatives,
               ROBUST, out.losses, out.weights, out.across, out.sharpness, out.score, out.reduced,
               out.back, out.spread)
    return out
