"""When a frame closes a pair with the reference keyframe and takes its place."""

from __future__ import annotations

from typing import NamedTuple

from rs_relpose_ros.config.keyframes import KeyframeConfig


class SinceKeyframe(NamedTuple):
    """What has happened since the reference keyframe."""

    parallax: float   # [px] median of the matches after derotation
    interval: float   # [s]
    frames: int   # 1 for the first frame after the keyframe
    tracked_fraction: float   # share of the keyframe's features that are still tracked


def closes_pair(since: SinceKeyframe, config: KeyframeConfig) -> bool:
    """Whether the current frame closes a pair: the camera moved far enough, or it is high time."""
    return (since.parallax >= config.min_keyframe_parallax
            or since.tracked_fraction < config.min_tracked_fraction
            or since.interval >= config.max_keyframe_interval
            or since.frames >= config.max_keyframe_frames)
