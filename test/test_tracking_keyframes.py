"""The keyframe policy."""

import numpy as np
import pytest

from rs_relpose_ros.config.keyframes import KeyframeConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.front_end.pair import closes_pair, SinceKeyframe

CONFIG = KeyframeConfig(min_keyframe_parallax=10.0, max_keyframe_interval=0.5,
                        max_keyframe_frames=12, min_tracked_fraction=0.3)


@pytest.mark.parametrize('parallax, interval, frames, fraction, expected', [
    (9.9, 0.49, 11, 0.3, False),
    (10.0, 0.03, 1, 1.0, True),
    (10.0, 0.9, 30, 0.1, True),
    (0.0, 0.03, 1, 0.29, True),
    (0.0, 0.5, 3, 1.0, True),
    (0.0, 0.3, 12, 1.0, True),
    (np.nan, 0.1, 2, 0.0, True),
    (np.nan, 0.5, 2, 1.0, True),
    (np.nan, 0.1, 2, 1.0, False),
])
def test_decision(parallax, interval, frames, fraction, expected):
    since = SinceKeyframe(parallax, interval, frames, fraction)
    assert closes_pair(since, CONFIG) is expected


def test_illegal_policy_is_refused():
    with pytest.raises(InputError, match='max_keyframe_frames'):
        KeyframeConfig(max_keyframe_frames=0)
    with pytest.raises(InputError, match='min_tracked_fraction'):
        KeyframeConfig(min_tracked_fraction=1.5)
