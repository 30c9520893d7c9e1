"""Textured images under known homographies: exact correspondences for the tracking tests."""

import cv2
import numpy as np

MARGIN = 150


def texture(height, width, seed=0):
    """Smooth random texture of three scales, larger than the images by MARGIN on each side."""
    rng = np.random.default_rng(seed)
    shape = (height + 2 * MARGIN, width + 2 * MARGIN)
    total = np.zeros(shape)
    for sigma, weight in ((1.5, 1.0), (4.0, 2.0), (12.0, 3.0)):
        layer = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), sigma)
        total += weight * layer / layer.std()
    return np.clip(128.0 + 45.0 * (total - total.mean()) / total.std(), 0, 255).astype(np.uint8)


class WarpedScene:
    """A plane of texture seen under homographies: image = view(H), point = H^-1 texture point."""

    def __init__(self, height=480, width=640, seed=0):
        self.shape = (height, width)
        self._texture = texture(height, width, seed)
        self._rng = np.random.default_rng(seed + 1)

    def similarity(self, degrees=0.0, scale=1.0, shift=(0.0, 0.0)):
        """Homography (image px -> plane px) of a turn about the image centre, zoom and shift."""
        height, width = self.shape
        centre = np.array([[1.0, 0.0, width / 2], [0.0, 1.0, height / 2], [0.0, 0.0, 1.0]])
        c, s = scale * np.cos(np.radians(degrees)), scale * np.sin(np.radians(degrees))
        return centre @ np.array([[c, -s, shift[0]], [s, c, shift[1]], [0.0, 0.0, 1.0]]
                                 ) @ np.linalg.inv(centre)

    def view(self, H, noise=0.0, gain=1.0, offset=0.0):
        """The image (H, W) of uint8 of the plane under H, with noise of the given sigma."""
        height, width = self.shape
        to_texture = np.array([[1.0, 0.0, MARGIN], [0.0, 1.0, MARGIN], [0.0, 0.0, 1.0]]) @ H
        image = cv2.warpPerspective(self._texture, to_texture, (width, height),
                                    flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
        image = gain * image.astype(np.float64) + offset
        image += noise * self._rng.normal(size=self.shape)
        return np.clip(np.round(image), 0, 255).astype(np.uint8)


def moved(points, H1, H2):
    """Where points (N, 2) of the view under H1 lie in the view under H2."""
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ (np.linalg.inv(H2) @ H1).T
    return homogeneous[:, :2] / homogeneous[:, 2:]


def errors(matches, H1, H2):
    """Distances [px] of the matched points from the true ones."""
    return np.linalg.norm(moved(matches.points1, H1, H2) - matches.points2, axis=1)
