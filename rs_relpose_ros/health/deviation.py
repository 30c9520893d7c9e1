"""What may be told wrong of camera and IMU, as one vector of small deviations from what is told.

Index ranges of the vector ``c`` (11,), true minus told:

- `AXES` [rad]: ``R_true = Exp(c) R_cam_imu``, in the camera frame;
- `OFFSET` [s]: of ``time_offset``, of the stamped row;
- `READOUT` [s]: of the signed read-out time, negative where row 0 is read last; the stamped row
  stays where it is;
- `BIAS` [rad/s]: of the gyro, in the IMU frame;
- `SCALE`: the gyro's, ``w_true = (1 + c) w``;
- `FOCAL`: of the inverse focal length, ``f_true = f / (1 + c)``;
- `DISTORTION`: of the first coefficient of the lens.
"""

from __future__ import annotations

AXES = slice(0, 3)
OFFSET = 3
READOUT = 4
BIAS = slice(5, 8)
SCALE = 8
FOCAL = 9
DISTORTION = 10
DEVIATIONS = 11

# Largest deviations [s] that tracking applies.
LARGEST_OFFSET, LARGEST_READOUT = 0.05, 0.01
