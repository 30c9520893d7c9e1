"""Deviations of camera, clocks and IMU from their configuration: one vector, in one order.

A deviation is true minus configured. The live monitor, the calibration of recordings and the doubt
of published poses use the entries of `ENTRIES` and take their indices from it. To add a deviation,
add its row there, and its derivative where it enters: `core.rows` or `geometry.lens`.

Nobody estimates all entries. A `Selection` is the basis of those that one estimator uses.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.core.least_squares import first_indices
from rs_relpose_ros.core.radial import corner_radius, independent_shapes, WRONG_SIGMA
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera


class Entry(NamedTuple):
    """One deviation, with as many values as it has components."""

    name: str
    size: int
    unit: str
    # 1 sigma of each value before anything is measured, if the parameter may be wrong.
    sigma: float
    # Largest value about which a pair is linearised: times, lens and readout stay possible.
    largest: float


# [chosen: sigmas cover what users configure wrongly by accident, so that a wrong parameter is
# within 3 sigmas; an axis that is exchanged is not a small deviation, and has checks of its own]
ENTRIES = (
    # R_true = Exp(c) R_cam_imu, in the axes of the camera.
    Entry('axes', 3, 'rad', 0.2, 0.5),
    # t_imu = t_image + time_offset, of the middle row.
    Entry('time_offset', 1, 's', 0.05, 0.06),
    # Change of time_offset by the covariate of a frame, such as its interval.
    Entry('offset_per_interval', 1, 's/s', 1.0, 2.0),
    # From the first to the last row; negative if row 0 is read last.
    Entry('readout_time', 1, 's', 0.03, 0.1),
    Entry('gyro_bias', 3, 'rad/s', 0.1, 0.2),
    # w_true = (1 + c) w for each axis of the IMU.
    Entry('gyro_scale', 3, '', 0.2, 0.3),
    # w_true = (I + M) w with M symmetric, zero on its diagonal: yz, xz, xy.
    Entry('gyro_skew', 3, 'rad', 0.005, 0.02),
    # Square of the exposure time, over which the rates of the gyro are averaged.
    Entry('exposure_square', 1, 's^2', 1e-4, 1e-3),
    # The next five are those of `geometry.lens`, in its order. f_true = f exp(c), both.
    Entry('focal_log', 1, '', 0.3, 0.45),
    # fy / fx, true = configured exp(c): of images that were resized along one axis alone.
    Entry('aspect', 1, '', 0.2, 0.35),
    # Coefficients k1, k2, k3 in the whole vector. Where `Selection.of_camera` is applied, values
    # of `radial.independent_shapes`, of which the first one is k1 alone.
    Entry('distortion', 3, '', WRONG_SIGMA, 0.6),
    # Coefficients p1 and p2 of a lens that is not centred on the sensor, or tilted against it.
    Entry('tangential', 2, '', 2e-3, 0.02),
    # [px] in the whole vector, in widths of the image where `Selection.of_camera` is applied.
    Entry('principal_point', 2, 'width', 0.015, 0.1),
)

# 1 sigma of fy / fx of a camera whose focal length is known. A smaller one would hold pixels that
# are not quite square, a larger one would widen poses for what calibrations exclude.
# [chosen: pixels are square; any value in 0.001..0.005 would do]
ASPECT_SIGMA = 0.002
# 1 sigma of the tangential coefficients p1 and p2 of a lens that is known. A larger one would
# dominate the doubt of the axes. [chosen: what a calibration by a target leaves]
TANGENTIAL_SIGMA = 5e-4


def slices(sizes: Mapping[str, int]) -> dict[str, slice]:
    """The place of each name in a vector that has them one after the other."""
    first = first_indices(**sizes)
    return {name: slice(first[name], first[name] + size) for name, size in sizes.items()}


# Places of the entries in the whole vector.
PARTS = slices({entry.name: entry.size for entry in ENTRIES})
# Number of values of the whole vector.
N_DEVIATIONS = sum(entry.size for entry in ENTRIES)
# Places of the entries of `geometry.lens` in the whole vector.
LENS = slice(PARTS['focal_log'].start, PARTS['principal_point'].stop)

# Basis (3, 1) of the first of the three components alone.
FIRST = np.eye(3)[:, :1]


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """The deviations that an estimator uses, k values ``c``: all deviations are ``basis c``."""

    basis: Array  # (N_DEVIATIONS, k)
    parts: Mapping[str, slice]  # places of the entries in c
    sigmas: Array  # (k,) before anything is measured
    largest: Array  # (k,) about which a pair is linearised

    @classmethod
    def of(cls, *names: str, **bases: Array) -> Selection:
        """Select entries by name, with all of their values or with a basis (size, m) each.

        The order is the order of `ENTRIES`.
        """
        unknown = {*names, *bases} - PARTS.keys()
        if unknown:
            raise ValueError(f'not the names of deviations: {sorted(unknown)}')
        chosen = [entry for entry in ENTRIES if entry.name in {*names, *bases}]
        own = {entry.name: bases.get(entry.name, np.eye(entry.size)) for entry in chosen}
        sizes = {name: basis.shape[1] for name, basis in own.items()}
        counts = list(sizes.values())
        parts = slices(sizes)
        whole = np.zeros((N_DEVIATIONS, sum(counts)))
        for name, basis in own.items():
            whole[PARTS[name], parts[name]] = basis
        sigmas = [entry.sigma for entry in chosen]
        largest = [entry.largest for entry in chosen]
        return cls(
            whole,
            parts,
            np.repeat(sigmas, counts),
            np.repeat(largest, counts),
        )

    @property
    def size(self) -> int:
        """Number k of the values."""
        return len(self.sigmas)

    def part(self, name: str) -> slice:
        """Places of the values of an entry."""
        return self.parts[name]

    def index(self, name: str) -> int:
        """Place of the only value of an entry."""
        part = self.parts[name]
        if part.stop - part.start != 1:
            raise ValueError(f'{name} has more than one value')
        return int(part.start)

    def of_camera(self, camera: RollingShutterCamera) -> Array:
        """Basis (N_DEVIATIONS, k) of values in units of a camera: see `ENTRIES`."""
        basis = self.basis.copy()
        center = PARTS['principal_point']
        distortion = PARTS['distortion']
        basis[center] *= camera.width
        basis[distortion] = independent_shapes(corner_radius(camera)) @ basis[distortion]
        return basis

    def mask(self, *names: str) -> NDArray[np.bool_]:
        """Which of the values (k,) belong to these entries."""
        chosen = np.zeros(self.size, dtype=bool)
        for name in names:
            chosen[self.parts[name]] = True
        return chosen


# Deviations that the live monitor estimates from the pairs of the last seconds. Its `time_offset`
# is that of the stamped row, as the parameter: `by_stamped_row`.
LIVE = Selection.of(
    'axes',
    'time_offset',
    'readout_time',
    'gyro_bias',
    'gyro_scale',
    'gyro_skew',
    'focal_log',
    'aspect',
    'distortion',
    'tangential',
    'principal_point',
)
# Deviations of the calibration of a recording: all. Those that it does not estimate are doubts.
OFFLINE = Selection.of(*PARTS)


def by_name(**values: float) -> Array:
    """The whole vector (N_DEVIATIONS,) with the same value in all components of these entries."""
    whole = np.zeros(N_DEVIATIONS)
    for name, value in values.items():
        whole[PARTS[name]] = value
    return whole


def by_stamped_row(selection: Selection, basis: Array, share: float) -> Array:
    """Basis (N_DEVIATIONS, k) of a selection whose `time_offset` is that of the stamped row.

    `basis` is that of the selection with the offset of the middle row, which is read `share` of
    the readout after the stamped row, and so are its deviations.
    """
    basis = basis.copy()
    basis[PARTS['time_offset'], selection.part('readout_time')] = share
    return basis
