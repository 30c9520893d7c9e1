"""What a calibration found, how sure it is, and what to record where it is not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

AXES = ('x (pitch)', 'y (yaw)', 'z (roll)')


@dataclass(frozen=True, slots=True)
class Estimate:
    """A figure with its 1 sigma, in the unit of the field; `remark` says why it is not observable.

    A figure that is not observable keeps its value, which means nothing then.
    """

    value: float
    sigma: float
    observable: bool
    remark: str = ''


@dataclass(frozen=True, slots=True, eq=False)
class CostCurve:
    """Cost of the whole fit over the read-out time, everything else fitted anew."""

    readout_times: Array    # (K,) signed [s]: negative is read upwards
    # (K,) minus the log-likelihood above that of the best; thinned out to independent pairs.
    costs: Array


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """Calibration of a rolling-shutter camera against a gyro.

    ``t_imu(row v) = stamp + time_offset + v / height * readout_time``: a negative read-out time is
    read upwards, with `time_offset` still that of row 0.
    """

    readout_time: Estimate                  # signed [s]
    fitted_readout: float                   # without its bound, the interval between frames [s]
    time_offset: Estimate                   # of row 0 [s], at the median interval between frames
    R_cam_imu: Array                        # (3, 3) v_cam = R_cam_imu v_imu
    rotation_sigma: Array                   # (3,) 1 sigma about the camera's axes [rad]
    rotation: Estimate                      # angle to `axis_map` [rad], with the largest sigma
    axis_map: Array                         # (3, 3) the nearest rotation between axes
    gyro_bias: tuple[Estimate, Estimate, Estimate]   # IMU frame [rad/s]
    focal_factor: Estimate | None           # true over assumed focal length; None where given
    # Change of the offset by the interval between frames [s/s], which automatic exposure makes;
    # None where the intervals do not vary like that.
    offset_by_interval: Estimate | None
    # Change of the offset by how early a stamp is against a smooth line [s/s], 1 where only the
    # stamps jitter; None where they do not.
    offset_by_jitter: Estimate | None
    stamp_jitter: float                     # rms about the smooth line [s]
    rotation_rates: Array                   # (3,) rms about the camera's axes less mean [rad/s]
    curve: CostCurve
    pixel_sigma: float                      # of a match, as seen [px]
    inlier_ratio: float
    frames: int
    pairs: int
    matches: int
    frame_interval: float                   # median [s]
    warnings: tuple[str, ...] = ()

    @property
    def observable(self) -> bool:
        """Whether all that a node needs could be told."""
        parts = [self.readout_time, self.time_offset, self.rotation, *self.gyro_bias]
        if self.focal_factor is not None:
            parts.append(self.focal_factor)
        return all(part.observable for part in parts)

    @property
    def follows_exposure(self) -> bool:
        """Whether the offset surely moves with the interval between frames."""
        slope = self.offset_by_interval
        return slope is not None and slope.observable and abs(slope.value) > 3.0 * slope.sigma

    @property
    def quat_cam_imu_xyzw(self) -> tuple[float, float, float, float]:
        """`R_cam_imu` as the node takes it."""
        x, y, z, w = (float(v) for v in Rotation.from_matrix(self.R_cam_imu).as_quat())
        return x, y, z, w

    @property
    def shutter(self) -> str:
        """'rolling', 'global' or 'unsure'.

        Rolling: the read-out time as fitted is 5 sigma and 1 ms from zero; global: it is within
        3 sigma or 1 ms of zero, and known to a millisecond.
        """
        value, sigma = abs(self.fitted_readout), self.readout_time.sigma
        if value > max(5.0 * sigma, 1e-3):
            return 'rolling'
        return 'global' if sigma < 1e-3 and value < max(3.0 * sigma, 1e-3) else 'unsure'
