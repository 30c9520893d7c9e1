"""A picture of a pair to look at while the node runs: tracks, inliers and row times."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.front_end.pair import PairResult

Color = NDArray[np.uint8]

# Largest width [px]; wider images are shrunk, because publishing large messages is slow.
_MAX_WIDTH = 960
_BAR_WIDTH = 14
_CAPTION_HEIGHT = 24
_OUTLIER = (255, 255, 0)
_WHITE = (255, 255, 255)
# Fractional bits of the coordinates that OpenCV draws at.
_SHIFT = 4


def draw_debug_image(result: PairResult) -> Color:
    """The current image (H, W, 3) in blue, green, red, with what was found in it.

    Each match is a line from its pixel in the reference keyframe to a dot at its pixel now.
    Inliers have the colour of their row's time, as the bar on the left shows it, outliers are
    cyan. A caption tells the outcome. Needs the pair's images.
    """
    assert result.image2 is not None
    height, width = result.image2.shape
    scale = min(1.0, _MAX_WIDTH / width)
    size = (round(scale * width), round(scale * height))
    # Two thirds of the brightness, so that the lines stand out.
    gray = cv2.resize(result.image2, size, interpolation=cv2.INTER_AREA) // 3 * 2
    canvas = np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    points1, points2 = result.matches.points1, result.matches.points2
    inliers = result.pose.inliers
    if len(inliers) != len(points1):   # a pair that failed early has none
        inliers = np.zeros(len(points1), dtype=bool)
    first, last = _span(result)
    colors = _colors(result.row_times2, first, last)
    # Pixel centres lie at integer coordinates.
    ends = np.round(((np.stack([points1, points2], axis=1) + 0.5) * scale - 0.5)
                    * (1 << _SHIFT)).astype(int)
    for (start, end), inlier, color in zip(ends.tolist(), inliers, colors, strict=True):
        color = color if inlier else _OUTLIER
        cv2.line(canvas, start, end, color, 1, cv2.LINE_AA, _SHIFT)
        cv2.circle(canvas, end, 2 << _SHIFT, color, -1, cv2.LINE_AA, _SHIFT)
    if len(points2):
        _draw_bar(canvas, result, first, last)
    return np.concatenate([canvas, _caption(result, int(inliers.sum()), size[0])])


def _span(result: PairResult) -> tuple[float, float]:
    """Least and largest row time [s] of the matches; they differ."""
    times = result.row_times2
    if len(times) == 0 or np.ptp(times) < 1e-6:
        return 0.0, 1.0
    return float(times.min()), float(times.max())


def _colors(times: NDArray[np.float64], first: float, last: float) -> list[tuple[int, ...]]:
    levels = np.clip(40 + 215 * (times - first) / (last - first), 0, 255).astype(np.uint8)
    if len(levels) == 0:
        return []
    return [tuple(color) for color in
            cv2.applyColorMap(levels[:, None], cv2.COLORMAP_PLASMA)[:, 0].tolist()]


def _draw_bar(canvas: Color, result: PairResult, first: float, last: float) -> None:
    """Colours of the rows, with the times of the first and the last row that has a match."""
    rows, times = result.matches.points2[:, 1], result.row_times2
    top, bottom = int(np.argmin(rows)), int(np.argmax(rows))
    if rows[bottom] - rows[top] < 1.0:
        return
    scale = canvas.shape[1] / result.image2.shape[1]  # type: ignore[union-attr]
    slope = (times[bottom] - times[top]) / (rows[bottom] - rows[top])
    of_rows = times[top] + slope * (np.arange(len(canvas)) / scale - rows[top])
    canvas[:, :_BAR_WIDTH] = np.array(_colors(of_rows, first, last), dtype=np.uint8)[:, None]
    for row, y in ((0, 14), (len(canvas) - 1, len(canvas) - 6)):
        cv2.putText(canvas, f'{1e3 * of_rows[row]:.1f} ms', (_BAR_WIDTH + 4, y),
                    cv2.FONT_HERSHEY_SIMPLEX, 0.42, _WHITE, 1, cv2.LINE_AA)


def _caption(result: PairResult, inliers: int, width: int) -> Color:
    pose = result.pose
    what = f'{pose.status.value} {pose.model}' if pose else pose.status.value
    text = (f'{what}: {inliers} of {len(result.matches.points1)} matches, parallax '
            f'{result.parallax:.1f} px, {1e3 * result.interval:.0f} ms')
    if pose:
        text += f', residual {pose.residual_rms:.2f} px'
    strip = np.zeros((_CAPTION_HEIGHT, width, 3), dtype=np.uint8)
    cv2.putText(strip, text, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _WHITE, 1, cv2.LINE_AA)
    return strip
