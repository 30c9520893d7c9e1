"""Cameras and images that are turned by quarter turns to the left, as `numpy.rot90` turns arrays.

A driver that turns images does the same to the camera matrix. Rows of the sensor become columns of
the image, and the order in which they are read stays the same.
"""

from dataclasses import replace

import numpy as np

from rs_relpose_lab.simulation.rows import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera

# Direction of the readout after a quarter turn to the left.
_DIRECTIONS = {'down': 'right', 'right': 'up', 'up': 'left', 'left': 'down'}
# Row from which row times count after a quarter turn that reverses the numbers of the rows.
_REVERSED = {'first': 'last', 'middle': 'middle', 'last': 'first'}
# Axes of the turned camera, as columns, in those of the camera: its x axis is the y axis.
_QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def turned_camera(camera: RollingShutterCamera, turns: int) -> RollingShutterCamera:
    """The camera of images that `numpy.rot90` has turned `turns` times."""
    for _ in range(turns):
        camera = _after_quarter_turn(camera)
    return camera


def turned_axes(turns: int) -> Array:
    """Rotation (3, 3) from the axes of the turned camera to those of the camera."""
    return np.asarray(np.linalg.matrix_power(_QUARTER, turns), dtype=np.float64)


def turned_pixels(pixels: Array, camera: RollingShutterCamera, turns: int) -> Array:
    """Where `numpy.rot90` moves pixels (..., 2) of the camera's images."""
    for _ in range(turns):
        # The pixel (u, v) moves to (v, width - 1 - u).
        pixels = np.stack([pixels[..., 1], camera.width - 1.0 - pixels[..., 0]], axis=-1)
        camera = _after_quarter_turn(camera)
    return pixels


def _after_quarter_turn(camera: RollingShutterCamera) -> RollingShutterCamera:
    # Columns from left to right become rows from the last one to the first one.
    reference = camera.reference_row
    if camera.readout_axis == 0:
        reference = _REVERSED[reference]
    return replace(
        camera,
        width=camera.height,
        height=camera.width,
        cx=camera.cy,
        cy=camera.width - 1.0 - camera.cx,
        fx=camera.fy,
        fy=camera.fx,
        distortion=_turned_lens(camera.distortion),
        readout_direction=_DIRECTIONS[camera.readout_direction],
        reference_row=reference,
    )


def _turned_lens(distortion: tuple[float, ...]) -> tuple[float, ...]:
    """plumb_bob coefficients: x' = y, y' = -x exchanges the tangential ones."""
    if len(distortion) < 4:
        return distortion
    k1, k2, p1, p2, *rest = distortion
    return (k1, k2, -p2, p1, *rest)
