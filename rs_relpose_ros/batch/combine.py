"""Calibrations of one camera from many bags as one: weighted means, and which do not agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rs_relpose_ros.batch.figures import CALIBRATED, calibrated

# Distance from the mean of the others beyond which a bag is an outlier [sigma].
_OUTLIER = 3.0


@dataclass(frozen=True, slots=True)
class Combined:
    """Weighted mean of independent measurements without the outliers."""

    figure: str
    mean: float
    sigma: float   # by the measurements' own sigmas, times sqrt(chi2/dof) where that is above 1
    chi2: float   # of those that are no outliers
    degrees_of_freedom: int
    bags: tuple[str, ...]   # all that have the figure
    outliers: tuple[str, ...]


def weighted_mean(figure: str, bags: Sequence[str], values: ArrayLike,
                  sigmas: ArrayLike) -> Combined:
    """Combine measurements (N,) with their sigmas (N,).

    The worst one is an outlier, as long as it is more than 3 sigma from the weighted mean of the
    others, its own sigma included, and two others remain.
    """
    x, s = np.asarray(values, dtype=np.float64), np.asarray(sigmas, dtype=np.float64)
    kept = list(range(len(x)))
    while len(kept) > 2:
        distances = [_distance(x, s, one, [i for i in kept if i != one]) for one in kept]
        worst = int(np.argmax(distances))
        if distances[worst] <= _OUTLIER:
            break
        del kept[worst]
    mean, sigma = _mean(x[kept], s[kept])
    chi2 = float((((x[kept] - mean) / s[kept]) ** 2).sum())
    degrees = len(kept) - 1
    scale = max(1.0, np.sqrt(chi2 / degrees)) if degrees else 1.0
    return Combined(figure, mean, float(sigma * scale), chi2, degrees, tuple(bags),
                    tuple(bag for i, bag in enumerate(bags) if i not in kept))


@dataclass(frozen=True, slots=True)
class CombinedCalibration:
    """The figures that are observable in one bag at least, and the rotation v_cam = R(q) v_imu.

    The figures ``rotation_x_rad``, y and z are rotation vectors from it, about the camera's axes.
    """

    figures: tuple[Combined, ...] = ()
    quat_cam_imu_xyzw: tuple[float, ...] | None = None


def combine(calibrations: Mapping[str, Mapping[str, Any]]) -> CombinedCalibration:
    """Calibrations by the names of their bags as one; of each figure where it is observable."""
    combined = []
    for figure in CALIBRATED:
        found = {bag: calibrated(figure, mapping) for bag, mapping in calibrations.items()}
        good = {bag: one for bag, one in found.items() if one is not None and one['observable']}
        if good:
            values, sigmas = ([one[part] for one in good.values()] for part in ('value', 'sigma'))
            combined.append(weighted_mean(figure, list(good), values, sigmas))
    turned = {bag: mapping for bag, mapping in calibrations.items()
              if mapping['rotation_from_axis_map_rad']['observable']}
    if not turned:
        return CombinedCalibration(tuple(combined))
    rotations = Rotation.from_quat([mapping['quat_cam_imu_xyzw'] for mapping in turned.values()])
    near = rotations.mean()
    vectors = (rotations * near.inv()).as_rotvec()
    about = np.array([mapping['rotation_sigma_rad'] for mapping in turned.values()])
    of_axes = [weighted_mean(f'rotation_{axis}_rad', list(turned), vectors[:, i], about[:, i])
               for i, axis in enumerate('xyz')]
    mean = Rotation.from_rotvec([one.mean for one in of_axes]) * near
    return CombinedCalibration(
        (*combined, *(replace(one, mean=0.0) for one in of_axes)),
        tuple(float(value) for value in mean.as_quat(canonical=True)))


def _distance(x: np.ndarray, s: np.ndarray, one: int, others: list[int]) -> float:
    mean, sigma = _mean(x[others], s[others])
    return float(abs(x[one] - mean) / np.hypot(s[one], sigma))


def _mean(x: np.ndarray, s: np.ndarray) -> tuple[float, float]:
    weights = s ** -2.0
    return float((weights * x).sum() / weights.sum()), float(weights.sum() ** -0.5)
