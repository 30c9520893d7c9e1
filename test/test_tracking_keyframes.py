"""The keyframe policy."""

import numpy as np
import pytest

from rs_relpose_ros.config.keyframes import KeyframeConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.front_end.keyframes import decide_keyframe, KeyframeDecision

CONFIG = KeyframeConfig(min_keyframe_parallax=10.0, max_keyframe_interval=0.5,
                        max_keyframe_frames=12, min_tracked_fraction=0.3)


@pytest.mark.parametrize('parallax, interval, frames, fraction, expected', [
    (9.9, 0.49, 11, 0.3, KeyframeDecision.WAIT),
    (10.0, 0.03, 1, 1.0, KeyframeDecision.PARALLAX),
    (10.0, 0.9, 30, 0.1, KeyframeDecision.PARALLAX),
    (0.0, 0.03, 1, 0.29, KeyframeDecision.TRACKS),
    (0.0, 0.5, 3, 1.0, KeyframeDecision.INTERVAL),
    (0.0, 0.3, 12, 1.0, KeyframeDecision.FRAMES),
    (np.nan, 0.1, 2, 0.0, KeyframeDecision.TRACKS),
    (np.nan, 0.5, 2, 1.0, KeyframeDecision.INTERVAL),
    (np.nan, 0.1, 2, 1.0, KeyframeDecision.WAIT),
])
def test_decision(parallax, interval, frames, fraction, expected):
    assert decide_keyframe(CONFIG, parallax, interval, frames, fraction) is expected


def test_illegal_policy_is_refused():
    with pytest.raises(InputError, match='max_keyframe_frames'):
        KeyframeConfig(max_keyframe_frames=0)
    with pytest.raises(InputError, match='min_tracked_fraction'):
        KeyframeConfig(min_tracked_fraction=1.5)
