"""Defaults of the estimator, each once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from rs_relpose_ros.config.declarations import check_settings, setting
from rs_relpose_ros.solvers.table import SOLVERS

SOLVER_CHOICES = ('auto', *SOLVERS)


class CarrierMotion(NamedTuple):
    """Speeds that a carrier reaches, from and to [m/s]; its acceleration, rms per axis [m/s^2]."""

    slow: float
    fast: float
    acceleration: float


MOTIONS = {
    'hand_held': CarrierMotion(0.1, 3.0, 1.5),
    'vehicle': CarrierMotion(0.5, 40.0, 1.5),
    'drone': CarrierMotion(0.2, 15.0, 3.0),
}
REFINEMENTS = ('map', 'alternating', 'none')


@dataclass(frozen=True, slots=True)
class EstimatorConfig:
    """How one frame pair is estimated."""

    solver: str = setting(
        'auto', 'hypothesis generator; auto chooses from what the IMU offers',
        choices=SOLVER_CHOICES)
    refinement: str = setting(
        'map', 'joint fit with IMU priors (map), the scheme of the paper (alternating), or none',
        choices=REFINEMENTS)
    threshold: float = setting(
        2.0, 'inlier threshold on the Sampson error', 'px', low=0.05, high=50.0, live=True)
    pixel_sigma: float = setting(
        0.5, 'noise of a match, 1 sigma per coordinate', 'px', low=0.01, high=20.0, live=True)
    gravity_sigma: float = setting(
        0.02, "noise of one frame's gravity direction, 1 sigma per axis", 'rad', low=1e-5,
        high=1.5, live=True)
    gyro_sigma: float = setting(
        0.005, "noise of one frame's mean angular rate, 1 sigma per axis, bias error included",
        'rad/s', low=1e-6, high=1.0, live=True)
    stamp_sigma: float = setting(
        0.0, "error of an image's stamp, 1 sigma; the scatter of the stamps about an even rhythm "
        'where that is larger. Covariances follow it, poses do not', 's', low=0.0, high=0.1,
        live=True)
    confidence: float = setting(
        0.999, 'probability of an outlier-free sample at which sampling stops', low=0.5,
        high=0.999999, live=True)
    max_iterations: int = setting(
        1000, 'most hypothesis samples', low=1, high=1_000_000, live=True)
    time_limit: float = setting(
        0.0, 'most time for sampling; 0 is no limit (needed for repeatable results)', 's', low=0.0,
        high=60.0, live=True)
    min_inliers: int = setting(
        15, 'fewest inliers of a pose', low=6, high=10_000, live=True)
    min_parallax: float = setting(
        1.0, 'least median parallax after the estimated rotation for a translation', 'px',
        low=0.0, high=500.0, live=True)
    max_translation_sigma: float = setting(
        10.0, 'largest 1 sigma of the direction of translation (root of the trace of its '
        'covariance); beyond it a pair has a rotation but no pose', 'deg', low=0.01, high=180.0,
        live=True)
    motion: str = setting(
        'hand_held', 'what carries the camera: how fast it goes and accelerates, where images and '
        'accelerometer do not tell', choices=tuple(MOTIONS), live=True)

    def __post_init__(self) -> None:
        check_settings(self)
