"""Recordings of drawn tracks and their camera, for tests of `rs_relpose calibrate`."""

from dataclasses import replace

import numpy as np

from rs_relpose_lab.experiments.calibration_tracks import drawn, record, Recorded
from rs_relpose_ros.geometry.camera import RollingShutterCamera


def recorded(seed: int, frames: int) -> Recorded:
    """A recording at 30 Hz with a readout of 20 ms."""
    rng = np.random.default_rng(seed)
    truth = drawn(rng, readout_time=0.02, frames=frames)
    return record(replace(truth, fps=30.0), rng)


def camera_of(one: Recorded) -> RollingShutterCamera:
    """The camera of a recording, whose readout time is not known."""
    truth = one.truth
    return RollingShutterCamera(
        width=truth.width,
        height=truth.height,
        fx=truth.focal,
        fy=truth.focal,
        cx=truth.width / 2,
        cy=truth.height / 2,
        readout_time=0.0,
    )
