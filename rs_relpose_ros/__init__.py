"""Relative pose of two rolling-shutter images, aided by an IMU.

The public API, loaded on first use so that ``rs_relpose --help`` does not wait for NumPy and
Numba::

    from rs_relpose_ros import EstimatorConfig, FrameMotion, RollingShutterCamera
    from rs_relpose_ros import estimate_relative_pose
"""

from importlib import import_module
import logging
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from rs_relpose_ros.config.settings import EstimatorConfig, Parameters
    from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
    from rs_relpose_ros.estimator.arguments import estimate_relative_pose, IntermediateFrame
    from rs_relpose_ros.estimator.result import RelativePose, Status
    from rs_relpose_ros.geometry.camera import Intrinsics, RollingShutterCamera
    from rs_relpose_ros.geometry.motion import FrameMotion, InertialMotion
    from rs_relpose_ros.imu.buffer import ImuBuffer, ImuSample
    from rs_relpose_ros.messages.published_pair import PairSynchronizer, PoseChain
    from rs_relpose_ros.odometry.rows import RowTrajectory
    from rs_relpose_ros.pipeline.chosen_pairs import estimate_wide_pair, view_frame
    from rs_relpose_ros.pipeline.pair import Frame
    from rs_relpose_ros.pipeline.warm_up import warm_up

__all__ = [
    'EstimatorConfig',
    'Frame',
    'FrameMotion',
    'ImuBuffer',
    'ImuSample',
    'InertialMotion',
    'InputError',
    'IntermediateFrame',
    'Intrinsics',
    'MissingInputError',
    'PairSynchronizer',
    'Parameters',
    'PoseChain',
    'RelativePose',
    'RollingShutterCamera',
    'RowTrajectory',
    'RsRelposeError',
    'Status',
    'estimate_relative_pose',
    'estimate_wide_pair',
    'view_frame',
    'warm_up',
]

# Module of each public name, which is imported when the name is used.
_HOMES = {
    'EstimatorConfig': 'config.settings',
    'Frame': 'pipeline.pair',
    'FrameMotion': 'geometry.motion',
    'ImuBuffer': 'imu.buffer',
    'ImuSample': 'imu.buffer',
    'InertialMotion': 'geometry.motion',
    'InputError': 'errors',
    'IntermediateFrame': 'estimator.arguments',
    'Intrinsics': 'geometry.camera',
    'MissingInputError': 'errors',
    'PairSynchronizer': 'messages.published_pair',
    'Parameters': 'config.settings',
    'PoseChain': 'messages.published_pair',
    'RelativePose': 'estimator.result',
    'RollingShutterCamera': 'geometry.camera',
    'RsRelposeError': 'errors',
    'RowTrajectory': 'odometry.rows',
    'Status': 'estimator.result',
    'estimate_relative_pose': 'estimator.arguments',
    'estimate_wide_pair': 'pipeline.chosen_pairs',
    'view_frame': 'pipeline.chosen_pairs',
    'warm_up': 'pipeline.warm_up',
}

logging.getLogger(__name__).addHandler(logging.NullHandler())


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f'{__name__}.{_HOMES[name]}'), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
