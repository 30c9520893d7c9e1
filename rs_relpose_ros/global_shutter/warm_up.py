"""Compiles (or loads from the cache) what turning a frame needs.

``python -m rs_relpose_ros.global_shutter.warm_up`` does it when the package is built.
"""

from __future__ import annotations

import numpy as np

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.front_end.front_end import FrameProcessed
from rs_relpose_ros.front_end.warm_up import warm_up_pipeline
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.global_shutter.frames import EncodedColorFrame
from rs_relpose_ros.global_shutter.unroller import unrolling_loop
from rs_relpose_ros.images.encoded import RawImage
from rs_relpose_ros.imu.samples import ImuSample

_SIDE = 32
_INTRINSICS = Intrinsics(width=_SIDE, height=_SIDE, fx=30.0, fy=30.0, cx=15.5, cy=15.5,
                         image_width=_SIDE, image_height=_SIDE,
                         distortion_model='plumb_bob', distortion=(-0.02, 0.01, 0.0, 0.0))


def warm_up_unroller(parameters: Parameters) -> None:
    """Turn two made-up frames; track them, too, where that is told."""
    sensor = parameters.sensor
    if sensor.track_time_offset or sensor.track_readout_time:
        warm_up_pipeline(parameters)
    parameters = parameters.updated({
        'readout_time': 0.02, 'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0], 'time_offset': 0.0,
        'stamp_exposure': 'middle', 'track_time_offset': False, 'track_readout_time': False})
    loop = unrolling_loop(parameters, offline=True)
    for stamp_ns in range(0, NANOSECONDS // 5, NANOSECONDS // 200):
        loop.sequencer.add_imu(ImuSample(stamp_ns, (0.01, 0.02, 0.03), (0.0, -9.81, 0.0)))
    image = RawImage(np.zeros(_SIDE**2, dtype=np.uint8), 'mono8', _SIDE, _SIDE, _SIDE, False)
    for stamp_ns in (NANOSECONDS // 20, NANOSECONDS // 10):
        loop.sequencer.add_frame(EncodedColorFrame(stamp_ns, image, '', _INTRINSICS))
        outcome = loop.step()
        assert isinstance(outcome, FrameProcessed), outcome
        assert outcome.result is not None
        outcome.result.image()


if __name__ == '__main__':
    warm_up_unroller(Parameters())
