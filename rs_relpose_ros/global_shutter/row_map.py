"""Where each pixel of an image as if all rows were seen at once lies in the image as it was read.

A ray that is seen in row v at the row time tau is turned by the gyro to the middle row,

    m_mid = R_mid^T R(tau) m,    tau = (v - v_ref) * line_delay,

R(tau) being the orientation of the camera at row time tau. The map goes the other way, from the
pixel of the result to the pixel that was read: K^-1, undistort, R(tau)^T R_mid, distort, K, where
tau is that of the row in which the pixel is found. What the camera moves within the read-out stays
in the image: the gyro does not tell it, and it depends on depth.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.front_end.derotated_rays import Sensor
from rs_relpose_ros.geometry.motion import FrameMotion

Array = NDArray[np.float64]
Map = NDArray[np.float32]

# Pixels from node to node of the grid on which the map is exact; linear in between. At 3 rad/s
# and a focal length of 450 px that is within 0.015 px (16 px: 0.04).
_STEP = 8
# Orientations over the read-out; linear in between, to 1e-7 rad at 3 rad/s.
_ORIENTATIONS = 129


@dataclass(frozen=True, slots=True, eq=False)
class MiddleRow:
    """The map of one camera for any motion; images are those that its `Intrinsics` publish.

    Attributes
    ----------
    row : float
        The middle row of the published image, as a row of the sensor.
    delay : float
        Its row time [s] from the reference row of the camera.
    """

    sensor: Sensor
    row: float = field(init=False)
    delay: float = field(init=False)
    _rows: Array = field(init=False, repr=False)   # (N,) of the nodes, on the sensor
    _rays: Array = field(init=False, repr=False)   # (N, 3) of the nodes
    _shape: tuple[int, int] = field(init=False, repr=False)   # nodes down and across

    def __post_init__(self) -> None:
        camera, intrinsics = self.sensor
        sizes = intrinsics.image_height, intrinsics.image_width
        # cv2.resize puts node k at pixel (k + 1/2) step - 1/2; one node more on each side, so that
        # all pixels lie between nodes.
        down, across = ((np.arange(math.ceil(size / _STEP) + 2) - 0.5) * _STEP - 0.5
                        for size in sizes)
        nodes = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
        pixels = intrinsics.to_sensor(nodes)
        _, row = intrinsics.to_sensor([[0.0, 0.5 * (sizes[0] - 1)]])[0]
        values = {'row': float(row), 'delay': float(camera.row_times(row)),
                  '_rows': np.ascontiguousarray(pixels[:, 1]), '_rays': camera.unproject(pixels),
                  '_shape': (len(down), len(across))}
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def sources(self, motion: FrameMotion) -> Map:
        """Pixels (H, W, 2), u and v, of the image as read; NaN where the lens sees nothing.

        `motion` is relative to the camera's reference row and covers all of its rows.
        """
        camera, intrinsics = self.sensor
        # From the middle row's frame to that of each of some rows: R(tau)^T R_mid.
        rows = np.linspace(0.0, camera.height - 1.0, _ORIENTATIONS)
        turns = np.einsum('nji,jk->nik', motion.rotations(camera.row_times(rows)),
                          motion.rotations([self.delay])[0])
        nodes = intrinsics.to_image(camera.project_turning(self._rays, self._rows, turns))
        down, across = self._shape
        whole = cv2.resize(nodes.reshape(down, across, 2).astype(np.float32),
                           (across * _STEP, down * _STEP), interpolation=cv2.INTER_LINEAR)
        return np.asarray(whole[_STEP:_STEP + intrinsics.image_height,
                                _STEP:_STEP + intrinsics.image_width])
