"""Compiles (or loads from the cache) every kernel that a run with given parameters needs.

    python -m rs_relpose_ros.front_end.warm_up

fills the cache on two cores, in one to two minutes: the first run then starts at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
import multiprocessing

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.estimator.warm_up import (
    warm_up_refinement,
    warm_up_sampling,
    warm_up_solvers,
)
from rs_relpose_ros.front_end.frame import Frame
from rs_relpose_ros.front_end.front_end import FrameProcessed, FrontEnd
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.imu.samples import ImuSample

_WIDTH, _HEIGHT = 320, 240
# With distortion, so that its kernels are compiled, too.
_INTRINSICS = Intrinsics(width=_WIDTH, height=_HEIGHT, fx=250.0, fy=250.0, cx=159.5, cy=119.5,
                         image_width=_WIDTH, image_height=_HEIGHT,
                         distortion_model='plumb_bob', distortion=(-0.02, 0.01, 0.0, 0.0))
_FRAME_NS = NANOSECONDS // 30
_IMU_NS = NANOSECONDS // 200


def warm_up_pipeline(parameters: Parameters) -> None:
    """Run the pipeline over a few made-up frames, once with all of the IMU, once with its gyro.

    Detector, solver and filters are those of `parameters`; what would keep the made-up frames from
    being processed is replaced.
    """
    parameters = parameters.updated({
        'readout_time': 0.02, 'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0], 'time_offset': 0.0,
        'stamp_exposure': 'middle', 'feature_rows': [0.0, 0.0], 'max_keyframe_frames': 1})
    for force in ((0.0, -9.81, 0.0), None):
        front_end = FrontEnd(parameters, offline=True)
        sequencer = front_end.sequencer
        images = list(_images())
        for stamp_ns in range(NANOSECONDS, NANOSECONDS + (len(images) + 3) * _FRAME_NS, _IMU_NS):
            sequencer.add_imu(ImuSample(stamp_ns, (0.01, 0.02, 0.03), force))
        for k, image in enumerate(images):
            sequencer.add_frame(Frame(NANOSECONDS + (k + 1) * _FRAME_NS, image, '', _INTRINSICS))
            outcome = front_end.step()
            assert isinstance(outcome, FrameProcessed), outcome


def _images() -> Iterator[NDArray[np.uint8]]:
    """A wall far away behind a near one, seen from a camera that moves, then stands."""
    noise = np.random.default_rng(0).integers(0, 256, (2, _HEIGHT, _WIDTH), dtype=np.uint8)
    far, near = (cv2.normalize(cv2.GaussianBlur(layer, (0, 0), 2.0), np.empty_like(layer), 0, 255,
                               cv2.NORM_MINMAX) for layer in noise)
    for shift in (0, 4, 8, 8):
        image = np.roll(far, -shift, axis=1)
        image[80:160] = np.roll(near, -3 * shift, axis=1)[80:160]
        yield image


def fill_cache() -> None:
    """Compile what the default parameters need, on two cores: one process compiles one at a time.

    Other solvers are compiled when they are chosen.
    """
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context('spawn')) as pool:
        other_half = pool.submit(_warm_up_estimate)
        warm_up_solvers()
        # No pair has that many matches: everything but the estimate.
        warm_up_pipeline(Parameters.from_mapping({'min_inliers': 10_000}))
        other_half.result()
    warm_up_pipeline(Parameters())


def _warm_up_estimate() -> None:
    warm_up_refinement()
    # By then the solvers are compiled, which are most of it.
    warm_up_sampling()


if __name__ == '__main__':
    fill_cache()
