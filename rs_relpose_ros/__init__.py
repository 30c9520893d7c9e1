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
    from rs_relpose_ros.config.estimator import EstimatorConfig
    from rs_relpose_ros.config.parameters import Parameters
    from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
    from rs_relpose_ros.estimator.estimate import estimate_relative_pose
    from rs_relpose_ros.estimator.result import RelativePose, Status
    from rs_relpose_ros.estimator.warm_up import warm_up
    from rs_relpose_ros.front_end.chosen_pairs import estimate_wide_pair, view_frame
    from rs_relpose_ros.front_end.frame import Frame
    from rs_relpose_ros.geometry.camera import RollingShutterCamera
    from rs_relpose_ros.geometry.inertial import InertialMotion
    from rs_relpose_ros.geometry.intrinsics import Intrinsics
    from rs_relpose_ros.geometry.motion import FrameMotion
    from rs_relpose_ros.imu.buffer import ImuBuffer
    from rs_relpose_ros.imu.samples import ImuSample
    from rs_relpose_ros.messages.pose_chain import PoseChain
    from rs_relpose_ros.messages.published_pair import PairSynchronizer

__all__ = ['EstimatorConfig', 'Frame', 'FrameMotion', 'ImuBuffer', 'ImuSample', 'InertialMotion',
           'InputError', 'Intrinsics', 'MissingInputError', 'PairSynchronizer', 'Parameters',
           'PoseChain', 'RelativePose', 'RollingShutterCamera', 'RsRelposeError', 'Status',
           'estimate_relative_pose', 'estimate_wide_pair', 'view_frame', 'warm_up']

_HOMES = {
    'EstimatorConfig': 'config.estimator', 'Frame': 'front_end.frame',
    'FrameMotion': 'geometry.motion', 'ImuBuffer': 'imu.buffer', 'ImuSample': 'imu.samples',
    'InertialMotion': 'geometry.inertial', 'InputError': 'errors',
    'Intrinsics': 'geometry.intrinsics', 'MissingInputError': 'errors',
    'PairSynchronizer': 'messages.published_pair', 'Parameters': 'config.parameters',
    'PoseChain': 'messages.pose_chain', 'RelativePose': 'estimator.result',
    'RollingShutterCamera': 'geometry.camera', 'RsRelposeError': 'errors',
    'Status': 'estimator.result', 'estimate_relative_pose': 'estimator.estimate',
    'estimate_wide_pair': 'front_end.chosen_pairs', 'view_frame': 'front_end.chosen_pairs',
    'warm_up': 'estimator.warm_up',
}

logging.getLogger(__name__).addHandler(logging.NullHandler())


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f'{__name__}.{_HOMES[name]}'), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
