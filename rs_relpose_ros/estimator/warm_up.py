"""Compiles (or loads from the cache) what an estimate needs, so that the first one is not slow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.estimator import EstimatorConfig
from rs_relpose_ros.estimator.estimate import estimate_relative_pose, Estimation
from rs_relpose_ros.estimator.hypotheses import MODES
from rs_relpose_ros.estimator.problem import build_problem
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.solvers.solver import Solutions

Array = NDArray[np.float64]


def warm_up(config: EstimatorConfig | None = None) -> None:
    """Compile (or load from the cache) every kernel of an estimate with `config`."""
    points1, points2, camera, motion = _sideways()
    estimate_relative_pose(points1, points2, camera, motion, motion, np.eye(3), 1e-4 * np.eye(3),
                           config=config)


def warm_up_solvers() -> None:
    """Compile the solvers that are sampled by default."""
    for solver in MODES[EstimatorConfig().solver].solvers:
        assert solver.address


def warm_up_sampling() -> None:
    """Compile the kernels of the first step alone."""
    _estimation().sample()


def warm_up_refinement() -> None:
    """Compile the kernels of all steps but the first."""
    _estimation().refine(Solutions(np.eye(3)[None], np.eye(1, 9)))


def _estimation() -> Estimation:
    points1, points2, camera, motion = _sideways()
    problem = build_problem(points1, points2, camera, motion, motion, np.eye(3),
                            1e-4 * np.eye(3))
    return Estimation(problem, MODES['auto'], EstimatorConfig(), np.arange(len(points1)),
                      np.zeros(1, dtype=np.uint64), None)


def _sideways() -> tuple[Array, Array, RollingShutterCamera, FrameMotion]:
    """Matches of a camera that moves to its right, for the warm-up."""
    rng = np.random.default_rng(0)
    camera = RollingShutterCamera(width=640, height=480, fx=450.0, fy=450.0, cx=319.5, cy=239.5,
                                  readout_time=0.03)
    motion = FrameMotion(np.array([0.0, 0.1, 0.0]), gravity=np.array([0.0, 1.0, 0.0]))
    world = rng.uniform([-4.0, -3.0, 4.0], [4.0, 3.0, 12.0], (100, 3))
    return camera.project(world), camera.project(world - [0.5, 0.0, 0.0]), camera, motion
