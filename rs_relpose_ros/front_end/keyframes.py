"""When a frame closes a pair with the reference keyframe and takes its place."""

from __future__ import annotations

from enum import Enum

from rs_relpose_ros.config.keyframes import KeyframeConfig


class KeyframeDecision(Enum):
    """Whether the current frame closes a pair, and what for."""

    WAIT = 'wait'
    PARALLAX = 'parallax'
    INTERVAL = 'interval'
    FRAMES = 'frames'
    TRACKS = 'tracks'


def decide_keyframe(config: KeyframeConfig, parallax_px: float, interval_s: float, frames: int,
                    tracked_fraction: float) -> KeyframeDecision:
    """Decide on the current frame.

    Parameters
    ----------
    config : KeyframeConfig
    parallax_px : float
        Median parallax of the matches after derotation [px]; NaN where there are none.
    interval_s : float
        Time since the reference keyframe [s].
    frames : int
        Frames since the reference keyframe; 1 for the first after it.
    tracked_fraction : float
        Share of the reference's features that are still tracked.
    """
    if parallax_px >= config.min_keyframe_parallax:
        return KeyframeDecision.PARALLAX
    if tracked_fraction < config.min_tracked_fraction:
        return KeyframeDecision.TRACKS
    if interval_s >= config.max_keyframe_interval:
        return KeyframeDecision.INTERVAL
    if frames >= config.max_keyframe_frames:
        return KeyframeDecision.FRAMES
    return KeyframeDecision.WAIT
