"""Alignment of the windows of a pair: each one of the current image with that of the reference.

What a track gathered in errors from frame to frame is gone then; the error of one alignment is
left. The current image is sampled as the reference sees it, turned and scaled as the tracks tell.
"""

from __future__ import annotations

from dataclasses import replace
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.tracking.brightness import brightness_table, with_brightness
from rs_relpose_ros.tracking.correlation import correlations
from rs_relpose_ros.tracking.images import Image
from rs_relpose_ros.tracking.lucas_kanade import inside, patch_radius, whole_images
from rs_relpose_ros.tracking.matches import Matches
from rs_relpose_ros.tracking.patches import cut, cut_warped

Array = NDArray[np.float64]

# A window that moves further [px] was lost before: drift is smaller.
_LARGEST_CORRECTION = 3.0
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.005)
# The fit of a window's turn and scale needs no more points than about this; each one costs time.
_FITTED = 100
# A fit that stretches or squeezes areas by more than this is none.
_LARGEST_STRETCH = 4.0


def aligned(matches: Matches, reference: Image, current: Image,
            config: TrackingConfig) -> tuple[Matches, NDArray[np.bool_]]:
    """`matches` (N) with their second points aligned, and which of them (N,) look alike."""
    points1, points2, side = matches.points1, matches.points2, config.klt_window
    radius = patch_radius(side, math.ceil(_LARGEST_CORRECTION))
    jacobians = window_jacobians(points1, points2)
    there = cut_warped(current, points2, jacobians, radius, points1)
    here = cut(reference, points1, radius)
    image = with_brightness(
        there.image, brightness_table(reference, current, points1, points2, side))
    windows = points1 + here.shifts
    flow = whole_images(here.image, image, windows, windows, side, 1, _CRITERIA)
    # From the pixels of the reference to those of the current image: p2 + J (x - p1).
    correction = np.einsum('nij,nj->ni', jacobians, flow.points - windows)
    found = points2 + correction
    correlation = correlations(here.image, image, windows, flow.points, side)
    # Patches repeat the border of the image: what was found there is not in the image.
    good = (flow.found & inside(current, found, side // 4)
            & (correlation >= config.min_correlation)
            & (np.linalg.norm(correction, axis=1) <= _LARGEST_CORRECTION))
    # A faint corner is worth less than a strong one of the same correlation.
    quality = correlation * flow.strength / (flow.strength + config.feature_quality)
    return replace(matches, points2=found, quality=quality), good


def window_homography(points1: Array, points2: Array) -> Array:
    """Homography (3, 3) from the first image to the second that fits the points (N, 2).

    The identity where there is none: too few points, or a wild fit.
    """
    if len(points1) < 8:
        return np.eye(3)
    # None, where there is none, becomes an array without shape.
    some = slice(None, None, -(-len(points1) // _FITTED))
    H = np.asarray(cv2.findHomography(points1[some], points2[some], method=0)[0],
                   dtype=np.float64)
    if H.shape != (3, 3) or not np.isfinite(H).all():
        return np.eye(3)
    scale = points1 @ H[2, :2] + H[2, 2]
    # Area of the image of a small window: det H / scale^3.
    with np.errstate(all='ignore'):
        area = np.linalg.det(H) / scale**3
    if not ((area > 1.0 / _LARGEST_STRETCH) & (area < _LARGEST_STRETCH)).all():
        return np.eye(3)
    return H


def window_jacobians(points1: Array, points2: Array) -> Array:
    """How windows around points (N, 2) are turned and scaled in the second image (N, 2, 2).

    Derivatives of `window_homography`: a column for each axis of the first image.
    """
    H = window_homography(points1, points2)
    homogeneous = np.column_stack([points1, np.ones(len(points1))]) @ H.T
    depth = homogeneous[:, 2, None, None]
    mapped = homogeneous[:, :2] / depth[:, 0]
    return (H[:2, :2] - mapped[:, :, None] * H[2, :2]) / depth
