"""Compilation (or loading from the cache) of the kernels of a run before its first frame.

    python -m rs_relpose_ros.pipeline.warm_up

fills the cache on two cores in a minute: the first run then starts at once.
"""

from collections.abc import Iterator
from dataclasses import replace
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading

import cv2
from llvmlite.binding import get_host_cpu_name
import numba
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.settings import EstimatorConfig, Parameters
from rs_relpose_ros.estimator import frames_between
from rs_relpose_ros.estimator.estimate import estimate, Estimation
from rs_relpose_ros.estimator.pair_problem import PairProblem
from rs_relpose_ros.estimator.result import Diagnostics, RelativePose, Status
from rs_relpose_ros.estimator.sampling import MODES
from rs_relpose_ros.garbage import collect_seldom
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import Intrinsics, RollingShutterCamera
from rs_relpose_ros.geometry.gyro import GyroPath
from rs_relpose_ros.geometry.matches import Matches
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.so3 import exp_so3
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.jit import source_digest
from rs_relpose_ros.kernel_loading import LATE  # noqa: F401 - its import changes Numba
from rs_relpose_ros.pipeline.pair import Frame, Result
from rs_relpose_ros.pipeline.pipeline import FrameLoop, FrontEnd
from rs_relpose_ros.solvers.common import Solutions
from rs_relpose_ros.tracking.images import RawImage

# Width of the made-up images [px]: small, as their content does not matter, but large enough to be
# searched at half size, as most images are. [chosen: any size above 240 would do]
_WIDTH = 320
# Height of the made-up images [px]. [chosen: the same]
_HEIGHT = 240
# The made-up camera. It has a distortion, whose kernels are then compiled, too. [chosen: any
# distortion would do]
_INTRINSICS = Intrinsics(
    width=_WIDTH,
    height=_HEIGHT,
    fx=250.0,
    fy=250.0,
    cx=159.5,
    cy=119.5,
    image_width=_WIDTH,
    image_height=_HEIGHT,
    distortion_model='plumb_bob',
    distortion=(-0.02, 0.01, 0.0, 0.0),
)
# These values replace parameters that would keep made-up frames from being processed. [chosen: any
# legal values would do]
MADE_UP_SENSOR = {
    'readout_time': 0.02,
    'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0],
    'time_offset': 0.0,
    'stamp_exposure': 'middle',
}
# Rotation of a made-up pair by the gyro, with its covariance. [chosen: any values would do]
_ROTATION = np.eye(3), 1e-4 * np.eye(3)


def warm_up(config: EstimatorConfig | None = None) -> None:
    """Compile (or load from the cache) every kernel of an estimate with `config`."""
    estimate(replace(_problem(), config=config or EstimatorConfig()))


def warm_up_pipeline(parameters: Parameters) -> None:
    """Run the pipeline over a few made-up frames, once with all of the IMU, once with its gyro.

    Detector, solver and filters are those of `parameters`.
    """
    parameters = parameters.updated(
        {**MADE_UP_SENSOR, 'feature_rows': [0.0, 0.0], 'max_keyframe_frames': 1}
    )
    warm_up(parameters.estimator)  # with a frame between
    for with_force in (True, False):
        for frame in made_up_frames(FrontEnd(parameters, offline=True), with_force):
            if frame.result is not None and frame.result.landmarks_of is not None:
                frame.result.landmarks_of()


def made_up_frames(loop: FrameLoop[Result], with_force: bool = True) -> Iterator[Frame[Result]]:
    """A few made-up frames, as processed by an offline loop."""
    images = list(_images())
    frame_ns = NANOSECONDS // 30
    rate = (0.01, 0.02, 0.03)
    force = (0.0, -9.81, 0.0) if with_force else None
    end_ns = NANOSECONDS + (len(images) + 3) * frame_ns
    for stamp_ns in range(NANOSECONDS, end_ns, NANOSECONDS // 200):
        loop.sequencer.add_imu(ImuSample(stamp_ns, rate, force))
    for k, image in enumerate(images, start=1):
        stamped = RawImage.of_gray(image, NANOSECONDS + k * frame_ns)
        loop.sequencer.add_frame(stamped, _INTRINSICS)
        outcome = loop.step()
        assert isinstance(outcome, Frame), outcome
        yield outcome


def _images() -> Iterator[NDArray[np.uint8]]:
    """A far wall behind a near one, from a camera that moves and then stops."""
    noise = np.random.default_rng(0).integers(0, 256, (2, _HEIGHT, _WIDTH), dtype=np.uint8)
    layers = [cv2.GaussianBlur(layer, (0, 0), 2.0) for layer in noise]
    stretched = [
        cv2.normalize(layer, np.empty_like(layer), 0, 255, cv2.NORM_MINMAX) for layer in layers
    ]
    far, near = stretched
    for shift in (0, 4, 8, 8):
        image = np.roll(far, -shift, axis=1)
        image[80:160] = np.roll(near[80:160], -3 * shift, axis=1)
        yield image


def _problem() -> PairProblem:
    """A pair with a frame between, halfway."""
    points1, points2, camera, motion = _sideways()
    points = np.stack([points1, 0.5 * (points1 + points2), points2])
    rotation, covariance = _ROTATION
    return PairProblem(
        Matches(np.arange(len(points1), dtype=np.uint32), points, np.ones(len(points1))),
        camera,
        (motion,) * 3,
        np.array([0.0, 0.1, 0.2]),
        np.stack([rotation] * 3),
        np.stack([covariance] * 3),
        (None,) * 3,
        EstimatorConfig(),
        0,
        gyro=GyroPath.constant(np.zeros(3), 0.0, 0.2),
        R_cam_imu=np.eye(3),
    )


def _sideways() -> tuple[Array, Array, RollingShutterCamera, FrameMotion]:
    """Matches of a camera that moves to its right, for the warm-up."""
    rng = np.random.default_rng(0)
    camera = RollingShutterCamera(
        width=640, height=480, fx=450.0, fy=450.0, cx=319.5, cy=239.5, readout_time=0.03
    )
    motion = FrameMotion(np.array([0.0, 0.1, 0.0]), gravity=np.array([0.0, 1.0, 0.0]))
    world = rng.uniform([-4.0, -3.0, 4.0], [4.0, 3.0, 12.0], (100, 3))
    points1 = camera.project(world)
    points2 = camera.project(world - [0.5, 0.0, 0.0])
    return points1, points2, camera, motion


# -- The cache of the kernels: other processes fill it, so that their memory is freed -------------

# A pipeline with this least number of inliers does everything but the estimate. [chosen: no pair
# has so many matches]
_UNREACHABLE = 10_000
# Argument of this module in a process that another one has started to compile all kernels.
# [chosen: any word would do]
_WHOLE = 'whole'
# Argument in a process that compiles the kernels of the two-view estimate alone. [chosen: any
# other word would do]
_HALF = 'half'


def fill_cache() -> None:
    """Compile the kernels of the default parameters, on two cores, one process each."""
    collect_seldom()
    other_half = _started(_HALF)
    for solver in MODES[EstimatorConfig().solver].solvers:
        assert solver.address
    warm_up_pipeline(Parameters.from_mapping({'min_inliers': _UNREACHABLE}))
    problem = _problem()
    pose = RelativePose(
        status=Status.OK,
        inliers=np.ones(len(problem.matches), dtype=bool),
        R=np.eye(3),
        t=np.eye(3)[0],
        diagnostics=Diagnostics(residual_rms=1.0),
    )
    frames_between.refined(pose, problem)
    Estimation(problem).sample()  # with what the other process has compiled by then
    other_half.wait()
    warm_up_pipeline(Parameters())
    _mark().touch()


def _fill_half() -> None:
    """Compile a two-view estimate without sampling."""
    collect_seldom()
    hypothesis = Solutions(np.eye(3)[None], np.eye(1, 9))
    Estimation(_problem()).refine(hypothesis)


def _started(*arguments: str) -> subprocess.Popen[bytes]:
    """A process of this module that ends soon after this one: its stdin is a pipe from here."""
    return subprocess.Popen(
        [sys.executable, '-m', 'rs_relpose_ros.pipeline.warm_up', *arguments],
        stdin=subprocess.PIPE,
    )


def _end_with_stdin() -> None:
    """End this process when the other end of its stdin is closed."""

    def wait() -> None:
        os.read(0, 1)
        signal.raise_signal(signal.SIGKILL)  # whatever the compiler does

    threading.Thread(target=wait, daemon=True).start()


def _mark() -> Path:
    """File of a filled cache: by sources, version and machine."""
    sources = source_digest(__name__)[:16]
    return Path(exp_so3.stats.cache_path, f'{sources}-{get_host_cpu_name()}-{numba.__version__}')


def cache_is_filled() -> bool:
    """Whether `fill_cache` has been here, with these sources on this machine."""
    return _mark().exists()


def fill_cache_if_empty() -> None:
    """Compile in other processes: their memory, some 700 MB, is freed."""
    if not cache_is_filled():
        _started(_WHOLE).wait()


if __name__ == '__main__':
    if len(sys.argv) > 1:
        _end_with_stdin()
    if sys.argv[1:] == [_HALF]:
        _fill_half()
    else:
        fill_cache()
