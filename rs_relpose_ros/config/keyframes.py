"""When a frame closes a pair with the reference keyframe: the settings."""

from __future__ import annotations

from dataclasses import dataclass

from rs_relpose_ros.config.declarations import check_settings, setting


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
