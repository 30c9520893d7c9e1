"""When a frame closes a pair with the reference keyframe and takes its place."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from rs_relpose_ros.settings import check_settings, setting


@dataclass(frozen=True, slots=True)
class KeyframeConfig:
    """Keyframe policy."""

    min_keyframe_parallax: float = setting(
        12.0, 'median parallax, after derotation, that closes a pair', 'px', low=0.0, high=1000.0,
        live=True)
    max_keyframe_interval: float = setting(
        0.5, 'age of the reference keyframe that closes a pair whatever its parallax', 's',
        low=0.0, high=60.0, live=True)
    max_keyframe_frames: int = setting(
        30, 'frames after which a pair is closed whatever its parallax', low=1, high=1000,
        live=True)
    min_tracked_fraction: float = setting(
        0.4, 'a pair is closed when a smaller share of the features is still tracked',
        low=0.0, high=1.0, live=True)

    def __post_init__(self) -> None:
        check_settings(self)


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
