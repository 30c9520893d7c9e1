"""Draws global_shutter.jpg: a house front from a swinging camera, before and after derotation.

PYTHONPATH=. python docs/images/global_shutter.py
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.experiments.global_shutter import configured, derotated_frames, swinging
from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.scene import Scene, Surface

RATE = 2.5   # largest [rad/s]
CONFIG = SimulationConfig(seed=1, duration=1.0, readout_time=0.033, distortion=(0.0,) * 5)
WIDTH, HEIGHT = 16.0, 9.0   # of the front [m]


def house_front() -> NDArray[np.uint8]:
    """Rows of windows with frames, between upright pilasters."""
    scale = 100   # texels per metre
    rng = np.random.default_rng(0)
    shape = round(HEIGHT * scale), round(WIDTH * scale)
    wall = 150.0 + 14.0 * cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), 3.0) * 6.0
    for left in np.arange(0.0, WIDTH, 2.0):
        pilaster = slice(round(left * scale), round((left + 0.25) * scale))
        wall[:, pilaster] += 55.0
        for top in np.arange(0.6, HEIGHT, 2.1):
            u, v = round((left + 0.7) * scale), round(top * scale)
            width, height = round(0.9 * scale), round(1.4 * scale)
            cv2.rectangle(wall, (u, v), (u + width, v + height), 235.0, -1)
            for column in range(2):
                for row in range(2):
                    place = u + 8 + column * (width // 2 - 3), v + 8 + row * (height // 2 - 3)
                    cv2.rectangle(wall, place, (place[0] + width // 2 - 13,
                                                place[1] + height // 2 - 13), 45.0, -1)
    return np.clip(wall, 0, 255).astype(np.uint8)


def labelled(image: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    """The image below a caption."""
    strip = np.full((34, image.shape[1]), 255, dtype=np.uint8)
    cv2.putText(strip, text, (8, 23), cv2.FONT_HERSHEY_SIMPLEX, 0.6, 0.0, 1, cv2.LINE_AA)
    return np.concatenate([strip, image])


def main() -> None:
    """Choose the frame with the largest shift, and draw it."""
    texture = house_front()
    front = Surface(np.array([6.5, WIDTH / 2, HEIGHT - 2.6]), np.array([0.0, -1.0, 0.0]),
                    np.array([0.0, 0.0, -1.0]), WIDTH, HEIGHT, texture)
    simulation = simulate(CONFIG, scene=Scene.of(front),
                          trajectory=swinging(RATE, CONFIG.duration, tilt=0.05))
    index, derotated = max(derotated_frames(simulation, configured(simulation), images=True),
                           key=lambda found: found[1].map.shift)
    pictures = (labelled(simulation.image(index), 'as the camera read it (33 ms, swinging)'),
                labelled(derotated.image().values, 'derotated by the gyro to its middle row'))
    gap = np.full((len(pictures[0]), 12), 255, dtype=np.uint8)
    path = Path(__file__).with_name('global_shutter.jpg')
    cv2.imwrite(str(path), np.concatenate([pictures[0], gap, pictures[1]], axis=1),
                [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == '__main__':
    main()
