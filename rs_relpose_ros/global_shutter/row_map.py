"""Where each pixel of an image as if all rows were seen at once lies in the image as it was read.

A ray that is seen in row v at the row time tau is turned by the gyro to the middle row,

    m_mid = R_mid^T R(tau) m,    tau = (v - v_ref) * line_delay,

R(tau) being the orientation of the camera at row time tau. The map goes the other way, from the
pixel of the result to the pixel that was read: K^-1, undistort, R(tau)^T R_mid, distort, K, where
tau is that of the row in which the pixel is found. What the camera moves within the read-out stays
in the image: the gyro does not tell it, and it depends on depth.
"""

from __future__ import annotations

from collections.abc import Iterator
import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.front_end.derotated_rays import Sensor
from rs_relpose_ros.geometry.motion import FrameMotion

# Pixels from node to node of the grid on which the map is exact; linear in between. At 3 rad/s
# and a focal length of 450 px that is within 0.015 px (16 px: 0.04).
_STEP = 8
# Rows of the image that are looked up at once, a multiple of the step.
_BAND = 64
# Orientations over the read-out; linear in between, to 1e-7 rad at 3 rad/s.
_ORIENTATIONS = 129


class RowMap(NamedTuple):
    """A map for one motion, as its nodes.

    `nodes`: pixels (rows, columns, 2), u and v, of the image as read; NaN where the lens sees
    nothing. `width`, `height`: of the image. `shift`: largest difference of a coordinate of a node
    and its source [px].
    """

    nodes: NDArray[np.float32]
    width: int
    height: int
    shift: float

    @property
    def complete(self) -> bool:
        """Whether the lens sees every node."""
        return not np.isnan(self.nodes).any()

    def bands(self) -> Iterator[tuple[slice, NDArray[np.float32]]]:
        """Rows of the image, some at a time, and their sources (N, W, 2), for `cv2.remap`.

        What is done with a band finds it in the cache; a whole map would not be there.
        """
        for top in range(0, self.height, _BAND):
            bottom = min(top + _BAND, self.height)
            nodes = self.nodes[top // _STEP:math.ceil(bottom / _STEP) + 2]
            band = cv2.resize(nodes, (nodes.shape[1] * _STEP, nodes.shape[0] * _STEP),
                              interpolation=cv2.INTER_LINEAR)
            yield slice(top, bottom), np.asarray(
                band[_STEP:_STEP + bottom - top, _STEP:_STEP + self.width])


class MiddleRow:
    """Maps of one camera; images are those that its `Intrinsics` publish.

    Attributes
    ----------
    sensor : Sensor
    delay : float
        Row time [s] of the middle row of the published image, from the reference row of the
        camera.
    """

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        camera, intrinsics = sensor
        sizes = intrinsics.image_height, intrinsics.image_width
        # cv2.resize puts node k at pixel (k + 1/2) step - 1/2; one node more on each side, so that
        # all pixels lie between nodes.
        down, across = ((np.arange(math.ceil(size / _STEP) + 2) - 0.5) * _STEP - 0.5
                        for size in sizes)
        self._shape = len(down), len(across)
        self._nodes = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
        pixels = intrinsics.to_sensor(self._nodes)
        self._rays = camera.unproject(pixels)
        self._rows = np.ascontiguousarray(pixels[:, 1])   # of the sensor
        _, middle = intrinsics.to_sensor([[0.0, 0.5 * (sizes[0] - 1)]])[0]
        self.delay = float(camera.row_times(middle))

    def map(self, motion: FrameMotion) -> RowMap:
        """Where the pixels come from, for a motion relative to the reference row of the camera."""
        camera, intrinsics = self.sensor
        # From the middle row's frame to that of each of some rows: R(tau)^T R_mid.
        rows = np.linspace(0.0, camera.height - 1.0, _ORIENTATIONS)
        turns = np.einsum('nji,jk->nik', motion.rotations(camera.row_times(rows)),
                          motion.rotations([self.delay])[0])
        nodes = intrinsics.to_image(camera.project_turning(self._rays, self._rows, turns))
        shift = np.nanmax(np.abs(nodes - self._nodes), initial=0.0)
        return RowMap(nodes.reshape(*self._shape, 2).astype(np.float32), intrinsics.image_width,
                      intrinsics.image_height, float(shift))
