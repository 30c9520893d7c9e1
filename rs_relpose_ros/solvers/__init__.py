"""Minimal solvers: the paper's five algorithms and the global-shutter 5-point."""

from rs_relpose_ros.solvers.minimal import (
    angular_3pt,
    angular_5pt,
    global_5pt,
    linear_9pt,
    uniform_9pt,
    uniform_11pt,
)
from rs_relpose_ros.solvers.solution import MinimalSolution

__all__ = [
    'MinimalSolution',
    'angular_3pt',
    'angular_5pt',
    'global_5pt',
    'linear_9pt',
    'uniform_9pt',
    'uniform_11pt',
]
